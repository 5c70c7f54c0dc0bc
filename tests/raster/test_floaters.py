"""Fish go, coral stays."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from reference_raster import several, sheet

from meshreg.raster import rasterize
from meshreg.records import Grid, Mesh, PointCloud, Survey
from meshreg.settings import RasterSettings


def bed(size=8.0, step=0.05, seed=0):
    """Rough ground with a slope and bumps of 0.3 m."""
    return sheet(
        lambda x, y: 0.1 * x + 0.15 * np.sin(2.1 * x) * np.cos(1.7 * y), size, step, jitter=0.3,
        seed=seed,
    ).geometry  # fmt: skip


def ground_at(x, y):
    return 0.1 * x + 0.15 * np.sin(2.1 * x) * np.cos(1.7 * y)


def blob(x, y, z, size=(0.4, 0.15, 0.12), n=12):
    """A closed ellipsoid: a fish."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, n), np.linspace(0, 2 * np.pi, n))
    vertices = np.stack(
        [
            x + 0.5 * size[0] * np.sin(theta) * np.cos(phi),
            y + 0.5 * size[1] * np.sin(theta) * np.sin(phi),
            z + 0.5 * size[2] * np.cos(theta),
        ],
        axis=-1,
    ).reshape(-1, 3)
    from reference_raster import grid_faces

    return Mesh(vertices, grid_faces(n, n))


GRID = Grid(0.0, 8.0, 0.1, (80, 80))
KEEP = RasterSettings(remove_floaters=False)


def test_a_fish_half_a_metre_up_goes_and_is_counted():
    ground, fish = bed(), blob(4, 4, ground_at(4, 4) + 0.56)
    raster = rasterize(Survey("s", several(ground, fish)), GRID)
    alone = rasterize(Survey("s", ground), GRID)
    np.testing.assert_array_equal(raster.height, alone.height)
    assert raster.masked["floaters"] == len(fish.faces)
    assert "floaters" not in alone.masked
    kept = rasterize(Survey("s", several(ground, fish)), GRID, KEEP)
    assert np.nanmax(kept.height - alone.height) > 0.25


def test_a_school_of_fish_goes():
    fishes = [blob(x, y, ground_at(x, y) + 0.9) for x in (2, 2.5, 3) for y in (5, 5.3)]
    raster = rasterize(Survey("s", several(bed(), *fishes)), GRID)
    assert raster.masked["floaters"] == sum(len(fish.faces) for fish in fishes)


def branching(ground, x, y):
    """A branching colony that grows out of the ground: spikes on vertices of the sheet itself."""
    rng = np.random.default_rng(4)
    vertices = ground.vertices.copy()
    near = np.flatnonzero(np.hypot(vertices[:, 0] - x, vertices[:, 1] - y) < 0.5)
    tips = rng.choice(near, len(near) // 4, replace=False)
    vertices[tips, 2] += rng.uniform(0.3, 0.9, len(tips))
    return Mesh(vertices, ground.faces)


def test_a_branching_colony_stays():
    reef = branching(bed(), 4, 4)
    raster = rasterize(Survey("s", reef), GRID)
    assert raster.masked.get("floaters", 0) == 0
    np.testing.assert_array_equal(raster.height, rasterize(Survey("s", reef), GRID, KEEP).height)


def test_the_torn_tips_of_branches_stay():
    reef = branching(bed(), 4, 4)
    tips = [blob(4.1, 4.05, ground_at(4, 4) + 0.85, (0.05, 0.05, 0.08))]
    raster = rasterize(Survey("s", several(reef, *tips)), GRID)
    assert raster.masked.get("floaters", 0) == 0


def test_a_table_coral_torn_off_its_stem_stays():
    table = blob(4, 4, ground_at(4, 4) + 0.45, (1.2, 1.2, 0.05), n=30)
    raster = rasterize(Survey("s", several(bed(), table)), GRID)
    assert raster.masked.get("floaters", 0) == 0


def test_islands_and_pieces_below_stay():
    island = bed(1.0)
    island = Mesh(
        island.vertices + np.array([12.0, 0, 3.0]), island.faces
    )  # far from the rest, and higher
    below = blob(4, 4, ground_at(4, 4) - 1.0)
    raster = rasterize(Survey("s", several(bed(), island, below)), Grid(0, 8, 0.1, (80, 140)))
    assert raster.masked.get("floaters", 0) == 0
    assert raster.valid[:, 120:130].any()


def test_a_canopy_stays():
    """What covers much ground is no floater."""
    roof = sheet(lambda x, y: 3 + 0 * x, 3.0, 0.05).geometry
    raster = rasterize(Survey("s", several(bed(), roof)), GRID)
    assert raster.masked.get("floaters", 0) == 0


@pytest.mark.parametrize("with_fish", [False, True])
def test_meshes_cut_along_seams_are_joined_before_they_are_judged(with_fish):
    """Faces that share no vertices: only the fish may go."""
    mesh = several(bed(), blob(4, 4, ground_at(4, 4) + 0.7)) if with_fish else bed()
    soup = Mesh(
        mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    )
    raster = rasterize(Survey("s", soup), GRID)
    alone = rasterize(Survey("s", bed()), GRID)
    np.testing.assert_array_equal(raster.height, alone.height)


def test_floaters_are_judged_alike_in_other_units_of_the_grid():
    mesh = several(bed(), blob(4, 4, ground_at(4, 4) + 0.56))
    for cell in (0.05, 0.4, 1.0):
        count = round(8 / cell)
        raster = rasterize(Survey("s", mesh), Grid(0, 8, cell, (count, count)))
        assert raster.masked["floaters"] > 0


# -- clouds ---------------------------------------------------------------------------------------


def points_on_bed(spacing=0.03, size=8.0, seed=0):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, size, (2, round((size / spacing) ** 2)))
    return np.column_stack([x, y, ground_at(x, y) + rng.normal(0, 0.005, len(x))])


def points_on_blob(mesh, count, seed=1):
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    face = rng.choice(len(area), count, p=area / area.sum())
    w = rng.dirichlet([1, 1, 1], count)
    return (corners[face] * w[..., None]).sum(axis=1)


def test_a_fish_in_a_cloud_goes():
    ground = points_on_bed()
    fish = points_on_blob(blob(4, 4, ground_at(4, 4) + 0.56), 150)
    survey = Survey("s", PointCloud(np.concatenate([ground, fish])))
    raster = rasterize(survey, GRID)
    assert raster.masked["floaters"] == 150
    np.testing.assert_array_equal(
        raster.height, rasterize(Survey("s", PointCloud(ground)), GRID).height
    )


def test_a_steep_coral_head_in_a_cloud_stays():
    ground = points_on_bed()
    rng = np.random.default_rng(2)
    angle, up = rng.uniform(0, 2 * np.pi, 6000), rng.uniform(0, 1.2, 6000)
    wall = np.column_stack(
        [4 + 0.4 * np.cos(angle), 4 + 0.4 * np.sin(angle), ground_at(4, 4) - 0.1 + up]
    )
    r = 0.4 * np.sqrt(rng.uniform(0, 1, 2000))
    top = np.column_stack([4 + r * np.cos(angle[:2000]), 4 + r * np.sin(angle[:2000]),
                           np.full(2000, ground_at(4, 4) + 1.1)])  # fmt: skip
    survey = Survey("s", PointCloud(np.concatenate([ground, wall, top])))
    raster = rasterize(survey, GRID)
    assert raster.masked.get("floaters", 0) == 0
    assert np.nanmax(raster.height) > ground_at(4, 4) + 1.0


def test_trees_in_a_cloud_stay():
    ground = points_on_bed(0.1)
    rng = np.random.default_rng(3)
    trees = np.concatenate(
        [rng.normal([x, y, 4.0], 0.3, (200, 3)) for x in (1, 3, 5) for y in (2, 6)]
    )
    survey = Survey("s", PointCloud(np.concatenate([ground, trees])))
    raster = rasterize(survey, GRID)
    assert raster.masked.get("floaters", 0) == 0


def test_a_stray_point_far_away_costs_no_memory():
    ground = points_on_bed(0.1)
    survey = Survey("s", PointCloud(np.concatenate([ground, [[1e7, -3e6, 50.0]]])))
    raster = rasterize(survey, GRID)
    assert raster.valid.mean() > 0.6
    mesh = several(bed(), dataclasses.replace(blob(1e7, 0, 50.0)))
    assert rasterize(Survey("s", mesh), GRID).valid.all()
