"""The probability of a right answer: a curve fitted to pairs whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from meshreg import calibration
from meshreg.benchmark import tables


def drawn(seed, same=4000, other=6000, intercept=-5.0, slope=1.8):
    """Pairs whose chance of being right follows a known curve, for equal numbers of both kinds."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0, 9, same + other)
    alike = np.arange(same + other) < same
    # other places are never right: were both kinds as frequent, of `same` pairs at this depth
    # twice the curve's share must be right, which bounds the curve by a half
    share = np.minimum(2 / (1 + np.exp(-(intercept + slope * depth))), 1.0)
    right = alike & (rng.random(same + other) < share)
    return 10.0**-depth, right, alike


def test_the_fit_finds_a_curve_that_made_the_pairs():
    """Without other places: plain logistic regression, against the curve that was drawn from."""
    rng = np.random.default_rng(3)
    depth = rng.uniform(0, 9, 20_000)
    right = rng.random(depth.size) < 1 / (1 + np.exp(-(-5.0 + 1.8 * depth)))
    found = calibration.fit(10.0**-depth, right, np.ones(depth.size, bool))
    assert found["intercept"] == pytest.approx(-5.0, abs=0.3)
    assert found["slope"] == pytest.approx(1.8, abs=0.1)
    assert (found["same"], found["other"]) == (20_000, 0)


def test_both_kinds_weigh_alike_however_many_there_are():
    few, many = (drawn(1, other=n) for n in (6_000, 60_000))
    a, b = calibration.fit(*few), calibration.fit(*many)
    assert a["slope"] == pytest.approx(b["slope"], rel=0.05)
    assert a["intercept"] == pytest.approx(b["intercept"], rel=0.05)
    assert b["other"] == 60_000


def test_what_is_parted_cleanly_does_not_become_a_step():
    alarms = [0.5, 0.2, 1e-9, 1e-12]
    found = calibration.fit(alarms, [False, False, True, True], [False, False, True, True])
    assert 0 < found["slope"] <= calibration.STEEPEST
    assert found["largest"] == 0.5  # two pairs show nothing
    assert math.isfinite(found["intercept"])


def test_the_package_curve_rises_and_keeps_its_bounds():
    alarms = [1.0, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-9, 1e-20, 1e-300, 0.0]
    values = [calibration.probability(alarm) for alarm in alarms]
    assert values == sorted(values)
    assert 0 < values[0] < 0.02
    assert 0.95 < values[-1] < 1
    assert values[6] > 0.9  # what may be accepted
    assert "synthetic" in calibration.basis()


def test_a_run_calibrates_on_its_crossings_and_different_places_alone():
    base = {"method": "fused", "preset": "robust"}
    rows = [
        base | {"kind": "crossing", "false_alarm": 1e-12, "success": 1},
        base | {"kind": "ladder", "false_alarm": 1e-3, "success": 0},
        base | {"kind": "elsewhere", "false_alarm": 0.3, "success": None},
        base | {"kind": "elsewhere", "false_alarm": None, "success": None},
        base | {"kind": "scenario", "false_alarm": 1e-12, "success": 0},
        base | {"kind": "crossing", "preset": "paper", "false_alarm": 0.1, "success": 1},
        base | {"kind": "crossing", "method": "sift", "false_alarm": 0.1, "success": 1},
    ]
    found = tables.calibrated(rows)
    assert (found["same"], found["other"]) == (2, 1)
