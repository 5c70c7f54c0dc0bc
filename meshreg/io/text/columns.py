"""What the columns of a text cloud mean: by their names, or by what is in them."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from meshreg.records import Bool, Float64

_NAMES = {
    "x": ("x", "east", "easting", "e", "xcoord", "coordx", "coordinatex", "utmx", "utme"),
    "y": ("y", "north", "northing", "n", "ycoord", "coordy", "coordinatey", "utmy", "utmn"),
    "z": (
        "z",
        "up",
        "u",
        "elevation",
        "elev",
        "height",
        "altitude",
        "alt",
        "h",
        "zcoord",
        "coordz",
    ),
    "depth": ("depth", "down", "waterdepth"),
    "lon": ("lon", "long", "longitude"),
    "lat": ("lat", "latitude"),
    "r": ("r", "red", "rf", "diffusered"),
    "g": ("g", "green", "gf", "diffusegreen"),
    "b": ("b", "blue", "bf", "diffuseblue"),
    "classification": ("classification", "scalarclassification"),
}
_MEANING = {name: key for key, names in _NAMES.items() for name in names}
_ALIKE = 0.2  # by how much more the colors of an earlier triple must correlate to be preferred
_PIECE = 1 << 16  # bytes
_FEWER = 8  # a color with so many times fewer values than its neighbors is a class or an alpha


def meaning(name: str) -> str | None:
    """Return what a column's name stands for; units in brackets and punctuation do not count."""
    bare = re.sub(r"[\[(].*?[\])]", "", name).lower()
    return _MEANING.get(re.sub(r"[^a-z]", "", bare))


def guess_names(rows: Sequence[Sequence[str]], columns: int, *, intensity: bool) -> list[str]:
    """Guess what the columns of rows without a header are.

    A running number first, then x y z; a triple of unit length is a normal; the last triple
    that can be a color is one, unless what it would take in is plainly something else.

    Parameters
    ----------
    rows : sequence of rows of words
        A sample of the file, numbers with decimal points.
    columns : int
        Words in a row.
    intensity : bool
        A single column before the colors or at the end is what PTS files have there.

    Returns
    -------
    list of str
        "x", "y", "z"; "id", "nx", "ny", "nz", "red", "green", "blue", "intensity"; else "other".
    """
    names = ["other"] * columns
    words = [row for row in rows if len(row) == columns]
    values = np.array([[_number(word) for word in row] for row in words]).reshape(-1, columns)
    dotted = np.array([[not _is_whole(word) for word in row] for row in words], bool)
    dotted = dotted.reshape(-1, columns)
    start = 1 if columns > 3 and _is_label(values, dotted) else 0
    names[:start] = ["id"] * start
    names[start : start + 3] = "xyz"
    triples = range(start + 3, columns - 2) if len(values) else range(0)
    for first in triples:
        if set(names[first : first + 3]) == {"other"} and _is_unit(values[:, first : first + 3]):
            names[first : first + 3] = ["nx", "ny", "nz"]
    left = [first for first in triples if set(names[first : first + 3]) == {"other"}]
    color = _color(values, np.asarray(dotted.any(axis=0)), left)
    if color is not None:
        names[color : color + 3] = ["red", "green", "blue"]
    alone = start + 3
    rest = [k for k, name in enumerate(names) if name == "other"]
    if rest == [alone] and (intensity or color == alone + 1):
        names[alone] = "intensity"
    return names


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return float("nan")


def _is_whole(word: str) -> bool:
    return re.fullmatch(r"[+-]?\d+", word) is not None


def _is_label(values: Float64, dotted: Bool) -> bool:
    """Whether the first column is a label or a running number, the next three coordinates."""
    if np.isnan(values[:, 0]).all():
        return bool(len(values) and np.isfinite(values[:, 1:4]).mean() > 0.5)
    if len(values) < 10 or dotted[:, 0].any() or not dotted[:, 1:4].any(axis=0).all():
        return False
    step = np.diff(values[:, 0])
    # The sample has gaps between its pieces, where more than one is skipped.
    return bool((step > 0).all() and np.mean(step == 1) > 0.9 and np.ptp(values[:, 1:3]) > 0)


def _is_unit(vectors: Float64) -> bool:
    """Whether vectors (N, 3) are of length 1, some zero ones apart, and not whole numbers."""
    length = np.linalg.norm(vectors, axis=1)
    there = length > 1e-6  # not where it is NaN
    if there.mean() < 0.5 or (vectors[there] == np.rint(vectors[there])).all():
        return False
    return bool(np.mean(np.abs(length[there] - 1) < 0.02) >= 0.95)


def _color(values: Float64, dotted: Bool, triples: Sequence[int]) -> int | None:
    """Choose the triple that is the color: whole numbers 0-255, 0-65535 or fractions 0-1."""
    for kind in (_eight_bits, _sixteen_bits, _fractions):
        fits = [
            first
            for first in triples
            if len(set(dotted[first : first + 3].tolist())) == 1
            and np.isfinite(values[:, first : first + 3]).all()
            and kind(values[:, first : first + 3])
        ]
        fits = [f for f in fits if _as_varied(values[:, f : f + 3])] or fits
        if fits:
            last = fits[-1]
            best = max(fits, key=lambda first: _likeness(values[:, first : first + 3]))
            gain = _likeness(values[:, best : best + 3]) - _likeness(values[:, last : last + 3])
            return best if gain > _ALIKE else last
    return None


def _eight_bits(part: Float64) -> bool:
    return bool((part == np.rint(part)).all() and part.min() >= 0 and 0 < part.max() <= 255)


def _sixteen_bits(part: Float64) -> bool:
    whole = (part == np.rint(part)).all() and part.min() >= 0
    return bool(whole and part.max(axis=0).min() > 255 and part.max() <= 65535)


def _fractions(part: Float64) -> bool:
    return bool(part.min() >= 0 and 0 < part.max() <= 1)


def _as_varied(part: Float64) -> bool:
    """Whether the three columns have about as many different values."""
    counts = [len(np.unique(column)) for column in part.T]
    return max(counts) < _FEWER * min(counts)


def _likeness(part: Float64) -> float:
    """Return the lower of the correlations of neighboring columns, 0 where there is none."""
    if len(part) < 10:
        return 0.0
    moved = part - part.mean(axis=0)
    size = np.sqrt((moved**2).sum(axis=0))
    if not size.all():
        return 0.0
    moved /= size
    return float(min(moved[:, 0] @ moved[:, 1], moved[:, 1] @ moved[:, 2]))


def sample_rows(data: NDArray[np.uint8], start: int, delimiter: str) -> list[list[str]]:
    """Return rows of words from the start, the middle and the end of a text cloud."""
    from meshreg.io.files.safe import decode_name

    size, piece = len(data), _PIECE
    begins: tuple[int, ...] = (start, (start + size) // 2, size - piece)
    if size - start <= 4 * piece:
        begins, piece = (start,), size
    rows = []
    for begin in begins:
        text = decode_name(bytes(data[begin : begin + piece]))
        lines = re.split(r"\r\n|\n|\r", text)
        if begin > start:
            lines = lines[1:]
        if begin + piece < size:
            lines = lines[:-1]
        for line in lines:
            stripped = line.strip()
            if stripped and not stripped.startswith(("#", "//")):
                rows.append(split(stripped, delimiter))
    return rows


def split(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line without blanks and quotes around them."""
    parts = line.split() if delimiter == " " else line.split(delimiter)
    return [part.strip().strip("\"'") for part in parts]
