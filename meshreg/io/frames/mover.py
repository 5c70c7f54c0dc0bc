"""Apply a frame: file coordinates to absolute ones and back, and from one file's to another's."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from meshreg.errors import InputError, UsageError
from meshreg.io.frames.bridge import bridge
from meshreg.records import Float64, Frame, SourceFile, Transform, Warp


def to_absolute(frame: Frame, xyz: Any) -> Float64:
    """Turn a file's coordinates (N, 3) into absolute ones, metres east, north, up.

    Raises
    ------
    InputError
        If a point lies outside what the CRS can represent.
    """
    points = np.asarray(xyz, float) @ frame.axes.T + frame.shift
    if frame.is_linear or frame.file_crs is None or frame.crs is None:
        return points
    return bridge(frame.file_crs, frame.crs).forward(points)


def to_file(frame: Frame, xyz: Any) -> Float64:
    """Turn absolute coordinates (N, 3) [m] into a file's own (inverse of `to_absolute`)."""
    points = np.asarray(xyz, float)
    if not (frame.is_linear or frame.file_crs is None or frame.crs is None):
        points = bridge(frame.file_crs, frame.crs).forward(points, back=True)
    return np.asarray((points - frame.shift) @ np.linalg.inv(frame.axes).T)


def is_plain(frame: Frame) -> bool:
    """Whether a file's coordinates are those of its CRS: no shift, x east, y north, z up."""
    return not frame.shift.any() and bool((frame.axes == np.eye(3)).all())


@dataclass(frozen=True, eq=False)
class Mover:
    """Moves one file's coordinates into another frame (`make_mover`).

    Attributes
    ----------
    source : Frame
        Of the file as it is.
    transform : Transform
        `reference_from_moving`, absolute.
    frame : Frame
        Of the file to be written.
    matrix : (4, 4) float64
        Old file coordinates to new ones: exact unless a CRS changes, else linearised at `centre`;
        without the warp.
    warp : Warp or None
        The bend that follows the transform.
    """

    source: Frame
    transform: Transform
    frame: Frame
    matrix: Float64
    _turn: Float64 = field(repr=False)
    warp: Warp | None = None

    @property
    def turn(self) -> Float64:
        """(3, 3) orthogonal matrix from directions in the old file to those in the new one.

        Its determinant is -1 where one of the two files has a mirrored frame.
        """
        return self._turn

    @property
    def scale(self) -> float:
        """Length in the new file of what is 1 long in the old one, units of both included."""
        return float(np.cbrt(abs(np.linalg.det(self.matrix[:3, :3]))))

    def points(self, xyz: Any) -> Float64:
        """Move points (N, 3), old file coordinates to new ones."""
        moved = self.transform.apply(to_absolute(self.source, xyz))
        return to_file(self.frame, moved if self.warp is None else self.warp.apply(moved))

    def directions(self, points: Any, vectors: Any) -> Float64:
        """Turn vectors (N, 3) such as normals, keeping their lengths.

        `points` (where they stand) is part of the contract, though one rotation serves a whole
        survey: a warp would turn a vector by no more than its strain, under a degree.
        """
        del points
        return np.asarray(np.asarray(vectors, float) @ self._turn.T)


def make_mover(
    source: SourceFile,
    transform: Transform,
    target: Frame,
    *,
    centre: Any = None,
    warp: Warp | None = None,
) -> Mover:
    """Return the map from the moving file's coordinates to those of the file to be written.

    Parameters
    ----------
    source : SourceFile
        The file as it is. Its absolute coordinates are taken to the target's CRS first, where
        both are known.
    transform : Transform
        `reference_from_moving` in absolute coordinates of the reference.
    target : Frame
        Usually `registered_frame(reference, source)`.
    centre : (3,) array, optional
        Where to linearise `matrix`, in the file's own coordinates; needed where a CRS changes.
    warp : Warp, optional
        Follows the transform.
    """
    start = source.frame
    if start.crs is not None and target.crs is not None and start.crs != target.crs:
        start = replace(start, crs=target.crs)

    if start.is_linear and target.is_linear:
        matrix = np.linalg.inv(frame_matrix(target)) @ transform.matrix @ frame_matrix(start)
        origin = transform.apply(to_absolute(start, np.zeros((1, 3))))
        matrix[:3, 3] = to_file(target, origin)[0]
        matrix[3] = (0, 0, 0, 1)
        before, after = start.axes, target.axes
    elif centre is None:
        raise UsageError("A change of CRS is linearised at a place; `centre` is missing.")
    else:
        here = np.asarray(centre, float)
        moved = transform.apply(to_absolute(start, here[None]))
        there = to_file(target, moved)[0]
        before, after = _tangent(start, here), _tangent(target, there)
        matrix = np.eye(4)
        matrix[:3, :3] = np.linalg.inv(after) @ transform.linear @ before
        matrix[:3, 3] = there - matrix[:3, :3] @ here
    turn = _rotation_in(after).T @ transform.rotation @ _rotation_in(before)
    return Mover(start, transform, target, matrix, turn, warp)


def frame_matrix(frame: Frame) -> Float64:
    """(4, 4) float64: file coordinates to absolute ones, for a frame without change of CRS."""
    matrix = np.eye(4)
    matrix[:3, :3] = frame.axes
    matrix[:3, 3] = frame.shift
    return matrix


def _tangent(frame: Frame, centre: Float64) -> Float64:
    """Return d absolute / d file (3, 3) at a place, by central differences over some 20 m."""
    step = np.abs(to_file(frame, to_absolute(frame, centre[None]) + 10.0) - centre).max(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = to_absolute(frame, np.concatenate([centre + np.diag(step), centre - np.diag(step)]))
        tangent = np.asarray(((ends[:3] - ends[3:]) / (2 * step[:, None])).T)
    if not (np.isfinite(tangent).all() and np.linalg.norm(tangent, axis=0).all()):
        raise InputError(
            f"Neighbouring places are not told apart by the coordinates of {frame.crs} at "
            f"{', '.join(f'{value:.10g}' for value in centre)}.",
            remedy="Correct the CRS (.prj, .survey.toml): one of its units or parameters is wrong.",
        )
    return tangent


def _rotation_in(linear: Float64) -> Float64:
    """Return the orthogonal matrix nearest to `linear` (3, 3), the units of its columns apart."""
    columns = linear / np.linalg.norm(linear, axis=0)
    left, _, right = np.linalg.svd(columns)
    return np.asarray(left @ right)
