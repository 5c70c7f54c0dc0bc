"""Texture pages by tile of texture coordinates: UDIM and the like.

Tile (u, v), whole numbers from 0, shows the coordinates u ... u + 1, v ... v + 1. Its page is
called by 1001 + u + 10 v, with u under 10 (UDIM, Mari), or by u and v themselves (ZBrush from 0,
Mudbox from 1).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

from meshreg.errors import InputError
from meshreg.io.files.safe import resolve_reference

Tile = tuple[int, int]
_TOKEN = re.compile(r"(?i)<(udim|uvtile)>|%\(udim\)d")
_NUMBER = re.compile(r"(?<![0-9])(1[0-9]{3})(?![0-9])(?=[^0-9]*$)")
_PAIR = re.compile(r"(?i)(?<![a-z0-9])u([0-9]{1,2})_v([0-9]{1,2})(?![0-9])")
_COLUMNS = 10  # tiles side by side in UDIM's counting


def has_token(name: str) -> bool:
    """Whether a page's name stands for all tiles ("reef.<UDIM>.jpg")."""
    return _TOKEN.search(name) is not None


def first_tile(name: str) -> bool:
    """Whether a page's name is that of the tile at (0, 0), as a material often names it."""
    base = _base(name)
    number = _NUMBER.search(base)
    pair = _PAIR.search(base)
    return (number is not None and number[1] == "1001") or (
        pair is not None and (pair[1], pair[2]) in (("0", "0"), ("1", "1"))
    )


def tile_pages(folder: Path, name: str, root: Path) -> dict[Tile, Path]:
    """Find the pages of all tiles that are there.

    Parameters
    ----------
    folder : Path
        Of the file that names the page.
    name : str
        With a token, or the name of the first tile's page.
    root : Path
        The survey's folder, which no page may leave.

    Returns
    -------
    dict of (u, v) to Path
    """
    pattern, place = _pattern(_base(name)), name[: len(name) - len(_base(name))]
    if pattern is None:
        return {}
    found: dict[Tile, Path] = {}
    for entry, tile in _matches(folder / place.replace("\\", "/"), pattern):
        try:
            found.setdefault(tile, resolve_reference(folder, place + entry, root=root))
        except InputError:  # a link out of the folder, a folder of that name
            continue
    return found


def _base(name: str) -> str:
    return re.split(r"[/\\]", name)[-1]


def _pattern(base: str) -> tuple[re.Pattern[str], int] | None:
    """Return what the pages' names look like, and from which number u and v count (or -1: UDIM)."""
    if token := _TOKEN.search(base):
        parts = base[: token.start()], base[token.end() :]
        if token[1] and token[1].lower() == "uvtile":
            return re.compile("{}u(\\d+)_v(\\d+){}".format(*map(re.escape, parts))), 1
        return re.compile("{}(1\\d{{3}}){}".format(*map(re.escape, parts))), -1
    if number := _NUMBER.search(base):
        parts = base[: number.start()], base[number.end() :]
        return re.compile("{}(1\\d{{3}}){}".format(*map(re.escape, parts))), -1
    if pair := _PAIR.search(base):
        parts = base[: pair.start()], base[pair.end() :]
        pattern = "{}[uU](\\d+)_[vV](\\d+){}".format(*map(re.escape, parts))
        return re.compile(pattern), int(pair[1])
    return None


def _matches(folder: Path, pattern: tuple[re.Pattern[str], int]) -> Iterable[tuple[str, Tile]]:
    try:
        entries = sorted(os.listdir(folder))
    except OSError:
        return
    for entry in entries:
        if not (fit := pattern[0].fullmatch(entry)):
            continue
        if pattern[1] < 0:
            number = int(fit[1]) - 1001
            if number >= 0:
                yield entry, (number % _COLUMNS, number // _COLUMNS)
        else:
            u, v = int(fit[1]) - pattern[1], int(fit[2]) - pattern[1]
            if u >= 0 and v >= 0:
                yield entry, (u, v)
