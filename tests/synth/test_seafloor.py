"""The seafloor is a function: of place, seed and epoch, and of nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from data_synth import types as t
from data_synth.seafloor import Seafloor, ground_of, make_seafloor
from data_synth.sites import SITES

BOUNDS = (-3.0, -3.0, 3.0, 3.0)


def lattice(half: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    side = np.arange(-half + step / 2, half, step)
    return np.meshgrid(side, side[::-1])


@pytest.fixture(scope="module")
def reef() -> Seafloor:
    return make_seafloor(SITES["reef"], 11, BOUNDS)


def test_does_not_depend_on_the_area_asked_for(reef):
    wider = make_seafloor(SITES["reef"], 11, (-9.0, -5.0, 4.0, 8.0))
    x, y = lattice(2.9, 0.05)
    for one, other in zip(reef.evaluate(x, y)[:2], wider.evaluate(x, y)[:2], strict=True):
        np.testing.assert_array_equal(one, other)


def test_does_not_depend_on_the_order_of_points(reef):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-2.9, 2.9, (2, 5000))
    order = rng.permutation(5000)
    height, color, winner = reef.evaluate(x, y)
    again = reef.evaluate(x[order], y[order])
    np.testing.assert_array_equal(height[order], again[0])
    np.testing.assert_array_equal(color[order], again[1])
    np.testing.assert_array_equal(winner[order], again[2])
    np.testing.assert_array_equal(reef.height(x, y), height)


def test_seed_decides(reef):
    x, y = lattice(2.9, 0.1)
    same = make_seafloor(SITES["reef"], 11, BOUNDS).height(x, y)
    np.testing.assert_array_equal(same, reef.height(x, y))
    other = make_seafloor(SITES["reef"], 12, BOUNDS).height(x, y)
    a, b = reef.height(x, y), other
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.5
    assert np.abs(a - b).mean() > 0.1


@pytest.mark.parametrize("site", sorted(SITES))
def test_every_site_gives_sound_numbers(site):
    floor = make_seafloor(SITES[site], 3, BOUNDS)
    x, y = lattice(2.9, 0.02)
    height, color, winner = floor.evaluate(x, y)
    assert np.isfinite(height).all()
    assert np.ptp(height) < 6.0
    assert color.min() > 0.0
    assert color.max() < 1.5
    assert winner.min() >= -1
    assert winner.max() < len(floor.features)


def test_sand_covers_the_stated_share():
    from data_synth.seafloor_kernels import evaluate_ground

    x, y = (a.ravel() for a in lattice(15.0, 0.2))
    for site in ("low_reef", "boulders", "reef_and_sand"):
        for seed in (1, 2):
            _, sandy = evaluate_ground(x, y, ground_of(SITES[site], seed), 0.0)
            assert (sandy > 0.5).mean() == pytest.approx(SITES[site].sand, abs=0.07)


def test_reef_is_as_rough_as_horseshoe_reef():
    """Quantiles of slope and spectrum of the real DEM (docs/seafloor_vs_reef.png), within bounds.

    Real: slopes at 1 cm 22.2, 36.6, 54.0 degrees (quartiles), at 10 cm 16.2, 29.1, 47.0; power
    spectral density falls from 2.3e-4 m4 at 0.447 m to 8.9e-8 at 0.045 m.
    """
    fine, coarse, long, short = [], [], [], []
    for seed in range(3):
        floor = make_seafloor(SITES["reef"], seed, (-3.0, -3.0, 3.0, 3.0))
        x, y = lattice(2.56, 0.01)
        z = floor.height(x, y, 0.01)
        fine.append(np.percentile(slope(z, 0.01), [25, 50, 75]))
        block = z[:510, :510].reshape(51, 10, 51, 10).mean(axis=(1, 3))
        coarse.append(np.percentile(slope(block, 0.10), [25, 50, 75]))
        a, b = density(z, 0.01, (0.447, 0.045))
        long.append(a)
        short.append(b)
    np.testing.assert_allclose(np.mean(fine, axis=0), [22.2, 36.6, 54.0], atol=7.0)
    np.testing.assert_allclose(np.mean(coarse, axis=0), [16.2, 29.1, 47.0], atol=8.0)
    assert 0.35 < np.exp(np.mean(np.log(long))) / 2.3e-4 < 2.5
    assert 0.35 < np.exp(np.mean(np.log(short))) / 8.9e-8 < 2.5


def slope(z: np.ndarray, step: float) -> np.ndarray:
    gy, gx = np.gradient(z, step)
    return np.degrees(np.arctan(np.hypot(gx, gy))).ravel()


def density(z: np.ndarray, step: float, wavelengths: tuple[float, ...]) -> list[float]:
    window = np.outer(np.hanning(z.shape[0]), np.hanning(z.shape[1]))
    power = np.abs(np.fft.fft2((z - z.mean()) * window)) ** 2 * step**2 / (window**2).sum()
    f = np.fft.fftfreq(z.shape[0], step)
    radius = np.hypot(*np.meshgrid(f, f))
    return [float(power[(radius * w > 0.85) & (radius * w < 1.18)].mean()) for w in wavelengths]


def test_features_never_reach_further_than_they_say(reef):
    """Take one feature away: nothing changes outside its reach."""
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-2.9, 2.9, (2, 60_000))
    whole = reef.evaluate(x, y)
    chosen = [
        np.flatnonzero(reef.features["kind"] == kind)[:1]
        for kind in np.unique(reef.features["kind"])
    ]
    for k in np.concatenate(chosen):
        f = reef.features[k]
        less = Seafloor(reef.ground, np.delete(reef.features, k), reef.bounds).evaluate(x, y)
        changed = (whole[0] != less[0]) | (whole[1] != less[1]).any(axis=1)
        far = np.hypot(x - f["x"], y - f["y"]) > f["reach"]
        assert not changed[far].any(), t.KINDS[f["kind"]]


def test_leaving_out_fine_relief_keeps_the_mean(reef):
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-2.9, 2.9, (2, 40_000))
    fine, coarse = reef.height(x, y), reef.height(x, y, 0.05)
    assert abs((fine - coarse).mean()) < 0.02
    assert np.median(np.abs(fine - coarse)) < 0.03


def test_ripples_run_with_their_wavelength():
    site = SITES["sand"]
    from dataclasses import replace

    site = replace(
        site, ripple=0.05, ripple_wavelength=0.5, ripple_wander=0.0, sand_relief=0.0, urchin=0.0
    )
    floor = make_seafloor(site, 1, (-6.0, -6.0, 6.0, 6.0))
    turn = floor.ground.ripple_turn
    along = np.arange(0, 5.0, 0.005)
    z = floor.height(along * np.cos(turn), along * np.sin(turn))
    power = np.abs(np.fft.rfft((z - z.mean()) * np.hanning(len(z))))
    peak = np.fft.rfftfreq(len(z), 0.005)[power.argmax()]
    assert 1 / peak == pytest.approx(0.5, rel=0.1)
    assert np.ptp(z) == pytest.approx(0.05, rel=0.25)
