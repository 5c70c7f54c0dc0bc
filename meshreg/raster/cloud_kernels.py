"""Numba loops that bin points to cells."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from meshreg.jit import jit, prange
from meshreg.types import Bool, Float32, Float64, Int32, UInt8

_CHUNK = 65536


@jit(parallel=True, nogil=True)
def cells_of(points: Float64, keep: Bool, cell: float, shape: tuple[int, int]) -> tuple[Int32, int]:
    """Index of each point's cell (row major, -1 outside); count of the points not finite.

    Points are metres east and north of the raster's north-west corner. A point on the outer edge
    in the south or east belongs to the last cell.
    """
    n_points = points.shape[0]
    rows, cols = shape
    out = np.empty(n_points, np.int32)
    n_chunks = (n_points + _CHUNK - 1) // _CHUNK
    broken = np.zeros(n_chunks, np.int64)
    for chunk in prange(n_chunks):
        for i in range(chunk * _CHUNK, min(n_points, (chunk + 1) * _CHUNK)):
            x, y = points[i, 0] / cell, -points[i, 1] / cell
            out[i] = -1
            if not math.isfinite(x + y + points[i, 2]):
                broken[chunk] += 1
                continue
            inside = -1e-6 <= x <= cols + 1e-6 and -1e-6 <= y <= rows + 1e-6
            if inside and (keep.size == 0 or keep[i]):
                row, col = min(int(max(y, 0.0)), rows - 1), min(int(max(x, 0.0)), cols - 1)
                out[i] = row * cols + col
    return out, broken.sum()


@jit(parallel=True, nogil=True)
def top_sums(
    cells: Int32, points: Float64, colors: UInt8, layer: float, first: int, bounds: Int32
) -> Float32:
    """Sum up, for the cells `first` and on, the points within `layer` below each cell's highest.

    A row of the result is (highest, count, sum of heights less the highest, red, green, blue).
    Worker w looks at all points and keeps the cells `bounds[w]` to `bounds[w + 1]` (counted from
    `first`): each cell's sum is taken by one worker in the points' order, however many there are.
    """
    sums = np.zeros((bounds[-1], 8), np.float32)  # a row to half a cache line
    sums[:, 0] = -np.inf
    colored = colors.shape[0] > 0
    for worker in prange(len(bounds) - 1):
        low, high = bounds[worker], bounds[worker + 1]
        for i in range(points.shape[0]):
            cell = cells[i] - first
            if low <= cell < high:
                sums[cell, 0] = max(sums[cell, 0], np.float32(points[i, 2]))
        for i in range(points.shape[0]):
            cell = cells[i] - first
            if low <= cell < high:
                below = np.float32(points[i, 2]) - sums[cell, 0]
                if below >= -layer:
                    sums[cell, 1] += 1.0
                    sums[cell, 2] += below
                    if colored:
                        sums[cell, 3] += colors[i, 0]
                        sums[cell, 4] += colors[i, 1]
                        sums[cell, 5] += colors[i, 2]
    return sums


@jit(parallel=True, nogil=True)
def cell_means(
    sums: Float32, height: Float32, samples: NDArray[np.uint16], color: UInt8, color_valid: Bool
) -> None:
    """Turn sums into means; `color` may be empty, all arrays are flat over the cells."""
    for cell in prange(sums.shape[0]):
        count = sums[cell, 1]
        if count > 0.0:
            height[cell] = sums[cell, 0] + sums[cell, 2] / count
            samples[cell] = min(int(count), 65535)
            if color.shape[0] > 0:
                color_valid[cell] = True
                for k in range(3):
                    color[cell, k] = int(sums[cell, 3 + k] / count + 0.5)
