"""WRITE glTF: a moved copy of a .glb or .gltf, by one more node above each root."""

from __future__ import annotations

import copy
import json
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from meshreg.errors import InputError
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.rewriting import (
    copy_companions,
    metres_per_file_unit,
    require_close,
    require_unchanged,
)
from meshreg.io.files.safe import file_bytes
from meshreg.io.frames.mover import Mover
from meshreg.io.gltf.center import center_of, with_center
from meshreg.io.gltf.document import Document, read_document
from meshreg.io.gltf.nodes import roots_of, scene_roots
from meshreg.io.gltf.parts import read_geometry
from meshreg.io.gltf.write import padded, require_size
from meshreg.io.second_reader import require_glb
from meshreg.records import Float64, SourceFile

_BENT = 1e-3  # most that a change of CRS may bend a survey moved by one matrix [m]
_BLOCK = 1 << 24


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of a .glb or .gltf: the transform goes into a node above each root.

    Geometry, textures and everything else stay as they are.

    Parameters
    ----------
    source : SourceFile
    move : Mover
    path : Path
        Of the same suffix as the source.

    Returns
    -------
    tuple of Path
        The file, then copies of the files that it names.

    Raises
    ------
    InputError
        The source is not what it was when read, or the change of CRS bends it by over 1 mm.
    OutputError
        It cannot be written, or does not read back as written.
    """
    require_unchanged(source, path)
    document = read_document(source.path)
    points = read_geometry(document)
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    require_writable(source, move, points[finite[:: max(1, len(finite) // 1000)]])
    expected = points @ move.matrix[:3, :3].T + move.matrix[:3, 3]
    tree = _with_matrix(document, move.matrix)
    _rename(document, source, tree)
    _recenter(document, source, move, tree)
    text = json.dumps(tree, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    copies = copy_companions(source, path)
    with atomic_file(path) as temporary:
        with open(temporary, "wb") as stream:
            if document.is_binary:
                data, (start, end) = file_bytes(source.path), document.rest
                text = padded(text)
                total = 20 + len(text) + end - start
                require_size(total, path)
                stream.write(struct.pack("<4sIIII", b"glTF", 2, total, len(text), 0x4E4F534A))
                stream.write(text)
                for here in range(start, end, _BLOCK):
                    stream.write(data[here : min(here + _BLOCK, end)].data)
            else:
                stream.write(text)
        again = read_geometry(read_document(temporary))
        tolerance = 1e-12 * (np.abs(expected).max(initial=0) + np.abs(points).max(initial=0))
        require_close(again, expected, tolerance, path)
        require_glb(source.path, temporary, move.matrix, path)
    return (path, *copies)


def require_writable(source: SourceFile, move: Mover, sample: Float64) -> None:
    """Refuse a file that would be bent on its way to the other CRS, which no node's matrix can.

    Parameters
    ----------
    source : SourceFile
    move : Mover
    sample : (N, 3) float64
        Some of its points, in its own coordinates.

    Raises
    ------
    InputError
        The bend is over 1 mm.
    """
    moved = sample @ move.matrix[:3, :3].T + move.matrix[:3, 3]
    off = float(np.abs(move.points(sample) - moved).max(initial=0)) if len(sample) else 0.0
    off *= metres_per_file_unit(move)
    if not off <= _BENT:
        raise InputError(
            f"would be bent by {off:.3g} m on its way to the other CRS; the matrix of a glTF node "
            "cannot do that.",
            file=source.path,
            remedy="Convert it to .ply or .obj first.",
        )


def _recenter(document: Document, source: SourceFile, move: Mover, tree: dict[str, Any]) -> None:
    """Let CESIUM_RTC give the new file's shift, in the way in which it gave the old one's."""
    center = center_of(document)
    if center is None:
        return
    frame = source.frame
    turned = not np.allclose(center, frame.shift) and np.allclose(frame.axes @ center, frame.shift)
    shift = move.frame.shift
    with_center(tree, np.linalg.solve(move.frame.axes, shift) if turned else shift)


def _rename(document: Document, source: SourceFile, tree: dict[str, Any]) -> None:
    """Let the tree refer to the copies of other files that cannot keep their names."""
    for kind, index, uri in document.uris() if source.copies else ():
        with suppress(InputError):  # a missing image is no companion
            if (new := source.copies.get(document.outside(uri))) is not None:
                tree[kind][index]["uri"] = quote(new)


def _with_matrix(document: Document, matrix: Float64) -> dict[str, Any]:
    """Return the JSON with a node of that matrix above each root node of each scene."""
    tree = copy.deepcopy(document.tree)
    nodes = tree.setdefault("nodes", [])
    above: dict[int, int] = {}
    scenes = tree.get("scenes")
    if not scenes:
        scenes = [{"nodes": scene_roots(document)}]
        tree["scenes"], tree["scene"] = scenes, 0
    flat = matrix.T.ravel().tolist()
    for scene in scenes:
        roots = roots_of(document, scene)
        for root in roots:
            if root not in above:
                above[root] = len(nodes)
                nodes.append({"name": "meshreg", "matrix": flat, "children": [root]})
        if roots:  # the format allows no empty list
            scene["nodes"] = [above[root] for root in roots]
    return tree
