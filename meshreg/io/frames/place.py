"""Where a file's coordinates are: file -> absolute metres -> another file, and back.

``absolute = to_crs(axes @ file + shift)``: the signed axes carry the unit, the shift is added
after them, and PROJ follows only where the file's CRS is not the metric one that absolute
coordinates are in.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, MeshregError, UsageError
from meshreg.io.files.safe import FARTHEST
from meshreg.io.frames.axes import ENU, Y_UP
from meshreg.io.frames.bridge import bridge
from meshreg.io.frames.crs import (
    crs_name,
    crs_text,
    grid_scale_and_convergence,
    metres_per_unit,
    metric_crs,
    parse_crs,
    vertical_part,
)
from meshreg.io.frames.framing import frame_from
from meshreg.io.frames.mover import Mover, frame_matrix, make_mover, to_absolute, to_file
from meshreg.io.frames.precision import single_precision_note
from meshreg.io.frames.sidecar import SidecarInfo, find_sidecar
from meshreg.io.frames.unapplied import unapplied_notes
from meshreg.io.options import ReadOptions
from meshreg.records import Float64, Frame, Maps, Mesh, PointCloud, SourceFile, Survey

_LOG = logging.getLogger("meshreg")


@dataclass(frozen=True, eq=False)
class Placed:
    """A file's points in place: `points` (N, 3) float64 [m] from the absolute `origin` (3,).

    `frame` belongs in the `SourceFile`, `notes` in the `Survey`; `name` and `date` come from a
    `.survey.toml`, where there is one; `sidecar` is the file that gave the shift or the CRS.
    """

    points: Float64
    origin: Float64
    frame: Frame
    notes: tuple[str, ...] = ()
    sidecar: Path | None = None
    name: str | None = None
    date: str | None = None


def place(
    path: Path,
    xyz: Any,
    options: ReadOptions,
    file_crs: str | None = None,
    default_axes: Any = None,
    *,
    georeferenced: bool = False,
    own: SidecarInfo | None = None,
    detail: Callable[[], float | None] | None = None,
) -> Placed:
    """Do what every reader does with its points: find the sidecar, the frame and a local origin.

    Parameters
    ----------
    path : Path
        The file, for its sidecars and for messages.
    xyz : (N, 3) array
        Finite coordinates as stored, N >= 1.
    options, file_crs, default_axes
        As for `frame_from`.
    georeferenced : bool
        The format states absolute coordinates itself (LAS, GeoTIFF): a shift file that speaks for
        a whole folder (offset.xyz, coords.txt, SHIFT.txt) is not meant for it.
    own : SidecarInfo, optional
        What the file says itself of its shift.
    detail : callable, optional
        Returns the size of a pixel on the ground, in units of `xyz`; asked only where coordinates
        went through 32-bit numbers.

    Raises
    ------
    InputError
        No points, coordinates outside their CRS, or spoilt by 32-bit numbers.
    """
    xyz = np.asarray(xyz)
    if not len(xyz):
        raise InputError("holds no points.", file=path, remedy="Export it again.")
    ends = _ends(xyz)
    if not np.isfinite(ends).all():
        raise InputError(f"has coordinates {ends.tolist()} that are not finite.", file=path)
    notes = single_precision_note(path, xyz, ends, detail)
    sidecar = find_sidecar(path, shared=not georeferenced, own=own, given=options)
    # The median, because a single stray point must not decide where the survey is.
    centre = np.median(xyz[:: max(1, len(xyz) // 10_000)].astype(np.float64), axis=0)
    try:
        frame = frame_from(options, sidecar, file_crs, default_axes, centre=centre)
        corners = np.array(list(itertools.product(*ends.T)), float)
        require_near(to_absolute(frame, corners) if frame.is_linear else corners)
        origin = np.round(to_absolute(frame, centre[None])[0])
        points = _from_origin(frame, xyz, origin)
        notes += _frame_notes(options, sidecar, frame, centre)
        if not georeferenced and not frame.shift.any():
            notes += unapplied_notes(path, frame, centre)
    except MeshregError as error:
        error.file = error.file or str(path)
        raise
    for note in notes:
        _LOG.warning("%s: %s", path.name, note)
    said = sidecar or SidecarInfo()
    return Placed(points, origin, frame, notes, said.path, said.name, said.date)


def require_near(corners: Float64) -> None:
    """Refuse absolute coordinates (N, 3) at which float64 no longer tells millimetres apart."""
    farthest = float(np.abs(corners).max())
    if not farthest < FARTHEST:
        raise InputError(
            f"has coordinates of up to {farthest:.3g}, shift included; {FARTHEST:g} is the limit.",
            remedy="Check its unit and its shift, or export it again.",
        )


def _ends(xyz: Any) -> Float64:
    """Return (2, 3) lowest and highest of each column."""
    # Rows taken 64 at a time: NumPy is slow along the first axis of three columns.
    whole = len(xyz) // 64 * 64
    wide = xyz[:whole].reshape(-1, 64 * 3)
    found = []
    for end in (np.min, np.max):
        parts = [end(wide, axis=0).reshape(64, 3)] if whole else []
        found.append(end(np.concatenate([*parts, xyz[whole:]]), axis=0))
    return np.asarray(found, np.float64)


def _from_origin(frame: Frame, xyz: Any, origin: Float64) -> Float64:
    """Return absolute coordinates minus `origin`, without going through large numbers if linear."""
    if frame.is_linear and (frame.axes == np.eye(3)).all():
        return np.asarray(xyz, np.float64) + (frame.shift - origin)
    if frame.is_linear:
        # One matrix product: exact for signed permutations, and no second copy.
        points = np.asarray(xyz, np.float64) @ frame.axes.T
        points += frame.shift - origin
        return points
    points = to_absolute(frame, xyz)
    points -= origin
    return points


def _frame_notes(
    options: ReadOptions, sidecar: SidecarInfo | None, frame: Frame, centre: Float64
) -> tuple[str, ...]:
    notes: list[str] = []
    if sidecar is not None:
        notes += sidecar.notes
        if sidecar.shift is not None and not any(sidecar.shift):
            pass  # the file's coordinates are absolute: nothing to say
        elif sidecar.shift is not None and options.shift is None:
            text = ", ".join(f"{value:.12g}" for value in sidecar.shift)
            notes.append(f"The shift ({text}) from {sidecar.shift_name} is added.")
        elif sidecar.shift is not None:
            notes.append(f"The stated shift replaces the one in {sidecar.shift_name}.")
    if frame.file_crs != frame.crs and frame.file_crs and frame.crs:
        how = bridge(frame.file_crs, frame.crs).note(frame.axes @ centre + frame.shift)
        notes.append(
            f"Coordinates were taken from {crs_name(frame.file_crs)} to {crs_name(frame.crs)}"
            + (f" ({how})." if how else ".")
        )
        unit = metres_per_unit(frame.file_crs)
        if unit != 1 and vertical_part(parse_crs(frame.file_crs)) is None:
            notes.append(f"No unit of heights is stated: they were taken in {unit:.9g} m, too.")
    return tuple(notes)


def reframe(survey: Survey, crs: str) -> Survey:
    """Take a survey to another CRS; its own must be known.

    Raises
    ------
    UsageError
        The survey has no CRS.
    InputError
        No operation between the two, or points outside the new CRS's area.
    """
    if survey.crs is None:
        raise UsageError(f"Survey {survey.name!r} has no CRS; it cannot be taken to {crs}.")
    crs = crs_text(crs) or crs
    if crs == survey.crs:
        return survey
    way = bridge(survey.crs, crs)
    how = way.note(survey.centre)
    note = f"Points were taken from {crs_name(survey.crs)} to {crs_name(crs)}"
    note += f" ({how})." if how else "."
    source = tuple(replace(item, frame=replace(item.frame, crs=crs)) for item in survey.source)
    geometry = survey.geometry
    changes: dict[str, Any] = {"crs": crs, "source": source, "notes": (*survey.notes, note)}
    if isinstance(geometry, Maps):
        from meshreg.io.maps.pair import reproject

        return replace(survey, geometry=reproject(geometry, crs), **changes)
    points = way.forward(geometry.points + survey.origin)
    if not np.isfinite(points).all():
        raise InputError(f"points of {survey.name!r} lie outside the area of {crs_name(crs)}.")
    origin = np.round((points.min(axis=0) + points.max(axis=0)) / 2)
    points -= origin
    moved: Mesh | PointCloud
    if isinstance(geometry, Mesh):
        moved = replace(geometry, vertices=points)
    else:
        moved = replace(geometry, points=points)
    return replace(survey, geometry=moved, origin=origin, **changes)


def common_crs(reference: Survey, moving: Survey) -> tuple[Survey, tuple[str, ...]]:
    """Bring the moving survey to the reference's CRS, and say what that means.

    Returns
    -------
    moving : Survey
        Reframed where both CRS are known and differ. Where one is missing, the numbers of both are
        taken as one local frame, which has the reference's CRS, or none.
    notes : tuple of str
    """
    if reference.crs == moving.crs:
        return moving, ()
    if reference.crs is not None and moving.crs is not None:
        moved = reframe(moving, reference.crs)
        return moved, moved.notes[len(moving.notes) :]
    known, other = (reference, moving) if moving.crs is None else (moving, reference)
    note = (
        f"{known.name!r} is in {crs_name(known.crs)}, {other.name!r} in a local frame without "
        "CRS: their coordinates are taken as one local frame. "
    )
    return _labelled(moving, reference.crs), (note + _grid_note(known),)


def _labelled(survey: Survey, crs: str | None) -> Survey:
    """Return a survey whose numbers are said to be in `crs`; none of them changes."""
    geometry = survey.geometry
    if isinstance(geometry, Maps):
        color_grid = geometry.color_grid
        geometry = replace(
            geometry,
            height_grid=replace(geometry.height_grid, crs=crs),
            color_grid=None if color_grid is None else replace(color_grid, crs=crs),
        )
    return replace(survey, geometry=geometry, crs=crs)


def _grid_note(survey: Survey) -> str:
    assert survey.crs is not None
    east, north = survey.centre[:2]
    scale, convergence = grid_scale_and_convergence(survey.crs, east, north)
    return (
        f"There the grid's scale is {scale:.6f} ({(scale - 1) * 1e3:+.2f} mm per metre) and grid "
        f"north lies {np.degrees(convergence):+.3f} degrees clockwise of true north; a local frame "
        "in true metres differs by that."
    )


def registered_frame(reference: SourceFile, moving: SourceFile, *, centre: Any = None) -> Frame:
    """Return the frame that the registered moving file is written in: the reference file's.

    glTF keeps its own axes (the format says Y up), in metres, with the reference's shift; one that
    is geocentric stays so, and no other file becomes so. Where
    that shift would leave glTF or STL, which know 32-bit numbers only, with coordinates that step
    by more than 0.1 mm, they get a round shift of their own at `centre`.

    Parameters
    ----------
    reference, moving : SourceFile
        First file of each survey.
    centre : (3,) array, optional
        Absolute centre of the registered survey [m].
    """
    frame = reference.frame
    own_axes = moving.format in ("glb", "gltf")
    if own_axes and moving.frame.crs == frame.crs and _geocentric(moving.frame):
        return moving.frame
    if _geocentric(frame) and not _geocentric(moving.frame):
        place = np.zeros(3) if centre is None else np.round(np.asarray(centre, float))
        frame = Frame(ENU, place, frame.crs, frame.crs)
    if own_axes:
        unit = float(np.cbrt(abs(np.linalg.det(moving.frame.axes))))
        shift = frame.shift if frame.is_linear else np.zeros(3)
        # a geocentric file has no axis that points up: it becomes what its format wants
        axes = Y_UP if _geocentric(moving.frame) else np.round(moving.frame.axes / unit, 12)
        frame = Frame(axes, shift, frame.crs, frame.crs)
    if centre is None or not (own_axes or moving.format == "stl"):
        return frame
    local = to_file(frame, np.atleast_2d(centre))
    if float(np.spacing(np.abs(local).max().astype(np.float32))) <= 1e-4:
        return frame
    axes = frame.axes if frame.is_linear else ENU
    return Frame(axes, np.round(np.asarray(centre, float)), frame.crs, frame.crs)


def _geocentric(frame: Frame) -> bool:
    return frame.file_crs is not None and bool(parse_crs(frame.file_crs).is_geocentric)


__all__ = [
    "Mover",
    "Placed",
    "common_crs",
    "frame_from",
    "frame_matrix",
    "grid_scale_and_convergence",
    "make_mover",
    "metric_crs",
    "place",
    "reframe",
    "registered_frame",
    "to_absolute",
    "to_file",
]
