"""A second, plain reader for each format: looks at samples of what was written.

The readers and writers of a format share code, so that what both get wrong would pass a check by
them. Here old and new file are taken apart by other means (words of lines, `struct`, `json`), and
the new numbers are compared with the moved old ones at the beginning, in the middle and at the end.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from meshreg.errors import OutputError
from meshreg.io.files.safe import open_regular
from meshreg.records import Float64

_BLOCK = 1 << 24
SLACK = 1e-7  # [m]; coordinates of 1e7 m are rounded by 2e-9 at each step
_BOM = b"\xef\xbb\xbf"
_LONGEST = 1 << 16  # bytes of a line, on average
_LINES = 100  # looked at in each place
_ROWS = 100


@dataclass(frozen=True, eq=False)
class Expected:
    """What a line or row should have: `values` (K,) in its words `places`, to within `tolerance`.

    Where a value is not finite the line must be as it was.
    """

    places: Sequence[int]
    values: Float64
    tolerance: float | Float64


ANYTHING = Expected((), np.zeros(0), np.inf)
LineRule = Callable[[list[bytes], int], Expected | None]


def require_lines(
    old: Path, new: Path, rule: LineRule, path: Path, delimiter: bytes | None = None
) -> None:
    """Compare lines of two text files: the words that `rule` names, and that no other differs.

    Parameters
    ----------
    old, new : Path
    rule : function
        From the words of an old line and its number (from 0) to what is expected of the new one:
        None where the line stays as it is, `ANYTHING` where it does not matter.
    path : Path
        For messages.
    delimiter : bytes, optional
        Else any run of blanks.

    Raises
    ------
    OutputError
    """
    count = _count_lines(old)
    if count < old.stat().st_size / _LONGEST:
        return  # lines that end with CR alone, which are not told apart here
    if _count_lines(new) != count:
        raise _differs(path, "the number of lines")
    wanted = sorted({*range(_LINES), *_middle(count), *range(count - _LINES, count)})
    wanted = [number for number in wanted if 0 <= number < count]
    joined = False  # by a backslash at the end of the line before
    for number, before, after in zip(wanted, _lines(old, wanted), _lines(new, wanted), strict=True):
        if not joined and not _line_agrees(before, after, rule, number, delimiter):
            raise _differs(path, f"line {number + 1}")
        joined = before.rstrip().endswith(b"\\")


def _middle(count: int) -> range:
    return range(count // 2 - _LINES // 2, count // 2 + _LINES // 2)


def _line_agrees(
    before: bytes, after: bytes, rule: LineRule, number: int, delimiter: bytes | None
) -> bool:
    before, after = before.removeprefix(_BOM), after.removeprefix(_BOM)
    a, b = before.split(delimiter), after.split(delimiter)
    if before.rstrip().endswith(b"\\") or b"\r" in before.rstrip(b"\r\n"):
        return True
    expected = rule([word.strip() for word in a], number)
    if expected is ANYTHING:
        return True
    if expected is None or not np.isfinite(expected.values).all():
        return [word.strip() for word in a] == [word.strip() for word in b]
    if len(a) != len(b):
        return False
    found = [float(b[place].replace(b",", b".")) for place in expected.places]
    close = np.abs(np.array(found) - expected.values) <= expected.tolerance
    same = all(
        one.strip() == two.strip()
        for k, (one, two) in enumerate(zip(a, b, strict=True))
        if k not in expected.places
    )
    return bool(same and close.all())


def _count_lines(path: Path) -> int:
    with open_regular(path) as stream:
        count, last = 0, b"\n"
        while block := stream.read(_BLOCK):
            count += block.count(b"\n")
            last = block[-1:]
    return count + (last != b"\n")


def _lines(path: Path, wanted: Sequence[int]) -> Iterator[bytes]:
    """Give the lines of these numbers, which ascend, without holding the others."""
    here = iter(wanted)
    target = next(here, None)
    with open_regular(path) as stream:
        number = 0
        while target is not None:
            start = stream.tell()
            block = stream.read(_BLOCK)
            if not block:
                return
            passed = block.count(b"\n")
            if number + passed < target:
                number += passed
                continue
            at = 0
            for _ in range(target - number):
                at = block.index(b"\n", at) + 1
            stream.seek(start + at)
            number = target
            while target is not None and target == number:
                yield stream.readline()
                number += 1
                target = next(here, None)


def require_rows(
    old: BinaryIO,
    new: BinaryIO,
    rows: int,
    forms: tuple[struct.Struct, struct.Struct],
    starts: tuple[int, int],
    rule: Callable[[tuple[Any, ...]], Expected],
    path: Path,
) -> None:
    """Compare rows of a fixed size in two binary files, as `require_lines` does lines.

    Parameters
    ----------
    old, new : binary streams
    rows : int
    forms : two of Struct
        Of an old and of a new row.
    starts : two of int
        First bytes of the rows.
    rule : function
        From the values of an old row to what is expected of the new one.
    path : Path
        For messages.
    """
    wanted = {*range(_ROWS), *_middle(rows), *range(rows - _ROWS, rows)}
    for number in sorted(row for row in wanted if 0 <= row < rows):
        found = []
        for stream, form, start in zip((old, new), forms, starts, strict=True):
            stream.seek(start + number * form.size)
            raw = stream.read(form.size)
            if len(raw) < form.size:
                raise _differs(path, f"row {number + 1}")
            found.append(form.unpack(raw))
        before, after = found
        expected = rule(before)
        changed = set(expected.places)
        finite = np.isfinite(expected.values)
        values = np.array([after[place] for place in expected.places], float)
        close = (np.abs(values - expected.values) <= expected.tolerance)[finite]
        same = all(
            repr(one) == repr(two)  # NaN too
            for k, (one, two) in enumerate(zip(before, after, strict=True))
            if k not in changed
        )
        if not (same and close.all()):
            raise _differs(path, f"row {number + 1}")


def _differs(path: Path, what: str) -> OutputError:
    return OutputError(
        f"does not read back as written by a second reader: {what} differs.",
        file=path,
        remedy="Check the disk and run again; if it stays so, it is a bug to report.",
    )


def require_glb(old: Path, new: Path, matrix: Float64, path: Path) -> None:
    """Compare corners of the primitives of two .glb or .gltf files, by their own bounds.

    Each POSITION accessor states its least and greatest values; their corners, taken through
    the nodes of the old file and `matrix` (4, 4), are those of the new one.

    Raises
    ------
    OutputError
    """
    before, after = (_corners(_gltf_tree(each)) for each in (old, new))
    expected = before @ matrix[:3, :3].T + matrix[:3, 3]
    size = 1 + float(np.abs(expected).max(initial=0)) + float(np.abs(before).max(initial=0))
    if before.shape != after.shape or np.abs(after - expected).max(initial=0) > 1e-9 * size:
        raise _differs(path, "a node")


def _gltf_tree(path: Path) -> Any:
    with open_regular(path) as stream:
        head = stream.read(20)
        if head[:4] == b"glTF":
            return json.loads(stream.read(struct.unpack_from("<I", head, 12)[0]))
        stream.seek(0)
        return json.loads(stream.read().decode("utf-8-sig"))


def _corners(tree: Any) -> Float64:
    """Return two opposite corners of each primitive of the scene, in the file's coordinates."""
    nodes = tree.get("nodes", [])
    found: list[Float64] = []
    scenes = tree.get("scenes") or [{"nodes": _roots(nodes)}]
    waiting = [(root, np.eye(4)) for root in scenes[tree.get("scene", 0)].get("nodes", [])]
    while waiting:
        number, above = waiting.pop()
        node = nodes[number]
        here = above @ _node_matrix(node)
        waiting += [(child, here) for child in node.get("children", [])]
        primitives = tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []
        for primitive in primitives:
            number = primitive.get("attributes", {}).get("POSITION")
            accessor = {} if number is None else tree["accessors"][number]
            ends = [accessor.get(key) for key in ("min", "max")]
            if all(map(_is_point, ends)) and not accessor.get("normalized"):
                found.append(np.array(ends, float) @ here[:3, :3].T + here[:3, 3])
    return np.concatenate(found) if found else np.zeros((0, 3))


def _is_point(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(type(item) in (int, float) and abs(item) < 1e30 for item in value)
    )


def _roots(nodes: Any) -> list[int]:
    below = {child for node in nodes for child in node.get("children", [])}
    return [number for number in range(len(nodes)) if number not in below]


def _node_matrix(node: Any) -> Float64:
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T.astype(float)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), float)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


_PLY_CODES = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h",
    "ushort": "H", "uint16": "H", "int": "i", "int32": "i", "uint": "I", "uint32": "I",
    "float": "f", "float32": "f", "double": "d", "float64": "d", "int64": "q", "uint64": "Q",
}  # fmt: skip


@dataclass(frozen=True)
class PlyRows:
    """Where the vertices of a PLY file stand: first byte or line, count, names, codes."""

    order: str
    start: int
    count: int
    names: tuple[str, ...]
    codes: str


def ply_rows(path: Path) -> PlyRows | None:
    """Find the vertices from the header; None where lists stand in or before them."""
    with open_regular(path) as stream:
        lines: list[str] = []
        while not lines or lines[-1].split()[:1] != ["end_header"]:
            line = stream.readline(1 << 16)
            if not line:
                return None  # lines that end with CR alone
            lines.append(line.decode("latin-1"))
        start = stream.tell()
    words = [line.split() for line in lines]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(
        next(word[1] for word in words if word[:1] == ["format"]), ""
    )
    at = start if order else len(lines)
    for number, word in enumerate(words):
        if word[:1] != ["element"]:
            continue
        count, names, codes = int(word[2]), [], order
        for item in words[number + 1 :]:
            if item[:1] == ["element"]:
                break
            if item[:1] == ["property"]:
                if item[1] == "list":
                    return None
                names.append(item[2])
                codes += _PLY_CODES[item[1]]
        if word[1] == "vertex":
            return PlyRows(order, at, count, tuple(names), codes)
        at += count * struct.calcsize(codes) if order else count
    return None


def require_ply(
    old: Path,
    new: Path,
    moved: Callable[[dict[str, float]], dict[str, float]],
    path: Path,
    slack: float = 0.0,
) -> None:
    """Compare vertices of two PLY files, where no list is in their way.

    Parameters
    ----------
    old, new : Path
    moved : function
        From the values of an old vertex by name to those that change.
    path : Path
        For messages.
    slack : float
        By how much rounding on the way may differ between one point and many.

    Raises
    ------
    OutputError
    """
    one, two = ply_rows(old), ply_rows(new)
    if one is None or two is None:
        return
    if one.names != two.names or one.count != two.count or one.order != two.order:
        raise _differs(path, "the header")

    def expected(values: Sequence[float]) -> Expected:
        new_values = moved(dict(zip(one.names, values, strict=True)))
        places = [one.names.index(name) for name in new_values]
        numbers = np.array([new_values[name] for name in new_values], float)
        kinds = [two.codes.lstrip("<>")[place] for place in places]
        steps = [{"f": 1e-7, "d": 1e-14}.get(kind, 0.0) for kind in kinds]
        whole = [0.51 * (kind not in "fd") for kind in kinds]
        return Expected(places, numbers, np.abs(numbers) * steps + np.array(whole) + slack + 1e-38)

    def rule(words: list[bytes], number: int) -> Expected | None:
        if not one.start <= number < one.start + one.count:
            return ANYTHING  # a blank line may have pushed the last ones here
        return expected([float(word) for word in words]) if words else None

    if not one.order:
        require_lines(old, new, rule, path)
        return
    forms = struct.Struct(one.codes), struct.Struct(two.codes)
    with open_regular(old) as before, open_regular(new) as after:
        starts = (one.start, two.start)
        require_rows(before, after, one.count, forms, starts, expected, path)


def require_las(
    old: Path, new: Path, moved: Callable[[Float64], Float64], lost: int, path: Path
) -> None:
    """Compare the coordinates of two LAS files that are not compressed (ASPRS LAS 1.4 R15, 2.4).

    Parameters
    ----------
    old, new : Path
    moved : function
        What becomes of points (N, 3).
    lost : int
        What stands for a coordinate that there is not.
    path : Path
        For messages.

    Raises
    ------
    OutputError
    """
    heads = []
    for each in (old, new):
        with open_regular(each) as stream:
            head = stream.read(375).ljust(375, b"\0")
        start, form, record, count = struct.unpack_from("<I4xBHI", head, 96)
        if head[25] >= 4:
            (count,) = struct.unpack_from("<Q", head, 247)
        steps, offset = np.array(struct.unpack_from("<6d", head, 131)).reshape(2, 3)
        heads.append((start, form, record, count, steps, offset))
    one, two = heads
    if one[1:4] != two[1:4]:
        raise _differs(path, "the header")
    rest = f"{one[2] - 12}x"

    def rule(values: tuple[int, ...]) -> Expected:
        if lost in values:
            return Expected((0, 1, 2), np.full(3, float(lost)), 0.0)
        point = moved(np.array([values]) * one[4] + one[5])[0]
        return Expected((0, 1, 2), (point - two[5]) / two[4], 0.51)

    form = struct.Struct("<iii" + rest)
    with open_regular(old) as before, open_regular(new) as after:
        require_rows(before, after, one[3], (form, form), (one[0], two[0]), rule, path)
