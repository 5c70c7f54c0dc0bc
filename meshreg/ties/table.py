"""`ties.csv`: one line a pair, plain CSV, written whole or not at all.

Columns: id, name, reference_east, reference_north, moving_east, moving_north [m], crs. A point
that is not picked yet is empty; an empty crs is a local frame.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from meshreg.errors import InputError, UsageError
from meshreg.io.files.atomic import as_output_error, atomic_file
from meshreg.io.files.safe import open_regular
from meshreg.ties.records import MAX_NAME, MAX_PAIRS, Point, TiePair, TiePoints

COLUMNS = (
    "id",
    "name",
    "reference_east",
    "reference_north",
    "moving_east",
    "moving_north",
    "crs",
)
MAX_BYTES = 16_000_000
MAX_LINES = 100_000  # far more than pairs: cameras may stand before the markers
_EXPORT = "Save it as comma-separated text in UTF-8."
IsHeader = Callable[[Sequence[str]], bool]
Row = tuple[int, Mapping[str, str]]  # line of the file, and its values by column


def write_ties(ties: TiePoints, path: str | Path) -> None:
    """Write the pairs as CSV; a tenth of a millimetre is kept.

    Raises
    ------
    OutputError
        It could not be written; what was there before is intact.
    """
    path = Path(path)
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for pair in ties.pairs:
        points = [*_numbers(pair.reference), *_numbers(pair.moving)]
        writer.writerow([pair.id, pair.name, *points, ties.crs or ""])
    with as_output_error(path), atomic_file(path) as temporary:
        if path.exists():  # the file keeps its permissions
            os.chmod(temporary, path.stat().st_mode & 0o777)
        temporary.write_bytes(out.getvalue().encode("utf-8"))


def _numbers(point: Point | None) -> tuple[str, str]:
    return ("", "") if point is None else (f"{point[0]:.4f}", f"{point[1]:.4f}")


def read_ties(path: str | Path) -> TiePoints:
    """Read `ties.csv`.

    Raises
    ------
    InputError
        Not that table, or a line that cannot be meant, with its number.
    """
    path = Path(path)
    header, rows = read_table(path, is_ours)
    if not header:
        raise InputError(
            f"has no line of column names ({', '.join(COLUMNS[2:6])}).",
            file=path,
            remedy="Make it by `meshreg pick`.",
        )
    return ties_from_rows(path, rows)


def is_ours(names: Sequence[str]) -> bool:
    """Whether a line's names are the columns of our own table."""
    return set(COLUMNS[2:6]) <= set(names)


def ties_from_rows(path: Path, rows: Sequence[Row]) -> TiePoints:
    """Turn the lines of our own table into pairs."""
    systems = {row.get("crs", "").strip() for _, row in rows}
    if len(systems) > 1:
        raise InputError(f"names several CRS: {', '.join(sorted(systems))}.", file=path)
    pairs: list[TiePair] = []
    used: set[int] = set()
    for line, row in rows:
        number = _id(path, line, row.get("id", ""), max(used, default=0) + 1)
        if number in used:
            raise InputError(f"has the id {number} twice.", file=path, place=f"line {line}")
        used.add(number)
        points = [_point(path, line, row, which) for which in ("reference", "moving")]
        pairs.append(TiePair(number, row.get("name", "").strip()[:MAX_NAME], *points))
    try:
        return TiePoints(tuple(pairs), next(iter(systems), "") or None)
    except UsageError as error:  # a record refused at birth; here the file is to blame
        raise InputError(error.message, file=path) from error


def _id(path: Path, line: int, text: str, default: int) -> int:
    if not text.strip():
        return default
    try:
        number = int(text)
    except ValueError:
        number = 0
    if not 0 < number < 1_000_000_000:
        raise InputError(f"has the id {text!r}; it is a whole number from 1.", file=path,
                         place=f"line {line}")  # fmt: skip
    return number


def _point(path: Path, line: int, row: Mapping[str, str], which: str) -> Point | None:
    texts = [row.get(f"{which}_{axis}", "").strip() for axis in ("east", "north")]
    if not any(texts):
        return None
    east, north = (number(path, line, text, f"{which} point") for text in texts)
    return east, north


def number(path: Path, line: int, text: str, what: str) -> float:
    """Read one coordinate, or say where it is none; the decimal sign may be a comma."""
    plain = text.strip()
    if plain.count(",") == 1 and "." not in plain:  # spreadsheets of half of Europe
        plain = plain.replace(",", ".")
    try:
        value = float(plain)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e9:
        raise InputError(
            f"has {text!r} in its {what}; that is not a coordinate.",
            file=path,
            place=f"line {line}",
        )
    return value


def read_table(path: Path, is_header: IsHeader) -> tuple[tuple[str, ...], list[Row]]:
    """Read a delimited text file: column names in lower case, and its lines with their numbers.

    Parameters
    ----------
    path : Path
    is_header : callable
        Whether a line's names are the columns that are looked for. It is tried with comma,
        semicolon, tab and space as the delimiter; what stands before the header, empty lines and
        comments (`#`) are skipped. A comment that starts with the header's own first column is
        the head of another table in the same file, which is passed over.

    Returns
    -------
    tuple of str
        The column names; empty where no line is such a header.
    list of (int, mapping)

    Raises
    ------
    InputError
        Too large, no text, or a line of more values than columns.
    """
    lines = read_text(path).splitlines()
    if len(lines) > MAX_LINES:
        raise InputError(f"has {len(lines)} lines; {MAX_LINES} are the limit.", file=path)
    for delimiter in ",;\t ":
        header, rows = _parsed(path, lines, delimiter, is_header)
        if header:
            if len(rows) > MAX_PAIRS:
                raise InputError(f"has {len(rows)} lines; {MAX_PAIRS} are the limit.", file=path)
            return header, rows
    return (), []


def read_text(path: Path, limit: int = MAX_BYTES) -> str:
    """Return a text file of points, if it has no more than `limit` bytes."""
    with open_regular(path) as stream:
        data = stream.read(limit + 1)
    if len(data) > limit:
        raise InputError(f"is larger than {limit} bytes; no table of points is.", file=path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"is not UTF-8 text ({error.reason}).", file=path, remedy=_EXPORT
        ) from error


def _parsed(
    path: Path, lines: Sequence[str], delimiter: str, is_header: IsHeader
) -> tuple[tuple[str, ...], list[Row]]:
    header: tuple[str, ...] = ()
    rows: list[Row] = []
    other = False
    for line, text in enumerate(lines, 1):
        if not text.strip():
            continue
        comment = text.lstrip().startswith("#")
        if comment or not header:
            cells = _cells(path, line, text.lstrip("# "), delimiter)
            names = tuple(name.strip().lower() for name in cells)
            if is_header(names):
                # Metashape writes cameras first, then markers, then scale bars
                header, rows, other = names, [], False
            elif header and names[:1] == header[:1]:
                other = True
            continue
        if other:
            continue
        cells = _cells(path, line, text, delimiter)
        if len(cells) > len(header) and any(cells[len(header) :]):
            raise InputError(
                f"has {len(cells)} values for {len(header)} columns.",
                file=path,
                place=f"line {line}",
            )
        values = [*cells, *[""] * (len(header) - len(cells))]
        rows.append((line, dict(zip(header, values, strict=False))))
    return header, rows


def _cells(path: Path, line: int, text: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader([text], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error as error:  # a value of more than 131,072 characters
        raise InputError(f"cannot be read: {error}.", file=path, place=f"line {line}") from error
