"""How probable it is that an answer is right: as calibrated on synthetic pairs, and only so.

The chance of a false alarm is measured on the pair itself and does not say how often pairs of the
same place are met at all. `meshreg benchmark` counts both on seafloors whose truth is known, half
and half, and fits a logistic regression on its logarithm. The `calibration.json` that a whole run
writes becomes the package's by copying it.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

FILE = Path(__file__).parent / "calibration.json"
STEEPEST = 5.0  # natural logarithms of the odds per power of ten
DEEPEST = 10.0  # -log10 of the false alarm; what is beyond it is all alike


def probability(false_alarm: float) -> float:
    """Return the probability that an answer with this chance of a false alarm is right.

    Never beyond what a number of pairs can show: with n right ones and no wrong one, 1 - 3 / n
    (the rule of three), and as much above 0 for wrong ones.
    """
    known = _known()
    at = known["intercept"] + known["slope"] * _depth(false_alarm)
    return float(np.clip(1.0 / (1.0 + math.exp(-at)), known["smallest"], known["largest"]))


def basis() -> str:
    """Say what the probability was calibrated on."""
    known = _known()
    return (
        f"calibrated on synthetic pairs: {known['same']} of the same place, {known['other']} of "
        "different places, as if either were as frequent"
    )


def fit(
    false_alarms: Sequence[float], right: Sequence[bool], same: Sequence[bool]
) -> Mapping[str, Any]:
    """Fit the curve to pairs whose truth is known.

    Parameters
    ----------
    false_alarms : (N,) float
    right : (N,) bool
        Whether the answer lay within 0.25 m of the truth; False for different places.
    same : (N,) bool
        Whether the pair shows the same place; both kinds weigh alike.

    Returns
    -------
    mapping
        What `calibration.json` holds.
    """
    from scipy.optimize import minimize

    depth = np.array([_depth(value) for value in false_alarms])
    good, alike = np.asarray(right, bool), np.asarray(same, bool)
    weight = np.where(alike, 0.5 / max(alike.sum(), 1), 0.5 / max((~alike).sum(), 1))

    def loss(curve: Any) -> tuple[float, Any]:
        at = curve[0] + curve[1] * depth
        slack = np.logaddexp(0, at) - good * at
        pull = weight * (1 / (1 + np.exp(-at)) - good)
        return float(weight @ slack), np.array([pull.sum(), pull @ depth])

    # where nothing lies between the right and the wrong ones the curve would be a step
    bounds = [(None, None), (0, STEEPEST)]
    found = minimize(loss, np.array([-3.0, 1.0]), jac=True, bounds=bounds)
    return {
        "intercept": float(found.x[0]),
        "slope": float(found.x[1]),
        "smallest": 3 / max(int((~good).sum()), 6),
        "largest": 1 - 3 / max(int(good.sum()), 6),
        "same": int(alike.sum()),
        "other": int((~alike).sum()),
    }


def _depth(false_alarm: float) -> float:
    return min(-math.log10(max(false_alarm, 1e-300)), DEEPEST)


@functools.cache
def _known() -> Mapping[str, Any]:
    known: Mapping[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return known
