"""Rows of numbers in a text file's bytes, as fast as they can be told apart."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.io.files.numbers_kernels import parse_number
from meshreg.jit import jit

WHITESPACE = 32  # delimiter code: any run of blanks and tabs


@jit(nogil=True)
def _line_end(data: Any, here: int) -> tuple[int, int]:
    """Return where the line at `here` ends and where the next one starts (LF, CRLF or CR)."""
    size = len(data)
    end = here
    while end < size and data[end] != 10 and data[end] != 13:
        end += 1
    after = end + 1
    if end + 1 < size and data[end] == 13 and data[end + 1] == 10:
        after = end + 2
    return end, after


@jit(nogil=True)
def _is_blank(byte: int) -> bool:
    return byte in (32, 9)


@jit(nogil=True)
def _is_data(data: Any, start: int, end: int) -> bool:
    """Whether a line is neither empty nor a comment (# or //)."""
    here = start
    while here < end and _is_blank(data[here]):
        here += 1
    if here == end or data[here] == 35:
        return False
    return not (data[here] == 47 and here + 1 < end and data[here + 1] == 47)


@jit(nogil=True)
def count_rows(data: Any, start: int) -> int:
    """Count the lines from `start` on that hold data."""
    rows = 0
    here = start
    while here < len(data):
        end, after = _line_end(data, here)
        rows += _is_data(data, here, end)
        here = after
    return rows


@jit(nogil=True)
def _field(data: Any, here: int, end: int, delimiter: int) -> tuple[int, int, int]:
    """Return start and end of the field at `here`, blanks taken off, and where the next one is."""
    while here < end and _is_blank(data[here]) and (delimiter == 32 or data[here] != delimiter):
        here += 1
    if delimiter == 32:
        stop = here
        while stop < end and not _is_blank(data[stop]):
            stop += 1
        after = stop
        while after < end and _is_blank(data[after]):
            after += 1
        return here, stop, after if after < end else end + 1
    stop = here
    while stop < end and data[stop] != delimiter:
        stop += 1
    last = stop
    while last > here and _is_blank(data[last - 1]):
        last -= 1
    return here, last, stop + 1


@jit(nogil=True)
def _is_nan(data: Any, start: int, end: int) -> bool:
    """Whether a field is empty or "nan"."""
    if start == end:
        return True
    return (
        end - start == 3
        and data[start] | 32 == 110
        and data[start + 1] | 32 == 97
        and data[start + 2] | 32 == 110
    )


@jit(nogil=True)
def parse_rows(
    data: Any, state: Any, delimiter: int, slots: Any, out: Any, unsettled: Any
) -> tuple[int, int]:
    """Read rows of fields until the end, an uneven row, or until `unsettled` is full.

    Parameters
    ----------
    data : (size,) uint8
    state : (3,) int64
        Where to start: byte, number of that line, row in `out`. Updated to where it stopped.
    delimiter : int
        44, 59 or 9; 32 is any run of blanks and tabs.
    slots : (columns,) int64
        Column of `out` for each column of the file, -1 for those that are not wanted.
    out : (rows, wanted) float64
    unsettled : (capacity, 5) int64
        Fields that Python must look at: row and column of `out`, start, end, line.

    Returns
    -------
    n_unsettled : int
    fields : int
        Fields in the uneven row at `state`, 0 if there is none.
    """
    here, line, row = state
    columns = len(slots)
    count = 0
    while here < len(data) and count + columns <= len(unsettled):
        end, after = _line_end(data, here)
        if _is_data(data, here, end):
            at, n = here, 0
            while at <= end:
                first, last, at = _field(data, at, end, delimiter)
                if n < columns and slots[n] >= 0:
                    value, known = parse_number(data, first, last)
                    if not known and not _is_nan(data, first, last):
                        unsettled[count, 0], unsettled[count, 1] = row, slots[n]
                        unsettled[count, 2], unsettled[count, 3] = first, last
                        unsettled[count, 4] = line
                        count += 1
                    out[row, slots[n]] = value if known else np.nan
                n += 1
            if n != columns:
                state[0], state[1], state[2] = here, line, row
                return count, n
            row += 1
        here = after
        line += 1
    state[0], state[1], state[2] = here, line, row
    return count, 0


@jit(nogil=True)
def _put_number(out: Any, at: int, value: float, decimals: int, mark: int) -> int:
    """Write a number with fixed decimals (fewer where 17 digits do not suffice); return the end."""
    size = abs(value)
    scaled = np.rint(size * 10.0**decimals)
    while scaled > 9e15 and decimals > 0:
        decimals -= 1
        scaled = np.rint(size * 10.0**decimals)
    digits = np.int64(scaled)
    if value < 0 and digits > 0:
        out[at] = 45
        at += 1
    width = 1
    rest = digits // 10
    while rest > 0:
        width += 1
        rest //= 10
    width = max(width, decimals + 1)
    last = at + width + (decimals > 0)
    here = last - 1
    for place in range(width):
        if place == decimals and decimals > 0:
            out[here] = mark
            here -= 1
        out[here] = 48 + digits % 10
        digits //= 10
        here -= 1
    return last


@jit(nogil=True)
def _decimals(data: Any, start: int, end: int, mark: int) -> int:
    """Count the decimals of a plain number; 0 where it has none or is in powers of ten."""
    for here in range(start, end):
        if data[here] == mark:
            for behind in range(here + 1, end):
                if not 48 <= data[behind] <= 57:
                    return 0
            return end - here - 1
    return 0


@jit(nogil=True)
def splice_rows(
    data: Any,
    state: Any,
    delimiter: int,
    columns: Any,
    numbers: Any,
    least: Any,
    out: Any,
    mark: int = 46,
) -> int:
    """Copy lines, with the fields of some columns replaced, until the end or until `out` is full.

    Parameters
    ----------
    data : (size,) uint8
    state : (2,) int64
        Where to start: byte, row of `numbers`. Updated to where it stopped.
    delimiter : int
        As for `parse_rows`, which has found every row to be of the same width.
    columns : (K,) int64
        Ascending.
    numbers : (rows, K) float64
        What is not finite leaves its field as it is.
    least : (K,) int64
        Decimals to write; more where the field had more.
    out : (capacity,) uint8
    mark : int
        Code of the decimal point, or comma.

    Returns
    -------
    int
        Bytes written; 0 if `out` is too small for one line.
    """
    here, row = state
    at = 0
    while here < len(data):
        end, after = _line_end(data, here)
        if at + (after - here) + 40 * len(columns) > len(out):
            break
        copied = here
        if _is_data(data, here, end):
            field, column, k = here, 0, 0
            while k < len(columns):
                first, last, field = _field(data, field, end, delimiter)
                if column == columns[k]:
                    value = numbers[row, k]
                    if np.isfinite(value):
                        for byte in data[copied:first]:
                            out[at] = byte
                            at += 1
                        digits = min(max(least[k], _decimals(data, first, last, mark)), 15)
                        at = _put_number(out, at, value, digits, mark)
                        copied = last
                    k += 1
                column += 1
            row += 1
        for byte in data[copied : min(after, len(data))]:
            out[at] = byte
            at += 1
        here = after
    state[0], state[1] = here, row
    return at
