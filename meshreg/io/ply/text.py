"""Numbers in the text of a PLY file, and where in it something is wrong."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError
from meshreg.io.ply.header import Property
from meshreg.records import Float64, UInt8

CUT = "The file is cut off or damaged; export or copy it again."
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_NAN = re.compile(r"[+-]?(?:nan(?:\([a-z0-9]*\))?|1\.#(?:qnan|snan|ind)0*)")
_INFINITE = re.compile(r"[+-]?(?:inf|infinity|1\.#inf0*)")


def line_of(data: UInt8, here: int) -> str:
    """Return "line N" of a byte; lines end with LF, CRLF or CR."""
    text = bytes(data[:here])
    ends = text.count(b"\n") + text.count(b"\r") - text.count(b"\r\n")
    return f"line {ends + 1}"


def start_of_row(data: UInt8, start: int, row: int) -> int:
    """Return the first byte of an element's row (from 1) in text; for error messages."""
    from meshreg.io.ply.kernels import count_tokens

    end, _ = count_tokens(data, start, row - 1, np.zeros(row - 1, np.int64))
    here = int(end)
    while here < len(data) and data[here] in b" \t\r\n":
        here += 1
    return here


def read_numbers(data: UInt8, start: int, end: int, count: int, path: Path) -> Float64:
    """Read the `count` words in data[start:end] as numbers.

    Raises
    ------
    InputError
        A word that is no number, with its line.
    """
    from meshreg.io.ply.kernels import parse_tokens

    out = np.empty(count, np.float64)
    filled, begin, stop = parse_tokens(data, (start, end), out, 0)
    while begin >= 0:
        out[filled] = _number(bytes(data[begin:stop][:200]), data, int(begin), path)
        filled, begin, stop = parse_tokens(data, (stop, end), out, filled + 1)
    return out


def _number(word: bytes, data: UInt8, here: int, path: Path) -> float:
    """Read one word that the fast parser left, or refuse it."""
    text = word.decode("latin-1")
    if _NUMBER.fullmatch(text):
        return float(text)
    if _NAN.fullmatch(text.lower()):
        return np.nan
    if _INFINITE.fullmatch(text.lower()):
        return np.inf
    comma = re.fullmatch(r"[+-]?[0-9]+,[0-9]+(?:[eE][+-]?[0-9]+)?", text)
    raise InputError(
        f"has {text[:40]!r} (byte {here}) where a number belongs"
        + (": a decimal comma." if comma else "."),
        file=path,
        place=line_of(data, here),
        remedy="Export it with decimal points." if comma else CUT,
    )


def fitting(values: Float64, item: Property, element: str, path: Path) -> NDArray[Any]:
    """Turn numbers read from text into the integers that the header declares."""
    if item.kind[0] == "f":
        return values
    limits = np.iinfo(item.kind)
    good = (values >= limits.min) & (values <= limits.max) & (values == np.floor(values))
    if not good.all():
        bad = values[np.flatnonzero(~good)[0]]
        raise InputError(
            f"has {bad:g} in property {item.name!r} of {element!r}, whose type "
            f"({item.kind}) does not hold it.",
            file=path,
            remedy="Export it again.",
        )
    return values.astype(item.kind)
