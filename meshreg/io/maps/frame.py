"""Where a map file's pixels are: its frame, and its values on a north-up square grid in metres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshreg.errors import MeshregError, UsageError
from meshreg.io.frames.crs import crs_name, metres_up, parse_crs
from meshreg.io.frames.framing import frame_from
from meshreg.io.frames.mover import to_absolute
from meshreg.io.frames.sidecar import SidecarInfo
from meshreg.io.maps.regrid import Forward, Placed, covering_grid, regrid
from meshreg.io.maps.values import RawMap, height_unit
from meshreg.io.options import ReadOptions
from meshreg.records import Bool, Float32, Frame, Grid, UInt8


def map_frame(raw: RawMap, options: ReadOptions, sidecar: SidecarInfo | None) -> Frame:
    """Join options, sidecar and file; the axes carry unit and sign of the heights."""
    if options.up == "y" or options.axes not in (None, "enu", "ned"):
        raise UsageError("A map's heights are up (or down, by axes='ned'), never y.", file=raw.path)
    said = sidecar or SidecarInfo()
    unit = options.unit if options.unit is not None else said.unit
    metres = height_unit(raw, None if unit is None else str(unit))
    crs = options.crs or said.crs or raw.crs
    if crs is None:
        flat = metres if unit is not None and metres is not None else 1.0
        axes = np.diag([flat, flat, 1.0 if metres is None else metres])
    else:
        # PROJ's way to the metric CRS multiplies heights by the unit that the CRS states.
        axes = np.diag(
            [1.0, 1.0, 1.0 if metres is None else metres / abs(metres_up(parse_crs(crs)))]
        )
    if (options.axes or said.axes) == "ned":
        axes[2, 2] *= -1
    plain = replace(options, unit=None, axes=None, up=None)
    rows, cols = raw.valid.shape
    centre = np.array([*(raw.matrix @ [cols / 2, rows / 2, 1]), level_of(raw)])
    try:
        frame = frame_from(
            plain, replace(said, unit=None, axes=None, up=None), raw.crs, axes, centre=centre
        )
        return frame if frame.local or frame.crs else replace(frame, local=raw.local)
    except MeshregError as error:
        error.file = error.file or str(raw.path)
        raise


def color_frame(raw: RawMap, options: ReadOptions, dem: Frame, notes: list[str]) -> Frame:
    """Return the orthomosaic's frame, which leads to the DEM's CRS."""
    if raw.crs is None and dem.file_crs is not None:
        notes.append("The orthomosaic states no CRS; the DEM's was taken for it.")
    if raw.crs is None or dem.file_crs is None or options.crs is not None:
        return dem
    frame = map_frame(raw, replace(options, shift=tuple(dem.shift)), None)
    if frame.crs != dem.crs:
        notes.append(f"The orthomosaic was taken from {crs_name(raw.crs)} to {crs_name(dem.crs)}.")
    return replace(frame, crs=dem.crs)


def level_of(raw: RawMap) -> float:
    """Return a height amid the data, in the file's unit; 0 for a picture."""
    sample = raw.values[::7, ::7]
    known = is_height(raw) and bool(np.isfinite(sample).any())
    return float(np.nanmedian(sample)) if known else 0.0


def is_height(raw: RawMap) -> bool:
    """Whether a raster holds heights (else colors)."""
    return raw.values.ndim == 2


def placed_raw(raw: RawMap, forward: Forward) -> Placed:
    """Return how a raster lies under `forward`, which takes its file's points anywhere."""
    return Placed(raw.matrix, raw.valid.shape, forward, level_of(raw))


def on_map(raw: RawMap, frame: Frame, notes: list[str]) -> tuple[Float32 | UInt8, Bool, Grid]:
    """Return a raster's values on a north-up square grid in metres, sampled anew if need be."""
    (a, b, west), (d, e, north) = raw.matrix.tolist()
    rows, cols = raw.valid.shape
    shift = frame.shift.tolist()
    square = abs(a - abs(e)) * max(rows, cols) < 0.01 * abs(a)
    if frame.is_linear and np.array_equal(frame.axes[:2, :2], np.eye(2)) and not (b or d) and a > 0:
        if square:
            values, valid = raw.values, raw.valid
            if e > 0:  # row 0 in the south
                values, valid, north = values[::-1], valid[::-1], north + rows * e
            grid = Grid(west + shift[0], north + shift[1], a, (rows, cols), frame.crs)
            if is_height(raw) and (frame.axes[2, 2], shift[2]) != (1, 0):
                values = (values * frame.axes[2, 2] + shift[2]).astype(np.float32)
            return values, valid, grid
        why = f"its pixels are {a:.9g} by {abs(e):.9g}"
    elif b or d:
        why = "it is rotated"
    else:
        why = f"it is in {crs_name(frame.file_crs)}"
    placed = placed_raw(raw, lambda points: to_absolute(frame, points))
    grid = covering_grid(placed, frame.crs)
    notes.append(f"{raw.path.name} was sampled anew to squares of {grid.cell:.6g} m, as {why}.")
    values, valid = regrid(raw.values, raw.valid, placed, grid, is_height=is_height(raw))
    return values, valid, grid
