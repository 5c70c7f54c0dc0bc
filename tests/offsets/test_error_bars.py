"""The methods' error bars: on surveys that are warped inside they hold what they promise."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import seafloor
from scipy.stats import chi2

from meshreg.offsets import ESTIMATORS, error_bars, estimate_offset
from meshreg.records import Grid
from meshreg.settings import Settings
from meshreg.statistics.kriging import Ground

SEEDS = {"sift": range(8), "terrain": range(20), "mutual_information": range(20)}
STRONG = 0.12  # m
HALF = 6.0
LEVEL = chi2.ppf(0.95, 2)


def warp(seed, amplitude):
    """Smooth displacement [m] with waves of 9 to 20 m, of its own for each seed."""
    rng = np.random.default_rng(seed)
    length, turn = rng.uniform(9, 20, 4), rng.uniform(0, 2 * np.pi, (2, 4))

    def field(east, north):
        along = np.cos(turn[0]) * east[..., None] + np.sin(turn[0]) * north[..., None]
        waves = amplitude * np.sin(2 * np.pi * along / length + turn[1])
        return waves[..., :2].sum(axis=-1), waves[..., 2:].sum(axis=-1)

    return field


@functools.cache
def pair(seed, amplitude):
    """Both floors, and the true offset: of the best rigid fit, at its centroid."""
    offset = np.random.default_rng(seed + 500).uniform(-0.8, 0.8, 2)
    field = warp(seed, amplitude)
    floor = seafloor.Seafloor.random(seed, size=15.0)
    later = floor.changed(seed + 1, 0.2)
    e, n = later.east - offset[0], later.north - offset[1]
    for _ in range(20):
        d = field(e, n)
        e, n = later.east - offset[0] - d[0], later.north - offset[1] - d[1]
    later = dataclasses.replace(later, east=e, north=n)
    east, north = np.meshgrid(*[np.linspace(-HALF, HALF, 97)] * 2)
    d = field(east, north)
    there = np.maximum(abs(east + offset[0] + d[0]), abs(north + offset[1] + d[1])) < HALF
    # the mean displacement is the best rigid fit's offset at the centroid, whatever its turn
    return floor, later, offset + np.array([d[0][there].mean(), d[1][there].mean()])


@functools.cache
def outcome(method, amplitude):
    """Errors (N, 2) and sigmas (N, 2, 2) [m] over the seeds."""
    errors, sigmas = [], []
    cell = 0.05 if method == "sift" else 0.1
    settings = Settings().changed({"search.radius": 3.0})
    for seed in SEEDS[method]:
        floor, later, true = pair(seed, amplitude)
        first = floor.raster(cell, HALF, seed=seed + 2)
        second = later.raster(cell, HALF, seed=seed + 3, gain=0.8)
        found = estimate_offset(first, second, method, settings)
        assert found.status == "ok", found.reason
        errors.append([found.east - true[0], found.north - true[1]])
        sigmas.append(found.sigma)
    return np.array(errors), np.array(sigmas)


@pytest.mark.parametrize("method", tuple(ESTIMATORS))
def test_the_region_covers_the_truth_of_warped_surveys(method):
    errors, sigmas = outcome(method, STRONG)
    away = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(sigmas), errors)
    assert np.mean(away <= LEVEL) >= 0.85
    # and it does so without being wide: typical sigma and error are of a size
    sizes = np.sqrt(np.trace(sigmas, axis1=1, axis2=2))
    ratio = np.median(sizes) / np.median(np.hypot(*errors.T))
    assert 0.7 < ratio < 2.0


@pytest.mark.parametrize("method", tuple(ESTIMATORS))
def test_rigid_surveys_keep_a_small_sigma(method):
    errors, sigmas = outcome(method, 0.0)
    size, warped = (
        float(np.median(np.sqrt(np.trace(outcome(method, a)[1], axis1=1, axis2=2))))
        for a in (0.0, STRONG)
    )
    assert size < 0.02
    assert size < 0.75 * warped
    assert 0.7 < size / np.median(np.hypot(*errors.T)) < 2.0
    away = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(sigmas), errors)
    assert np.mean(away <= LEVEL) >= 0.85


def test_block_scores_equal_brute_force():
    rng = np.random.default_rng(0)
    around, block = rng.normal(size=(3, 17, 17)), rng.normal(size=(3, 9, 9))
    found = error_bars.block_scores(around, block)
    assert found.shape == (3, 9, 9)
    for b in range(3):
        for i in range(9):
            for j in range(9):
                direct = sum(
                    around[b, i + r, j + c] * block[b, r, c] for r in range(9) for c in range(9)
                )
                assert found[b, i, j] == pytest.approx(direct, abs=1e-10)


@pytest.mark.parametrize("whole", [(0.0, 0.0), (0.4, -0.3), (-0.7, 0.9)])
def test_blocks_of_a_shifted_field_give_the_shift_at_their_places(whole):
    """Whatever whole-cell offset the blocks are asked round, they answer the same offset."""
    rng = np.random.default_rng(1)
    cell, true = 0.1, np.array([0.2, -0.1])
    field = rng.normal(size=(90, 80))
    # moving cell (r, c) shows what the reference shows at (r - 1 - 3, c + 2 + 5)
    grids = Grid(0.0, 0.0, cell, (90, 80)), Grid(0.5, 0.3, cell, (70, 60))
    row, col = np.indices((70, 60))
    r, c = grids[0].row_col(
        *(t + s for t, s in zip(grids[1].east_north(row, col), true, strict=True))
    )
    r, c = np.rint(r).astype(int), np.rint(c).astype(int)
    inside = (r >= 0) & (r < 90) & (c >= 0) & (c < 80)
    second = np.where(inside, field[np.clip(r, 0, 89), np.clip(c, 0, 79)], 0.0)
    masks = np.ones((90, 80), bool), inside
    near = tuple(true + np.clip(np.array(whole), -0.3, 0.3))
    near = tuple(np.round(np.array(near) / cell) * cell)
    blocks = error_bars.correlated_blocks([(field, second)], masks, grids, near, near)
    assert np.isfinite(blocks.offsets).all(axis=1).mean() > 0.9
    np.testing.assert_allclose(np.nanmedian(blocks.offsets, axis=0), true, atol=0.02)
    east, north = grids[1].east_north(*(np.array([[0, 0], [69, 59]]).T))
    assert (blocks.places[:, 0] > east[0]).all()
    assert (blocks.places[:, 1] < north[0]).all()


def test_own_offsets_find_a_hill_and_refuse_the_rest():
    steps = np.arange(-5, 6)
    true = np.array([[1.3, -2.2], [-0.4, 0.9]])
    hills = [
        np.exp(-0.5 * ((steps - e) ** 2 + (-steps[:, None] - n) ** 2) / 1.5**2) for e, n in true
    ]
    slope = steps[:, None] + 0.0 * steps  # highest on the edge
    twins = np.exp(-((steps - 4) ** 2 + steps[:, None] ** 2) / 2.0)
    found = error_bars.own_offsets(np.array([*hills, slope, twins + twins[:, ::-1], 0 * twins]))
    np.testing.assert_allclose(found[:2], true, atol=0.03)
    assert np.isnan(found[2:]).all()


@pytest.mark.parametrize("count", [6, 12, 60])
def test_the_sandwich_of_few_blocks_covers(count):
    """The mean of a few blocks, each with its own offset, lies in the 95 % region that often."""
    rng = np.random.default_rng(count)
    spread = np.linalg.cholesky([[4e-4, 1e-4], [1e-4, 1e-4]])
    hits = []
    for _ in range(1500):
        own = rng.normal(size=(count, 2)) @ spread.T
        mean = own.mean(axis=0)
        covariance = error_bars.few_blocks(own - mean, -count * np.eye(2))
        hits.append(mean @ np.linalg.solve(covariance, mean) <= LEVEL)
    assert 0.93 < np.mean(hits) < 0.975


def test_too_few_blocks_leave_the_sandwich_or_nothing():
    rng = np.random.default_rng(4)
    places = rng.uniform(0, 10, (5, 2))
    ground = Ground(places, np.full(5, 0.2))
    slopes = rng.normal(0, 0.1, (5, 2))
    nothing = np.full((5, 2), np.nan)
    blocks = error_bars.Blocks(places, nothing, slopes, -5 * np.eye(2))
    found = error_bars.error_bar((0.0, 0.0), blocks, ground, 0.01)
    np.testing.assert_allclose(
        found, error_bars.few_blocks(slopes, -5 * np.eye(2)) + 0.01**2 * np.eye(2)
    )
    saddle = dataclasses.replace(blocks, curvature=np.diag([-1.0, 1.0]))
    assert error_bars.error_bar((0.0, 0.0), saddle, ground, 0.01) is None
