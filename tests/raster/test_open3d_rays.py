"""Fine height samples against Open3D's ray casting, an independent program."""

from __future__ import annotations

import numpy as np
import pytest
from reference_raster import several, sheet

from meshreg.raster.mesh import draw_mesh
from meshreg.raster.placing import place
from meshreg.raster.spacing import Spacing
from meshreg.records import Grid, Survey
from meshreg.refine.open3d_loading import load_open3d
from meshreg.settings import RasterSettings

PLAIN = RasterSettings(fill_cells=0, remove_floaters=False)


def ray_heights(mesh, grid):
    """Height of the first hit of a ray straight down through each cell's centre."""
    open3d = load_open3d()
    scene = open3d.t.geometry.RaycastingScene()
    vertices = open3d.core.Tensor(mesh.vertices.astype(np.float32))
    scene.add_triangles(vertices, open3d.core.Tensor(mesh.faces.astype(np.uint32)))
    rows, cols = np.indices(grid.shape)
    east, north = grid.east_north(rows, cols)
    top = float(mesh.vertices[:, 2].max()) + 1.0
    rays = np.zeros((east.size, 6), np.float32)
    rays[:, 0], rays[:, 1], rays[:, 2], rays[:, 5] = east.ravel(), north.ravel(), top, -1.0
    distance = scene.cast_rays(open3d.core.Tensor(rays))["t_hit"].numpy()
    return np.where(np.isfinite(distance), top - distance, np.nan).reshape(grid.shape)


@pytest.mark.needs("open3d")
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_samples_equal_ray_hits(seed):
    rng = np.random.default_rng(seed)
    waves = rng.uniform(0.5, 4, (5, 2))

    def relief(x, y):
        return sum(np.sin(a * x + b * y) / (a + b) for a, b in waves)

    ground = sheet(relief, 6.0, 0.05, jitter=0.45, seed=seed).geometry
    roof = sheet(lambda x, y: 2.5 + 0.7 * x - 0.3 * y, 2.0, 0.11, jitter=0.4, seed=seed).geometry
    mesh = several(ground, roof)
    grid = Grid(-0.2037, 6.1911, 0.0203, (315, 315))
    survey = Survey("s", mesh)
    placing = place(survey, grid, None, np.zeros(1))
    layers = draw_mesh(mesh, placing, grid, Spacing(1.0, None), PLAIN, times=1)
    hits = ray_heights(mesh, grid)
    ours, theirs = np.isfinite(layers.height), np.isfinite(hits)
    assert (ours != theirs).mean() < 1e-4  # rays are float32: an outline may differ by a sample
    difference = np.abs(layers.height + placing.datum - hits)[ours & theirs]
    # At the roof's edge one may hit it and the other the ground; elsewhere they are equal.
    assert (difference > 1e-4).mean() < 1e-4
    assert np.median(difference) < 1e-6
