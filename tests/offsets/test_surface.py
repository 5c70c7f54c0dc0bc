"""Peaks of surfaces whose top is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshreg.offsets.surface import find_peak, gap_at

EAST = np.arange(-40, 41) * 0.1
NORTH = -EAST


def hill(east, north, width=0.3, height=1.0, stretch=1.0):
    d_east, d_north = EAST[None, :] - east, (NORTH[:, None] - north) / stretch
    return height * np.exp(-0.5 * (d_east**2 + d_north**2) / width**2)


@settings(max_examples=50, deadline=None)
@given(st.floats(-3.5, 3.5), st.floats(-3.5, 3.5))
def test_sub_cell_peak(east, north):
    peak = find_peak(hill(east, north), EAST, NORTH, 0.5)
    assert peak is not None
    assert peak.east == pytest.approx(east, abs=0.002)
    assert peak.north == pytest.approx(north, abs=0.002)


def test_gap_counts_in_robust_deviations():
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.01, (81, 81))
    surface = noise + hill(1.0, 0.5) + hill(-2.0, -1.5, height=0.6)
    peak = find_peak(surface, EAST, NORTH, 0.5)
    assert peak is not None
    far = np.hypot(EAST[None] - 1.0, NORTH[:, None] - 0.5) > 1.0
    spread = 1.4826 * np.median(np.abs(surface[far] - np.median(surface[far])))
    assert peak.gap == pytest.approx(0.4 / spread, rel=0.15)
    assert np.hypot(peak.second[0] + 2.0, peak.second[1] + 1.5) < 0.15


def test_a_broad_peak_is_not_its_own_rival():
    """A 1 m wide hill alone has no rival at 0.6 m, whatever the exclusion asked for."""
    noise = np.random.default_rng(1).normal(0, 0.002, (81, 81))
    peak = find_peak(hill(0.3, 0.2, width=0.7) + noise, EAST, NORTH, 0.5)
    assert peak is not None
    assert peak.second is not None
    assert np.hypot(peak.second[0] - 0.3, peak.second[1] - 0.2) > 1.3


def test_sigma_is_the_scatter_of_the_peak():
    """Over many noises the stated sigma is what the peak really scatters by."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(2)
    found, stated = [], []
    for _ in range(200):
        noise = gaussian_filter(rng.normal(size=(81, 81)), 2.0)
        noise *= 0.1 / noise.std()
        peak = find_peak(hill(0.03, -0.04, width=0.25, stretch=1.6) + noise, EAST, NORTH, 0.5)
        found.append((peak.east - 0.03, peak.north + 0.04))
        stated.append(peak.sigma)
    scatter = np.cov(np.array(found).T)
    mean = np.median(np.array(stated), axis=0)
    for axis in (0, 1):
        assert 0.6 < np.sqrt(mean[axis, axis] / scatter[axis, axis]) < 1.6
    assert np.sqrt(mean[1, 1] / mean[0, 0]) > 1.2  # the stretched axis is the less certain


def test_border_and_holes_are_said():
    assert find_peak(hill(3.99, 0), EAST, NORTH, 0.5).border
    assert not find_peak(hill(3.5, 0), EAST, NORTH, 0.5).border
    surface = hill(1.0, 1.0)
    surface[NORTH > 1.05] = np.nan
    assert find_peak(surface, EAST, NORTH, 0.5).border
    assert find_peak(np.full((81, 81), np.nan), EAST, NORTH, 0.5) is None


def test_gap_at_is_negative_where_another_hill_is_higher():
    rng = np.random.default_rng(3)
    surface = hill(1.0, 0.5) + hill(-2.0, -1.5, height=0.6) + rng.normal(0, 0.01, (81, 81))
    gap, value, place = gap_at(surface, EAST, NORTH, (-2.05, -1.4), 0.25)
    assert gap < -10
    assert value == pytest.approx(0.6, abs=0.05)
    assert np.hypot(place[0] + 2.0, place[1] + 1.5) < 0.15
    assert gap_at(surface, EAST, NORTH, (1.1, 0.4), 0.25)[0] > 10
    assert gap_at(surface, EAST, NORTH, (99.0, 0.0), 0.25)[0] == -np.inf
