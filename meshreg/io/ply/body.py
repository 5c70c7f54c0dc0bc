"""The body of a PLY file: one `Table` per element, columns decoded when asked for.

Text is turned into float64 numbers first and then read like a binary body of float64; so both
kinds share everything after that. Columns of a binary file whose rows are all alike are views
into the mapped file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError
from meshreg.io.ply.header import Element, Header
from meshreg.io.ply.text import CUT, fitting, line_of, read_numbers, start_of_row
from meshreg.records import Float64, UInt8

_NO_FLOATS = np.empty(0, np.float64)
_NO_INTS = np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class Table:
    """Where the rows of one element lie.

    Attributes
    ----------
    element : Element
    data : (N,) uint8
        The file, or the numbers read from its text.
    start, end : int
        Bytes in `data`.
    order : "<" or ">"
    tokens : (N / 8,) float64
        `data` as numbers where it came from text; empty for a binary file.
    row : dtype or None
        Layout of a row when all are alike.
    values : (P,) int64
        Values of each property in all rows.
    file : Path
    where : (start, end)
        Bytes of the file that hold the rows.
    """

    element: Element
    data: UInt8
    start: int
    end: int
    order: str
    tokens: Float64
    row: np.dtype[Any] | None
    values: NDArray[np.int64]
    file: Path
    where: tuple[int, int] = (0, 0)

    @property
    def is_text(self) -> bool:
        """Whether the numbers were read from text."""
        return len(self.tokens) > 0

    def kind(self, number: int) -> str:
        """Return the numpy type, with byte order, in which a column is stored in `data`."""
        return "<f8" if self.is_text else self.order + self.element.properties[number].kind

    def column(self, number: int) -> tuple[NDArray[np.int64] | None, NDArray[Any]]:
        """Decode one column.

        Returns
        -------
        counts : (rows,) int64 or None
            Length of each row's list; None for a scalar.
        values : (sum of counts,) or (rows,)
            In the type of the file; numbers from text are float64, checked to fit that type.
        """
        item = self.element.properties[number]
        rows = self.element.count
        if self.row is not None:
            view = np.ndarray((rows,), self.row, self.data.data, self.start)
            values = view[f"v{number}"].reshape(-1)
            counts = None
            if item.count_kind:
                each = len(values) // max(rows, 1)
                counts = np.full(rows, each, np.int64)
        else:
            counts, values = self._gather(number)
        if self.is_text:
            values = fitting(values, item, self.element.name, self.file)
        return (counts if item.count_kind else None), values

    def locate(self, numbers: list[int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Find the values of some scalar columns, ascending, in the bytes of `data`.

        Returns
        -------
        starts : (rows + 1,) int64
        places : (rows, K) int64
        """
        from meshreg.io.ply.kernels import locate

        rows = self.element.count
        starts = np.empty(rows + 1, np.int64)
        places = np.empty((rows, len(numbers)), np.int64)
        layout = _layout(self.element, self.is_text)
        span = (self.start, self.end, rows)
        wanted = np.array(numbers, np.int64)
        big = self.order == ">"
        locate(self.data, self.tokens, span, layout, big, wanted, starts, places)
        return starts, places

    def _gather(self, number: int) -> tuple[NDArray[np.int64], NDArray[Any]]:
        from meshreg.io.ply.kernels import gather

        counts = np.empty(self.element.count, np.int64)
        layout = _layout(self.element, self.is_text)
        out = np.empty(int(self.values[number] * layout[number, 2]), np.uint8)
        span = (self.start, self.end, self.element.count)
        gather(self.data, self.tokens, span, layout, self.order == ">", number, out, counts)
        return counts, out.view(self.kind(number))


def read_tables(
    header: Header, data: UInt8, path: Path, wanted: tuple[str, ...]
) -> dict[str, Table]:
    """Find every element's rows, and check that the body ends where they end.

    Parameters
    ----------
    header : Header
    data : (N,) uint8
        The whole file.
    path : Path
    wanted : tuple of str
        Elements to return; the others are stepped over.

    Raises
    ------
    InputError
        A body shorter or longer than the header says, a list of negative length, or in text a
        line with the wrong number of words or a word that is no number.
    """
    here = header.size
    tables = {}
    for element in header.elements:
        start = here
        if header.order:
            table = _binary(element, data, here, header.order, path)
            here = table.end
        else:
            table, here = _text(element, data, here, path, element.name in wanted)
        tables[element.name] = replace(table, where=(start, here))
    rest = data[here:]
    # A few programs end a binary file with a line end.
    if (len(rest) > 2 and header.order) or len(bytes(rest[: 1 << 16]).strip(b" \t\r\n\x1a")):
        place = f"byte {here}" if header.order else line_of(data, here)
        raise InputError(
            f"goes on for {len(rest)} bytes after the last of its elements.",
            file=path,
            place=place,
            remedy="The counts in its header are too small; export it again.",
        )
    return {name: table for name, table in tables.items() if name in wanted}


def scalar_columns(table: Table, names: tuple[str, ...], dtype: Any = None) -> NDArray[Any]:
    """Decode several scalar columns into (rows, len(names)).

    Parameters
    ----------
    table : Table
    names : tuple of str
        All present in the element.
    dtype : dtype, optional
        Else the type that holds all the file's.

    Raises
    ------
    InputError
        One of them is a list.
    """
    columns = []
    for name in names:
        number = table.element.column(name)
        assert number is not None
        counts, values = table.column(number)
        if counts is not None:
            raise InputError(
                f"has {name!r} as a list.",
                file=table.file,
                place=f"element {table.element.name!r}",
                remedy="Export it again.",
            )
        columns.append(values)
    kind = dtype or np.result_type(*columns)
    out = np.empty((table.element.count, len(names)), kind)
    for k, column in enumerate(columns):
        out[:, k] = column
    return out


def _layout(element: Element, text: bool) -> NDArray[np.int64]:
    """Return the (P, 3) layout that the kernels take."""
    from meshreg.io.ply.kernels import COUNT_CODES, TOKEN

    rows = []
    for item in element.properties:
        if text:
            rows.append((TOKEN if item.count_kind else 0, 8, 8))
        else:
            count_size = int(item.count_kind[1]) if item.count_kind else 0
            rows.append((COUNT_CODES[item.count_kind], count_size, int(item.kind[1])))
    return np.array(rows, np.int64).reshape(-1, 3)


def _row_dtype(element: Element, order: str, text: bool, counts: list[int]) -> np.dtype[Any]:
    """Return the type of a row whose lists have the given lengths, in the lists' order."""
    fields: list[Any] = []
    left = iter(counts)
    for number, item in enumerate(element.properties):
        kind = "<f8" if text else order + item.kind
        if item.count_kind:
            fields.append((f"n{number}", "<f8" if text else order + item.count_kind))
            fields.append((f"v{number}", kind, (next(left),)))
        else:
            fields.append((f"v{number}", kind))
    return np.dtype(fields)


def _binary(element: Element, data: UInt8, start: int, order: str, path: Path) -> Table:
    table = Table(element, data, start, start, order, _NO_FLOATS, None, _NO_INTS, path)
    return _measured(table, len(data), _NO_INTS)


def _measured(table: Table, limit: int, lengths: NDArray[np.int64]) -> Table:
    """Return the table with its end, and its row's layout where all rows are alike."""
    element = table.element
    row = _alike(table, limit, lengths)
    if row is not None:
        return replace(table, end=table.start + element.count * row.itemsize, row=row)
    from meshreg.io.ply.kernels import walk

    span = (table.start, limit, element.count)
    layout = _layout(element, table.is_text)
    big = table.order == ">"
    status, at, here, values = walk(table.data, table.tokens, span, layout, big, lengths)
    if status < 0:
        raise _broken(table, int(status), int(at), int(here), limit)
    return replace(table, end=int(status), values=values)


def _alike(table: Table, limit: int, lengths: NDArray[np.int64]) -> np.dtype[Any] | None:
    """Return the row's layout if all rows have lists as long as the first row's and fit."""
    from meshreg.io.ply.kernels import walk

    element, text = table.element, table.is_text
    if element.count == 0:
        return _row_dtype(element, table.order, text, [0] * len(element.properties))
    counts: list[int] = []
    if element.has_lists:
        big = table.order == ">"
        span = (table.start, limit, 1)
        layout = _layout(element, text)
        status, _, _, values = walk(table.data, table.tokens, span, layout, big, _NO_INTS)
        if status < 0:
            return None
        counts = [int(n) for n, p in zip(values, element.properties, strict=True) if p.count_kind]
    row = _row_dtype(element, table.order, text, counts)
    if element.count * row.itemsize > limit - table.start:
        return None
    if len(lengths) and not (lengths == row.itemsize).all():
        return None
    view = np.ndarray((element.count,), row, table.data.data, table.start)
    lists = [number for number, item in enumerate(element.properties) if item.count_kind]
    same = all(
        (view[f"n{number}"] == count).all() for number, count in zip(lists, counts, strict=True)
    )
    return row if same else None


def _broken(table: Table, status: int, row: int, here: int, limit: int) -> InputError:
    from meshreg.io.ply.kernels import BAD_COUNT, CUT_OFF

    element = table.element
    if status == BAD_COUNT:
        what = f"has a list of negative or broken length in row {row + 1} of {element.name!r}"
    elif table.is_text:
        what = (
            f"has too few or too many words for row {row + 1} of element {element.name!r} "
            f"({', '.join(item.name for item in element.properties)})"
        )
    elif status == CUT_OFF:
        what = f"ends at byte {limit}, in row {row + 1} of {element.count} of {element.name!r}"
    else:
        what = f"is broken in row {row + 1} of {element.name!r}"
    place = f"{element.name} {row + 1}" if table.is_text else f"byte {here}"
    return InputError(f"{what}.", file=table.file, place=place, remedy=CUT)


def _text(element: Element, data: UInt8, start: int, path: Path, wanted: bool) -> tuple[Table, int]:
    """Step over the lines of one element, and read their numbers if it is wanted."""
    from meshreg.io.ply.kernels import count_tokens

    words = np.zeros(element.count, np.int64)
    end, found = count_tokens(data, start, element.count, words)
    if found < element.count:
        raise InputError(
            f"ends after row {found} of {element.count} of element {element.name!r}.",
            file=path,
            place=line_of(data, end),
            remedy=CUT,
        )
    tokens = _NO_FLOATS
    if wanted and element.count:
        tokens = read_numbers(data, start, end, int(words.sum()), path)
    table = Table(element, tokens.view(np.uint8), 0, 0, "<", tokens, None, _NO_INTS, path)
    if not wanted or not element.count:
        return table, end
    try:
        return _measured(table, 8 * len(tokens), 8 * words), end
    except InputError as error:
        row = int((error.place or "").split()[-1]) if error.place else 1
        error.place = line_of(data, start_of_row(data, start, row))
        raise
