"""Weights of robust fits."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.records import Float64


def biweight(ratio: Any) -> Float64:
    """Return Tukey's biweight ``(1 - u²)²``, 0 beyond ``|u| = 1``.

    `ratio` is a residual over the size at which it counts no more. Beaton and Tukey (1974).
    """
    return np.asarray(np.clip(1 - np.asarray(ratio) ** 2, 0, None) ** 2)
