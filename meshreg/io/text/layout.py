"""What the lines of a text cloud mean: delimiter, header, columns, count, comments."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError
from meshreg.io.files.safe import decode_name
from meshreg.io.frames.directions import Directions, find_directions
from meshreg.io.text.columns import guess_names, meaning, sample_rows, split

_HEAD = 1 << 20  # bytes looked at to understand the file
_SAMPLE = 200  # lines
_DELIMITERS = (";", "\t", ",", " ")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(e[+-]?\d+)?", re.IGNORECASE)
_SPACED_COMMAS = re.compile(r"[+-]?\d+,\d+(,\s+[+-]?\d+,\d+)+")  # "1,5, 2,5, 3,5"
_POINT = re.compile(r"[+-]?\d*\.\d*(e[+-]?\d+)?", re.IGNORECASE)


@dataclass(frozen=True)
class Layout:
    """How to read the rows.

    Attributes
    ----------
    start, line : int
        Byte and number (from 1) of the first line that may hold data.
    delimiter : str
        "," ";" tab, or " " for any run of blanks.
    columns : int
    names : tuple of str
        Of all columns: the header's, those said by the user, or guessed ones.
    where : dict
        Column (from 0) of "x", "y", "z" and, where there are any, "r", "g", "b", "classification".
    decimal : str
        "." or ",", which stands in numbers.
    down : bool
        The third coordinate counts downward (a column called depth).
    lonlat : bool
        x and y are called longitude and latitude.
    count : int or None
        Points announced in the first line (.pts).
    guessed : bool
        No header names the columns; they are known by their values.
    """

    start: int
    line: int
    delimiter: str
    columns: int
    names: tuple[str, ...] = ()
    where: dict[str, int] = field(default_factory=dict)
    decimal: str = "."
    down: bool = False
    lonlat: bool = False
    count: int | None = None
    guessed: bool = False

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user must know of how the file was understood."""
        notes = []
        if self.guessed and self.columns > 3:
            notes.append(
                f"Columns: {' '.join(self.names)} (guessed; a header line, or columns = [...] in "
                "a .survey.toml, says otherwise)."
            )
        if self.decimal == ",":
            notes.append("Numbers have decimal commas.")
        return tuple(notes)

    @property
    def directions(self) -> Directions:
        """The columns that turn with the survey; their names are made different by a number."""
        coordinates = {self.names[k] for key, k in self.where.items() if len(key) == 1}
        return find_directions(self.names, coordinates)

    def column(self, name: str) -> int:
        """Return the number of the first column of that name."""
        return self.names.index(name)


def read_layout(
    data: NDArray[np.uint8], path: Path, columns: Sequence[str] | None = None
) -> Layout:
    """Find out how a text cloud is written, from its first megabyte and a sample of the rest.

    Parameters
    ----------
    data : (size,) uint8
    path : Path
    columns : sequence of str, optional
        Names of the columns, which go before a header's.

    Raises
    ------
    InputError
        Binary, UTF-16, an ESRI grid, commas that both separate and are decimal, fewer than three
        columns, or names without x, y and z.
    """
    head = bytes(data[:_HEAD])
    _refuse_binary(data, head, path)
    start = 3 if head.startswith(b"\xef\xbb\xbf") else 0
    lines = _lines(head, start, len(data) > _HEAD)
    comments: list[str] = []
    count = None
    for number, (offset, text) in enumerate(lines, 1):
        stripped = text.strip()
        if not stripped:
            continue
        if stripped.startswith(("#", "//")):
            comments.append(stripped.lstrip("#/ "))
            continue
        if count is None and stripped.isdigit() and number < len(lines):
            count = int(stripped)
            continue
        rows = [line.strip() for _, line in lines[number - 1 :]][:_SAMPLE]
        rows = [row for row in rows if row and not row.startswith(("#", "//"))]
        layout, header = _understand(rows, offset, number, comments, lines, path)
        return _named(replace(layout, count=count), columns or header, data, path)
    raise InputError("holds no rows of numbers.", file=path, remedy="Export it again.")


def _refuse_binary(data: NDArray[np.uint8], head: bytes, path: Path) -> None:
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError("is UTF-16.", file=path, remedy="Save it as UTF-8.")
    for start in range(0, len(data), 1 << 24):
        zeros = np.flatnonzero(data[start : start + (1 << 24)] == 0)
        if len(zeros):
            raise InputError(
                "holds NUL bytes; it is damaged or not text.",
                file=path,
                place=f"byte {start + int(zeros[0])}",
                remedy="Export it again.",
            )


def _lines(head: bytes, start: int, cut: bool) -> list[tuple[int, str]]:
    """Return offset and text of the lines in the first bytes, without one that is cut off."""
    lines = []
    for match in re.finditer(rb"([^\r\n]*)(\r\n|\n|\r|$)", head[start:]):
        if match.end() > match.start() and not (cut and match[2] == b""):
            lines.append((start + match.start(), decode_name(match[1])))
    return lines


def _understand(
    rows: Sequence[str],
    offset: int,
    number: int,
    comments: Sequence[str],
    lines: Sequence[tuple[int, str]],
    path: Path,
) -> tuple[Layout, Sequence[str] | None]:
    """Return where the rows start and how they are cut, and the header's names if any."""
    if re.match(r"ncols\s+\d+", rows[0], re.IGNORECASE):
        raise InputError(
            "is an ESRI grid.", file=path, remedy="Convert it: gdal_translate grid.asc dem.tif"
        )
    if any(_is_number(word) for word in re.split(r"[\s,;]+", rows[0])):
        delimiter, columns, decimal = _delimiter(rows, path)
        words = [_names_in(comment) for comment in reversed(comments)]
        header = next((n for n in words if len(n) == columns and _has_xyz(n)), None)
        return Layout(offset, number, delimiter, columns, decimal=decimal), header
    if len(rows) < 2:
        raise InputError("holds no rows of numbers.", file=path, remedy="Export it again.")
    delimiter, columns, decimal = _delimiter(rows[1:], path)
    layout = Layout(lines[number][0], number + 1, delimiter, columns, decimal=decimal)
    return layout, split(rows[0], delimiter)


def _named(
    layout: Layout, header: Sequence[str] | None, data: NDArray[np.uint8], path: Path
) -> Layout:
    """Return the layout with names and meanings of its columns."""
    if header is None:
        rows = sample_rows(data, layout.start, layout.delimiter)
        if layout.decimal == ",":
            rows = [[word.replace(",", ".") for word in row] for row in rows]
        names = guess_names(rows, layout.columns, intensity=path.suffix.lower() == ".pts")
        where = {key: k for k, name in enumerate(names) if (key := meaning(name))}
        return replace(layout, names=tuple(names), where=where, guessed=True)
    if len(header) != layout.columns:
        raise InputError(
            f"has {len(header)} names in its header, but {layout.columns} values in a row.",
            file=path,
            place=f"line {layout.line}",
            remedy="Name every column; write numbers with a decimal point.",
        )
    meanings = [meaning(name) for name in header]
    where = {key: meanings.index(key) for key in dict.fromkeys(meanings) if key}
    lonlat = not {"x", "y"} <= where.keys() and {"lon", "lat"} <= where.keys()
    down = "z" not in where and "depth" in where
    for name, other, use in (("x", "lon", lonlat), ("y", "lat", lonlat), ("z", "depth", down)):
        if use:
            where[name] = where[other]
    if not {"x", "y", "z"} <= where.keys():
        raise InputError(
            f"has no columns x, y and z among {', '.join(map(repr, header))}.",
            file=path,
            place="header",
            remedy="Name them x, y, z (or easting, northing, elevation or depth).",
        )
    for unused in ("lon", "lat", "depth"):
        where.pop(unused, None)
    return replace(layout, names=tuple(header), where=where, down=down, lonlat=lonlat)


def _names_in(comment: str) -> list[str]:
    """Return the words of a comment that may be a header ("//X Y Z R G B", "# x, y, z")."""
    return [word for word in re.split(r"[\s,;]+", comment) if word]


def _has_xyz(names: Sequence[str]) -> bool:
    meanings = {meaning(name) for name in names}
    return {"x", "y"} <= meanings and bool({"z", "depth"} & meanings)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word


def _delimiter(rows: Sequence[str], path: Path) -> tuple[str, int, str]:
    """Choose the delimiter that gives most rows the same number of columns, three of them numeric.

    A later row of another width is found when all are read, with its line. Returns delimiter,
    number of columns, and what stands in numbers as the decimal point.
    """
    fits: list[tuple[tuple[int, bool], tuple[str, int, str]]] = []
    for delimiter in _DELIMITERS if not _SPACED_COMMAS.fullmatch(rows[0]) else ():
        words = [split(row, delimiter) for row in rows]
        widths = [len(row) for row in words]
        width = max(set(widths), key=widths.count)
        example = words[widths.index(width)]
        every = [word for row in words for word in row]
        commas = any(map(_DECIMAL_COMMA.fullmatch, every)) and not any(map(_POINT.fullmatch, every))
        for decimal in (".", ",") if commas and delimiter != "," else (".",):
            if sum(_is_number(word.replace(decimal, ".")) for word in example) >= 3:
                fits.append(((widths.count(width), decimal == ","), (delimiter, width, decimal)))
    if fits:
        return max(fits, key=lambda fit: fit[0])[1]
    if _SPACED_COMMAS.fullmatch(rows[0]):
        raise InputError(
            "has numbers with a decimal comma, and commas between them.",
            file=path,
            remedy="Export it with decimal points (check the program's language setting).",
        )
    raise InputError(
        f"has no rows of three numbers or more; the first is {rows[0][:60]!r}.",
        file=path,
        remedy="Write x y z, or a header that names the columns.",
    )
