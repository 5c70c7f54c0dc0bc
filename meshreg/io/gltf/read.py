"""READ glTF 2.0 (.glb, .gltf): textured triangles or points in a tree of nodes.

Writing is in `meshreg.io.gltf.write`, moving a file in `rewrite`; the container is in
`gltf_document`, the tree of nodes in `gltf_nodes`, the primitives in `gltf_parts`.
The checks that trimesh (5.2) lacks - indices and strides out of range, accessors without data,
required extensions, lengths of chunks - walk all that a reader walks; reading what they have
passed is then less code than handing the file to trimesh and undoing its clean-up, so this is an
own reader and trimesh the oracle in its tests.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshreg.errors import InputError
from meshreg.io.assemble import (
    Found,
    RawGeometry,
    assemble_survey,
    without_broken_uv,
)
from meshreg.io.files.safe import MissingReferenceError
from meshreg.io.frames.axes import ENU, Y_UP
from meshreg.io.frames.sidecar import find_sidecar
from meshreg.io.gltf.center import relative_to_center, unread_places
from meshreg.io.gltf.document import Document, read_document
from meshreg.io.gltf.parts import Notes, Part, read_parts
from meshreg.io.gltf.texture import Pages
from meshreg.io.masks.polygons import weld
from meshreg.io.options import ReadOptions
from meshreg.records import Survey


def read(path: Path, options: ReadOptions) -> Survey:
    """Read a glTF file: (x, y, z) is east, up, south unless it is plainly Z-up.

    Parameters
    ----------
    path : Path
    options : ReadOptions
        `up` (or `axes`) decides on the axes; without it a file that is thin along z, wide along
        x and y and faces z is taken as Z-up, with a note.

    Returns
    -------
    Survey
        Colors of vertices are taken as stored; texture coordinates are turned from glTF's v
        downward to v upward.

    Raises
    ------
    InputError
        Whatever the specification does not allow, indices out of range, compressed geometry.
    UnsafeReferenceError
        A uri that leads out of the file's folder.
    ResourceLimitError
        A texture page of more than `options.max_pixels`, or instances without end.
    """
    document = read_document(path)
    notes = Notes()
    pages = Pages(document, options, notes.texts)
    raw = _joined(path, read_parts(document, pages, notes), pages, notes)
    counts = {"vertices": len(raw.points), "faces": 0 if raw.faces is None else len(raw.faces)}
    if raw.faces is not None and raw.colors is None:
        # Exporters repeat a vertex for each of its texture coordinates.
        new, kept = weld(raw.points)
        raw = RawGeometry(
            raw.points[kept], new[raw.faces], None, raw.uv, raw.face_texture, raw.textures
        )
    z_up = _may_guess(document, options) and _plainly_z_up(raw)
    axes = ENU if z_up else Y_UP
    said = relative_to_center(document, raw, axes, options, notes.texts)
    if z_up and said.up_counts:
        notes.texts.append(
            "The file is thin along its z axis and faces it: it was read as z up, against glTF's "
            "y up. Say --up y if that is wrong."
        )
    kind = "glb" if document.is_binary else "gltf"
    companions = _companions(document, options, notes)
    notes.texts += unread_places(document)
    found = Found(kind, tuple(notes.all()), companions, counts, said.axes, said.crs, said.own)
    return assemble_survey(path, raw, found, options)


def _joined(path: Path, parts: list[Part], pages: Pages, notes: Notes) -> RawGeometry:
    """Put primitives together into one geometry."""
    points = np.concatenate([part.points for part in parts])
    colors = None
    if any(part.colors is not None for part in parts):
        bare = sum(part.colors is None for part in parts)
        if bare:
            notes.texts.append(f"{bare} of {len(parts)} primitives have no colors; left white.")
        white = [np.full((len(part.points), 3), 255, np.uint8) for part in parts]
        chosen = zip(parts, white, strict=True)
        colors = np.concatenate([p.colors if p.colors is not None else w for p, w in chosen])
    if parts[0].faces is None:
        return RawGeometry(points, None, colors)
    starts = np.cumsum([0, *(len(part.points) for part in parts)])
    faces = np.concatenate(
        [p.faces + np.int32(s) for p, s in zip(parts, starts, strict=False) if p.faces is not None]
    )
    if not pages.textures or all(part.uv is None for part in parts):
        return RawGeometry(points, faces, colors)
    uv = np.concatenate(
        [
            part.uv if part.uv is not None else np.zeros((len(part.points), 2), np.float32)
            for part in parts
        ]
    )[faces]
    page = np.concatenate([np.full(len(p.faces), p.page) for p in parts if p.faces is not None])
    uv, page, more = without_broken_uv(path, uv, page.astype(np.int32))
    notes.texts += more
    return RawGeometry(points, faces, colors, uv, page, tuple(pages.textures))


def _may_guess(document: Document, options: ReadOptions) -> bool:
    """Whether nobody has said which axis is up (our own files are Y-up, as the format wants)."""
    if options.up is not None or options.axes is not None:
        return False
    if document.tree["asset"].get("generator") == "meshreg":
        return False
    said = find_sidecar(document.path, again=True)
    return said is None or (said.up is None and said.axes is None)


def _plainly_z_up(raw: RawGeometry) -> bool:
    """Whether a survey is thin along z, wide along x and y, and (as a mesh) faces +z."""
    points = raw.points[np.isfinite(raw.points).all(axis=1)]
    if not len(points):
        return False
    x, y, z = points.max(axis=0) - points.min(axis=0)
    if z > 0.5 * min(x, y):
        return False
    if raw.faces is None:
        return bool(z < 0.3 * min(x, y))
    corners = raw.points[raw.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = normals[np.isfinite(normals).all(axis=1)]
    area = np.sqrt((normals**2).sum(axis=1)).sum()
    if not area > 0:
        return False
    facing = normals.sum(axis=0) / area
    return bool(facing[2] > 0.6 and abs(facing[1]) < 0.4)


def _companions(document: Document, options: ReadOptions, notes: Notes) -> tuple[Path, ...]:
    """Return the other files that the document names and that are there."""
    found = []
    for kind, index, uri in document.uris():
        try:
            found.append(document.outside(uri))
        except InputError as error:
            if kind == "buffers" or not (
                options.geometry_only or isinstance(error, MissingReferenceError)
            ):
                raise
            notes.texts.append(f"Image {index} ({uri[:80]!r}) was left out: {error.message}")
    return tuple(dict.fromkeys(found))
