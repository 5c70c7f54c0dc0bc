"""How wrong a method's one offset is likely to be, from what each block of the overlap says alone.

The truth is the rigid motion that fits the whole overlap best. A method's offset misses it for
two reasons: noise, and the surveys' internal warp. Since blocks of ground lie decimetres from one
another, the highest peak of a score is near the offset that most blocks share (its mode), not near
their mean, and no curvature of that peak tells the difference. So every block is asked for its own
offset, in a small window round the method's answer; the best motion over all of the ground follows
from them by kriging (`statistics.kriging`), and the stated covariance is the mean square error

    sigma = (t - T)(t - T)' + cov(T)

of the method's offset t, with T the blocks' best motion. Where too few blocks answer, it is the
block sandwich of t itself (`statistics.sandwich`), from the slope and the curvature of the blocks'
scores at t, widened for few blocks as Hotelling's T² is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.records import Bool, Float64, Grid
from meshreg.statistics import MAD_TO_SIGMA, Ground, best_motion, block_sandwich, overlap_ground

BLOCK = 2.0  # m: several times the length over which high-passed heights or grey are alike
BLOCK_CELLS = (16, 40)  # but at least and at most so many cells wide
REACH = 0.5  # m that a block's own offset may lie from the whole's
REACH_CELLS = (5, 10)
MOST = 8  # blocks along a side: the warp is smooth, and kriging takes their number cubed
ENOUGH = 6  # blocks with an offset of their own
OWN_GAP = 0.5  # by which a block's peak must exceed its second, in robust deviations
RIVAL = 3  # cells from a block's peak at which another is its rival
FLOOR = 0.05  # cells: what the quadratic through 3 × 3 cells leaves


@dataclass(frozen=True, eq=False)
class Blocks:
    """What each block of the overlap says.

    Attributes
    ----------
    places : (B, 2) float64
        East and north [m] in the moving survey.
    offsets : (B, 2) float64
        Its own offset [m]; NaN where it has none.
    slopes : (B, 2) float64
        Of its share of the score at the method's offset, along east and north [1/m].
    curvature : (2, 2) float64
        Of all blocks' score there [1/m²]; negative definite at a peak.
    """

    places: Float64
    offsets: Float64
    slopes: Float64
    curvature: Float64


def error_bar(
    at: tuple[float, float], blocks: Blocks, ground: Ground, floor: float
) -> Float64 | None:
    """Mean square error [m²] of the offset `at` as the best motion at the ground's centroid.

    Parameters
    ----------
    at : (east, north)
        The method's offset [m].
    blocks : Blocks
    ground : Ground
        The overlap (`ground_of`).
    floor : float
        Deviation per axis [m] that is always there.

    Returns
    -------
    (2, 2) float64 or None
        None where the blocks tell nothing.
    """
    least = floor**2 * np.eye(2)
    known = np.isfinite(blocks.offsets).all(axis=1)
    if known.sum() >= ENOUGH:
        pivot = ground.share @ ground.places
        best = best_motion(
            blocks.places[known], blocks.offsets[known], ground, pivot, yaw_free=True
        )
        miss = np.asarray(at) - best.answer[:2]
        return np.asarray(np.outer(miss, miss) + best.covariance[:2, :2] + least)
    covariance = few_blocks(blocks.slopes, blocks.curvature)
    return None if covariance is None else covariance + least


def few_blocks(slopes: Float64, curvature: Float64) -> Float64 | None:
    """Block sandwich (2, 2) of a peak, widened for few blocks; None where it has no meaning.

    A 95 % ellipse of two degrees of freedom is drawn at chi-square's 5.99; with B blocks it takes
    Hotelling's ``T² = 2 (B - 1) / (B - 2) F(2, B - 2)``, and the covariance grows by their ratio.
    """
    from scipy.special import chdtri, fdtri

    slopes = slopes[(slopes != 0).any(axis=1)]
    count = len(slopes)
    if count < 4 or not np.linalg.eigvalsh(curvature)[-1] < 0:
        return None
    covariance = block_sandwich(curvature, slopes, np.arange(count), 1)
    hotelling = 2 * (count - 1) / (count - 2) * fdtri(2, count - 2, 0.95)
    return np.asarray(covariance * (hotelling / chdtri(2, 0.05)))


def ground_of(
    masks: tuple[Bool, Bool], grids: tuple[Grid, Grid], at: tuple[float, float]
) -> Ground | None:
    """Return the overlap at an offset [m], from every few cells: it is asked for in every pair."""
    return overlap_ground(masks, grids, at, MOST, max(1, max(masks[1].shape) // 120))


def correlated_blocks(
    pairs: Sequence[tuple[Float64, Float64]],
    masks: tuple[Bool, Bool],
    grids: tuple[Grid, Grid],
    whole: tuple[float, float],
    at: tuple[float, float],
) -> Blocks | None:
    """Correlate each block of the moving survey with the reference, near one offset.

    Parameters
    ----------
    pairs : sequence of ((H, W), (h, w)) float64
        Fields of reference and moving, zero outside their masks, whose products are added.
    masks : ((H, W), (h, w)) bool
    grids : (Grid, Grid)
        Of reference and moving.
    whole, at : (east, north)
        The whole-cell offset with the highest score, and the method's offset near it [m].

    Returns
    -------
    Blocks or None
        None where not even one block fits into the overlap.
    """
    cell = grids[1].cell
    side = int(np.clip(round(BLOCK / cell), *BLOCK_CELLS))
    reach = int(np.clip(round(REACH / cell), *REACH_CELLS))
    shift = whole_shift(grids, whole)
    here = laid(masks[0], shift, masks[1].shape, reach)
    corners = _corners(here[reach:-reach, reach:-reach] & masks[1], side)
    narrow, wide = np.arange(side), np.arange(side + 2 * reach)
    known = [_cut(m, corners, n).mean(axis=(1, 2)) for m, n in ((masks[1], narrow), (here, wide))]
    corners = corners[np.minimum(*known) >= 0.5]
    if len(corners) == 0:
        return None
    scores = np.zeros((len(corners), 2 * reach + 1, 2 * reach + 1))
    for first, second in pairs:
        around = _cut(laid(first, shift, second.shape, reach), corners, wide)
        scores += block_scores(around, _cut(second, corners, narrow))
    east, north = grids[1].east_north(*(corners + 0.5 * (side - 1)).T)
    slopes, curvature = _quadratic(scores, reach, reach)
    slopes = slopes + curvature @ ((np.asarray(at) - whole) / cell)
    return Blocks(
        np.stack([east, north], axis=1),
        np.asarray(whole) + own_offsets(scores) * cell,
        slopes / cell,
        curvature.sum(axis=0) / cell**2,
    )


def whole_shift(grids: tuple[Grid, Grid], whole: tuple[float, float]) -> tuple[int, int]:
    """Row and column of the moving raster's first cell in the reference, at a whole-cell offset."""
    reference, moving = grids
    row = (reference.north - moving.north - whole[1]) / moving.cell
    return round(row), round((moving.west + whole[0] - reference.west) / moving.cell)


def laid(first: Any, shift: tuple[int, int], shape: tuple[int, ...], reach: int) -> Any:
    """Return the reference's cells under the moving raster and `reach` around; 0 beyond it."""
    laid = np.zeros((shape[0] + 2 * reach, shape[1] + 2 * reach), first.dtype)
    source, target = [], []
    for axis in (0, 1):
        start = shift[axis] - reach
        low, high = max(0, -start), min(laid.shape[axis], first.shape[axis] - start)
        target.append(slice(low, max(high, low)))
        source.append(slice(low + start, max(high, low) + start))
    laid[tuple(target)] = first[tuple(source)]
    return laid


def _corners(overlap: Bool, side: int) -> Any:
    """(B, 2) int: top left cells of blocks that stand evenly over the overlap's box."""
    axes = []
    for axis in (1, 0):
        filled = np.flatnonzero(overlap.any(axis=axis))
        if len(filled) == 0 or np.ptp(filled) + 1 < side:
            return np.zeros((0, 2), int)
        low, high = int(filled[0]), int(filled[-1]) + 1
        count = min(max((high - low) // side, 1), MOST)
        edges = np.linspace(low, high, count + 1)
        axes.append(np.rint(0.5 * (edges[1:] + edges[:-1]) - 0.5 * side).astype(int))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def _cut(array: Any, corners: Any, span: Any) -> Any:
    """(B, n, n) pieces of an array, of the cells `span` from each corner."""
    rows, cols = corners[:, :1] + span, corners[:, 1:] + span
    return array[rows[:, :, None], cols[:, None, :]]


def block_scores(around: Any, block: Any) -> Float64:
    """(B, K, K) ``sum_r around[r + s] block[r]`` for all steps s at which the block lies inside."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    size = int(next_fast_len(around.shape[1], real=True))
    shape = (size, size)
    steps = around.shape[1] - block.shape[1] + 1
    product = rfft2(around, s=shape) * np.conj(rfft2(block, s=shape))
    return np.asarray(irfft2(product, s=shape)[:, :steps, :steps])


def own_offsets(scores: Float64) -> Float64:
    """(B, 2) east and north [cells] of each block's peak; NaN without one that stands out."""
    count, size = len(scores), scores.shape[1]
    reach = size // 2
    row, col = np.unravel_index(scores.reshape(count, -1).argmax(axis=1), (size, size))
    flat = scores.reshape(count, -1)
    middle = np.median(flat, axis=1, keepdims=True)
    spread = MAD_TO_SIGMA * np.median(abs(flat - middle), axis=1)
    steps = np.arange(size)
    away = [abs(steps - place[:, None]) for place in (row, col)]
    near = (away[0][:, :, None] <= RIVAL) & (away[1][:, None, :] <= RIVAL)
    rival = np.where(near, -np.inf, scores).max(axis=(1, 2))
    alone = flat.max(axis=1) - rival >= OWN_GAP * spread
    inside = (np.minimum(row, col) > 0) & (np.maximum(row, col) < size - 1)
    slope, curvature = _quadratic(scores, np.clip(row, 1, size - 2), np.clip(col, 1, size - 2))
    peaked = np.linalg.eigvalsh(curvature)[:, 1] < 0
    curvature[~peaked] = -np.eye(2)
    step = np.clip(-np.linalg.solve(curvature, slope[:, :, None])[:, :, 0], -1.0, 1.0)
    found = np.stack([col - reach, reach - row], axis=1) + step
    found[~(alone & inside & peaked)] = np.nan
    return np.asarray(found)


def _quadratic(scores: Float64, row: Any, col: Any) -> tuple[Float64, Float64]:
    """Slope (B, 2) and curvature (B, 2, 2) along east and north, per cell, at a cell of each."""
    block = np.arange(len(scores))

    def at(north: int, east: int) -> Float64:
        return np.asarray(scores[block, row - north, col + east])

    slope = 0.5 * np.stack([at(0, 1) - at(0, -1), at(1, 0) - at(-1, 0)], axis=1)
    along = at(0, 1) + at(0, -1) - 2 * at(0, 0)
    up = at(1, 0) + at(-1, 0) - 2 * at(0, 0)
    mixed = 0.25 * (at(1, 1) + at(-1, -1) - at(1, -1) - at(-1, 1))
    return slope, np.stack([along, mixed, mixed, up], axis=1).reshape(-1, 2, 2)
