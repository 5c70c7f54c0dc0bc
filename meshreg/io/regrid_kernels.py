"""The loop of `meshreg.io.regrid`, compiled. Its slow twin is in tests/reference_regrid.py."""

# ruff: noqa: PLR0913, PLR0917  (a kernel takes plain arrays, not records)

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.jit import jit, prange


@jit(nogil=True)
def _bilinear(
    values: Any, valid: Any, back: Any, x: float, y: float, channel: int
) -> tuple[float, bool]:
    """Return one channel at file x, y: the weighted mean of the valid among four pixels."""
    rows, cols = valid.shape
    col = back[0, 0] * x + back[0, 1] * y + back[0, 2] - 0.5
    row = back[1, 0] * x + back[1, 1] * y + back[1, 2] - 0.5
    # In doubles first: what is far outside would not fit an integer.
    near_row, near_col = np.rint(row), np.rint(col)
    if not (0 <= near_row < rows and 0 <= near_col < cols):
        return 0.0, False
    if not valid[int(near_row), int(near_col)]:
        return 0.0, False
    top, left = int(np.floor(row)), int(np.floor(col))
    down, right = row - top, col - left
    total, weight = 0.0, 0.0
    for i in range(2):
        r = min(max(top + i, 0), rows - 1)
        for j in range(2):
            c = min(max(left + j, 0), cols - 1)
            share = (down if i else 1.0 - down) * (right if j else 1.0 - right)
            if valid[r, c] and share > 0:
                total += share * values[r, c, channel]
                weight += share
    return total / weight, True


@jit(parallel=True, nogil=True)
def resample(
    values: Any,
    valid: Any,
    back: Any,
    nodes: Any,
    step: int,
    surface: Any,
    surface_valid: Any,
    surface_back: Any,
    lean: Any,
    gain: float,
    level: float,
    is_height: bool,
    out: Any,
    seen: Any,
) -> None:
    """Fill `out` (R, C, K) and `seen` (R, C) from `values` (H, W, K) and `valid` (H, W).

    Parameters
    ----------
    back, surface_back : (2, 3) float64
        File x, y, 1 to col, row of outer pixel corners.
    nodes : (rows, cols, 3) float64
        File x, y and absolute up at `level`, every `step` cells from the first cell centre.
    surface, surface_valid : (h, w, 1), (h, w)
        Heights that shift points sideways by `lean` a unit; empty where nothing leans.
    """
    rows, cols, channels = out.shape
    for row in prange(rows):
        node_row = row // step
        down = (row - node_row * step) / step
        for col in range(cols):
            node_col = col // step
            right = (col - node_col * step) / step
            place = np.zeros(3)
            for k in range(3):
                upper = nodes[node_row, node_col, k] * (1 - right)
                upper += nodes[node_row, node_col + 1, k] * right
                lower = nodes[node_row + 1, node_col, k] * (1 - right)
                lower += nodes[node_row + 1, node_col + 1, k] * right
                place[k] = upper * (1 - down) + lower * down
            x, y = place[0], place[1]
            height = level
            if surface.shape[0] > 0:
                for _ in range(3):  # a contraction by tilt times slope
                    lift = height - level
                    found, known = _bilinear(
                        surface,
                        surface_valid,
                        surface_back,
                        x + lean[0] * lift,
                        y + lean[1] * lift,
                        0,
                    )
                    if known:
                        height = found
                x += lean[0] * (height - level)
                y += lean[1] * (height - level)
            for k in range(channels):
                value, ok = _bilinear(values, valid, back, x, y, k)
                seen[row, col] = ok
                if is_height:
                    out[row, col, k] = place[2] + gain * (value - level) if ok else np.nan
                else:
                    out[row, col, k] = np.rint(value)
