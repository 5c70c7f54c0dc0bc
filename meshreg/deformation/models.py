"""Which smooth bend the tiles speak for: rigid, similarity, dome, quadratic or spline.

Each model is fitted to offsets that were measured tile by tile (`deformation`), robustly and with
each tile predicted from the others. A richer model is taken only where it predicts tiles that it
has not seen clearly better, on all of the ground and on that which needed no bend, folds nothing,
and strains the survey as a whole (`strain`) by less than a survey can be strained.

All models are kept as bicubic B-splines on one box; the polynomials are contained in them exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from meshreg.records import Bool, Float64, Warp, cubic_weights
from meshreg.statistics import RAYLEIGH, groups_of, least_trimmed_squares, robust

MODELS = ("rigid", "similarity", "dome", "quadratic", "spline")
FALL = 0.9  # a richer model must bring the held-out error below this share
TRUSTED = 0.5  # weight from which on a tile agrees with a model
FOLDS = 0.5  # slope of the displacement: steeper ground than this is no survey's bend
FINEST = 1 / 2000  # of a tile's side: a bend smaller than this is nobody's error
KNOT_TILES, KNOT_METRES = 2.0, 8.0  # knots closer than this would follow corals, not cameras
MOST_INTERVALS = 8  # a side
MIN_TILES = {"rigid": 6, "similarity": 8, "dome": 8, "quadratic": 12, "spline": 16}
_BENDING = np.logspace(-4, 1, 11)  # weights of the bending energy that are tried


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
        Of the survey as a whole (`strain`).
    """

    model: str
    coefficients: Float64
    held: Float64
    weights: Float64
    strain: float


def fit_models(sample: Sample) -> tuple[Step, ...]:
    """Fit every model that the sample has tiles enough for; the spline once for each stiffness."""
    steps = []
    for model in MODELS:
        enough = len(np.unique(sample.block)) >= MIN_TILES[model]
        if not enough or (model == "similarity" and sample.values.shape[1] == 1):
            continue
        fits = _fits(sample, model)
        # a fit that folds the ground could not be undone; it follows a few wrong tiles in a corner
        steps += [s for s in fits if steepest(_alone(s.coefficients, sample)) < FOLDS]
    return tuple(steps)


def choose(steps: Sequence[Step], sample: Sample, max_strain: float) -> Step:
    """Climb from the rigid step as long as the held-out error falls by a tenth and more.

    Of few tiles a tenth may be chance: the fall must also be larger than two of its standard
    errors, and than three where it is the first departure from a rigid move.

    It must fall on all of the ground, and on that alone which agrees with the poorer model. A bend
    of the cameras strains all of the ground, and what predicts it predicts all of it better.
    Ground that has changed in one piece leaves the rest where a rigid move had it already, and a
    bend that follows it helps no other tile. That tells them apart until half of the ground has
    changed. It does not where the models bend and ground slides too: a piece as wide as two knots
    are apart looks like the bend that it lies in.
    """
    costs = _costs(steps, sample)
    best = 0
    for model in MODELS[1:]:
        able = [k for k, s in enumerate(steps) if s.model == model and s.strain <= max_strain]
        if not able:
            continue
        rival = min(able, key=lambda k: float(costs[k].mean()))
        poor, rich = costs[best], costs[rival]
        agreeing = _blocks(steps[best].weights > TRUSTED, sample)
        # whether there is any bend is asked of the agreeing ground with the same rigour
        if _falls(poor, rich, 2.0 if best else 3.0) and _falls(
            poor[agreeing], rich[agreeing], 0.0 if best else 3.0
        ):
            best = rival
    return steps[best]


def _blocks(tiles: Bool, sample: Sample) -> Bool:
    """(B,): whether any of a block's tiles is among `tiles` (M,)."""
    groups = groups_of(sample.block)
    return np.asarray((tiles[groups] & (groups >= 0)).any(axis=1))


def _falls(poor: Float64, rich: Float64, sigmas: float) -> bool:
    """Whether the error falls by a tenth from costs `poor` to `rich` (B,), and for sure."""
    gain = poor - rich
    doubt = sigmas * gain.std() / np.sqrt(gain.size)
    return bool(rich.mean() <= FALL**2 * poor.mean() and gain.mean() > doubt)


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
        scale = middle / RAYLEIGH[sample.values.shape[1]]
        costs[:, members] = np.minimum(held / scale, 3.0) ** 2
    groups = groups_of(sample.block)
    there = groups >= 0
    return np.asarray((costs[:, groups] * there).sum(axis=2) / there.sum(axis=1))


def _fits(sample: Sample, model: str) -> Iterator[Step]:
    counts = intervals(sample)
    if model == "spline":
        yield from _splines(sample, counts) if counts is not None else ()
        return
    sites = _sites(sample, counts or (1, 1))
    design, at_sites = (_polynomials(p, sample, model) for p in (sample.places, sites))
    start = least_trimmed_squares(design, sample.values) if model == "rigid" else None
    answer, held, weights = robust(design, sample.values, sample.block, sample.channel, start=start)
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
        answer, held, weights = robust(
            design, sample.values, sample.block, sample.channel, stiffness * energy
        )
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
    weights = weights / max(weights.max(), 1e-300)
    return Step(model, table, held, weights, strain(_alone(table, sample)))


def _alone(table: Float64, sample: Sample) -> Warp:
    """Coefficients (R, C, K) as a warp that does nothing else."""
    whole = np.zeros((*table.shape[:2], 3))
    whole[..., slice(0, 2) if table.shape[2] == 2 else slice(2, 3)] = table
    return Warp("", "", sample.low, sample.high, whole)


def strain(warp: Warp) -> float:
    """How much a warp strains a survey as a whole.

    Root mean square, over all lines in the box that are at least half of its diagonal long, of
    their change in length, as a share of it; of a vertical bend, half the angle by which they
    tilt (a shear), their mean tilt apart. The larger of the two. To first order no rigid motion
    strains, and a similarity strains by its scale.

    A strain has no meaning without the length that it is taken over. Over short lengths it does
    not tell cameras' bends from anything else: a bend of u rms on a square of side L strains it by
    ``sqrt(6) u / L`` rms as a uniform stretch, 1 % for 10 cm on 25 m, by twice that in waves about
    as long as the square, and by four times at the steepest. Over the lengths that scale bars and
    camera networks hold, the same bend is 0.7 %.
    """
    axes = (np.linspace(low, high, 9) for low, high in zip(warp.low, warp.high, strict=True))
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    moved = warp.displacement(places)
    arm = places - places.mean(axis=0)
    up = moved[:, 2] - arm @ np.linalg.lstsq(arm, moved[:, 2], rcond=None)[0]
    first, second = np.triu_indices(len(places), 1)
    line = places[second] - places[first]
    square = (line**2).sum(axis=1)
    far = square >= 0.25 * ((warp.high - warp.low) ** 2).sum()
    along = ((moved[second] - moved[first])[:, :2] * line).sum(axis=1) / square
    tilt = 0.5 * (up[second] - up[first]) / np.sqrt(square)
    return float(max(np.sqrt(np.mean(part[far] ** 2)) for part in (along, tilt)))


def steepest(warp: Warp) -> float:
    """Largest slope of the horizontal displacement in the box: from 1 on the ground may fold."""
    axes = (np.linspace(low, high, 25) for low, high in zip(warp.low, warp.high, strict=True))
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    return float(np.linalg.norm(warp.gradient(places)[:, :2], ord=2, axis=(1, 2)).max())


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
