"""The rigid motion that fits a whole overlap best, from the offsets of some of its tiles.

Two models of one place differ by a rigid motion and by a smooth internal warp. What is asked for
is the rigid motion that fits all of the overlap best, by uniform least squares; what is known are
the offsets of tiles, which cover it unevenly and err. With the warp as a random field, whose size
and range the tiles themselves tell, the answer and its covariance follow by block kriging
(universal kriging of a linear functional; Cressie, Statistics for Spatial Data, 1993, sections
3.4 and 2.6): a tile weighs by how much of the overlap it speaks for, tiles that stand close share
their warp, and ground without tiles adds to the doubt.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshreg.records import Bool, Float64, Grid

RANGES = (0.1, 0.2, 0.4, 0.8, 1.6)  # of the warp, in diagonals of the tiles' places
# Of the warp in the variance. Never all of it: a tile is not the smooth warp itself, since the
# relief that tells its offset is spread unevenly over it, and the warp bends within it.
SHARES = (0.0, 0.2, 0.5, 0.8, 0.95, 0.99)
OWN = (0.0, 0.5, 0.9)  # how far what a tile errs by for itself follows what its own fit says
MOST_TILES = 300  # that the warp's size and range are estimated from
# Squared deviations of two axes, from what all others say, at which a tile is left out, and up to
# which it comes back: two numbers, lest it go in and out. Chance would be content with half (1e-4),
# but a warp bends more in some places than as a rule, and ground that slid stands out by more.
OUTLIER, RETURN = 40.0, 30.0


@dataclass(frozen=True, eq=False)
class Ground:
    """The overlap: places (G, 2) [m] that stand for it, and the share of its area of each (G,)."""

    places: Float64
    share: Float64


def overlap_ground(
    masks: tuple[Bool, Bool],
    grids: tuple[Grid, Grid],
    offset: tuple[float, float] | Float64,
    nodes: int,
    step: int = 1,
) -> Ground | None:
    """Return up to about `nodes`² places of the moving survey's cells that fall on the reference's.

    Parameters
    ----------
    masks : ((H, W), (h, w)) bool
        Of reference and moving.
    grids : (Grid, Grid)
    offset : (east, north)
        Of the moving survey [m].
    nodes : int
        Places along the overlap's longer side.
    step : int
        Only every so many rows and columns are looked at.

    Returns
    -------
    Ground or None
        None where no cell falls on another.
    """
    row, col = (index * step for index in np.nonzero(masks[1][::step, ::step]))
    east, north = grids[1].east_north(row, col)
    there = np.rint(np.stack(grids[0].row_col(east + offset[0], north + offset[1]))).astype(int)
    inside = np.all((there >= 0) & (there < np.array(masks[0].shape)[:, None]), axis=0)
    inside[inside] = masks[0][tuple(there[:, inside])]
    if not inside.any():
        return None
    row, col, east, north = row[inside], col[inside], east[inside], north[inside]
    side = int(max(np.ptp(row), np.ptp(col))) // nodes + 1
    node = (row // side) * masks[1].shape[1] + col // side
    _, node, count = np.unique(node, return_inverse=True, return_counts=True)
    places = np.stack([np.bincount(node, east), np.bincount(node, north)], axis=1)
    return Ground(places / count[:, None], count / count.sum())


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion in the plane.

    Attributes
    ----------
    answer : (k,) float64
        East and north [m] at the pivot; where they were sought the turn [rad], and the stretch:
        exactly ``s sin psi`` and ``s cos psi - 1`` of a similarity.
    covariance : (k, k) float64
    used : (M,) bool
        False where a tile lies far from what its neighbours say.
    field : Field
        The warp itself.
    """

    answer: Float64
    covariance: Float64
    used: Bool
    field: Field


@dataclass(frozen=True, eq=False)
class Field:
    """Most likely offset at any place: the rigid part and the warp, as the tiles tell them."""

    places: Float64
    pivot: Float64
    answer: Float64
    weights: Float64
    reach: float

    def __call__(self, places: Float64) -> Float64:
        """Offset (N, 2) [m] at places (N, 2)."""
        rigid = design(places, self.pivot, len(self.answer)) @ self.answer
        return np.asarray(rigid + correlation(places, self.places, self.reach) @ self.weights)

    def growth(self, places: Float64) -> Float64:
        """(N,) area in the reference for a unit of area at places in the moving survey."""
        step = 0.01 * self.reach
        ends = [(self(places + s) - self(places - s)) / (2 * step) for s in step * np.eye(2)]
        return np.asarray(np.linalg.det(np.eye(2) + np.stack(ends, axis=2)))


def best_motion(
    places: Float64,
    offsets: Float64,
    ground: Ground,
    pivot: Float64,
    *,
    yaw_free: bool,
    scale_free: bool = False,
    start: Motion | None = None,
    noise: Float64 | None = None,
) -> Motion:
    """Find the rigid motion that fits all of the ground best; leave out tiles that stand alone.

    Parameters
    ----------
    places, offsets : (M, 2) float64
        Where the tiles are, and how far each must go [m].
    ground : Ground
    pivot : (2,) float64
        Where the offset is stated [m].
    yaw_free : bool
        Whether a turn is sought too.
    scale_free : bool
        Whether a turn and a stretch are sought too.
    start : Motion, optional
        Whose tiles are used as they are.
    noise : (M, 2) float64, optional
        Variance of each tile's east and north in any unit; alike for all where it is not known.
    """
    terms = 4 if scale_free else 2 + yaw_free
    unlike = np.ones_like(offsets) if noise is None else noise / np.median(noise)
    if start is not None:
        return _krige(places, offsets, unlike, start.used, ground, pivot, terms)[0]
    used = _near_neighbours(places, offsets / np.sqrt(np.maximum(unlike, 1.0)))
    for _ in range(5):
        before = used
        motion, used = _krige(places, offsets, unlike, used, ground, pivot, terms)
        if (used == before).all():
            break
    return motion


def design(places: Float64, pivot: Float64, terms: int) -> Float64:
    """(M, 2, k) float64: what each of the 2 to 4 parameters does to the offset at each place."""
    arm = places - pivot
    columns = np.zeros((len(arm), 2, 4))
    columns[:, 0, 0] = columns[:, 1, 1] = 1.0
    columns[:, 0, 2], columns[:, 1, 2] = -arm[:, 1], arm[:, 0]
    columns[:, :, 3] = arm
    return columns[:, :, :terms]


def correlation(first: Float64, second: Float64, reach: float) -> Float64:
    """(M, N) Matérn correlation of smoothness 5/2 between places."""
    from scipy.spatial.distance import cdist

    away = cdist(first, second) * (np.sqrt(5) / reach)
    return np.asarray((1 + away + away * away / 3) * np.exp(-away))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Generalised least squares of the tiles' offsets at one reach and share of the warp."""

    reach: float
    share: float
    inverse: Float64  # (2, M, M), of the covariance of each axis in units of `variance`
    alone: Float64  # (M, 2): what each tile errs by for itself, in the same units
    normal: Float64  # (k, k)
    answer: Float64  # (k,)
    left: Float64  # (M, 2)
    variance: float
    cost: float  # -2 ln of the restricted likelihood

    @classmethod
    def of(
        cls,
        offsets: Float64,
        drift: Float64,
        alike: Float64,
        reach: float,
        share: float,
        alone: Float64,
    ) -> _Fit:
        alone = (1.0 - share) * alone
        covariance = share * alike + np.stack([np.diag(part) for part in alone.T])
        inverse = np.asarray(np.linalg.inv(covariance), np.float64)
        weighed = np.stack([inverse[axis] @ drift[:, axis] for axis in (0, 1)], axis=1)
        normal = np.einsum("mik,mil->kl", drift, weighed)
        answer = np.linalg.solve(normal, np.einsum("mik,mi->k", weighed, offsets))
        left = offsets - drift @ answer
        freedom = offsets.size - len(answer)
        variance = float(np.einsum("mi,imn,ni->", left, inverse, left, optimize=True)) / freedom
        variance = max(variance, 1e-24)
        volume = np.linalg.slogdet(covariance)[1].sum() + np.linalg.slogdet(normal)[1]
        cost = freedom * np.log(variance) + volume
        return cls(reach, share, inverse, alone, normal, answer, left, variance, float(cost))

    @property
    def pulls(self) -> Float64:
        """(M, 2): the inverse covariance times what is left."""
        return np.stack([self.inverse[axis] @ self.left[:, axis] for axis in (0, 1)], axis=1)


def _krige(
    places: Float64,
    offsets: Float64,
    unlike: Float64,
    used: Bool,
    ground: Ground,
    pivot: Float64,
    terms: int,
) -> tuple[Motion, Bool]:
    """Average over all likely reaches and shares of the warp; also tell which tiles fit."""
    here, there, unlike_here = places[used], offsets[used], unlike[used]
    drift = design(here, pivot, terms)
    diagonal = float(np.hypot(*np.ptp(places, axis=0)))
    thin = slice(None, None, -(-len(here) // MOST_TILES))
    owns = OWN if np.ptp(unlike) > 0 else OWN[:1]
    tries = []
    for reach in diagonal * np.array(RANGES):
        alike = correlation(here[thin], here[thin], reach)
        for share in SHARES if reach == diagonal * RANGES[0] else SHARES[1:]:
            for own in owns:
                alone = 1.0 + own * (unlike_here[thin] - 1.0)
                fit = _Fit.of(there[thin], drift[thin], alike, float(reach), share, alone)
                tries.append((fit, own))
    cost = np.array([fit.cost for fit, _ in tries])
    odds = np.exp(-0.5 * (cost - cost.min()))
    odds /= odds.sum()
    found = []
    for weight, (fit, own) in zip(odds, tries, strict=True):
        if weight > 1e-3:
            whole = fit
            if len(here[thin]) < len(here):
                alike = correlation(here, here, fit.reach)
                alone = 1.0 + own * (unlike_here - 1.0)
                whole = _Fit.of(there, drift, alike, fit.reach, fit.share, alone)
            found.append((weight, (whole, own), *_over_ground(whole, here, drift, ground, pivot)))
    total = sum(weight for weight, *_ in found)
    answer = sum(weight * a for weight, _, a, _ in found) / total
    covariance = sum(w * (c + np.outer(a - answer, a - answer)) for w, _, a, c in found) / total
    best, own = max(found, key=lambda entry: entry[0])[1]
    field = Field(here, pivot, best.answer, best.share * best.pulls, best.reach)
    alone = (1.0 - best.share) * (1.0 + own * (unlike - 1.0))
    fits = _fitting(best, places, offsets, alone, used, pivot)
    return Motion(answer, covariance, used, field), fits


def _over_ground(
    fit: _Fit, places: Float64, drift: Float64, ground: Ground, pivot: Float64
) -> tuple[Float64, Float64]:
    """Best motion over the ground, drift and warp together, and its covariance."""
    over = design(ground.places, pivot, drift.shape[2])
    area = ground.share[:, None, None]
    normal = np.einsum("gik,gil->kl", over, area * over)
    # (2, k, G): what a field at each place, along each axis, does to the answer
    weights = np.linalg.solve(normal, (area * over).reshape(-1, over.shape[2]).T)
    weights = weights.reshape(over.shape[2], len(over), 2).transpose(2, 0, 1)
    near = fit.share * correlation(ground.places, places, fit.reach)
    within = fit.share * correlation(ground.places, ground.places, fit.reach)
    known = weights @ near  # (2, k, M): covariance of the answer with each tile
    gain = known @ fit.inverse  # axis by axis
    answer = fit.answer + sum(gain[axis] @ fit.left[:, axis] for axis in (0, 1))
    rest = np.eye(drift.shape[2]) - sum(gain[axis] @ drift[:, axis] for axis in (0, 1))
    covariance = rest @ np.linalg.solve(fit.normal, rest.T)
    for axis in (0, 1):
        covariance += weights[axis] @ within @ weights[axis].T - gain[axis] @ known[axis].T
    return answer, fit.variance * 0.5 * (covariance + covariance.T)


def _fitting(
    fit: _Fit, places: Float64, offsets: Float64, alone: Float64, used: Bool, pivot: Float64
) -> Bool:
    """Tell which tiles lie where all the others, drift and warp, expect them."""
    here = places[used]
    drift = design(here, pivot, len(fit.answer))
    weighed = np.stack([fit.inverse[axis] @ drift[:, axis] for axis in (0, 1)], axis=1)
    # leave-one-out (Dubrule, Mathematical Geology 15, 1983): (P d)_m / P_mm, of variance s²/P_mm
    inner = np.diagonal(fit.inverse, axis1=1, axis2=2).T - np.einsum(
        "mik,kl,mil->mi", weighed, np.linalg.inv(fit.normal), weighed
    )
    pulls = fit.pulls
    deviation = (pulls**2 / np.maximum(inner, 1e-12)).sum(axis=1) / fit.variance
    scale = max(float(np.median(deviation)) / (2 * np.log(2)), 1e-12)
    # the left-out ones are judged from the kept ones, as any other place would be
    result = np.zeros(len(used), bool)
    result[used] = deviation <= OUTLIER * scale
    out = ~used
    if out.any():
        near = fit.share * correlation(places[out], here, fit.reach)
        expected = design(places[out], pivot, len(fit.answer)) @ fit.answer + near @ pulls
        told = np.stack([((near @ part) * near).sum(axis=1) for part in fit.inverse], axis=1)
        variance = np.maximum(fit.share + alone[out] - told, 1e-12)
        away = ((offsets[out] - expected) ** 2 / variance).sum(axis=1)
        result[out] = away <= RETURN * scale * fit.variance
    return result if result.sum() >= 0.5 * used.sum() else used


def _near_neighbours(places: Float64, offsets: Float64) -> Bool:
    """Tell which tiles lie near the median of their eight neighbours: a start without outliers."""
    away = ((places[:, None] - places[None]) ** 2).sum(axis=2)
    away = np.round(away / max(float(away.max()), 1e-30), 9)  # rounding decides among no equals
    nearest = np.argsort(away, axis=1, kind="stable")[:, 1:9]
    apart = np.hypot(*(offsets - np.median(offsets[nearest], axis=1)).T)
    return np.asarray(apart <= 4 * max(float(np.median(apart)), 1e-9))
