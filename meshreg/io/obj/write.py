"""WRITE Wavefront OBJ: a survey from memory, or a moved copy of a file that keeps all else."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import OutputError, UsageError
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.images import texture_suffix, write_texture
from meshreg.io.files.line_blocks import Block, in_order, line_blocks
from meshreg.io.files.rewriting import (
    Extent,
    copy_companions,
    moved_points,
    require_close,
    require_unchanged,
    warn,
)
from meshreg.io.files.safe import open_regular
from meshreg.io.frames.directions import bend_note, find_directions
from meshreg.io.frames.mover import Mover
from meshreg.io.frames.sidecar import write_shift
from meshreg.io.obj.mtl_write import new_libraries, write_libraries
from meshreg.io.obj.scan import scan
from meshreg.io.second_reader import ANYTHING, Expected, LineRule, require_lines
from meshreg.records import Float64, Frame, Mesh, PointCloud, SourceFile, Survey, UInt8

_ROWS = 1 << 16  # rows turned into text at once
_FEWEST_DECIMALS = 6
_UV_DECIMALS = 9  # float32 between 0.5 and 1 steps by 6e-8, near 0.01 by 9e-10
_BOM = b"\xef\xbb\xbf"


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a survey as Wavefront OBJ in coordinates from its origin, which goes to a sidecar.

    Six decimals, more for small things: a hundred-millionth of the extent at least. Texture
    pages become ``<stem>_0.png`` and so on (byte for byte where they came from a file), named in
    ``<stem>.mtl``; colors per vertex follow the coordinates as three numbers from 0 to 1.

    Parameters
    ----------
    survey : Survey
        A mesh or a point cloud.
    path : Path

    Returns
    -------
    tuple of Path
        The file, its MTL and texture pages, its shift sidecar where one is needed.

    Raises
    ------
    UsageError
        The survey is maps, or has coordinates that are not finite.
    OutputError
        It cannot be written; what was there before is intact.
    """
    geometry = survey.geometry
    if not isinstance(geometry, (Mesh, PointCloud)):
        raise UsageError("Maps cannot be written as OBJ.", file=path, remedy="Use .tif.")
    if not len(geometry.points):
        raise UsageError("the survey holds no points.", file=path)
    if not (np.abs(geometry.points) < 1e9).all():
        raise UsageError("has coordinates that are not finite or over 1e9.", file=path)
    extra: list[Path] = []
    names: tuple[str, ...] = ()
    if isinstance(geometry, Mesh) and geometry.uv is not None:
        stem = re.sub(r"[^A-Za-z0-9._-]", "_", path.stem)
        names = ("untextured", *(f"page_{k}" for k in range(len(geometry.textures))))
        extra = _write_materials(geometry, path.with_name(f"{stem}.mtl"), names)
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            _write_geometry(geometry, stream, extra[0].name if extra else "", names)
        extent = Extent()
        extent.add(geometry.points)
        extent.require_equal(scan(temporary).points, path, 1e-6)
    frame = Frame(shift=survey.origin, file_crs=survey.crs, crs=survey.crs)
    return (path, *extra, *write_shift(path, frame))


def _write_materials(mesh: Mesh, path: Path, names: tuple[str, ...]) -> list[Path]:
    """Write the texture pages, then the MTL that names them; return the MTL and the pages."""
    pages = []
    lines = [f"newmtl {names[0]}", "Kd 1 1 1"]
    for number, texture in enumerate(mesh.textures):
        page = path.with_name(f"{path.stem}_{number}{texture_suffix(texture)}")
        write_texture(texture, page)
        pages.append(page)
        clamp = "-clamp on " if texture.clamp else ""
        lines += [f"newmtl {names[number + 1]}", "Kd 1 1 1", f"map_Kd {clamp}{page.name}"]
    with atomic_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", "ascii")
    return [path, *pages]


def _write_geometry(
    geometry: Mesh | PointCloud, stream: BinaryIO, library: str, names: tuple[str, ...]
) -> None:
    from meshreg.io.obj.write_kernels import MAX_NUMBER, number_values, put_faces, put_rows

    def lines(word: bytes, rows: Any, decimals: int, more: Any) -> Iterator[Any]:
        text = np.frombuffer(word, np.uint8)
        for start in range(0, len(rows), _ROWS):
            part = np.asarray(rows[start : start + _ROWS], np.float64)
            beside = np.asarray(more[start : start + _ROWS], np.float64) / 255
            width = len(text) + 1 + (part.shape[1] + beside.shape[1]) * (MAX_NUMBER + 1)
            out = np.empty(len(part) * width, np.uint8)
            yield out[: put_rows(text, part, decimals, beside, out)]

    points = geometry.points
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 1.0
    decimals = int(np.clip(np.ceil(8 - np.log10(max(extent, 1e-9))), _FEWEST_DECIMALS, 15))
    stream.write(b"# meshreg\n" + (f"mtllib {library}\n".encode() if library else b""))
    colors = geometry.colors if geometry.colors is not None else np.empty((0, 3), np.uint8)
    stream.writelines(lines(b"v", points, decimals, colors))
    if isinstance(geometry, PointCloud):
        return
    uv, pages = np.empty((0, 3), np.int32), np.empty(0, np.int32)
    if geometry.uv is not None and geometry.face_texture is not None:
        pages = np.asarray(geometry.face_texture)
        corners = geometry.uv[pages >= 0].reshape(-1, 2)
        values = np.ascontiguousarray(corners).view(np.uint64).reshape(-1)
        numbers = np.empty(len(values), np.int32)
        firsts = np.empty(len(values), np.int64)
        table = np.full(1 << int(2 * len(values) + 1).bit_length(), -1, np.int32)
        count = number_values(values, table, numbers, firsts)
        stream.writelines(
            lines(b"vt", corners[firsts[:count]], _UV_DECIMALS, np.empty((0, 3), np.uint8))
        )
        uv = np.full((len(pages), 3), -1, np.int32)
        uv[pages >= 0] = numbers.reshape(-1, 3)
    texts = [f"usemtl {name}\n".encode() for name in names]
    starts = np.cumsum([0, *map(len, texts)])
    longest = max(map(len, texts), default=0)
    before = -2
    for start in range(0, len(geometry.faces), _ROWS):
        part = slice(start, start + _ROWS)
        out = np.empty(len(geometry.faces[part]) * (75 + longest), np.uint8)
        joined = np.frombuffer(b"".join(texts) or b"\0", np.uint8)
        size = put_faces(geometry.faces[part], uv[part], pages[part], before, joined, starts, out)
        stream.write(out[:size].data)
        before = int(pages[part][-1]) if len(pages) else before


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of an OBJ file: the numbers of `v` and `vn` change, no other byte.

    Numbers keep their decimals, and get six where they had fewer. The MTL and the texture pages
    are copied under the same names, or under those in `source.copies`: then the lines that name
    them change, too.

    Parameters
    ----------
    source : SourceFile
    move : Mover
    path : Path

    Returns
    -------
    tuple of Path
        The file, then its MTL and texture pages.

    Raises
    ------
    InputError
        The source is not what it was when read.
    OutputError
        It cannot be written, does not read back as written, or a file of the same name and other
        content is there.
    """
    require_unchanged(source, path)
    size = max(source.fingerprint[0], 1)
    parts, lines = [], 0
    normals_in: set[bool] = set()
    with atomic_file(path) as temporary:
        with open_regular(source.path) as stream, open(temporary, "wb") as out:
            if stream.read(3) == _BOM:
                out.write(_BOM)
            stream.seek(0)
            blocks = line_blocks(stream, source.path)
            work = _mover_of_blocks(move, path, new_libraries(source), normals_in)
            with closing(in_order(blocks, work, size)) as moved:
                for block, (text, points) in moved:
                    out.write(text.data)
                    parts.append(points)
                    lines += _count_lines(block)
        again, lines_again = _read_back(temporary)
        require_close(again, np.concatenate(parts), 1e-6, path)
        if lines_again != lines:
            raise OutputError(
                f"does not read back as written: {lines_again} lines of {lines}.",
                file=path,
                remedy="Check the disk and run again.",
            )
        require_lines(source.path, temporary, _line_rule(source, move), path)
    if True in normals_in and (note := bend_note(find_directions(("nx", "ny", "nz")), move)):
        warn(path, note)
    copies = copy_companions(source, path, but=".mtl" if source.copies else "")
    write_libraries(source, path)
    return (path, *copies)


def _line_rule(source: SourceFile, move: Mover) -> LineRule:
    """Return what a second reader expects of a line: `v` and `vn` moved, all else as it was."""

    def rule(words: list[bytes], number: int) -> Expected | None:
        del number
        kind = words[0] if len(words) > 3 else b""
        if words[:1] == [b"mtllib"] and source.copies:
            return ANYTHING
        if kind not in (b"v", b"vn"):
            return None
        try:
            old = np.array([[float(word) for word in words[1:4]]])
        except ValueError:
            return ANYTHING
        new = moved_points(move, old) if kind == b"v" else move.directions(old, old)
        return Expected((1, 2, 3), new[0], 1e-6 + 2e-15 * np.abs(new[0]))

    return rule


def _read_back(path: Path) -> tuple[Float64, int]:
    """Return the points (N, 3) of a file's `v` lines, and how many lines it has."""

    def found(block: Block) -> tuple[Float64, int]:
        kinds, _, values, _ = _vectors(block)
        return values[kinds == 0], _count_lines(block)

    with open_regular(path) as stream:
        blocks = line_blocks(stream, path)
        with closing(in_order(blocks, found, os.path.getsize(path))) as results:
            parts, lines = zip(*(result for _, result in results), strict=True)
    return np.concatenate(parts), sum(lines)


def _count_lines(block: Block) -> int:
    return int(np.count_nonzero(block.data[: block.end] == ord("\n")))


def _vectors(block: Block) -> tuple[UInt8, NDArray[np.int64], Float64, NDArray[np.int64]]:
    """Kinds (N,), places (N, 3, 2), values (N, 3) and decimals (N, 3) of a block's vectors."""
    from meshreg.io.obj import write_kernels as kernels
    from meshreg.io.obj.text_kernels import N_STATE

    most = block.end // 6 + 2
    kinds = np.empty(most, np.uint8)
    spans = np.empty((most, 3, 2), np.int64)
    values = np.empty((most, 3))
    decimals = np.empty((most, 3), np.int64)
    state = np.zeros(N_STATE, np.int64)
    n = kernels.find_vectors(block.data, block.end, kinds, spans, values, decimals, state)
    _read_rest(block, spans[:n], values[:n])
    return kinds[:n], spans[:n], values[:n], decimals[:n]


def _mover_of_blocks(
    move: Mover,
    path: Path,
    libraries: Callable[[bytes], bytes] | None = None,
    normals_in: set[bool] | None = None,
) -> Callable[[Block], tuple[UInt8, Float64]]:
    """Return the function that moves one block: its new bytes, and its moved points.

    It enters into `normals_in` whether it met normals.
    """
    from meshreg.io.obj import write_kernels as kernels

    def moved(block: Block) -> tuple[UInt8, Float64]:
        text, points = placed(block)
        if libraries is not None:
            text = np.frombuffer(libraries(text.tobytes()), np.uint8)
        return text, points

    def placed(block: Block) -> tuple[UInt8, Float64]:
        kinds, spans, values, decimals = _vectors(block)
        n = len(kinds)
        if n == 0:
            return block.data[: block.end], np.empty((0, 3))
        points = moved_points(move, values[kinds == 0])
        values[kinds == 0] = points
        normals = values[kinds == 1]
        if normals_in is not None:
            normals_in.add(len(normals) > 0)
        values[kinds == 1] = move.directions(np.zeros_like(normals), normals)
        values[~np.isfinite(values).all(axis=1)] = np.nan  # those lines stay as they are
        decimals = np.maximum(decimals, _FEWEST_DECIMALS)
        out = np.empty(block.end + 3 * n * kernels.MAX_NUMBER, np.uint8)
        size = kernels.put_vectors(block.data, block.end, spans, values, decimals, out)
        if size < 0:
            raise OutputError("has coordinates that are too large to be written.", file=path)
        return out[:size], points

    return moved


def _read_rest(block: Block, spans: NDArray[np.int64], values: Float64) -> None:
    """Read the numbers that the kernel could not; NaN and infinity stay NaN."""
    for row, k in np.argwhere(np.isnan(values)).tolist():
        word = block.data[slice(*spans[row, k].tolist())].tobytes()
        try:
            value = float(word)
        except ValueError:
            continue
        values[row, k] = value if np.isfinite(value) else np.nan
