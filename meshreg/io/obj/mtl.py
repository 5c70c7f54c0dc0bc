"""Wavefront MTL: which texture page a material has, and how it lies on the surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from meshreg.errors import InputError
from meshreg.io.files.line_blocks import line_blocks
from meshreg.io.files.safe import decode_name, open_regular

_OTHER_MAPS = ("bump", "disp", "decal", "refl", "norm")


@dataclass(frozen=True)
class Material:
    """One material of an MTL file.

    Attributes
    ----------
    name : str
    place : str
        Line of `page`, for messages.
    page : str or None
        The texture page of `map_Kd`, as written.
    change : (scale u, scale v, offset u, offset v)
        Texture coordinates are scaled, then moved (options -s and -o).
    clamp : bool
        Option -clamp on.
    others : tuple of str
        Files named by its other maps, which are not used but belong to it.
    """

    name: str
    place: str = ""
    page: str | None = None
    change: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)
    clamp: bool = False
    others: tuple[str, ...] = ()


@dataclass
class _Draft:
    name: str
    place: str = ""
    page: str | None = None
    change: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)
    clamp: bool = False
    others: list[str] = field(default_factory=list)

    def done(self) -> Material:
        return Material(
            self.name, self.place, self.page, self.change, self.clamp, tuple(self.others)
        )


def read_mtl(path: Path) -> dict[str, Material]:
    """Read the materials of an MTL file, by name; of two of one name the first counts.

    Raises
    ------
    InputError
        Not text, or an option of `map_Kd` that is not understood, with its line.
    ResourceLimitError
        A line of more than 1 MiB.
    """
    materials: dict[str, Material] = {}
    draft: _Draft | None = None
    for number, line in _lines(path):
        words = line.split(None, 1)
        key = words[0].lower() if words else b""
        rest = decode_name(words[1].strip()) if len(words) > 1 else ""
        if key == b"newmtl":
            if draft is not None:
                materials.setdefault(draft.name, draft.done())
            draft = _Draft(rest)
        elif draft is None or not rest:
            continue
        elif key == b"map_kd":
            draft.place = f"line {number}"
            draft.page, draft.change, draft.clamp = _page(rest, path, draft.place)
        elif key.startswith(b"map_") or key.decode("latin-1") in _OTHER_MAPS:
            draft.others.append(_other(rest))
    if draft is not None:
        materials.setdefault(draft.name, draft.done())
    return materials


def name_start(key: bytes, rest: bytes) -> int:
    """Return where in what follows `key` (map_Kd, bump, ...) the name of the file begins."""
    text = rest.decode("latin-1")
    name = _page(text, Path(), "")[0] if key.lower() == b"map_kd" else _other(text)
    return len(text) - len(name)


def _other(text: str) -> str:
    """Return the file that a map which is not used names, its options left out."""
    return text.rsplit(maxsplit=1)[-1] if text.startswith("-") else text


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    number = 0
    with open_regular(path) as stream:
        for block in line_blocks(stream, path):
            for line in block.data[: block.end].tobytes().splitlines():
                number += 1
                yield number, line


def _page(text: str, path: Path, place: str) -> tuple[str, tuple[float, float, float, float], bool]:
    """Split what follows `map_Kd` into the page's name, scale and offset, clamp."""
    scale, offset, clamp = (1.0, 1.0), (0.0, 0.0), False
    while text.startswith("-"):
        option, _, text = text.partition(" ")
        text = text.lstrip()
        if option in ("-s", "-o"):
            numbers: list[float] = []
            while len(numbers) < 3 and (value := _number(text)) is not None:
                numbers.append(value)
                text = text.partition(" ")[2].lstrip()
            default = 1.0 if option == "-s" else 0.0
            pair = (numbers[0] if numbers else default, numbers[1] if numbers[1:] else default)
            scale, offset = (pair, offset) if option == "-s" else (scale, pair)
            good = bool(numbers)
        elif option == "-clamp":
            word, _, text = text.partition(" ")
            good, clamp = word in ("on", "off"), word == "on"
            text = text.lstrip()
        else:
            good = False
        if not good:
            raise InputError(
                f"option {option!r} of map_Kd is not understood; -s, -o and -clamp are.",
                file=path,
                place=place,
                remedy="Take it out, if the texture looks right without it.",
            )
    if not text:
        raise InputError("map_Kd names no file.", file=path, place=place)
    return text, (*scale, *offset), clamp


def _number(text: str) -> float | None:
    word = text.split(None, 1)[0] if text.strip() else ""
    try:
        value = float(word)
    except ValueError:
        return None
    return value if abs(value) < 1e9 else None
