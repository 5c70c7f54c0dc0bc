"""READ and WRITE STL: triangles without colors, binary or text.

An own reader, because the one number that must be checked (84 + 50 n bytes) is the format.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError, UsageError
from meshreg.io.assemble import Found, RawGeometry, assemble_survey
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.rewriting import (
    FINEST,
    Extent,
    float32_step,
    metres_per_file_unit,
    moved_points,
    require_unchanged,
    warn,
)
from meshreg.io.files.safe import file_bytes, open_regular
from meshreg.io.frames.directions import bend_note, find_directions
from meshreg.io.frames.mover import Mover
from meshreg.io.frames.sidecar import write_shift
from meshreg.io.masks.polygons import weld
from meshreg.io.options import ReadOptions
from meshreg.io.ply.text import read_numbers
from meshreg.io.second_reader import ANYTHING, SLACK, Expected, require_lines, require_rows
from meshreg.records import Float64, Frame, Mesh, SourceFile, Survey, UInt8

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_CORNER = (b"vertex", None, None, None)  # None: a number
_LOOP = (b"facet", b"normal", None, None, None, b"outer", b"loop", *_CORNER, *_CORNER, *_CORNER)
_WORDS = (*_LOOP, b"endloop", b"endfacet")
_SOLID = re.compile(rb"^[ \t]*(?:end)?solid\b[^\r\n]*", re.IGNORECASE | re.MULTILINE)
_TRIPLE = re.compile(
    rb"^([ \t]*(vertex|facet[ \t]+normal)[ \t]+)\S+[ \t]+\S+[ \t]+\S+", re.IGNORECASE | re.MULTILINE
)
_CHUNK = 1 << 18
_DAMAGED = "The file is cut off or damaged; export or copy it again."


def read(path: Path, options: ReadOptions) -> Survey:
    """Read an STL file; equal corners become one vertex.

    Parameters
    ----------
    path : Path
    options : ReadOptions

    Returns
    -------
    Survey

    Raises
    ------
    InputError
        A binary file of another size than its count of triangles says, text that is not whole
        facets, over 1 % of corners not finite.
    """
    data = file_bytes(path)
    if _is_binary(data, path):
        points = np.asarray(_facets(data)["corners"], np.float64).reshape(-1, 3)
        counts = {"faces": len(points) // 3, "single_precision": 1}
    else:
        points = _text_corners(bytes(data), path)
        counts = {"faces": len(points) // 3}
    new, kept = weld(points)
    raw = RawGeometry(points[kept], new.reshape(-1, 3))
    return assemble_survey(path, raw, Found("stl", counts=counts), options)


def _is_binary(data: UInt8, path: Path) -> bool:
    """Whether the size is that of a binary file; text may start with "solid" only if it is not."""
    if len(data) >= 84:
        count = int(np.frombuffer(data[80:84].tobytes(), "<u4")[0])
        if 84 + 50 * count == len(data):
            return True
    else:
        count = 0
    start = bytes(data[:512])
    if start.lstrip()[:5].lower() == b"solid" and b"\0" not in start:
        return False
    raise InputError(
        f"has {len(data)} bytes; {84 + 50 * count} belong to its {count} triangles.",
        file=path,
        place="byte 80",
        remedy=_DAMAGED,
    )


def _facets(data: UInt8) -> NDArray[Any]:
    return np.ndarray(((len(data) - 84) // 50,), _FACET, data.data, 84)


def _text_corners(text: bytes, path: Path) -> Float64:
    """Read the corners (3 F, 3) of a text file, every word checked."""
    marks = [line.split()[0].lower() for line in _SOLID.findall(text)]
    words = _SOLID.sub(b"", text).split()
    bad = []
    for at, wanted in enumerate(_WORDS):
        column = words[at :: len(_WORDS)]
        if wanted is not None and set(column) != {wanted}:
            wrong = (k for k, word in enumerate(column) if word.lower() != wanted)
            bad += [(k * len(_WORDS) + at, wanted) for k in [next(wrong, None)] if k is not None]
    if bad:
        at, wanted = min(bad)
        raise InputError(
            f"has {words[at][:40]!r} where {wanted!r} belongs.",
            file=path,
            place=f"facet {at // len(_WORDS) + 1}",
            remedy=_DAMAGED,
        )
    if (
        not words
        or len(words) % len(_WORDS)
        or marks != [b"solid", b"endsolid"] * (len(marks) // 2)
    ):
        raise InputError(
            f"ends after {len(words) // len(_WORDS)} facets without 'endsolid'.",
            file=path,
            place=f"byte {len(text)}",
            remedy=_DAMAGED,
        )
    n_facets = len(words) // len(_WORDS)
    if (found := sum(1 for _ in _TRIPLE.finditer(text))) != 4 * n_facets:
        raise InputError(
            f"has {n_facets} facets, but {found} lines of numbers; {4 * n_facets} belong to them.",
            file=path,
            remedy="Write each vertex and each normal on a line of its own; export it again.",
        )
    numbers = []
    for facet in range(0, len(words), len(_WORDS)):
        for at in (8, 12, 16):
            numbers += words[facet + at : facet + at + 3]
    joined = np.frombuffer(b"\n".join(numbers), np.uint8)
    try:
        return read_numbers(joined, 0, len(joined), len(numbers), path).reshape(-1, 3)
    except InputError as error:
        line = int((error.place or "line 1").split()[1])  # a number a line
        error.place = f"facet {(line - 1) // 9 + 1}"
        raise


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a mesh as binary STL about its origin, with a sidecar that holds the shift.

    Raises
    ------
    UsageError
        The survey is no mesh.
    OutputError
        It cannot be written.
    """
    mesh = survey.geometry
    if not isinstance(mesh, Mesh):
        raise UsageError("Only a mesh can be written as STL.", file=path, remedy="Use .ply.")
    extent = Extent()
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            stream.write(b"meshreg".ljust(80) + np.uint32(len(mesh.faces)).tobytes())
            for start in range(0, len(mesh.faces), _CHUNK):
                corners = mesh.vertices[mesh.faces[start : start + _CHUNK]]
                rows = np.zeros(len(corners), _FACET)
                rows["corners"] = corners
                normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
                length = np.sqrt((normal**2).sum(axis=1, keepdims=True))
                rows["normal"] = normal / np.where(length > 0, length, 1)
                extent.add(rows["corners"].reshape(-1, 3))
                stream.write(rows.data)
        extent.require_equal(_facets(file_bytes(temporary))["corners"].reshape(-1, 3), path)
    frame = Frame(shift=survey.origin, file_crs=survey.crs, crs=survey.crs)
    return (path, *write_shift(path, frame))


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of an STL file: corners and normals change, nothing else.

    Raises
    ------
    InputError
        The source is not what it was when read.
    OutputError
        It cannot be written, or does not read back as written.
    """
    require_unchanged(source, path)
    data = file_bytes(source.path)
    binary = _is_binary(data, source.path)
    if note := bend_note(find_directions(("nx", "ny", "nz")), move):
        warn(path, note)
    extent = Extent()
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            if binary:
                facets = _facets(data)
                step = float32_step(move, facets["corners"].reshape(-1, 3))
                if step > FINEST:
                    warn(path, f"binary STL holds float32 only, which steps by {step:.2g} m there.")
                stream.write(bytes(data[:84]))
                for start in range(0, len(facets), _CHUNK):
                    rows = facets[start : start + _CHUNK].copy()
                    corners = rows["corners"].reshape(-1, 3)
                    rows["normal"] = move.directions(corners[::3], rows["normal"])
                    rows["corners"] = moved_points(move, corners).reshape(-1, 3, 3)
                    extent.add(rows["corners"].reshape(-1, 3))
                    stream.write(rows.data)
            else:
                moved = moved_points(move, _text_corners(bytes(data), source.path))
                extent.add(moved)
                stream.write(_moved_text(bytes(data), move, moved))
        written = file_bytes(temporary)
        if binary:
            extent.require_equal(_facets(written)["corners"].reshape(-1, 3), path)
        else:
            tolerance = 1e-14 * float(np.abs(moved[np.isfinite(moved)]).max(initial=1))
            extent.require_equal(_text_corners(bytes(written), path), path, tolerance)
        _look_again(source.path, temporary, move, binary, path)
    return (path,)


def _look_again(old: Path, new: Path, move: Mover, binary: bool, path: Path) -> None:
    """Compare facets by the second reader."""
    slack = SLACK / metres_per_file_unit(move)

    def rule(words: list[bytes], number: int) -> Expected | None:
        del number
        kind = [word.lower() for word in words[:2]]
        if kind[:1] == [b"vertex"] and len(words) == 4:
            corner = np.array([[float(word) for word in words[1:]]])
            values = moved_points(move, corner)[0]
            return Expected((1, 2, 3), values, slack + 1e-14 * np.abs(values))
        if kind == [b"facet", b"normal"] and len(words) == 5:
            try:
                vector = np.array([[float(word) for word in words[2:]]])
            except ValueError:
                return ANYTHING
            return Expected((2, 3, 4), move.directions(vector, vector)[0], 1e-13)
        return ANYTHING if len(words) > 5 else None  # a whole facet in one line

    def facet(values: tuple[float, ...]) -> Expected:
        normal, corners = np.array([values[:3]]), np.reshape(values[3:12], (3, 3))
        new_normal = move.directions(corners[:1], normal)[0]
        numbers = np.concatenate([new_normal, moved_points(move, corners).ravel()])
        return Expected(range(12), numbers, slack + 1e-7 * np.abs(numbers))

    if not binary:
        require_lines(old, new, rule, path)
        return
    form = struct.Struct("<12fH")
    with open_regular(old) as before, open_regular(new) as after:
        before.seek(80)
        (count,) = struct.unpack("<I", before.read(4))
        require_rows(before, after, count, (form, form), (84, 84), facet, path)


def _moved_text(text: bytes, move: Mover, corners: Float64) -> bytes:
    """Replace the numbers after "vertex" and "facet normal"; the rest of the text stays.

    A normal that is no number (decimal commas, "-1.#IND") becomes that of its corners.
    """
    new = iter(corners.tolist())
    sides = np.diff(corners.reshape(-1, 3, 3), axis=1)
    own = iter(np.cross(sides[:, 0], sides[:, 1]))

    def replaced(match: re.Match[bytes]) -> bytes:
        if match[2].lower() == b"vertex":
            values = next(new)
        else:
            across = next(own)
            try:
                old = np.array([[float(word) for word in match[0].split()[2:]]])
                values = move.directions(np.zeros((1, 3)), old)[0].tolist()
            except ValueError:
                values = (across / (np.linalg.norm(across) or 1.0)).tolist()
        return match[1] + " ".join(f"{value:.15g}" for value in values).encode()

    return _TRIPLE.sub(replaced, text)
