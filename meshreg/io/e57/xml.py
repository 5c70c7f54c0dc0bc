"""The XML section of an E57 file, which describes scans, poses and fields; read without trust.

libE57Format hands this XML to a parser that follows external entities, so it is checked here
first; and a registration only has to rewrite the poses in it, so every other byte can stay.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from meshreg.errors import InputError, UnsafeReferenceError
from meshreg.io.e57.pages import (
    AGAIN,
    HEADER_SIZE,
    PAGE,
    PAYLOAD,
    check_header,
    logical_bytes,
    to_logical,
)
from meshreg.io.files.safe import open_regular, require_proportion
from meshreg.records import Float64

_PER_POINT = 100  # bytes of memory: coordinates, colors, and copies of them
MAX_DEPTH = 64


@dataclass(frozen=True)
class Field:
    """One field of a scan's points, as the prototype declares it; its width in bits."""

    name: str
    bits: int
    minimum: float
    maximum: float


@dataclass
class Entry:
    """One child of `data3D` (a scan) or `images2D` in the XML.

    `pose` is the byte span of its pose element, or the empty span where one can be put in.
    `rotation` is a unit quaternion w, x, y, z.
    """

    kind: str
    pose: tuple[int, int] = (0, 0)
    rotation: Float64 = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    translation: Float64 = field(default_factory=lambda: np.zeros(3))
    count: int = 0
    fields: dict[str, Field] = field(default_factory=dict)
    limits: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Layout:
    """What the header and the XML of an E57 file say."""

    xml: bytes
    xml_start: int
    xml_is_last: bool
    entries: tuple[Entry, ...]
    crs: str | None
    crs_span: tuple[int, int]

    @property
    def scans(self) -> tuple[Entry, ...]:
        """The scans, in file order."""
        return tuple(entry for entry in self.entries if entry.kind == "data3D")


def read_layout(path: Path) -> Layout:
    """Check header, pages and XML of an E57 file and list its scans; no point is read.

    Raises
    ------
    UnsafeReferenceError
        The XML holds a DOCTYPE or ENTITY declaration.
    InputError
        Not an E57 file, cut off, or an XML section that is not what the standard allows.
    ResourceLimitError
        An XML section over 100 MB.
    """
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        start, length = check_header(stream.read(HEADER_SIZE), size, path)
        logical_start = to_logical(start)
        xml = logical_bytes(stream, logical_start, length)
    if len(xml) != length:
        raise InputError("changed while it was read.", file=path, remedy="Read it again.")
    _refuse_declarations(xml, path)
    walk = _parse(xml, path)
    is_last = (logical_start + length + PAYLOAD - 1) // PAYLOAD * PAGE >= size
    layout = Layout(xml, logical_start, is_last, tuple(walk.entries), walk.crs, walk.crs_span)
    for number, scan in enumerate(layout.scans):
        _check_count(scan, number, size, path)
    total = sum(scan.count for scan in layout.scans)
    require_proportion(_PER_POINT * total, size, path, f"{total} points")
    return layout


def _refuse_declarations(xml: bytes, path: Path) -> None:
    """Let no document type or entity through, in whatever encoding it may hide."""
    text = xml.removeprefix(b"\xef\xbb\xbf")
    # The declaration may be padded: look at all of it.
    head = text[: text.find(b"?>") + 2] if text.startswith(b"<?xml") else b""
    declared = re.search(rb"encoding\s*=\s*[\"']([^\"']*)[\"']", head)
    encoding = declared.group(1).lower() if declared else b"utf-8"
    if not text.startswith(b"<") or b"\0" in xml or encoding not in (b"utf-8", b"us-ascii"):
        raise InputError(
            f"has an XML section that is not UTF-8 (declared as {encoding.decode('latin-1')!r}).",
            file=path,
            place="XML section",
            remedy=AGAIN,
        )
    found = re.search(rb"<!\s*(DOCTYPE|ENTITY)", xml, re.IGNORECASE)
    if found:
        raise UnsafeReferenceError(
            f"its XML section holds a {found.group(1).decode().upper()} declaration, by which a "
            "file can read others on this machine.",
            file=path,
            place=f"byte {found.start()} of the XML section",
            remedy="Ask where the file comes from; export it again from the scanner's software.",
        )


def _parse(xml: bytes, path: Path) -> _Walk:
    walk = _Walk(xml, path)
    try:
        walk.parser.Parse(xml, True)
    except expat.ExpatError as error:
        raise InputError(
            f"has an XML section that cannot be read: {error}.",
            file=path,
            place="XML section",
            remedy=AGAIN,
        ) from error
    except ValueError as error:
        raise InputError(
            f"has a value in its XML section that is not a number: {error}.",
            file=path,
            place=f"line {walk.parser.CurrentLineNumber} of the XML section",
            remedy=AGAIN,
        ) from error
    return walk


class _Walk:
    """Goes through the XML once; keeps scans, poses and where in the bytes each pose lies."""

    def __init__(self, xml: bytes, path: Path) -> None:
        self.xml, self.path = xml, path
        self.stack: list[str] = []
        self.text, self.childless = "", False
        self.entries: list[Entry] = []
        self.crs: str | None = None
        self.crs_span = (0, 0)
        self.pose_start = -1
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self.start
        self.parser.EndElementHandler = self.end
        self.parser.CharacterDataHandler = self.characters

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self.stack.append(name)
        self.text, self.childless = "", True
        if len(self.stack) > MAX_DEPTH:
            raise InputError(
                f"nests its XML deeper than {MAX_DEPTH} elements.",
                file=self.path,
                place="XML section",
                remedy=AGAIN,
            )
        if self.stack == ["e57Root", "coordinateMetadata"]:
            self.crs_span = (self.parser.CurrentByteIndex, 0)
        elif len(self.stack) == 3 and name == "vectorChild":
            self.entries.append(Entry(self.stack[1]))
        elif len(self.stack) >= 4 and self.entries:
            self._start_in_entry(name, attributes)

    def _start_in_entry(self, name: str, attributes: dict[str, str]) -> None:
        entry, inner = self.entries[-1], self.stack[3:]
        if inner == ["pose"]:
            self.pose_start = self.parser.CurrentByteIndex
        elif inner == ["points"]:
            entry.count = int(attributes.get("recordCount", "0"))
        elif len(inner) == 3 and inner[:2] == ["points", "prototype"]:
            entry.fields[name] = _field(name, attributes)

    def _tag_end(self) -> int:
        """Return where the element whose end is being reported ends.

        expat points at its end tag, but behind it where it is written as one empty tag.
        """
        here = self.parser.CurrentByteIndex
        if self.childless and self.xml[here - 2 : here] == b"/>":
            return here
        return self.xml.index(b">", here) + 1

    def characters(self, text: str) -> None:
        self.text += text

    def end(self, name: str) -> None:
        inner, text = self.stack[3:], self.text.strip()
        if self.stack == ["e57Root", "coordinateMetadata"]:
            self.crs, self.crs_span = text or None, (self.crs_span[0], self._tag_end())
        elif self.stack == ["e57Root"] and not self.crs_span[1]:  # a place for one
            self.crs_span = (self.parser.CurrentByteIndex,) * 2
        elif len(self.stack) == 3 and name == "vectorChild" and self.entries:
            if self.pose_start < 0:  # a place for one: just before the end tag
                self.entries[-1].pose = (self.parser.CurrentByteIndex,) * 2
            self.pose_start = -1
        elif inner and self.entries:
            self._end_in_entry(inner, text)
        self.stack.pop()
        self.text, self.childless = "", False

    def _end_in_entry(self, inner: list[str], text: str) -> None:
        entry = self.entries[-1]
        if inner == ["pose"]:
            entry.pose = (self.pose_start, self._tag_end())
            entry.rotation = _unit(entry.rotation, self.path)
        elif len(inner) == 3 and inner[:2] == ["pose", "rotation"] and inner[2] in "wxyz":
            entry.rotation["wxyz".index(inner[2])] = float(text or 0)
        elif len(inner) == 3 and inner[:2] == ["pose", "translation"] and inner[2] in "xyz":
            entry.translation["xyz".index(inner[2])] = float(text or 0)
        elif len(inner) == 2 and inner[0] == "colorLimits":
            entry.limits[inner[1]] = float(text or 0)


def _unit(quaternion: Float64, path: Path) -> Float64:
    norm = float(np.linalg.norm(quaternion))
    if not (np.isfinite(norm) and norm > 1e-6):
        raise InputError(
            f"has a pose whose rotation is {quaternion.tolist()}, which is not a rotation.",
            file=path,
            place="XML section",
            remedy=AGAIN,
        )
    return quaternion / norm


def _field(name: str, attributes: dict[str, str]) -> Field:
    """Read one element of a prototype (E2807 section 8.3; whole numbers are packed in bits)."""
    low, high = attributes.get("minimum"), attributes.get("maximum")
    if attributes.get("type") == "Float":
        bits = 32 if attributes.get("precision") == "single" else 64
        return Field(name, bits, float(low or "-inf"), float(high or "inf"))
    first = -(2**63) if low is None else int(low)
    last = 2**63 - 1 if high is None else int(high)
    return Field(name, max(last - first, 0).bit_length(), first, last)


def _check_count(scan: Entry, number: int, size: int, path: Path) -> None:
    bits = max(sum(item.bits for item in scan.fields.values()), 1)
    if scan.count < 0 or scan.count * bits > size * 8:
        raise InputError(
            f"declares {scan.count} points of {bits} bits each, but the file has {size} bytes.",
            file=path,
            place=f"scan {number + 1}",
            remedy=AGAIN,
        )


def with_poses(layout: Layout, poses: list[tuple[Float64, Float64]], crs: str | None) -> bytes:
    """Return the XML with every pose and the CRS replaced, all other bytes kept.

    Parameters
    ----------
    layout : Layout
    poses : list of (rotation, translation)
        Unit quaternion w, x, y, z and metres, one for each of `layout.entries`.
    crs : str or None
        The CRS that the new coordinates are in.
    """
    edits = [
        (*entry.pose, _pose_text(*pose)) for entry, pose in zip(layout.entries, poses, strict=True)
    ]
    if crs != layout.crs:
        text = f'<coordinateMetadata type="String"><![CDATA[{crs or ""}]]></coordinateMetadata>'
        edits.append((*layout.crs_span, text.encode()))
    xml = layout.xml
    for start, stop, text_bytes in sorted(edits, reverse=True):
        xml = xml[:start] + text_bytes + xml[stop:]
    return xml


def _pose_text(rotation: Float64, translation: Float64) -> bytes:
    def values(names: str, numbers: Float64) -> str:
        return "".join(
            f'<{name} type="Float">{float(number)!r}</{name}>'
            for name, number in zip(names, numbers, strict=True)
        )

    return (
        '<pose type="Structure"><rotation type="Structure">'
        + values("wxyz", rotation)
        + '</rotation><translation type="Structure">'
        + values("xyz", translation)
        + "</translation></pose>"
    ).encode("ascii")
