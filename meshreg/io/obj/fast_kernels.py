"""The common lines of a Wavefront OBJ file, fast; all others are left to `obj_kernels`.

Written without calls, because in the state machine these cost more than the digits do: `v` with
three or six plain numbers, `vt` with two, `vn`, and `f` with three corners counted from 1 make up
nearly all of an exported survey. Every doubtful line is left to the state machine, so that what
is right or wrong is said in one place.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.io.obj.text_kernels import (
    COLORED,
    CORNERS,
    FACES,
    LINES,
    NORMALS,
    UVS,
    VERTICES,
    WITH_UV,
)
from meshreg.jit import jit

MAX_LINE = 1 << 20
_TEN = 10.0 ** np.arange(23)
_BLANK, _SLASH, _V, _F, _T, _N = 32, 47, 118, 102, 116, 110


@jit(nogil=True, inline="always")
def _decimal(data: Any, here: int) -> tuple[float, int]:
    """Read blanks and a plain decimal number; a negative place says that it is not so plain."""
    start = here
    while data[here] == _BLANK:
        here += 1
    apart = here > start
    negative = data[here] == 45
    if negative:
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
    plain = apart and 0 < seen <= 18 and digits <= 9007199254740992
    # Both are exact in float64, so the one rounding is the right one (Clinger, PLDI 1990).
    value = np.float64(digits) / _TEN[decimals if plain else 0]
    return (-value if negative else value), (here if plain else -1)


@jit(nogil=True, inline="always")
def _count(data: Any, here: int) -> tuple[Any, int]:
    """Read a whole number from 1 on, of up to nine digits; a negative place says "it is not"."""
    first = here
    value = np.int64(0)
    digit = np.int64(data[here]) - 48
    while 0 <= digit <= 9:
        value = 10 * value + digit
        here += 1
        digit = np.int64(data[here]) - 48
    return value, (here if 0 < here - first <= 9 and value > 0 else -1)


@jit(nogil=True)
def parse_plain(  # noqa: PLR0912, PLR0915  (one loop without calls, on purpose)
    data: Any, here: int, end: int, stop: int, state: Any, floats: Any, faces: Any
) -> int:
    """Read plain lines up to the first that is not; return the place of that line.

    Parameters
    ----------
    data, here, end, stop, state, floats, faces
        As for `obj_kernels.parse`.
    """
    points, colors, uvs = floats
    vertex, uv, sizes = faces
    n_points, n_uvs, n_normals = state[VERTICES], state[UVS], state[NORMALS]
    n_faces, n_corners, lines = state[FACES], state[CORNERS], state[LINES]
    with_uv, colored = state[WITH_UV], state[COLORED]
    while here < end:
        at = here + 1
        form, kind, after = 0, data[here], data[here + 1]
        if kind == _V and after == _BLANK:
            for k in range(3):
                points[n_points, k], at = _decimal(data, at)
                if at < 0:
                    break
            if at >= 0 and data[at] == _BLANK and data[at + 1] > _BLANK:
                form = 1
                for k in range(3):
                    colors[n_points, k], at = _decimal(data, at)
                    if at < 0:
                        break
            if at < 0:
                break
        elif kind == _F and after == _BLANK and n_faces != stop:
            for k in range(3):
                parts = 0
                while data[at] == _BLANK:
                    at += 1
                index, at = _count(data, at)
                vertex[n_corners + k] = index - 1
                uv[n_corners + k] = -1
                if at >= 0 and data[at] == _SLASH:
                    at += 1
                    if data[at] != _SLASH:
                        index, at = _count(data, at)
                        uv[n_corners + k] = index - 1
                        parts = 1
                    if at >= 0 and data[at] == _SLASH:
                        index, at = _count(data, at + 1)
                        parts += 2
                if at < 0 or (k > 0 and parts != form):
                    at = -1
                    break
                form = parts
            if at < 0:
                break
        elif kind == _V and after == _T and data[here + 2] == _BLANK:
            kind = _T
            at += 1
            for k in range(2):
                uvs[n_uvs, k], at = _decimal(data, at)
                if at < 0:
                    break
            if at < 0:
                break
        elif kind == _V and after == _N and data[here + 2] == _BLANK:
            kind = _N
            while data[at] != 10 and data[at] != 13 and data[at] != 92:
                at += 1
        else:
            break
        while data[at] == _BLANK:
            at += 1
        if data[at] == 13:
            at += 1
        if data[at] != 10 or at - here > MAX_LINE:
            break
        here = at + 1
        lines += 1
        if kind == _F:
            sizes[n_faces] = 3
            n_faces += 1
            n_corners += 3
            with_uv += form & 1
        elif kind == _T:
            n_uvs += 1
        elif kind == _N:
            n_normals += 1
        else:
            n_points += 1
            colored += form
    state[VERTICES], state[UVS], state[NORMALS] = n_points, n_uvs, n_normals
    state[FACES], state[CORNERS], state[LINES] = n_faces, n_corners, lines
    state[WITH_UV], state[COLORED] = with_uv, colored
    return here
