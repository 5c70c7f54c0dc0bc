"""Which smooth bend the tiles speak for: rigid, similarity, dome, quadratic or spline.

Each model is fitted to offsets that were measured tile by tile (`meshreg.warp`), robustly and with
each tile predicted from the others. A richer model is taken only where it predicts tiles that it
has not seen clearly better, and strains the survey by less than a survey can be strained.

All models are kept as bicubic B-splines on one box; the polynomials are contained in them exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from meshreg.types import Float64, Warp, cubic_weights

MODELS = ("rigid", "similarity", "dome", "quadratic", "spline")
FALL = 0.9  # a richer model must bring the held-out error below this share
FINEST = 1 / 2000  # of a tile's side: a bend smaller than this is nobody's error
KNOT_TILES, KNOT_METRES = 2.0, 8.0  # knots closer than this would follow corals, not cameras
MOST_INTERVALS = 8  # a side
MIN_TILES = {"rigid": 6, "similarity": 8, "dome": 8, "quadratic": 12, "spline": 16}
_BENDING = np.logspace(-4, 1, 11)  # weights of the bending energy that are tried
_RAYLEIGH = {1: 0.6745, 2: 1.1774}  # median length of a normal deviate in 1 and 2 dimensions


@dataclass(frozen=True, eq=False)
class Sample:
    """What is fitted: values (M, K) [m] at places (M, 2) [m], absolute in the reference.

    `block` (M,) groups tiles that are held out together, `channel` (M,) those that err alike;
    `side` is the length of a tile [m]; the box of the models runs from `low` to `high`.
    """

    places: Float64
    values: Float64
    block: np.ndarray
    channel: np.ndarray
    side: float
    low: Float64
    high: Float64


@dataclass(frozen=True, eq=False)
class Step:
    """One model, fitted.

    Attributes
    ----------
    model : str
    coefficients : (R, C, K) float64
        Of the B-splines on the sample's box.
    held : (M,) float64
        How far each tile lies from what the others predict [m].
    weights : (M,) float64
        0 (set aside) to 1.
    strain : float
        Largest strain in the box, the rigid part apart.
    """

    model: str
    coefficients: Float64
    held: Float64
    weights: Float64
    strain: float


def climb(sample: Sample) -> tuple[Step, ...]:
    """Fit every model that the sample has tiles enough for; the spline once for each stiffness."""
    steps = []
    for model in MODELS:
        enough = len(np.unique(sample.block)) >= MIN_TILES[model]
        if not enough or (model == "similarity" and sample.values.shape[1] == 1):
            continue
        steps += list(_fits(sample, model))
    return tuple(steps)


def choose(steps: Sequence[Step], sample: Sample, max_strain: float) -> Step:
    """Climb from the rigid step as long as the held-out error falls by a tenth and more.

    Of few tiles a tenth may be chance: the fall must also be larger than two of its standard
    errors, and than three where it is the first departure from a rigid move.
    """
    costs = _costs(steps, sample)
    errors = np.sqrt(costs.mean(axis=1))
    best = 0
    for model in MODELS[1:]:
        able = [k for k, s in enumerate(steps) if s.model == model and s.strain <= max_strain]
        if not able:
            continue
        rival = min(able, key=lambda k: errors[k])
        gain = costs[best] - costs[rival]
        doubt = (2.0 if best else 3.0) * gain.std() / np.sqrt(gain.size)
        if errors[rival] <= FALL * errors[best] and gain.mean() > doubt:
            best = rival
    return steps[best]


def _costs(steps: Sequence[Step], sample: Sample) -> Float64:
    """Return (steps, blocks) mean squared held-out lengths, in deviations of the best step.

    A length counts for at most three deviations, so that ground that has changed, which no model
    should follow, does not speak; a model that runs wild between tiles still pays for it.
    `FINEST` is added to all of them.
    """
    finest = FINEST * sample.side
    costs = np.empty((len(steps), len(sample.block)))
    for channel in np.unique(sample.channel):
        members = sample.channel == channel
        held = np.hypot([step.held[members] for step in steps], finest)
        middle = float(np.median(held, axis=1).min())
        scale = middle / _RAYLEIGH[sample.values.shape[1]]
        costs[:, members] = np.minimum(held / scale, 3.0) ** 2
    groups = _groups(sample.block)
    there = groups >= 0
    return np.asarray((costs[:, groups] * there).sum(axis=2) / there.sum(axis=1))


def _fits(sample: Sample, model: str) -> Iterator[Step]:
    counts = intervals(sample)
    if model == "spline":
        yield from _splines(sample, counts) if counts is not None else ()
        return
    sites = _sites(sample, counts or (1, 1))
    design, at_sites = (_polynomials(p, sample, model) for p in (sample.places, sites))
    answer, held, weights = _robust(design, sample, None)
    table = _through(at_sites @ answer, sites, sample, counts or (1, 1))
    yield _step(model, table, held, weights, sample)


def _splines(sample: Sample, counts: tuple[int, int]) -> Iterator[Step]:
    """Fit the spline at each stiffness."""
    basis = _basis(sample.places, sample, counts)
    dimension = sample.values.shape[1]
    eye = np.eye(dimension)
    design = np.einsum("mp,kl->mkpl", basis, eye).reshape(len(basis), dimension, -1)
    energy = np.kron(_bending_energy(sample, counts), eye)
    energy *= np.trace(basis.T @ basis) / np.trace(energy) * dimension
    for stiffness in _BENDING:
        answer, held, weights = _robust(design, sample, stiffness * energy)
        table = answer.reshape(counts[1] + 3, counts[0] + 3, dimension)
        yield _step("spline", table, held, weights, sample)


def intervals(sample: Sample) -> tuple[int, int] | None:
    """Spline intervals along east and north, or None where the box does not hold one of them."""
    spacing = max(KNOT_TILES * sample.side, KNOT_METRES)
    east, north = np.floor((sample.high - sample.low) / spacing + 1e-9).astype(int)
    if min(east, north) < 1:
        return None
    return min(int(east), MOST_INTERVALS), min(int(north), MOST_INTERVALS)


def _step(model: str, table: Float64, held: Float64, weights: Float64, sample: Sample) -> Step:
    whole = np.zeros((*table.shape[:2], 3))
    if table.shape[2] == 2:
        whole[..., :2] = table
    else:
        whole[..., 2:] = table
    strain = largest_strain(Warp(model, model, sample.low, sample.high, whole))
    return Step(model, table, held, weights / max(weights.max(), 1e-300), strain)


def largest_strain(warp: Warp) -> float:
    """Largest principal strain in the warp's box: horizontal, or the shear by a change of slope.

    Strain is the symmetric part of the gradient; a mean tilt is rigid, and left out.
    """
    axes = (np.linspace(a, b, 25) for a, b in zip(warp.low, warp.high, strict=True))
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    slopes = warp.gradient(places)
    a, b = slopes[:, 0, 0], slopes[:, 1, 1]
    shear = 0.5 * (slopes[:, 0, 1] + slopes[:, 1, 0])
    flat = np.abs(a + b) / 2 + np.hypot((a - b) / 2, shear)
    bend = 0.5 * np.hypot(*(slopes[:, 2] - slopes[:, 2].mean(axis=0)).T)
    return float(max(flat.max(), bend.max()))


# ---- the robust fit ---------------------------------------------------------------------------


def _robust(
    design: Float64, sample: Sample, penalty: Float64 | None, iterations: int = 20
) -> tuple[Float64, Float64, Float64]:
    """Answer (p,), held-out lengths (M,) and weights (M,) of a fit of `design` (M, K, p).

    Weights come from held-out residuals, so that a bending model cannot run after a tile that lies
    wrong and then find it fitting; in proportion to how well the other tiles can predict that
    tile, so that no corner is set aside for being one. Huber's at first, whose answer has one
    minimum, then Tukey's biweight at four deviations, which sets changed ground aside.
    """
    groups = _groups(sample.block)
    scale = _scale(np.linalg.norm(sample.values - np.median(sample.values, axis=0), axis=1), sample)
    weights = np.ones(len(design))
    answer = np.zeros(design.shape[2])
    for turn in range(iterations):
        weighted = design * (weights / scale**2)[:, None, None]
        normal = np.tensordot(weighted, design, axes=((0, 1), (0, 1)))
        if penalty is not None:
            normal = normal + penalty * np.mean(weights / scale**2)
        # a floor far under any rounding keeps ground without tiles at rest
        normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal) / len(normal)
        inverse = np.asarray(np.linalg.inv(normal), np.float64)
        pull = np.tensordot(weighted, sample.values, axes=((0, 1), (0, 1)))
        before, answer = answer, inverse @ pull
        residual = sample.values - design @ answer
        held, doubt = _held_out(design, weighted, inverse, residual, groups)
        size = np.linalg.norm(held, axis=1) / np.sqrt(1 + doubt / scale**2)
        scale = _scale(size, sample)
        weights = _weights(size / scale, huber=turn < 4)
        if turn > 5 and np.abs(design @ (answer - before)).max() < 1e-5:
            break
    return answer, np.linalg.norm(held, axis=1), weights


def _weights(size: Float64, *, huber: bool) -> Float64:
    if huber:
        return np.asarray(np.minimum(1.0, 1.5 / np.maximum(size, 1e-12)))
    return np.asarray(np.clip(1 - (size / 4.0) ** 2, 0, None) ** 2)


def _scale(size: Float64, sample: Sample) -> Float64:
    """Robust deviation per axis [m] of each tile's channel; nothing is known to a micrometre."""
    scale = np.empty(len(size))
    for channel in np.unique(sample.channel):
        members = sample.channel == channel
        middle = float(np.median(size[members])) / _RAYLEIGH[sample.values.shape[1]]
        scale[members] = max(middle, 1e-6)
    return scale


def _groups(block: np.ndarray) -> np.ndarray:
    """(B, n) indices of each block's tiles, -1 where a block has fewer than the largest."""
    _, number = np.unique(block, return_inverse=True)
    counts = np.bincount(number)
    order = np.argsort(number, kind="stable")
    groups = np.full((len(counts), counts.max()), -1)
    column = np.arange(len(block)) - np.repeat(np.cumsum(counts) - counts, counts)
    groups[number[order], column] = order
    return groups


def _held_out(
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


# ---- the models -------------------------------------------------------------------------------


def _polynomials(places: Float64, sample: Sample, model: str) -> Float64:
    """(M, K, p) design of a model in coordinates from the box's centre, in half diagonals."""
    centre = 0.5 * (sample.low + sample.high)
    radius = 0.5 * float(np.hypot(*(sample.high - sample.low)))
    x, y = ((places - centre) / radius).T
    one, zero, square = np.ones_like(x), np.zeros_like(x), x**2 + y**2
    if sample.values.shape[1] == 1:
        columns = [one, x, y]
        columns += {"dome": [square], "quadratic": [x * x, x * y, y * y]}.get(model, [])
        return np.stack(columns, axis=-1)[:, None, :]
    if model == "quadratic":
        columns = [one, x, y, x * x, x * y, y * y]
        both = [(c, zero) for c in columns] + [(zero, c) for c in columns]
    else:
        both = [(one, zero), (zero, one), (-y, x)]
        both += [(x, y)] if model in ("similarity", "dome") else []
        both += [(square * x, square * y)] if model == "dome" else []
    return np.stack([np.stack(pair, axis=-1) for pair in both], axis=-1)


def _sites(sample: Sample, counts: tuple[int, int]) -> Float64:
    """Places (P, 2), as many as there are coefficients, by whose values a spline is known."""
    ends = zip(sample.low, sample.high, counts, strict=True)
    axes = (np.linspace(low, high, count + 3) for low, high, count in ends)
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def _through(values: Float64, sites: Float64, sample: Sample, counts: tuple[int, int]) -> Float64:
    """Coefficients (R, C, K) of the spline that has these values (P, K) at the sites."""
    table = np.asarray(np.linalg.solve(_basis(sites, sample, counts), values), np.float64)
    return table.reshape(counts[1] + 3, counts[0] + 3, -1)


def _basis(places: Float64, sample: Sample, counts: tuple[int, int]) -> Float64:
    """(M, R C) values of the B-splines at places, row by row from the south."""
    parts = []
    for axis in (0, 1):
        step = (sample.high[axis] - sample.low[axis]) / counts[axis]
        place = np.clip((places[:, axis] - sample.low[axis]) / step, 0, counts[axis])
        first = np.minimum(place.astype(int), counts[axis] - 1)
        dense = np.zeros((len(places), counts[axis] + 3))
        at = first[:, None] + np.arange(4)
        np.put_along_axis(dense, at, cubic_weights(place - first), axis=1)
        parts.append(dense)
    table: Float64 = np.einsum("mr,mc->mrc", parts[1], parts[0])
    return table.reshape(len(places), -1)


def _bending_energy(sample: Sample, counts: tuple[int, int]) -> Float64:
    """Matrix of ``∫∫ f_xx² + 2 f_xy² + f_yy²`` over the box (Wahba, Spline Models, 2.4)."""
    grams = []
    for axis in (0, 1):
        step = (sample.high[axis] - sample.low[axis]) / counts[axis]
        grams.append([_gram(counts[axis], step, order) for order in range(3)])
    (east0, east1, east2), (north0, north1, north2) = grams
    return np.asarray(np.kron(north0, east2) + 2 * np.kron(north1, east1) + np.kron(north2, east0))


def _gram(count: int, step: float, order: int) -> Float64:
    """Integrals of products of the splines' derivatives; four Gauss points are exact."""
    places, weights = np.polynomial.legendre.leggauss(4)
    t = 0.5 * (places + 1)
    if order == 2:
        values = np.stack([1 - t, 3 * t - 2, 1 - 3 * t, t], axis=-1)
    else:
        values = cubic_weights(t, derivative=order == 1)
    one = (values * weights[:, None] * 0.5).T @ values * step ** (1 - 2 * order)
    whole = np.zeros((count + 3, count + 3))
    for k in range(count):
        whole[k : k + 4, k : k + 4] += one
    return whole
