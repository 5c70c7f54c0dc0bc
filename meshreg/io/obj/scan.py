"""One pass over a Wavefront OBJ file: blocks of lines, read side by side, joined in order.

Nothing here depends on how many threads work: a block's result is its own.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, ResourceLimitError
from meshreg.io.files.line_blocks import LONGEST, Block, in_order, line_blocks
from meshreg.io.files.safe import open_regular
from meshreg.io.obj.lines import Lines, Worker, word_at
from meshreg.records import Float32, Float64, Int32

_COUNTED = (
    *("VERTICES", "UVS", "NORMALS", "FACES", "OBJECTS", "GROUPS"),
    *("ELEMENTS", "OTHERS", "WEIGHTED", "COLORED"),
)
_REPAIR = "Export the file again, or repair the line."


@dataclass(frozen=True, eq=False)
class Scan:
    """Everything of an OBJ file that is used, in the file's coordinates.

    Attributes
    ----------
    points : (V, 3) float64
        May hold NaN, which stands for infinity too.
    colors : (V, 3) float32 or None
        As written; None unless every vertex has them.
    uvs : (T, 2) float32
    vertex : (C,) int32
        Vertex of each face corner, from 0; unchecked.
    uv : (C,) int32 or None
        Texture vertex of each corner, from 0, -1 for none; unchecked. None where no corner has.
    sizes : (P,) int32 or None
        Corners of each face; None where all are triangles.
    materials : list of (int, str)
        Faces before each `usemtl`, and its name.
    libraries : list of str
        Names of `mtllib`, in order, without repeats.
    counts : dict
        Of statements, by kind.
    sha256 : str
    fingerprint : (int, int)
        Size [bytes] and time of last change [ns].
    ends_whole : bool
        Whether the last line has its end.
    """

    points: Float64
    colors: Float32 | None
    uvs: Float32
    vertex: Int32
    uv: Int32 | None
    sizes: Int32 | None
    materials: list[tuple[int, str]]
    libraries: list[str]
    counts: dict[str, int]
    sha256: str
    fingerprint: tuple[int, int]
    ends_whole: bool


def scan(path: Path) -> Scan:
    """Read an OBJ file.

    Raises
    ------
    InputError
        With the number of the line, and of the face where there is one.
    ResourceLimitError
        A line of more than 1 MiB, over 2^30 corners.
    """
    hasher = hashlib.sha256()
    joiner = _Joiner(path)
    with open_regular(path) as stream:
        before = os.fstat(stream.fileno())
        # closed here, not by the garbage collector, which may run in one of its own threads
        with closing(
            in_order(line_blocks(stream, path, hasher), Worker(), before.st_size)
        ) as found:
            for block, lines in found:
                joiner.add(block, lines)
        after = os.fstat(stream.fileno())
    mark = (after.st_size, after.st_mtime_ns)
    if mark != (before.st_size, before.st_mtime_ns):
        raise InputError("changed while it was read.", file=path, remedy="Read it again.")
    return joiner.joined(hasher.hexdigest(), mark)


def line_of_face(path: Path, face: int) -> int:
    """Return the number of the line (from 1) that holds a face (from 0)."""
    from meshreg.io.obj import text_kernels as text

    work = Worker()
    n_lines = 0
    with open_regular(path) as stream:
        for block in line_blocks(stream, path):
            state = work(block, stop=face).state
            n_lines += int(state[text.LINES])
            if state[text.ERROR] == text.STOPPED:
                break
            face -= int(state[text.FACES])
    return n_lines + 1


class _Joiner:
    """Joins what is in the blocks, in the order of the file; says what is wrong, and where."""

    def __init__(self, path: Path) -> None:
        from meshreg.io.obj import text_kernels as text

        self._path = path
        self._parts: list[Lines] = []
        self._totals = np.zeros(text.N_STATE, np.int64)
        self._names: list[tuple[int, int, str]] = []
        self._ends_whole = True

    def add(self, block: Block, lines: Lines) -> None:
        """Take the next block; raise for what is wrong in it."""
        from meshreg.io.obj import text_kernels as text

        if lines.wrong:
            raise self._wrong_word(*lines.wrong[0])
        if lines.state[text.ERROR] != text.OK:
            raise self._error(block, lines.state)
        if lines.state[text.RELATIVE]:
            _make_absolute(lines.vertex, int(self._totals[text.VERTICES]))
            if lines.uv is not None:
                _make_absolute(lines.uv, int(self._totals[text.UVS]))
        first = int(self._totals[text.FACES])
        self._names += [(kind, first + faces, name) for kind, faces, name in lines.names]
        self._totals += lines.state
        self._parts.append(lines)
        self._ends_whole = block.data[block.end - 1] in (10, 13)
        if self._totals[[text.VERTICES, text.UVS, text.CORNERS]].max() >= 1 << 30:
            raise ResourceLimitError("has over 2^30 vertices or corners.", file=self._path)

    def _wrong_word(self, line: int, word: str) -> InputError:
        from meshreg.io.obj import text_kernels as text

        message, remedy = f"{word!r} cannot be read as a number.", _REPAIR
        if "," in word:
            message = f"{word!r} has a comma where a number is expected (a decimal comma?)."
            remedy = "Export it with a decimal point."
        place = f"line {self._totals[text.LINES] + line + 1}"
        return InputError(message, file=self._path, place=place, remedy=remedy)

    def _error(self, block: Block, state: Any) -> InputError | ResourceLimitError:
        from meshreg.io.obj import text_kernels as text

        code = int(state[text.ERROR])
        place = f"line {self._totals[text.LINES] + state[text.LINES] + 1}"
        if code == text.LONG_LINE:
            message = f"the line is longer than {LONGEST} bytes."
            return ResourceLimitError(message, file=self._path, place=place)
        word = word_at(block, int(state[text.ERROR_AT]))
        if code not in (text.FEW_NUMBERS, text.MANY_NUMBERS):
            place += f" (face {self._totals[text.FACES] + state[text.FACES] + 1})"
        message = {
            text.FEW_NUMBERS: "too few numbers: the line is cut off.",
            text.MANY_NUMBERS: "more numbers than the format has: x y z, then w or r g b.",
            text.FEW_CORNERS: "a face of fewer than three corners: the line is cut off.",
            text.BAD_INDEX: f"{word!r} cannot be read as the corner of a face.",
            text.ZERO_INDEX: f"{word!r} holds index 0; indices count from 1.",
            text.HUGE_INDEX: f"{word!r} holds an index out of range.",
            text.UNEVEN_CORNERS: f"{word!r} has not the parts (v/vt/vn) of the face's first "
            "corner: the line is cut off.",
        }[code]
        return InputError(message, file=self._path, place=place, remedy=_REPAIR)

    def joined(self, sha256: str, fingerprint: tuple[int, int]) -> Scan:
        """Return everything as one; the parts are let go of one after another."""
        from meshreg.io.obj import kernels
        from meshreg.io.obj import text_kernels as text

        totals, parts = self._totals, self._parts
        self._parts = []
        counts = {name.lower(): int(totals[getattr(text, name)]) for name in _COUNTED}
        sizes = uv = colors = None
        if totals[text.POLYGONS]:
            sizes = [_filled(part.sizes, int(part.state[text.FACES]), 3) for part in parts]
        if totals[text.WITH_UV]:
            uv = [_filled(part.uv, len(part.vertex), -1) for part in parts]
        if 0 < counts["vertices"] == counts["colored"]:
            colors = [part.colors for part in parts]
        points, uvs = [part.points for part in parts], [part.uvs for part in parts]
        vertex = [part.vertex for part in parts]
        parts.clear()
        libraries = [name for kind, _, name in self._names if kind == kernels.MTLLIB]
        return Scan(
            points=_join(points, np.empty((0, 3))),
            colors=None if colors is None else _join(colors, np.empty((0, 3), np.float32)),
            uvs=_join(uvs, np.empty((0, 2), np.float32)),
            vertex=_join(vertex, np.empty(0, np.int32)),
            uv=None if uv is None else _join(uv, np.empty(0, np.int32)),
            sizes=None if sizes is None else _join(sizes, np.empty(0, np.int32)),
            materials=[(at, name) for kind, at, name in self._names if kind == kernels.USEMTL],
            libraries=list(dict.fromkeys(libraries)),
            counts=counts,
            sha256=sha256,
            fingerprint=fingerprint,
            ends_whole=self._ends_whole,
        )


def _make_absolute(corners: Int32, base: int) -> None:
    """Turn indices that count back from a line into ones that count from the file's start."""
    from meshreg.io.obj import text_kernels as text

    back = corners < -1
    absolute = corners[back].astype(np.int64) - text.NEGATIVE + base
    # Those that count back beyond the file's start must not look like "none".
    corners[back] = np.where(absolute < 0, -2, absolute)


def _filled(values: Int32 | None, length: int, value: int) -> Int32:
    return np.full(length, value, np.int32) if values is None else values


def _join(arrays: list[Any], empty: Any) -> Any:
    """Concatenate, and let go of the parts."""
    whole = np.concatenate(arrays) if arrays else empty
    arrays.clear()
    return whole
