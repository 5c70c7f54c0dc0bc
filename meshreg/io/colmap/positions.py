"""Camera positions: from a table (CSV) or from the GPS of the photographs beside a model."""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.io.files.safe import MissingReferenceError, open_regular, resolve_reference
from meshreg.records import Float64

_MAX_BYTES = 100_000_000
_BROKEN = (OSError, ValueError, KeyError, TypeError, ZeroDivisionError, SyntaxError)
_GPS = 0x8825  # the EXIF tag of the GPS block
_COLUMNS = {
    "image": ("image", "label", "name", "filename", "imagename", "file", "photo", "camera"),
    "east": ("east", "easting", "x", "xeasting", "xeast", "e"),
    "north": ("north", "northing", "y", "ynorthing", "ynorth", "n"),
    "lon": ("lon", "long", "lng", "longitude", "xlongitude"),
    "lat": ("lat", "latitude", "ylatitude"),
    "up": ("up", "z", "alt", "altitude", "zaltitude", "elevation", "elev", "height", "h"),
    "depth": ("depth",),
}
_REMEDY = "Write a header: image,east,north,up (metres) or image,lon,lat,up."


@dataclass(frozen=True, eq=False)
class Positions:
    """Where images were taken.

    Attributes
    ----------
    names : tuple of str
    xyz : (N, 3) float64
        East, north, up [m], or longitude, latitude [degrees] and up.
    degrees : bool
    notes : tuple of str
    """

    names: tuple[str, ...]
    xyz: Float64
    degrees: bool
    notes: tuple[str, ...] = ()


def read_positions(path: Path) -> Positions:
    """Read a table of camera positions; commas, semicolons, tabs or blanks between columns.

    The header names the columns: image (or label, name, file), east, north, up (or x, y, z), or
    lon, lat with up (or altitude, height, depth). Without a header they are image, east, north,
    up. A depth counts downward, unless its numbers are negative.

    Raises
    ------
    InputError
        Naming the line.
    """
    with open_regular(path) as stream:
        text = stream.read(_MAX_BYTES + 1)
    if len(text) > _MAX_BYTES or b"\0" in text:
        raise InputError("is not a table of positions.", file=path, remedy=_REMEDY)
    lines = [
        (number, line.strip())
        for number, line in enumerate(text.decode("utf-8-sig", "replace").splitlines(), 1)
        if line.strip()
    ]
    header, rows = _header(lines, path)
    split = _splitter(rows[0][1] if rows else "", path)
    names, values = [], []
    columns = header or {"image": 0, "east": 1, "north": 2, "up": 3}
    keys = [key for key in ("east", "lon", "north", "lat", "up", "depth") if key in columns]
    for number, line in rows:
        words = split(line)
        try:
            names.append(words[columns["image"]].strip().strip('"'))
            values.append([float(words[columns[key]]) for key in keys])
        except (IndexError, ValueError, csv.Error) as error:
            raise InputError(
                f"has no position in {line[:60]!r}.",
                file=path,
                place=f"line {number}",
                remedy="Use decimal points and one row for each image.",
            ) from error
    if not names:
        raise InputError("holds no position.", file=path, remedy=_REMEDY)
    xyz = np.array(values)
    if not np.isfinite(xyz).all():
        bad = rows[int(np.argmin(np.isfinite(xyz).all(axis=1)))][0]
        raise InputError("holds a number that is not finite.", file=path, place=f"line {bad}")
    notes = []
    if keys[2] == "depth" and np.median(xyz[:, 2]) >= 0:
        xyz[:, 2] *= -1
        notes.append("Depths of cameras were taken as metres downward.")
    return Positions(tuple(names), xyz, "lon" in keys, tuple(notes))


def _header(
    lines: list[tuple[int, str]], path: Path
) -> tuple[dict[str, int] | None, list[tuple[int, str]]]:
    """Return the columns that the first row names (None where it names none) and the data rows."""
    first = next((i for i, (_, line) in enumerate(lines) if _named(line)), None)
    data = [row for row in lines if not row[1].startswith("#")]
    if first is None or (data and lines[first][0] > data[0][0]):
        return None, data
    columns = _named(lines[first][1])
    flat = {"east", "north"} <= columns.keys() or {"lon", "lat"} <= columns.keys()
    if "image" not in columns or not flat or not {"up", "depth"} & columns.keys():
        raise InputError(
            f"names its columns {lines[first][1]!r}; image, east, north and up were looked for.",
            file=path,
            place=f"line {lines[first][0]}",
            remedy=_REMEDY,
        )
    if {"lon", "lat"} <= columns.keys():
        columns = {key: at for key, at in columns.items() if key not in ("east", "north")}
    if "up" in columns:
        columns.pop("depth", None)
    return columns, [row for row in data if row[0] > lines[first][0]]


def _named(line: str) -> dict[str, int]:
    """Return column numbers by meaning where a line is a header, else nothing."""
    words = re.split(r"[,;\t]" if re.search(r"[,;\t]", line) else r"\s+", line.lstrip("# "))
    found: dict[str, int] = {}
    for at, word in enumerate(words):
        plain = re.sub(r"\([^)]*\)|\[[^]]*\]|[^a-z]", "", word.lower())
        for key, known in _COLUMNS.items():
            if plain in known and key not in found:
                found[key] = at
    return found if len(found) >= 3 else {}


def _splitter(line: str, path: Path) -> Any:
    for mark in (";", "\t", ","):
        if line.count(mark) >= 3:
            return lambda text: _fields(text, mark)
    if line and len(line.split()) < 4:
        raise InputError(f"has too few columns in {line[:60]!r}.", file=path, remedy=_REMEDY)
    return str.split


def _fields(line: str, mark: str) -> list[str]:
    """Return the fields of a line; quotes may hold the mark."""
    if '"' not in line:
        return [word.strip() for word in line.split(mark)]
    return [
        word.strip() for word in next(csv.reader([line], delimiter=mark, skipinitialspace=True))
    ]


def match_names(images: Sequence[str], positions: Sequence[str]) -> list[tuple[int, int]]:
    """Pair images with positions: by path, else by file name, else by name without its suffix.

    Letter case does not matter; a name that fits several on either side fits none.

    Returns
    -------
    list of (image number, position number)
    """

    def keys(name: str) -> tuple[str, str, str]:
        path = name.replace("\\", "/").lower()
        base = path.rsplit("/", 1)[-1]
        return path, base, base.rsplit(".", 1)[0]

    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for level in range(3):
        left = _unique(images, level, keys, set(pairs))
        right = _unique(positions, level, keys, taken)
        for key, image in left.items():
            if key in right:
                pairs[image] = right[key]
                taken.add(right[key])
    return sorted(pairs.items())


def _unique(names: Sequence[str], level: int, keys: Any, without: set[int]) -> dict[str, int]:
    found: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        if number not in without:
            found.setdefault(keys(name)[level], []).append(number)
    return {key: numbers[0] for key, numbers in found.items() if len(numbers) == 1}


def exif_positions(root: Path, images: Sequence[str]) -> Positions:
    """Read the GPS of the photographs, where they lie in the survey's folder or its `images`.

    Parameters
    ----------
    root : Path
        The folder that was named; nothing outside it is opened.
    images : sequence of str
        Names as the model gives them.

    Returns
    -------
    Positions
        Of those that have one, perhaps none; longitude, latitude (WGS 84), altitude [m].
    """
    names, values = [], []
    for name in images:
        path = _photograph(root, name)
        place = None if path is None else _gps(path)
        if place is not None:
            names.append(name)
            values.append(place)
    notes = ("The altitudes are of GPS receivers: their datum and accuracy are those of EXIF.",)
    return Positions(tuple(names), np.array(values).reshape(-1, 3), True, notes if names else ())


def _photograph(root: Path, name: str) -> Path | None:
    for folder in (root / "images", root):
        if folder.is_dir():
            try:
                return resolve_reference(folder, name, root=root)
            except MissingReferenceError:
                continue
            except InputError:  # a name that leads outside is no photograph of this survey
                return None
    return None


def _gps(path: Path) -> tuple[float, float, float] | None:
    """Return longitude, latitude, altitude of a photograph, None where it has no usable GPS."""
    from PIL import Image

    try:
        with warnings.catch_warnings(), open_regular(path) as stream:
            warnings.simplefilter("ignore")  # no pixel is decoded, whatever the size
            with Image.open(stream, formats=("JPEG", "TIFF")) as image:
                block = image.getexif().get_ifd(_GPS)
        lat, lon = (_angle(block[tag], block[tag - 1]) for tag in (2, 4))
        up = float(block[6]) * (-1 if block.get(5) in (1, b"\x01") else 1)
    except (*_BROKEN, Image.DecompressionBombError):
        return None
    usable = np.isfinite([lon, lat, up]).all() and abs(lat) <= 90 and abs(lon) <= 180
    return (lon, lat, up) if usable and (lon, lat) != (0, 0) else None


def _angle(parts: Any, side: Any) -> float:
    """Return degrees of (degrees, minutes, seconds) and N, S, E or W (EXIF 2.3, section 4.6.6)."""
    degrees, minutes, seconds = (float(part) for part in parts)
    value = degrees + minutes / 60 + seconds / 3600
    return -value if str(side).strip("\0 ").upper() in ("S", "W") else value
