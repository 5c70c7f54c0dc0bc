"""The noise against slow twins, and what it promises: no period, no seam, no scheduling."""

from __future__ import annotations

import numpy as np
import pytest
import reference_synth as slow
from hypothesis import given, settings
from hypothesis import strategies as st

from data_synth.noise_kernels import (
    hash01,
    lumps_at,
    lumps_into,
    octaves,
    octaves_into,
)
from data_synth.sfm_kernels import bend_many

coordinate = st.floats(-5e3, 5e3, allow_nan=False)
seeds = st.integers(0, 2**30)


@settings(max_examples=60, deadline=None)
@given(x=coordinate, y=coordinate, seed=seeds)
def test_octaves_equal_the_slow_twin(x, y, seed):
    fast = octaves(x, y, seed, 1.7, 0.05, 0.6, 5)
    assert fast == pytest.approx(slow.octaves(x, y, seed, 1.7, 0.05, 0.6, 5), abs=1e-7)


@settings(max_examples=60, deadline=None)
@given(x=coordinate, y=coordinate, seed=seeds, presence=st.floats(0.1, 1.0))
def test_lumps_equal_the_highest_of_all_near(x, y, seed, presence):
    """So the four cells that the kernel asks are enough."""
    up, own = lumps_at(x, y, seed, presence)
    assert up == pytest.approx(slow.lumps(x, y, seed, presence), abs=1e-9)
    assert 0.0 <= own < 1.0


@settings(deadline=None)
@given(ix=st.integers(-(2**20), 2**20), iy=st.integers(-(2**20), 2**20), seed=seeds)
def test_hash_equals_the_slow_twin(ix, iy, seed):
    assert hash01(ix, iy, seed) == slow.hash2(ix, iy, seed) / 2**32


def test_vector_loops_equal_single_points():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-50, 50, (2, 500))
    out = np.full(500, 2.0)
    octaves_into(x, y, 7, 0.9, 0.02, 0.7, 4, 0.3, out)
    single = [2.0 + 0.3 * octaves(a, b, 7, 0.9, 0.02, 0.7, 4) for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(out, single, atol=1e-12)
    up, own = np.empty(500), np.empty(500)
    lumps_into(x, y, 0.5, 0.3, 7, 0.8, up, own)
    c, s = np.cos(0.3) / 0.5, np.sin(0.3) / 0.5
    pairs = [lumps_at(c * a - s * b, s * a + c * b, 7, 0.8) for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(np.stack([up, own], axis=1), pairs, atol=1e-12)


def test_octaves_have_unit_spread_and_no_period():
    side = np.arange(400) * 0.37
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    out = np.zeros(x.size)
    octaves_into(x, y, 3, 2.0, 0.0, 0.5, 1, 1.0, out)
    field = out.reshape(400, 400)
    assert abs(field.mean()) < 0.05
    assert field.std() == pytest.approx(1.0, abs=0.05)
    spectrum = np.abs(np.fft.fft2(field - field.mean())) ** 2
    correlation = np.fft.ifft2(spectrum).real / spectrum.sum() * spectrum.size
    correlation /= correlation[0, 0]
    # beyond a few wavelengths nothing is like anything else
    assert np.abs(correlation[20:200, 20:200]).max() < 0.1


def test_lumps_are_continuous():
    x = np.linspace(0, 30, 200_001)
    up, own = np.empty(x.size), np.empty(x.size)
    lumps_into(x, 0.7 * x, 1.0, 0.0, 9, 0.9, up, own)
    assert np.abs(np.diff(up)).max() < 0.02
    assert 0.2 < (up > 0).mean() < 0.9


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=2), seeds)
def test_warp_equals_numpys_sines(point, seed):
    rng = np.random.default_rng(seed)
    warp = {
        "poly": rng.normal(size=(3, 6)),
        "waves": rng.normal(size=(5, 2)),
        "cosines": rng.normal(size=(5, 3)),
        "sines": rng.normal(size=(5, 3)),
    }
    q = np.array([point])
    fast = bend_many(q[:, 0].copy(), q[:, 1].copy(), *warp.values())
    np.testing.assert_allclose(fast, slow.bend(q, warp), rtol=1e-12, atol=1e-9)
