"""READ PLY: text and both binary orders, meshes with colors or texture pages, point clouds.

Writing and rewriting are in `meshreg.io.ply.write`. An own reader because trimesh (5.2) takes the
faces of a short text file for vertices, accepts any format word, cannot read binary files that
mix triangles and quads, and puts the last of several texture pages on all faces.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError, ResourceLimitError
from meshreg.io.assemble import (
    Found,
    RawGeometry,
    assemble_survey,
    eight_bit_colors,
    without_broken_uv,
)
from meshreg.io.files.images import open_texture
from meshreg.io.files.safe import MissingReferenceError, decode_name, file_bytes, resolve_reference
from meshreg.io.las.classes import RECLASS, ground_classes
from meshreg.io.masks.polygons import Triangles, triangulate
from meshreg.io.options import ReadOptions
from meshreg.io.ply.body import Table, read_tables, scalar_columns
from meshreg.io.ply.header import Header, read_header
from meshreg.io.ply.write import direction_notes
from meshreg.records import Float32, Int32, Survey, Texture

_XYZ = ("x", "y", "z")
_COLORS = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_CLASS = ("classification", "Classification", "scalar_classification", "scalar_Classification")
_WITHOUT = "Export it again, or leave the textures out (geometry_only, --geometry-only)."


def read(path: Path, options: ReadOptions) -> Survey:
    """Read a PLY file as a mesh, or as a point cloud where it has no faces.

    Parameters
    ----------
    path : Path
    options : ReadOptions

    Returns
    -------
    Survey

    Raises
    ------
    InputError
        Anything that the format does not allow, counts that the file's size cannot hold, indices
        out of range, over 1 % of vertices not finite.
    UnsafeReferenceError
        A `comment TextureFile` that leads out of the file's folder.
    ResourceLimitError
        A texture page of more than `options.max_pixels`, or 2^31 vertices.
    """
    header = read_header(path)
    vertex = header.element("vertex")
    if vertex is None or any(vertex.column(name) is None for name in _XYZ):
        raise InputError(
            "has no element 'vertex' with x, y and z.", file=path, remedy="Export it again."
        )
    if header.element("tristrips") is not None:
        raise InputError(
            "holds triangle strips.", file=path, remedy="Export it with triangles as faces."
        )
    if vertex.count >= 2**31:
        raise ResourceLimitError(
            f"has {vertex.count} vertices; fewer than 2^31 are read.",
            file=path,
            remedy="Cut it into blocks.",
        )
    tables = read_tables(header, file_bytes(path), path, ("vertex", "face"))
    notes = list(direction_notes(header))
    points = scalar_columns(tables["vertex"], _XYZ, np.float64)
    colors = _colors(tables["vertex"], notes)
    counts = {"vertices": len(points)}
    face = tables.get("face")
    if face is None or not face.element.count:
        points, colors = _ground(tables["vertex"], points, colors, notes, path)
        raw = RawGeometry(points, None, colors)
        return assemble_survey(path, raw, Found("ply", tuple(notes), (), counts), options)
    counts["faces"] = face.element.count
    if face.element.column("red", "diffuse_red") is not None and colors is None:
        notes.append("Colors of faces are not used, only those of vertices and textures.")
    sizes, corners = _corners(face, len(points))
    triangles = triangulate(points, sizes, corners, path)
    notes += triangles.notes()
    faces = np.ascontiguousarray(triangles.pick_corners(corners))
    uv = face_texture = None
    textures: tuple[Texture, ...] = ()
    companions: tuple[Path, ...] = ()
    if not options.geometry_only:
        uv, pages = _texture_coordinates(tables, header, triangles, sizes, faces, notes)
        if uv is not None:
            textures, companions, new = _open_pages(header, path, options, notes)
            face_texture = new[pages]
            uv, face_texture, more = without_broken_uv(path, uv, face_texture)
            notes += more
    raw = RawGeometry(points, faces, colors, uv, face_texture, textures)
    found = Found("ply", tuple(notes), companions, counts)
    return assemble_survey(path, raw, found, options)


def _ground(
    vertex: Table,
    points: NDArray[np.float64],
    colors: NDArray[np.uint8] | None,
    notes: list[str],
    path: Path,
) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    """Leave out a cloud's points that are classed as noise or water."""
    name = next((n for n in _CLASS if vertex.element.column(n) is not None), None)
    if name is None:
        return points, colors
    keep = ground_classes(scalar_columns(vertex, (name,))[:, 0], notes)
    if keep is None:
        return points, colors
    if not keep.any():
        raise InputError(f"holds no usable point ({' '.join(notes)}).", file=path, remedy=RECLASS)
    return points[keep], None if colors is None else colors[keep]


def _colors(vertex: Table, notes: list[str]) -> NDArray[np.uint8] | None:
    for names in _COLORS:
        numbers = [vertex.element.column(name) for name in names]
        if all(number is not None for number in numbers):
            colors, more = eight_bit_colors(scalar_columns(vertex, names, None))
            notes += more
            return colors
    return None


def _corners(face: Table, n_vertices: int) -> tuple[NDArray[np.int64], Int32]:
    """Return the size of each face and the vertex of each corner, all checked."""
    number = face.element.column("vertex_indices", "vertex_index")
    sizes, values = face.column(number) if number is not None else (None, np.zeros(0))
    if sizes is None or values.dtype.kind not in "iu":
        raise InputError(
            "has faces without a list 'vertex_indices' of integers.",
            file=face.file,
            remedy="Export it again.",
        )
    if len(values) and (int(values.max()) >= n_vertices or int(values.min()) < 0):
        corner = int(np.flatnonzero((values >= n_vertices) | (values < 0))[0])
        bad = int(np.searchsorted(np.cumsum(sizes), corner, side="right"))
        raise InputError(
            f"refers to vertex {int(values[corner])} of {n_vertices} (counted from 0).",
            file=face.file,
            place=f"face {bad + 1}",
            remedy="The file is damaged; export it again.",
        )
    return sizes, values.astype(np.int32)


def _texture_coordinates(
    tables: dict[str, Table],
    header: Header,
    triangles: Triangles,
    sizes: NDArray[np.int64],
    faces: Int32,
    notes: list[str],
) -> tuple[Float32 | None, Int32]:
    """Return the texture coordinates of triangles' corners and the number of their page or -1."""
    nothing = None, np.zeros(0, np.int32)
    vertex, face = tables["vertex"], tables["face"]
    listed = face.element.column("texcoord")
    has = np.ones(len(sizes), np.bool_)
    if listed is not None:
        uv, has = _listed_uv(face, listed, sizes, triangles)
    else:
        names = next((n for n in _UV if all(vertex.element.column(c) is not None for c in n)), None)
        if names is None:
            if header.textures:
                notes.append("Texture pages are named, but there are no texture coordinates.")
            return nothing
        uv = scalar_columns(vertex, names, np.float32)[faces]
    if not header.textures:
        notes.append("Texture coordinates were left out: no texture page is named.")
        return nothing
    pages = np.where(triangles.pick_faces(has), _page_numbers(face, header, triangles), -1)
    return uv, pages.astype(np.int32)


def _listed_uv(
    face: Table, number: int, sizes: NDArray[np.int64], triangles: Triangles
) -> tuple[Float32, NDArray[np.bool_]]:
    """Read the faces' lists of u, v, u, v...; an empty list is a face without texture."""
    lengths, values = face.column(number)
    if lengths is None:
        raise InputError("has 'texcoord' that is not a list.", file=face.file, remedy=_WITHOUT)
    has = lengths > 0
    wrong = np.flatnonzero(has & (lengths != 2 * sizes))
    if len(wrong):
        raise InputError(
            f"has {lengths[wrong[0]]} texture coordinates on a face of {sizes[wrong[0]]} corners.",
            file=face.file,
            place=f"face {wrong[0] + 1}",
            remedy=_WITHOUT,
        )
    uv = np.zeros((int(sizes.sum()), 2), np.float32)
    uv[np.repeat(has, sizes)] = values.reshape(-1, 2)
    return np.ascontiguousarray(triangles.pick_corners(uv)), has


def _page_numbers(face: Table, header: Header, triangles: Triangles) -> NDArray[np.int64]:
    number = face.element.column("texnumber")
    count = len(header.textures)
    if number is None:
        if count > 1:
            raise InputError(
                f"names {count} texture pages, but its faces have no 'texnumber' to choose by.",
                file=face.file,
                remedy=_WITHOUT,
            )
        return np.zeros(len(triangles.polygon), np.int64)
    lengths, values = face.column(number)
    values = values.astype(np.int64)
    wrong = np.flatnonzero((values < -1) | (values >= count))
    if lengths is not None or len(wrong):
        at = int(wrong[0]) if len(wrong) else 0
        raise InputError(
            f"has texnumber {values[at]} with {count} texture pages.",
            file=face.file,
            place=f"face {at + 1}",
            remedy=_WITHOUT,
        )
    picked: NDArray[np.int64] = triangles.pick_faces(values)
    return picked


def _open_pages(
    header: Header, path: Path, options: ReadOptions, notes: list[str]
) -> tuple[tuple[Texture, ...], tuple[Path, ...], Int32]:
    """Open the texture pages.

    Returns
    -------
    textures, companions : tuple
        Those that are there.
    new : (pages + 1,) int32
        Number of each declared page among `textures`, or -1; the last one is for -1 itself.
    """
    textures, companions = [], []
    new = np.full(len(header.textures) + 1, -1, np.int32)
    for number, name in enumerate(header.textures):
        try:
            page = resolve_reference(path.parent, name, root=path.parent)
        except MissingReferenceError as error:
            notes.append(
                f"Texture page {decode_name(name)!r} was not found; its faces have no color "
                f"({error.message})"
            )
            continue
        if page.name != Path(decode_name(name).replace("\\", "/")).name:
            notes.append(f"Texture page {decode_name(name)!r} was found as {page.name!r}.")
        companions.append(page)
        try:
            textures.append(open_texture(page, options.max_pixels, notes=notes))
        except InputError as error:
            notes.append(f"Texture page {page.name!r} {error.message} Its faces have no color.")
            continue
        new[number] = len(textures) - 1
    return tuple(textures), tuple(companions), new
