"""Clouds: the mean of each cell's top layer."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_raster import cloud_raster, moved
from scipy.ndimage import binary_dilation

from meshreg.raster import cloud as module
from meshreg.raster import rasterize
from meshreg.records import Grid, PointCloud, Survey, Transform
from meshreg.settings import RasterSettings

PLAIN = RasterSettings(fill_cells=0, remove_floaters=False)


def scatter(count=20_000, size=10.0, seed=0, height=lambda x, y: 0.3 * x, colors=True):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, size, (2, count))
    paint = rng.integers(0, 256, (count, 3)) if colors else None
    return Survey("cloud", PointCloud(np.column_stack([x, y, height(x, y) + 0 * x]), paint))


def absolute(raster):
    return raster.height.astype(np.float64) + raster.datum


@given(st.integers(0, 1000), st.sampled_from([0.1, 0.37, 2.0]))
@settings(max_examples=25, deadline=None)
def test_the_kernel_agrees_with_its_twin(seed, cell):
    survey = scatter(
        600, 3.0, seed, lambda x, y: np.sin(9 * x) + np.random.default_rng(seed).normal(size=len(x))
    )
    survey = moved(survey, (100.0, -7.0, 30.0))
    grid = Grid(99.9, -4.2, cell, (int(3.3 / cell) + 1, int(2.8 / cell) + 1))
    raster = rasterize(survey, grid, PLAIN)
    height, count, color = cloud_raster(survey, grid, 2 * cell)
    # a point just at the top layer's lower end is in or out by the last digit of a float32 height
    alike = raster.samples == count
    assert (~alike).sum() <= 1
    assert np.abs(raster.samples - count).max() <= 1
    # and what its cell's height is by then tilts its neighbours', four times over
    far = ~binary_dilation(~alike, iterations=4)
    np.testing.assert_allclose(absolute(raster)[far], height[far], atol=1e-4)
    np.testing.assert_array_equal(raster.color_valid, raster.valid)
    assert np.abs(raster.color - color).max() <= 0.501


def test_one_point_makes_a_cell_and_none_leaves_it_empty():
    points = np.array([[0.5, 0.5, 2.0], [2.5, 0.5, 3.0], [2.6, 1.5, 4.0]])
    raster = rasterize(Survey("c", PointCloud(points)), Grid(0, 2, 1, (2, 3)), PLAIN)
    assert raster.valid.tolist() == [[False, False, True], [True, False, True]]
    np.testing.assert_array_equal(raster.samples, [[0, 0, 1], [1, 0, 1]])
    assert not raster.color_valid.any()


def test_what_lies_under_the_top_layer_is_left_out():
    points = np.array([[0.5, 0.5, z] for z in (0.0, 1.0, 4.1, 5.0, 6.0)])
    points = np.concatenate([points, [[1.5, 1.5, 0], [1.2, 1.8, 0]]])
    raster = rasterize(Survey("c", PointCloud(points)), Grid(0, 2, 1, (2, 2)), PLAIN)
    assert absolute(raster)[1, 0] == pytest.approx((4.1 + 5 + 6) / 3, abs=1e-6)


def test_points_to_one_side_of_their_cells_do_not_tilt_or_shift_the_surface():
    """A plane comes out as a plane at the cells' centres, however the points lie in the cells."""
    rng = np.random.default_rng(3)
    for place in (
        rng.uniform(0, 8, (4000, 2)),
        np.stack(np.meshgrid(*2 * [np.arange(0.01, 8, 0.3)]), -1),
    ):
        x, y = place.reshape(-1, 2).T
        cloud = PointCloud(np.column_stack([x, y, 0.7 * x - 0.4 * y]))
        raster = rasterize(Survey("c", cloud), Grid(0, 8, 0.4, (20, 20)), PLAIN)
        east, north = raster.grid.east_north(*np.indices((20, 20)))
        error = (absolute(raster) - (0.7 * east - 0.4 * north))[raster.valid]
        assert np.abs(error).max() < 0.01 * 0.4 * 0.7  # a hundredth of what a cell's side rises


def test_points_on_the_outer_edge_belong_to_the_last_cells():
    points = np.array([[0, 0, 4], [2, 2, 4], [0, 2, 4], [2, 0, 4.0]])
    raster = rasterize(Survey("c", PointCloud(points)), Grid(0, 2, 1, (2, 2)), PLAIN)
    np.testing.assert_allclose(absolute(raster), 4.0, atol=1e-6)
    np.testing.assert_array_equal(raster.samples, 1)
    raster = rasterize(Survey("c", PointCloud(points)), Grid(0, 2, 1, (2, 2)), PLAIN,
                       transform=Transform(offset=np.array([0.001, 0, 0])))  # fmt: skip
    assert raster.valid.sum() == 2


def test_points_that_are_not_finite_are_left_out_and_counted():
    survey = scatter(1000)
    points = survey.geometry.points.copy()
    points[::100, 2] = np.nan
    points[1::100, 0] = np.inf
    raster = rasterize(Survey("c", PointCloud(points)), Grid(0, 10, 1, (10, 10)), PLAIN)
    assert raster.masked["not finite"] == 20
    assert raster.samples.sum() == 980
    assert np.isfinite(absolute(raster)[raster.valid]).all()


def test_the_order_of_points_and_the_threads_change_nothing(monkeypatch):
    import numba

    survey = scatter(50_000)
    grid = Grid(0, 10, 0.1, (100, 100))
    one = rasterize(survey, grid)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        two = rasterize(survey, grid)
    finally:
        numba.set_num_threads(threads)
    monkeypatch.setattr(module, "_BLOCK_CELLS", 77)
    three = rasterize(survey, grid)
    for other in (two, three):
        np.testing.assert_array_equal(other.height, one.height)
        np.testing.assert_array_equal(other.color, one.color)
    order = np.random.default_rng(1).permutation(50_000)
    cloud = PointCloud(survey.geometry.points[order], survey.geometry.colors[order])
    four = rasterize(Survey("c", cloud), grid)
    np.testing.assert_allclose(four.height, one.height, atol=1e-6)
    np.testing.assert_array_equal(four.color, one.color)


def test_utm_and_whole_lattice_shifts_change_nothing():
    survey = scatter(5000)
    grid = Grid(0, 10, 0.25, (40, 40))
    near = rasterize(survey, grid, PLAIN)
    away = moved(survey, (731_000, 5_705_000, 0))
    far = rasterize(away, dataclasses.replace(grid, west=731_000, north=5_705_010), PLAIN)
    np.testing.assert_array_equal(near.height, far.height)
    np.testing.assert_array_equal(near.color, far.color)


def test_more_points_than_the_counter_holds_are_averaged_all_the_same():
    rng = np.random.default_rng(0)
    count = 200_000
    points = np.column_stack([rng.uniform(0, 1, (count, 2)), rng.uniform(-0.5, 0.5, count)])
    colors = rng.integers(0, 256, (count, 3))
    raster = rasterize(Survey("c", PointCloud(points, colors)), Grid(0, 1, 1, (1, 1)), PLAIN)
    assert raster.samples[0, 0] == 65535
    assert absolute(raster)[0, 0] == pytest.approx(points[:, 2].mean(), abs=2e-5)
    assert np.abs(raster.color[0, 0] - colors.mean(axis=0)).max() <= 0.6


def test_doubled_points_shift_weights_only_within_their_cell():
    survey = scatter(20_000, height=lambda x, y: 0.1 * x)
    points = survey.geometry.points
    doubled = Survey("c", PointCloud(np.concatenate([points, points[points[:, 0] < 5]])))
    grid = Grid(0, 10, 0.5, (20, 20))
    one, two = rasterize(survey, grid, PLAIN), rasterize(doubled, grid, PLAIN)
    np.testing.assert_allclose(one.height, two.height, atol=1e-6)
