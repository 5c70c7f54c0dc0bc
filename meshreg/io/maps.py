"""A DEM with its orthomosaic as GeoTIFFs: read, written, moved.

A survey that comes as maps keeps two north-up grids in metres. Files that are rotated, in degrees
or feet, or of pixels that are not square are sampled anew on reading (`meshreg.io.regrid`).
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from meshreg.errors import InputError, MeshregError, UsageError
from meshreg.io.bridge import bridge
from meshreg.io.crs import crs_name, metres_up, parse_crs
from meshreg.io.frames import frame_from
from meshreg.io.geotiff import is_picture
from meshreg.io.geotiff_values import RawMap, height_unit, read_color, read_height
from meshreg.io.geotiff_write import write_color, write_height
from meshreg.io.mover import Mover, to_absolute
from meshreg.io.options import ReadOptions
from meshreg.io.regrid import Forward, Placed, covering_grid, placed_grid, regrid
from meshreg.io.safe import fingerprint, sha256
from meshreg.io.sidecar import SidecarInfo, find_sidecar
from meshreg.types import Bool, Float32, Frame, Grid, Maps, SourceFile, Survey, SurveyRaster, UInt8

log = logging.getLogger("meshreg")

_ANY_SIZE = 1 << 62
_PAIR = 'Give both as "dem.tif,ortho.tif".'


def read(path: Path | str, options: ReadOptions) -> Survey:
    """Read a DEM, or a DEM and its orthomosaic as "dem.tif,ortho.tif" (in either order).

    Parameters
    ----------
    path : Path or str
        One file, or two joined by a comma.
    options : ReadOptions
        `unit` is that of the heights (and of x and y, where there is no CRS); ``axes="ned"``
        means that heights count downward; `crs` stands in for the files' own.

    Raises
    ------
    InputError
        See `read_pair`.
    """
    parts = [Path(part.strip()) for part in str(path).split(",")]
    if Path(path).is_file():
        parts = [Path(path)]
    if len(parts) > 2:
        raise UsageError(f"{len(parts)} maps were given; a survey has two.", remedy=_PAIR)
    if len(parts) == 1:
        return read_pair(parts[0], None, options)
    dem, ortho = parts
    if is_picture(dem, options.max_pixels) and not is_picture(ortho, options.max_pixels):
        dem, ortho = ortho, dem
    return read_pair(dem, ortho, options)


def read_pair(dem: Path, ortho: Path | None, options: ReadOptions) -> Survey:
    """Read a survey from its DEM and, if there is one, its orthomosaic.

    Parameters
    ----------
    dem : Path
        GeoTIFF of heights; the first band counts.
    ortho : Path or None
        GeoTIFF of colours, in any CRS; it goes to the DEM's.
    options : ReadOptions

    Returns
    -------
    Survey
        With `Maps` in a metric CRS, or in a local frame where neither file states one. Its two
        sources are of format "maps"; the orthomosaic's companion is the DEM.

    Raises
    ------
    InputError
        Not a GeoTIFF, damaged, not georeferenced, a picture instead of heights (or the reverse),
        two maps that do not overlap.
    ResourceLimitError
        More than `options.max_pixels` pixels.
    UsageError
        Options that contradict the files.
    """
    if is_picture(dem, options.max_pixels):
        raise InputError("is a picture, not a DEM: a survey needs heights.", file=dem, remedy=_PAIR)
    if ortho is not None and not is_picture(ortho, options.max_pixels):
        raise InputError("is a DEM, not a picture.", file=ortho, remedy=_PAIR)
    heights = read_height(dem, options.max_pixels)
    sidecar = find_sidecar(dem, shared=False)
    frame = _frame(heights, options, sidecar)
    notes = [*heights.notes]
    height, _, height_grid = _on_map(heights, frame, notes)
    sources = [_source(dem, frame, heights, sidecar)]
    maps = Maps(np.asarray(height, np.float32), height_grid)
    if ortho is not None:
        colors = read_color(ortho, options.max_pixels)
        notes += colors.notes
        color_frame = _color_frame(colors, options, frame, notes)
        color, valid, color_grid = _on_map(colors, color_frame, notes)
        _require_overlap(height_grid, color_grid, ortho)
        sources.append(_source(ortho, color_frame, colors, None, companions=(dem,)))
        maps = Maps(maps.height, height_grid, np.asarray(color, np.uint8), valid, color_grid)
    for note in notes:
        log.warning("%s: %s", dem.name, note)
    said = sidecar or SidecarInfo()
    return Survey(
        name=said.name or dem.stem,
        geometry=maps,
        crs=frame.crs,
        date=said.date,
        source=tuple(sources),
        notes=tuple(notes),
    )


def _source(
    path: Path,
    frame: Frame,
    raw: RawMap,
    sidecar: SidecarInfo | None,
    companions: tuple[Path, ...] = (),
) -> SourceFile:
    rows, cols = raw.valid.shape
    return SourceFile(
        path=path,
        format="maps",
        frame=frame,
        companions=companions,
        sidecar=None if sidecar is None else sidecar.path,
        sha256=sha256(path),
        fingerprint=fingerprint(path),
        counts={"rows": rows, "cols": cols, "valid": int(np.count_nonzero(raw.valid))},
    )


def _frame(raw: RawMap, options: ReadOptions, sidecar: SidecarInfo | None) -> Frame:
    """Join options, sidecar and file; the axes carry unit and sign of the heights."""
    if options.up == "y" or options.axes not in (None, "enu", "ned"):
        raise UsageError("A map's heights are up (or down, by axes='ned'), never y.", file=raw.path)
    said = sidecar or SidecarInfo()
    unit = options.unit if options.unit is not None else said.unit
    metres = height_unit(raw, None if unit is None else str(unit))
    crs = options.crs or said.crs or raw.crs
    if crs is None:
        level = height_unit(raw, str(unit)) if unit is not None else 1.0
        axes = np.diag([level or 1.0, level or 1.0, metres or 1.0])
    else:
        # PROJ's way to the metric CRS multiplies heights by the unit that the CRS states.
        axes = np.diag(
            [1.0, 1.0, 1.0 if metres is None else metres / abs(metres_up(parse_crs(crs)))]
        )
    if (options.axes or said.axes) == "ned":
        axes[2, 2] *= -1
    plain = replace(options, unit=None, axes=None, up=None)
    rows, cols = raw.valid.shape
    centre = np.array([*(raw.matrix @ [cols / 2, rows / 2, 1]), _level(raw)])
    try:
        return frame_from(
            plain, replace(said, unit=None, axes=None, up=None), raw.crs, axes, centre=centre
        )
    except MeshregError as error:
        error.file = error.file or str(raw.path)
        raise


def _color_frame(raw: RawMap, options: ReadOptions, dem: Frame, notes: list[str]) -> Frame:
    """Return the orthomosaic's frame, which leads to the DEM's CRS."""
    if raw.crs is None or dem.file_crs is None or options.crs is not None:
        if (raw.crs is None) != (dem.file_crs is None):
            one = "orthomosaic" if raw.crs is None else "DEM"
            notes.append(f"The {one} states no CRS; that of the other map was taken for both.")
        if dem.file_crs is None and raw.crs is not None:
            return Frame(dem.axes, dem.shift)
        return dem
    frame = _frame(raw, replace(options, shift=tuple(dem.shift)), None)
    if frame.crs != dem.crs:
        notes.append(f"The orthomosaic was taken from {crs_name(raw.crs)} to {crs_name(dem.crs)}.")
    return replace(frame, crs=dem.crs)


def _level(raw: RawMap) -> float:
    """Return a height amid the data, in the file's unit; 0 for a picture."""
    return (
        float(np.nanmedian(raw.values[::7, ::7]))
        if _is_height(raw) and np.isfinite(raw.values[::7, ::7]).any()
        else 0.0
    )


def _is_height(raw: RawMap) -> bool:
    return raw.values.ndim == 2


def _placed(raw: RawMap, forward: Forward) -> Placed:
    return Placed(raw.matrix, raw.valid.shape, forward, _level(raw))


def _on_map(raw: RawMap, frame: Frame, notes: list[str]) -> tuple[Float32 | UInt8, Bool, Grid]:
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
            if _is_height(raw) and (frame.axes[2, 2], shift[2]) != (1, 0):
                values = (values * frame.axes[2, 2] + shift[2]).astype(np.float32)
            return values, valid, grid
        why = f"its pixels are {a:.9g} by {abs(e):.9g}"
    elif b or d:
        why = "it is rotated"
    else:
        why = f"it is in {crs_name(frame.file_crs)}"
    placed = _placed(raw, lambda points: to_absolute(frame, points))
    grid = covering_grid(placed, frame.crs)
    notes.append(f"{raw.path.name} was sampled anew to squares of {grid.cell:.6g} m, as {why}.")
    values, valid = regrid(raw.values, raw.valid, placed, grid, is_height=_is_height(raw))
    return values, valid, grid


def _require_overlap(dem: Grid, ortho: Grid, path: Path) -> None:
    west, south, east, north = np.array([dem.bounds, ortho.bounds]).T
    if max(west) >= min(east) or max(south) >= min(north):
        raise InputError(
            f"does not overlap its DEM: it spans east {ortho.bounds[0]:.2f} to "
            f"{ortho.bounds[2]:.2f}, the DEM {dem.bounds[0]:.2f} to {dem.bounds[2]:.2f}; north "
            f"{ortho.bounds[1]:.2f} to {ortho.bounds[3]:.2f}, the DEM {dem.bounds[1]:.2f} to "
            f"{dem.bounds[3]:.2f}.",
            file=path,
            remedy="Give the two maps of one survey, in CRS that say where they are.",
        )


def reproject(maps: Maps, crs: str) -> Maps:
    """Take maps to another metric CRS; each keeps about its cell.

    Raises
    ------
    UsageError
        The maps have no CRS.
    InputError
        No known way between the two CRS.
    """
    own = maps.height_grid.crs
    if own is None:
        raise UsageError(f"These maps have no CRS; they cannot be taken to {crs}.")
    forward = bridge(own, crs).forward
    level = float(np.nanmedian(maps.height))
    placed = placed_grid(maps.height_grid, forward, level)
    grid = covering_grid(placed, crs)
    height, _ = regrid(maps.height, np.isfinite(maps.height), placed, grid, is_height=True)
    if maps.color is None or maps.color_valid is None or maps.color_grid is None:
        return Maps(np.asarray(height, np.float32), grid)
    placed = placed_grid(maps.color_grid, forward, level)
    color_grid = covering_grid(placed, crs)
    color, valid = regrid(maps.color, maps.color_valid, placed, color_grid, is_height=False)
    return Maps(
        np.asarray(height, np.float32), grid, np.asarray(color, np.uint8), valid, color_grid
    )


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of a DEM or an orthomosaic.

    The surface is sampled anew at the cell centres of a north-up grid in the target's absolute
    coordinates (metres; its CRS where it has one), with edges on whole multiples of the cell, so
    that maps of equal cell share a lattice. Heights move with the points. A tilt shifts a point
    by its height; an orthomosaic takes it from the DEM that it was read with.

    Parameters
    ----------
    source : SourceFile
        Of format "maps".
    move : Mover
    path : Path

    Raises
    ------
    InputError, OutputError
        As on reading and writing.
    """

    def forward(
        points: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    ) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return to_absolute(move.frame, move.points(points))

    picture = is_picture(source.path, _ANY_SIZE)
    raw = (read_color if picture else read_height)(source.path, _ANY_SIZE)
    surface_raw = raw
    if picture and source.companions:
        surface_raw = read_height(source.companions[0], _ANY_SIZE)
    surface_placed = _placed(surface_raw, forward)
    placed = replace(_placed(raw, forward), level=surface_placed.level)
    surface = None
    if _is_height(surface_raw):
        surface = (np.asarray(surface_raw.values, np.float32), surface_placed)
    grid = covering_grid(placed, move.frame.crs)
    values, valid = regrid(
        raw.values, raw.valid, placed, grid, is_height=not picture, surface=surface
    )
    if picture:
        write_color(np.asarray(values, np.uint8), valid, grid, path)
    else:
        write_height(np.asarray(values, np.float32), grid, path)
    return (path,)


def write_raster(
    raster: SurveyRaster, path: Path, what: Literal["height", "color"] = "height"
) -> None:
    """Write a rasterized survey's DEM or orthomosaic as a cloud-optimised GeoTIFF.

    Parameters
    ----------
    raster : SurveyRaster
    path : Path
    what : "height" or "color"
        Float32 heights (absolute: `datum` added; no data -9999), or 8-bit red, green, blue with an
        alpha band.

    Raises
    ------
    OutputError
        It could not be written, or did not read back as written.
    """
    if what == "color":
        write_color(raster.color, raster.color_valid, raster.grid, path)
    else:
        height = (raster.height.astype(np.float64) + raster.datum).astype(np.float32)
        write_height(np.where(raster.valid, height, np.float32(np.nan)), raster.grid, path)


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a survey of maps: the DEM to `path`, the orthomosaic beside it.

    The orthomosaic is called as the DEM, with "_ortho" for its "_dem" or added to its stem.

    Raises
    ------
    UsageError
        The survey is a mesh or a point cloud.
    """
    maps = survey.geometry
    if not isinstance(maps, Maps):
        raise UsageError(
            f"A {type(maps).__name__} is not written as GeoTIFF.",
            remedy="Make its maps by `meshreg rasterize`.",
        )
    write_height(maps.height, maps.height_grid, path)
    if maps.color is None or maps.color_valid is None or maps.color_grid is None:
        return (path,)
    ortho = path.with_name(path.stem.removesuffix("_dem") + "_ortho" + path.suffix)
    write_color(maps.color, maps.color_valid, maps.color_grid, ortho)
    return path, ortho
