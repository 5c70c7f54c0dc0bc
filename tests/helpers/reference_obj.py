"""A slow Wavefront OBJ parser to compare the kernels with: plain Python, line by line.

It shares no code with meshreg and follows http://paulbourke.net/dataformats/obj/ literally.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field


@dataclass
class PlainObj:
    vertices: list[tuple[float, float, float]] = field(default_factory=list)
    colors: list[tuple[float, float, float] | None] = field(default_factory=list)
    uvs: list[tuple[float, float]] = field(default_factory=list)
    normals: int = 0
    # Corners of each face as (vertex, texture vertex or None), both from 0.
    faces: list[list[tuple[int, int | None]]] = field(default_factory=list)
    materials: list[str | None] = field(default_factory=list)  # of each face
    libraries: list[str] = field(default_factory=list)


class PlainError(Exception):
    def __init__(self, line: int, text: str) -> None:
        super().__init__(f"line {line}: {text}")
        self.line = line


def logical_lines(text: str) -> list[tuple[int, str]]:
    """Split at LF, CRLF or CR; join geometry lines that end in a backslash."""
    physical = re.split(r"\r\n|\n|\r", text)
    lines = []
    number = 0
    while number < len(physical):
        start = number
        line = physical[number]
        number += 1
        word = line.split()[0] if line.split() else ""
        continues = word in ("v", "vt", "vn", "f", "l", "p")
        while continues and line.endswith("\\") and "#" not in line and number < len(physical):
            line = line[:-1] + " " + physical[number]
            number += 1
        lines.append((start + 1, line))
    return lines


def read_number(word: str, line: int) -> float:
    try:
        if "_" in word:
            raise ValueError
        return float(word)
    except ValueError:
        raise PlainError(line, f"{word} is not a number") from None


def parse_plain(text: str) -> PlainObj:
    obj = PlainObj()
    material = None
    for number, full in logical_lines(text):
        keyword = full.split()[0] if full.split() else ""
        if keyword in ("usemtl", "mtllib"):
            name = full.strip()[6:].strip()
            if keyword == "usemtl":
                material = name
            else:
                obj.libraries.append(name)
            continue
        words = re.split(r"(?:^|[ \t])#", full)[0].split()
        if not words:
            continue
        keyword, *rest = words
        if keyword == "v":
            values = [read_number(word, number) for word in rest]
            if len(values) not in (3, 4, 6, 7):
                raise PlainError(number, "wrong count of numbers")
            obj.vertices.append(tuple(values[:3]))
            obj.colors.append(tuple(values[3:6]) if len(values) >= 6 else None)
        elif keyword == "vt":
            values = [read_number(word, number) for word in rest]
            if not 1 <= len(values) <= 3:
                raise PlainError(number, "wrong count of numbers")
            obj.uvs.append((values[0], values[1] if len(values) > 1 else 0.0))
        elif keyword == "vn":
            obj.normals += 1
        elif keyword == "f":
            obj.faces.append([corner(word, obj, number) for word in rest])
            parts = {shape(word) for word in rest}
            if len(rest) < 3 or len(parts) > 1:
                raise PlainError(number, "cut off")
            obj.materials.append(material)
    for face in obj.faces:
        for vertex, uv in face:
            if not 0 <= vertex < len(obj.vertices):
                raise PlainError(0, "vertex out of range")
            if uv is not None and not 0 <= uv < len(obj.uvs):
                raise PlainError(0, "texture vertex out of range")
    return obj


def shape(word: str) -> tuple[bool, bool]:
    parts = [*word.split("/"), "", ""]
    return bool(parts[1]), bool(parts[2])


def corner(word: str, obj: PlainObj, line: int) -> tuple[int, int | None]:
    if not re.fullmatch(r"-?\d+(/(-?\d+)?(/(-?\d+)?)?)?", word):
        raise PlainError(line, f"{word} is no corner")
    parts = [*word.split("/"), "", ""]
    if any(part and int(part) == 0 for part in parts):
        raise PlainError(line, "index 0")

    def absolute(part: str, count: int) -> int:
        return int(part) - 1 if int(part) > 0 else count + int(part)

    uv = absolute(parts[1], len(obj.uvs)) if parts[1] else None
    return absolute(parts[0], len(obj.vertices)), uv
