"""Loops over the body of a PLY file: rows of differing length, and numbers in text."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.io.files.numbers_kernels import parse_number
from meshreg.jit import jit

# How the count of a list is stored; 0 is no list. TOKEN: float64, in numbers read from text.
COUNT_CODES = {"": 0, "i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6}
TOKEN = 7
CUT_OFF, BAD_COUNT, ROW_LENGTH = -1, -2, -3


@jit(nogil=True)
def _count_at(data: Any, tokens: Any, here: int, code: int, big: bool) -> Any:
    """Read a list's count; -1 for a negative one or no whole number."""
    if code == 7:
        value = tokens[here >> 3]
        return np.int64(value) if 0 <= value <= 4294967295 and value == np.floor(value) else -1
    size = 1 if code <= 2 else (2 if code <= 4 else 4)
    count = np.int64(0)
    for k in range(size):
        count = count << 8 | np.int64(data[here + (k if big else size - 1 - k)])
    if code % 2 == 1 and count >> (8 * size - 1):
        return -1
    return count


@jit(nogil=True)
def walk(data: Any, tokens: Any, span: Any, layout: Any, big: bool, lengths: Any) -> Any:
    """Walk the rows of an element whose lists may differ in length.

    Parameters
    ----------
    data : (N,) uint8
    tokens : (N / 8,) float64
        `data` seen as numbers, where it came from text; else empty.
    span : (start, end, rows)
        Bytes from which and up to which the rows lie.
    layout : (P, 3) int64
        Of each property the code of its count, the count's and the value's size in bytes.
    big : bool
        Big endian.
    lengths : (rows,) int64 or empty
        Bytes that each row must have.

    Returns
    -------
    status : int
        Where the element ends, or CUT_OFF, BAD_COUNT, ROW_LENGTH.
    row, here : int
        Where it went wrong: row and byte.
    values : (P,) int64
        Values of each property in all rows.
    """
    start, end, rows = span
    here = start
    values = np.zeros(len(layout), np.int64)
    for row in range(rows):
        begin = here
        for p in range(len(layout)):
            code, count_size, size = layout[p]
            count = 1
            if code:
                if here + count_size > end:
                    return CUT_OFF, row, here, values
                count = _count_at(data, tokens, here, code, big)
                if count < 0:
                    return BAD_COUNT, row, here, values
                here += count_size
            if count * size > end - here:
                return CUT_OFF, row, here, values
            here += count * size
            values[p] += count
        if len(lengths) and here - begin != lengths[row]:
            return ROW_LENGTH, row, begin, values
    return here, rows, here, values


@jit(nogil=True)
def gather(
    data: Any, tokens: Any, span: Any, layout: Any, big: bool, wanted: int, out: Any, counts: Any
) -> None:
    """Copy the bytes of one property into `out` and its counts into `counts`.

    `walk` must have passed over the same rows; arguments as there, and

    Parameters
    ----------
    wanted : int
        Number of the property.
    out : (values * size,) uint8
    counts : (rows,) int64
    """
    here, _, rows = span
    place = 0
    for row in range(rows):
        for p in range(len(layout)):
            code, count_size, size = layout[p]
            count = 1
            if code:
                count = _count_at(data, tokens, here, code, big)
                here += count_size
            if p == wanted:
                counts[row] = count
                for k in range(count * size):
                    out[place + k] = data[here + k]
                place += count * size
            here += count * size


@jit(nogil=True)
def locate(
    data: Any, tokens: Any, span: Any, layout: Any, big: bool, wanted: Any, starts: Any, places: Any
) -> None:
    """Find where each row starts and where its values of some scalar properties stand.

    `walk` must have passed over the same rows; arguments as there, and

    Parameters
    ----------
    wanted : (K,) int64
        Numbers of properties, ascending.
    starts : (rows + 1,) int64
        Filled with the first byte of each row; the last is where the rows end.
    places : (rows, K) int64
        Filled with the first bytes of the values.
    """
    here, _, rows = span
    for row in range(rows):
        starts[row] = here
        k = 0
        for p in range(len(layout)):
            code, count_size, size = layout[p]
            count = 1
            if code:
                count = _count_at(data, tokens, here, code, big)
                here += count_size
            if k < len(wanted) and p == wanted[k]:
                places[row, k] = here
                k += 1
            here += count * size
    starts[rows] = here


@jit(nogil=True)
def splice(
    data: Any, starts: Any, places: Any, old_sizes: Any, values: Any, new_sizes: Any, out: Any
) -> int:
    """Copy rows with some values replaced by others of the same or another size.

    Parameters
    ----------
    data : (N,) uint8
    starts, places : arrays
        As `locate` gives them, of the rows to copy.
    old_sizes, new_sizes : (K,) int64
        Bytes of each value before and after.
    values : (rows, K, 8) uint8
        The new ones, in their first bytes.
    out : (capacity,) uint8
        Large enough.

    Returns
    -------
    int
        Bytes written.
    """
    at = 0
    for row in range(len(starts) - 1):
        here = starts[row]
        for k in range(places.shape[1]):
            for byte in data[here : places[row, k]]:
                out[at] = byte
                at += 1
            for j in range(new_sizes[k]):
                out[at] = values[row, k, j]
                at += 1
            here = places[row, k] + old_sizes[k]
        for byte in data[here : starts[row + 1]]:
            out[at] = byte
            at += 1
    return at


@jit(nogil=True)
def _is_blank(byte: int) -> bool:
    return byte in (32, 9)


@jit(nogil=True)
def _is_end(byte: int) -> bool:
    return byte in (10, 13)


@jit(nogil=True)
def count_tokens(data: Any, start: int, rows: int, counts: Any) -> tuple[int, int]:
    """Count the words of the next `rows` lines that are not blank.

    Parameters
    ----------
    data : (N,) uint8
    start : int
    rows : int
    counts : (rows,) int64
        Filled with the words of each line.

    Returns
    -------
    end : int
        Just after the last of these lines.
    found : int
        Lines found; fewer than `rows` where the file ends before.
    """
    here = start
    row = 0
    while row < rows and here < len(data):
        words = 0
        inside = False
        while here < len(data):
            byte = data[here]
            here += 1
            if _is_end(byte):
                break
            blank = _is_blank(byte)
            if not blank and not inside:
                words += 1
            inside = not blank
        if words:
            counts[row] = words
            row += 1
    return here, row


@jit(nogil=True)
def parse_tokens(data: Any, span: Any, out: Any, first: int) -> tuple[int, int, int]:
    """Read the words in data[start:end] as numbers into out[first:].

    Stops at a word that `parse_number` does not settle, so that the caller can.

    Returns
    -------
    filled : int
        Numbers in `out` now, from its start.
    start, end : int
        The word that it stopped at; start is -1 when all are read.
    """
    here, end = span
    while here < end:
        byte = data[here]
        if _is_blank(byte) or _is_end(byte):
            here += 1
            continue
        begin = here
        while here < end:
            byte = data[here]
            if _is_blank(byte) or _is_end(byte):
                break
            here += 1
        value, known = parse_number(data, begin, here)
        if not known:
            return first, begin, here
        out[first] = value
        first += 1
    return first, -1, -1
