"""The frame of a COLMAP model: which way is up, and where, how large and how turned it lies.

A model's own frame is arbitrary in scale, place and tilt. Up comes from the cameras and the ground;
the rest from camera positions, by a similarity that a share of wrong positions does not disturb.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshreg.records import Bool, Float64

_DRAWS = 500
_ROUNDS = 50
# Of the length of a normal vector in 2 and 3 dimensions: its median and its 99 % quantile.
_MEDIAN = {2: 1.17741, 3: 1.53817}
_REACH = {2: 3.03485, 3: 3.36821}
MAX_TILT = np.radians(30.0)


@dataclass(frozen=True, eq=False)
class Similarity:
    """``to = scale * rotation @ of + shift``, with what speaks for it.

    Attributes
    ----------
    scale : float
    rotation : (3, 3) float64
    shift : (3,) float64
    inliers : (N,) bool
        The positions that it agrees with.
    sigma : float
        Standard deviation of one coordinate of a position [m], from the inliers; NaN where no
        position is left over to tell.
    """

    scale: float
    rotation: Float64
    shift: Float64
    inliers: Bool
    sigma: float

    def apply(self, points: Float64) -> Float64:
        """Move points (N, 3)."""
        return points @ (self.scale * self.rotation).T + self.shift


def turn_up(up: Float64) -> Float64:
    """Return the (3, 3) rotation that takes the direction `up` to z: the one of least angle.

    A direction that points down is turned over about x first. Models often look along +z with y
    downward, as their first camera did; its picture's upper edge then comes to lie in the north.
    """
    up = up / np.linalg.norm(up)
    if up[2] < 0:
        over = np.diag([1.0, -1.0, -1.0])
        return turn_up(over @ up) @ over
    v = np.cross(up, [0.0, 0.0, 1.0])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + up[2]))


def ground_up(points: Float64, camera_up: Float64) -> Float64:
    """Return the normal of the ground, on the side of the cameras.

    Least absolute deviations of height over a plane (iteratively reweighted), in a frame levelled
    by the cameras, then levelled again by the plane until it lies still: a convex fit that half
    of the points being walls, fish or noise does not take over. Far-off points are left out.

    Parameters
    ----------
    points : (N, 3) float64
    camera_up : (3,) float64
        Minus the mean viewing direction of the cameras.
    """
    low, high = np.percentile(points, [5, 95], axis=0)
    margin = 0.25 * (high - low)
    near = points[((points >= low - margin) & (points <= high + margin)).all(axis=1)]
    near = near[:: max(1, len(near) // 100_000)]
    up = camera_up / np.linalg.norm(camera_up)
    for _ in range(10):
        turn = turn_up(up)
        local = (near - near.mean(axis=0)) @ turn.T
        slope = _flattest_plane(local)
        normal = turn.T @ np.array([-slope[0], -slope[1], 1.0])
        up = normal / np.linalg.norm(normal)
        if np.hypot(*slope) < 1e-6:
            break
    return np.asarray(up)


def _flattest_plane(points: Float64) -> Float64:
    """Return the slopes (x, y) of the plane z = ax + by + c of least absolute deviations."""
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    size = float(np.ptp(points[:, 2])) or 1.0
    weights = np.ones(len(points))
    solution = np.zeros(3)
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)[:, None]
        new = np.linalg.lstsq(design * root, points[:, 2] * root[:, 0], rcond=None)[0]
        still = np.abs(new - solution)[:2].max() < 1e-7
        solution = new
        if still:
            break
        weights = 1 / np.maximum(np.abs(points[:, 2] - design @ solution), 1e-4 * size)
    return np.asarray(solution[:2])


def umeyama(of: Float64, to: Float64) -> tuple[float, Float64, Float64]:
    """Return scale, rotation and shift of the least-squares similarity between matched points.

    Parameters
    ----------
    of, to : (N, D) float64

    Returns
    -------
    scale, rotation (D, D), shift (D,)
        Umeyama (1991), IEEE PAMI 13 (4), equations 40-42, doi:10.1109/34.88573.
    """
    middle_of, middle_to = of.mean(axis=0), to.mean(axis=0)
    a, b = of - middle_of, to - middle_to
    u, spread, vt = np.linalg.svd(b.T @ a)
    sign = np.ones(len(spread))
    sign[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0
    rotation = (u * sign) @ vt
    size = float((a**2).sum())
    scale = float(spread @ sign) / size if size > 0 else 0.0
    return scale, rotation, middle_to - scale * rotation @ middle_of


def robust_similarity(of: Float64, to: Float64, *, level: bool = False) -> Similarity:
    """Fit a similarity to matched points of which up to almost half may be wrong.

    Least median of squares over seeded draws of three (two if level) matches, then least squares
    over all within the 99 % bound of the spread it implies, until that set is stable.

    Parameters
    ----------
    of, to : (N, 3) float64
        Camera centres in the model and in the world, N >= 3.
    level : bool
        `of` is level already: solve scale, yaw and shift from east and north alone, and the
        height's shift by the median.
    """
    dimension = 2 if level else 3
    source, target = of[:, :dimension], to[:, :dimension]
    count = len(source)
    sample = min(dimension, count)
    draws = np.random.default_rng(0)
    best = (np.inf, umeyama(source, target))
    for _ in range(_DRAWS if count > sample else 0):
        chosen = draws.choice(count, sample, replace=False)
        fit = umeyama(source[chosen], target[chosen])
        median = float(np.median(_misses(fit, source, target)))
        if fit[0] > 0 and median < best[0]:
            best = (median, fit)
    fit = best[1]
    inliers = np.ones(count, bool)
    for _ in range(_ROUNDS):
        miss = _misses(fit, source, target)
        # The factor makes up for the median of few (Rousseeuw and Leroy 1987, chapter 5).
        spread = (1 + 5 / max(count - sample, 1)) * float(np.median(miss)) / _MEDIAN[dimension]
        found = miss <= max(_REACH[dimension] * spread, 1e-9 * float(np.abs(target).max()))
        if found.sum() <= sample or np.array_equal(found, inliers):
            break
        inliers = found
        fit = umeyama(source[inliers], target[inliers])
    scale, turn, move = fit
    rotation, shift = np.eye(3), np.zeros(3)
    rotation[:dimension, :dimension], shift[:dimension] = turn, move
    if level:
        shift[2] = float(np.median((to - scale * of)[inliers, 2]))
    return Similarity(scale, rotation, shift, inliers, _sigma(fit, source, target, inliers))


def _misses(fit: tuple[float, Float64, Float64], of: Float64, to: Float64) -> Float64:
    scale, rotation, shift = fit
    return np.asarray(np.linalg.norm(of @ (scale * rotation).T + shift - to, axis=1))


def _sigma(fit: tuple[float, Float64, Float64], of: Float64, to: Float64, used: Bool) -> float:
    dimension = of.shape[1]
    free = dimension * int(used.sum()) - (7 if dimension == 3 else 4)
    if free <= 0:
        return float("nan")
    return float(np.sqrt((_misses(fit, of[used], to[used]) ** 2).sum() / free))


def tilt_sigma(similarity: Similarity, of: Float64) -> float:
    """Return how well the positions know the tilt [rad]: the spread across their line decides."""
    used = of[similarity.inliers] * similarity.scale
    spread = np.linalg.svd(used - used.mean(axis=0), compute_uv=False)
    sigma = similarity.sigma
    return sigma / float(spread[1]) if np.isfinite(sigma) and spread[1] > 0 else float("inf")


def scale_sigma(similarity: Similarity, of: Float64) -> float:
    """Return the relative standard deviation of the scale; NaN where nothing tells."""
    used = of[similarity.inliers] * similarity.scale
    size = float(np.sqrt(((used - used.mean(axis=0)) ** 2).sum()))
    return similarity.sigma / size if size > 0 else float("nan")
