"""Tukey's biweight."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from meshreg.statistics import biweight


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
