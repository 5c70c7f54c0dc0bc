"""Ready DEMs and orthomosaics onto another grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_raster import maps_raster

from meshreg.errors import UsageError
from meshreg.raster import rasterize
from meshreg.records import Grid, Maps, Survey, Transform
from meshreg.settings import RasterSettings

PLAIN = RasterSettings(fill_cells=0)


def maps_of(shape=(24, 30), cell=0.5, seed=0, empty=0.1, color_cell=0.25):
    rng = np.random.default_rng(seed)
    height = rng.normal(size=shape).astype(np.float32)
    height[rng.random(shape) < empty] = np.nan
    times = round(cell / color_cell)
    fine = (shape[0] * times, shape[1] * times)
    color = rng.integers(0, 256, (*fine, 3))
    seen = rng.random(fine) > empty
    grid, color_grid = Grid(100.0, 50.0, cell, shape), Grid(100.0, 50.0, color_cell, fine)
    return Survey("maps", Maps(height, grid, color, seen, color_grid))


def absolute(raster):
    return raster.height.astype(np.float64) + raster.datum


def turned(angle, scale=1.0, offset=(0.0, 0.0, 0.0), pivot=(107.0, 44.0, 0.0)):
    rotation = np.eye(3)
    rotation[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return Transform(rotation, scale, np.array(offset), np.array(pivot))


def test_on_its_own_grid_every_value_stays_as_it_was():
    survey = maps_of()
    maps = survey.geometry
    raster = rasterize(survey, maps.height_grid, PLAIN)
    np.testing.assert_allclose(raster.height, maps.height, rtol=0, atol=0)
    raster = rasterize(survey, maps.color_grid, PLAIN)
    np.testing.assert_array_equal(raster.color_valid & ~maps.color_valid, False)
    keep = raster.color_valid
    np.testing.assert_array_equal(raster.color[keep], maps.color[keep])


def test_whole_cell_shifts_are_exact_and_go_the_right_way():
    survey = maps_of(empty=0.0)
    height = survey.geometry.height
    raster = rasterize(survey, Grid(101.0, 49.5, 0.5, (20, 20)), PLAIN)
    np.testing.assert_array_equal(raster.height, height[1:21, 2:22])
    move = Transform(offset=np.array([1.5, -2.0, 0.25]))
    raster = rasterize(survey, Grid(101.5, 48.0, 0.5, (20, 20)), PLAIN, transform=move)
    np.testing.assert_allclose(raster.height, height[:20, :20] + 0.25, atol=1e-6)


def test_a_coarser_grid_takes_exact_area_means():
    survey = maps_of(empty=0.0)
    height = survey.geometry.height.astype(float)
    raster = rasterize(survey, Grid(100.0, 50.0, 1.5, (8, 10)), PLAIN)
    truth = height.reshape(8, 3, 10, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(absolute(raster), truth, atol=1e-6)
    # Shifted by a third of a source cell the mean weighs the cells cut by the share of area.
    raster = rasterize(survey, Grid(100.0 + 0.5 / 3, 50.0, 1.5, (8, 9)), PLAIN)
    fine = np.repeat(np.repeat(height, 3, axis=0), 3, axis=1)  # ninths of a source cell
    truth = fine[:, 1 : 1 + 81].reshape(8, 9, 9, 9).mean(axis=(1, 3))
    np.testing.assert_allclose(absolute(raster), truth, atol=1e-6)


@given(
    seed=st.integers(0, 99),
    angle=st.sampled_from([0.0, 0.01, -0.3, 2.0]),
    cell=st.sampled_from([0.25, 0.5, 0.7, 1.3]),
    scale=st.sampled_from([1.0, 0.8]),
)
@settings(max_examples=20, deadline=None)
def test_the_kernels_agree_with_their_twin(seed, angle, cell, scale):
    survey = maps_of(seed=seed)
    maps = survey.geometry
    move = turned(angle, scale, (0.123, -0.456, 0.0))
    grid = Grid(101.03, 48.02, cell, (12, 14))
    raster = rasterize(survey, grid, PLAIN, transform=move)
    times = max(1, int(np.ceil(cell / (0.5 * scale) - 1e-6)))
    height = maps_raster(
        maps.height.astype(float), np.isfinite(maps.height), maps.height_grid, grid, move, times
    )
    np.testing.assert_allclose(absolute(raster), height * scale, atol=2e-6)
    times = max(1, int(np.ceil(cell / (0.25 * scale) - 1e-6)))
    color = maps_raster(
        maps.color.astype(float), maps.color_valid, maps.color_grid, grid, move, times
    )
    seen = np.isfinite(color[..., 0]) & raster.valid
    np.testing.assert_array_equal(raster.color_valid, seen)
    assert np.abs(raster.color - color)[seen].max(initial=0) <= 0.501


def test_missing_cells_spread_no_further_than_themselves():
    height = np.ones((9, 9), np.float32)
    height[4, 4] = np.nan
    survey = Survey("m", Maps(height, Grid(0, 9, 1.0, (9, 9))))
    for shift in (0.0, 0.2, 0.49):
        raster = rasterize(survey, Grid(shift, 9 - shift, 1.0, (8, 8)), PLAIN)
        assert (~raster.valid).sum() <= 1
        assert (absolute(raster)[raster.valid] == 1.0).all()
    raster = rasterize(survey, Grid(0, 9, 3.0, (3, 3)), PLAIN)
    assert raster.valid.all()


def test_colors_are_kept_only_over_heights():
    survey = maps_of(empty=0.2)
    raster = rasterize(survey, survey.geometry.color_grid, PLAIN)
    assert not (raster.color_valid & ~raster.valid).any()


def test_nothing_lies_beyond_the_map():
    survey = maps_of(empty=0.0)
    raster = rasterize(survey, Grid(95.0, 55.0, 0.5, (50, 60)), PLAIN)
    inside = np.zeros((50, 60), bool)
    inside[10:34, 10:40] = True
    np.testing.assert_array_equal(raster.valid, inside)
    raster = rasterize(survey)
    assert raster.grid.bounds == pytest.approx((100.0, 38.0, 115.0, 50.0))


def test_maps_cannot_be_tilted():
    tilt = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    with pytest.raises(UsageError, match="cannot be tilted"):
        rasterize(maps_of(), Grid(100, 50, 1, (4, 4)), transform=Transform(tilt))


def test_a_map_without_colors_is_a_map():
    survey = Survey("m", Maps(np.ones((4, 4)), Grid(0, 4, 1.0, (4, 4))))
    raster = rasterize(survey)
    assert raster.valid.all()
    assert not raster.color_valid.any()
