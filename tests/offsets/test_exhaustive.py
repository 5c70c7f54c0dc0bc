"""The exhaustive searches against their slow twins, cell by cell."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import reference_offsets as twin
from hypothesis import given, settings
from hypothesis import strategies as st

from meshreg.errors import UsageError
from meshreg.offsets import mutual_information, terrain
from meshreg.offsets.correlate import Correlator, Window
from meshreg.records import Grid, SurveyRaster


def raster(seed, shape=(17, 23), cell=0.1, west=0.0, north=0.0, datum=0.0, holes=0.15):
    rng = np.random.default_rng(seed)
    z = np.cumsum(rng.normal(0, 0.05, shape), axis=1) + 0.3 * rng.normal(size=shape)
    color = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    valid = rng.random(shape) > holes
    z = np.where(valid, z, np.nan)
    grid = Grid(west, north, cell, shape)
    return SurveyRaster(grid, z, color, valid, valid, valid.astype(np.uint16), datum=datum)


@pytest.mark.parametrize("datum", [0.0, -2000.0])
def test_terrain_cost_equals_brute_force(datum):
    a = raster(1, datum=datum)
    b = raster(2, (14, 19), west=0.3, north=-0.2, datum=datum + 0.04)
    window = Window.around(a.grid, b.grid, 0.8)
    cost, counts = terrain.cost_surface(a, b, window, 0.3)
    expected, expected_counts = twin.scan(
        a.height.astype(float) + a.datum,
        a.valid,
        b.height.astype(float) + b.datum,
        b.valid,
        window.rows,
        window.cols,
        0.3,
        twin.terrain_cost,
    )
    np.testing.assert_array_equal(counts, expected_counts)
    np.testing.assert_array_equal(np.isnan(cost), np.isnan(expected))
    np.testing.assert_allclose(cost, expected, rtol=1e-9)


def test_terrain_cost_is_correlation_plus_two_penalties():
    """c = s1/s2 + s2/s1 - 2 rho + (m1 - m2)²/(s1 s2), at the nominal offset."""
    a, b = raster(3, holes=0), raster(4, holes=0)
    window = Window.around(a.grid, b.grid, 0.1)
    cost, _ = terrain.cost_surface(a, b, window, 0.0)
    z1, z2 = a.height.astype(float), b.height.astype(float)
    s1, s2 = z1.std(), z2.std()
    rho = np.corrcoef(z1.ravel(), z2.ravel())[0, 1]
    expected = s1 / s2 + s2 / s1 - 2 * rho + (z1.mean() - z2.mean()) ** 2 / (s1 * s2)
    assert cost[1, 1] == pytest.approx(expected, rel=1e-10)


def test_high_pass_correlation_equals_brute_force():
    a, b = raster(5), raster(6, (15, 20), west=-0.2, north=0.1)
    window = Window.around(a.grid, b.grid, 0.6)
    surface, _ = terrain.correlation_surface(a, b, window, 0.3, (2.0,))
    z1, z2 = terrain.absolute_heights(a, b)
    expected, _ = twin.scan(
        terrain.high_pass(z1, a.valid, 2.0),
        a.valid,
        terrain.high_pass(z2, b.valid, 2.0),
        b.valid,
        window.rows,
        window.cols,
        0.3,
        twin.correlation,
    )
    np.testing.assert_allclose(surface, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("bins", [8, 16, 256])
def test_direct_information_equals_brute_force(bins):
    a, b = raster(7), raster(8, (16, 18), west=0.2, north=-0.1)
    window = Window.around(a.grid, b.grid, 0.4)
    first, second = (mutual_information.levels(r, bins, 0.0) for r in (a, b))
    masks = (a.color_valid, b.color_valid)
    surface, counts = mutual_information.direct_surface(first, second, masks, window, 0.3, bins)
    expected, expected_counts = twin.scan(
        first,
        masks[0],
        second,
        masks[1],
        window.rows,
        window.cols,
        0.3,
        lambda x, y: twin.mutual_information(x, y, bins),
    )
    np.testing.assert_array_equal(counts, expected_counts)
    np.testing.assert_allclose(surface, expected, rtol=1e-9, atol=1e-12)


def test_fft_information_equals_direct():
    a, b = raster(9, (40, 37)), raster(10, (35, 41), west=-0.4, north=0.3)
    window = Window.around(a.grid, b.grid, 0.9)
    first, second = (mutual_information.levels(r, 16, 0.5) for r in (a, b))
    masks = (a.color_valid, b.color_valid)
    direct, _ = mutual_information.direct_surface(first, second, masks, window, 0.3, 16)
    fast, _ = mutual_information.fft_surface(first, second, masks, window, 0.3, 16)
    np.testing.assert_allclose(fast, direct, rtol=1e-9, atol=1e-11)


def test_levels_of_the_paper_are_grey_values():
    a = raster(11, holes=0)
    grey = np.rint(a.color @ np.array([0.299, 0.587, 0.114]))
    np.testing.assert_array_equal(mutual_information.levels(a, 256, 0.0), grey)
    np.testing.assert_array_equal(mutual_information.levels(a, 32, 0.0), grey // 8)


def test_robust_levels_are_all_used_alike():
    counts = np.bincount(mutual_information.levels(raster(12, (60, 60), holes=0), 16, 0.5).ravel())
    assert len(counts) == 16
    assert counts.min() > 0.9 * 3600 / 16
    assert counts.max() < 1.1 * 3600 / 16


@settings(max_examples=30, deadline=None)
@given(
    shapes=st.tuples(*[st.tuples(st.integers(3, 12), st.integers(3, 12)) for _ in range(2)]),
    place=st.tuples(st.integers(-15, 15), st.integers(-15, 15)),
    reach=st.integers(1, 9),
    seed=st.integers(0, 99),
)
def test_sums_never_wrap_round(shapes, place, reach, seed):
    """Whatever the sizes and places, each offset's sum is the sum over its own overlap."""
    rng = np.random.default_rng(seed)
    first, second = (rng.normal(size=s) for s in shapes)
    a = Grid(0.0, 0.0, 1.0, shapes[0])
    b = Grid(float(place[0]), float(place[1]), 1.0, shapes[1])
    window = Window.around(a, b, reach)
    correlator = Correlator(window)
    sums = correlator.sums((correlator.transform(first), correlator.transform(second)))
    full = [np.ones(s, bool) for s in shapes]
    for i, row in enumerate(window.rows):
        for j, col in enumerate(window.cols):
            x, y = twin.overlap(first, full[0], second, full[1], row, col)
            assert sums[i, j] == pytest.approx(float(np.sum(x * y)), abs=1e-9)


def test_window_offsets_mean_metres_to_add():
    """A moving grid that starts 0.3 m east of the truth needs -0.3 m east."""
    a = Grid(0.0, 0.0, 0.1, (20, 20))
    window = Window.around(a, dataclasses.replace(a, west=0.3, north=-0.2), 0.5)
    # the shift that lays cell (0, 0) on cell (0, 0)
    assert window.east[list(window.cols).index(0)] == pytest.approx(-0.3)
    assert window.north[list(window.rows).index(0)] == pytest.approx(0.2)


def test_grids_off_the_lattice_are_refused():
    a = Grid(0.0, 0.0, 0.1, (20, 20))
    with pytest.raises(UsageError, match=r"0\.3000 columns"):
        Window.around(a, dataclasses.replace(a, west=0.03), 0.5)
    with pytest.raises(UsageError, match=r"cells differ: 0\.1 and 0\.2"):
        Window.around(a, dataclasses.replace(a, cell=0.2), 0.5)


@given(
    shapes=st.tuples(*[st.tuples(st.integers(3, 9), st.integers(3, 9))] * 2),
    place=st.tuples(st.integers(-40, 40), st.integers(-40, 40)),
    reach=st.integers(1, 50),
)
def test_a_window_holds_the_offsets_at_which_the_rasters_meet_and_no_others(shapes, place, reach):
    a = Grid(0.0, 0.0, 1.0, shapes[0])
    b = Grid(float(place[0]), float(place[1]), 1.0, shapes[1])
    window = Window.around(a, b, reach)
    for axis, (nominal, shifts) in enumerate(
        zip((-place[1], place[0]), (window.rows, window.cols), strict=True)
    ):
        cells = set(range(shapes[0][axis]))
        meet = [
            s
            for s in range(nominal - reach, nominal + reach + 1)
            if cells & set(range(s, s + shapes[1][axis]))
        ]
        assert list(shifts) == meet
    assert window.empty == (not (len(window.rows) and len(window.cols)))
    # the search costs what the rasters' own sizes ask, however far it goes
    assert max(window.padded) <= 2 * (sum(map(max, shapes)) + 2)
