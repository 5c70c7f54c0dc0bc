"""How much of a cell's fraction survives: a real reef, shifted by known parts of a cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from reference_raster import grid_faces

from meshreg.raster import rasterize
from meshreg.raster.mesh import draw_mesh
from meshreg.raster.placing import place
from meshreg.raster.spacing import Spacing
from meshreg.records import Grid, Mesh, Survey, Transform
from meshreg.settings import RasterSettings

DEM = Path(__file__).parents[1] / "data" / "reef_dem" / "horseshoe_crop.tif"
SHIFTS = [(0.5, 0.5), (0.25, 0.0), (0.0, 0.33), (0.37, 0.71), (0.05, 0.95), (0.62, 0.18)]
CELL = 0.10


@pytest.fixture(scope="module")
def reef():
    """3.2 m × 3.2 m of Horseshoe Reef at 1 cm as a mesh."""
    import rasterio

    with rasterio.open(DEM) as file:
        height = file.read(1).astype(float)
    rows, cols = height.shape
    north, east = np.meshgrid(0.01 * np.arange(rows)[::-1], 0.01 * np.arange(cols), indexing="ij")
    vertices = np.stack([east, north, height], axis=-1).reshape(-1, 3)
    return Survey("reef", Mesh(vertices, grid_faces(rows, cols)))


def shift_between(reference, moving):
    """Least-squares shift (rows, columns) of two DEMs near each other, in cells; inner cells.

    Gauss-Newton on the mean of both, resampled by a cubic spline: independent of the package.
    """
    from scipy.ndimage import shift as spline_shift

    inner = (slice(3, -3), slice(3, -3))
    found = np.zeros(2)
    for _ in range(10):
        laid = spline_shift(moving, found, order=3, mode="nearest")
        rows, cols = np.gradient(0.5 * (laid + reference))
        design = np.stack([rows[inner].ravel(), cols[inner].ravel(), np.ones(rows[inner].size)], 1)
        step = np.linalg.lstsq(design, (laid - reference)[inner].ravel(), rcond=None)[0]
        found += step[:2]
    return found


def worst_error(reef, heights):
    """Largest error of the recovered shift [cells] over `SHIFTS`."""
    grid = Grid(0.1, 3.1, CELL, (30, 30))
    reference, worst = heights(reef, grid, None), 0.0
    for east, north in SHIFTS:
        move = Transform(offset=np.array([east * CELL, north * CELL, 0.0]))
        found = shift_between(reference, heights(reef, grid, move))
        worst = max(worst, np.abs(found - [north, -east]).max())  # rows go south
    return worst


def test_area_means_keep_two_hundredths_of_a_cell(reef):
    plain = RasterSettings(remove_floaters=False)

    def averaged(survey, grid, move):
        raster = rasterize(survey, grid, plain, transform=move)
        assert raster.samples.min() >= 100  # at the mesh's spacing
        return raster.height.astype(float)

    def point_sampled(survey, grid, move):
        placing = place(survey, grid, move, np.zeros(1))
        layers = draw_mesh(survey.geometry, placing, grid, Spacing(1.0, None), plain, times=1)
        return layers.height.astype(float)

    error = worst_error(reef, averaged)
    assert error <= 0.02
    assert worst_error(reef, point_sampled) > 2 * error  # one ray a cell, for comparison
