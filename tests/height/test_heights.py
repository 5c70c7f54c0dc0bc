"""Height and tilt against planes, growth and bending that are known exactly."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import seafloor
from hypothesis import given
from hypothesis import strategies as st
from made_registration import made_registration
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

from meshreg import statistics
from meshreg.errors import UsageError
from meshreg.height.ground import SEEN, largest_sheet, neighbours
from meshreg.height.lifting import (
    CHANGED,
    MAX_TILT,
    SET_ASIDE,
    SHEET,
    STABLE,
    fit_heights,
    rotation,
    stable_ground,
)
from meshreg.records import Transform

HERE = Transform()


@functools.cache
def relief(seed=3, half=7.0, noise=0.002, noise_seed=0):
    floor = seafloor.Seafloor.random(seed, size=2 * half + 6)
    return floor.raster(0.1, half, noise=noise, seed=noise_seed)


def places(raster):
    row, col = np.indices(raster.grid.shape)
    return raster.grid.east_north(row, col)


def lowered(raster, by, valid=None):
    """The raster with `by` taken from its heights, so that `by` is to be added again."""
    height = raster.height.astype(float) - by
    if valid is None:
        return dataclasses.replace(raster, height=height)
    return dataclasses.replace(raster, height=np.where(valid, height, np.nan), valid=valid)


def plane(raster, up, tilt_east, tilt_north):
    east, north = places(raster)
    return up + tilt_east * (north - north.mean()) - tilt_north * (east - east.mean())


def patches(raster, share, seed, width=0.5):
    """Round patches over about `share` of the cells: colonies, nowhere a whole block wide."""
    rng = np.random.default_rng(seed)
    east, north = places(raster)
    grown = np.zeros(raster.grid.shape, bool)
    while grown.mean() < share:
        e, n = rng.uniform(east.min(), east.max()), rng.uniform(north.min(), north.max())
        grown |= np.hypot(east - e, north - n) < width * rng.uniform(0.5, 1.0)
    return grown


def test_a_raster_onto_itself_stays():
    found = fit_heights(relief(), relief(), HERE)
    assert abs(found.up) < 1e-9
    assert not found.tilt.any()
    assert found.kept > 0.99
    assert np.abs(found.covariance).max() < 1e-16


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("degrees", [0.1, 1.0])
def test_known_plane_is_recovered(degrees, sign):
    tilt = sign * np.deg2rad(degrees) * np.array([0.8, -0.6])
    other = relief(noise_seed=1)
    found = fit_heights(relief(), lowered(other, plane(other, sign * 0.37, *tilt)), HERE)
    # a tilt also moves relief sideways, which adding a plane does not
    np.testing.assert_allclose(
        np.rad2deg(found.tilt), np.rad2deg(tilt), atol=0.005 + 0.01 * degrees
    )
    assert found.up == pytest.approx(sign * 0.37, abs=0.001 + 0.001 * degrees)
    assert not found.doubt


def test_a_plane_within_the_noise_is_left_alone():
    other = relief(noise_seed=1)
    found = fit_heights(relief(), lowered(other, plane(other, 0.02, 2e-6, 1e-6)), HERE)
    assert not found.tilt.any()
    assert found.up == pytest.approx(0.02, abs=3e-4)


def test_a_tilt_beyond_three_degrees_is_doubted_and_not_applied():
    other = relief(noise_seed=1)
    found = fit_heights(relief(), lowered(other, plane(other, 0.0, np.deg2rad(5.0), 0.0)), HERE)
    assert "beyond 3°" in found.doubt
    assert not found.tilt.any()


@pytest.mark.parametrize("height", [0.08, -0.08])
def test_growth_on_one_side_does_not_pull(height):
    """A third of the ground, most of it in the west, grew (or broke off) by 8 cm."""
    other = relief(noise_seed=1)
    east, _ = places(other)
    grown = patches(other, 0.45, 7) & (east < east.mean() + 3)
    assert 0.2 < grown.mean() < 0.4
    found = fit_heights(relief(), lowered(other, np.where(grown, -height, 0.0)), HERE)
    assert abs(found.up) < 0.003  # the mean would say 24 mm
    assert np.abs(np.rad2deg(found.tilt)).max() < 0.03
    # what lies within the square over which detail is compared does not count either
    beside = uniform_filter(grown.astype(float), SEEN + 2) > 0
    assert grown.mean() - 0.05 < 1 - found.kept < beside.mean() + 0.05


def test_ground_that_changed_is_told_from_ground_that_did_not():
    """Colonies grew by 10 cm, and the whole of a square of 2.4 m was washed out by 30 cm."""
    other = relief(noise_seed=1)
    grown = patches(other, 0.08, 7, width=0.3)
    east, north = places(other)
    washed = (np.abs(east - 2.0) < 1.2) & (np.abs(north + 1.5) < 1.2)
    change = np.where(washed, 0.3, np.where(grown, -0.1, 0.0))
    found = fit_heights(relief(), lowered(other, change), HERE)
    assert found.ground.shape == other.grid.shape
    # blocks are 0.8 m wide: what reaches into one of them beside the square goes with it, and
    # detail is compared over 0.7 m
    near = (np.abs(east - 2.0) < 2.0) & (np.abs(north + 1.5) < 2.0)
    beside = uniform_filter(grown.astype(float), 2 * SEEN) > 0
    inner = (np.abs(east) < 6.5) & (np.abs(north) < 6.5)  # splines need neighbours
    stable = found.ground == STABLE
    assert (inner & ~near & ~beside).mean() > 0.05
    assert stable[inner & ~near & ~beside].mean() > 0.93
    assert stable[inner & grown & ~near].mean() < 0.05
    assert (found.ground[inner & grown & ~near] == CHANGED).mean() > 0.9
    assert stable[washed].mean() < 0.05
    within = (np.abs(east - 2.0) < 0.5) & (np.abs(north + 1.5) < 0.5) & ~beside
    assert (found.ground[within] == SET_ASIDE).mean() > 0.9


def test_laid_down_ground_keeps_its_place():
    other, yaw = relief(), np.deg2rad(4.0)
    east, north = places(other)
    ground = np.where((np.abs(east - 2.0) < 1.2) & (np.abs(north + 1.5) < 0.8), SET_ASIDE, STABLE)
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    move = Transform(turn, 1.0, [0.4, -0.3, 0.0])
    seen = np.abs(east) < 5.0
    target = dataclasses.replace(other, height=np.where(seen, other.height, np.nan), valid=seen)
    laid = stable_ground(ground.astype(np.uint8), other.grid, move, target)
    # every laid cell by hand: back where it came from
    e, n = east - 0.4, north + 0.3
    e, n = c * e + s * n, c * n - s * e
    from_east, from_north = np.abs(e - 2.0), np.abs(n + 1.5)
    assert (laid[seen & (from_east < 1.1) & (from_north < 0.7)] == SET_ASIDE).all()
    beyond = (from_east > 1.3) | (from_north > 0.9)
    inside = seen & (np.abs(e) < 6.9) & (np.abs(n) < 6.9)
    assert (laid[inside & beyond] == STABLE).all()
    assert not laid[~seen].any()
    assert not laid[seen & (np.abs(n) > 7.1)].any()


def test_slow_bending_is_averaged_over_all_ground():
    """The answer is the uniform least-squares fit, not the fit to where the models agree."""
    other = relief(noise_seed=1)
    east, north = places(other)
    x, y = east / np.abs(east).max(), north / np.abs(north).max()
    bowl = 0.06 * (x**2 + y**2) + 0.03 * x**3 - 0.04 * x * y
    design = np.stack([np.ones(x.size), north.ravel(), -east.ravel()], axis=1)
    best = np.linalg.lstsq(design, bowl.ravel(), rcond=None)[0]
    found = fit_heights(relief(), lowered(other, bowl), HERE)
    assert found.up == pytest.approx(best[0], abs=0.0015)
    np.testing.assert_allclose(np.rad2deg(found.tilt), np.rad2deg(best[1:]), atol=0.02)


def waves(raster, seed, length, size):
    """A smooth field of three waves of about this length [m], of about this size [m] (rms)."""
    rng = np.random.default_rng(seed)
    east, north = places(raster)
    total = np.zeros(east.shape)
    for _ in range(3):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        step = 2 * np.pi / (length * rng.uniform(0.8, 1.3))
        total += np.sin(step * (np.cos(angle) * east + np.sin(angle) * north) + phase)
    return size * total / total.std()


@pytest.mark.parametrize("rise", [0.06, -0.09])
def test_sand_that_rose_as_a_sheet_does_not_lift_the_survey(rise):
    """Two thirds of the ground are sand, level and with other ripples each time; rock tells up.

    Now and then an island of rock far from the others is mistaken, and the stated sigma says so.
    """
    rock, again = relief(), relief(noise_seed=1)
    found, stated = [], []
    for seed in range(5):
        level = waves(rock, seed, 9.0, 1.0)
        sand = level < np.quantile(level, 0.66)
        slow = waves(rock, seed, 6.0, 0.02)
        before, after = (waves(rock, 10 * seed + k, 0.35, 0.008) + slow for k in (1, 2))
        reference = dataclasses.replace(rock, height=np.where(sand, before, rock.height))
        moving = dataclasses.replace(again, height=np.where(sand, after + rise, again.height))
        assert abs(np.median(reference.height - moving.height)) > 0.05
        for first, second in ((reference, moving), (moving, reference)):
            heights = fit_heights(first, second, HERE)
            found.append(heights.up)
            stated.append(np.sqrt(heights.covariance[0, 0]))
            assert (heights.ground[sand] == STABLE).mean() < 0.1
            assert not heights.note
    assert np.median(np.abs(found)) < 0.002
    assert (np.abs(found) < 2.5 * np.array(stated)).all()


def test_ground_without_detail_is_not_believed_to_have_stayed():
    """Bare sand: what it rose by cannot be told from an error in depth."""
    bare = [dataclasses.replace(relief(), height=waves(relief(), k, 0.35, 0.008)) for k in (1, 2)]
    found = fit_heights(bare[0], lowered(bare[1], 0.05), HERE)
    assert found.up == pytest.approx(0.05, abs=0.005)
    assert np.sqrt(found.covariance[0, 0]) >= SHEET
    half = np.ptp(places(relief())[0]) / np.sqrt(12)  # m, from the middle, rms
    assert (np.sqrt(np.diag(found.covariance)[1:]) >= 0.9 * SHEET / half).all()
    assert "sand" in found.note


def test_where_no_ground_counts_the_models_may_bend():
    """Only a third tells, all in the east; the stated region knows that the west may bend."""
    rock, again = relief(), relief(noise_seed=1)
    east, north = places(rock)
    design = np.stack([np.ones(east.size), north.ravel(), -east.ravel()], axis=1)
    deviations = []
    for seed in range(6):
        bowl = waves(rock, 70 + seed, 14.0, 0.04)
        best = np.linalg.lstsq(design, bowl.ravel(), rcond=None)[0]
        plants = [
            np.where(east < 2.5, waves(rock, 100 + 2 * seed + k, 0.35, 0.03), 0.0) for k in (0, 1)
        ]
        still = dataclasses.replace(rock, height=rock.height + plants[0])
        bent = dataclasses.replace(again, height=again.height + plants[1] - bowl)
        for first, second, truth in ((still, bent, best), (bent, still, -best)):
            heights = fit_heights(first, second, HERE)
            assert not heights.note
            assert (heights.ground[east < 2.0] == STABLE).mean() < 0.15
            miss = np.append(heights.up, heights.tilt) - truth
            deviations.append(np.sqrt(miss**2 / np.diag(heights.covariance)))
    assert np.max(deviations) < 3.0  # without that, tilts err by six
    assert np.median(deviations) > 0.05  # nor is anything allowed


@functools.cache
def bent_floor():
    """A noisy reference of 16 m, and the exact floor to look its places up in."""
    floor = seafloor.Seafloor.random(3, size=24)
    return floor.raster(0.1, 8.0, noise=0.002), floor.raster(0.05, 9.0, noise=0.0)


@pytest.mark.parametrize("seed", range(4))
def test_models_that_bend_far_are_compared_where_the_same_ground_is(seed):
    """20 cm across and 5 cm up and down: up and tilt are still the uniform best fit's."""
    still, fine = bent_floor()
    parts = [waves(still, 7 * seed + k, 9.0, 0.14) for k in (0, 1)]
    up = waves(still, 7 * seed + 2, 9.0, 0.05)
    east, north = places(still)
    at = fine.grid.row_col(east + parts[0], north + parts[1])
    moved = dataclasses.replace(still, height=map_coordinates(fine.height, at, order=3) - up)

    def offset_at(places):
        row, col = still.grid.row_col(*places.T)
        return np.stack(
            [map_coordinates(part, [row, col], order=3, mode="nearest") for part in parts], axis=1
        )

    design = np.stack([np.ones(up.size), north.ravel(), -east.ravel()], axis=1)
    best = np.linalg.lstsq(design, up.ravel(), rcond=None)[0]
    found = fit_heights(still, moved, HERE, offset_at)
    assert found.up == pytest.approx(best[0], abs=0.003)
    miss = np.append(found.up, found.tilt) - best
    deviations = np.abs(miss) / np.sqrt(np.diag(found.covariance))
    assert deviations.max() < 3.5
    assert (found.ground == STABLE).mean() > 0.85
    blind = fit_heights(still, moved, HERE)
    assert (blind.ground == STABLE).mean() < 0.7


def test_a_tilt_that_is_left_out_is_in_the_covariance():
    """Too small to be significant, it is what both directions may disagree by."""
    rng = np.random.default_rng(5)
    still = relief()
    error = gaussian_filter(rng.normal(0, 1.0, still.grid.shape), 12.0)
    error *= 0.01 / error.std()
    there, back = (
        fit_heights(a, b, HERE)
        for a, b in ((still, lowered(still, error)), (lowered(still, error), still))
    )
    miss = np.abs(there.tilt + back.tilt)
    allowed = np.sqrt(np.diag(there.covariance + back.covariance)[1:])
    assert (miss <= 3 * allowed).all()


def bending_lattice(seed):
    """15 × 15 blocks of ground that bends by 3 cm and errs by 2 mm."""
    rng = np.random.default_rng(seed)
    row, col = np.mgrid[:15, :15]
    phase = rng.uniform(0, 6, 2)
    bending = 0.03 * np.sin(row / 4 + phase[0]) + 0.03 * np.cos(col / 5 + phase[1])
    return np.stack([row, col], axis=-1), bending + rng.normal(0, 0.002, row.shape), rng


@given(st.integers(0, 1000), st.floats(0.15, 0.4))
def test_the_largest_sheet_ends_at_a_step(seed, step):
    """However the ground bends, a third that slid as a whole is told from the rest."""
    lattice, value, rng = bending_lattice(seed)
    slid = (lattice[..., 0] + lattice[..., 1] * rng.uniform(-0.3, 0.3)) > 9.5
    found = largest_sheet(lattice.reshape(-1, 2), (value + step * slid).ravel(), np.ones(225))
    assert not found[slid.ravel()].any()
    assert found[~slid.ravel()].mean() > 0.97


@given(st.integers(0, 1000), st.integers(1, 4))
def test_the_largest_sheet_goes_on_behind_a_gap(seed, wide):
    lattice, value, _ = bending_lattice(seed)
    seen = np.abs(lattice[..., 1] - 7) >= 0.5 * wide
    found = largest_sheet(lattice[seen], value[seen], np.ones(seen.sum()))
    assert found.mean() > 0.97


@given(st.data())
def test_neighbours_are_the_median_of_what_is_known_around(data):
    shape = data.draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    values = st.one_of(st.just(np.nan), st.floats(-1, 1))
    table = np.array(data.draw(st.lists(values, min_size=81, max_size=81))).reshape(9, 9)
    lattice = np.argwhere(np.ones(shape, bool))
    found = neighbours(lattice, table[tuple(lattice.T)])
    table[shape[0] :] = table[:, shape[1] :] = np.nan
    for (row, col), value in zip(lattice, found, strict=True):
        around = table[max(row - 2, 0) : row + 3, max(col - 2, 0) : col + 3]
        known = around[np.isfinite(around)]
        assert value == (
            pytest.approx(np.median(known)) if known.size else pytest.approx(np.nan, nan_ok=True)
        )


def test_the_largest_sheet_of_blocks_in_one_line():
    lattice = np.stack([np.zeros(14, int), np.arange(14)], axis=1)
    value = np.where(np.arange(14) < 9, 0.0, 0.5) + 0.001 * np.arange(14)
    found = largest_sheet(lattice, value, np.ones(14))
    np.testing.assert_array_equal(found, np.arange(14) < 9)


def test_what_lies_under_the_mask_changes_nothing():
    valid = np.ones(relief().grid.shape, bool)
    valid[:40, 60:] = False
    first, second = (
        fit_heights(relief(), lowered(relief(noise_seed=1), 0.02 + wild * ~valid, valid), HERE)
        for wild in (0.0, 7.0)
    )
    assert first.up == second.up
    np.testing.assert_array_equal(first.covariance, second.covariance)
    assert first.up == pytest.approx(0.02, abs=5e-4)


def test_nothing_in_common_is_said():
    found = fit_heights(relief(), relief(), Transform(offset=(100.0, 0.0, 0.0)))
    assert "no heights in common" in found.note
    assert found.up == 0.0
    assert not found.covariance.any()


def test_too_little_for_blocks_takes_the_median():
    small = relief(half=1.0)
    found = fit_heights(small, lowered(small, 0.05), HERE)
    assert found.up == pytest.approx(0.05, abs=1e-6)
    assert "too little" in found.note
    assert found.covariance[1, 1] > 0


def test_covariance_is_the_scatter():
    """Ground that errs in patches half a metre wide: answers scatter by the stated sigma.

    Less what the same spread from block to block would mean if it were growth.
    """
    still = relief(half=6.0)
    answers, stated, whole = [], [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        error = gaussian_filter(rng.normal(0, 0.05, still.grid.shape), 3.0)
        found = fit_heights(still, lowered(still, error), HERE)
        answers.append(found.up)
        whole.append(found.covariance[0, 0])
        stated.append(whole[-1] - found.sigma**2)
    scatter = np.mean(np.square(answers))
    assert 0.4 * scatter < np.mean(stated) < 2.5 * scatter
    assert np.mean(whole) > scatter


@pytest.mark.parametrize("share", [0.2, 0.4])
@pytest.mark.parametrize("height", [0.008, 0.02])
def test_turf_that_covers_much_of_the_ground_is_within_the_stated_sigma(share, height):
    """Patches a metre wide, and noise; up is wrong by what lies on the ground, and says so."""
    still = relief(half=8.0)
    errors, sigmas = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        patchy = gaussian_filter(rng.normal(size=still.grid.shape), 5.0)
        turf = height * (patchy > np.quantile(patchy, 1 - share))
        noise = rng.normal(0, 0.005, still.grid.shape)
        found = fit_heights(still, lowered(still, 0.30 - turf - noise), HERE)
        errors.append(found.up - 0.30)
        sigmas.append(np.sqrt(found.covariance[0, 0]))
    assert np.all(np.abs(errors) < 1.96 * np.array(sigmas))
    assert np.max(sigmas) < height + 0.002


@given(
    st.floats(-MAX_TILT, MAX_TILT),
    st.floats(-MAX_TILT, MAX_TILT),
    st.floats(-3.0, 3.0),
)
def test_completed_transform_lifts_its_place_and_turns_right_handedly(a, b, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    flat = Transform([[c, -s, 0], [s, c, 0], [0, 0, 1]], 1.0, (5.0, -3.0, 0.0), (1e5, 2e6, 0.0))
    place = np.array([1e5 + 10, 2e6 - 4, -12.0])
    found = dataclasses.replace(
        fit_heights(relief(), relief(), Transform(offset=(100.0, 0.0, 0.0))),
        place=place,
        up=0.25,
        tilt=np.array([a, b]),
    )
    whole = found.transform(flat)
    lift = whole.apply(place) - flat.apply(place)
    np.testing.assert_allclose(lift, [0, 0, 0.25], atol=1e-8)
    turn = rotation(np.array([a, b]))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    # to the first order: east turns down about north, north turns up about east
    np.testing.assert_allclose(turn[2, :2], [-b, a], atol=2e-4)
    np.testing.assert_allclose(whole.rotation, turn @ flat.rotation, atol=1e-12)


def test_registration_sigma_is_what_drawn_transforms_scatter_by():
    registration = made_registration()
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 7)) * np.array([3e-3, 2e-3, 4e-3, 1e-4, 2e-4, 3e-4, 1e-4])[:, None]
    registration = dataclasses.replace(registration, covariance=root @ root.T)
    transform = registration.transform
    home = transform.pivot + transform.offset
    place = home + np.array([7.0, -11.0, 2.0])
    scatter = []
    for t_e, t_n, t_u, a, b, yaw, scale in rng.multivariate_normal(
        np.zeros(7), registration.covariance, 20_000
    ):
        turn = np.array([[0, -yaw, b], [yaw, 0, -a], [-b, a, 0]])  # infinitesimal, right-handed
        arm = place - home
        scatter.append(np.array([t_e, t_n, t_u]) + turn @ arm + scale * arm)
    found = statistics.registration_sigma(registration, *place)
    np.testing.assert_allclose(found, np.std(scatter, axis=0), rtol=0.03)
    many = statistics.registration_sigma(
        registration, np.full((2, 3), place[0]), np.full((2, 3), place[1]), place[2]
    )
    np.testing.assert_allclose(many, np.broadcast_to(found, (2, 3, 3)))
    # one number for all directions is never too small in any
    stated = statistics.registration_error(registration.covariance, transform, place)
    np.testing.assert_allclose([stated[axis] for axis in "xyz"], found)
    assert stated["isotropic"] >= found.max()
    assert stated["isotropic"] <= np.sqrt((found**2).sum())


def test_a_rejected_registration_states_no_sigma():
    with pytest.raises(UsageError, match="rejected"):
        statistics.registration_sigma(made_registration("rejected"), 0.0, 0.0)
