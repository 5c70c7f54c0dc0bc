"""From the polygons of a file to clean triangles; shared by all mesh formats.

Corners are numbered through the file's flat list of polygon corners, so that whatever a format
keeps per corner (vertex, texture coordinate, normal) is picked with the same numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError

_BENT = 0.05  # a concave polygon further from its plane than this share of its size is "not flat"
_MAX_CONCAVE = 2000  # corners; ear clipping takes quadratic time

Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles cut from polygons.

    Attributes
    ----------
    cut : ((F, 3) int64, (F,) int64) or None
        Positions in the flat list of polygon corners, and the number of the polygon that each
        triangle was cut from; None where every polygon was a triangle already.
    n_polygons : int
    counts : mapping
        "empty" (polygons of fewer than three corners, left out), "polygons" (cut into more than
        one triangle), "concave" (cut by ear clipping), "bent" (concave and not flat).
    """

    cut: tuple[Int64, Int64] | None
    n_polygons: int
    counts: Mapping[str, int]

    @property
    def corners(self) -> Int64:
        """(F, 3) int64: positions in the flat list of polygon corners."""
        if self.cut is None:
            return np.arange(3 * self.n_polygons, dtype=np.int64).reshape(-1, 3)
        return self.cut[0]

    @property
    def polygon(self) -> Int64:
        """(F,) int64: number of the polygon that each triangle was cut from, from 0."""
        return np.arange(self.n_polygons, dtype=np.int64) if self.cut is None else self.cut[1]

    def pick_corners(self, values: Any) -> Any:
        """Turn (C, ...) values of polygon corners into (F, 3, ...) of triangle corners."""
        if self.cut is None:
            return values.reshape(-1, 3, *values.shape[1:])
        return values[self.cut[0]]

    def pick_faces(self, values: Any) -> Any:
        """Turn (P, ...) values of polygons into (F, ...) of triangles."""
        return values if self.cut is None else values[self.cut[1]]

    def notes(self) -> tuple[str, ...]:
        """Return one sentence for everything dropped or guessed."""
        said = []
        if self.counts["empty"]:
            said.append(f"{self.counts['empty']} faces of fewer than three corners were dropped.")
        if self.counts["bent"]:
            said.append(
                f"{self.counts['bent']} concave faces are not flat; how they were cut into "
                f"triangles is a choice."
            )
        return tuple(said)


def triangulate(
    points: NDArray[np.float64], sizes: Any, vertex: Any, file: Path | None = None
) -> Triangles:
    """Cut polygons into triangles that keep their corners' order.

    Convex polygons are fanned from their first corner; concave ones are cut by ear clipping
    (G. Meisters, Polygons have ears, Am. Math. Monthly 82, 1975) in the plane of the two axes in
    which they are largest.

    Parameters
    ----------
    points : (V, 3) float64
    sizes : (P,) int
        Corners of each polygon; fewer than three leave the polygon out.
    vertex : (C,) int
        Vertex of each corner, polygon after polygon; all within `points`.
    file : path, optional
        For the error's text.

    Returns
    -------
    Triangles

    Raises
    ------
    InputError
        A concave polygon of more than 2,000 corners.
    """
    sizes = np.asarray(sizes, np.int64)
    first = np.cumsum(sizes) - sizes
    counts = {"empty": int((sizes < 3).sum()), "polygons": 0, "concave": 0, "bent": 0}
    if (sizes == 3).all():
        return Triangles(None, len(sizes), counts)
    pieces = np.maximum(sizes - 2, 0)
    polygon = np.repeat(np.arange(len(sizes), dtype=np.int64), pieces)
    step = np.arange(len(polygon), dtype=np.int64) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    start = first[polygon]
    corners = np.stack([start, start + step + 1, start + step + 2], axis=1)
    many = np.flatnonzero(sizes > 3)
    counts["polygons"] = len(many)
    if len(many):
        from meshreg.io.masks.polygons_kernels import cut_concave

        vertex = np.ascontiguousarray(vertex, np.int64)
        place = (np.cumsum(pieces) - pieces)[many]
        concave, bent, large = cut_concave(
            np.ascontiguousarray(points, np.float64),
            vertex,
            np.stack([first[many], sizes[many], place], axis=1),
            corners,
            _BENT,
            _MAX_CONCAVE,
        )
        if large >= 0:
            raise InputError(
                f"A concave polygon has {sizes[many[large]]} corners; more than {_MAX_CONCAVE} "
                f"are not cut into triangles.",
                file=file,
                place=f"face {many[large] + 1}",
                remedy="Triangulate the mesh in the program that made it.",
            )
        counts["concave"], counts["bent"] = int(concave), int(bent)
    return Triangles((corners, polygon), len(sizes), counts)


def usable_faces(
    points: NDArray[np.float64], faces: NDArray[Any]
) -> tuple[NDArray[np.bool_] | None, tuple[str, ...]]:
    """Find the triangles that carry area once: neither degenerate nor the copy of an earlier one.

    Parameters
    ----------
    points : (V, 3) float64
        May hold NaN or infinity; faces that touch those are not usable.
    faces : (F, 3) int

    Returns
    -------
    keep : (F,) bool or None
        None means all.
    notes : tuple of str
        One sentence for each kind left out.
    """
    if not len(faces):
        return None, ()
    from meshreg.io.files.faces_kernels import use_faces

    faces = np.ascontiguousarray(faces, np.int32)
    table = np.full(1 << int(1.25 * len(faces)).bit_length(), -1, np.int32)
    keep = np.empty(len(faces), np.bool_)
    lost, flat, copies = use_faces(np.ascontiguousarray(points, np.float64), faces, table, keep)
    notes = []
    if lost:
        notes.append(f"{lost} faces touch a vertex that is not finite and were dropped.")
    if flat:
        notes.append(f"{flat} faces without area were dropped.")
    if copies:
        notes.append(f"{copies} faces that repeat another face's vertices were dropped.")
    return (keep if notes else None), tuple(notes)


def weld(points: NDArray[np.float64]) -> tuple[Int32, Int64]:
    """Find points that are equal in all digits, for formats that repeat them at each face.

    Parameters
    ----------
    points : (N, 3) float64

    Returns
    -------
    new : (N,) int32
        Number of each point among the different ones.
    kept : (M,) int64
        Row of the first of each, in order.
    """
    from meshreg.io.masks.polygons_kernels import weld_points

    table = np.full(1 << int(2 * len(points) + 1).bit_length(), -1, np.int32)
    new = np.empty(len(points), np.int32)
    kept = np.empty(len(points), np.int64)
    count = weld_points(np.ascontiguousarray(points, np.float64), table, new, kept)
    return new, kept[:count].copy()
