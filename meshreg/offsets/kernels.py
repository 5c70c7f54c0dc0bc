"""Compiled loops of the estimators. Readable twins: `tests/helpers/reference_offsets.py`."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.jit import jit, prange


@jit(parallel=True, nogil=True)
def direct_information(
    first: Any, second: Any, rows: Any, cols: Any, scored: Any, bins: int
) -> Any:
    """Mutual information (nat) of two level images for each offset; level `bins` is masked."""
    surface = np.zeros((len(rows), len(cols)))
    height1, width1 = first.shape
    height2, width2 = second.shape
    for i in prange(len(rows)):
        # bin `bins` takes the masked cells, so that the inner loop has no branch
        joint = np.zeros((bins + 1, bins + 1), np.int32)
        for j in range(len(cols)):
            if not scored[i, j]:
                continue
            joint[:] = 0
            shift_row, shift_col = rows[i], cols[j]
            first_col = max(0, -shift_col)
            last_col = min(width2, width1 - shift_col)
            for r in range(max(0, -shift_row), min(height2, height1 - shift_row)):
                for c in range(first_col, last_col):
                    joint[first[r + shift_row, c + shift_col], second[r, c]] += 1
            surface[i, j] = _information(joint, bins)
    return surface


@jit(nogil=True)
def _information(joint: Any, bins: int) -> float:
    """H1 + H2 - H12 of the counts in the first `bins` rows and columns."""
    total = 0
    joint_sum = 0.0
    marginal = np.zeros(bins, np.int64)
    marginal_sum = 0.0
    for a in range(bins):
        row = 0
        for b in range(bins):
            count = joint[a, b]
            if count > 0:
                row += count
                marginal[b] += count
                joint_sum += count * np.log(count)
        if row > 0:
            marginal_sum += row * np.log(row)
            total += row
    for b in range(bins):
        if marginal[b] > 0:
            marginal_sum += marginal[b] * np.log(marginal[b])
    if total == 0:
        return 0.0
    return float((joint_sum - marginal_sum) / total + np.log(total))


@jit(parallel=True, nogil=True)
def add_entropies(total: Any, marginal: Any, counts: Any, cols: Any, table: Any) -> None:
    """Take one level of the first image against all of the second's.

    With ``n_b = round(counts[b, :, cols])``, add ``sum over b of table[n_b]`` less the table at
    the sum of n_b to each cell of `total`, and n_b to `marginal` (K, L, B).
    """
    for i in prange(total.shape[0]):
        for j in range(len(cols)):
            whole, joint = 0, 0.0
            for b in range(counts.shape[0]):
                n = max(int(counts[b, i, cols[j]] + 0.5), 0)
                marginal[i, j, b] += n
                whole += n
                joint += table[n]
            total[i, j] += joint - table[whole]


@jit(parallel=True, nogil=True)
def subtract_marginals(total: Any, marginal: Any, table: Any) -> None:
    """Subtract ``sum over b of table[marginal[:, :, b]]`` from each cell of `total`."""
    for i in prange(total.shape[0]):
        for j in range(total.shape[1]):
            for b in range(marginal.shape[2]):
                total[i, j] -= table[marginal[i, j, b]]
