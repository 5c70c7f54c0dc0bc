"""Loops that write Wavefront OBJ: lines from arrays, and moved copies of blocks of lines."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.io.obj.text_kernels import is_blank, is_end, read_number, skip_blanks, skip_line
from meshreg.jit import jit

MAX_NUMBER = 24  # bytes that `_put_fixed` writes at most
_LARGEST = 9e15  # every whole number up to here is a float64
_TEN = 10.0 ** np.arange(20)
_SPACE, _NEWLINE, _SLASH, _POINT, _MINUS, _ZERO = 32, 10, 47, 46, 45, 48


@jit(nogil=True)
def _put_whole(value: Any, least: int, out: Any, at: int) -> int:
    """Write a whole number >= 0 with at least so many digits; return the place behind it."""
    n = 1
    rest = value // 10
    while rest > 0:
        rest //= 10
        n += 1
    n = max(n, least)
    for k in range(n):
        out[at + n - 1 - k] = _ZERO + value % 10
        value //= 10
    return at + n


@jit(nogil=True)
def _put_fixed(value: float, decimals: int, out: Any, at: int) -> int:
    """Write a number in fixed notation; fewer decimals where float64 has no more digits."""
    size = abs(value)
    while decimals > 0 and size * _TEN[decimals] >= _LARGEST:
        decimals -= 1
    whole = np.int64(np.rint(size * _TEN[decimals]))
    if value < 0 and whole > 0:
        out[at] = _MINUS
        at += 1
    unit = np.int64(_TEN[decimals])
    at = _put_whole(whole // unit, 1, out, at)
    if decimals > 0:
        out[at] = _POINT
        at = _put_whole(whole % unit, decimals, out, at + 1)
    return at


@jit(nogil=True)
def put_rows(word: Any, rows: Any, decimals: int, more: Any, out: Any) -> int:
    """Write one line a row: `word`, the numbers, and those of `more` with four decimals.

    Parameters
    ----------
    word : (K,) uint8
    rows : (N, M) float64
        All below 9e15.
    decimals : int
        At most 15.
    more : (N or 0, L) float64
    out : (N * (K + 1 + (M + L) * (MAX_NUMBER + 1)) or more,) uint8

    Returns
    -------
    int
        Bytes written.
    """
    at = 0
    for row in range(len(rows)):
        for byte in word:
            out[at] = byte
            at += 1
        for k in range(rows.shape[1]):
            out[at] = _SPACE
            at = _put_fixed(rows[row, k], decimals, out, at + 1)
        if len(more):
            for k in range(more.shape[1]):
                out[at] = _SPACE
                at = _put_fixed(more[row, k], 4, out, at + 1)
        out[at] = _NEWLINE
        at += 1
    return at


@jit(nogil=True)
def put_faces(
    faces: Any, uv: Any, pages: Any, before: int, names: Any, starts: Any, out: Any
) -> int:
    """Write `f` lines, with a `usemtl` line wherever the page changes.

    Parameters
    ----------
    faces : (F, 3) int32
    uv : (F or 0, 3) int32
        Numbers of the texture coordinates from 0; -1 for faces without.
    pages : (F or 0,) int32
    before : int
        Page of the face before the first; below -1 if there is none.
    names : (B,) uint8
        Lines to write for page -1, 0, 1, ..., one after another.
    starts : (P + 2,) int64
        Where each of these starts, and where the last ends.
    out : (F * (75 + longest name) or more,) uint8

    Returns
    -------
    int
        Bytes written.
    """
    at = 0
    for face in range(len(faces)):
        if len(pages) and pages[face] != before:
            before = pages[face]
            for k in range(starts[before + 1], starts[before + 2]):
                out[at] = names[k]
                at += 1
        out[at] = 102  # f
        at += 1
        for k in range(3):
            out[at] = _SPACE
            at = _put_whole(np.int64(faces[face, k]) + 1, 1, out, at + 1)
            if len(uv) and uv[face, k] >= 0:
                out[at] = _SLASH
                at = _put_whole(np.int64(uv[face, k]) + 1, 1, out, at + 1)
        out[at] = _NEWLINE
        at += 1
    return at


@jit(nogil=True)
def number_values(values: Any, table: Any, numbers: Any, firsts: Any) -> int:
    """Give equal values one number, counted in the order of first appearance.

    Parameters
    ----------
    values : (N,) uint64
    table : (2^k,) int32, all -1
        At least twice as long as `values`.
    numbers : (N,) int32
        Out: number of each value.
    firsts : (N,) int64
        Out: where each number appears first; as many as are returned.
    """
    mask = np.uint64(len(table) - 1)
    count = 0
    for k in range(len(values)):
        mixed = values[k] * np.uint64(0x9E3779B97F4A7C15)
        slot = np.int64((mixed ^ (mixed >> np.uint64(32))) & mask)
        while table[slot] >= 0 and values[firsts[table[slot]]] != values[k]:
            slot = (slot + 1) & np.int64(mask)
        if table[slot] < 0:
            table[slot] = count
            firsts[count] = k
            count += 1
        numbers[k] = table[slot]
    return count


@jit(nogil=True)
def _decimals(data: Any, start: int, end: int) -> int:
    """Return how many decimals a number is written with, its exponent reckoned in."""
    count, exponent, sign = 0, 0, 1
    here = start
    while here < end and data[here] != _POINT and data[here] | 32 != 101:
        here += 1
    if here < end and data[here] == _POINT:
        here += 1
        while here < end and data[here] | 32 != 101:
            here += 1
            count += 1
    if here < end:  # at the letter e
        here += 1
        sign = -1 if data[here] == _MINUS else 1
        while here < end:
            if 48 <= data[here] <= 57:
                exponent = min(10 * exponent + data[here] - 48, 1000)
            here += 1
    return min(max(count - sign * exponent, 0), 15)


@jit(nogil=True)
def find_vectors(
    data: Any, end: int, kinds: Any, spans: Any, values: Any, decimals: Any, state: Any
) -> int:
    """Find the numbers of all `v` and `vn` lines.

    Parameters
    ----------
    data : (end + 4 or more,) uint8
        Whole lines, followed by four line ends.
    end : int
    kinds : (N,) uint8
        Out: 0 for `v`, 1 for `vn`; N is at least ``end // 6 + 2``.
    spans : (N, 3, 2) int64
        Out: first byte of each number and the byte behind it.
    values : (N, 3) float64
        Out: NaN where only Python can read the number.
    decimals : (N, 3) int64
        Out: as the numbers are written.
    state : (7 or more,) int64

    Returns
    -------
    int
        How many were found.
    """
    found, here = 0, 0
    while here < end:
        if data[here] == 102 or (data[here] == 118 and data[here + 1] == 116):  # f, vt
            while data[here] != 10 and data[here] != 13:
                here += 1
        here = skip_blanks(data, here, state)
        kind = -1
        if data[here] == 118 and is_blank(data[here + 1]):
            kind, here = 0, here + 1
        elif data[here] == 118 and data[here + 1] == 110 and is_blank(data[here + 2]):
            kind, here = 1, here + 2
        n = 0
        while kind >= 0 and n < 3:
            here = skip_blanks(data, here, state)
            if is_end(data[here]):
                break
            spans[found, n, 0] = here
            value, after, known = read_number(data, here)
            if after == here:
                break
            values[found, n] = value if known else np.nan
            decimals[found, n] = _decimals(data, here, after)
            spans[found, n, 1] = here = after
            n += 1
        if n == 3:
            kinds[found] = kind
            found += 1
        here = skip_line(data, here, kind >= 0 and data[here] != 35, state)
    return found


@jit(nogil=True)
def put_vectors(data: Any, end: int, spans: Any, values: Any, decimals: Any, out: Any) -> int:
    """Copy bytes with the numbers at `spans` replaced; return how many were written.

    Parameters
    ----------
    data, end, spans
        As from `find_vectors`, cut to what was found.
    values : (N, 3) float64
        The numbers to write; where not finite, what is there stays.
    decimals : (N, 3) int64
    out : (end + 3 * N * MAX_NUMBER or more,) uint8

    Returns
    -------
    int
        -1 if a number is too large to be written in fixed notation.
    """
    here, at = 0, 0
    for row in range(len(spans)):
        for k in range(3):
            value = values[row, k]
            if not np.isfinite(value):
                continue
            if abs(value) >= _LARGEST:
                return -1
            gap = spans[row, k, 0] - here
            out[at : at + gap] = data[here : here + gap]
            at += gap
            at = _put_fixed(value, decimals[row, k], out, at)
            here = spans[row, k, 1]
    out[at : at + end - here] = data[here:end]
    return at + end - here
