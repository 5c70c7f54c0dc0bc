"""The last millimetres on the 3-D surfaces themselves: ICP from the pose found.

A DEM sees a reef from above; its overhangs and walls, where much of the coral is, are seen only
here. Opt-in (`refine.surfaces`), and believed only where it is a small step that makes the surfaces
agree better. It looks at ground that has not changed, as the heights tell it, and is never surer
than what it started from: a fit of points that lie close already does not see how the models bend.

Generalized ICP ("gicp"; Segal, Haehnel and Thrun, RSS 2009) is small_gicp's, in one thread, so that
the same points give the same answer. Point-to-plane ICP ("icp"; Chen and Medioni, 1992) with
Tukey's robust kernel is Open3D's, which needs OpenGL's and X11's libraries.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from meshreg.errors import UsageError
from meshreg.records import Bool, Float64, Grid, Maps, Mesh, Survey, Transform
from meshreg.statistics import biweight, block_sandwich

GATE = 0.03  # m: points further apart have changed, or are not the same surface
PLAINLY = 0.8  # of the distance before: on level ground a slide changes little
MAX_POINTS = 1_000_000
BLOCKS = 7  # along the longer side: parcels of ground that err alike


@dataclass(frozen=True, eq=False)
class Polished:
    """What ICP on the surfaces says.

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
    doubt : str
        Why the answer that was given cannot be accepted, if so.
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
    doubt: str = ""

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
    if kind != "none" and kind not in ALIGNERS:
        raise UsageError(
            f"refine.surfaces is {kind!r}.", remedy=f"Use one of none, {', '.join(ALIGNERS)}."
        )


def polish(  # noqa: PLR0913, PLR0917
    reference: Survey,
    moving: Survey,
    transform: Transform,
    place: Float64,
    error: Mapping[str, Any] | None,
    stable: tuple[Bool, Grid] | None,
    seed: int = 0,
    max_points: int = MAX_POINTS,
    kind: str = "gicp",
) -> Polished:
    """Polish a registration by ICP on both surfaces.

    Points of both surveys (sampled over a mesh's area) are paired within 3 cm, in an origin of
    their own.

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
    kind : str
        Key in `ALIGNERS`.

    Returns
    -------
    Polished
        Accepted only if the centroid moves, along each axis, by at most three sigmas or 3 cm, and
        the points within the gate lie closer than before.

    Raises
    ------
    UsageError
        If `kind` is unknown, or its library cannot be imported.
    """
    if isinstance(reference.geometry, Maps) or isinstance(moving.geometry, Maps):
        return _kept(transform, "maps have no 3-D surface to polish on")
    check_surfaces(kind)
    aligner = ALIGNERS[kind]
    library = _library(kind, aligner.load)
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
    clouds, normals = aligner.prepare(library, fixed, loose)
    before, share, _ = _agreement(fixed, normals, loose)
    if share < 0.1:
        return _kept(transform, "the surfaces lie too far apart to polish on")
    step = _proper(aligner.align(library, *clouds))
    moved = np.abs(step.offset)
    after, share_after, scatter = _agreement(fixed, normals, step.apply(loose))
    sigma = np.array([error[axis] for axis in "xyz"]) if error else np.zeros(3)
    small = bool((moved <= np.maximum(3 * sigma, GATE)).all())
    better = after < before and share_after >= 0.98 * share
    length = float(np.linalg.norm(step.offset))
    if not (small and better):
        why = "it does not bring them closer" if small else f"it would move it by {length:.3f} m"
        left_out = f"polishing on the surfaces is left out: {why}"
        doubt = ""
        if better and after < PLAINLY * before:
            doubt = (
                f"the surfaces themselves fit better {length:.2g} m away ({1000 * before:.1f} to "
                f"{1000 * after:.1f} mm rms), further than the answer may err"
            )
        return Polished(transform, False, length, before, after, left_out, doubt=doubt)
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
    sandwich over square blocks of ground, as of the heights. Zero where fewer
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
    weight = biweight(along / GATE)
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


def _library(kind: str, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except (ImportError, OSError) as error:
        raise UsageError(
            f"refine.surfaces is {kind!r}, but its library cannot be imported: {error}.",
            remedy="Run `meshreg doctor` to see what is missing, or leave it at 'none'.",
        ) from error


def _load_small_gicp() -> Any:
    import small_gicp

    return small_gicp


def _load_open3d() -> Any:
    from meshreg.refine.open3d_loading import load_open3d

    return load_open3d()


Clouds = tuple[tuple[Any, Any], Float64]  # reference and moving as the library has them; normals


def _gicp_clouds(gicp: Any, fixed: Float64, loose: Float64) -> Clouds:
    clouds = gicp.PointCloud(fixed), gicp.PointCloud(loose)
    for cloud in clouds:
        gicp.estimate_normals_covariances(cloud, num_neighbors=20)
    return clouds, clouds[0].normals()[:, :3]


def _by_gicp(gicp: Any, fixed: Any, loose: Any) -> Float64:
    found = gicp.align(
        fixed,
        loose,
        gicp.KdTree(fixed),
        max_correspondence_distance=GATE,
        max_iterations=60,
        rotation_epsilon=1e-7,
        translation_epsilon=1e-7,
    )
    return np.asarray(found.T_target_source, float)


def _icp_clouds(o3d: Any, fixed: Float64, loose: Float64) -> Clouds:
    clouds = tuple(
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (fixed, loose)
    )
    clouds[0].estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
    return (clouds[0], clouds[1]), np.asarray(clouds[0].normals)


def _by_icp(o3d: Any, fixed: Any, loose: Any) -> Float64:
    pipeline = o3d.pipelines.registration
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        found = pipeline.registration_icp(
            loose,
            fixed,
            GATE,
            np.eye(4),
            pipeline.TransformationEstimationPointToPlane(pipeline.TukeyLoss(k=GATE)),
            pipeline.ICPConvergenceCriteria(1e-9, 1e-9, 60),
        )
    return np.asarray(found.transformation, float)


@dataclass(frozen=True)
class Aligner:
    """A library's way from two clouds to the (4, 4) step that lays the second on the first."""

    load: Callable[[], Any]
    prepare: Callable[[Any, Float64, Float64], Clouds]
    align: Callable[[Any, Any, Any], Float64]


ALIGNERS: Mapping[str, Aligner] = {
    "gicp": Aligner(_load_small_gicp, _gicp_clouds, _by_gicp),
    "icp": Aligner(_load_open3d, _icp_clouds, _by_icp),
}
