"""WRITE PLY: a survey from memory, or a moved copy of a file that keeps all else."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.images import texture_suffix, write_texture
from meshreg.io.files.rewriting import (
    FINEST,
    Extent,
    copy_companions,
    float32_step,
    metres_per_file_unit,
    moved_points,
    require_unchanged,
    warn,
)
from meshreg.io.files.safe import file_bytes, resolve_reference
from meshreg.io.frames.directions import (
    Directions,
    bend_note,
    find_directions,
    stored,
    turn_columns,
)
from meshreg.io.frames.mover import Mover
from meshreg.io.frames.sidecar import write_shift
from meshreg.io.ply.body import Table, read_tables, scalar_columns
from meshreg.io.ply.header import Element, Header, read_header
from meshreg.io.second_reader import SLACK, require_ply
from meshreg.records import Frame, Mesh, PointCloud, SourceFile, Survey

_CHUNK = 1 << 18  # rows
_BLOCK = 1 << 24  # bytes
_XYZ = ("x", "y", "z")
_TEXTURE = re.compile(rb"(\s*comment\s+(?i:texturefile)\s+)(.*?)(\s*)", re.DOTALL)


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a survey as binary little-endian PLY with absolute float64 coordinates.

    Colors are written per vertex; texture coordinates per face, with one `comment TextureFile`
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
    """Write a moved copy of a PLY file: x, y, z and directions change, nothing else.

    Format, order of elements, types, further properties (lists too) and comments stay.
    Coordinates stored as float or integer become double where they would step by more than 0.1 mm
    in the new frame. Directions of faces turn too.

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
        The source is not what it was when read.
    OutputError
        It cannot be written, or does not read back as written.
    """
    require_unchanged(source, path)
    header = read_header(source.path)
    data = file_bytes(source.path)
    turning = {item.name: element_directions(item) for item in header.elements}
    changed = [
        name for name in turning if name == "vertex" or (name == "face" and turning[name].columns)
    ]
    tables = read_tables(header, data, source.path, tuple(changed))
    points = scalar_columns(tables["vertex"], _XYZ, np.float64)
    new = _with_enough_digits(tables["vertex"].element, move, points, path)
    parts = [_Part(table, table.element, None, turning[name]) for name, table in tables.items()]
    at = list(tables).index("vertex")
    parts[at] = replace(parts[at], new=new, points=points)
    for part in parts:
        if note := bend_note(part.found, move):
            warn(path, note)
    renamed = _renamed_pages(source, header)
    extent = Extent()
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            stream.writelines(_moved_header(header, tables["vertex"].element, new, renamed))
            here = header.size
            for part in parts:
                start, end = part.table.where
                _copy(data, here, start, stream)
                moved = _moved_columns(part, move, extent)
                if not header.order:
                    _write_text(part.table, bytes(data[start:end]), moved, stream)
                elif part.table.row is not None:
                    _write_binary(part.table, part.new, moved, stream)
                else:
                    _write_spliced(part.table, part.new, moved, stream)
                here = end
            _copy(data, here, len(data), stream)
        _check(temporary, replace(header, textures=renamed), extent, path)
        require_ply(
            source.path,
            temporary,
            _moved_values(move, turning["vertex"]),
            path,
            SLACK / metres_per_file_unit(move),
        )
    return (path, *copy_companions(source, path))


@dataclass(frozen=True, eq=False)
class _Part:
    """An element whose rows change: as it is, as it will be, its points if it has any."""

    table: Table
    new: Element
    points: NDArray[np.float64] | None
    found: Directions


def element_directions(element: Element) -> Directions:
    """Find the attributes with a direction among an element's properties."""
    scalars = [item for item in element.properties if not item.count_kind]
    fixed = {item.name for item in scalars if item.kind[0] == "u"}
    return find_directions((item.name for item in scalars), _XYZ, fixed)


def direction_notes(header: Header) -> tuple[str, ...]:
    """Return what a reader says of directions that a moved copy cannot turn."""
    notes: tuple[str, ...] = ()
    for element in header.elements:
        found = element_directions(element)
        placed = all(element.column(name) is not None for name in _XYZ)
        if element.name in ("vertex", "face"):
            notes += found.notes
        elif element.count and (placed or found.columns or found.kept):
            notes += (f"Element {element.name!r} holds places or directions; it is not moved.",)
    return notes


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


def _numbers(element: Element, names: Iterable[str]) -> list[int]:
    """Return the numbers of some columns, ascending."""
    wanted = set(names)
    return [number for number, item in enumerate(element.properties) if item.name in wanted]


def _copy(data: NDArray[np.uint8], start: int, end: int, stream: BinaryIO) -> None:
    for here in range(start, end, _BLOCK):
        stream.write(data[here : min(here + _BLOCK, end)].data)


def _moved_columns(
    change: _Part, move: Mover, extent: Extent
) -> Iterator[tuple[slice, dict[str, NDArray[Any]]]]:
    """Give chunks of rows: where, and the columns that change, in the type to be written."""
    table, new, points, found = change.table, change.new, change.points, change.found
    old = {}
    for name in found.columns:
        number = table.element.column(name)
        assert number is not None
        old[name] = table.column(number)[1]
    kinds = {item.name: np.dtype(item.kind) for item in new.properties}
    if table.is_text:  # as many digits as there are
        kinds = {k: np.dtype(np.float64) if v.kind == "f" else v for k, v in kinds.items()}
    for start in range(0, table.element.count, _CHUNK):
        part = slice(start, min(start + _CHUNK, table.element.count))
        here = np.zeros((part.stop - start, 3)) if points is None else points[part]
        columns = turn_columns(found, move, here, {name: old[name][part] for name in old})
        if points is not None:
            columns |= dict(zip(_XYZ, moved_points(move, here).T, strict=True))
        written = {name: stored(values, kinds[name]) for name, values in columns.items()}
        if points is not None:
            extent.add(np.stack([written[name] for name in _XYZ], axis=1))
        yield part, written


def _write_binary(table: Table, new: Element, moved: Any, stream: BinaryIO) -> None:
    """Write rows that are all alike."""
    assert table.row is not None
    assert table.row.names is not None
    view = np.ndarray((new.count,), table.row, table.data.data, table.start)
    fields = []
    for name in table.row.names:
        item = new.properties[int(name[1:])]
        kind = table.row[name]
        widened = name[0] == "v" and item.kind == "f8" and item.name in _XYZ
        fields.append((name, np.dtype(table.order + "f8") if widened else kind))
    for part, columns in moved:
        rows = np.empty(part.stop - part.start, fields)
        for name in table.row.names:
            rows[name] = view[name][part]
        for name, values in columns.items():
            rows[f"v{new.column(name)}"] = values
        stream.write(rows.data)


def _write_spliced(table: Table, new: Element, moved: Any, stream: BinaryIO) -> None:
    """Write rows whose lists differ in length: their bytes, but for those of some columns."""
    from meshreg.io.ply.kernels import splice

    starts = places = np.empty(0, np.int64)
    numbers: list[int] = []
    for part, columns in moved:
        if not numbers:
            numbers = _numbers(new, columns)
            starts, places = table.locate(numbers)
        items = [new.properties[number] for number in numbers]
        sizes = np.array([int(item.kind[1]) for item in items])
        before = np.array([int(table.element.properties[number].kind[1]) for number in numbers])
        values = np.zeros((part.stop - part.start, len(numbers), 8), np.uint8)
        for k, item in enumerate(items):
            ordered = columns[item.name].astype(table.order + item.kind)
            values[:, k, : sizes[k]] = ordered.view(np.uint8).reshape(-1, sizes[k])
        rows = starts[part.start : part.stop + 1]
        room = int(rows[-1] - rows[0] + len(values) * (sizes - before).clip(0).sum())
        out = np.empty(room, np.uint8)
        size = splice(table.data, rows, places[part], before, values, sizes, out)
        stream.write(out[:size].data)


def _write_text(table: Table, text: bytes, moved: Any, stream: BinaryIO) -> None:
    """Replace words in the lines of text; the other words and the line ends stay."""
    lines = (line for line in re.findall(rb"[^\r\n]*(?:\r\n|\n|\r)|[^\r\n]+", text))
    for part, columns in moved:
        numbers = _numbers(table.element, columns)
        starts, places = table.locate(numbers)
        words = (places - starts[:-1, None]) // 8  # numbers of words in their rows
        names = [table.element.properties[number].name for number in numbers]
        # 15 digits: what was written with up to 15 comes out the same when nothing moves.
        texts = [[f"{value:.15g}".encode() for value in columns[name].tolist()] for name in names]
        done = 0
        while done < part.stop - part.start:
            line = next(lines)
            row = line.split()
            if row:
                for k, at in enumerate(words[part.start + done].tolist()):
                    row[at] = texts[k][done]
                done += 1
                line = b" ".join(row) + line[len(line.rstrip(b"\r\n")) :]
            stream.write(line)
    stream.writelines(lines)


def _moved_values(move: Mover, found: Directions) -> Callable[[dict[str, float]], dict[str, float]]:
    """Return the function that moves one vertex, for the second reader."""

    def moved(values: dict[str, float]) -> dict[str, float]:
        point = np.array([[values[name] for name in _XYZ]])
        named = {name: np.array([values[name]]) for name in found.columns}
        turned = turn_columns(found, move, point, named)
        out = {name: float(column[0]) for name, column in turned.items()}
        return out | dict(zip(_XYZ, moved_points(move, point)[0].tolist(), strict=True))

    return moved


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
