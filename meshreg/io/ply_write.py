"""WRITE PLY: a survey from memory, or a moved copy of a file that keeps all else."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.images import texture_suffix, write_texture
from meshreg.io.mover import Mover
from meshreg.io.ply_body import Table, read_tables, scalar_columns
from meshreg.io.ply_header import Element, Header, read_header
from meshreg.io.rewriting import (
    FINEST,
    Extent,
    copy_companions,
    float32_step,
    moved_points,
    require_unchanged,
    warn,
)
from meshreg.io.safe import atomic_file, file_bytes, resolve_reference
from meshreg.io.sidecar import write_shift
from meshreg.types import Float64, Frame, Mesh, PointCloud, SourceFile, Survey

_CHUNK = 1 << 18  # rows
_BLOCK = 1 << 24  # bytes
_XYZ = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_TEXTURE = re.compile(rb"(\s*comment\s+(?i:texturefile)\s+)(.*?)(\s*)", re.DOTALL)


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a survey as binary little-endian PLY with absolute float64 coordinates.

    Colours are written per vertex; texture coordinates per face, with one `comment TextureFile`
    a page (files ``<stem>_000.png`` beside it) and the page's number as `texnumber`.

    Parameters
    ----------
    survey : Survey
    path : Path

    Returns
    -------
    tuple of Path
        The file, its texture pages and, where the survey has a CRS, the sidecar that states it.

    Raises
    ------
    UsageError
        The survey is maps.
    OutputError
        It cannot be written; what was there before is intact.
    """
    geometry = survey.geometry
    if not isinstance(geometry, (Mesh, PointCloud)):
        raise UsageError("Maps cannot be written as PLY.", file=path, remedy="Use .tif.")
    pages = []
    if isinstance(geometry, Mesh):
        stem = re.sub(r"[\x00-\x1f\x7f]", "_", path.stem)
        for number, texture in enumerate(geometry.textures):
            page = path.with_name(f"{stem}_{number:03d}{texture_suffix(texture)}")
            write_texture(texture, page)
            pages.append(page)
    names = tuple(page.name for page in pages)
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            stream.write(_new_header(geometry, names))
            for rows in _new_rows(geometry, survey.origin):
                stream.write(rows.data)
        header = read_header(temporary)
        tables = read_tables(header, file_bytes(temporary), temporary, ("vertex",))
        extent = Extent()
        extent.add(geometry.points + survey.origin)
        extent.require_equal(scalar_columns(tables["vertex"], _XYZ), path)
    frame = Frame(file_crs=survey.crs, crs=survey.crs)
    return (path, *pages, *write_shift(path, frame))


def _new_header(geometry: Mesh | PointCloud, pages: tuple[str, ...]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", "comment meshreg"]
    lines += [f"comment TextureFile {name}" for name in pages]
    lines += [f"element vertex {len(geometry.points)}"]
    lines += [f"property double {name}" for name in _XYZ]
    if geometry.colors is not None:
        lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    if isinstance(geometry, Mesh):
        lines += [f"element face {len(geometry.faces)}"]
        lines += ["property list uchar int vertex_indices"]
        if geometry.uv is not None:
            lines += ["property list uchar float texcoord", "property int texnumber"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def _new_rows(geometry: Mesh | PointCloud, origin: Any) -> Iterator[NDArray[Any]]:
    """Give the body in chunks of rows."""
    fields: list[Any] = [("xyz", "<f8", 3)]
    if geometry.colors is not None:
        fields.append(("rgb", "u1", 3))
    for start in range(0, len(geometry.points), _CHUNK):
        part = slice(start, start + _CHUNK)
        rows = np.empty(len(geometry.points[part]), fields)
        rows["xyz"] = geometry.points[part] + origin
        if geometry.colors is not None:
            rows["rgb"] = geometry.colors[part]
        yield rows
    if not isinstance(geometry, Mesh):
        return
    fields = [("n", "u1"), ("v", "<i4", 3)]
    if geometry.uv is not None:
        fields += [("m", "u1"), ("uv", "<f4", 6), ("page", "<i4")]
    for start in range(0, len(geometry.faces), _CHUNK):
        part = slice(start, start + _CHUNK)
        rows = np.empty(len(geometry.faces[part]), fields)
        rows["n"], rows["v"] = 3, geometry.faces[part]
        if geometry.uv is not None and geometry.face_texture is not None:
            rows["m"], rows["uv"] = 6, geometry.uv[part].reshape(-1, 6)
            rows["page"] = geometry.face_texture[part]
        yield rows


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of a PLY file: x, y, z and normals change, nothing else.

    Format, order of elements, types, further properties and comments stay. Coordinates stored as
    float or integer become double where they would step by more than 0.1 mm in the new frame.

    Parameters
    ----------
    source : SourceFile
    move : Mover
    path : Path

    Returns
    -------
    tuple of Path
        The file, then its texture pages.

    Raises
    ------
    InputError
        The source is not what it was when read, or its vertices have lists of varying length.
    OutputError
        It cannot be written, or does not read back as written.
    """
    require_unchanged(source, path)
    header = read_header(source.path)
    data = file_bytes(source.path)
    table = read_tables(header, data, source.path, ("vertex",))["vertex"]
    if table.row is None:
        raise _lists(source)
    points = scalar_columns(table, _XYZ, np.float64)
    new = _with_enough_digits(table.element, move, points, path)
    renamed = _renamed_pages(source, header)
    extent = Extent()
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            stream.writelines(_moved_header(header, table.element, new, renamed))
            _copy(data, header.size, table.where[0], stream)
            moved = _moved_rows(table, move, points)
            if header.order:
                _write_binary(table, new, moved, extent, stream)
            else:
                _write_text(table, bytes(data[slice(*table.where)]), moved, extent, stream)
            _copy(data, table.where[1], len(data), stream)
        _check(temporary, replace(header, textures=renamed), extent, path)
    return (path, *copy_companions(source, path))


def require_writable(source: SourceFile, move: Mover, sample: Float64) -> None:
    """Refuse a file whose vertices have lists of varying length, before the work."""
    del move, sample
    header = read_header(source.path)
    vertex = next(element for element in header.elements if element.name == "vertex")
    if vertex.has_lists:
        data = file_bytes(source.path)
        if read_tables(header, data, source.path, ("vertex",))["vertex"].row is None:
            raise _lists(source)


def _lists(source: SourceFile) -> InputError:
    return InputError(
        "has vertices with lists of varying length, which cannot be rewritten.",
        file=source.path,
        remedy="Export it without them.",
    )


def _with_enough_digits(
    element: Element, move: Mover, points: NDArray[np.float64], path: Path
) -> Element:
    """Return the element with x, y and z as double where their own type is too coarse."""
    kinds = {item.kind for item in element.properties if item.name in _XYZ}
    step = 0.0
    if kinds != {"f8"}:
        step = 1.0 if any(kind[0] != "f" for kind in kinds) else float32_step(move, points)
    if step <= FINEST:
        return element
    warn(path, "x, y and z were stored in a type too coarse for the new frame; they are double.")
    return replace(
        element,
        properties=tuple(
            replace(item, kind="f8") if item.name in _XYZ else item for item in element.properties
        ),
    )


def _renamed_pages(source: SourceFile, header: Header) -> tuple[bytes, ...]:
    """Return the names of the texture pages' copies, as far as they differ from the pages'."""
    names = []
    for name in header.textures:
        new = None
        with suppress(InputError):  # a missing page is no companion
            folder = source.path.parent
            new = source.copies.get(resolve_reference(folder, name, root=folder))
        names.append(name if new is None else os.fsencode(new))
    return tuple(names)


def _moved_header(
    header: Header, old: Element, new: Element, textures: tuple[bytes, ...]
) -> list[bytes]:
    lines = list(header.lines)
    if textures != header.textures:
        pages = iter(textures)
        for number, line in enumerate(lines):
            if found := _TEXTURE.fullmatch(line):
                lines[number] = found[1] + next(pages) + found[3]
    for before, after in zip(old.properties, new.properties, strict=True):
        if before.kind != after.kind:
            lines[before.line] = re.sub(
                rb"(property\s+)\S+", rb"\1double", lines[before.line], count=1
            )
    return lines


def _copy(data: NDArray[np.uint8], start: int, end: int, stream: BinaryIO) -> None:
    for here in range(start, end, _BLOCK):
        stream.write(data[here : min(here + _BLOCK, end)].data)


def _moved_rows(
    table: Table, move: Mover, points: NDArray[np.float64]
) -> Iterator[tuple[slice, NDArray[np.float64], NDArray[np.float64] | None]]:
    """Give chunks of rows: where, their moved points, their turned normals (or None)."""
    items = {item.name: item for item in table.element.properties}
    normals = None
    if all(name in items and items[name].kind[0] == "f" for name in _NORMAL):
        normals = scalar_columns(table, _NORMAL, np.float64)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, min(start + _CHUNK, len(points)))
        turned = None if normals is None else move.directions(points[part], normals[part])
        yield part, moved_points(move, points[part]), turned


def _write_binary(table: Table, new: Element, moved: Any, extent: Extent, stream: BinaryIO) -> None:
    assert table.row is not None
    assert table.row.names is not None
    view = np.ndarray((new.count,), table.row, table.data.data, table.start)
    fields = []
    for name in table.row.names:
        item = new.properties[int(name[1:])]
        kind = table.row[name]
        widened = name[0] == "v" and item.kind == "f8" and item.name in _XYZ
        fields.append((name, np.dtype(table.order + "f8") if widened else kind))
    for part, points, normals in moved:
        rows = np.empty(len(points), fields)
        for name in table.row.names:
            rows[name] = view[name][part]
        for names, values in ((_XYZ, points), (_NORMAL, normals)):
            if values is not None:
                for axis, name in enumerate(names):
                    rows[f"v{new.column(name)}"] = values[:, axis]
        extent.add(np.stack([rows[f"v{new.column(name)}"] for name in _XYZ], axis=1))
        stream.write(rows.data)


def _write_text(table: Table, text: bytes, moved: Any, extent: Extent, stream: BinaryIO) -> None:
    """Replace words in the lines of text; the other words and the line ends stay."""
    assert table.row is not None
    place = {}
    for number, item in enumerate(table.element.properties):
        place[item.name] = table.row.fields[f"v{number}"][1] // 8  # type: ignore[index]
    lines = (line for line in re.findall(rb"[^\r\n]*(?:\r\n|\n|\r)|[^\r\n]+", text))
    for part, points, normals in moved:
        done = 0
        columns = [(place[name], points[:, k]) for k, name in enumerate(_XYZ)]
        if normals is not None:
            columns += [(place[name], normals[:, k]) for k, name in enumerate(_NORMAL)]
        # 15 digits: what was written with up to 15 comes out the same when nothing moves.
        words = [(at, [f"{value:.15g}".encode() for value in values]) for at, values in columns]
        while done < part.stop - part.start:
            line = next(lines)
            row = line.split()
            if row:
                for at, column in words:
                    row[at] = column[done]
                done += 1
                line = b" ".join(row) + line[len(line.rstrip(b"\r\n")) :]
            stream.write(line)
        extent.add(points)
    stream.writelines(lines)


def _check(written: Path, header: Header, extent: Extent, path: Path) -> None:
    """Read a rewritten file back."""
    again = read_header(written)
    old = [(item.name, item.count, len(item.properties)) for item in header.elements]
    new = [(item.name, item.count, len(item.properties)) for item in again.elements]
    if old != new or again.order != header.order or again.textures != header.textures:
        raise OutputError("does not read back as written: its header differs.", file=path)
    tables = read_tables(again, file_bytes(written), written, ("vertex",))
    points = scalar_columns(tables["vertex"], _XYZ, np.float64)
    largest = max(1.0, float(np.abs([extent.low, extent.high]).max())) if extent.count else 1.0
    extent.require_equal(points, path, 0.0 if header.order else 1e-14 * largest)
