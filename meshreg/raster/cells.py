"""Which cells a pair of surveys can bear."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from meshreg.errors import UsageError
from meshreg.raster.spacing import Spacing, measure_spacing, rounded, survey_bounds
from meshreg.records import PointCloud, Survey
from meshreg.settings import RasterSettings

PAPER_DEM_CELL = 0.10  # Bryson et al. 2013, III-C
PAPER_ORTHO_CELL = 0.05  # III-D
FINEST_SIFT_CELL = 0.02  # or a thousand to the ground's width, down to the next
FINEST_SMALL_CELL = 0.01


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
    of a cloud's scattered points, so that the orthomosaic's cells of half the size hold two points
    each; a gridded cloud is as good as the map that it was made from) or the texels; and finer
    where the patch is under 5 m across (50 cells at least) or its points are under 2 mm apart. It
    has one digit. The orthomosaic has half that cell, or the same where the texels are no finer.
    SIFT works at the coarser texture's spacing, but not finer than 0.02 m (on ground under 20 m
    across: than a thousandth of it, and not than 0.01 m) and not coarser than the orthomosaic, and
    coarsens where its raster would have over a quarter of `settings.max_cells`.

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
    texels = max(spacing.texels or spacing.points for _, spacing in pair)
    # half a texel would only show how texels are read between their centres
    # and a cell between the points of a gridded cloud none at all
    gridded = any(spacing.gridded for _, spacing in pair)
    ortho = dem if texels > (0.5 if gridded else 0.75) * dem else 0.5 * dem
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
    return Cells(rounded(dem), rounded(ortho), rounded(sift), tuple(notes))


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
    if isinstance(survey.geometry, PointCloud) and not spacing.gridded:
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
    area = max(_across(survey) ** 2 for survey, _ in pair)
    # finer images than these show more features than are kept (sift.max_features)
    finest = float(np.clip(math.sqrt(area) / 1000, FINEST_SMALL_CELL, FINEST_SIFT_CELL))
    for survey, spacing in pair:
        cloud = isinstance(survey.geometry, PointCloud) and not spacing.gridded
        finest = max(finest, 1.5 * spacing.points if cloud else spacing.texels or spacing.points)
    times = max(1, math.floor(ortho / finest + 0.01))
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
    """Smallest power of ten times 1, 2, 3, 4, 5, 6 or 8 that is not over 10 % below `length`."""
    power = 10.0 ** math.floor(math.log10(length))
    return next(
        rounded(step * power) for step in (1, 2, 3, 4, 5, 6, 8, 10) if step * power >= 0.9 * length
    )


def _round_down(length: float) -> float:
    """Largest 1, 2 or 5 times a power of ten that is not above `length`."""
    power = 10.0 ** math.floor(math.log10(length) + 1e-9)
    return next(rounded(step * power) for step in (5, 2, 1) if step * power <= length * (1 + 1e-9))
