"""READ and WRITE OFF: polygons in text, with colors per vertex as COFF."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.assemble import Found, RawGeometry, assemble_survey, eight_bit_colors
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.rewriting import (
    Extent,
    metres_per_file_unit,
    moved_points,
    require_close,
    require_unchanged,
)
from meshreg.io.files.safe import file_bytes, open_regular, require
from meshreg.io.frames.mover import Mover
from meshreg.io.frames.sidecar import write_shift
from meshreg.io.masks.polygons import triangulate
from meshreg.io.options import ReadOptions
from meshreg.io.ply.text import line_of, read_numbers
from meshreg.io.second_reader import SLACK
from meshreg.records import Float64, Frame, Mesh, SourceFile, Survey

_MOST_READ_TWICE = 50_000_000  # bytes
_COMMENT = re.compile(rb"#[^\r\n]*")
_HEAD = re.compile(
    rb"\s*(C?OFF)\s+(-?[0-9]{1,15})[ \t]+(-?[0-9]{1,15})(?:[ \t]+-?[0-9]{1,15})?[ \t]*[\r\n]"
)
_DAMAGED = "The file is cut off or damaged; export or copy it again."


class _Lines:
    """The text without comments: numbers of each row, and where the rows lie in the file.

    Comments are blanked, not cut out, so that positions in `data` are those in the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        text = _COMMENT.sub(lambda match: b" " * len(match[0]), bytes(file_bytes(path)))
        head = _HEAD.match(text)
        if not head:
            raise InputError(
                "does not start with OFF (or COFF) and the counts of vertices and faces.",
                file=path,
                place="line 1",
                remedy="Binary OFF and further kinds are not read; export it as PLY.",
            )
        self.colored = head[1] == b"COFF"
        self.n_vertices, self.n_faces = int(head[2]), int(head[3])
        self.data = np.frombuffer(text, np.uint8)
        left = len(text) - head.end() + 1
        require(self.n_vertices, 6, left, path, "line 2", "vertices")
        require(self.n_faces, 2, left - 6 * self.n_vertices, path, "line 2", "faces")
        self.start = head.end()
        self.middle, sizes, self.vertices = self._rows(self.start, self.n_vertices, "vertices")
        wanted = (6, 7) if self.colored else (3,)
        wrong = np.flatnonzero((sizes != sizes[:1]) | ~np.isin(sizes, wanted))
        if len(wrong):
            self._fail_row(self.start, int(wrong[0]), int(sizes[wrong[0]]))
        end, self.sizes, self.faces = self._rows(self.middle, self.n_faces, "faces")
        if text[end:].strip():
            raise InputError(
                "goes on after its last face.",
                file=path,
                place=line_of(self.data, end),
                remedy="The counts on its second line are too small; export it again.",
            )

    def _rows(self, start: int, count: int, what: str) -> tuple[int, NDArray[np.int64], Float64]:
        from meshreg.io.ply.kernels import count_tokens

        words = np.zeros(count, np.int64)
        end, found = count_tokens(self.data, start, count, words)
        if found < count:
            raise InputError(
                f"ends after {found} of {count} {what}.",
                file=self.path,
                place=line_of(self.data, end),
                remedy=_DAMAGED,
            )
        return int(end), words, read_numbers(self.data, start, end, int(words.sum()), self.path)

    def _fail_row(self, start: int, row: int, size: int) -> None:
        from meshreg.io.ply.kernels import count_tokens

        end, _ = count_tokens(self.data, start, row + 1, np.zeros(row + 1, np.int64))
        raise InputError(
            f"has {size} numbers on a line where that does not fit.",
            file=self.path,
            place=line_of(self.data, int(end) - 1),
            remedy=_DAMAGED,
        )

    def polygons(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Return the size of each face and the vertex of each corner, checked."""
        first = np.cumsum(self.sizes) - self.sizes
        sizes = self.faces[first]
        rest = self.sizes - 1 - sizes  # up to four numbers of color may follow
        good = (sizes == np.floor(sizes)) & (sizes >= 0) & (rest >= 0) & (rest <= 4)
        if not good.all():
            bad = int(np.flatnonzero(~good)[0])
            self._fail_row(self.middle, bad, int(self.sizes[bad]))
        count = sizes.astype(np.int64)
        step = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
        values = self.faces[np.repeat(first, count) + 1 + step]
        wrong = (values != np.floor(values)) | (values < 0) | (values >= self.n_vertices)
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            face = int(np.searchsorted(np.cumsum(count), at, side="right"))
            raise InputError(
                f"refers to vertex {values[at]:g} of {self.n_vertices} (counted from 0).",
                file=self.path,
                place=f"face {face + 1}",
                remedy="The file is damaged; export it again.",
            )
        return count, values.astype(np.int32)


def read(path: Path, options: ReadOptions) -> Survey:
    """Read an OFF or COFF file.

    Raises
    ------
    InputError
        Counts that the file does not hold, a line with the wrong number of words, indices out of
        range, over 1 % of vertices not finite.
    """
    lines = _Lines(path)
    rows = lines.vertices.reshape(lines.n_vertices, -1 if lines.n_vertices else 3)
    points = rows[:, :3]
    notes: tuple[str, ...] = ()
    colors = None
    if lines.colored:
        colors, notes = eight_bit_colors(_as_stored(rows[:, 3:6]))
    counts = {"vertices": lines.n_vertices, "faces": lines.n_faces}
    if not lines.n_faces:
        raw = RawGeometry(points, None, colors)
        return assemble_survey(path, raw, Found("off", notes, counts=counts), options)
    sizes, corners = lines.polygons()
    triangles = triangulate(points, sizes, corners, path)
    raw = RawGeometry(points, np.ascontiguousarray(triangles.pick_corners(corners)), colors)
    found = Found("off", (*notes, *triangles.notes()), counts=counts)
    return assemble_survey(path, raw, found, options)


def _as_stored(colors: Float64) -> NDArray[Any]:
    """Return whole numbers as integers (0-255), others as they are (0-1)."""
    whole = colors.size and (colors == np.floor(colors)).all() and colors.max() > 1
    return colors.astype(np.int64) if whole else colors


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a mesh as OFF, or COFF where it has colors, in absolute coordinates.

    Raises
    ------
    UsageError
        The survey is no mesh.
    OutputError
        It cannot be written.
    """
    mesh = survey.geometry
    if not isinstance(mesh, Mesh):
        raise UsageError("Only a mesh can be written as OFF.", file=path, remedy="Use .ply.")
    points = mesh.vertices + survey.origin
    colors = [""] * len(points)
    if mesh.colors is not None:
        colors = [" %d %d %d 255" % tuple(row) for row in mesh.colors.tolist()]  # noqa: UP031
    with atomic_file(path) as temporary:
        with open(temporary, "w", encoding="ascii") as stream:
            stream.write("OFF\n" if mesh.colors is None else "COFF\n")
            stream.write(f"{len(points)} {len(mesh.faces)} 0\n")
            for (x, y, z), color in zip(points.tolist(), colors, strict=True):
                stream.write(f"{x!r} {y!r} {z!r}{color}\n")
            stream.writelines(f"3 {a} {b} {c}\n" for a, b, c in mesh.faces.tolist())
        extent = Extent()
        extent.add(points)
        again = _Lines(temporary)
        extent.require_equal(again.vertices.reshape(len(points), -1)[:, :3], path)
    return (path, *write_shift(path, Frame(file_crs=survey.crs, crs=survey.crs)))


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of an OFF file: the first three numbers of vertices change only.

    Raises
    ------
    InputError
        The source is not what it was when read.
    OutputError
        It cannot be written, or does not read back as written.
    """
    require_unchanged(source, path)
    lines = _Lines(source.path)
    points = lines.vertices.reshape(lines.n_vertices, -1)[:, :3]
    moved = moved_points(move, points)
    original = bytes(file_bytes(source.path))
    new = iter(moved.tolist())
    extent = Extent()
    extent.add(moved)
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            stream.write(original[: lines.start])
            for line in re.findall(
                rb"[^\r\n]*(?:\r\n|\n|\r)|[^\r\n]+", original[lines.start : lines.middle]
            ):
                words = line.split(b"#")[0].split()
                if words:
                    xyz = " ".join(f"{value:.15g}" for value in next(new)).encode()
                    tail = b" ".join([b"", *words[3:]])
                    line = xyz + tail + line[len(line.rstrip(b"\r\n")) :]  # noqa: PLW2901
                stream.write(line)
            stream.write(original[lines.middle :])
        again = _Lines(temporary)
        tolerance = 1e-14 * float(np.abs(moved[np.isfinite(moved)]).max(initial=1))
        extent.require_equal(again.vertices.reshape(len(points), -1)[:, :3], path, tolerance)
        _look_again(source.path, temporary, move, path)
    return (path,)


def _look_again(old: Path, new: Path, move: Mover, path: Path) -> None:
    """Compare vertices and faces as trimesh reads them, where the file is not large."""
    from trimesh.exchange.off import load_off

    if old.stat().st_size > _MOST_READ_TWICE:
        return
    tables = []
    for each in (old, new):
        with open_regular(each) as stream:
            try:
                tables.append(load_off(stream))
            except (ValueError, IndexError, NameError) as error:
                if each == old:
                    return  # trimesh has never read it
                raise OutputError(f"is not read by trimesh: {error}.", file=path) from error
    before, after = tables
    expected = moved_points(move, before["vertices"])
    tolerance = SLACK / metres_per_file_unit(move)
    tolerance += 1e-13 * float(np.abs(expected[np.isfinite(expected)]).max(initial=1))
    require_close(after["vertices"], expected, tolerance, path)
    if not np.array_equal(before["faces"], after["faces"]):
        raise OutputError("does not read back as written: its faces differ.", file=path)
