"""How widely numbers scatter, whatever some of them are."""

from __future__ import annotations

import numpy as np

from meshreg.records import Float64

MAD_TO_SIGMA = 1.4826


def nmad(values: Float64) -> float:
    """Normalised median absolute deviation (Höhle and Höhle 2009, section 3.2)."""
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))
