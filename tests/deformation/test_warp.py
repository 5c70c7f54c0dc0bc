"""The internal error and the warp: closed-form bends are the truth, scipy's splines the twin."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import seafloor
from hypothesis import given, settings
from hypothesis import strategies as st
from made_registration import made_registration
from scipy.interpolate import BSpline

import meshreg
from meshreg.apply import apply_transform
from meshreg.cli import app as cli
from meshreg.deformation.internal import Deformation, check_model, measure
from meshreg.deformation.models import FALL, Sample, choose, fit_models, intervals, steepest, strain
from meshreg.deformation.warp_rasters import common_value, warped_raster
from meshreg.errors import InputError, UsageError
from meshreg.io import read_survey, require_warpable, rewrite_survey, write_survey
from meshreg.io.result.document import read_registration, registration_document, to_json
from meshreg.raster import rasterize
from meshreg.records import (
    Grid,
    Maps,
    Mesh,
    PointCloud,
    SourceFile,
    Survey,
    Transform,
    Warp,
)
from meshreg.refine.tiles import TileOffsets
from meshreg.report import residuals
from meshreg.settings import RasterSettings, Settings, WarpSettings

SIDE = 3.6  # m, of a tile
HALF = 12.6  # m, of the patch of 7 × 7 tiles
NOISE = 0.005  # m, of a tile

# ---- the record -------------------------------------------------------------------------------


def random_warp(seed, slope=0.01, low=(-12.0, -9.0), high=(13.0, 11.0), shape=(6, 7)):
    rng = np.random.default_rng(seed)
    warp = Warp("spline", "spline", low, high, rng.normal(size=(*shape, 3)))
    return dataclasses.replace(warp, coefficients=warp.coefficients * slope / steepest(warp))


def test_displacement_is_that_of_the_textbook_splines():
    warp = random_warp(1)
    rng = np.random.default_rng(2)
    places = rng.uniform(warp.low, warp.high, (50, 2))
    rows, cols = warp.coefficients.shape[:2]
    bases = []
    for axis, count in ((0, cols - 3), (1, rows - 3)):
        step = (warp.high[axis] - warp.low[axis]) / count
        knots = warp.low[axis] + step * np.arange(-3, count + 4)
        bases.append(BSpline(knots, np.eye(count + 3), 3)(places[:, axis]))
    twin = np.einsum("pr,pc,rck->pk", bases[1], bases[0], warp.coefficients)
    np.testing.assert_allclose(warp.displacement(places), twin, atol=1e-14)


def test_gradient_is_the_slope():
    warp = random_warp(3)
    places = np.random.default_rng(4).uniform(warp.low + 0.1, warp.high - 0.1, (40, 2))
    for axis, step in enumerate(1e-4 * np.eye(2)):
        slope = (warp.displacement(places + step) - warp.displacement(places - step)) / 2e-4
        np.testing.assert_allclose(warp.gradient(places)[..., axis], slope, atol=1e-9)


@given(st.integers(0, 2**31), st.floats(0.0, 0.05))
@settings(max_examples=40, deadline=None)
def test_inverse_undoes_the_warp(seed, slope):
    warp = random_warp(seed, slope)
    points = np.random.default_rng(seed).uniform(-30, 30, (200, 3))  # inside the box and out
    np.testing.assert_allclose(warp.inverse(warp.apply(points)), points, rtol=0, atol=1e-9)
    np.testing.assert_allclose(warp.apply(warp.inverse(points)), points, rtol=0, atol=1e-9)


def test_inverse_at_utm_size():
    place = np.array([731_500.0, 5_705_200.0])
    warp = random_warp(5, 0.02, place, place + 25)
    points = np.append(place, -12.0) + np.random.default_rng(6).uniform(0, 25, (100, 3))
    assert np.abs(warp.inverse(warp.apply(points)) - points).max() < 5e-9


def test_outside_the_box_the_edge_is_held():
    warp = random_warp(7)
    edge = np.array([[13.0, 4.0], [-12.0, -9.0], [1.0, 11.0]])
    beyond = np.array([[40.0, 4.0], [-13.0, -90.0], [1.0, 11.5]])
    np.testing.assert_array_equal(warp.displacement(beyond), warp.displacement(edge))


def test_a_warp_that_folds_is_not_inverted():
    with pytest.raises(UsageError, match="folds"):
        random_warp(8, 3.0).inverse(np.random.default_rng(0).uniform(-10, 10, (50, 3)))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"coefficients": np.zeros((3, 4, 3))}, "at least"),
        ({"coefficients": np.full((4, 4, 3), np.nan)}, "finite"),
        ({"high": (-12.0, 0.0)}, "empty"),
    ],
)
def test_a_warp_is_checked_at_birth(changed, said):
    with pytest.raises(UsageError, match=said):
        dataclasses.replace(random_warp(0), **changed)


# ---- the ladder -------------------------------------------------------------------------------


def lattice():
    middle = np.arange(7) * SIDE - 3 * SIDE
    return np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)


def sample_of(values, places=None, side=SIDE):
    places = lattice() if places is None else places
    count = len(places)
    low, high = places.min(axis=0) - side / 2, places.max(axis=0) + side / 2
    return Sample(places, values, np.arange(count), np.zeros(count, int), side, low, high)


def rigid(places, rng):
    """A shift and a turn that T left, small as they are."""
    turn = rng.normal(0, 2e-4)
    return rng.normal(0, 0.01, 2) + turn * np.stack([-places[:, 1], places[:, 0]], axis=1)


def up_dome(places, height=0.06):
    """A dome whose middle is `height` above the corners of the patch."""
    return -height * (places**2).sum(axis=1, keepdims=True) / (2 * HALF**2)


def flat_quadratic(places):
    x, y = places.T / HALF
    return 0.03 * np.stack([x * x - 0.5 * x * y, 0.7 * y * y + x * y], axis=1)


def flat_waves(places):
    x, y = places.T
    return np.stack(
        [0.05 * np.sin(2 * np.pi * y / 22 + 0.4), 0.04 * np.cos(2 * np.pi * (x + y) / 26)], axis=1
    )


def said_by(step, sample, places):
    table = np.zeros((*step.coefficients.shape[:2], 3))
    dimension = sample.values.shape[1]
    part = slice(0, 2) if dimension == 2 else slice(2, 3)
    table[..., part] = step.coefficients
    return Warp("", "", sample.low, sample.high, table).displacement(places)[:, part]


FIELDS = {
    "similarity": (lambda p: 0.003 * p, 0.004),
    "dome": (lambda p: 0.04 * (p**2).sum(axis=1, keepdims=True) * p / HALF**3, 0.006),
    "quadratic": (flat_quadratic, 0.006),
    "spline": (flat_waves, 0.010),
}


@pytest.mark.parametrize("model", FIELDS)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_horizontal_bend_is_named_and_recovered(model, seed):
    rng = np.random.default_rng(seed)
    places = lattice()
    field, most = FIELDS[model]
    values = field(places) + rigid(places, rng)
    sample = sample_of(values + rng.normal(0, NOISE, values.shape))
    best = choose(fit_models(sample), sample, 0.10)
    assert best.model == model
    error = said_by(best, sample, places) - values
    assert np.sqrt((error**2).sum(axis=1).mean()) < most


@pytest.mark.parametrize("height", [0.06, -0.06, 0.2])
def test_a_dome_is_named_and_its_height_recovered(height):
    rng = np.random.default_rng(3)
    places = lattice()
    values = up_dome(places, height) + 0.001 * places[:, :1] - 0.02
    sample = sample_of(values + rng.normal(0, NOISE, values.shape))
    best = choose(fit_models(sample), sample, 0.05)
    assert best.model == "dome"
    ends = said_by(best, sample, np.array([[0, 0], *(HALF * np.array(
        [[1, 1], [1, -1], [-1, 1], [-1, -1]]
    ))]))  # fmt: skip
    assert ends[0] - ends[1:].mean() == pytest.approx(height, abs=0.006)


@pytest.mark.parametrize("dimension", [1, 2])
def test_noise_alone_is_rigid(dimension):
    places = lattice()
    chosen = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        left = rigid(places, rng) if dimension == 2 else 0.001 * places[:, :1]
        sample = sample_of(left + rng.normal(0, NOISE, (len(places), dimension)))
        chosen.append(choose(fit_models(sample), sample, np.inf).model)
    assert chosen.count("rigid") >= 11


def test_few_tiles_stay_rigid():
    """Seven tiles with a bend in them: no model has enough of them to be held out from."""
    places = lattice()[::7]
    values = np.stack([0.02 * (places[:, 1] / HALF) ** 2, 0 * places[:, 0]], axis=1)
    sample = sample_of(values, places)
    assert {step.model for step in fit_models(sample)} == {"rigid"}


@pytest.mark.parametrize("bend", [0.0, 0.06])
@pytest.mark.parametrize("grown", [0.05, 0.15])
def test_ground_that_has_changed_is_not_absorbed(bend, grown):
    """A tenth of the tiles, side by side, have grown: the model follows the cameras, not them."""
    rng = np.random.default_rng(5)
    places = lattice()
    patch = np.isin(np.arange(49), [15, 16, 17, 22, 23])
    values = up_dome(places, bend)
    seen = values + rng.normal(0, 0.004, values.shape) - grown * patch[:, None]
    sample = sample_of(seen)
    best = choose(fit_models(sample), sample, 0.05)
    assert best.model == ("dome" if bend else "rigid")
    assert np.abs(said_by(best, sample, places) - values)[patch].max() < 0.006
    assert (best.weights[patch] == 0).all()
    assert (best.weights[~patch] > 0).all()


def test_wild_tiles_do_not_bend_the_survey():
    rng = np.random.default_rng(6)
    places = lattice()
    values = flat_quadratic(places)
    seen = values + rng.normal(0, NOISE, values.shape)
    wild = rng.choice(49, 8, replace=False)
    seen[wild] += rng.uniform(0.1, 0.25, (8, 2)) * rng.choice([-1, 1], (8, 2))
    sample = sample_of(seen)
    best = choose(fit_models(sample), sample, 0.05)
    error = said_by(best, sample, places) - values
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.008
    assert (best.weights[wild] == 0).all()


def test_tiles_that_share_a_block_are_held_out_together():
    """Each tile twice, erring alike: seen twice, noise must not pass for a bend."""
    places = lattice()
    rng = np.random.default_rng(7)
    values = rng.normal(0, NOISE, (49, 2))
    once = sample_of(values)
    twice = Sample(
        np.tile(places, (2, 1)), np.tile(values, (2, 1)), np.tile(np.arange(49), 2),
        np.repeat([0, 1], 49), SIDE, once.low, once.high,
    )  # fmt: skip
    for one, two in zip(fit_models(once), fit_models(twice), strict=True):
        assert one.model == two.model
        if one.model != "spline":  # whose energy is weighed against the number of tiles
            np.testing.assert_allclose(two.held[:49], one.held, rtol=0.05, atol=1e-4)
    assert choose(fit_models(twice), twice, np.inf).model == "rigid"


def test_held_out_is_what_a_fit_without_the_tile_says():
    """Twin: leave each tile out by hand, in an unweighted least-squares plane."""
    places = lattice()[:25]
    values = np.random.default_rng(8).normal(0, NOISE, (25, 1))
    sample = sample_of(values, places)
    from meshreg.deformation import models as ladder
    from meshreg.statistics import held_out

    design = ladder._polynomials(places, sample, "rigid")
    weighted, groups = design, held_out.groups_of(sample.block)
    inverse = np.linalg.inv(np.einsum("mkp,mkq->pq", design, design))
    answer = inverse @ np.einsum("mkp,mk->p", design, values)
    held, _ = held_out.held_out(design, weighted, inverse, values - design @ answer, groups)
    for k in range(25):
        rest = np.arange(25) != k
        alone = np.linalg.lstsq(design[rest, 0], values[rest], rcond=None)[0]
        assert held[k, 0] == pytest.approx((values[k] - design[k] @ alone).item(), abs=1e-8)


def test_knots_are_no_closer_than_two_tiles_and_eight_metres():
    def patch(size, side):
        ends = np.array([0.0, 0.0]), np.array([size, 0.7 * size])
        return Sample(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1), np.zeros(1), side, *ends)

    assert intervals(patch(25.2, 3.6)) == (3, 2)
    assert intervals(patch(25.2, 6.0)) == (2, 1)
    assert intervals(patch(11.0, 1.6)) is None  # 7.7 m one way
    assert intervals(patch(400.0, 3.6)) == (8, 8)


def warp_of(field, low=(-15.0, -10.0), high=(15.0, 10.0)):
    """A warp that is this field of degree 3 or less, by its values at sixteen places."""
    axes = [np.linspace(a, b, 4) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    unit = np.eye(16).reshape(16, 4, 4, 1) * np.ones(3)
    basis = [Warp("", "", low, high, one).displacement(places)[:, 0] for one in unit]
    table = np.linalg.solve(np.stack(basis, axis=1), field(places)).reshape(4, 4, 3)
    return Warp("", "", low, high, table)


def flat_and_up(flat, up=None):
    return lambda p: np.column_stack([flat(p), 0 * p[:, 0] if up is None else up(p)])


def test_a_rigid_motion_strains_nothing_and_a_scale_by_itself():
    turned = warp_of(
        flat_and_up(lambda p: 0.2 + 0.01 * p[:, ::-1] * [-1, 1], lambda p: 0.3 - 0.02 * p[:, 0])
    )
    assert strain(turned) < 1e-12
    assert strain(warp_of(flat_and_up(lambda p: 0.003 * p))) == pytest.approx(0.003, rel=1e-9)
    assert strain(warp_of(flat_and_up(lambda p: -0.003 * p))) == pytest.approx(0.003, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_strain_is_the_change_of_lengths_across_the_survey(seed):
    """Twin: long lines drawn at random, measured before and after."""
    rng = np.random.default_rng(seed)
    table = rng.normal(0, 0.05, (6, 7, 3)) * [1, 1, 0]
    warp = Warp("", "", (-15.0, -10.0), (15.0, 10.0), table)
    ends = rng.uniform(warp.low, warp.high, (2, 40_000, 2))
    before = np.hypot(*(ends[1] - ends[0]).T)
    moved = [e + warp.displacement(e)[:, :2] for e in ends]
    after = np.hypot(*(moved[1] - moved[0]).T)
    far = before >= 0.5 * np.hypot(30.0, 20.0)
    change = np.sqrt(np.mean((after[far] / before[far] - 1) ** 2))
    assert strain(warp) == pytest.approx(change, rel=0.25)  # the lattice has more of the edges
    up = Warp("", "", warp.low, warp.high, table[..., [2, 2, 0]])
    rise = [up.displacement(e)[:, 2] for e in ends]
    plane = np.column_stack([np.ones(80_000), ends.reshape(-1, 2)])
    rise = np.concatenate(rise)
    rise = (rise - plane @ np.linalg.lstsq(plane, rise, rcond=None)[0]).reshape(2, -1)
    tilt = np.arctan2(rise[1] - rise[0], before)[far]
    assert strain(up) == pytest.approx(0.5 * np.sqrt(np.mean(tilt**2)), rel=0.25)


def test_strain_grows_with_the_bend_and_not_with_the_place():
    warp = random_warp(3)
    twice = dataclasses.replace(warp, coefficients=2 * warp.coefficients)
    assert strain(twice) == pytest.approx(2 * strain(warp), rel=1e-9)
    far = np.array([4e5, 5e6])
    there = dataclasses.replace(warp, low=warp.low + far, high=warp.high + far)
    assert strain(there) == pytest.approx(strain(warp), rel=1e-6)


@pytest.mark.parametrize("rms", [0.04, 0.07, 0.10])
def test_a_bend_of_cameras_is_within_the_strain_that_is_allowed(rms):
    """Waves of a third to two patches, of the generator: 4 to 10 cm rms on 25 m."""
    from data_synth.sfm import Sfm, make_distortion

    still = {"offset_east": 0.0, "offset_north": 0.0, "offset_up": 0.0, "yaw": 0.0, "tilt": 0.0}
    sfm = Sfm(warp=rms, scale=0.0, scale_drift=0.0, doming=0.0, **still)
    places = np.column_stack([lattice(), np.zeros(49)])
    for seed in range(3):
        rng = np.random.default_rng(seed)
        bend = make_distortion(sfm, rng, np.zeros(3), 2 * HALF)
        values = (bend.reference_from_moving(places) - places)[:, :2]
        sample = sample_of(values + rng.normal(0, NOISE, values.shape))
        best = choose(fit_models(sample), sample, WarpSettings().max_strain)
        assert best.model == "spline"
        assert 0.04 * rms < best.strain < 0.01
        error = said_by(best, sample, lattice()) - values
        assert np.sqrt((error**2).sum(axis=1).mean()) < 0.015


@pytest.mark.parametrize(
    ("dimension", "size"), [(2, 0.05), (2, 0.15), (2, 0.3), (1, 0.15), (1, 0.3)]
)
def test_ground_that_has_changed_in_one_piece_is_not_bent_after(dimension, size):
    """Up to 45 % of the tiles, side by side, slid or grown: within the strain that is allowed,
    and predicting held-out tiles better, a bend would follow them; the rest of the ground says no.
    """
    places, tempted = lattice(), 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        away = np.hypot(*((places - rng.uniform(-9, 9, 2)) * rng.uniform(0.7, 1.4, 2)).T)
        changed = away <= np.sort(away)[21]
        angle = rng.uniform(0, 2 * np.pi)
        heading = np.array([np.cos(angle), np.sin(angle)]) if dimension == 2 else np.array([-1.0])
        amount = size * rng.uniform(0.5, 1.0, (49, 1)) * changed[:, None]
        sample = sample_of(amount * heading + rng.normal(0, 0.004, (49, dimension)))
        steps = fit_models(sample)
        best = choose(steps, sample, 0.01)
        assert best.model == "rigid"
        assert np.abs(said_by(best, sample, places)[~changed]).max() < 0.006
        assert (best.weights[changed] < 0.5).all()
        error = [np.sqrt(np.mean(np.minimum(s.held, 0.1) ** 2)) for s in steps if s.strain < 0.01]
        tempted += min(error[1:]) < FALL * error[0]
    assert tempted >= 3


def test_too_much_strain_is_refused():
    places = lattice()
    rng = np.random.default_rng(9)
    sample = sample_of(20 * flat_quadratic(places) + rng.normal(0, NOISE, (49, 2)))
    steps = fit_models(sample)
    best = choose(steps, sample, np.inf)
    assert best.strain > 0.02
    assert choose(steps, sample, 0.01).strain <= 0.01
    assert choose(steps, sample, best.strain).model == best.model


def test_a_fit_that_folds_the_ground_is_none():
    """Tiles that claim a mirrored ground: a quadratic could say so, and could not be undone."""
    places = lattice()
    values = 2.0 * places[:, ::-1]
    sample = sample_of(values + np.random.default_rng(12).normal(0, NOISE, values.shape))
    steps = fit_models(sample)
    assert {step.model for step in steps} == {"rigid", "similarity", "dome"}
    points = np.column_stack([places, np.zeros(49)])
    for step in steps:
        table = np.dstack([step.coefficients, np.zeros(step.coefficients.shape[:2])])
        warp = Warp("", "", sample.low, sample.high, table)
        np.testing.assert_allclose(warp.inverse(warp.apply(points)), points, atol=1e-9)


def test_common_value_is_that_of_the_ground_that_stayed():
    rng = np.random.default_rng(10)
    stayed, grown = rng.normal(0, 0.01, 700), rng.uniform(0.02, 0.15, 500)
    values = np.concatenate([stayed, grown])
    assert abs(common_value(values)) < 0.004
    assert abs(np.median(values)) > 0.009
    assert common_value(-values) == pytest.approx(-common_value(values), abs=1e-3)


# ---- measured on a pair -----------------------------------------------------------------------


def bent_pair(up=lambda p: 0 * p[:, :1], flat=lambda p: 0 * p, seed=0, cell=0.1):
    """A reference, the same floor bent the other way as the moving survey laid it, and tiles.

    A bump at p stands in the moving survey where p - d(p) = p', so that the warp must be d.
    """
    floor = seafloor.Seafloor.random(seed, size=2 * HALF + 2)
    reference = floor.raster(cell, HALF, noise=0.003, seed=1)
    places = np.stack([floor.east, floor.north], axis=1)
    away = places.copy()
    for _ in range(20):  # away + flat(away) = places
        away = places - flat(away)
    later = dataclasses.replace(floor, east=away[:, 0], north=away[:, 1])
    moving = later.raster(cell, HALF, noise=0.003, seed=2)
    row, col = np.mgrid[: moving.grid.shape[0], : moving.grid.shape[1]]
    cells = np.stack(moving.grid.east_north(row.ravel(), col.ravel()), axis=1)
    height = moving.height - up(cells).reshape(moving.grid.shape)
    rng = np.random.default_rng(seed)
    tiles = TileOffsets(
        lattice(), flat(lattice()) + rng.normal(0, 0.003, (49, 2)), np.arange(49), np.zeros(49, int)
    )
    return tiles, reference, dataclasses.replace(moving, height=height.astype(np.float32))


def test_doming_is_named_and_measured():
    """The moving survey's middle is 6 cm too high, and it says so."""
    tiles, reference, moving = bent_pair(up=lambda p: up_dome(p, -0.06))
    found = measure(tiles, Transform(), reference, moving, WarpSettings())
    assert "translation is not enough" in found.summary
    assert "doming" in found.summary
    vertical = found.record["vertical"]
    assert vertical["model"] == "dome"
    assert vertical["doming"] == pytest.approx(0.06, abs=0.003)
    assert vertical["held_out"] < 0.3 * vertical["held_out_rigid"]
    assert found.record["horizontal"]["model"] == "rigid"
    assert found.record["applied"] is False


def test_a_pair_that_is_rigid_is_said_to_be():
    tiles, reference, moving = bent_pair()
    found = measure(tiles, Transform(), reference, moving, WarpSettings("auto"))
    assert found.summary.startswith("a rigid move is enough")
    assert found.warp is None
    assert found.record["vertical"]["bend_rms"] == 0.0


def test_a_slope_does_not_turn_a_horizontal_bend_into_a_vertical_one():
    """On ground that falls by 1 in 3, 3 cm sideways are 1 cm up; they must not be counted twice."""
    tiles, reference, moving = bent_pair(flat=flat_quadratic)
    east = reference.grid.east_north(0, np.arange(reference.grid.shape[1]))[0]
    row, col = np.mgrid[: moving.grid.shape[0], : moving.grid.shape[1]]
    cells = np.stack(moving.grid.east_north(row.ravel(), col.ravel()), axis=1)
    there = (cells + flat_quadratic(cells))[:, 0].reshape(moving.grid.shape)
    reference = dataclasses.replace(reference, height=reference.height + np.float32(east / 3))
    moving = dataclasses.replace(moving, height=(moving.height + there / 3).astype(np.float32))
    found = measure(tiles, Transform(), reference, moving, WarpSettings("auto"))
    assert found.warp.horizontal == "quadratic"
    assert found.record["vertical"]["model"] == "rigid"
    assert found.record["vertical"]["held_out_rigid"] < 0.003


def test_a_warp_asked_for_is_the_only_one_tried():
    tiles, reference, moving = bent_pair(flat=flat_quadratic)
    for model in ("similarity", "quadratic", "spline"):
        found = measure(tiles, Transform(), reference, moving, WarpSettings(model))
        assert found.record["horizontal"]["model"] == "quadratic"  # what it is, whatever is asked
        assert (found.warp is None) == (model == "similarity")
        assert found.warp is None or found.warp.horizontal == model


def test_the_warp_follows_the_transform_it_was_measured_with():
    """Tiles are in moving coordinates; a turn and a shift of them must end at the same warp."""
    tiles, reference, moving = bent_pair(flat=flat_quadratic)
    c, s = np.cos(0.05), np.sin(0.05)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    transform = Transform(turn, 1.0, np.array([3.0, -2.0, 0.5]), np.array([5.0, 5.0, -3.0]))
    back = transform.inverse().apply(np.column_stack([tiles.places, np.zeros(49)]))[:, :2]
    elsewhere = dataclasses.replace(tiles, places=back, offsets=tiles.places + tiles.offsets - back)
    one = measure(tiles, Transform(), reference, moving, WarpSettings("auto")).warp
    two = measure(elsewhere, transform, reference, moving, WarpSettings("auto")).warp
    np.testing.assert_allclose(two.displacement(lattice()), one.displacement(lattice()), atol=1e-6)


def test_strain_over_the_limit_is_said_and_not_applied():
    """Value, limit and setting; nothing but what is within the limit is applied."""
    tiles, reference, moving = bent_pair(flat=lambda p: 4 * flat_quadratic(p))
    loose = measure(tiles, Transform(), reference, moving, WarpSettings("auto", 0.05))
    value = loose.record["horizontal"]["strain"]
    assert "max_strain" not in loose.summary
    assert strain(loose.warp) == pytest.approx(value, rel=1e-9)
    found = measure(tiles, Transform(), reference, moving, WarpSettings("auto", 0.9 * value))
    assert f"the horizontal bend strains the survey by {value:.1%}" in found.summary
    assert f"over the {0.9 * value:.1%} (warp.max_strain)" in found.summary
    assert found.warp is None or strain(found.warp) <= 0.9 * value


def test_ground_that_slid_is_told_and_not_called_a_bend():
    """Two fifths of the tiles, side by side, 15 cm to the east: no model bends after them."""
    tiles, reference, moving = bent_pair()
    slid = np.arange(49) >= 29
    offsets = tiles.offsets + 0.15 * slid[:, None] * [1.0, 0.0]
    tiles = dataclasses.replace(tiles, offsets=offsets)
    found = measure(tiles, Transform(), reference, moving, WarpSettings("auto"))
    assert found.warp is None
    assert found.record["horizontal"]["model"] == "rigid"
    assert found.summary.startswith("a rigid move is enough")
    assert "20 of 49 tiles lie apart (horizontal), as changed ground does" in found.summary


def test_too_few_tiles_are_said():
    tiles, reference, moving = bent_pair()
    few = TileOffsets(tiles.places[:5], tiles.offsets[:5], tiles.block[:5], tiles.channel[:5])
    for some in (None, few):
        found = measure(some, Transform(), reference, moving, WarpSettings("auto"))
        assert "too few tiles" in found.summary
        assert found.warp is None
        assert not found.record


def test_without_heights_the_horizontal_part_stands_alone():
    tiles, reference, moving = bent_pair(flat=flat_quadratic)
    blind = dataclasses.replace(
        moving,
        height=np.full_like(moving.height, np.nan),
        valid=np.zeros(moving.grid.shape, bool),
    )
    found = measure(tiles, Transform(), reference, blind, WarpSettings("auto"))
    assert found.record["vertical"] is None
    assert found.warp.vertical == "rigid"
    assert not found.warp.displacement(lattice())[:, 2].any()


def test_an_unknown_warp_is_refused():
    with pytest.raises(UsageError, match="There are: none, auto, similarity"):
        check_model("affine")
    check_model("auto")


# ---- applied ----------------------------------------------------------------------------------


def ground(step=0.05, half=5.0):
    """A smooth mesh of 10 × 10 m as (survey, transform, warp)."""
    axis = np.arange(-half, half + step / 2, step)
    x, y = (a.ravel() for a in np.meshgrid(axis, axis))
    z = 0.2 * np.sin(1.1 * x) * np.cos(0.8 * y)
    n = len(axis)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + n], 1),
         np.stack([corner + 1, corner + n + 1, corner + n], 1)]
    )  # fmt: skip
    grey = (100 + 100 * z).astype(np.uint8)
    mesh = Mesh(np.stack([x, y, z], 1), faces, colors=np.repeat(grey[:, None], 3, axis=1))
    c, s = np.cos(0.01), np.sin(0.01)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    transform = Transform(turn, 1.0, np.array([0.31, -0.17, 0.05]), np.zeros(3))
    low, high = (14.8, 24.6), (25.8, 35.1)
    return (
        Survey("made", mesh, np.array([20.0, 30.0, -4.0])),
        transform,
        random_warp(11, 0.02, low, high, (5, 5)),
    )


def test_mesh_cloud_and_raster_are_bent_alike():
    survey, transform, warp = ground()
    want = warp.apply(transform.apply(survey.geometry.points + survey.origin))
    bent = apply_transform(survey, transform, warp)
    np.testing.assert_allclose(bent.geometry.points + bent.origin, want, atol=1e-12)
    cloud = Survey("c", PointCloud(survey.geometry.points), survey.origin)
    moved = apply_transform(cloud, transform, warp)
    np.testing.assert_array_equal(moved.geometry.points, bent.geometry.points)
    grid = Grid(14.0, 36.0, 0.05, (240, 240))
    plain = RasterSettings(remove_floaters=False, mask_flat_color=False)
    meshed = rasterize(bent, grid, plain)
    rasters = warped_raster(rasterize(survey, grid, plain, transform=transform), warp)
    both = meshed.valid & rasters.valid
    assert both.sum() > 0.97 * max(meshed.valid.sum(), rasters.valid.sum())
    off = np.abs((meshed.height - rasters.height)[both]) + abs(meshed.datum - rasters.datum)
    assert np.percentile(off, 99) < 0.001
    assert np.abs(meshed.color.astype(float) - rasters.color)[both].mean() < 0.6
    # unbent they differ by far more
    rigid_one = rasterize(survey, grid, plain, transform=transform)
    assert np.nanmedian(np.abs(rigid_one.height - meshed.height)) > 0.003


@pytest.mark.parametrize("name", ["a.ply", "a.obj", "a.xyz", "a.las", "a.stl"])
def test_files_are_bent_as_the_survey_in_memory(tmp_path: Path, name):
    survey, transform, warp = ground(step=0.5)
    if name.endswith((".xyz", ".las")):
        survey = dataclasses.replace(survey, geometry=PointCloud(survey.geometry.points))
    write_survey(survey, tmp_path / name)
    delivered = read_survey(tmp_path / name)
    bent = apply_transform(delivered, transform, warp)
    written = rewrite_survey(delivered, transform, tmp_path / "out", warp=warp)
    again = read_survey(next(p for p in written if p.suffix == Path(name).suffix))
    np.testing.assert_allclose(
        again.geometry.points + again.origin, bent.geometry.points + bent.origin, atol=2e-4
    )
    rigid_one = apply_transform(delivered, transform)
    difference = rigid_one.geometry.points + rigid_one.origin - again.geometry.points - again.origin
    assert np.abs(difference).max() > 0.01


def test_maps_are_bent_as_the_mesh(tmp_path: Path):
    survey, transform, warp = ground()
    grid = Grid(14.0, 36.0, 0.05, (240, 240))
    plain = RasterSettings(remove_floaters=False, mask_flat_color=False)
    raster = rasterize(survey, grid, plain)
    height = np.where(raster.valid, raster.height + raster.datum, np.nan).astype(np.float32)
    write_survey(Survey("m", Maps(height, grid)), tmp_path / "dem.tif")
    delivered = read_survey(tmp_path / "dem.tif")
    written = rewrite_survey(delivered, transform, tmp_path / "out", warp=warp)
    again = read_survey(written[0]).geometry
    meshed = rasterize(apply_transform(survey, transform, warp), again.height_grid, plain)
    both = meshed.valid & np.isfinite(again.height)
    off = np.abs(meshed.height[both] + meshed.datum - again.height[both])
    assert both.sum() > 0.95 * meshed.valid.sum()
    assert np.percentile(off, 99) < 0.002


@pytest.mark.parametrize(("kind", "said"), [("glb", "glTF"), ("colmap", "COLMAP")])
def test_formats_that_move_as_a_whole_are_refused_with_the_remedy(kind, said):
    survey, *_ = ground(step=1.0)
    survey = dataclasses.replace(survey, source=(SourceFile(Path(f"a.{kind}"), kind),))
    with pytest.raises(UsageError, match=said) as caught:
        require_warpable(survey)
    assert ".ply" in str(caught.value.remedy)
    require_warpable(dataclasses.replace(survey, source=(SourceFile(Path("a.obj"), "obj"),)))


# ---- kept -------------------------------------------------------------------------------------


def warped_registration():
    tiles, reference, moving = bent_pair(
        up=lambda p: up_dome(p, -0.06), flat=flat_quadratic, cell=0.2
    )
    found = measure(tiles, Transform(), reference, moving, WarpSettings("auto", 0.05)).applied()
    made = made_registration("accepted")
    return dataclasses.replace(made, internal=found.record, warp=found.warp), found


def test_a_warp_survives_the_record(tmp_path: Path):
    registration, found = warped_registration()
    text = to_json(registration_document(registration))
    (tmp_path / "registration.json").write_text(text, encoding="utf-8")
    again = read_registration(tmp_path)
    np.testing.assert_array_equal(again.warp.coefficients, found.warp.coefficients)
    np.testing.assert_array_equal(
        again.warp.displacement(lattice()), found.warp.displacement(lattice())
    )
    names = (again.warp.horizontal, again.warp.vertical)
    assert names == (found.warp.horizontal, found.warp.vertical) == ("quadratic", "dome")
    assert again.internal == json.loads(text)["internal"]
    assert again.internal["applied"] is True
    assert "transform.txt" in found.summary


def test_the_schema_takes_it():
    jsonschema = pytest.importorskip("jsonschema")
    registration, _ = warped_registration()
    schema = json.loads(
        (Path(meshreg.__file__).parent / "io" / "result" / "registration.schema.json").read_text(
            "utf-8"
        )
    )
    document = registration_document(registration)
    jsonschema.validate(document, schema)
    document["warp"]["coefficients"][0] = [[1.0]]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document, schema)


@pytest.fixture
def run(capsys):
    def call(*arguments):
        code = cli.run([str(argument) for argument in arguments])
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


def test_apply_bends_a_further_file(tmp_path: Path, run):
    survey, transform, warp = ground(step=0.5)
    registration = dataclasses.replace(
        made_registration("accepted"), transform=transform.at(survey.centre), warp=warp
    )
    (tmp_path / "registration.json").write_text(to_json(registration_document(registration)))
    write_survey(survey, tmp_path / "more.ply")
    code, said, error = run(
        "apply", tmp_path, tmp_path / "more.ply", "-o", tmp_path / "o", "--json"
    )
    assert code == 0, error
    assert json.loads(said)["warped"] is True
    again = read_survey(tmp_path / "o" / "more_registered.ply")
    want = apply_transform(read_survey(tmp_path / "more.ply"), transform, warp)
    np.testing.assert_allclose(
        again.geometry.points + again.origin, want.geometry.points + want.origin, atol=1e-5
    )


def test_a_glb_is_refused_before_the_work_is_done(tmp_path: Path, run):
    survey, *_ = ground(step=1.0)
    for name in ("a.glb", "b.glb"):
        write_survey(survey, tmp_path / name)
    out = tmp_path / "out"
    code, _, error = run(
        "register", tmp_path / "a.glb", tmp_path / "b.glb", "-o", out, "--warp", "auto"
    )
    assert code == 2
    assert "cannot be warped" in error
    assert not out.exists()


def test_a_broken_warp_in_a_record_is_refused(tmp_path: Path):
    registration, _ = warped_registration()
    document = registration_document(registration)
    document["warp"]["coefficients"] = [[[0.0, 0.0, 0.0]]]
    (tmp_path / "registration.json").write_text(to_json(document), encoding="utf-8")
    with pytest.raises(InputError, match="warp: is"):
        read_registration(tmp_path)


def test_the_figure_shows_tiles_model_and_name():
    tiles, reference, moving = bent_pair(up=lambda p: up_dome(p, -0.06), cell=0.2)
    found = measure(tiles, Transform(), reference, moving, WarpSettings())
    evidence = {"residuals": found.evidence, "reference_dem": reference}
    made = dataclasses.replace(made_registration("accepted"), evidence=evidence)
    figure = residuals.draw_residuals(made)
    assert "doming" in figure.get_supxlabel()
    quivers = [c for c in figure.axes[0].collections if type(c).__name__ == "Quiver"]
    np.testing.assert_array_equal(quivers[0].U, found.evidence["model_east"])
    discs = figure.axes[1].collections[1]
    used = found.evidence["up_weight"] > residuals.FAINT
    np.testing.assert_allclose(discs.get_array(), 1000 * found.evidence["up"][used])


def test_a_pair_of_maps_goes_all_the_way():
    """Registered with and without a warp: measured in both, applied in one."""
    _, reference, moving = bent_pair(
        up=lambda p: up_dome(p, -0.06), flat=lambda p: 2 * flat_quadratic(p)
    )

    def survey(raster, name, shift=(0.0, 0.0)):
        grid = dataclasses.replace(
            raster.grid, west=raster.grid.west + shift[0], north=raster.grid.north + shift[1]
        )
        return Survey(name, Maps(raster.height, grid, raster.color, raster.color_valid, grid))

    pair = survey(reference, "a"), survey(moving, "b", (-0.83, 0.47))
    found = {}
    for model in ("none", "auto"):
        options = Settings().changed(
            {"methods": ("terrain",), "warp.model": model,
             "search.radius": 3.0,
                "search.max_yaw": 0.0,
                "search.max_scale": 0.0, "refine.surfaces": "none"}
        )  # fmt: skip
        found[model] = meshreg.register_pair(*pair, options)
    assert found["none"].warp is None
    assert found["none"].internal["said"] in found["none"].notes
    assert found["none"].internal["horizontal"]["model"] in ("quadratic", "spline")
    assert found["none"].internal["applied"] is False
    registration = found["auto"]
    assert registration.internal["applied"] is True
    places = np.column_stack([lattice(), np.zeros(49)])
    moved = places - [0.83, -0.47, 0.0]
    true = places + np.hstack([2 * flat_quadratic(lattice()), up_dome(lattice(), -0.06)])
    rigid_only = registration.transform.apply(moved)
    left = registration.warp.apply(rigid_only) - true
    rms = np.sqrt((left**2).mean(axis=0))
    assert np.hypot(*rms[:2]) < 0.010
    assert rms[2] < 0.006
    assert np.sqrt(((rigid_only - true)[:, :2] ** 2).sum(axis=1).mean()) > 0.03
    assert registration.after["height_rmse"] < 0.7 * found["none"].after["height_rmse"]


def test_internal_says_when_it_was_applied():
    warp = random_warp(0)
    said = Deformation("bent", {"applied": False}, warp).applied()
    assert said.record["applied"] is True
    assert said.summary.startswith("bent; ")


def as_kind(raster, kind):
    """A raster's cells as a mesh, a cloud or maps."""
    if kind == "raster":
        return Maps(raster.height, raster.grid, raster.color, raster.color_valid, raster.grid)
    rows, cols = raster.grid.shape
    row, col = np.indices((rows, cols))
    east, north = raster.grid.east_north(row.ravel(), col.ravel())
    points = np.stack([east, north, raster.height.ravel()], axis=1)
    colors = raster.color.reshape(-1, 3)
    if kind == "cloud":
        return PointCloud(points, colors)
    a = (row * cols + col)[:-1, :-1].ravel()
    faces = np.concatenate(
        [np.stack([a, a + cols, a + 1], 1), np.stack([a + 1, a + cols, a + cols + 1], 1)]
    )
    return Mesh(points, faces, colors=colors)


def geometry_of(path: Path):
    """Every coordinate of a file, absolute; heights where there is no other."""
    survey = read_survey(path)
    if isinstance(survey.geometry, Maps):
        grid = survey.geometry.height_grid
        return np.array([grid.west, grid.north, grid.cell]), survey.geometry.height
    return survey.geometry.points + survey.origin, getattr(survey.geometry, "faces", None)


@pytest.mark.parametrize(("kind", "name"), [("mesh", "ply"), ("cloud", "ply"), ("raster", "tif")])
def test_apply_lays_the_moving_survey_where_register_did(tmp_path: Path, run, kind, name):
    """Warped once by `register` and once more by `apply`, from the record alone."""
    _, reference, moving = bent_pair(
        up=lambda p: up_dome(p, -0.06), flat=lambda p: 2 * flat_quadratic(p), cell=0.15
    )
    paths = [tmp_path / f"{which}.{name}" for which in ("reference", "moving")]
    for raster, path in zip((reference, moving), paths, strict=True):
        write_survey(Survey(path.stem, as_kind(raster, kind)), path)
    quick = [f"--set={key}" for key in ("search.max_yaw=0.0", "search.max_scale=0.0")]
    quick += ["--set=refine.surfaces=none", "--methods=terrain", "--dem-cell=0.15"]
    code, _, error = run(
        "register", *paths, "-o", tmp_path / "out", "--warp", "auto", "--search-radius=2", *quick
    )
    assert code in (0, 1), error  # a single method may end in review
    registration = read_registration(tmp_path / "out")
    assert registration.internal["applied"] is True
    first = next((tmp_path / "out").glob(f"moving*_registered.{name}"))
    code, _, error = run("apply", tmp_path / "out", paths[1], "-o", tmp_path / "again")
    assert code == 0, error
    second = next((tmp_path / "again").glob(f"moving*_registered.{name}"))
    for one, two in zip(geometry_of(first), geometry_of(second), strict=True):
        np.testing.assert_array_equal(one, two)
    if kind != "raster":
        points = read_survey(paths[1]).geometry.points
        want = registration.warp.apply(registration.transform.apply(points))
        np.testing.assert_allclose(geometry_of(second)[0], want, atol=2e-5)
        assert np.abs(want - registration.transform.apply(points)).max() > 0.03
