"""Parse the rows of a text cloud whose layout is known."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError
from meshreg.io.text.layout import Layout
from meshreg.records import Float64

_UNSETTLED = 65_536


def columns_of(
    data: NDArray[np.uint8],
    layout: Layout,
    path: Path,
    wanted: Iterable[int],
    lenient: bool = False,
) -> dict[int, Float64]:
    """Parse some columns of all rows: each (rows,) float64, NaN where a field is empty or "nan".

    Parameters
    ----------
    data : (size,) uint8
    layout : Layout
    path : Path
    wanted : iterable of int
        Numbers of columns.
    lenient : bool
        What is no number is NaN too, in columns that are not x, y or z.

    Raises
    ------
    InputError
        As `read`.
    """
    if layout.decimal == ",":
        data = data.copy()
        data[layout.start :][data[layout.start :] == ord(",")] = ord(".")
    numbers = sorted(set(wanted))
    strict = {layout.where[name] for name in "xyz"} if lenient else set(numbers)
    values = _read_values(data, layout, path, numbers, strict)
    return {number: values[:, slot] for slot, number in enumerate(numbers)}


def _read_values(
    data: NDArray[np.uint8], layout: Layout, path: Path, wanted: list[int], strict: set[int]
) -> Float64:
    """Parse all rows into (rows, columns of `wanted`) float64."""
    from meshreg.io.text.kernels import count_rows, parse_rows

    rows = count_rows(data, layout.start)
    if layout.count is not None and layout.count != rows:
        raise InputError(
            f"announces {layout.count} points, but holds {rows} rows.",
            file=path,
            place="line 1",
            remedy="It is cut off or was edited; export it again.",
        )
    slots = np.full(layout.columns, -1, np.int64)
    slots[wanted] = np.arange(len(wanted))
    out = np.full((rows, len(wanted)), np.nan)
    state = np.array([layout.start, layout.line, 0], np.int64)
    unsettled = np.zeros((_UNSETTLED + layout.columns, 5), np.int64)
    while state[0] < len(data):
        count, fields = parse_rows(data, state, ord(layout.delimiter), slots, out, unsettled)
        for row, slot, start, end, line in unsettled[:count].tolist():
            word = bytes(data[start:end])
            out[row, slot] = _settled(word, line, path, wanted[slot] in strict)
        if fields:
            raise InputError(
                f"has {fields} values where the other rows have {layout.columns}.",
                file=path,
                place=f"line {state[1]}",
                remedy="The row is cut off or damaged; export it again.",
            )
    return out


def _settled(word: bytes, line: int, path: Path, strict: bool) -> float:
    """Read a number that the kernel left to Python, or say which line has none."""
    text = word.decode("latin-1").strip("\"'")
    try:
        if "_" not in text:
            return float(text)
    except ValueError:
        pass
    if not strict:
        return float("nan")
    comma = "a decimal comma" if "," in text else "text"
    raise InputError(
        f"has {comma} where a number should be: {text[:40]!r}.",
        file=path,
        place=f"line {line}",
        remedy="Write numbers with a decimal point, and nan where there is none.",
    )
