"""The state machine that reads whole lines of a Wavefront OBJ file."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.io.obj.text_kernels import (
    BAD_INDEX,
    COLORED,
    CORNERS,
    ELEMENTS,
    ERROR,
    ERROR_AT,
    EVENTS,
    FACES,
    FEW_CORNERS,
    FEW_NUMBERS,
    GROUPS,
    LINES,
    LONG_LINE,
    MANY_NUMBERS,
    NORMALS,
    OBJECTS,
    OK,
    OTHERS,
    POLYGONS,
    STOPPED,
    UNEVEN_CORNERS,
    UVS,
    VERTICES,
    WEIGHTED,
    WITH_UV,
    is_blank,
    is_break,
    is_end,
    read_index,
    read_number,
    skip_blanks,
    skip_line,
)
from meshreg.jit import jit

# Kinds of events: the first two name something, the others are words that only Python can read.
USEMTL, MTLLIB, POINT_WORD, COLOR_WORD, UV_WORD, IDLE_WORD = 1, 2, 3, 4, 5, 6

MAX_LINE = 1 << 20
MANY = 1000  # lines read before the fast kernel gets its turn again

_SLASH, _HASH, _BACKSLASH = 47, 35, 92
_USEMTL = np.frombuffer(b"usemtl", np.uint8).copy()
_MTLLIB = np.frombuffer(b"mtllib", np.uint8).copy()


@jit(nogil=True)
def _event(events: Any, state: Any, kind: int, target: int, start: int, end: int) -> None:
    row = state[EVENTS]
    events[row, 0], events[row, 1] = kind, target
    events[row, 2], events[row, 3], events[row, 4] = start, end, state[LINES]
    state[EVENTS] += 1


@jit(nogil=True)
def _vertex(
    data: Any, here: int, state: Any, points: Any, colors: Any, events: Any
) -> tuple[int, int]:
    """Read the numbers of a `v` line; return the place behind them and an error code."""
    row = state[VERTICES]
    n = 0
    while True:
        here = skip_blanks(data, here, state)
        if is_end(data[here]):
            break
        if n == 7:
            return here, MANY_NUMBERS
        start = here
        value, here, known = read_number(data, here)
        if n < 3:
            points[row, n] = value
        elif n < 6:
            colors[row, n - 3] = value
        if not known:
            kind = POINT_WORD if n < 3 else (COLOR_WORD if n < 6 else IDLE_WORD)
            _event(events, state, kind, 3 * row + n % 3, start, here)
        n += 1
    if n < 3:
        return here, FEW_NUMBERS
    if n == 5:
        return here, MANY_NUMBERS
    if n == 4 and colors[row, 0] != 1.0:
        state[WEIGHTED] += 1
    state[COLORED] += n >= 6
    state[VERTICES] += 1
    return here, OK


@jit(nogil=True)
def _texture_vertex(data: Any, here: int, state: Any, uvs: Any, events: Any) -> tuple[int, int]:
    """Read the numbers of a `vt` line; v is 0 where it is left out, w is not used."""
    row = state[UVS]
    uvs[row, 1] = 0.0
    n = 0
    while True:
        here = skip_blanks(data, here, state)
        if is_end(data[here]):
            break
        if n == 3:
            return here, MANY_NUMBERS
        start = here
        value, here, known = read_number(data, here)
        if n < 2:
            uvs[row, n] = value
        if not known:
            _event(events, state, UV_WORD if n < 2 else IDLE_WORD, 2 * row + n % 2, start, here)
        n += 1
    state[UVS] += 1
    return here, (OK if n else FEW_NUMBERS)


@jit(nogil=True)
def _corner(
    data: Any, here: int, state: Any, vertex: Any, uv: Any, at: int
) -> tuple[int, int, int]:
    """Read v, v/vt, v//vn or v/vt/vn; return the place behind it, which parts it has, error."""
    parts = 0
    vertex[at], here, error = read_index(data, here, state[VERTICES], state)
    uv[at] = -1
    if error == OK and data[here] == _SLASH:
        here += 1
        if not (data[here] == _SLASH or is_blank(data[here]) or is_break(data[here])):
            uv[at], here, error = read_index(data, here, state[UVS], state)
            parts = 1
        if error == OK and data[here] == _SLASH:
            here += 1
            if not (is_blank(data[here]) or is_break(data[here])):
                _, here, error = read_index(data, here, 0, state)
                parts += 2
    if error == OK and not (
        is_blank(data[here]) or is_break(data[here]) or data[here] == _BACKSLASH
    ):
        error = BAD_INDEX
    return here, parts, error


@jit(nogil=True)
def _face(data: Any, here: int, state: Any, vertex: Any, uv: Any, sizes: Any) -> tuple[int, int]:
    """Read the corners of an `f` line; return the place behind them and an error code."""
    first = corner = state[CORNERS]
    form = -1
    while True:
        here = skip_blanks(data, here, state)
        if is_end(data[here]):
            break
        start = here
        here, parts, error = _corner(data, here, state, vertex, uv, corner)
        if error == OK and form >= 0 and parts != form:
            error = UNEVEN_CORNERS
        if error != OK:
            return start, error
        form = parts
        corner += 1
    if corner - first < 3:
        return here, FEW_CORNERS
    sizes[state[FACES]] = corner - first
    state[POLYGONS] += corner - first != 3
    state[WITH_UV] += form & 1
    state[FACES] += 1
    state[CORNERS] = corner
    return here, OK


@jit(nogil=True)
def _starts_with(data: Any, here: int, word: Any) -> bool:
    for k in range(len(word)):
        if data[here + k] != word[k]:
            return False
    after = data[here + len(word)]
    return is_blank(after) or is_break(after)


@jit(nogil=True)
def _other_statement(data: Any, here: int, state: Any, events: Any) -> int:
    """Take note of any statement but v, vt, vn and f; return the place behind its line."""
    byte = data[here]
    single = is_blank(data[here + 1]) or is_break(data[here + 1])
    kind = 0
    named = False
    if byte == 117 and _starts_with(data, here, _USEMTL):
        kind = USEMTL
    elif byte == 109 and _starts_with(data, here, _MTLLIB):
        kind = MTLLIB
    elif single and (byte == 111 or byte == 103):  # noqa: PLR1714
        state[OBJECTS] += byte == 111
        state[GROUPS] += byte == 103
        named = True
    elif single and (byte == 108 or byte == 112):  # noqa: PLR1714
        state[ELEMENTS] += 1
    elif not (single and byte == 115):
        state[OTHERS] += 1
    # A name may end in a backslash, so the lines that hold one are never continued.
    lines = state[LINES]
    behind = skip_line(data, here, kind == 0 and not named, state)
    if kind:
        start, end = here + 6, behind
        while end > start and data[end - 1] <= 32:
            end -= 1
        while start < end and is_blank(data[start]):
            start += 1
        _event(events, state, kind, state[FACES], start, end)
        events[state[EVENTS] - 1, 4] = lines
    return behind


@jit(nogil=True)
def _statement(
    data: Any, here: int, state: Any, points: Any, colors: Any, uvs: Any, faces: Any, events: Any
) -> tuple[int, int, bool]:
    """Read one statement; return a place on its line (or behind it), error, if it is behind."""
    vertex, uv, sizes = faces
    byte, after = data[here], data[here + 1]
    spaced = is_blank(after) or after == _BACKSLASH or is_break(after)
    if byte == 118:
        if spaced:
            place, error = _vertex(data, here + 1, state, points, colors, events)
            return place, error, False
        named = is_blank(data[here + 2]) or is_break(data[here + 2])
        if after == 116 and named:
            place, error = _texture_vertex(data, here + 2, state, uvs, events)
            return place, error, False
        if after == 110 and named:
            state[NORMALS] += 1
            return here, OK, False
    elif byte == 102 and spaced:
        place, error = _face(data, here + 1, state, vertex, uv, sizes)
        return place, error, False
    elif is_end(byte):
        return here, OK, False
    return _other_statement(data, here, state, events), OK, True


@jit(nogil=True)
def parse(
    data: Any, here: int, end: int, stop: int, state: Any, floats: Any, faces: Any, events: Any
) -> int:
    """Read up to `MANY` whole lines of any kind; return the place behind them.

    Parameters
    ----------
    data : (end + 4 or more,) uint8
        The lines, followed by four line ends.
    here, end : int
        Where to start (a line's first byte), and the place behind the last line.
    stop : int
        Number of faces at which to stop, or -1.
    state : (N_STATE,) int64
        Counts, added to. On an error also its code and its byte; ``state[LINES]`` are then the
        lines before it.
    floats : tuple
        points (end // 6 + 2, 3) float64, colors (end // 6 + 2, 3) float32, uvs (end // 4 + 2, 2)
        float32.
    faces : tuple
        vertex (end // 2 + 2,) int32, uv the same, sizes (end // 6 + 2,) int32. Corners from 0; -1
        where there is no uv; NEGATIVE plus an index from the first of these lines for a negative
        one.
    events : (end // 2 + 2, 5) int64
        Kind, faces before (of a name) or place in the flat array (of a word), first byte, byte
        behind it, lines before.
    """
    points, colors, uvs = floats
    last = state[LINES] + MANY
    while here < end and state[LINES] < last:
        start, lines = here, state[LINES]
        here = skip_blanks(data, here, state)
        if state[FACES] == stop and data[here] == 102:
            place, error, behind = here, STOPPED, False
        else:
            place, error, behind = _statement(data, here, state, points, colors, uvs, faces, events)
        if error == OK:
            # A comment is never continued: one that ends in a backslash would eat a vertex.
            joins = data[place] != _HASH
            here = place if behind else skip_line(data, place, joins, state)
            if here - start > MAX_LINE + 2:
                place, error = start, LONG_LINE
        if error != OK:
            state[ERROR], state[ERROR_AT], state[LINES] = error, place, lines
            return end
    return here
