"""The covariance of a fit whose neighbouring residuals err alike.

Taken one by one, thousands of cells or tiles would claim a certainty that they do not have: ground
that is near to other ground is wrong by the same. Summed over blocks wider than that, they count as
often as they are independent (Huber 1967; White, Econometrica 48, 1980; by blocks: Liang and Zeger,
Biometrika 73, 1986).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.records import Float64


def block_sandwich(curvature: Float64, scores: Float64, block: Any, lost: int) -> Float64:
    """Covariance (P, P) of P parameters, ``H⁻¹ (sum_b g_b g_b') H⁻¹ B / (B - lost)``.

    Parameters
    ----------
    curvature : (P, P) float64
        H, of the cost at the answer (or of a score at its peak: the sign is of no account).
    scores : (M, P) float64
        Each residual's share of the slope there.
    block : (M,) int
        Which block it belongs to; any numbers.
    lost : int
        Degrees of freedom that the fit has taken from the B blocks; never over four in five.
    """
    _, number = np.unique(block, return_inverse=True)
    count = int(number.max()) + 1
    sums = np.stack([np.bincount(number, column, count) for column in scores.T], axis=1)
    sums -= sums.mean(axis=0)  # zero at the answer but for where the fit has stopped
    inverse = np.linalg.pinv(curvature, hermitian=True)
    freedom = count / max(count - lost, 0.2 * count)
    return np.asarray(inverse @ (sums.T @ sums) @ inverse * freedom)
