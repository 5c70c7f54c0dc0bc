"""Numba loops that bin points to cells."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from meshreg.jit import jit, prange
from meshreg.records import Bool, Float32, Float64, Int32, UInt8

Int64 = NDArray[np.int64]
_CHUNK = 65536
_PARTS = 64  # into which the points are cut for sorting


class SortedPoints(NamedTuple):
    """Points in the order of blocks of cells: those of block b are ``starts[b]:starts[b + 1]``."""

    starts: Int64
    cells: Int32  # (n,)
    place: Float32  # (n, 3) from its cell's centre: east and south [cells]; height
    rgb: UInt8  # (n, 3), or (0, 3) without colors


class CellArrays(NamedTuple):
    """A raster's arrays, flat over the cells, to be written."""

    height: Float32
    lean: Float32  # (cells, 2): mean place of the points, east and south of the centre [cells]
    samples: NDArray[np.uint16]
    color: UInt8  # (cells, 3)
    color_valid: Bool


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
def sorted_points(
    cells: Int32, points: Float64, colors: UInt8, size: tuple[float, int, int], block: int
) -> SortedPoints:
    """Sort the points to blocks of `block` cells, keeping their order (a parallel counting sort).

    What lies in one block then fits in a core's cache. `colors` may be empty; `size` is the cell
    [m] and the raster's rows and columns.
    """
    step, n_cols, n_cells = size[0], size[2], size[1] * size[2]
    n_points, n_blocks = cells.shape[0], (n_cells + block - 1) // block
    places = np.zeros((_PARTS, n_blocks), np.int64)
    for part in prange(_PARTS):
        for i in range(part * n_points // _PARTS, (part + 1) * n_points // _PARTS):
            if cells[i] >= 0:
                places[part, cells[i] // block] += 1
    starts = np.zeros(n_blocks + 1, np.int64)
    total = 0
    for number in range(n_blocks):
        starts[number] = total
        for part in range(_PARTS):
            count = places[part, number]
            places[part, number] = total
            total += count
    starts[n_blocks] = total
    cell, spot = np.empty(total, np.int32), np.empty((total, 3), np.float32)
    rgb = np.empty((total if colors.shape[0] > 0 else 0, 3), np.uint8)
    for part in prange(_PARTS):
        for i in range(part * n_points // _PARTS, (part + 1) * n_points // _PARTS):
            if cells[i] >= 0:
                number = cells[i] // block
                place = places[part, number]
                places[part, number] = place + 1
                cell[place] = cells[i]
                row = cells[i] // n_cols
                spot[place, 0] = points[i, 0] / step - (cells[i] - row * n_cols) - 0.5
                spot[place, 1] = -points[i, 1] / step - row - 0.5
                spot[place, 2] = points[i, 2]
                if colors.shape[0] > 0:
                    rgb[place, 0] = colors[i, 0]
                    rgb[place, 1] = colors[i, 1]
                    rgb[place, 2] = colors[i, 2]
    return SortedPoints(starts, cell, spot, rgb)


@jit(parallel=True, nogil=True)
def top_means(points: SortedPoints, layer: float, block: int, out: CellArrays) -> None:
    """Mean height, place and color of the points within `layer` below each cell's highest."""
    starts, cells, place, rgb = points.starts, points.cells, points.place, points.rgb
    # Named outside the loop: numba 0.68 loses what is written through a tuple inside it.
    height, samples, color, color_valid = out.height, out.samples, out.color, out.color_valid
    lean = out.lean
    for number in prange(len(starts) - 1):
        first, size = number * block, min(block, height.shape[0] - number * block)
        top = np.full(size, -np.inf, np.float32)
        for i in range(starts[number], starts[number + 1]):
            cell = cells[i] - first
            top[cell] = max(top[cell], place[i, 2])
        sums = np.zeros((size, 7))  # count, height less the top, red, green, blue, east, south
        for i in range(starts[number], starts[number + 1]):
            cell = cells[i] - first
            below = place[i, 2] - top[cell]
            if below >= -layer:
                sums[cell, 0] += 1.0
                sums[cell, 1] += below
                sums[cell, 5] += place[i, 0]
                sums[cell, 6] += place[i, 1]
                if rgb.shape[0] > 0:
                    sums[cell, 2] += rgb[i, 0]
                    sums[cell, 3] += rgb[i, 1]
                    sums[cell, 4] += rgb[i, 2]
        for cell in range(size):
            count = sums[cell, 0]
            if count > 0.0:
                height[first + cell] = top[cell] + sums[cell, 1] / count
                samples[first + cell] = min(int(count), 65535)
                lean[first + cell, 0] = sums[cell, 5] / count
                lean[first + cell, 1] = sums[cell, 6] / count
                if rgb.shape[0] > 0:
                    color_valid[first + cell] = True
                    for k in range(3):
                        color[first + cell, k] = int(sums[cell, 2 + k] / count + 0.5)


@jit(parallel=True, nogil=True)
def centred(mean: Float32, lean: Float32, height: Float32, out: Float32) -> None:
    """Carry each cell's mean height from the mean place of its points to the cell's centre.

    Points on a lattice that is no divisor of the cell, or sparse ones, lie to one side of it, and
    on a slope that side is a height. ``out = mean - lean * slope``, the slope from `height`, which
    is what an earlier pass gave: between the cells on both sides, or to the only one there is.
    All are (H, W), NaN where empty, but `lean` (H, W, 2).
    """
    for row in prange(mean.shape[0]):
        for col in range(mean.shape[1]):
            out[row, col] = mean[row, col]
            if not math.isnan(mean[row, col]):
                out[row, col] -= _rise(height, lean, np.int64(row), col)


@jit(nogil=True)
def _rise(height: Float32, lean: Float32, row: Any, col: int) -> float:
    """How much higher the surface is at the mean place of a cell's points than at its centre."""
    rows, cols = height.shape
    total = 0.0
    for axis in range(2):
        i, j = axis, 1 - axis
        low_row, low_col, high_row, high_col = row, col, row, col
        if row - i >= 0 and col - j >= 0 and not math.isnan(height[row - i, col - j]):
            low_row, low_col = row - i, col - j
        if row + i < rows and col + j < cols and not math.isnan(height[row + i, col + j]):
            high_row, high_col = row + i, col + j
        steps = high_row - low_row + high_col - low_col
        if steps > 0:
            rise = height[high_row, high_col] - height[low_row, low_col]
            total += rise / steps * lean[row, col, axis]
    return total
