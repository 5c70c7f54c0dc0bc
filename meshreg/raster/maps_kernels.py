"""Numba loops that resample a DEM and an orthomosaic."""

from __future__ import annotations

import math

import numpy as np

from meshreg.jit import jit, prange
from meshreg.records import Bool, Float32, Float64, UInt8


@jit(nogil=True, inline="always")
def _corner(place: float, size: int) -> tuple[int, int, float]:
    """Return the two cells whose centres lie around `place`, and the share of the second.

    Within half a cell of the raster's edge both are the last cell; beyond, the first is -1.
    """
    if not -0.5 - 1e-6 <= place <= size - 0.5 + 1e-6:
        return -1, -1, 0.0
    place = min(max(place, 0.0), size - 1.0)
    # What is off a centre by less than a millionth is rounding: keep the cell's very value.
    if abs(place - round(place)) < 1e-6:
        place = float(round(place))
    first = math.floor(place)
    return first, min(first + 1, size - 1), place - first


@jit(parallel=True, nogil=True)
def resampled_heights(height: Float32, back: Float64, times: int, out: Float64) -> None:
    """Mean over `times`² bilinear samples per cell of `out`; NaN where under half have a value.

    `back` (2, 3) takes (column, row, 1) of the samples to (column, row) of `height`. A sample
    whose four cells are missing by half of their weight or more has no value.
    """
    rows, cols = height.shape
    least = max(1, (times * times + 1) // 2)
    for row in prange(out.shape[0]):
        for col in range(out.shape[1]):
            total, count = 0.0, 0
            for i in range(row * times, (row + 1) * times):
                for j in range(col * times, (col + 1) * times):
                    x = back[0, 0] * j + back[0, 1] * i + back[0, 2]
                    y = back[1, 0] * j + back[1, 1] * i + back[1, 2]
                    left, right, fx = _corner(x, cols)
                    top, bottom, fy = _corner(y, rows)
                    if left < 0 or top < 0:
                        continue
                    value, weight = 0.0, 0.0
                    for p, q, w in (
                        (top, left, (1.0 - fx) * (1.0 - fy)),
                        (top, right, fx * (1.0 - fy)),
                        (bottom, left, (1.0 - fx) * fy),
                        (bottom, right, fx * fy),
                    ):
                        if w > 0.0 and math.isfinite(height[p, q]):
                            value += w * height[p, q]
                            weight += w
                    if weight > 0.5:
                        total += value / weight
                        count += 1
            out[row, col] = total / count if count >= least else np.nan


@jit(parallel=True, nogil=True)
def resampled_colors(
    color: UInt8, valid: Bool, back: Float64, times: int, out: UInt8, out_valid: Bool
) -> None:
    """As `resampled_heights`, for colors."""
    rows, cols = valid.shape
    least = max(1, (times * times + 1) // 2)
    for row in prange(out_valid.shape[0]):
        for col in range(out_valid.shape[1]):
            red, green, blue, count = 0.0, 0.0, 0.0, 0
            for i in range(row * times, (row + 1) * times):
                for j in range(col * times, (col + 1) * times):
                    x = back[0, 0] * j + back[0, 1] * i + back[0, 2]
                    y = back[1, 0] * j + back[1, 1] * i + back[1, 2]
                    left, right, fx = _corner(x, cols)
                    top, bottom, fy = _corner(y, rows)
                    if left < 0 or top < 0:
                        continue
                    r, g, b, weight = 0.0, 0.0, 0.0, 0.0
                    for p, q, w in (
                        (top, left, (1.0 - fx) * (1.0 - fy)),
                        (top, right, fx * (1.0 - fy)),
                        (bottom, left, (1.0 - fx) * fy),
                        (bottom, right, fx * fy),
                    ):
                        if w > 0.0 and valid[p, q]:
                            r += w * color[p, q, 0]
                            g += w * color[p, q, 1]
                            b += w * color[p, q, 2]
                            weight += w
                    if weight > 0.5:
                        red, green, blue = red + r / weight, green + g / weight, blue + b / weight
                        count += 1
            if count >= least:
                out_valid[row, col] = True
                out[row, col, 0] = int(red / count + 0.5)
                out[row, col, 1] = int(green / count + 0.5)
                out[row, col, 2] = int(blue / count + 0.5)
