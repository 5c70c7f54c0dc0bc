"""The container of a glTF 2.0 file: chunks, JSON, buffers and accessors, each checked.

Khronos Group, glTF 2.0 Specification (ISO/IEC 12113:2022), sections 3.5-3.7 and 4. Nothing is
allocated from a number in the file: an accessor is a view into bytes that are there.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError
from meshreg.io.files.safe import file_bytes, resolve_reference
from meshreg.records import Float64, UInt8

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_DAMAGED = "The file is cut off or damaged; export or copy it again."
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# Required extensions that change nothing that is read here, or are read.
_UNDERSTOOD = (
    "KHR_materials_",
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    "EXT_texture_webp",
    "CESIUM_RTC",
)
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


@dataclass(frozen=True, eq=False)
class Document:
    """A glTF file.

    Attributes
    ----------
    path : Path
    tree : dict
        The JSON.
    binary : (N,) uint8 or None
        The BIN chunk of a GLB.
    rest : (start, end)
        Bytes of a GLB after its JSON chunk.
    """

    path: Path
    tree: dict[str, Any]
    binary: UInt8 | None = None
    rest: tuple[int, int] = (0, 0)
    _loaded: dict[int, UInt8] = field(default_factory=dict, repr=False)
    _checked: dict[str, list[dict[str, Any]]] = field(default_factory=dict, repr=False)

    @property
    def is_binary(self) -> bool:
        """Whether it is a GLB."""
        return self.rest != (0, 0)

    def fail(self, message: str, place: str = "", remedy: str = _DAMAGED) -> NoReturn:
        """Raise the InputError that names this file."""
        raise InputError(message, file=self.path, place=place or None, remedy=remedy)

    def items(self, kind: str) -> list[dict[str, Any]]:
        """Return one of the top-level lists, every entry an object; empty where it is missing."""
        if kind not in self._checked:
            found = self.tree.get(kind, [])
            if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
                self.fail(f"has {kind!r} that is not a list of objects.")
            self._checked[kind] = found
        return self._checked[kind]

    def item(self, kind: str, index: Any, place: str) -> dict[str, Any]:
        """Return entry `index` of a top-level list."""
        found = self.items(kind)
        if type(index) is not int or not 0 <= index < len(found):
            self.fail(f"refers to {kind}[{str(index)[:40]}] of {len(found)}.", place)
        return found[index]

    def whole(self, owner: dict[str, Any], key: str, place: str, default: int | None = None) -> int:
        """Return a whole number, zero or more, from an object."""
        value = owner.get(key, default)
        if type(value) is not int or not 0 <= value < 2**53:
            self.fail(f"has {key} = {str(value)[:40]}, which is not a count.", place)
        return value

    def numbers(self, owner: dict[str, Any], key: str, count: int, place: str) -> Float64 | None:
        """Return a list of finite numbers from an object, or None where it is missing."""
        value = owner.get(key)
        if value is None:
            return None
        good = isinstance(value, list) and len(value) == count
        good = good and all(type(item) in (int, float) and abs(item) < 1e300 for item in value)
        if not good:
            self.fail(f"has {key} = {str(value)[:60]}, which is not {count} numbers.", place)
        return np.array(value, np.float64)

    def uris(self) -> Iterator[tuple[str, int, str]]:
        """Give kind, index and URI of all buffers and images that are other files."""
        for kind in ("buffers", "images"):
            for index, item in enumerate(self.items(kind)):
                uri = item.get("uri")
                if uri is not None and not isinstance(uri, str):
                    self.fail("has a uri that is not text.", f"{kind}[{index}]")
                if uri is not None and not uri.startswith("data:"):
                    yield kind, index, uri

    def outside(self, uri: str) -> Path:
        """Find a file that the document names; see `resolve_reference` for what is refused."""
        folder = self.path.parent
        return resolve_reference(folder, unquote_to_bytes(uri), root=folder)

    def data_uri(self, uri: str, place: str) -> bytes:
        """Decode a data: URI; its length is bounded by the file's."""
        head, comma, text = uri.partition(",")
        try:
            if not comma or not head.endswith(";base64"):
                raise ValueError
            return base64.b64decode(text, validate=True)
        except (ValueError, binascii.Error):
            self.fail("has a data: uri that is not base64.", place)

    def buffer(self, index: Any, place: str) -> UInt8:
        """Return the bytes of a buffer, at least as many as it declares."""
        item = self.item("buffers", index, place)
        place = f"buffers[{index}]"
        if index not in self._loaded:
            uri = item.get("uri")
            if uri is None:
                if index != 0 or self.binary is None:
                    self.fail("has no uri and no BIN chunk.", place)
                found = self.binary
            elif isinstance(uri, str) and uri.startswith("data:"):
                found = np.frombuffer(self.data_uri(uri, place), np.uint8)
            else:
                found = file_bytes(self.outside(str(uri)))
            self._loaded[index] = found
        found = self._loaded[index]
        length = self.whole(item, "byteLength", place)
        if length > len(found):
            self.fail(f"declares {length} bytes, but {len(found)} are there.", place)
        return found[:length]

    def view(self, index: Any, place: str) -> tuple[UInt8, int]:
        """Return the bytes of a buffer view and its stride (0: packed)."""
        item = self.item("bufferViews", index, place)
        place = f"bufferViews[{index}]"
        data = self.buffer(item.get("buffer"), place)
        start = self.whole(item, "byteOffset", place, 0)
        length = self.whole(item, "byteLength", place)
        stride = self.whole(item, "byteStride", place, 0)
        if start + length > len(data):
            self.fail(f"ends at byte {start + length} of a buffer of {len(data)}.", place)
        if stride and not (4 <= stride <= 252 and stride % 4 == 0):
            self.fail(f"has byteStride {stride}; it must be 4, 8, ... 252.", place)
        return data[start : start + length], stride

    def accessor(self, index: Any, place: str, widths: tuple[int, ...]) -> NDArray[Any]:
        """Return an accessor's values as stored: (count, width), a view into the buffer.

        Parameters
        ----------
        index : int
        place : str
            What refers to it, for messages.
        widths : tuple of int
            Numbers an element may have.
        """
        item = self.item("accessors", index, place)
        place = f"accessors[{index}]"
        if "sparse" in item or "bufferView" not in item:
            what = "is sparse" if "sparse" in item else "has no bufferView (all zero)"
            self.fail(f"{what}, which is not read.", place, "Export it without that.")
        code = item.get("componentType")
        kind = COMPONENTS.get(code) if type(code) is int else None
        width = _WIDTHS.get(str(item.get("type")))
        if kind is None or width is None or width not in widths:
            self.fail(
                f"holds {item.get('type')} of component type {item.get('componentType')}, "
                f"where {' or '.join(map(str, widths))} numbers each are expected.",
                place,
            )
        count = self.whole(item, "count", place)
        start = self.whole(item, "byteOffset", place, 0)
        data, stride = self.view(item["bufferView"], place)
        size = width * int(kind[1])
        stride = stride or size
        if stride < size or count < 1 or start + stride * (count - 1) + size > len(data):
            self.fail(
                f"declares {count} elements of {size} bytes every {stride} from byte {start}, "
                f"but its view has {len(data)} bytes.",
                place,
            )
        dtype = np.dtype("<" + kind)
        strides = (stride, dtype.itemsize)
        return np.ndarray((count, width), dtype, data.data, start, strides)

    def normalized(self, index: Any, place: str, widths: tuple[int, ...]) -> NDArray[Any]:
        """Return an accessor's values, integers of a normalized one brought to -1 ... 1.

        glTF 2.0, section 3.6.2.2.
        """
        values = self.accessor(index, place, widths)
        if values.dtype.kind == "f" or not self.items("accessors")[index].get("normalized"):
            return values
        return np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1.0)


def extension(owner: dict[str, Any], name: str) -> Any:
    """Return an object's extension of that name, or None."""
    extensions = owner.get("extensions")
    return extensions.get(name) if isinstance(extensions, dict) else None


def read_document(path: Path) -> Document:
    """Read a .glb or .gltf, told by its first bytes, and check its asset and extensions.

    Raises
    ------
    InputError
        Chunks that do not fill the file exactly, JSON that is none, another version than 2.x, a
        required extension that is not understood.
    """
    data = file_bytes(path)
    if bytes(data[:4]) == b"glTF":
        document = _read_glb(path, data)
    else:
        document = Document(path, _parse(path, bytes(data), 0))
    asset = document.tree.get("asset")
    version = str(asset.get("version")) if isinstance(asset, dict) else "none"
    least = str(asset.get("minVersion", "2.0")) if isinstance(asset, dict) else "2.0"
    if not version.startswith("2.") or least != "2.0":
        document.fail(
            f"is of glTF version {version[:20]}; 2.0 is read.", "asset", "Export it as glTF 2.0."
        )
    _check_extensions(document)
    return document


def _read_glb(path: Path, data: UInt8) -> Document:
    def fail(message: str, at: int) -> NoReturn:
        raise InputError(message, file=path, place=f"byte {at}", remedy=_DAMAGED)

    if len(data) < 20:
        fail(f"ends after {len(data)} bytes.", len(data))
    version, length = struct.unpack("<II", bytes(data[4:12]))
    if version != 2:
        fail(f"is GLB version {version}; 2 is read.", 4)
    if length != len(data):
        fail(f"declares a length of {length} bytes, but has {len(data)}.", 8)
    chunks = []
    here = 12
    while here < len(data):
        if here + 8 > len(data):
            fail("ends within the head of a chunk.", here)
        size, kind = struct.unpack("<II", bytes(data[here : here + 8]))
        if here + 8 + size > len(data) or size % 4:
            fail(f"has a chunk of {size} bytes, but {len(data) - here - 8} are there.", here)
        chunks.append((kind, here + 8, here + 8 + size))
        here += 8 + size
    kind, start, end = chunks[0]
    if kind != _JSON:
        fail("does not start with a JSON chunk.", 12)
    tree = _parse(path, bytes(data[start:end]), start)
    binary = None
    if len(chunks) > 1 and chunks[1][0] == _BIN:
        binary = data[chunks[1][1] : chunks[1][2]]
    return Document(path, tree, binary, (end, len(data)))


def _parse(path: Path, text: bytes, start: int) -> dict[str, Any]:
    def constant(name: str) -> NoReturn:
        raise ValueError(f"{name} is not a JSON number")

    try:
        tree = json.loads(text.decode("utf-8-sig"), parse_constant=constant)
    except RecursionError:
        raise InputError(
            "has JSON nested too deeply.", file=path, place=f"byte {start}", remedy=_DAMAGED
        ) from None
    except ValueError as error:
        at = start + getattr(error, "pos", getattr(error, "start", 0))
        raise InputError(
            f"has JSON that cannot be read: {str(error)[:100]}.",
            file=path,
            place=f"byte {at}",
            remedy=_DAMAGED,
        ) from error
    if not isinstance(tree, dict):
        raise InputError("is not glTF: its JSON is not an object.", file=path, remedy=_DAMAGED)
    return tree


def _check_extensions(document: Document) -> None:
    required = document.tree.get("extensionsRequired", [])
    if not isinstance(required, list):
        document.fail("has extensionsRequired that is not a list.")
    for name in map(str, required):
        if name in _COMPRESSED:
            document.fail(
                f"is compressed ({name}), which is not read.",
                "extensionsRequired",
                "Export it without compression.",
            )
        if not name.startswith(_UNDERSTOOD):
            document.fail(
                f"requires the extension {name[:60]}, which is not read.",
                "extensionsRequired",
                "Export it without that.",
            )
