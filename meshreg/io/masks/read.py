"""Masks: which part of a survey takes part in a registration.

A mask is a GeoTIFF (a pixel that is not zero and not without data: use) or polygons (GeoJSON or a
shapefile; inside: use). A polygon whose attribute `use` is false or 0, or whose attribute
`exclude` is true or 1, is left out instead; where all polygons are, everything else is used.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, MeshregError
from meshreg.io.files.safe import open_regular
from meshreg.io.frames.bridge import bridge
from meshreg.io.frames.crs import crs_text
from meshreg.io.maps import geotiff
from meshreg.io.maps import sides as geotiff_sides
from meshreg.io.masks.files import (
    KINDS,
    Area,
    inside,
    inside_cells,
    moved,
    read_geojson,
    read_shapefile,
)
from meshreg.records import Bool, Float64, Frame, Grid, Survey

log = logging.getLogger("meshreg")

_MAX_PIXELS = 1_000_000_000
_ROWS = 1 << 22  # cells worked on at once


@dataclass(frozen=True, eq=False)
class Raster:
    """A raster mask: `use` (H, W) bool; `matrix` (2, 3) from (col, row, 1) to x, y in `crs`."""

    use: Bool
    matrix: Float64
    crs: str | None


@dataclass(frozen=True, eq=False)
class Mask:
    """Says of every place whether it is used; made by `read_mask`.

    Attributes
    ----------
    path : Path
        The file, for messages.
    crs : str or None
        CRS of the coordinates that `at` takes, and of `areas`.
    areas : tuple of Area
    raster : Raster or None
    inverted : bool
    """

    path: Path
    crs: str | None
    areas: tuple[Area, ...] = ()
    raster: Raster | None = None
    inverted: bool = False

    def at(self, east: Any, north: Any) -> Bool:
        """Return which of the places are used, as bool of the arguments' shape."""
        east, north = np.broadcast_arrays(np.asarray(east, float), np.asarray(north, float))
        flat = np.ravel(east), np.ravel(north)
        if self.raster is not None:
            used = _raster_at(self.raster, self.crs, *flat)
        else:
            used = self._combined([(inside(area, *flat), area.use) for area in self.areas])
        return (used ^ self.inverted).reshape(east.shape)

    def __call__(self, grid: Grid) -> Bool:
        """Return which cells (by their centres) are used, (H, W) bool.

        A grid in another CRS than the mask's is served too.
        """
        if self.crs is not None and grid.crs is not None and grid.crs != self.crs:
            return self.to(grid.crs)(grid)
        rows, cols = grid.shape
        if self.raster is None:
            parts = [(inside_cells(area, grid), area.use) for area in self.areas]
            used = self._combined(parts) ^ self.inverted
        else:
            used = np.empty(grid.shape, bool)
            step = max(1, _ROWS // cols)
            for start in range(0, rows, step):
                block = slice(start, min(start + step, rows))
                row, col = np.mgrid[block, 0:cols]
                used[block] = self.at(*grid.east_north(row, col))
        if not used.any():
            log.warning("%s: the mask leaves nothing of this grid to use.", self.path)
        return used

    @staticmethod
    def _combined(parts: list[tuple[Bool, bool]]) -> Bool:
        wanted = [inside for inside, use in parts if use]
        unwanted = [inside for inside, use in parts if not use]
        used = np.any(wanted, axis=0) if wanted else np.ones_like(parts[0][0])
        return np.asarray(used & ~np.any(unwanted, axis=0) if unwanted else used)

    def to(self, crs: str) -> Mask:
        """Return the same mask for coordinates in another CRS (its corners go there)."""
        if self.crs is None:
            return replace(self, crs=crs)
        areas = tuple(moved(area, self.crs, crs) for area in self.areas)
        return replace(self, crs=crs, areas=areas)


def read_mask(
    path: str | Path,
    invert: bool = False,
    crs: str | None = None,
    survey: Survey | None = None,
) -> Mask:
    """Read a mask; its kind is told by its first bytes.

    Parameters
    ----------
    path : path
        GeoTIFF, GeoJSON or shapefile.
    invert : bool
        Leave out what would be used, and the reverse.
    crs : str or None
        CRS of the survey; None for a local frame, whose coordinates the mask then shares.
        A GeoJSON without a CRS is in degrees (RFC 7946), unless its numbers cannot be; any other
        file without one is in the survey's CRS.
    survey : Survey, optional
        A mask without a CRS that lies apart from this survey, but on it once the shift of the
        survey's file is added, was drawn in the file's own coordinates, and is read so.

    Raises
    ------
    InputError
        Not a mask, damaged, or without any polygon.
    """
    path = Path(path)
    with open_regular(path) as stream:
        head = stream.read(16)
    target = crs_text(crs) if crs else None
    try:
        if head[:4] in geotiff_sides.MAGIC:
            raster = _read_raster(path)
            own = raster.crs
            mask = Mask(path, target, (), replace(raster, crs=own or target), invert)
            return mask if survey is None else _on_survey(mask, mask, own, survey)
        if head[:4] == b"\x00\x00\x27\x0a":
            areas, own = read_shapefile(path)
        elif head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
            areas, own = read_geojson(path, target)
        else:
            raise InputError("is not a mask that is known.", file=path, remedy=KINDS)
        if not areas:
            raise InputError("holds no polygon.", file=path, remedy=KINDS)
        placed = areas
        if own is not None and target is not None and own != target:
            placed = tuple(moved(area, own, target) for area in areas)
        mask = Mask(path, target, placed, None, invert)
        if survey is not None:
            if head[:4] != b"\x00\x00\x27\x0a":
                areas, own = read_geojson(path, None)  # its numbers, degrees or not
            mask = _on_survey(mask, replace(mask, areas=areas), own, survey)
    except MeshregError as error:
        error.file = error.file or str(path)
        raise
    return mask


def _on_survey(mask: Mask, as_stored: Mask, own: str | None, survey: Survey) -> Mask:
    """Return the mask, or the one that its stored numbers are in the survey file's coordinates."""
    frame = survey.source[0].frame if survey.source else Frame()
    plain = (frame.axes[:2, :2] == np.eye(2)).all() and frame.is_linear
    if own is not None or not plain or not frame.shift[:2].any() or _meets(mask, survey):
        return mask
    shift = frame.shift[:2]
    areas = tuple(
        replace(area, rings=tuple(ring + shift for ring in area.rings)) for area in as_stored.areas
    )
    raster = as_stored.raster
    if raster is not None:
        raster = replace(raster, matrix=raster.matrix + np.outer(shift, (0, 0, 1)))
    shifted = replace(as_stored, areas=areas, raster=raster)
    if not _meets(shifted, survey):
        return mask
    text = ", ".join(f"{value:.12g}" for value in shift)
    log.warning(
        "%s: taken to be in the file coordinates of %s; its shift (%s) is added.",
        mask.path,
        survey.name,
        text,
    )
    return shifted


def _meets(mask: Mask, survey: Survey) -> bool:
    """Whether the mask's extent shares ground with the survey's."""
    if mask.raster is None:
        corners = np.concatenate([ring for area in mask.areas for ring in area.rings])
    else:
        rows, cols = mask.raster.use.shape
        ends = np.array([[0, 0, 1], [cols, 0, 1], [0, rows, 1], [cols, rows, 1]], float)
        corners = ends @ mask.raster.matrix.T
    low, high = survey.bounds[:, :2]
    return bool((corners.min(axis=0) <= high).all() and (corners.max(axis=0) >= low).all())


def _read_raster(path: Path) -> Raster:
    with geotiff.opened(path, _MAX_PIXELS) as dataset:
        matrix, crs = geotiff.lattice(dataset, path), geotiff.crs_of(dataset, path)
        use = np.empty(dataset.shape, bool)
        for window in geotiff.windows(dataset):
            values = dataset.read(1, window=window)
            known = dataset.dataset_mask(window=window) >= 128
            rows = slice(window.row_off, window.row_off + window.height)
            use[rows] = known & (values != 0) & ~np.isnan(values.astype(np.float64))
    return Raster(use, matrix, crs)


def _raster_at(raster: Raster, crs: str | None, east: Float64, north: Float64) -> Bool:
    points = np.column_stack([east, north, np.zeros_like(east)])
    if raster.crs is not None and crs is not None and raster.crs != crs:
        points = bridge(crs, raster.crs).forward(points)
    back = np.linalg.inv(raster.matrix[:, :2])
    col, row = np.floor(back @ (points[:, :2] - raster.matrix[:, 2]).T)
    rows, cols = raster.use.shape
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    used = np.zeros(len(points), bool)
    used[inside] = raster.use[row[inside].astype(int), col[inside].astype(int)]
    return used
