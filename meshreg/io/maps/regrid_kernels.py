"""The loop of `meshreg.io.maps.regrid`, compiled. Slow twin: tests/helpers/reference_regrid.py."""

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


@jit(nogil=True)
def _between(nodes: Any, row: int, col: int, down: float) -> tuple[float, float, float]:
    """Return file x, y and absolute up between two rows of nodes."""
    upper, lower = nodes[row, col], nodes[row + 1, col]
    return (
        upper[0] * (1 - down) + lower[0] * down,
        upper[1] * (1 - down) + lower[1] * down,
        upper[2] * (1 - down) + lower[2] * down,
    )


@jit(nogil=True)
def _misses(
    back: Any, shape: tuple[int, int], start: tuple[float, ...], end: tuple[float, ...]
) -> bool:
    """Whether the line between two places in the file, x, y, passes a raster on one side."""
    for axis, size in ((0, shape[1]), (1, shape[0])):
        one = back[axis, 0] * start[0] + back[axis, 1] * start[1] + back[axis, 2]
        two = back[axis, 0] * end[0] + back[axis, 1] * end[1] + back[axis, 2]
        if max(one, two) < -1.0 or min(one, two) > size + 1.0:
            return True
    return False


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
        for node_col in range((cols - 1) // step + 1):
            start = _between(nodes, node_row, node_col, down)
            end = _between(nodes, node_row, node_col + 1, down)
            first, last = node_col * step, min((node_col + 1) * step, cols)
            if surface.shape[0] == 0 and _misses(back, valid.shape, start, end):
                for col in range(first, last):
                    seen[row, col] = False
                    for k in range(channels):
                        out[row, col, k] = np.nan if is_height else 0
                continue
            for col in range(first, last):
                right = (col - first) / step
                x = start[0] * (1 - right) + end[0] * right
                y = start[1] * (1 - right) + end[1] * right
                up = start[2] * (1 - right) + end[2] * right
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
                        out[row, col, k] = up + gain * (value - level) if ok else np.nan
                    else:
                        out[row, col, k] = np.rint(value)
