"""Ground that has not changed, found without being told where it is: by its detail, by majority.

Sand that has risen or fallen as a sheet may be most of what is seen, but it does not look the same
again: ground whose small relief recurs is the same ground. Within a block of such cells the ground
is where most of them agree; among the blocks, what a step parts from the others, or what departs
from its neighbours, has changed as a whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meshreg.records import Bool, Float64

Index = NDArray[np.int_]
HALF_WIDTH = 1.349  # the shortest half of a normal distribution is this many sigmas wide
QUARTER = 0.3186  # sigmas: a quarter of a normal distribution lies nearer to its middle
CUT = 2.5  # sigmas; what lies further from a block's ground has changed
BLOCK_CUT = 4.0  # robust deviations at which a block is not believed
ROUNDING = 1e-9  # m
DETAIL = 2.0  # cells: the mean around a cell, from which its detail is measured
SEEN = 7  # cells: side of the square over which detail is compared; a few of it are independent
RECURS = 0.6  # correlation there; by chance it is 0 +- 0.3


def recurring(first: Float64, second: Float64, known: Bool) -> Bool:
    """Return where two height maps on one grid show the same detail, (H, W) bool.

    Parameters
    ----------
    first, second : (H, W) float64
        Heights [m], any values where they are not `known`.
    known : (H, W) bool
    """
    from scipy.ndimage import gaussian_filter, uniform_filter

    weight = np.maximum(gaussian_filter(known.astype(np.float64), DETAIL, truncate=3.0), 1e-6)

    def detail(height: Float64) -> Float64:
        level = np.where(known, height - np.median(height[known]), 0.0)
        return np.where(known, level - gaussian_filter(level, DETAIL, truncate=3.0) / weight, 0.0)

    def around(products: Float64) -> Float64:
        return np.asarray(uniform_filter(products, SEEN, mode="constant"))

    one, other = detail(first), detail(second)
    size = around(one**2).clip(0) * around(other**2).clip(0)
    alike = np.divide(around(one * other), np.sqrt(size), out=np.zeros_like(one), where=size > 0)
    return np.asarray(known & (alike >= RECURS))


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


def largest_sheet(lattice: Index, value: Float64, weight: Float64, least: float = 0.0) -> Bool:
    """Return which blocks (B,) belong to the largest piece of ground without a step in it.

    Models bend, but they do not tear: ground that slid, fell or was heaped up as a whole stands
    apart from what is beside it by a step, however much both bend. A step is over four deviations
    of what two neighbours differ by as a rule, for each block's width between them.

    Parameters
    ----------
    lattice : (B, 2) int
        Row and column of each block, from 0.
    value : (B,) float64
        Its height difference [m].
    weight : (B,) float64
        Its size.
    least : float
        No lower step is one [m].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start, end, far = _beside(lattice)
    steps = np.abs(value[start] - value[end]) / far
    usual = float(np.quantile(steps, 0.25)) / QUARTER  # most steps may be at the rim of something
    joined = steps <= max(BLOCK_CUT * usual, least) + ROUNDING
    links = coo_array((far[joined], (start[joined], end[joined])), shape=2 * (len(lattice),))
    _, piece = connected_components(links, directed=False)
    return np.asarray(piece == np.argmax(np.bincount(piece, weight)))


def _beside(lattice: Index) -> tuple[Index, Index, Float64]:
    """Pairs of blocks with no other between them, across gaps too, and how far they are apart.

    Gabriel's graph (Gabriel and Sokal 1969): no third block in the circle about both.
    """
    from scipy.spatial import Delaunay, QhullError, cKDTree

    try:
        corners = Delaunay(lattice).simplices
    except QhullError:  # all in one line
        corners = Delaunay(lattice, qhull_options="QJ").simplices
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]))
    start, end = np.unique(edges, axis=0).T
    far = np.hypot(*(lattice[start] - lattice[end]).T)
    third, _ = cKDTree(lattice).query(0.5 * (lattice[start] + lattice[end]))
    kept = third >= 0.5 * far - ROUNDING
    return start[kept], end[kept], far[kept]


def slow_bending(arm: Float64, weight: Float64, value: Float64, told: Bool) -> tuple[Float64, int]:
    """Slow bending of the models at all blocks [m] and its number of terms, from those `told`.

    A cubic in both directions, or less where blocks are few.
    """
    degree = int(np.clip(np.sqrt(0.2 * told.sum()), 1, 3))
    x, y = (arm / np.abs(arm).max()).T
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    design = np.stack([x**i * y**j for i, j in powers], axis=1)
    return design @ least_squares(design[told], weight[told], value[told]), len(powers)


def neighbours(lattice: Index, value: Float64) -> Float64:
    """Median of each block's 5 × 5 neighbourhood; NaN is left out, and the answer without any."""
    table = np.full(lattice.max(axis=0) + 5, np.nan)
    table[tuple(lattice.T + 2)] = value
    windows = np.lib.stride_tricks.sliding_window_view(table, (5, 5))
    near = np.sort(windows[tuple(lattice.T)].reshape(-1, 25))  # NaN comes last
    known = np.isfinite(near).sum(axis=1)
    middle = [(known - 1) // 2, known // 2]  # of none: the last, which is NaN
    return np.asarray(0.5 * np.take_along_axis(near, np.stack(middle, 1), axis=1).sum(axis=1))


def numbered(row: Index, col: Index) -> tuple[Index, Index]:
    """Row and column (B, 2) of each block that holds cells, and each cell's block number."""
    width = int(col.max()) + 1
    names, number = np.unique(row * width + col, return_inverse=True)
    return np.stack([names // width, names % width], axis=1), number


def least_squares(design: Float64, weight: Float64, value: Float64) -> Float64:
    """Solution (P,) of a weighted linear fit; the shortest where there are many."""
    normal = (design * weight[:, None]).T @ design
    return np.asarray(np.linalg.lstsq(normal, (design * weight[:, None]).T @ value, rcond=None)[0])
