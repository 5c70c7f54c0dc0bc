"""The sum of tiles' surfaces at every offset, for one turn and scale after another."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.jit import jit, prange

SCORED = 1 << 20  # what a scored cell counts in a packed surface; below it lies its value
BIAS = 256  # added to a value so that it is never negative; the values are within ±BIAS


@jit(parallel=True)
def strongest(packed: Any, shifts: Any, split: int, least: Any, reach: int) -> Any:
    """Strongest hypothesis at each offset, for all tiles and for each channel's alone.

    Parameters
    ----------
    packed : (M, K, K) int32
        ``SCORED + BIAS + value`` of each tile at each offset; 0 where it is not scored. M is under
        4096, so that the values' sum stays below SCORED.
    shifts : (H, M, 2) int64
        First row and column of the searched window in each tile's surface, for each hypothesis.
    split : int
        Tiles before it are one channel's, from it on the other's.
    least : (3,) int64
        Tiles that must be scored: of all, of the first channel, of the second.
    reach : int
        The window has 2 reach + 1 rows and columns.

    Returns
    -------
    highest : (3, N, N) float32
        Sum of the values over the root of the tiles that are scored; -inf where they are too few.
    choice : (3, N, N) int32
        The hypothesis that is so high; the first of several.
    """
    size = 2 * reach + 1
    tiles, hypotheses = packed.shape[0], shifts.shape[0]
    highest = np.full((3, size, size), -np.inf, np.float32)
    choice = np.zeros((3, size, size), np.int32)
    for row in prange(size):
        sums = np.empty((2, size), np.int32)
        for number in range(hypotheses):
            sums[:] = 0
            for tile in range(tiles):
                line = packed[tile, row + shifts[number, tile, 0]]
                first = shifts[number, tile, 1]
                part = line[first : first + size]
                into = sums[0] if tile < split else sums[1]
                for col in range(size):
                    into[col] += part[col]
            for col in range(size):
                one, other = sums[0, col], sums[1, col]
                for which in range(3):
                    total = one + other if which == 0 else (one if which == 1 else other)
                    count = total // SCORED
                    if count >= least[which]:
                        value = np.float32(total - count * (SCORED + BIAS)) / np.sqrt(
                            np.float32(count)
                        )
                        if value > highest[which, row, col]:
                            highest[which, row, col] = value
                            choice[which, row, col] = number
    return highest, choice
