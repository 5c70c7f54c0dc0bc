"""Rows of numbers in a text file's bytes, as fast as they can be told apart."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.io.numbers_kernels import parse_number
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
    return byte == 32 or byte == 9


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
    while here < end and _is_blank(data[here]) and data[here] != delimiter:
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
