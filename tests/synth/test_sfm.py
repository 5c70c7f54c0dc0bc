"""The distortion: what was asked for is what is there, forward, back and in truth.json."""

from __future__ import annotations

import math

import numpy as np
import pytest
import reference_synth as slow

from data_synth.recipe import load
from data_synth.scene import make_scene
from data_synth.sfm import Distortion, Sfm, identity, make_distortion
from data_synth.truth import best_fit, common_points, make_truth

CENTRE = np.array([431_200.0, 8_376_500.0, -12.0])
STILL = Sfm(
    offset_east=0.0,
    offset_north=0.0,
    offset_up=0.0,
    yaw=0.0,
    tilt=0.0,
    scale=0.0,
    scale_drift=0.0,
    doming=0.0,
    warp=0.0,
    warp_up=0.0,
)


def made(size: float = 12.0, seed: int = 0, **changes: object) -> Distortion:
    sfm = Sfm(**{**STILL.__dict__, **changes})
    return make_distortion(sfm, np.random.default_rng(seed), CENTRE, size)


def points(size: float = 12.0, start: np.ndarray = CENTRE, count: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(5)
    return start + rng.uniform(-0.5, 0.5, (count, 3)) * [size, size, 1.5]


def test_nothing_asked_nothing_done():
    p = points()
    np.testing.assert_allclose(made().reference_from_moving(p), p, atol=1e-8)
    np.testing.assert_allclose(identity(CENTRE).reference_from_moving(p), p, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_forward_and_back_are_inverse(seed):
    d = make_distortion(
        Sfm(warp=0.25, yaw=5.0, tilt=2.0, doming=0.4), np.random.default_rng(seed), CENTRE, 12.0
    )
    p = points(start=d.start)
    np.testing.assert_allclose(d.moving_from_reference(d.reference_from_moving(p)), p, atol=5e-9)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("flat", "up"), [(0.04, 0.01), (0.2258, 0.05)])
def test_warp_has_the_stated_size_after_the_best_rigid_fit(seed, flat, up):
    d = made(seed=seed, warp=flat, warp_up=up, yaw=0.4, offset_east=3.0)
    side = (np.arange(60) + 0.5) / 60 * 12.0 - 6.0
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    moving = np.stack([x, y, np.zeros_like(x)], axis=1) + d.start
    reference = d.reference_from_moving(moving)
    fit = best_fit(moving, reference, with_scale=False)
    left = moving @ fit[:3, :3].T + fit[:3, 3] - reference
    assert np.sqrt((left[:, :2] ** 2).sum(axis=1).mean()) == pytest.approx(flat, rel=0.06)
    assert np.sqrt((left[:, 2] ** 2).mean()) == pytest.approx(up, rel=0.06)
    # smooth: nothing shorter than a third of the patch
    assert (2 * math.pi / np.hypot(*d.waves.T)).min() > 12.0 / 3 - 1e-9


def test_offset_length_and_direction():
    lengths, angles = [], []
    for seed in range(40):
        d = made(seed=seed, offset_length=5.2113)
        offset = d.centre - d.start
        lengths.append(np.hypot(*offset[:2]))
        angles.append(math.atan2(offset[1], offset[0]))
    np.testing.assert_allclose(lengths, 5.2113, atol=1e-9)
    assert np.hypot(np.cos(angles).mean(), np.sin(angles).mean()) < 0.35


def test_drawn_offsets_fill_their_range_and_no_more():
    offsets = np.array(
        [
            (d.centre - d.start)[:2]
            for d in (
                made(seed=k, offset_east=(-5.0, 5.0), offset_north=(-5.0, 5.0)) for k in range(200)
            )
        ]
    )
    assert np.abs(offsets).max() <= 5.0
    assert offsets.min(axis=0).max() < -4.5
    assert offsets.max(axis=0).min() > 4.5
    assert np.abs(offsets.mean(axis=0)).max() < 0.7


def test_yaw_tilt_scale_are_those_asked_for():
    d = made(yaw=5.0, scale=0.02)
    assert np.cbrt(np.linalg.det(d.linear)) == pytest.approx(1.02, abs=1e-12)
    assert math.degrees(math.atan2(d.linear[1, 0], d.linear[0, 0])) == pytest.approx(5.0, abs=1e-9)
    tilted = made(tilt=1.5)
    assert math.degrees(math.acos(tilted.linear[2, 2])) == pytest.approx(1.5, abs=1e-9)
    assert np.linalg.det(made(mirrored=True).linear) == pytest.approx(-1.0)


def test_doming_is_middle_above_corner():
    d = made(doming=0.4)
    spots = CENTRE + np.array([[0.0, 0, 0], [6.0, 6.0, 0], [-6.0, 6.0, 0]])
    up = d.reference_from_moving(spots)[:, 2] - spots[:, 2]
    np.testing.assert_allclose(up[0] - up[1:], 0.4, atol=1e-9)


def test_scale_drift_changes_the_scale_across_the_patch_and_keeps_angles():
    share = 0.01
    d = made(seed=3, scale_drift=share)
    h = 1e-3
    scales = []
    for spot in points(count=200):
        east, north = (
            (d.reference_from_moving((spot + s)[None]) - d.reference_from_moving((spot - s)[None]))[
                0
            ]
            / (2 * h)
            for s in h * np.eye(3)[:2]
        )
        assert abs(east[:2] @ north[:2]) < 1e-6
        scales.append(np.hypot(*east[:2]))
    assert np.ptp(scales) == pytest.approx(share * (1 + np.sqrt(2) / 5), rel=0.35)


@pytest.mark.parametrize("name", ["tasmania_12h", "abrolhos_12mo", "scale_2pct", "doming"])
def test_truth_is_the_function(name):
    """truth.json alone, by plain NumPy, maps moving points as the generator's own kernels do."""
    scene = make_scene(load(name), 4, 8.0)
    truth = make_truth(scene)
    d = scene.moving.distortion
    p = points(8.0, d.start)
    by_formula = slow.reference_from_moving(p, truth["warp"])
    np.testing.assert_allclose(d.reference_from_moving(p), by_formula, atol=1e-8)
    samples = truth["warp_samples"]
    np.testing.assert_allclose(
        slow.reference_from_moving(np.array(samples["moving"]), truth["warp"]),
        samples["reference"],
        atol=1e-8,
    )


@pytest.mark.parametrize("name", ["tasmania_12h", "scott_24mo", "yaw_5deg", "severity_05"])
def test_the_fit_in_truth_is_the_best_one(name):
    scene = make_scene(load(name), 2, 10.0)
    truth = make_truth(scene)
    moving, reference = common_points(scene, 0.25)
    by_formula = slow.reference_from_moving(moving, truth["warp"])
    np.testing.assert_allclose(by_formula, reference, atol=1e-8)
    rigid = np.array(truth["reference_from_moving"])
    turn = rigid[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(moving.mean(axis=0), truth["centroid"], atol=1e-9)
    left = moving @ turn.T + rigid[:3, 3] - reference
    assert truth["residual_rms"]["horizontal"] == pytest.approx(
        np.sqrt((left[:, :2] ** 2).sum(axis=1).mean())
    )
    # no shift and no turn makes it smaller
    np.testing.assert_allclose(left.mean(axis=0), 0.0, atol=1e-7)
    arm = reference - reference.mean(axis=0)
    np.testing.assert_allclose(np.cross(arm, left).mean(axis=0), 0.0, atol=1e-6)
    # a similarity fits no worse
    alike = truth["similarity"]["residual_rms"]
    assert alike["horizontal"] <= truth["residual_rms"]["horizontal"] + 1e-9
    centre = truth["at_centre"]
    np.testing.assert_allclose(
        slow.reference_from_moving(np.array([centre["moving"]]), truth["warp"])[0],
        centre["reference"],
        atol=1e-8,
    )


@pytest.mark.parametrize(
    ("name", "length", "warp"),
    [
        ("tasmania_12h", 5.2113, 0.2258),
        ("abrolhos_12mo", 0.7708, 0.0725),
        ("scott_24mo", 2.4851, 0.2095),
    ],
)
def test_table_one(name, length, warp):
    """The paper's offsets, and its residuals, at the recipes' own size."""
    lengths, residuals = [], []
    for seed in range(4):
        truth = make_truth(make_scene(load(name), seed))
        lengths.append(np.hypot(*truth["offset"][:2]))
        residuals.append(truth["residual_rms"]["horizontal"])
    np.testing.assert_allclose(lengths, length, atol=0.12)
    assert 0.7 * warp < np.mean(residuals) < 1.1 * warp
