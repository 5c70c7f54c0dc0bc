"""Weights and scales of robust fits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshreg.statistics import biweight, half_scale


@given(st.floats(-1e3, 1e3))
def test_it_is_the_slope_of_its_loss_over_the_residual(ratio: float) -> None:
    """Loss ``(1 - (1 - u²)³) / 6`` within 1: its slope is ``u (1 - u²)²`` (Huber and Ronchetti)."""
    step = 1e-5

    def loss(u: float) -> float:
        return (1 - max(1 - u * u, 0.0) ** 3) / 6

    slope = (loss(ratio + step) - loss(ratio - step)) / (2 * step)
    assert abs(slope - ratio * float(biweight(ratio))) < 1e-6
    assert 0 <= biweight(ratio) <= 1


def test_known_values() -> None:
    np.testing.assert_array_equal(biweight([0.0, 1.0, -1.0, 2.0]), [1, 0, 0, 0])
    np.testing.assert_allclose(biweight([0.5, -0.5]), 0.5625, rtol=1e-15)


@given(st.integers(0, 1000), st.floats(0.01, 10.0))
def test_the_shortest_half_tells_the_sigma_of_normal_values_and_of_the_larger_group(
    seed: int, sigma: float
) -> None:
    rng = np.random.default_rng(seed)
    one = rng.normal(3.0, sigma, 4000)
    assert abs(half_scale(one) / sigma - 1) < 0.12
    two = np.append(one, rng.normal(3.0 + 40 * sigma, sigma, 2000))
    # half of all are three quarters of the larger group: its shortest such interval is 1.7 as long
    assert 1.4 < half_scale(two) / sigma < 2.0
    assert half_scale(two + 7.0) == pytest.approx(half_scale(two), rel=1e-9)
