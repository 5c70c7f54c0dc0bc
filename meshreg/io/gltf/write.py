"""WRITE GLB: a survey from memory."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import OutputError, UsageError
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.images import EncodedImage
from meshreg.io.files.rewriting import require_close
from meshreg.io.files.safe import file_bytes
from meshreg.io.frames.axes import Y_UP
from meshreg.io.frames.sidecar import write_shift
from meshreg.io.gltf.document import read_document
from meshreg.io.gltf.parts import read_geometry
from meshreg.records import Frame, Mesh, PointCloud, Survey, Texture

MOST_BYTES = 2**32 - 1  # of a GLB
_MIME = {"JPEG": "image/jpeg", "PNG": "image/png"}
_SIZES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_CODES = {"|u1": 5121, "<u4": 5125, "<f4": 5126}


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a survey as GLB: Y-up, float32 about its origin, the origin in a node.

    Texture pages are embedded, JPEG and PNG ones byte for byte, others as PNG; vertices are
    repeated where texture coordinates differ, as the format wants.

    Parameters
    ----------
    survey : Survey
    path : Path
        Ending in .glb.

    Returns
    -------
    tuple of Path
        The file and, where the survey has a CRS, the sidecar that states it.

    Raises
    ------
    UsageError
        The survey is maps.
    OutputError
        It cannot be written, or would be larger than the format's 4 GiB.
    """
    geometry = survey.geometry
    if not isinstance(geometry, (Mesh, PointCloud)):
        raise UsageError("Maps cannot be written as glTF.", file=path, remedy="Use .tif.")
    builder = _Builder()
    if isinstance(geometry, PointCloud):
        rows = np.arange(len(geometry.points))
        primitives = [_primitive(builder, geometry, rows, None, None, mode=0)]
    else:
        primitives = _mesh_primitives(builder, geometry)
    origin = survey.origin @ Y_UP  # the inverse of a rotation is its transpose
    builder.tree["meshes"] = [{"primitives": primitives}]
    builder.tree["nodes"] = [{"mesh": 0, "name": survey.name, "translation": origin.tolist()}]
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            _write_glb(stream, builder.tree, builder.blobs, builder.size, path)
        again = read_geometry(read_document(temporary)) @ Y_UP.T
        local = np.concatenate([geometry.points[rows] for rows in builder.rows])
        tolerance = 2e-7 * np.abs(local).max(initial=0) + 1e-15 * np.abs(survey.origin).max()
        require_close(again, local + survey.origin, tolerance, path)
    frame = Frame(Y_UP, file_crs=survey.crs, crs=survey.crs) if survey.crs else Frame()
    return (path, *write_shift(path, frame))


class _Builder:
    """Collects the binary chunk and the JSON that describes it.

    `rows` holds, for each primitive, the points of the survey that its vertices are.
    """

    def __init__(self) -> None:
        self.blobs: list[Any] = []
        self.size = 0
        self.rows: list[NDArray[Any]] = []
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "meshreg"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "buffers": [],
            "bufferViews": [],
            "accessors": [],
        }

    def view(self, blob: Any, target: int | None = None) -> int:
        """Add bytes, aligned to four, as a buffer view."""
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.size, "byteLength": len(blob)}
        if target is not None:
            view["target"] = target
        padding = -len(blob) % 4
        self.blobs += [blob, bytes(padding)]
        self.size += len(blob) + padding
        self.tree["bufferViews"].append(view)
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, values: NDArray[Any], normalized: bool = False, ends: bool = False) -> int:
        """Add an array (N, width) or, for indices, (N,)."""
        values = np.ascontiguousarray(values)
        width = 1 if values.ndim == 1 else values.shape[1]
        target = 34963 if values.ndim == 1 else 34962  # indices, attributes
        item: dict[str, Any] = {
            "bufferView": self.view(values.data.cast("B"), target),
            "componentType": _CODES[values.dtype.str],
            "count": len(values),
            "type": _SIZES[width],
        }
        if normalized:
            item["normalized"] = True
        if ends:
            item["min"], item["max"] = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        self.tree["accessors"].append(item)
        return len(self.tree["accessors"]) - 1


def _mesh_primitives(builder: _Builder, mesh: Mesh) -> list[dict[str, Any]]:
    """Make one primitive of each texture page, and one of the faces without."""
    if mesh.uv is None or mesh.face_texture is None:
        rows, index = np.unique(mesh.faces, return_inverse=True)
        return [_primitive(builder, mesh, rows, index.reshape(-1), None)]
    primitives = []
    for page in np.unique(mesh.face_texture).tolist():
        chosen = mesh.face_texture == page
        corners = mesh.faces[chosen].reshape(-1)
        if page < 0:
            rows, index = np.unique(corners, return_inverse=True)
            primitives.append(_primitive(builder, mesh, rows, index, None))
            continue
        uv = mesh.uv[chosen].reshape(-1, 2)
        order = np.lexsort((uv[:, 1], uv[:, 0], corners))
        sorted_uv, sorted_corners = uv[order], corners[order]
        fresh = np.ones(len(order), np.bool_)
        fresh[1:] = (sorted_uv[1:] != sorted_uv[:-1]).any(axis=1)
        fresh[1:] |= sorted_corners[1:] != sorted_corners[:-1]
        index = np.empty(len(order), np.int64)
        index[order] = np.cumsum(fresh) - 1
        down = np.stack([sorted_uv[fresh, 0], np.float32(1) - sorted_uv[fresh, 1]], axis=1)
        primitive = _primitive(builder, mesh, sorted_corners[fresh], index, down)
        primitive["material"] = _material(builder, mesh.textures[page])
        primitives.append(primitive)
    return primitives


def _primitive(
    builder: _Builder,
    geometry: Mesh | PointCloud,
    rows: NDArray[Any],
    index: NDArray[Any] | None,
    uv: NDArray[np.float32] | None,
    mode: int = 4,
) -> dict[str, Any]:
    builder.rows.append(rows)
    points = (geometry.points[rows] @ Y_UP).astype("<f4")
    attributes = {"POSITION": builder.accessor(points, ends=True)}
    if geometry.colors is not None:
        # Four bytes each, because an element must start at a multiple of four.
        rgba = np.full((len(rows), 4), 255, np.uint8)
        rgba[:, :3] = geometry.colors[rows]
        attributes["COLOR_0"] = builder.accessor(rgba, normalized=True)
    if uv is not None:
        attributes["TEXCOORD_0"] = builder.accessor(uv.astype("<f4"))
    primitive: dict[str, Any] = {"attributes": attributes, "mode": mode}
    if index is not None:
        primitive["indices"] = builder.accessor(index.astype("<u4"))
    return primitive


def _material(builder: _Builder, texture: Texture) -> int:
    """Add a page as image, texture and unlit material; return the material's number."""
    load = texture.load
    kind = load.kind if isinstance(load, EncodedImage) else ""
    if isinstance(load, EncodedImage) and kind in _MIME:
        blob = load.data if load.path is None else bytes(file_bytes(load.path))
        assert blob is not None
    else:
        from PIL import Image

        stream, kind = io.BytesIO(), "PNG"
        Image.fromarray(load()).save(stream, format="PNG", compress_level=3)
        blob = stream.getvalue()
    tree = builder.tree
    tree.setdefault("images", []).append(
        {"bufferView": builder.view(blob), "mimeType": _MIME[kind], "name": texture.name}
    )
    wrap = 33071 if texture.clamp else 10497
    tree.setdefault("samplers", []).append({"wrapS": wrap, "wrapT": wrap})
    number = len(tree["images"]) - 1
    tree.setdefault("textures", []).append({"source": number, "sampler": number})
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    material = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": number}, "metallicFactor": 0.0},
        "extensions": {"KHR_materials_unlit": {}},
        "doubleSided": True,
    }
    tree.setdefault("materials", []).append(material)
    return len(tree["materials"]) - 1


def _write_glb(
    stream: BinaryIO, tree: dict[str, Any], blobs: list[Any], size: int, path: Path
) -> None:
    tree["buffers"] = [{"byteLength": size}]
    text = padded(json.dumps(tree, ensure_ascii=False, separators=(",", ":")).encode())
    total = 12 + 8 + len(text) + 8 + size
    require_size(total, path)
    stream.write(struct.pack("<4sIIII", b"glTF", 2, total, len(text), 0x4E4F534A))
    stream.write(text)
    stream.write(struct.pack("<II", size, 0x004E4942))
    stream.writelines(blobs)


def padded(text: bytes) -> bytes:
    """Fill up JSON with blanks to a multiple of four bytes."""
    return text + b" " * (-len(text) % 4)


def require_size(total: int, path: Path) -> None:
    """Refuse what the format cannot hold."""
    if total > MOST_BYTES:
        raise OutputError(
            f"would have {total} bytes; a GLB holds at most {MOST_BYTES}.",
            file=path,
            remedy="Write it as .obj or .ply.",
        )
