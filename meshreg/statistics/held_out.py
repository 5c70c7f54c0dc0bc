"""A robust linear fit of tiles, each of them predicted from the others.

Ground that has changed must not bend a fit, and a model that bends easily must not earn trust by
running after single tiles: both weights and errors come from held-out residuals.
"""

from __future__ import annotations

import numpy as np

from meshreg.records import Float64
from meshreg.statistics.weights import biweight

RAYLEIGH = {1: 0.6745, 2: 1.1774}  # median length of a normal deviate in 1 and 2 dimensions


def robust(
    design: Float64,
    values: Float64,
    block: np.ndarray,
    channel: np.ndarray,
    penalty: Float64 | None = None,
    start: Float64 | None = None,
) -> tuple[Float64, Float64, Float64]:
    """Answer (p,), held-out lengths (M,) and weights (M,) of a fit of `design` (M, K, p).

    Weights come from held-out residuals, so that a bending model cannot run after a tile that lies
    wrong and then find it fitting; in proportion to how well the other tiles can predict that
    tile, so that no corner is set aside for being one. Huber's at first, whose answer has one
    minimum, then Tukey's biweight at four deviations, which sets changed ground aside.

    Parameters
    ----------
    design : (M, K, p) float64
    values : (M, K) float64
        Along K axes [m].
    block, channel : (M,) int
        Tiles of a block are held out together; those of a channel err alike.
    penalty : (p, p) float64, optional
        Energy of the answer, as it weighs against tiles of one deviation.
    start : (p,) float64, optional
        An answer that is near enough to tell changed ground from the start, without Huber's turns.
    """
    groups = groups_of(block)
    weights = np.ones(len(design))
    answer = np.zeros(design.shape[2]) if start is None else start
    about = np.median(values, axis=0) if start is None else design @ start
    size = np.linalg.norm(values - about, axis=1)
    scale = _scale(size, channel, values.shape[1])
    if start is not None:
        weights = _weights(size / scale, huber=False)
    for turn in range(20):
        weighted = design * (weights / scale**2)[:, None, None]
        normal = np.tensordot(weighted, design, axes=((0, 1), (0, 1)))
        if penalty is not None:
            normal = normal + penalty * np.mean(weights / scale**2)
        # a floor far under any rounding keeps ground without tiles at rest
        normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal) / len(normal)
        inverse = np.asarray(np.linalg.inv(normal), np.float64)
        pull = np.tensordot(weighted, values, axes=((0, 1), (0, 1)))
        before, answer = answer, inverse @ pull
        residual = values - design @ answer
        held, doubt = held_out(design, weighted, inverse, residual, groups)
        size = np.linalg.norm(held, axis=1) / np.sqrt(1 + doubt / scale**2)
        scale = _scale(size, channel, values.shape[1])
        weights = _weights(size / scale, huber=start is None and turn < 4)
        if turn > 5 and np.abs(design @ (answer - before)).max() < 1e-5:
            break
    return answer, np.linalg.norm(held, axis=1), weights


def least_trimmed_squares(design: Float64, values: Float64, starts: int = 300) -> Float64:
    """Answer (p,) that fits one half of the values best, whatever the other half says.

    Least trimmed squares from random starts by concentration steps (Rousseeuw & Van Driessen,
    Data Mining and Knowledge Discovery 12, 2006); the draws are the same in every run. Among three
    hundred draws of three tiles, dozens lie on good ground alone where nearly half of it changed.
    """
    count = design.shape[2]
    half = len(values) // 2 + 1
    squares = np.einsum("mkp,mkq->mpq", design, design).reshape(len(values), -1)
    pulls = np.einsum("mkp,mk->mp", design, values)
    size, kept = np.random.default_rng(0).random((starts, len(values))), count
    for turn in range(30):
        chosen = (np.argsort(np.argsort(size, axis=1), axis=1) < kept).astype(float)
        normal = (chosen @ squares).reshape(-1, count, count)
        # three tiles in a row tell no turn: the floor leaves it at rest
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(count)
        answers = np.linalg.solve(normal, (chosen @ pulls)[..., None])[..., 0]
        apart = values - np.einsum("mkp,sp->smk", design, answers)
        size, kept = (apart**2).sum(axis=2), half
        cost = np.partition(size, half - 1, axis=1)[:, :half].sum(axis=1)
        if turn == 3:  # the rest of the way for the ten best alone
            size = size[np.argsort(cost, kind="stable")[:10]]
    return np.asarray(answers[np.argmin(cost)])


def _weights(size: Float64, *, huber: bool) -> Float64:
    if huber:
        return np.asarray(np.minimum(1.0, 1.5 / np.maximum(size, 1e-12)))
    return biweight(size / 4.0)


def _scale(size: Float64, channel: np.ndarray, dimension: int) -> Float64:
    """Robust deviation per axis [m] of each tile's channel; nothing is known to a micrometre."""
    scale = np.empty(len(size))
    for one in np.unique(channel):
        members = channel == one
        middle = float(np.median(size[members])) / RAYLEIGH[dimension]
        scale[members] = max(middle, 1e-6)
    return scale


def groups_of(block: np.ndarray) -> np.ndarray:
    """(B, n) indices of each block's tiles, -1 where a block has fewer than the largest."""
    _, number = np.unique(block, return_inverse=True)
    counts = np.bincount(number)
    order = np.argsort(number, kind="stable")
    groups = np.full((len(counts), counts.max()), -1)
    column = np.arange(len(block)) - np.repeat(np.cumsum(counts) - counts, counts)
    groups[number[order], column] = order
    return groups


def held_out(
    design: Float64, weighted: Float64, inverse: Float64, residual: Float64, groups: np.ndarray
) -> tuple[Float64, Float64]:
    """Residuals (M, K) of each tile from the fit without its block, and that fit's doubt (M,).

    For weights that stay, no new fit is needed: ``r_b(-b) = (1 - H)⁻¹ r_b`` with
    ``H = X A⁻¹ X' W``, and the variance of the prediction is ``(1 - H)⁻¹ X A⁻¹ X'``; X are the
    block's rows, A the normal matrix. The doubt [m²] is the mean over the axes.
    """
    blocks, most = groups.shape
    there = (groups >= 0)[..., None]
    dimension, count = design.shape[1:]
    size = most * dimension
    own = (design[groups] * there[..., None]).reshape(blocks, size, count)
    pull = (weighted[groups] * there[..., None]).reshape(blocks, size, count)
    spread = own @ inverse
    hat = spread @ np.swapaxes(pull, 1, 2)
    left = (residual[groups] * there).reshape(blocks, size, 1)
    # a tile that alone holds a coefficient is predicted by nothing: its residual grows large
    both = np.concatenate([left, spread @ np.swapaxes(own, 1, 2)], axis=2)
    solved = np.linalg.solve(np.eye(size) * (1 + 1e-9) - hat, both)
    doubt = np.diagonal(solved[:, :, 1:], axis1=1, axis2=2).reshape(blocks, most, dimension)
    held, doubts = np.empty_like(residual), np.empty(len(residual))
    held[groups[groups >= 0]] = solved[:, :, 0].reshape(blocks, most, dimension)[groups >= 0]
    doubts[groups[groups >= 0]] = np.maximum(doubt.mean(axis=2), 0.0)[groups >= 0]
    return held, doubts
