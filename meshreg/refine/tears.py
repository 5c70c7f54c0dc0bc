"""A model that is torn, or of which a part has slid: two populations of tile offsets.

Models bend, smoothly; where a bundle of images hangs on the rest by few ties the two parts may lie
apart by a step. Tiles show both: a bend as a slow change of their offsets, a tear as a jump along a
line. Both are fitted, a cubic surface without a jump and a quadratic one with a jump at the best of
many lines, and the jump is believed where it explains what the smooth bend, with more coefficients,
does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshreg.records import Bool, Float64, Tear
from meshreg.refine.tiles import TileOffsets
from meshreg.statistics import RAYLEIGH, biweight

LEAST_TILES = 16
LEAST_SHARE = 0.12  # of the tiles: a smaller piece is ground that has changed
ABRUPT = 4.0  # times as far apart are neighbours across a tear as others; across a bend, up to 2.6
LEAST_HELD = 3.0  # tiles: two or three that match wrongly may be alike by chance
FALL = 0.5  # a jump must bring the squared error below this share of a smooth bend's
SURE = 5.0  # sigmas
TRIED = 8  # regions of those that explain most by least squares, that are fitted robustly
_SIDES = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


def tear_of_tiles(tiles: TileOffsets, resolution: float) -> Tear | None:
    """Find two populations of horizontal offsets; `resolution` [m] is what a tile is good for."""
    return find_tear(tiles.places, tiles.offsets, resolution)


def contradicts(tiles: TileOffsets, tear: Tear) -> bool:
    """Whether tiles of another channel see the torn part where the rest has it.

    A model that is torn takes its relief and its picture along; what one of them shows alone is
    ground that has changed.
    """
    from scipy.spatial import cKDTree

    if not len(tear.places):
        return False
    side = np.sqrt(np.ptp(tiles.places, axis=0).prod() / len(tiles.places))
    far, _ = cKDTree(tear.places).query(tiles.places)
    inside = far <= 0.5 * side
    if not LEAST_HELD <= inside.sum() < len(inside):
        return False
    apart = np.median(tiles.offsets[inside], axis=0) - np.median(tiles.offsets[~inside], axis=0)
    return bool(np.linalg.norm(apart) < 0.5 * tear.size)


def find_tear(places: Float64, values: Float64, resolution: float) -> Tear | None:
    """Tell whether values at places are two smooth surfaces that lie apart.

    Parameters
    ----------
    places : (M, 2) float64
        East and north of the tiles [m].
    values : (M, K) float64
        How far each must go along K axes [m].
    resolution : float
        No deviation of the tiles is taken to be smaller [m].

    Returns
    -------
    Tear or None
        None where a smooth bend explains the tiles as well, or they are too few.
    """
    count, axes = values.shape
    if count < LEAST_TILES:
        return None
    middle = places.mean(axis=0)
    arm = (places - middle) / max(float(np.abs(places - middle).max()), 1e-9)
    plain, rich = (1, 2) if count < 2 * LEAST_TILES else (2, 3)
    smooth = _polynomials(arm, rich)
    start = _like_neighbours(places, values).astype(np.float64)
    regions = _regions(arm)
    if not len(regions):
        return None
    base = _polynomials(arm, plain)
    likely = regions[np.argsort(_errors_with(base, regions, values, start), kind="stable")[:TRIED]]
    fits = [_fit(np.column_stack([base, part]), values, start, resolution) for part in likely]
    scale = min(fit.scale for fit in fits)
    chosen = int(np.argmin([fit.loss(scale) for fit in fits]))
    torn, best = fits[chosen], likely[chosen]
    design = np.column_stack([base, best])
    # a robust bend would set aside what lies along the tear: both are asked for the same tiles
    kept = torn.weights > 0
    bent = values[kept] - smooth[kept] @ np.linalg.lstsq(smooth[kept], values[kept], rcond=None)[0]
    freedom = kept.sum() - np.array([design.shape[1], smooth.shape[1]])
    error = np.array([(torn.size[kept] ** 2).sum(), (bent**2).sum()]) / np.maximum(freedom, 1)
    if error[0] > FALL * error[1]:
        return None
    # counted for the smaller part, whichever of the two was fitted
    apart = torn.answer[-1] if 2 * best.sum() <= count else -torn.answer[-1]
    covariance = np.linalg.pinv((design * torn.weights[:, None]).T @ design)
    sigma = torn.scale * float(np.sqrt(covariance[-1, -1]))
    sure = np.linalg.norm(apart) > SURE * sigma * np.sqrt(axes)
    # both parts must be held by tiles that agree with the model, not by a few that do not
    held = min(torn.weights[best].sum(), torn.weights[~best].sum())
    if not sure or held < max(0.5 * LEAST_SHARE * count, LEAST_HELD):
        return None
    if not _abrupt(places[kept], values[kept], best[kept]):
        return None
    best = best if 2 * best.sum() <= count else ~best
    away = arm[best].mean(axis=0) - arm[~best].mean(axis=0)
    side = _SIDES[round(float(np.arctan2(away[1], away[0])) / (np.pi / 4)) % 8]
    return Tear(np.asarray(apart), sigma, float(best.mean()), side, places[best])


@dataclass(frozen=True, eq=False)
class _Fit:
    answer: Float64  # (p, K)
    weights: Float64  # (M,)
    size: Float64  # (M,) lengths of the residuals [m]
    scale: float  # robust deviation along one axis [m]

    def loss(self, scale: float) -> float:
        """Tukey's biweight loss of the residuals at four deviations of `scale` [m]."""
        inner = np.clip(1 - (self.size / (4 * scale)) ** 2, 0, None)
        return float((1 - inner**3).sum())


def _fit(design: Float64, values: Float64, start: Float64, resolution: float) -> _Fit:
    """Least squares by Tukey's biweight at four robust deviations, from the weights of `start`."""
    weights = start
    for _ in range(20):
        weighted = design * weights[:, None]
        answer = np.linalg.lstsq(weighted.T @ design, weighted.T @ values, rcond=None)[0]
        size = np.linalg.norm(values - design @ answer, axis=1)
        freedom = max(1.0 - design.shape[1] / max(float((weights > 0).sum()), 1.0), 0.2)
        scale = float(np.median(size)) / RAYLEIGH[values.shape[1]] / np.sqrt(freedom)
        scale = max(scale, resolution)
        before, weights = weights, biweight(size / (4 * scale))
        if np.abs(weights - before).max() < 1e-4:
            break
    return _Fit(np.asarray(answer), weights, size, scale)


def _errors_with(base: Float64, regions: Bool, values: Float64, weights: Float64) -> Float64:
    """(R,) squared error that is left once each region may jump, all else by `base`."""
    root = np.sqrt(weights)[:, None]
    ortho = np.linalg.qr(base * root)[0]
    left = values * root
    left = left - ortho @ (ortho.T @ left)
    jumps = regions.T * root
    jumps = jumps - ortho @ (ortho.T @ jumps)
    power = np.maximum((jumps**2).sum(axis=0), 1e-9)
    return np.asarray((left**2).sum() - ((jumps.T @ left) ** 2).sum(axis=1) / power)


def _abrupt(places: Float64, values: Float64, part: Bool) -> bool:
    """Whether neighbours across the line differ by more than neighbours elsewhere do.

    A bend of a wavelength not much longer than the tiles changes as much everywhere.
    """
    from scipy.spatial import cKDTree

    near = cKDTree(places).query(places, k=min(5, len(places)))[1][:, 1:]
    steps = np.linalg.norm(values[near] - values[:, None], axis=2)
    across = part[near] != part[:, None]
    if not across.any() or across.all():
        return True
    return bool(np.median(steps[across]) > ABRUPT * np.median(steps[~across]))


def _polynomials(arm: Float64, degree: int) -> Float64:
    x, y = arm.T
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack([x**i * y**j for i, j in powers], axis=1)


def _regions(arm: Float64) -> Bool:
    """(R, M): half planes, strips and corners, each with and without at least `LEAST_SHARE`."""
    halves: list[Bool] = []
    found: list[Bool] = []
    for angle in np.arange(8) * np.pi / 8:
        along = arm @ [np.cos(angle), np.sin(angle)]
        cuts = np.quantile(along, np.linspace(0.06, 0.94, 12))
        above = [along > cut for cut in cuts]
        found += above
        found += [a & ~b for k, a in enumerate(above) for b in above[k + 2 :]]
        halves += above[1::2]
    turned = [*halves, *(~half for half in halves)]
    found += [a & b for k, a in enumerate(turned) for b in turned[k + 1 :]]
    regions = np.unique(np.array(found), axis=0)
    share = regions.mean(axis=1)
    return np.asarray(regions[(share >= LEAST_SHARE) & (share <= 1 - LEAST_SHARE)])


def _like_neighbours(places: Float64, values: Float64) -> Bool:
    """Tell which tiles are like two of their six neighbours: a start without outliers.

    Of a row of tiles between a tear and the survey's edge no more lie on their own side.
    """
    from scipy.spatial import cKDTree

    nearest = cKDTree(places).query(places, k=min(7, len(places)))[1][:, 1:]
    apart = np.linalg.norm(values[nearest] - values[:, None], axis=2)
    second = np.sort(apart, axis=1)[:, 1]
    return np.asarray(second <= 5 * max(float(np.median(second)), 1e-9))
