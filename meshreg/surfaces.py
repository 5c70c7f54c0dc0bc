"""The last millimetres on the 3-D surfaces themselves: generalized ICP from the pose found.

A DEM sees a reef from above; its overhangs and walls, where much of the coral is, are seen only
here. Opt-in (`refine.surfaces = "gicp"`), and believed only where it is a small step that makes the
surfaces agree better. It looks at ground that has not changed, as the
heights tell it, and is never surer than what it started from: a fit of points that lie close
already does not see how the models bend.

Generalized ICP (Segal, Haehnel and Thrun, RSS 2009) is small_gicp's, in one thread, so that the
same points give the same answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from meshreg.errors import UsageError
from meshreg.sandwich import block_sandwich
from meshreg.types import Bool, Float64, Grid, Maps, Mesh, Survey, Transform

GATE = 0.03  # m: points further apart have changed, or are not the same surface
MAX_POINTS = 1_000_000
SURFACES = ("none", "gicp")
BLOCKS = 7  # along the longer side: parcels of ground that err alike


@dataclass(frozen=True, eq=False)
class Polished:
    """What generalized ICP says.

    Attributes
    ----------
    transform : Transform
        `reference_from_moving`: the polished one where it was accepted, else the one given.
    accepted : bool
    moved : float
        How far the overlap's centroid went [m].
    before, after : float
        Root mean square distance of the moving points from the reference's tangent planes [m], of
        pairs within the gate.
    note : str
        What the user should know.
    home : (3,) float64
        Where the step was taken: the overlap's centroid, absolute in the reference [m].
    step : (6,) float64
        East, north, up [m] and right-handed turns about these [rad] that were added there.
    scatter : (6, 6) float64
        Covariance of the step there, from blocks of ground; zero where they are too few.
    """

    transform: Transform
    accepted: bool
    moved: float
    before: float
    after: float
    note: str
    home: Float64 = field(default_factory=lambda: np.zeros(3))
    step: Float64 = field(default_factory=lambda: np.zeros(6))
    scatter: Float64 = field(default_factory=lambda: np.zeros((6, 6)))

    def widened(self, covariance: Float64) -> Float64:
        """Return what the covariance (7, 7) at `home` of the pose given becomes.

        Nowhere smaller than that, nor than the scatter of the blocks; and the step itself, by
        which two ways of reading the same ground differ, counts as one deviation.
        """
        if not self.accepted:
            return covariance
        # angles in metres at a metre's arm, so that the eigenvalues are of one unit
        values, axes = np.linalg.eigh(self.scatter - covariance[:6, :6])
        more = (axes * np.maximum(values, 0.0)) @ axes.T + np.outer(self.step, self.step)
        wide = covariance.copy()
        wide[:6, :6] += 0.5 * (more + more.T)
        return wide


def check_surfaces(kind: str) -> None:
    """Raise UsageError for an unknown `refine.surfaces`."""
    if kind not in SURFACES:
        raise UsageError(
            f"refine.surfaces is {kind!r}.", remedy=f"Use one of {', '.join(SURFACES)}."
        )


def polish(
    reference: Survey,
    moving: Survey,
    transform: Transform,
    place: Float64,
    error: Mapping[str, Any] | None,
    stable: tuple[Bool, Grid] | None,
    seed: int = 0,
    max_points: int = MAX_POINTS,
) -> Polished:
    """Polish a registration by generalized ICP (Segal, Haehnel and Thrun 2009) on both surfaces.

    Points of both surveys (sampled over a mesh's area) are paired within 3 cm, with Tukey's
    robust kernel over the same width, in an origin of their own.

    Parameters
    ----------
    reference, moving : Survey
        Meshes or point clouds; maps have no 3-D surface.
    transform : Transform
        The pose found, `reference_from_moving`.
    place : (3,) float64
        Centroid of the overlap, absolute in the moving survey [m].
    error : mapping or None
        Standard deviations x, y, z there [m] (`Registration.registration_error`).
    stable : ((H, W) bool, Grid) or None
        Where the ground has not changed, in the moving survey as delivered: masked, changed and
        unknown cells are False. None where it could not be told, and nothing is polished.
    seed : int
        Of the points' draw.
    max_points : int
        Of each survey.

    Returns
    -------
    Polished
        Accepted only if the centroid moves, along each axis, by at most three sigmas or 3 cm, and
        the points within the gate lie closer than before.

    Raises
    ------
    UsageError
        If small_gicp cannot be imported.
    """
    if isinstance(reference.geometry, Maps) or isinstance(moving.geometry, Maps):
        return _kept(transform, "maps have no 3-D surface to polish on")
    gicp = _small_gicp()
    if stable is None:
        return _kept(transform, "too little stable ground to polish on")
    home = transform.apply(place)
    rng = np.random.default_rng(seed)
    fixed = sampled(reference, max_points, rng) - home
    points = sampled(moving, max_points, rng)
    loose, trusted = transform.apply(points) - home, _trusted(points, *stable)
    fixed, (loose, trusted) = _shared(fixed, loose, trusted)
    loose = loose[trusted]
    if min(len(fixed), len(loose)) < 1000:
        return _kept(transform, "too few points in common to polish on")
    clouds = [gicp.PointCloud(points) for points in (fixed, loose)]
    for cloud in clouds:
        gicp.estimate_normals_covariances(cloud, num_neighbors=20)
    normals = clouds[0].normals()[:, :3]
    before, share, _ = _agreement(fixed, normals, loose)
    if share < 0.1:
        return _kept(transform, "the surfaces lie too far apart to polish on")
    found = gicp.align(
        *clouds,
        gicp.KdTree(clouds[0]),
        max_correspondence_distance=GATE,
        max_iterations=60,
        rotation_epsilon=1e-7,
        translation_epsilon=1e-7,
    )
    step = _proper(np.asarray(found.T_target_source))
    moved = np.abs(step.offset)
    after, share_after, scatter = _agreement(fixed, normals, step.apply(loose))
    sigma = np.array([error[axis] for axis in "xyz"]) if error else np.zeros(3)
    small = bool((moved <= np.maximum(3 * sigma, GATE)).all())
    better = after < before and share_after >= 0.98 * share
    length = float(np.linalg.norm(step.offset))
    if not (small and better):
        why = "it does not bring them closer" if small else f"it would move it by {length:.3f} m"
        return Polished(
            transform, False, length, before, after, f"polishing on the surfaces is left out: {why}"
        )
    turn = 0.5 * (step.rotation - step.rotation.T)  # of milliradians: the vector of the turn
    taken = np.append(step.offset, [turn[2, 1], turn[0, 2], turn[1, 0]])
    step = Transform(step.rotation, 1.0, step.offset, home)
    note = (
        f"polished on the surfaces: moved by {1000 * length:.1f} mm, "
        f"distance {1000 * before:.1f} mm to {1000 * after:.1f} mm rms"
    )
    whole = (step @ transform).at(transform.pivot)
    return Polished(whole, True, length, before, after, note, home, taken, scatter)


def sampled(survey: Survey, count: int, rng: np.random.Generator) -> Float64:
    """Absolute points (N, 3) on a survey: a cloud's own, or uniform over a mesh's area."""
    geometry = survey.geometry
    assert not isinstance(geometry, Maps)
    if not isinstance(geometry, Mesh) or not len(geometry.faces):
        points = geometry.points
        if len(points) > count:
            points = points[rng.choice(len(points), count, replace=False)]
        return np.asarray(points + survey.origin)
    corners = geometry.vertices[geometry.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    total = np.cumsum(area)
    number = min(count, 2 * len(geometry.faces))
    face = np.searchsorted(total, rng.random(number) * total[-1])
    u, v = rng.random((2, number))
    over = u + v > 1  # fold the square into the triangle
    u, v = np.where(over, 1 - u, u)[:, None], np.where(over, 1 - v, v)[:, None]
    a, b, c = (corners[np.minimum(face, len(area) - 1), k] for k in range(3))
    return np.asarray(a + u * (b - a) + v * (c - a) + survey.origin)


def _trusted(points: Float64, stable: Bool, grid: Grid) -> Bool:
    """Tell which points (N, 3) stand on ground that has not changed."""
    at = np.rint(np.stack(grid.row_col(points[:, 0], points[:, 1]))).astype(int)
    rows, cols = grid.shape
    inside = np.asarray((at[0] >= 0) & (at[0] < rows) & (at[1] >= 0) & (at[1] < cols))
    inside[inside] = stable[tuple(at[:, inside])]
    return inside


def _shared(fixed: Float64, loose: Float64, trusted: Bool) -> tuple[Float64, tuple[Float64, Bool]]:
    """Return the points of each within the other's bounding box and the gate."""
    kept = []
    for own, other in ((fixed, loose), (loose, fixed)):
        if not len(other):
            return fixed[:0], (loose[:0], trusted[:0])
        low, high = other.min(axis=0) - GATE, other.max(axis=0) + GATE
        kept.append(((own >= low) & (own <= high)).all(axis=1))
    return fixed[kept[0]], (loose[kept[1]], trusted[kept[1]])


def _agreement(fixed: Float64, normals: Float64, loose: Float64) -> tuple[float, float, Float64]:
    """Rms distance [m] from the tangent planes, share within the gate, covariance (6, 6).

    With ``r = n . (p - q)`` and ``J = (n, p × n)``, weights by Tukey's biweight over the gate: the
    sandwich (`meshreg.sandwich`) over square blocks of ground, as of the heights. Zero where fewer
    than two blocks a parameter are left.
    """
    from scipy.spatial import cKDTree

    loose = loose[:: max(1, len(loose) // 100_000)]
    far, which = cKDTree(fixed).query(loose, distance_upper_bound=GATE)
    near = np.isfinite(far)
    if not near.any():
        return float("nan"), 0.0, np.zeros((6, 6))
    points, normal = loose[near], normals[which[near]]
    along = ((points - fixed[which[near]]) * normal).sum(axis=1)
    rms, share = float(np.sqrt(np.mean(along**2))), float(near.mean())
    design = np.hstack([normal, np.cross(points, normal)])
    weight = (1 - (along / GATE) ** 2) ** 2
    low = points[:, :2].min(axis=0)
    side = float(np.ptp(points[:, :2], axis=0).max()) / BLOCKS
    cell = ((points[:, :2] - low) / side).astype(int)
    _, block = np.unique(cell[:, 0] * (BLOCKS + 1) + cell[:, 1], return_inverse=True)
    count = int(block.max()) + 1
    if count < 12:
        return rms, share, np.zeros((6, 6))
    scores = design * (weight * along)[:, None]
    curvature = (design * weight[:, None]).T @ design
    return rms, share, block_sandwich(curvature, scores, block, design.shape[1])


def _proper(matrix: Float64) -> Transform:
    """Return a rigid matrix about the local origin, its rotation orthogonal to the last bit."""
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    return Transform(u @ vt, 1.0, matrix[:3, 3])


def _kept(transform: Transform, why: str) -> Polished:
    nan = float("nan")
    return Polished(transform, False, 0.0, nan, nan, why)


def _small_gicp() -> Any:
    try:
        import small_gicp
    except (ImportError, OSError) as error:
        raise UsageError(
            f"refine.surfaces is 'gicp', but small_gicp cannot be imported: {error}.",
            remedy="Run `meshreg doctor` to see what is missing, or leave it at 'none'.",
        ) from error
    return small_gicp
