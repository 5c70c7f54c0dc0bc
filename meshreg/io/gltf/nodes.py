"""The tree of nodes of a glTF scene: which mesh stands where (glTF 2.0, section 3.5)."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.io.gltf.document import Document
from meshreg.records import Float64

_DEPTH = 64
_MAX_NODES = 1_000_000


def mesh_instances(document: Document) -> list[tuple[int, Float64]]:
    """Walk the scene and return each mesh with the matrix of its place.

    Returns
    -------
    list of (mesh index, (4, 4) float64)
        Matrices from the mesh's to the file's coordinates, in the order of the scene.

    Raises
    ------
    InputError
        A node that is reached twice (a cycle, or two parents), more than 64 levels, a matrix
        that is none, a skinned mesh.
    """
    nodes = document.items("nodes")
    found = []
    seen: set[int] = set()
    stack = [(index, np.eye(4), 1) for index in reversed(scene_roots(document))]
    while stack:
        index, above, depth = stack.pop()
        place = f"nodes[{index}]"
        node = document.item("nodes", index, place)
        if index in seen:
            document.fail("is reached twice: the nodes are not a tree.", place)
        seen.add(index)
        if depth > _DEPTH or len(seen) > _MAX_NODES:
            document.fail(f"lies more than {_DEPTH} levels deep.", place)
        if "skin" in node or node.get("weights"):
            document.fail("is skinned or morphed, which is not read.", place, "Export it rigid.")
        matrix = above @ _node_matrix(document, node, place)
        if "mesh" in node:
            document.item("meshes", node["mesh"], place)
            found.append((int(node["mesh"]), matrix))
        children = node.get("children", [])
        if not isinstance(children, list) or len(children) > len(nodes):
            document.fail("has children that are not a list of nodes.", place)
        stack += [(child, matrix, depth + 1) for child in reversed(children)]
    return found


def scene_roots(document: Document) -> list[int]:
    """Return the root nodes of the default scene; without scenes, the nodes that are no child."""
    if document.items("scenes"):
        return roots_of(document, document.item("scenes", document.tree.get("scene", 0), "scene"))
    nodes = document.items("nodes")
    lists = [node.get("children", []) for node in nodes]
    children = {c for below in lists if isinstance(below, list) for c in below if type(c) is int}
    return [index for index in range(len(nodes)) if index not in children]


def roots_of(document: Document, scene: dict[str, Any]) -> list[int]:
    """Return the root nodes of one scene, checked to be numbers."""
    roots = scene.get("nodes", [])
    if not isinstance(roots, list) or not all(type(root) is int for root in roots):
        document.fail("has a scene whose nodes are not a list of numbers.", "scenes")
    return roots


def _node_matrix(document: Document, node: dict[str, Any], place: str) -> Float64:
    """Return a node's own matrix: 16 numbers by columns, or translation * rotation * scale."""
    flat = document.numbers(node, "matrix", 16, place)
    if flat is not None:
        matrix = flat.reshape(4, 4).T
        if not np.allclose(matrix[3], (0, 0, 0, 1)):
            document.fail("has a matrix that is not affine.", place)
        return matrix
    matrix = np.eye(4)
    turn = document.numbers(node, "rotation", 4, place)
    if turn is not None:
        length = float(np.sqrt(turn @ turn))
        if not 0.5 < length < 2:
            document.fail(f"has a rotation of length {length:.3g}, not 1.", place)
        matrix[:3, :3] = _rotation(turn / length)
    scale = document.numbers(node, "scale", 3, place)
    if scale is not None:
        matrix[:3, :3] *= scale
    move = document.numbers(node, "translation", 3, place)
    if move is not None:
        matrix[:3, 3] = move
    return matrix


def _rotation(quaternion: Float64) -> Float64:
    """Rotation matrix of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
