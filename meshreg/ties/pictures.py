"""Pictures to pick on: a survey's orthomosaic as a GeoTIFF, or its relief where it has no color."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshreg.errors import InputError
from meshreg.io.maps.write import write_color
from meshreg.records import Bool, Float64, Grid, Maps, Survey, UInt8
from meshreg.report.style import hillshade
from meshreg.settings import RasterSettings


def write_picture(survey: Survey, path: Path, cell: float, settings: RasterSettings) -> None:
    """Write the picture of a survey as it was delivered.

    Parameters
    ----------
    survey : Survey
        Maps keep the cells of their own orthomosaic.
    path : Path
    cell : float
        Of anything else [m].
    settings : RasterSettings

    Raises
    ------
    InputError
        Neither color nor surface.
    """
    from meshreg.raster import rasterize
    from meshreg.raster.grid import survey_grid

    maps = survey.geometry
    if isinstance(maps, Maps):
        if maps.color is not None and maps.color_valid is not None and maps.color_grid is not None:
            write_color(maps.color, maps.color_valid, maps.color_grid, path)
        else:
            _write_relief(maps.height.astype(np.float64), maps.height_grid, path)
        return
    raster = rasterize(survey, survey_grid(survey, cell), settings)
    if raster.color_valid.any() and np.ptp(raster.color[raster.color_valid]) > 0:
        write_color(raster.color, raster.color_valid, raster.grid, path)
    elif raster.valid.any():
        _write_relief(raster.height.astype(np.float64), raster.grid, path)
    else:
        raise InputError(f"The survey {survey.name!r} shows nothing from above.")


def write_relief(dem: Path, path: Path) -> None:
    """Write the picture of a DEM's GeoTIFF.

    Raises
    ------
    InputError
        It is no DEM.
    """
    from meshreg.io.maps.values import read_height

    raw = read_height(dem, 1 << 62)
    (cell, _, west), (_, _, north) = raw.matrix.tolist()
    height = np.where(raw.valid, raw.values, np.nan).astype(np.float64)
    _write_relief(height, Grid(west, north, cell, raw.valid.shape), path)


def _write_relief(height: Float64, grid: Grid, path: Path) -> None:
    shade = hillshade(height, grid.cell)
    valid: Bool = np.isfinite(shade)
    grey = np.clip(np.nan_to_num(shade), 0, 1)
    color: UInt8 = np.repeat(np.round(255 * grey).astype(np.uint8)[..., None], 3, axis=2)
    color[~valid] = 0
    write_color(color, valid, grid, path)
