"""What one block of lines of a Wavefront OBJ file holds."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.io.files.line_blocks import BLOCK, LONGEST, Block
from meshreg.io.files.safe import decode_name
from meshreg.records import Float32, Float64, Int32

_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_NONFINITE = re.compile(rb"[+-]?(nan|inf|1\.#)", re.IGNORECASE)  # as C libraries print them


@dataclass(frozen=True, eq=False)
class Lines:
    """What is in one block: its arrays, `names` (kind, faces before, name), `wrong` words."""

    state: NDArray[np.int64]
    points: Float64
    colors: Float32
    uvs: Float32
    vertex: Int32
    uv: Int32 | None
    sizes: Int32 | None
    names: list[tuple[int, int, str]] = field(default_factory=list)
    wrong: list[tuple[int, str]] = field(default_factory=list)


class Worker:
    """Runs the kernel over blocks, each independent of all others; keeps its scratch arrays."""

    def __init__(self) -> None:
        self._scratch: deque[Any] = deque()

    def __call__(self, block: Block, stop: int = -1) -> Lines:
        """Read one block; `stop` is the face (from 0, in this block) at which to stop."""
        from meshreg.io.obj import text_kernels as text
        from meshreg.io.obj.fast_kernels import parse_plain
        from meshreg.io.obj.kernels import parse

        try:
            scratch = self._scratch.pop()
        except IndexError:
            scratch = _new_scratch(BLOCK + LONGEST)
        floats, faces, events = scratch
        state = np.zeros(text.N_STATE, np.int64)
        here = 0
        while here < block.end:
            here = parse_plain(block.data, here, block.end, stop, state, floats, faces)
            if here < block.end:
                here = parse(block.data, here, block.end, stop, state, floats, faces, events)
        (points, colors, uvs), (vertex, uv, sizes) = floats, faces
        n_points, n_uvs, n_corners = state[[text.VERTICES, text.UVS, text.CORNERS]]
        lines = Lines(
            state,
            points[:n_points].copy(),
            colors[: n_points if state[text.COLORED] else 0].copy(),
            uvs[:n_uvs].copy(),
            vertex[:n_corners].copy(),
            uv[:n_corners].copy() if state[text.WITH_UV] else None,
            sizes[: state[text.FACES]].copy() if state[text.POLYGONS] else None,
        )
        for event in events[: state[text.EVENTS]].tolist():
            _note(block, lines, event)
            if lines.wrong:
                break
        self._scratch.append(scratch)
        return lines


def _new_scratch(size: int) -> Any:
    """Return arrays that what is in a block of `size` bytes fits; untouched pages cost nothing."""
    return (
        (
            np.empty((size // 6 + 2, 3)),
            np.empty((size // 6 + 2, 3), np.float32),
            np.empty((size // 4 + 2, 2), np.float32),
        ),
        (
            np.empty(size // 2 + 2, np.int32),
            np.empty(size // 2 + 2, np.int32),
            np.empty(size // 6 + 2, np.int32),
        ),
        np.empty((size // 2 + 2, 5), np.int64),
    )


def _note(block: Block, lines: Lines, event: list[int]) -> None:
    """Keep a name, or read a word that the kernel could not: NaN, infinity, very long numbers."""
    from meshreg.io.obj import kernels

    kind, target, start, end, line = event
    word = block.data[start:end].tobytes()
    if kind in (kernels.USEMTL, kernels.MTLLIB):
        lines.names.append((kind, target, decode_name(word)))
        return
    if _NUMBER.fullmatch(word):
        value = float(word)
    elif _NONFINITE.match(word):
        value = float("nan")
    else:
        lines.wrong.append((line, word_at(block, start)))
        return
    arrays: dict[int, Any] = {
        kernels.POINT_WORD: lines.points,
        kernels.COLOR_WORD: lines.colors,
        kernels.UV_WORD: lines.uvs,
    }
    # The numbers of a line that turns out to be wrong lie behind the arrays' ends.
    if kind in arrays and target < arrays[kind].size:
        arrays[kind].reshape(-1)[target] = value


def word_at(block: Block, start: int) -> str:
    """Return the word at or after a byte, for messages."""
    words = block.data[start : start + 40].tobytes().split(maxsplit=1)
    return decode_name(words[0]) if words else ""
