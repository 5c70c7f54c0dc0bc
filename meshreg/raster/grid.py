"""Which lattice: grids that differ by whole cells, and exact means over their cells."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from meshreg.errors import InputError, ResourceLimitError, UsageError
from meshreg.raster.cells import Cells, choose_cells
from meshreg.raster.spacing import Spacing, measure_spacing, rounded, survey_bounds
from meshreg.records import Float64, Grid, Maps, Survey, SurveyRaster, Transform

__all__ = [
    "Cells",
    "Spacing",
    "cell_offset",
    "check_size",
    "choose_cells",
    "coarsened",
    "common_grid",
    "measure_spacing",
    "on_grid",
    "require_together",
    "survey_bounds",
    "survey_grid",
    "survey_grids",
]

LEAST_SHARE = 0.5  # a cell with data on less of its area is empty: the mean would sit to one side
_BYTES_PER_CELL = 11  # of a SurveyRaster
_BLOCK = 512  # cells: the side of a GeoTIFF's tile, of which even an empty one is written
_APART = 64  # times the cells that all but a hundredth of the points would need
_LOOKED_AT = 100_000  # points


def survey_grid(
    survey: Survey,
    cell: float,
    lattice: float | None = None,
    *,
    transform: Transform | None = None,
) -> Grid:
    """Return the smallest grid of a worldwide lattice that holds the survey.

    Parameters
    ----------
    survey : Survey
    cell : float
        Side of a cell [m].
    lattice : float, optional
        The grid's edges are whole multiples of this length [m], itself a multiple of `cell`
        (default: the cell). Grids of one cell and lattice differ by whole cells.
    transform : Transform, optional
        `reference_from_moving`: the grid is to hold the moved survey.
    """
    return _holding(survey_bounds(survey, transform), cell, lattice, survey.crs)


def survey_grids(
    survey: Survey,
    cells: Mapping[str, float],
    lattice: float | None = None,
    *,
    transform: Transform | None = None,
) -> dict[str, Grid]:
    """Return `survey_grid` for each of the named cells [m]; the survey is measured once."""
    bounds = survey_bounds(survey, transform)
    return {name: _holding(bounds, cell, lattice, survey.crs) for name, cell in cells.items()}


def _holding(bounds: Float64, cell: float, lattice: float | None, crs: str | None) -> Grid:
    lattice = cell if lattice is None else lattice
    times = round(lattice / cell) if cell > 0 else 0
    if not (times >= 1 and abs(times * cell - lattice) <= 1e-9 * lattice):
        raise UsageError(
            f"The lattice of {lattice} m is not a multiple of the cell of {cell} m.",
            remedy="Give a positive cell, and a lattice that it divides.",
        )
    low, high = bounds / lattice
    # What sticks out by less than a millionth of a cell is rounding.
    west, south = (math.floor(value + 1e-6) for value in low[:2])
    east, north = (math.ceil(value - 1e-6) for value in high[:2])
    shape = (max(north - south, 1) * times, max(east - west, 1) * times)
    return Grid(rounded(west * lattice), rounded(max(north, south + 1) * lattice), cell, shape, crs)


def check_size(grid: Grid, max_cells: int) -> None:
    """Raise ResourceLimitError, with the numbers, if the grid has over `max_cells` cells."""
    rows, cols = grid.shape
    limit = min(max_cells, 2**31 - 1)
    if rows * cols > limit:
        width, length = cols * grid.cell, rows * grid.cell
        raise ResourceLimitError(
            f"A raster of {width:.6g} m × {length:.6g} m in cells of {grid.cell:g} m has "
            f"{rows * cols:,} cells ({rows * cols * _BYTES_PER_CELL / 1e9:.1f} GB); "
            f"the limit is {limit:,}.",
            remedy="Choose larger cells (--dem-cell, --ortho-cell, --sift-cell), look for stray "
            "points far away, or raise it (--set raster.max_cells=...).",
        )


def require_together(survey: Survey, cell: float, grid: Grid | None = None) -> None:
    """Refuse a survey whose lattice would be enormous for the sake of a few points far away.

    A raster's cost grows with its lattice, whatever lies in it. `grid` is compared with the box
    around all points but a hundredth (half of it at each end, by coordinate), both in whole blocks
    of 512 × 512 cells; without it the box around all points.

    Raises
    ------
    InputError
        If the one is over 64 times the other, with the points that make it so.
    """
    if isinstance(survey.geometry, Maps):
        return
    points = survey.geometry.points
    bounds = survey_bounds(survey)
    extent = bounds[:, :2]
    if grid is not None:
        reach = np.array([grid.shape[1], grid.shape[0]]) * grid.cell
        extent = np.array([[0.0, 0.0], reach])
    sample = points[:: max(1, len(points) // _LOOKED_AT), :2]
    sample = sample[np.isfinite(sample).all(axis=1)]
    # by rank, so that of a handful of points one is left out at each end as well
    low, high = np.quantile(sample, (0.005, 0.995), axis=0, method="closest_observation")
    if len(sample) > 8:
        low = np.maximum(low, np.partition(sample, 1, axis=0)[1])
        high = np.minimum(high, np.partition(sample, -2, axis=0)[-2])
    middle = np.array([low, high]) + survey.origin[:2]
    if _blocks(extent, cell) <= _APART * _blocks(middle, cell):
        return
    side = np.maximum(high - low, cell)
    far = np.flatnonzero(((points[:, :2] < low - side) | (points[:, :2] > high + side)).any(axis=1))
    whole, most = np.ptp(bounds[:, :2], axis=0), np.ptp(middle, axis=0)
    first = "" if not len(far) else f", the first of them at {_place(survey, int(far[0]))}"
    raise InputError(
        f"{survey.name} lies within {most[0]:.6g} m × {most[1]:.6g} m but for {len(far):,} of "
        f"{len(points):,} points far away{first}: its raster would be {whole[0]:.6g} m × "
        f"{whole[1]:.6g} m in cells of {cell:g} m, nearly all of them empty.",
        file=survey.source[0].path if survey.source else None,
        remedy="Remove the far points in the program that made the file.",
    )


def _blocks(ends: Float64, cell: float) -> float:
    return float(np.prod(np.ceil(np.maximum(np.ptp(ends, axis=0) / cell, 1) / _BLOCK)))


def _place(survey: Survey, row: int) -> str:
    """Say where a point lies: absolute east and north."""
    assert not isinstance(survey.geometry, Maps)
    east, north = (survey.geometry.points[row] + survey.origin)[:2]
    return f"{east:.10g} m east, {north:.10g} m north"


def cell_offset(a: Grid, b: Grid) -> tuple[int, int]:
    """Return (rows, columns) by which cell (0, 0) of `b` lies south and east of that of `a`.

    Raises
    ------
    UsageError
        If cells or CRS differ, or the lattices are shifted by a part of a cell.
    """
    if abs(a.cell - b.cell) > 1e-9 * a.cell:
        raise UsageError(f"The grids have cells of {a.cell} m and {b.cell} m.")
    if a.crs != b.crs:
        raise UsageError(f"The grids are in different CRS: {a.crs} and {b.crs}.")
    rows, cols = (a.north - b.north) / a.cell, (b.west - a.west) / a.cell
    if abs(rows - round(rows)) > 1e-3 or abs(cols - round(cols)) > 1e-3:
        raise UsageError(
            f"The grids are shifted by {rows:.4f} rows and {cols:.4f} columns.",
            remedy="Make both with meshreg.raster.grid.survey_grid and the same lattice.",
        )
    return round(rows), round(cols)


def common_grid(a: Grid, b: Grid) -> Grid:
    """Return the smallest grid on the lattice of `a` that holds `a` and `b`.

    Raises
    ------
    UsageError
        As `cell_offset`.
    """
    row, col = cell_offset(a, b)
    top, left = min(row, 0), min(col, 0)
    bottom = max(a.shape[0], row + b.shape[0])
    right = max(a.shape[1], col + b.shape[1])
    west, north = rounded(a.west + left * a.cell), rounded(a.north - top * a.cell)
    return Grid(west, north, a.cell, (bottom - top, right - left), a.crs)


def on_grid(raster: SurveyRaster, grid: Grid) -> SurveyRaster:
    """Copy a raster into a larger grid of the same lattice; nothing is resampled.

    Raises
    ------
    UsageError
        If the grid does not hold the raster, or is shifted by a part of a cell.
    """
    row, col = grid.row_col(*raster.grid.east_north(0, 0))
    top, left = round(float(row)), round(float(col))
    rows, cols = raster.grid.shape
    fits = 0 <= top <= grid.shape[0] - rows and 0 <= left <= grid.shape[1] - cols
    if not fits or max(abs(row - top), abs(col - left)) > 1e-3:
        raise UsageError(f"Grid {grid} does not hold {raster.grid} on one lattice.")
    part = (slice(top, top + rows), slice(left, left + cols))

    def placed(array: Any, empty: Any) -> Any:
        whole = np.full((*grid.shape, *array.shape[2:]), empty, array.dtype)
        whole[part] = array
        return whole

    return replace(
        raster,
        grid=grid,
        height=placed(raster.height, np.nan),
        color=placed(raster.color, 0),
        valid=placed(raster.valid, False),
        color_valid=placed(raster.color_valid, False),
        samples=placed(raster.samples, 0),
    )


def coarsened(raster: SurveyRaster, times: int, share: float = LEAST_SHARE) -> SurveyRaster:
    """Return the exact area mean over blocks of `times` × `times` cells from the NW corner.

    A block's height is the mean of its cells that have one, if those are at least `share` of all
    `times`² cells; its color likewise. Blocks that stick out in the south and east count what is
    outside as empty. Counts in `masked` stay those of the finer raster.

    Raises
    ------
    UsageError
        If `times` is not a positive whole number.
    """
    if times < 1 or times != int(times):
        raise UsageError(f"coarsened needs a whole number of cells to a block, not {times}.")
    if times == 1:
        return raster
    from meshreg.raster import finish_kernels

    rows, cols = (-(-size // times) for size in raster.grid.shape)
    height = np.empty((rows, cols), np.float32)
    color = np.zeros((rows, cols, 3), np.uint8)
    valid = np.empty((rows, cols), np.bool_)
    color_valid = np.empty((rows, cols), np.bool_)
    samples = np.empty((rows, cols), np.uint16)
    least = max(1, math.ceil(share * times * times - 1e-9))
    finish_kernels.block_heights(
        raster.height, raster.valid, raster.samples, times, least, height, valid, samples
    )
    finish_kernels.block_colors(raster.color, raster.color_valid, times, least, color, color_valid)
    grid = replace(raster.grid, cell=rounded(raster.grid.cell * times), shape=(rows, cols))
    return replace(
        raster,
        grid=grid,
        height=height,
        color=color,
        valid=valid,
        color_valid=color_valid,
        samples=samples,
    )
