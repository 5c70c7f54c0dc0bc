"""`scripts/closures.py`: what its numbers are, on networks whose truth is known."""

from __future__ import annotations

import importlib.util
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def closures():
    spec = importlib.util.spec_from_file_location("closures", ROOT / "scripts" / "closures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def network(rng, stated, dates=6):
    """Offsets of all pairs of dates that err by a unit along each axis, and what is stated."""
    at = rng.normal(0, 5, (dates, 3))
    covariance = np.diag(np.full(3, stated**2))
    return {
        (i, j): (at[j] - at[i] + rng.normal(0, 1, 3), covariance)
        for i, j in itertools.combinations(range(dates), 2)
    }


@pytest.mark.parametrize("stated", [1.0, 3.0])
def test_ratio_is_one_where_the_bars_are_true(closures, stated):
    rng = np.random.default_rng(0)
    found = [closures.adjusted(network(rng, stated), [0, 1]) for _ in range(200)]
    assert {f["freedom"] for f in found} == {20}
    assert found[0]["upper"] == pytest.approx(1.57, abs=0.005)
    ratios = stated**2 * np.array([f["ratio"] for f in found])
    assert ratios.mean() == pytest.approx(1.0, abs=0.07)
    assert ratios.var() == pytest.approx(2 / 20, rel=0.35)
    up = closures.adjusted(network(rng, stated), [2])
    assert up["freedom"] == 10
    assert up["upper"] == pytest.approx(chi2.ppf(0.95, 10) / 10)


def test_offsets_that_close_leave_nothing(closures):
    at = np.random.default_rng(1).normal(0, 5, (4, 3))
    exact = {
        (i, j): (at[j] - at[i], np.eye(3) * 1e-4) for i, j in itertools.combinations(range(4), 2)
    }
    exact.pop((1, 3))
    found = closures.adjusted(exact, [0, 1])
    assert found["freedom"] == 4
    assert found["ratio"] < 1e-12


def test_scatter_about_the_mean(closures):
    rng = np.random.default_rng(2)
    total = [
        closures.scattered([(rng.normal(0, 2, 3), np.eye(3) * 4.0) for _ in range(6)])
        for _ in range(300)
    ]
    assert {freedom for _, freedom in total} == {10}
    assert np.mean([chi for chi, _ in total]) / 10 == pytest.approx(1.0, abs=0.08)


def test_dates_are_found_by_name(closures, tmp_path):
    for name in ("b_dsm.tif", "b_ortho.tif", "a_dem.tif", "b.obj", "c.laz", "c.txt", "LICENSE"):
        (tmp_path / name).write_bytes(b"")
    found = closures.dates_in([tmp_path])
    assert list(found) == ["a", "b", "c"]
    assert found["b"] == f"{tmp_path / 'b_dsm.tif'},{tmp_path / 'b_ortho.tif'}"
    assert found["a"] == str(tmp_path / "a_dem.tif")
    assert found["c"] == str(tmp_path / "c.laz")
