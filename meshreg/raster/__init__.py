"""Rasterize: a survey seen straight from above, as a height and a color per cell.

`rasterize` is the one door; `meshreg.raster.grid` chooses cells and grids. Every kind of survey
ends as the same record: a mesh by a z-buffer of samples that are averaged (`mesh`), a cloud by the
mean of each cell's top layer (`cloud`), ready maps by resampling (`maps`).
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from meshreg.errors import UsageError
from meshreg.raster.cloud import draw_cloud
from meshreg.raster.finish import Layers, finished
from meshreg.raster.grid import check_size, choose_cells, require_together, survey_grid
from meshreg.raster.maps import draw_maps
from meshreg.raster.mesh import draw_mesh
from meshreg.raster.placing import place
from meshreg.raster.spacing import Spacing, measure_spacing
from meshreg.records import Grid, Maps, Mesh, Survey, SurveyRaster, Transform
from meshreg.settings import RasterSettings

log = logging.getLogger("meshreg")


def rasterize(
    survey: Survey,
    grid: Grid | None = None,
    settings: RasterSettings | None = None,
    *,
    transform: Transform | None = None,
    mask: Any = None,
) -> SurveyRaster:
    """Lay a survey on a grid: the top surface seen straight from above, area mean per cell.

    Heights are sampled at the mesh's spacing (2 × 2 to 16 × 16 samples a cell) and averaged,
    which keeps a fraction of a cell's accuracy that one ray a cell loses; colors likewise, at the
    texture's spacing up to 8 × 8 samples, texels finer than that being averaged beforehand. Cells
    with data on less than half of their area stay empty. Enclosed gaps of up to
    `settings.fill_cells` cells are closed by the mean of their neighbours (with 0 samples); the
    outer edge never moves.

    Parameters
    ----------
    survey : Survey
    grid : Grid, optional
        Default: the survey's own bounds at the orthomosaic's cell that `choose_cells` finds.
    settings : RasterSettings, optional
    transform : Transform, optional
        `reference_from_moving`, applied to the survey's points first.
    mask : callable, optional
        ``mask(grid)`` returns (H, W) bool, True where the survey is used, judged at cell centres;
        with a `transform` its ``at(east, north)`` is asked at the places before the move.

    Returns
    -------
    SurveyRaster
        `masked` counts what was left out, where there is anything: triangles or points in
        "floaters" and "not finite", triangles in "missing page", cells in "flat color", in
        "mask", and in "beneath" (surface hidden under the top one: overhangs, double layers).

    Raises
    ------
    InputError
        If the survey has no surface, no two of its points lie apart, or a few lie so far from the
        others that nearly all of its raster would be empty.
    UsageError
        If the grid's and the survey's CRS differ, or the mask has another shape than the grid.
    ResourceLimitError
        If the grid has more than `settings.max_cells` cells.
    """
    settings = settings or RasterSettings()
    spacing = measure_spacing(survey)
    if grid is None:
        cells = choose_cells(survey, survey, settings)
        grid = survey_grid(survey, cells.ortho, transform=transform)
    if grid.crs is not None and survey.crs is not None and grid.crs != survey.crs:
        raise UsageError(
            f"The grid is in {grid.crs}, {survey.name} in {survey.crs}.",
            remedy="Bring the survey to the grid's CRS first (meshreg.io.frames.reframe).",
        )
    require_together(survey, grid.cell, grid)
    check_size(grid, settings.max_cells)
    layers, texel, datum = _layers(survey, grid, settings, transform, spacing)
    raster = finished(layers, grid, settings, texel, datum, mask, transform)
    if raster.masked:
        log.info("%s: left out %s", survey.name, dict(raster.masked))
    return raster


def _layers(
    survey: Survey,
    grid: Grid,
    settings: RasterSettings,
    transform: Transform | None,
    spacing: Spacing,
) -> tuple[Layers, float, float]:
    """Draw the survey: its layers, the distance between its colors [m], the heights' datum [m]."""
    geometry = survey.geometry
    if isinstance(geometry, Maps):
        placing = place(survey, grid, transform, geometry.height[::16, ::16].astype(np.float64))
        return draw_maps(geometry, placing, grid), grid.cell, placing.datum
    heights = geometry.points[:: max(1, len(geometry.points) // 10_000), 2]
    placing = place(survey, grid, transform, heights)
    texels = None if spacing.texels is None else spacing.texels * placing.scale
    spacing = Spacing(spacing.points * placing.scale, texels)
    if isinstance(geometry, Mesh):
        layers = draw_mesh(geometry, placing, grid, spacing, settings)
    else:
        layers = draw_cloud(geometry, placing, grid, spacing, settings)
    return layers, texels or spacing.points, placing.datum
