"""Words of a Wavefront OBJ line: blanks, line ends, numbers and face indices.

The bytes are followed by four line ends that do not belong to the file, so that no loop here needs
to ask whether the file is over.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.io.files.numbers_kernels import parse_number
from meshreg.jit import jit

# Places in the `state` that `obj_kernels.parse` fills.
VERTICES, UVS, NORMALS, CORNERS, FACES, EVENTS, LINES = 0, 1, 2, 3, 4, 5, 6
ERROR, ERROR_AT, COLORED, WEIGHTED, RELATIVE, POLYGONS = 7, 8, 9, 10, 11, 12
OBJECTS, GROUPS, ELEMENTS, OTHERS, WITH_UV = 13, 14, 15, 16, 17
N_STATE = 18

# What `state[ERROR]` says.
OK, FEW_NUMBERS, MANY_NUMBERS, FEW_CORNERS, BAD_INDEX = 0, 1, 2, 3, 4
ZERO_INDEX, HUGE_INDEX, UNEVEN_CORNERS, LONG_LINE, STOPPED = 5, 6, 7, 8, 9

# A negative index is kept as this plus its index from the block's first vertex, which the caller
# makes absolute: so the blocks of a file are parsed independently of one another.
NEGATIVE = -(1 << 30)

_TEN = 10.0 ** np.arange(23)
_HASH, _BACKSLASH = 35, 92


@jit(nogil=True)
def is_blank(byte: Any) -> bool:
    """Whether a byte separates words."""
    return bool(byte == 32 or byte == 9)  # noqa: PLR1714  (compiles to two comparisons)


@jit(nogil=True)
def is_break(byte: Any) -> bool:
    """Whether a byte ends a line."""
    return bool(byte == 10 or byte == 13)  # noqa: PLR1714


@jit(nogil=True)
def is_end(byte: Any) -> bool:
    """Whether the statement is over where a word could start: a line end or a comment."""
    return bool(byte == 10 or byte == 13 or byte == _HASH)  # noqa: PLR1714


@jit(nogil=True)
def skip_blanks(data: Any, here: int, state: Any) -> int:
    """Go over blanks and over line ends that a backslash hides."""
    while True:
        byte = data[here]
        if is_blank(byte):
            here += 1
        elif byte == _BACKSLASH and (data[here + 1] == 10 or data[here + 1] == 13):
            here += 3 if data[here + 1] == 13 and data[here + 2] == 10 else 2
            state[LINES] += 1
        else:
            return here


@jit(nogil=True)
def skip_line(data: Any, here: int, joins: bool, state: Any) -> int:
    """Go behind the line's end; `joins` says whether a backslash continues the line."""
    while True:
        byte = data[here]
        if byte == 10:
            state[LINES] += 1
            return here + 1
        if byte == 13:
            state[LINES] += 1
            return here + (2 if data[here + 1] == 10 else 1)
        if byte == _BACKSLASH and joins:
            after = skip_blanks(data, here, state)
            here = after if after > here else here + 1
        else:
            here += 1


@jit(nogil=True)
def word_end(data: Any, here: int) -> int:
    """Return the place behind the word at `here`."""
    while not (is_blank(data[here]) or is_break(data[here]) or data[here] == _BACKSLASH):
        here += 1
    return here


@jit(nogil=True)
def read_number(data: Any, start: int) -> tuple[float, int, bool]:
    """Read the number at `start`; return its value, the place behind it, and whether it is one.

    Not known are also NaN, infinity and the few numbers that only Python's `float` can settle.
    """
    here = start
    byte = np.int64(data[here])
    negative = byte == 45
    if negative or byte == 43:
        here += 1
    first = here
    digits = np.int64(0)
    digit = np.int64(data[here]) - 48
    while 0 <= digit <= 9:
        digits = 10 * digits + digit
        here += 1
        digit = np.int64(data[here]) - 48
    seen = here - first
    decimals = 0
    if digit == -2:  # the decimal point
        here += 1
        first = here
        digit = np.int64(data[here]) - 48
        while 0 <= digit <= 9:
            digits = 10 * digits + digit
            here += 1
            digit = np.int64(data[here]) - 48
        decimals = here - first
        seen += decimals
    byte = digit + 48
    plain = is_blank(byte) or is_break(byte)
    if plain and 0 < seen <= 18 and digits <= 9007199254740992:
        # Both are exact in float64, so the one rounding is the right one (Clinger, PLDI 1990).
        value = np.float64(digits) / _TEN[decimals]
        return (-value if negative else value), here, True
    end = word_end(data, start)
    value, known = parse_number(data, start, end)
    return value, end, known


@jit(nogil=True)
def read_index(data: Any, start: int, count: int, state: Any) -> tuple[Any, int, int]:
    """Read a face's index at `start`; return it from 0 (or NEGATIVE plus ...), end, error."""
    here = start
    negative = data[here] == 45
    if negative:
        here += 1
    first = here
    value = np.int64(0)
    digit = np.int64(data[here]) - 48
    while 0 <= digit <= 9:
        value = 10 * value + digit
        here += 1
        digit = np.int64(data[here]) - 48
    if here == first:
        return 0, start, BAD_INDEX
    if here - first > 9 and (here - first > 18 or value > 2147483647):
        return 0, start, HUGE_INDEX
    if value == 0:
        return 0, start, ZERO_INDEX
    if negative:
        if value >= 1 << 29:
            return 0, start, HUGE_INDEX
        state[RELATIVE] = 1
        return NEGATIVE + count - value, here, OK
    return value - 1, here, OK
