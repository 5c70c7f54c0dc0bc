"""What a survey measures: where it lies, how far apart its points and texels are."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from meshreg.errors import InputError
from meshreg.records import Float64, Maps, Mesh, PointCloud, Survey, Transform, ends

CLOSEST = 1e-9  # m; nearer points are one place in numbers that hold a survey's
_SAMPLE = 50_000  # faces or points looked at; every n-th, so that the answer is repeatable


@dataclass(frozen=True)
class Spacing:
    """Typical distances on the ground.

    Attributes
    ----------
    points : float
        Between neighbouring vertices, points or height cells [m].
    texels : float or None
        Between neighbouring texels [m]; None without a texture or an orthomosaic.
    gridded : bool
        Whether a cloud's points stand on a regular grid, one in each of its squares.
    """

    points: float
    texels: float | None
    gridded: bool = False


_MEASURED: WeakKeyDictionary[Survey, Spacing] = WeakKeyDictionary()  # asked for seven times a pair


def measure_spacing(survey: Survey) -> Spacing:
    """Measure how far apart the survey's points and texels are, seen from above.

    A mesh: the median edge, and the median over the ground of the square root of ground area per
    texel. A cloud: the square root of occupied area per point. Maps: their cells. At most 200,000
    faces or points are looked at (every n-th).

    Raises
    ------
    InputError
        If the survey covers no ground: no faces, or all points in one place or on one line.
    """
    if survey not in _MEASURED:
        _MEASURED[survey] = _measured(survey)
    return _MEASURED[survey]


def _measured(survey: Survey) -> Spacing:
    geometry = survey.geometry
    if isinstance(geometry, Maps):
        texels = None if geometry.color_grid is None else geometry.color_grid.cell
        return Spacing(geometry.height_grid.cell, texels)
    if isinstance(geometry, PointCloud):
        points = _cloud_spacing(geometry.points)
        texels = None
    else:
        points = _edge(geometry)
        texels = median_texel(*texel_sizes(geometry)[1:])
    if points is None or not (points >= CLOSEST and _extent(geometry.points) >= CLOSEST):
        raise InputError(
            f"{survey.name} covers no ground: its points lie in one place or on one line.",
            file=survey.source[0].path if survey.source else None,
            remedy="Check the file, or which axis points up (--up, --axes).",
        )
    gridded = isinstance(geometry, PointCloud) and _on_a_grid(geometry.points, points)
    return Spacing(points, texels, gridded)


def _extent(points: Float64) -> float:
    """Return the shorter side [m] of the box around finite points, seen from above."""
    return float(np.ptp(np.stack(_finite_bounds(points))[:, :2], axis=0).min())


def _edge(mesh: Mesh) -> float | None:
    faces = mesh.faces[:: max(1, len(mesh.faces) // _SAMPLE)]
    corners = mesh.vertices[faces][:, :, :2]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    edges = edges[np.isfinite(edges) & (edges > 0)]
    return float(np.median(edges)) if edges.size else None


def texel_sizes(mesh: Mesh) -> tuple[Float64, Float64, Float64]:
    """Look at a sample of the textured faces.

    Returns
    -------
    page : (n,) float64
        Index of the face's texture page.
    texel : (n,) float64
        Side of a texel on the ground, seen from above [m].
    area : (n,) float64
        Ground that the face covers [m²]: its weight.
    """
    if mesh.uv is None or mesh.face_texture is None:
        return np.empty(0), np.empty(0), np.empty(0)
    step = max(1, len(mesh.faces) // _SAMPLE)
    faces, uv, page = mesh.faces[::step], mesh.uv[::step], mesh.face_texture[::step]
    faces, uv, page = faces[page >= 0], uv[page >= 0], page[page >= 0]
    pixels = np.array([texture.size for texture in mesh.textures], float).reshape(-1, 2)
    ground = _area(mesh.vertices[faces][:, :, :2])
    texels = _area(uv.astype(np.float64)) * pixels[page].prod(axis=1)
    # A face that no camera saw often has all corners on one texel: it tells nothing.
    told = np.isfinite(ground * texels) & (ground > 0) & (texels > 1e-3)
    texel = np.sqrt(ground[told] / texels[told])
    return page[told].astype(np.float64), texel, ground[told]


def median_texel(texel: Float64, area: Float64) -> float | None:
    """Return the texel [m] that half the ground lies below; None without any."""
    if not texel.size:
        return None
    order = np.argsort(texel, kind="stable")
    total = np.cumsum(area[order])
    return float(texel[order][np.searchsorted(total, 0.5 * total[-1])])


def _area(corners: Float64) -> Float64:
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))


def _cloud_spacing(points: Float64) -> float | None:
    """Square root of occupied ground per point, the ground counted in squares of 25 points."""
    sample = points[:: max(1, len(points) // _SAMPLE), :2]
    sample = sample[np.isfinite(sample).all(axis=1)]
    if not len(sample):
        return None
    places = sample - sample.min(axis=0)
    extent = places.max(axis=0)
    square = 5.0 * np.sqrt(extent.prod() / len(sample))
    if not square > 0:
        return None
    area = 0.0
    for _ in range(3):  # holes shrink the ground, and with it the squares
        cols = int(extent[0] / square) + 1
        cells = np.floor(places / square).astype(np.int64)
        area = len(np.unique(cells[:, 1] * cols + cells[:, 0])) * square**2
        square = 5.0 * np.sqrt(area / len(sample))
    return float(np.sqrt(area / len(points)))


def _on_a_grid(points: Float64, spacing: float) -> bool:
    """Whether each point's nearest neighbour is as far as any other's: about one `spacing` [m].

    Scattered points have theirs at half of that on average, at any distance from nothing to more.
    Looked at in full around three points.
    """
    from scipy.spatial import cKDTree

    told = []
    for place in (0.25, 0.5, 0.75):
        middle = points[int(place * (len(points) - 1)), :2]
        near = (np.abs(points[:, 0] - middle[0]) < 10 * spacing) & (
            np.abs(points[:, 1] - middle[1]) < 10 * spacing
        )
        part = points[near, :2]
        if len(part) < 30:
            continue
        nearest = cKDTree(part).query(part, 2)[0][:, 1]
        low, middling, high = np.quantile(nearest, (0.1, 0.5, 0.9))
        told.append(high - low < 0.2 * middling and 0.8 < middling / spacing < 1.2)
    return bool(told) and all(told)


def survey_bounds(survey: Survey, transform: Transform | None = None) -> Float64:
    """(2, 3) float64: lowest and highest absolute east, north, up [m] after `transform`.

    Points that are not finite, and vertices in no face, do not count.

    Raises
    ------
    InputError
        If nothing is left to bound.
    """
    geometry = survey.geometry
    if isinstance(geometry, Maps):
        points = _map_corners(geometry)
    else:
        counted = geometry.faces if isinstance(geometry, Mesh) else geometry.points
        if transform is None and len(counted) and np.isfinite(survey.bounds).all():
            return survey.bounds  # looked at once, however often it is asked for
        points = geometry.points
        if isinstance(geometry, Mesh):
            used = np.zeros(len(points), bool)
            used[geometry.faces.ravel()] = True
            points = points if used.all() else points[used]
    if transform is None:
        return _checked_bounds(survey, np.stack(_finite_bounds(points)) + survey.origin)
    home = transform.apply(survey.origin)  # moved there once, not with each point
    points = points @ np.ascontiguousarray(transform.linear.T)
    return _checked_bounds(survey, np.stack(_finite_bounds(points)) + home)


def _finite_bounds(points: Float64) -> tuple[Float64, Float64]:
    if not len(points):
        return np.full(3, np.inf), np.full(3, -np.inf)
    low, high = ends(points)
    if not np.isfinite([low, high]).all():
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            return np.full(3, np.inf), np.full(3, -np.inf)
        low, high = ends(points)
    return low, high


def _checked_bounds(survey: Survey, bounds: Float64) -> Float64:
    if not np.isfinite(bounds).all():
        what = "triangles" if isinstance(survey.geometry, Mesh) else "points"
        raise InputError(
            f"{survey.name} has no {what} with finite coordinates.",
            file=survey.source[0].path if survey.source else None,
            remedy="Export it again.",
        )
    return bounds


def _map_corners(maps: Maps) -> Float64:
    heights = maps.height[np.isfinite(maps.height)]
    low, high = (float(heights.min()), float(heights.max())) if heights.size else (0.0, 0.0)
    corners = []
    for grid in (maps.height_grid, maps.color_grid):
        if grid is not None:
            west, south, east, north = grid.bounds
            corners += [
                (x, y, z) for x in (west, east) for y in (south, north) for z in (low, high)
            ]
    return np.array(corners)


def rounded(length: float) -> float:
    """Drop the last digits, in which 0.1 and 3 × 0.1 / 3 differ."""
    return float(f"{length:.12g}")
