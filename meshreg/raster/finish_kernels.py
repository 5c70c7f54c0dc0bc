"""Numba loops on finished rasters: block means, small holes, calm color."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meshreg.jit import jit, prange
from meshreg.records import Bool, Float32, Int32, UInt8

UInt16 = NDArray[np.uint16]
Int64 = NDArray[np.int64]


@jit(parallel=True, nogil=True)
def block_heights(
    height: Float32, valid: Bool, samples: UInt16, times: int, least: int,
    out: Float32, out_valid: Bool, out_samples: UInt16,
) -> None:  # fmt: skip
    """Average heights over blocks of `times` × `times` cells with at least `least` valid ones."""
    rows, cols = height.shape
    for row in prange(out.shape[0]):
        for col in range(out.shape[1]):
            total, count, behind = 0.0, 0, 0
            for i in range(row * times, min((row + 1) * times, rows)):
                for j in range(col * times, min((col + 1) * times, cols)):
                    if valid[i, j]:
                        total += height[i, j]
                        count += 1
                        behind += samples[i, j]
            out_valid[row, col] = count >= least
            out[row, col] = total / count if count >= least else np.nan
            out_samples[row, col] = min(behind, 65535) if count >= least else 0


@jit(parallel=True, nogil=True)
def block_colors(
    color: UInt8, valid: Bool, times: int, least: int, out: UInt8, out_valid: Bool
) -> None:
    """Average colors over blocks of `times` × `times` cells with at least `least` valid ones."""
    rows, cols = valid.shape
    for row in prange(out.shape[0]):
        for col in range(out.shape[1]):
            red, green, blue, count = 0, 0, 0, 0
            for i in range(row * times, min((row + 1) * times, rows)):
                for j in range(col * times, min((col + 1) * times, cols)):
                    if valid[i, j]:
                        red += color[i, j, 0]
                        green += color[i, j, 1]
                        blue += color[i, j, 2]
                        count += 1
            out_valid[row, col] = count >= least
            if count >= least:
                half = count // 2
                out[row, col, 0] = (red + half) // count
                out[row, col, 1] = (green + half) // count
                out[row, col, 2] = (blue + half) // count


@jit(parallel=True, nogil=True)
def lone_gaps(valid: Bool) -> Bool:
    """Find the empty cells whose eight neighbours all hold data."""
    rows, cols = valid.shape
    gaps = np.zeros((rows, cols), np.bool_)
    for row in prange(1, rows - 1):
        for col in range(1, cols - 1):
            if not valid[row, col]:
                around = 0
                for i in range(row - 1, row + 2):
                    for j in range(col - 1, col + 2):
                        around += valid[i, j]
                gaps[row, col] = around == 8
    return gaps


@jit(parallel=True, nogil=True)
def neighbour_means(
    places: Int64, height: Float32, valid: Bool, color: UInt8, color_valid: Bool
) -> tuple[Float32, UInt8, Bool]:
    """Mean height and color of the valid cells among the eight neighbours of each place (M, 2).

    The height is NaN where there is none. The last is True where at least half of those
    neighbours have a color.
    """
    rows, cols = valid.shape
    heights = np.empty(len(places), np.float32)
    colors = np.zeros((len(places), 3), np.uint8)
    colored = np.zeros(len(places), np.bool_)
    for m in prange(len(places)):
        row, col = places[m, 0], places[m, 1]
        total, count, seen = 0.0, 0, 0
        red, green, blue = 0, 0, 0
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(col - 1, 0), min(col + 2, cols)):
                if valid[i, j]:
                    total += height[i, j]
                    count += 1
                    if color_valid[i, j]:
                        red += color[i, j, 0]
                        green += color[i, j, 1]
                        blue += color[i, j, 2]
                        seen += 1
        heights[m] = total / count if count > 0 else np.nan
        if seen > 0 and 2 * seen >= count:
            colors[m, 0] = (red + seen // 2) // seen
            colors[m, 1] = (green + seen // 2) // seen
            colors[m, 2] = (blue + seen // 2) // seen
            colored[m] = True
    return heights, colors, colored


@jit(parallel=True, nogil=True)
def calm_cells(color: UInt8, still: Bool) -> Bool:
    """Find the cells that are still and have exactly the color of their four still neighbours."""
    rows, cols = still.shape
    calm = np.zeros((rows, cols), np.bool_)
    for row in prange(1, rows - 1):
        for col in range(1, cols - 1):
            if not still[row, col]:
                continue
            same = True
            for i, j in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
                same = same and still[i, j]
                for k in range(3):
                    same = same and color[i, j, k] == color[row, col, k]
            calm[row, col] = same
    return calm


@jit(nogil=True)
def color_counts(color: UInt8, where: Bool) -> Int32:
    """Count each of the 16,777,216 colors (red × 65536 + green × 256 + blue) among the cells."""
    counts = np.zeros(1 << 24, np.int32)
    for row in range(where.shape[0]):
        for col in range(where.shape[1]):
            if where[row, col]:
                red, green = int(color[row, col, 0]), int(color[row, col, 1])
                counts[(red << 16) + (green << 8) + int(color[row, col, 2])] += 1
    return counts
