"""Both surveys as rasters on one lattice: for the search, and as they lie in the end."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from meshreg.offsets import ESTIMATORS
from meshreg.raster import rasterize
from meshreg.raster.grid import coarsened, common_grid, on_grid, survey_grids
from meshreg.records import Grid, Survey, SurveyRaster, Transform
from meshreg.settings import Settings

Pairs = dict[str, tuple[SurveyRaster, SurveyRaster]]


def rasterize_pair(
    reference: Survey,
    moving: Survey,
    settings: Settings,
    masks: Mapping[str, Any],
    tell: Callable[[str, float], None],
    motion: Transform | None = None,
    known: Pairs | None = None,
) -> Pairs:
    """Both surveys at each cell that is needed, on one lattice.

    With a `motion` the moving survey is moved by it, and the reference taken from what is `known`.
    """
    cells = _cells(settings)
    lattice = _lattice(cells)

    def made(survey: Survey, which: str, motion: Transform | None) -> dict[str, SurveyRaster]:
        grids = survey_grids(survey, cells, lattice, transform=motion)
        return _levels(survey, grids, settings, masks[which], motion)

    if known is not None:
        moved = made(moving, "moving", motion)
        return {name: (known[name][0], moved[name]) for name in cells}
    still = made(reference, "reference", None)
    tell("rasterize", 0.5)
    moved = made(moving, "moving", motion)
    tell("rasterize", 1.0)
    return {name: (still[name], moved[name]) for name in cells}


def pair_grids(
    reference: Survey, moving: Survey, settings: Settings
) -> dict[str, tuple[Grid, Grid]]:
    """Return the grids (reference, moving) on which `rasterize_pair` lays the surveys."""
    cells = _cells(settings)
    lattice = _lattice(cells)
    still, moved = (survey_grids(survey, cells, lattice) for survey in (reference, moving))
    return {name: (still[name], moved[name]) for name in cells}


def rasterize_registered(
    moving: Survey,
    transform: Transform | None,
    settings: Settings,
    masks: Mapping[str, Any],
    pairs: Pairs,
) -> dict[str, Any]:
    """Lay both surveys on common grids, which hold the moving one before and after.

    One that was delivered wholly beside the reference and its own registered place would make them
    as large as the way between: it stays on its own grid, as "moving_…_apart". What SIFT looks at
    is not needed any more: cells are as large as the orthomosaic's.
    """
    rasters: dict[str, Any] = {}
    kept = {name: pairs[name] for name in ("dem", "ortho")}
    grids = {name: still.grid for name, (still, _) in kept.items()}
    apart = False
    if transform is not None:
        cells = _cells(settings)
        there = survey_grids(moving, cells, _lattice(cells), transform=transform)
        grids = {name: common_grid(grid, there[name]) for name, grid in grids.items()}
        apart = _beside(kept["dem"][1].grid, grids["dem"])
    if not apart:
        grids = {name: common_grid(grids[name], b.grid) for name, (_, b) in kept.items()}
    for name, (still, delivered) in kept.items():
        rasters[f"reference_{name}"] = on_grid(still, grids[name])
        if apart:
            rasters[f"moving_{name}_apart"] = delivered
        else:
            rasters[f"moving_{name}_before"] = on_grid(delivered, grids[name])
    if transform is None:
        return rasters
    moved = _levels(moving, grids, settings, masks["moving"], transform)
    return rasters | {"moving_dem": moved["dem"], "moving_ortho": moved["ortho"]}


def _beside(one: Grid, other: Grid) -> bool:
    """Whether two grids share no cell."""
    (w, s, e, n), (west, south, east, north) = one.bounds, other.bounds
    return w >= east or e <= west or s >= north or n <= south


def _levels(
    survey: Survey,
    grids: Mapping[str, Grid],
    settings: Settings,
    mask: Any,
    transform: Transform | None = None,
) -> dict[str, SurveyRaster]:
    """Rasterize a survey on the finest of the grids; the others are exact means where they fit."""
    finest = min(grids.values(), key=lambda grid: grid.cell)
    fine = rasterize(survey, finest, settings.raster, transform=transform, mask=mask)
    made = {}
    for name, grid in grids.items():
        times = round(grid.cell / finest.cell)
        if abs(grid.cell - times * finest.cell) < 1e-9 * grid.cell:
            made[name] = fine if times == 1 else coarsened(fine, times)
        else:
            made[name] = rasterize(survey, grid, settings.raster, transform=transform, mask=mask)
    return made


def _cells(settings: Settings) -> dict[str, float]:
    """Cell [m] of each kind of raster that the methods and the judge look at."""
    options = settings.raster
    cells = {"sift": options.sift_cell, "ortho": options.ortho_cell, "dem": options.dem_cell}
    needed = {ESTIMATORS[m].raster for m in settings.methods} | {"ortho", "dem"}
    return {name: float(cells[name] or 0.0) for name in needed}


def _lattice(cells: Mapping[str, float]) -> float | None:
    """Return the lattice [m] that holds all the cells; None if the coarsest is no multiple."""
    coarsest = max(cells.values())
    fits = all(abs(coarsest / c - round(coarsest / c)) < 1e-9 for c in cells.values())
    return coarsest if fits else None
