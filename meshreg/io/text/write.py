"""WRITE text clouds: from memory, or a moved copy of a file that keeps all else."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import OutputError, UsageError
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.rewriting import Extent, moved_points, require_unchanged, warn
from meshreg.io.files.safe import file_bytes
from meshreg.io.frames.directions import bend_note, turn_columns
from meshreg.io.frames.mover import Mover
from meshreg.io.frames.sidecar import find_sidecar, write_shift
from meshreg.io.second_reader import ANYTHING, Expected, LineRule, require_lines
from meshreg.io.text.layout import Layout, read_layout
from meshreg.io.text.values import columns_of
from meshreg.records import Float64, Frame, PointCloud, SourceFile, Survey

_XYZ = ("x", "y", "z")
_BLOCK = 1 << 22


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a point cloud as text in absolute coordinates, with six decimals.

    CSV has commas and a header; .txt a header as a comment; .xyz blanks and no header. The CRS,
    if any, goes into a sidecar.

    Returns
    -------
    tuple of Path
        The file, then its sidecar.

    Raises
    ------
    UsageError
        The survey is not a point cloud.
    OutputError
        Not written, or not what was meant when read back.
    """
    cloud = survey.geometry
    if not isinstance(cloud, PointCloud):
        raise UsageError(f"A text file holds points, not a {type(cloud).__name__}.", file=path)
    comma = path.suffix.lower() == ".csv"
    mark = "," if comma else " "
    names = ["x", "y", "z", *(("red", "green", "blue") if cloud.colors is not None else ())]
    row = mark.join(["%.6f"] * 3 + ["%d"] * (len(names) - 3))
    extent = Extent()
    with atomic_file(path) as temporary:
        with open(temporary, "w", encoding="ascii", newline="\n") as stream:
            if path.suffix.lower() != ".xyz":
                stream.write(("" if comma else "//") + mark.join(names) + "\n")
            for start in range(0, len(cloud.points), 100_000):
                part: Any = cloud.points[start : start + 100_000] + survey.origin
                extent.add(part)
                if cloud.colors is not None:
                    part = np.hstack([part, cloud.colors[start : start + 100_000]])
                stream.write("\n".join([row] * len(part)) % tuple(part.ravel().tolist()) + "\n")
        _check(temporary, path, extent, 1e-6, read_layout(file_bytes(temporary), path))
    frame = Frame(file_crs=survey.crs, crs=survey.crs)
    return (path, *write_shift(path, frame))


def _check(written: Path, path: Path, extent: Extent, tolerance: float, layout: Layout) -> None:
    """Read the coordinates back; a guess of columns is not made anew."""
    data = file_bytes(written)
    values = columns_of(data, layout, path, [layout.where[name] for name in _XYZ])
    points = np.stack([values[layout.where[name]] for name in _XYZ], axis=1)
    extent.require_equal(points, path, tolerance)


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of a text cloud: coordinates and directions change, no other word does.

    Numbers keep at least the decimals that they had, and four (metres) or nine (degrees). A
    column called depth goes on counting downward.

    Raises
    ------
    InputError
        The source is damaged or has changed since it was read.
    OutputError
        Not written, or not what was meant when read back.
    """
    from meshreg.io.frames.crs import is_geographic

    require_unchanged(source, path)
    data = file_bytes(source.path)
    sidecar = find_sidecar(source.path, again=True)
    said = None if sidecar is None else sidecar.columns
    layout = read_layout(data, source.path, said)
    found = layout.directions
    turning = [layout.column(name) for name in found.columns]
    xyz = [layout.where[name] for name in _XYZ]
    values = columns_of(data, layout, source.path, [*xyz, *turning], lenient=True)
    points = np.stack([values[column] for column in xyz], axis=1)
    moved = moved_points(move, points)
    lost = ~np.isfinite(points).all(axis=1)
    moved[lost] = np.nan  # such rows stay word for word
    flip = layout.down and source.frame.axes[2, 2] < 0 and move.frame.axes[2, 2] > 0
    if flip:
        moved[:, 2] *= -1
    degrees = move.frame.file_crs is not None and is_geographic(move.frame.file_crs)
    names = {}
    if layout.lonlat and not degrees:
        names = {rb"\blon(g|gitude)?\b": b"x", rb"\blat(itude)?\b": b"y"}
    if layout.down and not flip and move.frame.axes[2, 2] > 0:
        names[rb"\b(water)?[ _]?(depth|down)\b"] = b"z"  # they were negative, hence heights
    replacing = {layout.where[name]: moved[:, k] for k, name in enumerate(_XYZ)}
    least = dict.fromkeys(replacing, 4)
    if degrees:
        least |= {layout.where["x"]: 9, layout.where["y"]: 9}
    named = {name: values[layout.column(name)] for name in found.columns}
    for name, column in turn_columns(found, move, points, named).items():
        down = flip and any(name == group[2] for group in found.vectors)
        replacing[layout.column(name)] = np.where(lost, np.nan, -column if down else column)
        least[layout.column(name)] = 6
    if note := bend_note(found, move):
        warn(path, note)
    extent = Extent()
    extent.add(moved)
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            stream.write(_renamed(bytes(data[: layout.start]), names))
            stream.writelines(_moved_lines(data, layout, replacing, least))
        again = read_layout(file_bytes(temporary), path, said)
        if again.columns != layout.columns or again.decimal != layout.decimal:
            raise OutputError("does not read back with the same columns.", file=path)
        _check(temporary, path, extent, 0.51e-4, replace(layout, start=again.start))
        rule = _line_rule(layout, move, flip, least)
        mark = None if layout.delimiter == " " else layout.delimiter.encode()
        require_lines(source.path, temporary, rule, path, mark)
    return (path,)


def _line_rule(layout: Layout, move: Mover, flip: bool, least: dict[int, int]) -> LineRule:
    """Return what a second reader expects of a row; headers and comments do not matter to it."""
    found = layout.directions
    xyz = [layout.where[name] for name in _XYZ]

    def rule(words: list[bytes], number: int) -> Expected | None:
        del number
        try:
            numbers = {
                column: float(words[column].replace(layout.decimal.encode(), b"."))
                for column in least
            }
        except (ValueError, IndexError):
            return ANYTHING
        old = np.array([[numbers[column] for column in xyz]])
        new = dict(zip(xyz, moved_points(move, old)[0], strict=True))
        named = {name: np.array([numbers[layout.column(name)]]) for name in found.columns}
        for name, value in turn_columns(found, move, old, named).items():
            new[layout.column(name)] = float(value[0])
        if flip:
            new[xyz[2]] *= -1
            for group in found.vectors:
                new[layout.column(group[2])] *= -1
        places = sorted(new)
        digits = np.array([0.51 * 10.0 ** -least[column] for column in places])
        values = np.array([new[column] for column in places])
        if not np.isfinite(old).all():
            values[:] = np.nan
        return Expected(places, values, digits + 2e-15 * np.abs(values))

    return rule


def _renamed(head: bytes, names: dict[bytes, bytes]) -> bytes:
    """Rename columns in the header, the last line before the rows."""
    lines = head.splitlines(keepends=True)
    for pattern, name in names.items():
        lines[-1] = re.sub(pattern, name, lines[-1], count=1, flags=re.IGNORECASE)
    return b"".join(lines)


def _moved_lines(
    data: NDArray[np.uint8], layout: Layout, replacing: dict[int, Float64], least: dict[int, int]
) -> Iterator[memoryview]:
    """Give the bytes from `layout.start` on, with the numbers of some columns replaced."""
    from meshreg.io.text.kernels import splice_rows

    columns = np.array(sorted(replacing), np.int64)
    numbers = np.stack([replacing[column] for column in columns], axis=1)
    decimals = np.array([least[column] for column in columns], np.int64)
    state = np.array([layout.start, 0], np.int64)
    mark = ord(layout.decimal)
    out = np.empty(_BLOCK, np.uint8)
    while state[0] < len(data):
        size = splice_rows(
            data, state, ord(layout.delimiter), columns, numbers, decimals, out, mark
        )
        if size == 0:
            out = np.empty(2 * len(out), np.uint8)
        yield out[:size].data
