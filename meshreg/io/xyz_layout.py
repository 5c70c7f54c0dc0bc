"""What the lines of a text cloud mean: delimiter, header, columns, count, comments."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError
from meshreg.io.safe import decode_name

_HEAD = 1 << 20  # bytes looked at to understand the file
_SAMPLE = 200  # lines
_DELIMITERS = (";", "\t", ",", " ")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(e[+-]?\d+)?", re.IGNORECASE)
_SPACED_COMMAS = re.compile(r"[+-]?\d+,\d+(,\s+[+-]?\d+,\d+)+")  # "1,5, 2,5, 3,5"
_NAMES = {
    "x": ("x", "east", "easting", "e", "xcoord", "coordx", "coordinatex", "utmx", "utme"),
    "y": ("y", "north", "northing", "n", "ycoord", "coordy", "coordinatey", "utmy", "utmn"),
    "z": (
        "z",
        "up",
        "u",
        "elevation",
        "elev",
        "height",
        "altitude",
        "alt",
        "h",
        "zcoord",
        "coordz",
    ),
    "depth": ("depth", "down", "waterdepth"),
    "lon": ("lon", "long", "longitude"),
    "lat": ("lat", "latitude"),
    "r": ("r", "red", "rf", "diffusered"),
    "g": ("g", "green", "gf", "diffusegreen"),
    "b": ("b", "blue", "bf", "diffuseblue"),
    "nx": ("nx", "normalx"),
    "ny": ("ny", "normaly"),
    "nz": ("nz", "normalz"),
}
_MEANING = {name: key for key, names in _NAMES.items() for name in names}


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
    where : dict
        Column (from 0) of "x", "y", "z" and, where there are any, "r", "g", "b", "nx", "ny", "nz".
    down : bool
        The third coordinate counts downward (a column called depth).
    lonlat : bool
        x and y are called longitude and latitude.
    count : int or None
        Points announced in the first line (.pts).
    guessed : bool
        No header says which columns are colours; `colors_at` looks at the values.
    """

    start: int
    line: int
    delimiter: str
    columns: int
    where: dict[str, int] = field(default_factory=dict)
    down: bool = False
    lonlat: bool = False
    count: int | None = None
    guessed: bool = False


def read_layout(data: NDArray[np.uint8], path: Path) -> Layout:
    """Find out how a text cloud is written, from its first megabyte.

    Raises
    ------
    InputError
        Binary, UTF-16, an ESRI grid, decimal commas, fewer than three columns, or a header
        without x, y and z.
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
        return _understand(rows, offset, number, comments, count, lines, path)
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
    count: int | None,
    lines: Sequence[tuple[int, str]],
    path: Path,
) -> Layout:
    if re.match(r"ncols\s+\d+", rows[0], re.IGNORECASE):
        raise InputError(
            "is an ESRI grid.", file=path, remedy="Convert it: gdal_translate grid.asc dem.tif"
        )
    header: list[str] | None = None
    if not any(_is_number(word) for word in re.split(r"[\s,;]+", rows[0])):
        if len(rows) < 2:
            raise InputError("holds no rows of numbers.", file=path, remedy="Export it again.")
        delimiter, columns = _delimiter(rows[1:], path)
        header = split(rows[0], delimiter)
        offset, number = lines[number][0], number + 1
        rows = rows[1:]
    else:
        delimiter, columns = _delimiter(rows, path)
        words = [_names_in(comment) for comment in reversed(comments)]
        header = next((n for n in words if len(n) == columns and _has_xyz(n)), None)
    if header is None:
        where = {name: k for k, name in enumerate("xyz")}
        return Layout(offset, number, delimiter, columns, where, count=count, guessed=True)
    if len(header) != columns:
        raise InputError(
            f"has {len(header)} names in its header, but {columns} values in a row.",
            file=path,
            place=f"line {number}",
            remedy="Name every column; write numbers with a decimal point.",
        )
    meanings = [_meaning(name) for name in header]
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
    return Layout(offset, number, delimiter, columns, where, down, lonlat, count)


def _names_in(comment: str) -> list[str]:
    """Return the words of a comment that may be a header ("//X Y Z R G B", "# x, y, z")."""
    return [word for word in re.split(r"[\s,;]+", comment) if word]


def _has_xyz(names: Sequence[str]) -> bool:
    meanings = {_meaning(name) for name in names}
    return {"x", "y"} <= meanings and bool({"z", "depth"} & meanings)


def _meaning(name: str) -> str | None:
    """Return what a column's name stands for; units in brackets and punctuation do not count."""
    bare = re.sub(r"[\[(].*?[\])]", "", name).lower()
    return _MEANING.get(re.sub(r"[^a-z]", "", bare))


def split(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line without blanks and quotes around them."""
    parts = line.split() if delimiter == " " else line.split(delimiter)
    return [part.strip().strip("\"'") for part in parts]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word


def _delimiter(rows: Sequence[str], path: Path) -> tuple[str, int]:
    """Choose the delimiter that gives most rows the same number of columns, three of them numeric.

    A later row of another width is found when all are read, with its line.
    """
    fits = []
    for delimiter in _DELIMITERS if not _SPACED_COMMAS.fullmatch(rows[0]) else ():
        widths = [len(split(row, delimiter)) for row in rows]
        width = max(set(widths), key=widths.count)
        example = split(rows[widths.index(width)], delimiter)
        if sum(map(_is_number, example)) >= 3:
            fits.append((widths.count(width), delimiter, width))
    if fits:
        best = max(fits, key=lambda fit: fit[0])
        return best[1], best[2]
    for delimiter in (";", "\t", " "):
        words = [word.rstrip(",") for word in split(rows[0], delimiter)]
        if sum(bool(_DECIMAL_COMMA.fullmatch(word)) for word in words) >= 2:
            raise InputError(
                "has numbers with a decimal comma.",
                file=path,
                remedy="Export it with decimal points (check the program's language setting).",
            )
    raise InputError(
        f"has no rows of three numbers or more; the first is {rows[0][:60]!r}.",
        file=path,
        remedy="Write x y z, or a header that names the columns.",
    )
