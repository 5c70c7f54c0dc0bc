"""Ground that has not changed, found without being told where it is: by majority.

Within a block of cells the ground is where most cells agree; among the blocks, what departs from
the slow bending of all the others, or from its neighbours, has changed as a whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meshreg.types import Bool, Float64

Index = NDArray[np.int_]
MAD_TO_SIGMA = 1.4826
HALF_WIDTH = 1.349  # the shortest half of a normal distribution is this many sigmas wide
CUT = 2.5  # sigmas; what lies further from a block's ground has changed
BLOCK_CUT = 4.0  # robust deviations at which a block is not believed
ROUNDING = 1e-9  # m


def block_grounds(
    difference: Float64, number: Index, count: int
) -> tuple[Float64, Index, Float64, Bool]:
    """Each block's ground [m], its cells, the share of them on that ground, and whether each is."""
    cells = np.bincount(number, minlength=count)
    order = np.lexsort((difference, number))
    first = np.concatenate([[0], np.cumsum(cells)[:-1]])
    place = np.arange(len(order)) - first[number[order]]
    values = np.full((count, int(cells.max())), np.inf)
    values[number[order], place] = difference[order]
    ground, sigma = shortest_half(values, cells)
    finite = np.isfinite(values)
    near = finite
    for _ in range(10):
        away = np.where(finite, np.abs(np.where(finite, values, 0.0) - ground[:, None]), np.inf)
        near = away <= CUT * sigma[:, None] + ROUNDING
        held = np.maximum(near.sum(axis=1), 1)
        ground = np.where(near, values, 0.0).sum(axis=1) / held
    member = np.empty(len(order), bool)
    member[order] = near[number[order], place]
    return ground, cells, near.sum(axis=1) / np.maximum(cells, 1), member


def shortest_half(values: Float64, cells: Index) -> tuple[Float64, Float64]:
    """Mean and sigma of the shortest half of each row of sorted values, padded with infinity."""
    half = (cells + 1) // 2
    start = np.arange(values.shape[1])[None, :]
    end = start + half[:, None] - 1
    fits = end < cells[:, None]
    upper = np.take_along_axis(values, np.minimum(end, values.shape[1] - 1), axis=1)
    lower = np.where(np.isfinite(values), values, 0.0)
    width = np.where(fits, upper - lower, np.inf)
    best = np.argmin(width, axis=1)
    total = np.concatenate([np.zeros((len(values), 1)), np.cumsum(lower, axis=1)], axis=1)
    rows = np.arange(len(values))
    mean = (total[rows, best + half] - total[rows, best]) / half
    return mean, width[rows, best] / HALF_WIDTH


def slow_bending(arm: Float64, weight: Float64, value: Float64) -> tuple[Float64, int]:
    """Slow bending of the models at the blocks [m], a cubic or less, and its number of terms.

    Least trimmed squares over half of the blocks, by concentration steps from a level start and
    from all blocks (Rousseeuw and Van Driessen 2006): up to half of the ground may have changed.
    """
    degree = int(np.clip(np.sqrt(0.2 * len(value)), 1, 3))
    x, y = (arm / np.abs(arm).max()).T
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    design = np.stack([x**i * y**j for i, j in powers], axis=1)
    half = max((len(value) + len(powers) + 1) // 2, len(powers) + 1)
    mode, _ = shortest_half(np.sort(value)[None, :], np.array([len(value)]))
    tried = []
    for start in (np.full(len(value), mode[0]), design @ least_squares(design, weight, value)):
        bent = start
        for _ in range(20):
            near = np.argsort(np.abs(value - bent), kind="stable")[:half]
            solved = least_squares(design[near], weight[near], value[near])
            before, bent = bent, design @ solved
            if np.abs(bent - before).max() < 1e-9:
                break
        tried.append((float(np.sort((value - bent) ** 2)[:half].sum()), bent))
    bent = min(tried, key=lambda trial: trial[0])[1]
    scale = MAD_TO_SIGMA * float(np.median(np.abs(value - bent)))
    kept = np.abs(value - bent) <= BLOCK_CUT * scale + ROUNDING
    return design @ least_squares(design[kept], weight[kept], value[kept]), len(powers)


def neighbours(lattice: Index, value: Float64) -> Float64:
    """Median of each block's 5 × 5 neighbourhood; NaN is left out, 0 where nothing is left."""
    from scipy.ndimage import generic_filter

    table = np.full(lattice.max(axis=0) + 1, np.nan)
    table[tuple(lattice.T)] = value
    filtered = generic_filter(table, _median_known, size=5, mode="constant", cval=np.nan)
    return np.asarray(filtered[tuple(lattice.T)])


def _median_known(values: Float64) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else 0.0


def numbered(row: Index, col: Index) -> tuple[Index, Index]:
    """Row and column (B, 2) of each block that holds cells, and each cell's block number."""
    width = int(col.max()) + 1
    names, number = np.unique(row * width + col, return_inverse=True)
    return np.stack([names // width, names % width], axis=1), number


def least_squares(design: Float64, weight: Float64, value: Float64) -> Float64:
    """Solution (P,) of a weighted linear fit; the shortest where there are many."""
    normal = (design * weight[:, None]).T @ design
    return np.asarray(np.linalg.lstsq(normal, (design * weight[:, None]).T @ value, rcond=None)[0])
