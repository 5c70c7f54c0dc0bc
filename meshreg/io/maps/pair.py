"""A DEM with its orthomosaic as GeoTIFFs: read, written, moved.

A survey that comes as maps keeps two north-up grids in metres. Files that are rotated, in degrees
or feet, or of pixels that are not square are sampled anew on reading (`meshreg.io.maps.regrid`).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from meshreg.errors import InputError, UsageError
from meshreg.io.files.rewriting import require_unchanged
from meshreg.io.files.safe import fingerprint, sha256
from meshreg.io.finding import split_maps
from meshreg.io.frames.bridge import bridge
from meshreg.io.frames.mover import Mover, to_absolute
from meshreg.io.frames.sidecar import SidecarInfo, find_sidecar
from meshreg.io.maps.frame import color_frame, is_height, map_frame, on_map, placed_raw
from meshreg.io.maps.geotiff import is_picture
from meshreg.io.maps.regrid import covering_grid, placed_grid, regrid
from meshreg.io.maps.values import RawMap, read_color, read_height
from meshreg.io.maps.write import write_color, write_height
from meshreg.io.options import ReadOptions
from meshreg.records import (
    Float64,
    Frame,
    Grid,
    Maps,
    SourceFile,
    Survey,
    SurveyRaster,
)

log = logging.getLogger("meshreg")

_ANY_SIZE = 1 << 62
_PAIR = 'Give both as "dem.tif,ortho.tif".'


def read(path: Path | str | Sequence[Path], options: ReadOptions) -> Survey:
    """Read a DEM, or a DEM and its orthomosaic as "dem.tif,ortho.tif" (in either order).

    Parameters
    ----------
    path : Path, str or sequence of Path
        One file, or two, in a sequence or joined by a comma.
    options : ReadOptions
        `unit` is that of the heights (and of x and y, where there is no CRS); ``axes="ned"``
        means that heights count downward; `crs` stands in for the files' own.

    Raises
    ------
    InputError
        See `read_pair`.
    """
    if not isinstance(path, str | Path):
        parts = tuple(path)
    else:
        whole = os.path.lexists(path)
        parts = (Path(path),) if whole else split_maps(str(path)) or (Path(path),)
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
        GeoTIFF of colors, in any CRS; it goes to the DEM's.
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
    colors = None if ortho is None else read_color(ortho, options.max_pixels)
    notes = [*heights.notes, *(colors.notes if colors is not None else ())]
    if colors is not None and colors.crs is not None and not (heights.crs or options.crs):
        notes.append("The DEM states no CRS; the orthomosaic's was taken for it.")
        options = replace(options, crs=colors.crs)
    sidecar = find_sidecar(dem, shared=False, given=options)
    frame = map_frame(heights, options, sidecar)
    if any(frame.shift):
        text = ", ".join(f"{value:.12g}" for value in frame.shift)
        notes.append(f"The shift ({text}) is added to the maps' coordinates.")
    height, _, height_grid = on_map(heights, frame, notes)
    sources = [_source(heights, frame, sidecar)]
    maps = Maps(np.asarray(height, np.float32), height_grid)
    if colors is not None:
        own = color_frame(colors, options, frame, notes)
        color, valid, color_grid = on_map(colors, own, notes)
        _require_overlap(height_grid, color_grid, colors.path)
        sources.append(_source(colors, own, None, companions=(dem,)))
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
    raw: RawMap,
    frame: Frame,
    sidecar: SidecarInfo | None,
    companions: tuple[Path, ...] = (),
) -> SourceFile:
    rows, cols = raw.valid.shape
    return SourceFile(
        path=raw.path,
        format="maps",
        frame=frame,
        companions=companions,
        sidecar=None if sidecar is None else sidecar.path,
        sha256=sha256(raw.path),
        fingerprint=fingerprint(raw.path, companions),
        counts={"rows": rows, "cols": cols, "valid": int(np.count_nonzero(raw.valid))},
    )


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
    InputError
        The file has changed since it was read, or is damaged.
    OutputError
        It could not be written, or did not read back as written.
    """

    def forward(points: Float64) -> Float64:
        return to_absolute(move.frame, move.points(points))

    require_unchanged(source, path)
    picture = is_picture(source.path, _ANY_SIZE)
    raw = (read_color if picture else read_height)(source.path, _ANY_SIZE)
    surface_raw = raw
    if picture and source.companions:
        surface_raw = read_height(source.companions[0], _ANY_SIZE)
    surface_placed = placed_raw(surface_raw, forward)
    placed = replace(placed_raw(raw, forward), level=surface_placed.level)
    surface = None
    if is_height(surface_raw):
        surface = (np.asarray(surface_raw.values, np.float32), surface_placed)
    grid = covering_grid(placed, move.frame.crs)
    values, valid = regrid(
        raw.values, raw.valid, placed, grid, is_height=not picture, surface=surface
    )
    local = move.frame.local or raw.local
    if picture:
        color = np.asarray(values, np.uint8)
        write_color(color, valid, grid, path, local=local, tags=raw.tags)
    else:
        write_height(np.asarray(values, np.float32), grid, path, local=local, tags=raw.tags)
    return (path,)


def local_crs(survey: Survey | None) -> str | None:
    """Return the WKT of the local CRS in which a survey's maps lie; None where there is none.

    Maps are in metres: a local system in another unit is not theirs.
    """
    if survey is None or survey.crs is not None or not survey.source:
        return None
    frame = survey.source[0].frame
    return frame.local if abs(abs(np.linalg.det(frame.axes)) - 1) < 1e-9 else None


def write_raster(
    raster: SurveyRaster,
    path: Path,
    what: Literal["height", "color"] = "height",
    local: str | None = None,
) -> None:
    """Write a rasterized survey's DEM or orthomosaic as a cloud-optimised GeoTIFF.

    Parameters
    ----------
    raster : SurveyRaster
    path : Path
    what : "height" or "color"
        Float32 heights (absolute: `datum` added; no data -9999), or 8-bit red, green, blue with an
        alpha band.
    local : str, optional
        WKT of the local CRS that they are in (`local_crs`), where they have none on Earth.

    Raises
    ------
    OutputError
        It could not be written, or did not read back as written.
    """
    if what == "color":
        write_color(raster.color, raster.color_valid, raster.grid, path, local=local)
    else:
        height = (raster.height.astype(np.float64) + raster.datum).astype(np.float32)
        height = np.where(raster.valid, height, np.float32(np.nan))
        write_height(height, raster.grid, path, local=local)


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
