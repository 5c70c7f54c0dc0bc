"""What every method owes, picked up from the table: a new method is tested by being listed."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import seafloor

from meshreg.errors import UsageError
from meshreg.offsets import ESTIMATORS, estimate_offset
from meshreg.offsets import sift as sift_module
from meshreg.records import SurveyRaster
from meshreg.settings import Settings, SiftSettings

OFFSET = (1.237, -2.412)
METHODS = tuple(ESTIMATORS)


def small(preset="robust"):
    return Settings.from_preset(preset).changed({"search.radius": 4.0})


@functools.cache
def pairs(change=0.25, yaw=0.0, seed=7):
    made = seafloor.rasters(seed, OFFSET, yaw=yaw, change=change, half=7.0, size=20.0)
    return made | {"sift": made["ortho"]}


def pair(method, **kind):
    return pairs(**kind)[ESTIMATORS[method].raster]


@pytest.mark.parametrize("method", METHODS)
def test_zero_on_a_copy(method):
    reference, _ = pair(method)
    estimate = estimate_offset(reference, reference, method, small())
    assert estimate.status == "ok", estimate.reason
    assert np.hypot(estimate.east, estimate.north) < 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_known_shift_after_change(method):
    reference, moving = pair(method)
    estimate = estimate_offset(reference, moving, method, small())
    assert estimate.status == "ok", estimate.reason
    error = np.array([estimate.east - OFFSET[0], estimate.north - OFFSET[1]])
    assert np.abs(error).max() < 0.05
    # the stated sigma is neither boastful nor empty
    away = error @ np.linalg.solve(estimate.sigma, error)
    assert away < 5**2
    assert np.sqrt(np.linalg.eigvalsh(estimate.sigma).max()) < 0.08


@pytest.mark.parametrize("method", METHODS)
def test_swapped_pair_gives_the_inverse(method):
    reference, moving = pair(method)
    there = estimate_offset(reference, moving, method, small())
    back = estimate_offset(moving, reference, method, small())
    slack = 1e-6 if ESTIMATORS[method].raster != "sift" else 0.02  # nearest neighbours are one-way
    if method == "mutual_information":
        slack = 0.01  # the level sets are cut on each image's own quantiles
    assert there.east == pytest.approx(-back.east, abs=slack)
    assert there.north == pytest.approx(-back.north, abs=slack)


@pytest.mark.parametrize("method", METHODS)
def test_values_under_the_mask_change_nothing(method):
    reference, moving = pair(method)
    rng = np.random.default_rng(0)
    hole = np.zeros(moving.grid.shape, bool)
    hole[20:60, 30:90] = True
    answers = []
    for fill in (0, 200):
        color, height = moving.color.copy(), moving.height.copy()
        color[hole] = rng.integers(0, 256, (hole.sum(), 3)) if fill else 0
        height[hole] = np.nan
        masked = dataclasses.replace(
            moving, color=color, height=height, valid=~hole, color_valid=~hole
        )
        answers.append(estimate_offset(reference, masked, method, small()))
    assert (answers[0].east, answers[0].north) == (answers[1].east, answers[1].north)


@pytest.mark.parametrize("preset", ["robust", "paper"])
@pytest.mark.parametrize("method", METHODS)
def test_same_seed_same_answer(method, preset):
    reference, moving = pair(method)
    quick = small(preset).changed({"search.radius": 2.6})
    first, second = (estimate_offset(reference, moving, method, quick) for _ in range(2))
    np.testing.assert_array_equal(
        [first.east, first.north, first.score], [second.east, second.north, second.score]
    )


@pytest.mark.parametrize("preset", ["robust", "paper"])
@pytest.mark.parametrize("method", METHODS)
def test_blank_and_flat_fail_with_a_reason(method, preset):
    reference, _ = pair(method)
    flat = dataclasses.replace(
        reference,
        height=np.full(reference.grid.shape, -7.0),
        color=np.full((*reference.grid.shape, 3), 90, np.uint8),
    )
    estimate = estimate_offset(flat, flat, method, small(preset))
    assert estimate.status == "failed"
    assert estimate.reason
    assert np.isnan(estimate.east)


@pytest.mark.parametrize("method", METHODS)
def test_empty_fails_with_a_reason(method):
    reference, _ = pair(method)
    nothing = np.zeros(reference.grid.shape, bool)
    empty = dataclasses.replace(
        reference,
        height=np.full(reference.grid.shape, np.nan),
        valid=nothing,
        color_valid=nothing,
    )
    for args in ((reference, empty), (empty, reference), (empty, empty)):
        estimate = estimate_offset(*args, method, small())
        assert estimate.status == "failed"
        assert "survey" in estimate.reason or "DEM" in estimate.reason


@pytest.mark.parametrize("method", METHODS)
def test_surveys_far_apart_fail_with_a_reason(method):
    reference, moving = pair(method)
    grid = dataclasses.replace(moving.grid, west=moving.grid.west + 4e6)
    estimate = estimate_offset(reference, dataclasses.replace(moving, grid=grid), method, small())
    assert estimate.status == "failed"
    assert "overlap" in estimate.reason or "matches" in estimate.reason


@pytest.mark.parametrize("method", ["terrain", "mutual_information"])
def test_an_optimum_on_the_border_is_said_with_the_remedy(method):
    reference, moving = pair(method)
    short = small().changed({"search.radius": 2.4})
    estimate = estimate_offset(reference, moving, method, short)
    assert estimate.status == "failed"
    assert "search border" in estimate.reason
    assert "--search-radius" in estimate.reason


@pytest.mark.parametrize("method", METHODS)
def test_half_a_degree_of_yaw_does_not_matter(method):
    reference, moving = pair(method, yaw=np.deg2rad(0.5))
    estimate = estimate_offset(reference, moving, method, small())
    assert estimate.status == "ok", estimate.reason
    # yaw is about the origin; the overlap's centre is 1.4 m from it: 1.2 cm
    assert np.hypot(estimate.east - OFFSET[0], estimate.north - OFFSET[1]) < 0.07


def test_paper_terrain_finds_the_known_shift():
    reference, moving = pair("terrain")
    estimate = estimate_offset(reference, moving, "terrain", small("paper"))
    assert estimate.status != "failed"
    # raw heights after change: the paper's own accuracy is 0.1 to 0.2 m (Fig. 2)
    assert np.hypot(estimate.east - OFFSET[0], estimate.north - OFFSET[1]) < 0.25


def test_papers_number_of_draws():
    """k = log(1 - 0.99) / log(1 - 0.5^10): 4,714 draws."""
    assert sift_module.draws(SiftSettings()) == 4714


def test_ransac_on_made_matches():
    """Ten clean pairs are drawn often at 72 % inliers; the mean then lies at the truth."""
    rng = np.random.default_rng(1)
    clean = rng.normal((2.0, -1.0), 0.05, (360, 2))
    wild = rng.uniform(-5, 5, (140, 2))
    offsets = np.concatenate([clean, wild])
    found = sift_module.ransac(offsets, SiftSettings(), np.random.default_rng(0))
    assert np.hypot(found.east - 2.0, found.north + 1.0) < 0.02
    assert 350 <= found.inliers.sum() <= 375
    assert found.inliers[:360].sum() >= 345


def test_vote_finds_what_ransac_cannot():
    """At 4 % inliers no draw of ten is clean; every match voting still finds the cluster."""
    rng = np.random.default_rng(2)
    clean = rng.normal((2.0, -1.0), 0.05, (40, 2))
    wild = rng.uniform(-5, 5, (960, 2))
    found = sift_module.vote(np.concatenate([clean, wild]), 0.2, 5.0)
    assert np.hypot(found.east - 2.0, found.north + 1.0) < 0.04
    assert found.false_alarms < 1e-6


def test_unrelated_matches_are_chance():
    """The expected number of false alarms means what it says, over many unrelated sets."""
    rng = np.random.default_rng(3)
    alarms = []
    for _ in range(100):
        found = sift_module.vote(rng.uniform(-5, 5, (300, 2)), 0.2, 5.0)
        alarms.append(found.false_alarms)
    assert np.mean(np.array(alarms) < 0.1) < 0.2
    assert min(alarms) > 1e-4


def test_large_images_are_worked_in_tiles():
    """Tiles change neither how many features there are nor where they lie."""
    reference, _ = pair("sift")
    whole = sift_module.features(reference, SiftSettings(), equalise=True)[0]
    tiled = sift_module.features(reference, SiftSettings(tile=128), equalise=True)[0]
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(tiled).query(whole)
    assert np.mean(distance < 0.01) > 0.9
    assert abs(len(whole) - len(tiled)) < 0.1 * len(whole)


def test_unknown_method_is_named():
    reference, moving = pair("terrain")
    with pytest.raises(UsageError, match=r"'magic'.*sift, terrain, mutual_information"):
        estimate_offset(reference, moving, "magic")


def test_records_stay_read_only():
    reference, _ = pair("terrain")
    assert isinstance(reference, SurveyRaster)
    with pytest.raises(ValueError, match="read-only"):
        reference.height[0, 0] = 1.0
