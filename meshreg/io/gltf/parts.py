"""The primitives of a glTF scene, each in place: points, triangles, colors, coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import ResourceLimitError
from meshreg.io.assemble import eight_bit_colors
from meshreg.io.files.safe import require_proportion
from meshreg.io.gltf.document import Document, extension
from meshreg.io.gltf.nodes import mesh_instances
from meshreg.io.gltf.texture import Pages
from meshreg.io.options import ReadOptions
from meshreg.records import Float64, Int32

_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6
_PER_POINT = 100  # bytes of memory: coordinates, texture coordinates, and copies of them
_MOST_REPEATED = 20  # times that instances may multiply what the file holds


@dataclass(frozen=True, eq=False)
class Part:
    """One primitive in place: points (V, 3) float64 in file coordinates, and what is on them.

    `faces` (F, 3) int32 is None for points; `colors` (V, 3) uint8; `uv` (V, 2) float32 with v
    upward; `page` is a number among the textures or -1.
    """

    points: Float64
    faces: Int32 | None
    colors: NDArray[np.uint8] | None = None
    uv: NDArray[np.float32] | None = None
    page: int = -1


@dataclass(eq=False)
class Notes:
    """What is said once however many primitives it concerns."""

    lines: int = 0
    loose_points: int = 0
    texts: list[str] = field(default_factory=list)

    def all(self) -> list[str]:
        """Return all sentences, each once."""
        said = list(dict.fromkeys(self.texts))
        if self.lines:
            said.append(f"{self.lines} primitives of lines were left out.")
        if self.loose_points:
            said.append(f"{self.loose_points} primitives of points beside triangles were left out.")
        return said


def read_parts(document: Document, pages: Pages, notes: Notes) -> list[Part]:
    """Read every primitive of every instance, triangles only where there are any."""
    instances = mesh_instances(document)
    _require_bounded(document, instances)
    parts = []
    for mesh, matrix in instances:
        for number, primitive in enumerate(_primitives(document, mesh)):
            mode = primitive.get("mode", _TRIANGLES)
            here = f"meshes[{mesh}].primitives[{number}]"
            if mode in (_POINTS, _TRIANGLES, _STRIP, _FAN):
                parts.append(_part(document, primitive, matrix, pages, here))
            elif mode in (1, 2, 3):
                notes.lines += 1
            else:
                document.fail(f"has mode {str(mode)[:20]}, which is none.", here)
    if not parts:
        document.fail("shows no triangles and no points in its scene.", "scene")
    meshes = [part for part in parts if part.faces is not None]
    if meshes:
        notes.loose_points = len(parts) - len(meshes)
    return meshes or parts


def read_geometry(document: Document) -> Float64:
    """Return all points of a scene in the file's own coordinates, (V, 3) float64, in its order."""
    options = ReadOptions(geometry_only=True)
    parts = read_parts(document, Pages(document, options, []), Notes())
    return np.concatenate([part.points for part in parts])


def _require_bounded(document: Document, instances: list[tuple[int, Float64]]) -> None:
    """Refuse instances that multiply a small file into a huge survey, and over 2^31 points."""
    accessors = document.items("accessors")
    total = 0
    for mesh, _ in instances:
        for primitive in _primitives(document, mesh):
            attributes = primitive.get("attributes")
            position = attributes.get("POSITION") if isinstance(attributes, dict) else None
            for index in (position, primitive.get("indices")):
                if type(index) is int and 0 <= index < len(accessors):
                    count = accessors[index].get("count")
                    total += count if type(count) is int else 0
    held = sum(document.whole(item, "byteLength", "buffers") for item in document.items("buffers"))
    if total > _MOST_REPEATED * held + 1_000_000 or total >= 2**31:
        raise ResourceLimitError(
            f"shows {total} points and indices by repeating what its {held} bytes hold.",
            file=document.path,
            remedy="Export the survey as one mesh.",
        )
    require_proportion(_PER_POINT * total, held, document.path, f"{total} points and indices")


def _primitives(document: Document, mesh: int) -> list[dict[str, Any]]:
    found = document.items("meshes")[mesh].get("primitives")
    if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
        document.fail("has primitives that are not a list of objects.", f"meshes[{mesh}]")
    return found


def _part(
    document: Document, primitive: dict[str, Any], matrix: Float64, pages: Pages, place: str
) -> Part:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or "POSITION" not in attributes:
        document.fail("has no POSITION.", place)
    if extension(primitive, "KHR_draco_mesh_compression") is not None:
        document.fail(
            "is compressed (KHR_draco_mesh_compression), which is not read.",
            place,
            "Export it without compression.",
        )
    stored = document.normalized(attributes["POSITION"], place, (3,))
    if stored.dtype.kind != "f" and "KHR_mesh_quantization" not in document.tree.get(
        "extensionsRequired", []
    ):
        document.fail(f"has positions of type {stored.dtype}.", place)
    with np.errstate(invalid="ignore"):  # NaN and infinity are dropped later, and counted
        points = stored.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    count = len(points)
    faces = _faces(document, primitive, count, place)
    if faces is not None and np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    colors = None
    if "COLOR_0" in attributes:
        values = document.normalized(attributes["COLOR_0"], place, (3, 4))
        _require_count(document, len(values), count, "COLOR_0", place)
        if values.dtype.kind != "u":  # unnormalized integers are not allowed, but meant so
            values = np.clip(np.nan_to_num(values), 0.0, 1.0)
        colors, _ = eight_bit_colors(values[:, :3])
    page, set_name, change = pages.of(primitive, place)
    uv = None
    if page >= 0 and faces is not None:
        if set_name not in attributes:
            document.fail(f"has a texture, but no {set_name}.", place)
        uv = document.normalized(attributes[set_name], place, (2,)).astype(np.float32)
        _require_count(document, len(uv), count, set_name, place)
        uv = change(uv)
    return Part(points, faces, colors, uv, page if uv is not None else -1)


def _require_count(document: Document, have: int, want: int, name: str, place: str) -> None:
    if have != want:
        document.fail(f"has {want} positions, but {have} of {name}.", place)


def _faces(document: Document, primitive: dict[str, Any], count: int, place: str) -> Int32 | None:
    """Return (F, 3) int32 within `count` points, or None for a primitive of points."""
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _POINTS:
        return None
    if count < 3:
        document.fail(f"has triangles of {count} points.", place)
    if primitive.get("indices") is None:
        index = np.arange(count, dtype=np.int32)
    else:
        stored = document.accessor(primitive["indices"], place, (1,))[:, 0]
        if stored.dtype.kind != "u":
            document.fail(f"has indices of type {stored.dtype}.", place)
        if int(stored.max()) >= count:
            at = int(np.flatnonzero(stored >= count)[0])
            document.fail(
                f"refers to vertex {int(stored[at])} of {count} (counted from 0).",
                f"{place} face {at // 3 + 1}",
            )
        index = stored.astype(np.int32)
    if mode == _TRIANGLES or len(index) < 3:
        if len(index) % 3:
            document.fail(f"has {len(index)} corners, which make no whole triangles.", place)
        return index.reshape(-1, 3)
    if mode == _FAN:
        return np.stack([np.full(len(index) - 2, index[0]), index[1:-1], index[2:]], axis=1)
    strip = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    strip[1::2, :2] = strip[1::2, 1::-1]
    return np.ascontiguousarray(strip)
