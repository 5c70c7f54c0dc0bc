"""Which cells, which lattice: grids that differ by whole cells, and exact means over them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from meshreg.errors import InputError, ResourceLimitError, UsageError
from meshreg.raster.spacing import Spacing as Spacing
from meshreg.raster.spacing import measure_spacing as measure_spacing
from meshreg.settings import RasterSettings
from meshreg.types import (
    Float64,
    Grid,
    Maps,
    Mesh,
    PointCloud,
    Survey,
    SurveyRaster,
    Transform,
)

PAPER_DEM_CELL = 0.10  # Bryson et al. 2013, III-C
PAPER_ORTHO_CELL = 0.05  # III-D
FINEST_SIFT_CELL = 0.01
LEAST_SHARE = 0.5  # a cell with data on less of its area is empty: the mean would sit to one side
_BYTES_PER_CELL = 11  # of a SurveyRaster


@dataclass(frozen=True)
class Cells:
    """Cell sizes [m] for a pair of surveys, and why they differ from the paper's.

    Unless the user says otherwise `dem` is a whole multiple of `ortho`, and that of `sift`.
    """

    dem: float
    ortho: float
    sift: float
    notes: tuple[str, ...] = ()


def choose_cells(
    reference: Survey, moving: Survey, settings: RasterSettings | None = None
) -> Cells:
    """Choose the cells for a pair: what the settings say, else what the data can bear.

    The DEM's cell is the paper's 0.10 m, but not finer than the points (three times the spacing
    of a cloud's points, so that the orthomosaic's cells of half the size hold two points each) or
    the texels; and finer where the patch is under 5 m across (50 cells at least) or its points are
    under 2 mm apart. It is 1, 2 or 5 times a power of ten. The orthomosaic has half that cell.
    SIFT works at the coarser texture's spacing, not finer than 0.01 m and not coarser than the
    orthomosaic, and coarsens where its raster would have over a quarter of `settings.max_cells`.

    Raises
    ------
    InputError
        If a survey covers no ground.
    UsageError
        If a cell in the settings is not positive.
    """
    settings = settings or RasterSettings()
    for name in ("dem_cell", "ortho_cell", "sift_cell"):
        value = getattr(settings, name)
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise UsageError(f"raster.{name} is {value}; a cell is a positive length in metres.")
    pair = [(survey, measure_spacing(survey)) for survey in (reference, moving)]
    notes: list[str] = []
    dem = _default_dem_cell(pair, notes if settings.dem_cell is None else [])
    ortho = 0.5 * dem
    if settings.ortho_cell is not None:
        ortho = settings.ortho_cell
        dem = ortho * max(1, math.ceil(dem / ortho - 1e-6))
    if settings.dem_cell is not None:
        dem = settings.dem_cell
        if settings.ortho_cell is None:
            ortho = dem / max(1, math.ceil(dem / ortho - 1e-6))
    sift = settings.sift_cell
    if sift is None:
        sift = _default_sift_cell(pair, ortho, settings, notes)
    return Cells(_clean(dem), _clean(ortho), _clean(sift), tuple(notes))


def _default_dem_cell(pair: list[tuple[Survey, Spacing]], notes: list[str]) -> float:
    needed = max(_finest(survey, spacing)[0] for survey, spacing in pair)
    across = min(_across(survey) for survey, _ in pair)
    closest = max(spacing.points for _, spacing in pair)
    wanted = _round_down(min(PAPER_DEM_CELL, across / 50, 50 * closest))
    dem = max(wanted, _round_up(needed))
    if dem > PAPER_DEM_CELL:
        why = "; ".join(f"{survey.name}: {_finest(survey, spacing)[1]}" for survey, spacing in pair)
        notes.append(f"DEM cell {dem:g} m instead of the paper's {PAPER_DEM_CELL:g} m ({why}).")
    elif dem < PAPER_DEM_CELL:
        notes.append(
            f"DEM cell {dem:g} m instead of the paper's {PAPER_DEM_CELL:g} m: the ground is "
            f"{across:.3g} m across, its points {closest:.3g} m apart."
        )
    return dem


def _finest(survey: Survey, spacing: Spacing) -> tuple[float, str]:
    """Finest DEM cell [m] that a survey bears, and what says so."""
    if isinstance(survey.geometry, PointCloud):
        return 3.0 * spacing.points, f"points {spacing.points:.3g} m apart"
    texels = spacing.texels or 0.0
    if texels > spacing.points:
        return texels, f"texels {texels:.3g} m apart"
    return spacing.points, f"points {spacing.points:.3g} m apart"


def _default_sift_cell(
    pair: list[tuple[Survey, Spacing]],
    ortho: float,
    settings: RasterSettings,
    notes: list[str],
) -> float:
    finest = FINEST_SIFT_CELL
    for survey, spacing in pair:
        cloud = isinstance(survey.geometry, PointCloud)
        finest = max(finest, 1.5 * spacing.points if cloud else spacing.texels or spacing.points)
    times = max(1, math.floor(ortho / finest + 0.01))
    area = max(_across(survey) ** 2 for survey, _ in pair)
    most = max(1, math.floor(ortho * math.sqrt(0.25 * settings.max_cells / area)))
    if most < times:
        notes.append(
            f"SIFT cell {ortho / most:.3g} m instead of {ortho / times:.3g} m: the ground is "
            f"{math.sqrt(area):.0f} m across (raster.max_cells {settings.max_cells:,})."
        )
    return ortho / min(times, most)


def _across(survey: Survey) -> float:
    """Square root of the bounding box's area [m]."""
    low, high = survey_bounds(survey)
    return math.sqrt(float(np.prod((high - low)[:2])))


def _round_up(length: float) -> float:
    """Smallest 1, 2 or 5 times a power of ten that is not over 10 % below `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(_clean(step * power) for step in (1, 2, 5, 10, 20) if step * power >= 0.9 * length)


def _round_down(length: float) -> float:
    """Largest 1, 2 or 5 times a power of ten that is not above `length`."""
    power = 10.0 ** math.floor(math.log10(length) + 1e-9)
    return next(_clean(step * power) for step in (5, 2, 1) if step * power <= length * (1 + 1e-9))


def _clean(length: float) -> float:
    """Drop the last digits, in which 0.1 and 3 × 0.1 / 3 differ."""
    return float(f"{length:.12g}")


def survey_bounds(survey: Survey, transform: Transform | None = None) -> Float64:
    """(2, 3) float64: lowest and highest absolute east, north, up [m] after `transform`.

    Points that are not finite, and vertices in no face, do not count.

    Raises
    ------
    InputError
        If nothing is left to bound.
    """
    geometry = survey.geometry
    if isinstance(geometry, Maps):
        points = _map_corners(geometry)
    else:
        points = geometry.points
        if isinstance(geometry, Mesh):
            used = np.zeros(len(points), bool)
            used[geometry.faces.ravel()] = True
            points = points if used.all() else points[used]
        if transform is None:  # one pass without a copy: NaN is skipped, infinity found below
            low, high = _finite_bounds(points)
            return _checked_bounds(survey, np.stack([low, high]) + survey.origin)
    points = points + survey.origin
    if transform is not None:
        points = transform.apply(points)
    return _checked_bounds(survey, np.stack(_finite_bounds(points)))


def _finite_bounds(points: Float64) -> tuple[Float64, Float64]:
    if not len(points):
        return np.full(3, np.inf), np.full(3, -np.inf)
    low, high = points.min(axis=0), points.max(axis=0)
    if not np.isfinite([low, high]).all():
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            return np.full(3, np.inf), np.full(3, -np.inf)
        low, high = points.min(axis=0), points.max(axis=0)
    return low, high


def _checked_bounds(survey: Survey, bounds: Float64) -> Float64:
    if not np.isfinite(bounds).all():
        what = "triangles" if isinstance(survey.geometry, Mesh) else "points"
        raise InputError(
            f"{survey.name} has no {what} with finite coordinates.",
            file=survey.source[0].path if survey.source else None,
            remedy="Export it again.",
        )
    return bounds


def _map_corners(maps: Maps) -> Float64:
    heights = maps.height[np.isfinite(maps.height)]
    low, high = (float(heights.min()), float(heights.max())) if heights.size else (0.0, 0.0)
    corners = []
    for grid in (maps.height_grid, maps.color_grid):
        if grid is not None:
            west, south, east, north = grid.bounds
            corners += [
                (x, y, z) for x in (west, east) for y in (south, north) for z in (low, high)
            ]
    return np.array(corners)


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
    lattice = cell if lattice is None else lattice
    times = round(lattice / cell)
    if not (cell > 0 and times >= 1 and abs(times * cell - lattice) <= 1e-9 * lattice):
        raise UsageError(
            f"The lattice of {lattice} m is no multiple of the cell of {cell} m.",
            remedy="Give a positive cell, and a lattice that it divides.",
        )
    low, high = survey_bounds(survey, transform) / lattice
    # What sticks out by less than a millionth of a cell is rounding.
    west, south = (math.floor(value + 1e-6) for value in low[:2])
    east, north = (math.ceil(value - 1e-6) for value in high[:2])
    shape = (max(north - south, 1) * times, max(east - west, 1) * times)
    return Grid(
        _clean(west * lattice), _clean(max(north, south + 1) * lattice), cell, shape, survey.crs
    )


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
    west, north = _clean(a.west + left * a.cell), _clean(a.north - top * a.cell)
    return Grid(west, north, a.cell, (bottom - top, right - left), a.crs)


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
    grid = replace(raster.grid, cell=_clean(raster.grid.cell * times), shape=(rows, cols))
    return replace(
        raster,
        grid=grid,
        height=height,
        color=color,
        valid=valid,
        color_valid=color_valid,
        samples=samples,
    )
