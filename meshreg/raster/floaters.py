"""Fish and flecks in the water column: small pieces that stand clear above everything near them.

Conservative: a piece goes only if it is small, joined to nothing, and higher by a gap than
whatever lies under it or beside it. Coral stays: a branching colony is joined to its foot, and
the tip of a branch that the reconstruction tore off stays close to the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from meshreg.records import Bool, Float64, Int32, Mesh

_SMALL = 0.05  # share of the ground (mesh) that a floater may cover, and that all together may
_FEW = 0.01  # share of the points (cloud) that all floaters together may be
_MOST_SQUARES = 8000  # along a side of the raster in which the ground is looked up
_GAP_SPACINGS = 3.0  # least gap beneath a floater, in point spacings
_GAP_EXTENTS = 0.5  # and in its own horizontal extents: a table coral torn off its stem is wide


_LEVEL = np.cos(np.deg2rad(5.0))  # a tilt below that makes nothing float
_KEPT: WeakKeyDictionary[Mesh, Bool] = WeakKeyDictionary()  # a pair asks thrice


def faces_to_keep(mesh: Mesh, up: Float64, spacing: float) -> Bool:
    """Return for each face (F,) whether to keep it, or an empty array to keep all.

    Parameters
    ----------
    mesh : Mesh
    up : (3,) float64
        Direction in the mesh's own coordinates.
    spacing : float
        Of neighbouring vertices there.
    """
    up = up / np.linalg.norm(up)
    if up[2] >= _LEVEL:
        if mesh not in _KEPT:
            _KEPT[mesh] = _grounded(mesh.vertices, mesh.faces, spacing)
        return _KEPT[mesh]
    across = np.linalg.svd(up[None, :])[2][1:]  # any two that are level
    return _grounded(mesh.vertices @ np.vstack([across, up]).T, mesh.faces, spacing)


def _grounded(points: Float64, faces: Int32, spacing: float) -> Bool:
    from meshreg.raster import floater_kernels as kernels

    everything = np.empty(0, bool)
    label, count = kernels.face_pieces(points, faces)
    if count < 2:
        return everything
    area, low, high = kernels.piece_sizes(points, faces, label, count)
    if area[area > _SMALL * area.sum()].sum() < 0.5 * area.sum():
        # Faces that share no vertices, or charts cut apart along seams: join equal places.
        label, count = kernels.face_pieces(points, kernels.joined(points, faces))
        area, low, high = kernels.piece_sizes(points, faces, label, count)
    total = area.sum()
    main = area > _SMALL * total
    if main.all() or area[main].sum() < 0.5 * total:
        return everything
    square = 2.0 * spacing
    corners = np.flatnonzero(kernels.corners_of(faces, main[label], len(points)))
    gone = standing_clear(points[corners], low, high, ~main, spacing, square)
    if not gone.any() or area[gone].sum() > _SMALL * total:
        return everything
    return np.asarray(~gone[label])


def standing_clear(
    ground: Float64, low: Float64, high: Float64, small: Bool, spacing: float, square: float
) -> Bool:
    """Find the `small` pieces whose lowest point is clear above all `ground` near them.

    Near is: within the piece's outline, widened by half its extent or three spacings. A piece
    with no ground near it stays: it may be an island of the survey.

    Parameters
    ----------
    ground : (N, 3) float64
        Points of everything but the small pieces [m].
    low, high : (P, 3) float64
        Corners of each piece's box [m].
    small : (P,) bool
    spacing, square : float
        Between points, and side of the squares that the ground is looked up in [m].
    """
    tops = _tops(ground, square)
    gone = np.zeros(len(low), bool)
    for piece in np.flatnonzero(small):
        extent = float(np.linalg.norm(high[piece, :2] - low[piece, :2]))
        reach = max(_GAP_EXTENTS * extent, _GAP_SPACINGS * spacing)
        first = np.floor((low[piece, :2] - reach - tops.corner) / tops.square).astype(int).clip(0)
        last = np.floor((high[piece, :2] + reach - tops.corner) / tops.square).astype(int)
        if (last < 0).any():
            continue
        near = tops.top[first[1] : last[1] + 1, first[0] : last[0] + 1]
        highest = near.max(initial=-np.inf)
        gap = max(_GAP_SPACINGS * spacing, _GAP_EXTENTS * extent)
        gone[piece] = np.isfinite(highest) and low[piece, 2] - highest > gap
    return gone


def floating_points(points: Float64, spacing: float) -> Bool:
    """Return for each point (N,) whether to keep it, or an empty array to keep all.

    Seen from above first: the highest points of squares four spacings wide are joined to sheets
    where they differ by less than eight spacings; a small sheet that stands above all squares
    around it by a gap is a suspect. It may be the top of a steep coral head: so the points in
    suspect squares and beside them are joined to pieces by cubes three spacings wide, and a piece
    that does not reach the squares beside is judged as a mesh's. Where more than 1 % of the points
    would go they are no floaters (trees, a building) and all stay.

    Parameters
    ----------
    points : (N, 3) float64
        East, north, up [m]; not finite where there is none.
    spacing : float
        Of neighbouring points [m].
    """
    from scipy import ndimage

    from meshreg.raster import floater_kernels as kernels

    everything = np.empty(0, bool)
    square = 4.0 * spacing
    tops = _tops(points, square)
    sheet, count = kernels.sheets(tops.top, 2.0 * square)
    size, extent, step = kernels.sheet_steps(tops.top, sheet, count)
    clear = np.isfinite(step) & (
        step > np.maximum(2.0 * square, _GAP_EXTENTS * tops.square * extent)
    )
    clear &= size <= _SMALL * size.sum()
    if not clear.any():
        return everything
    suspect = (sheet >= 0) & clear[sheet]
    beside = ndimage.maximum_filter(suspect, 5) & ~suspect
    places, inside = tops.places, tops.places >= 0
    chosen = np.flatnonzero(inside & (suspect | beside).ravel()[places])
    label, count = _pieces(points[chosen], _GAP_SPACINGS * spacing)
    grounded = np.zeros(count, bool)
    grounded[label[beside.ravel()[places[chosen]]]] = True
    loose = ~grounded[label]
    if not loose.any():
        return everything
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, label[loose], points[chosen[loose]])
    np.maximum.at(high, label[loose], points[chosen[loose]])
    ground = inside.copy()
    ground[chosen[loose]] = False
    gone = standing_clear(points[ground], low, high, ~grounded, spacing, square)
    removed = chosen[gone[label]]
    if not len(removed) or len(removed) > _FEW * len(points):
        return everything
    keep = np.ones(len(points), bool)
    keep[removed] = False
    return keep


@dataclass(frozen=True)
class _Tops:
    """The highest point in each square of a raster whose rows go north."""

    corner: Float64  # south-west
    square: float
    top: Float64  # (rows, cols), -inf where there is no point
    places: Int32  # (N,) square of each point, -1 where it is not finite


def _tops(points: Float64, square: float) -> _Tops:
    import numba

    from meshreg.raster import floater_kernels as kernels

    low, high = kernels.plan_bounds(points)
    if not np.isfinite([low, high]).all():
        return _Tops(np.zeros(2), square, np.full((1, 1), -np.inf), np.full(len(points), -1))
    # A stray point far away must not make this raster large.
    square = max(square, float((high - low).max()) / _MOST_SQUARES)
    cols, rows = (int(size) + 1 for size in (high - low) / square)
    places = kernels.squares_of(points, low, square, (rows, cols))
    top = kernels.highest(points, places, (rows, cols), numba.get_num_threads())
    return _Tops(low, square, top, places)


def _pieces(points: Float64, cube: float) -> tuple[Int32, int]:
    """Label the sets of points whose cubes touch (by faces, edges or corners), and count them."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    cubes = np.floor((points - points.min(axis=0)) / cube).astype(np.int64) + 1
    size = cubes.max(axis=0) + 2
    steps = np.array([1, size[0], size[0] * size[1]])
    keys, own = np.unique(cubes @ steps, return_inverse=True)
    pairs = [np.stack([np.arange(len(keys))] * 2)]
    offsets = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3) @ steps
    for offset in offsets[offsets > 0]:
        at = np.searchsorted(keys, keys + offset)
        hit = np.flatnonzero((at < len(keys)) & (keys[at.clip(max=len(keys) - 1)] == keys + offset))
        pairs.append(np.stack([hit, at[hit]]))
    i, j = np.concatenate(pairs, axis=1)
    links = coo_array((np.ones(len(i), bool), (i, j)), shape=(len(keys), len(keys)))
    count, label = connected_components(links, directed=False)
    return label[own].astype(np.int32), int(count)
