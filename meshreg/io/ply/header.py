"""The header of a PLY file: what is declared, checked before a byte of the body is read.

G. Turk, The PLY polygon file format, Stanford 1994; `comment TextureFile` as MeshLab writes it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from meshreg.errors import InputError
from meshreg.io.files.safe import open_regular, require

MAX_HEADER = 1 << 20
_MAX_LINES = 5000  # of elements and properties
_DAMAGED = "The file is damaged or no PLY file; export or copy it again."
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip


@dataclass(frozen=True)
class Property:
    """One column of an element: a numpy type without byte order, and for lists the count's."""

    name: str
    kind: str
    count_kind: str = ""
    line: int = 0  # of the header, from 0

    @property
    def least_bytes(self) -> int:
        """Bytes of one value; for a list those of an empty one."""
        return int((self.count_kind or self.kind)[1])


@dataclass(frozen=True)
class Element:
    """One table of the file; `line` is where the header declares it, from 0."""

    name: str
    count: int
    properties: tuple[Property, ...]
    line: int = 0

    def column(self, *names: str) -> int | None:
        """Return the number of the first property that has one of these names, or None."""
        for wanted in names:
            for number, item in enumerate(self.properties):
                if item.name == wanted:
                    return number
        return None

    @property
    def has_lists(self) -> bool:
        """Whether rows may differ in length."""
        return any(item.count_kind for item in self.properties)


@dataclass(frozen=True)
class Header:
    """A PLY header.

    Attributes
    ----------
    order : "", "<" or ">"
        Text, little endian or big endian.
    elements : tuple of Element
    textures : tuple of bytes
        Names of the texture pages, in the order of their comments.
    lines : tuple of bytes
        The header's lines as they are, with their ends; together `size` bytes.
    size : int
    """

    order: str
    elements: tuple[Element, ...]
    textures: tuple[bytes, ...]
    lines: tuple[bytes, ...]
    size: int

    def element(self, name: str) -> Element | None:
        """Return the element of that name, or None."""
        return next((item for item in self.elements if item.name == name), None)


def read_header(path: Path) -> Header:
    """Read and check the header of a PLY file.

    Raises
    ------
    InputError
        Anything that the format does not allow, or counts that the file's size cannot hold.
    """
    with open_regular(path) as stream:
        start = stream.read(MAX_HEADER)
        total = stream.seek(0, 2)
    if not start:
        raise InputError("is empty.", file=path, remedy="Export or copy it again.")
    lines = _split(start, path)
    order, textures = None, []
    drafts: list[tuple[str, int, int, list[Property]]] = []
    for number, line in enumerate(lines[1:-1], start=1):
        place = f"line {number + 1}"
        words = line.decode("latin-1").split()
        match words:
            case [] | ["comment"] | ["obj_info", *_]:
                continue
            case ["comment", word, *_]:
                if word.lower() == "texturefile":
                    textures.append(line.strip()[len("comment") :].strip()[len(word) :].strip())
            case ["format", word, version] if order is None and not drafts:
                if word not in _ORDERS or version != "1.0":
                    raise InputError(
                        f"has format '{word} {version}'; known are {', '.join(_ORDERS)} 1.0.",
                        file=path,
                        place=place,
                        remedy=_DAMAGED,
                    )
                order = _ORDERS[word]
            case ["element", name, count]:
                if any(name == draft[0] for draft in drafts):
                    raise _bad(f"declares element {name!r} twice", path, place)
                drafts.append((name, _count(count, name, path, place), number, []))
            case ["property", *rest] if drafts:
                drafts[-1][3].append(_property(rest, number, drafts[-1][3], path, place))
            case _:
                raise _bad(
                    f"has a line that means nothing here: {' '.join(words)[:80]!r}", path, place
                )
    if order is None:
        raise _bad("states no format", path, "header")
    elements = tuple(Element(name, n, tuple(items), at) for name, n, at, items in drafts)
    size = sum(map(len, lines))
    header = Header(order, elements, tuple(textures), tuple(lines), size)
    _require_sizes(header, total - size, path)
    return header


def _bad(what: str, path: Path, place: str) -> InputError:
    return InputError(f"{what}.", file=path, place=place, remedy=_DAMAGED)


def _split(start: bytes, path: Path) -> list[bytes]:
    """Cut the header into lines that keep their ends (LF, CRLF or CR)."""
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", start)
    if not first:
        raise InputError("does not start with 'ply'.", file=path, place="byte 0", remedy=_DAMAGED)
    # A lone CR ends lines only in a file whose first line says so: in any other, a byte of the
    # body that happens to be CR or LF would be taken for part of the header.
    end = rb"\r" if first[1] == b"\r" else rb"\r?\n"
    last = re.search(rb"(?:^|[\r\n])(end_header[ \t]*" + end + rb")", start)
    if not last:
        raise InputError(
            f"has no 'end_header' within its first {MAX_HEADER} bytes.",
            file=path,
            place=f"byte {len(start)}",
            remedy=_DAMAGED,
        )
    lines = re.findall(rb"[^\r\n]*(?:\r\n|\n|\r)", start[: last.start(1)])
    declared = sum(line.lstrip()[:8] in (b"element ", b"property") for line in lines)
    if declared > _MAX_LINES:
        raise _bad(f"declares {declared} elements and properties", path, "header")
    return [*lines, last[1]]


def _count(text: str, name: str, path: Path, place: str) -> int:
    if not re.fullmatch(r"[0-9]{1,18}", text):
        raise _bad(f"declares {text[:40]} of element {name!r}, which is not a count", path, place)
    return int(text)


def _property(
    words: list[str], line: int, before: list[Property], path: Path, place: str
) -> Property:
    match words:
        case ["list", count, kind, name]:
            kinds = (count, kind)
        case [kind, name]:
            kinds = ("uchar", kind)
        case _:
            raise _bad(f"has a property that cannot be read: {' '.join(words)[:80]!r}", path, place)
    for word in kinds:
        if word not in _TYPES:
            raise _bad(f"has property {name!r} of unknown type {word!r}", path, place)
    if any(name == other.name for other in before):
        raise _bad(f"declares property {name!r} twice", path, place)
    if len(words) == 2:
        return Property(name, _TYPES[kind], "", line)
    if _TYPES[count] not in ("i1", "u1", "i2", "u2", "i4", "u4"):
        raise _bad(
            f"counts the list {name!r} in {count!r}, which is not an integer type", path, place
        )
    return Property(name, _TYPES[kind], _TYPES[count], line)


def _require_sizes(header: Header, available: int, path: Path) -> None:
    """Check that the smallest body which the header allows fits into the file."""
    if not header.order:
        available += 1  # the last line needs no end
    for element in header.elements:
        place = f"line {element.line + 1}"
        if not element.properties and element.count:
            raise _bad(f"declares element {element.name!r} without a property", path, place)
        if header.order:
            least = sum(item.least_bytes for item in element.properties)
        else:
            least = 2 * len(element.properties)  # a digit and a blank or line end
        require(element.count, least, available, path, place, f"rows of element {element.name!r}")
        available -= element.count * least
