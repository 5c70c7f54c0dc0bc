"""From what a reader found in a file to a `Survey`: the cleaning that all formats share."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError
from meshreg.io.files.images import require_pages
from meshreg.io.files.safe import FARTHEST, fingerprint, sha256
from meshreg.io.frames.place import Placed, place
from meshreg.io.frames.sidecar import SidecarInfo
from meshreg.io.masks.polygons import usable_faces
from meshreg.io.options import ReadOptions
from meshreg.records import (
    Bool,
    Int32,
    Mesh,
    PointCloud,
    SourceFile,
    Survey,
    Texture,
    UInt8,
)

_LOG = logging.getLogger("meshreg")
_MOST_LOST = 0.01  # share of points that may be NaN or infinite
FARTHEST_PAGE = 1e6  # texture coordinates from here on say nothing
_MOST_WRAPPED = 0.01  # share of texture coordinates that may lie outside the page unsaid
_SAMPLE = 500_000  # faces that the size of a pixel is measured on
_AXES = np.eye(3)


@dataclass(frozen=True, eq=False)
class RawGeometry:
    """Points, and triangles if any, in the file's own coordinates.

    Attributes
    ----------
    points : (V, 3) float
        May hold NaN and infinity.
    faces : (F, 3) int32 or None
        All within `points`; None for a point cloud.
    colors : (V, 3) uint8 or None
    uv : (F, 3, 2) float32 or None
    face_texture : (F,) int32 or None
        -1 where a face has no texture.
    textures : tuple of Texture
    usable : (keep, notes) or None
        What `usable_faces` says of `points` and `faces`, where the reader has asked it already.
    """

    points: NDArray[Any]
    faces: Int32 | None = None
    colors: UInt8 | None = None
    uv: NDArray[np.float32] | None = None
    face_texture: Int32 | None = None
    textures: tuple[Texture, ...] = ()
    usable: tuple[Bool | None, tuple[str, ...]] | None = None


@dataclass(frozen=True, eq=False)
class Found:
    """What a reader knows beside the geometry.

    Attributes
    ----------
    format : str
        Key in `meshreg.io.formats.BY_KEY`.
    notes : tuple of str
    companions : tuple of Path
    counts : mapping
        As the file declares them.
    axes : (3, 3) float64
        Of the format, where neither user nor sidecar says otherwise.
    crs : str or None
        Found in the file.
    own : SidecarInfo or None
        What the file says of its shift.
    sha256 : str or None
        Of the file, where the reader had all its bytes in hand anyway.
    """

    format: str
    notes: tuple[str, ...] = ()
    companions: tuple[Path, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    axes: NDArray[np.float64] = field(default_factory=lambda: _AXES)
    crs: str | None = None
    own: SidecarInfo | None = None
    sha256: str | None = None


def assemble_survey(path: Path, raw: RawGeometry, found: Found, options: ReadOptions) -> Survey:
    """Clean a file's geometry, put it in place and make a `Survey` of it.

    Points that are not finite go, with their faces (over 1 % are refused); so do faces without
    area, faces that repeat another's vertices, and vertices that no face uses.

    Raises
    ------
    InputError
        Nothing usable is left, or over 1 % of the points are not finite.
    """
    require_pages(raw.textures)
    raw, notes = _without_lost_points(raw, path)
    if raw.faces is not None:
        raw, more = _without_idle_faces(raw, path)
        notes += more
        notes += _uv_notes(raw)
    if not len(raw.points):
        raise InputError("holds no points.", file=path, remedy="Export it again.")
    notes = (*found.notes, *notes)
    for note in notes:
        _LOG.warning("%s: %s", path.name, note)
    placed = place(
        path,
        raw.points,
        options,
        found.crs,
        found.axes,
        own=found.own,
        detail=lambda: texel_size(raw),
    )
    geometry: Mesh | PointCloud
    if raw.faces is None:
        geometry = PointCloud(placed.points, raw.colors)
    else:
        geometry = Mesh(
            placed.points, raw.faces, raw.colors, raw.uv, raw.face_texture, raw.textures
        )
    return placed_survey(path, placed, geometry, replace(found, notes=notes))


def placed_survey(
    path: Path, placed: Placed, geometry: Mesh | PointCloud, found: Found, name: str | None = None
) -> Survey:
    """Make the survey of one file whose points are in place; `name` stands in for its stem."""
    source = SourceFile(
        path=path,
        format=found.format,
        frame=placed.frame,
        companions=found.companions,
        sidecar=placed.sidecar,
        sha256=found.sha256 or sha256(path),
        fingerprint=fingerprint(path, found.companions),
        counts=found.counts,
    )
    return Survey(
        name=placed.name or name or path.stem,
        geometry=geometry,
        origin=placed.origin,
        crs=placed.frame.crs,
        date=placed.date,
        source=(source,),
        notes=(*found.notes, *placed.notes),
    )


def texel_size(mesh: RawGeometry | Mesh) -> float | None:
    """Return the side of a texture's pixel on the ground, in units of the points; None without.

    The median would follow small faces; this is the root of all area over all pixels.
    """
    if mesh.faces is None or mesh.uv is None or mesh.face_texture is None or not mesh.textures:
        return None
    every = slice(None, None, max(1, len(mesh.faces) // _SAMPLE))
    page = mesh.face_texture[every]
    used = page >= 0
    sizes = np.array([texture.size for texture in mesh.textures], float)[page[used]]
    uv = mesh.uv[every][used].astype(np.float64) * sizes[:, None, :]
    corners = np.asarray(mesh.points, np.float64)[mesh.faces[every][used]]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(first, second), axis=1).sum()
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    pixels = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    return float(np.sqrt(area / pixels)) if pixels > 0 else None


def _rows(values: NDArray[np.bool_]) -> Bool:
    """Return which rows of (N, K) are True throughout, as (N,)."""
    return np.asarray(values.all(axis=1))


def _keep_points(raw: RawGeometry, keep: Bool) -> RawGeometry:
    """Leave out points; faces must not use them any more."""
    faces = raw.faces
    if faces is not None:
        new = np.cumsum(keep, dtype=np.int32) - np.int32(1)
        faces = new[faces]
    colors = None if raw.colors is None else raw.colors[keep]
    return replace(raw, points=raw.points[keep], faces=faces, colors=colors, usable=None)


def _keep_faces(raw: RawGeometry, keep: Bool) -> RawGeometry:
    assert raw.faces is not None
    changes: dict[str, Any] = {"faces": raw.faces[keep], "usable": None}
    if raw.uv is not None and raw.face_texture is not None:
        changes |= {"uv": raw.uv[keep], "face_texture": raw.face_texture[keep]}
    return replace(raw, **changes)


def _without_lost_points(raw: RawGeometry, path: Path) -> tuple[RawGeometry, tuple[str, ...]]:
    """Leave out points that are not finite, and the faces that touch them."""
    # First the whole array at once, which is many times faster than row by row.
    if len(raw.points) and raw.points.min() > -FARTHEST and raw.points.max() < FARTHEST:
        return raw, ()
    finite = _rows(np.abs(raw.points) < FARTHEST)
    lost = len(finite) - int(np.count_nonzero(finite))
    if not lost:
        return raw, ()
    if lost > _MOST_LOST * len(finite):
        first = int(np.flatnonzero(~finite)[0])
        raise InputError(
            f"has {lost} points of {len(finite)} that are not finite numbers below "
            f"{FARTHEST:g} (more than {_MOST_LOST:.0%}).",
            file=path,
            place=f"vertex {first + 1}",
            remedy="Remove them in the program that made the file, or export it again.",
        )
    text = f"{lost} points that are not finite numbers were dropped"
    if raw.faces is not None:
        whole = _rows(finite[raw.faces])
        text += f", with {len(whole) - int(np.count_nonzero(whole))} faces that touch them"
        raw = _keep_faces(raw, whole)
    return _keep_points(raw, finite), (text + ".",)


def _without_idle_faces(raw: RawGeometry, path: Path) -> tuple[RawGeometry, tuple[str, ...]]:
    """Leave out faces without area and copies, then vertices that no face uses."""
    assert raw.faces is not None
    keep, notes = raw.usable or usable_faces(np.asarray(raw.points, np.float64), raw.faces)
    if keep is not None:
        raw = _keep_faces(raw, keep)
    assert raw.faces is not None
    if not len(raw.faces):
        raise InputError("holds no usable face.", file=path, remedy="Export it again.")
    from meshreg.io.files.faces_kernels import mark_used

    used = np.zeros(len(raw.points), np.bool_)
    mark_used(raw.faces, used)
    idle = len(used) - int(np.count_nonzero(used))
    if idle:
        raw = _keep_points(raw, used)
        notes += (f"{idle} vertices that no face uses were left out.",)
    return raw, notes


def _uv_notes(raw: RawGeometry) -> tuple[str, ...]:
    """Say when texture coordinates leave the page, where they wrap or take the edge's color."""
    if raw.uv is None or raw.face_texture is None:
        return ()
    if not raw.uv.size or (raw.uv.min() >= -1e-4 and raw.uv.max() <= 1 + 1e-4):
        return ()
    textured = raw.face_texture >= 0
    outside: Bool = np.logical_or(raw.uv < -1e-4, raw.uv > 1 + 1e-4).any(axis=2)  # type: ignore[assignment]
    n_outside = int(np.count_nonzero(outside[textured]))
    share = n_outside / max(3 * int(np.count_nonzero(textured)), 1)
    if share <= _MOST_WRAPPED:
        return ()
    return (f"{share:.1%} of the texture coordinates lie outside 0-1 and wrap around.",)


def require_pages_near(path: Path, uv: NDArray[np.float32]) -> None:
    """Refuse texture coordinates (N, 2) of which over 1 % lie a million pages away or farther.

    There a float32 no longer says which texel is meant.

    Raises
    ------
    InputError
    """
    with np.errstate(invalid="ignore"):  # those that are not numbers count as none
        far: Bool = np.asarray((np.abs(uv) >= FARTHEST_PAGE).any(axis=1) & _rows(np.isfinite(uv)))
    count = int(np.count_nonzero(far))
    if count > _MOST_LOST * len(far):
        first = int(np.flatnonzero(far)[0])
        raise InputError(
            f"has {count} texture coordinates of {len(far)} beyond {FARTHEST_PAGE:g}, "
            f"the first ({uv[first, 0]:g}, {uv[first, 1]:g}).",
            file=path,
            remedy="It is damaged; export it again, or read it with --geometry-only.",
        )


def without_broken_uv(
    path: Path, uv: NDArray[np.float32], face_texture: Int32
) -> tuple[NDArray[np.float32], Int32, tuple[str, ...]]:
    """Take the texture off faces whose texture coordinates are not finite, or far off any page.

    Returns
    -------
    uv : (F, 3, 2) float32
        Zero on those faces.
    face_texture : (F,) int32
        -1 on those faces.
    notes : tuple of str

    Raises
    ------
    InputError
        As `require_pages_near`.
    """
    with np.errstate(invalid="ignore"):
        good = _rows((np.abs(uv) < FARTHEST_PAGE).reshape(len(uv), 6))
    if good.all():
        return uv, face_texture, ()
    require_pages_near(path, uv[face_texture >= 0].reshape(-1, 2))
    lost = int(np.count_nonzero(~good & (face_texture >= 0)))
    uv = np.where(good[:, None, None], uv, np.float32(0))
    face_texture = np.where(good, face_texture, np.int32(-1))
    note = (
        f"{lost} faces have texture coordinates that are not finite or far off; they get no color."
    )
    return uv, face_texture, (note,) if lost else ()


def eight_bit_colors(values: NDArray[Any]) -> tuple[UInt8, tuple[str, ...]]:
    """Turn colors of any stored type (N, 3) into 8 bits.

    8-bit values stay. 16-bit ones are divided by 257, unless none is above 255: then they hold
    8-bit values. Floats are 0-1, unless one is above 1: then they are 0-255. Other integers are
    0-255.
    """
    values = np.asarray(values)
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values), ()
    if not values.size:
        return np.zeros((0, 3), np.uint8), ()
    if values.dtype.kind == "f":
        finite = np.isfinite(values)
        scaled = np.where(finite, values, 0).astype(np.float64)
        lost = int(np.count_nonzero(~finite.all(axis=1)))
        notes = [f"{lost} colors that are not finite became black."] if lost else []
        if scaled.max() <= 1.0:
            scaled *= 255
        else:
            notes.append("Colors are fractional numbers above 1; they were taken as 0-255.")
    else:
        scaled = values.astype(np.float64)
        notes = []
        if values.dtype == np.uint16 and values.max() > 255:
            scaled /= 257
        elif values.dtype == np.uint16:
            notes.append("Colors have 8-bit values in 16-bit fields; they were taken as 0-255.")
    outside = (scaled < -0.5) | (scaled > 255.5)
    if outside.any():
        notes.append(f"{int(outside.any(axis=1).sum())} colors outside 0-255 were clipped.")
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8), tuple(notes)
