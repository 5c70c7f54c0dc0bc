"""The tables of formats: a new one is its module and its lines here.

Each entry names a function by "module:function", imported at first use.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

READERS: dict[str, str] = {
    ".obj": "meshreg.io.obj:read",
    ".ply": "meshreg.io.ply:read",
    ".glb": "meshreg.io.gltf:read",
    ".gltf": "meshreg.io.gltf:read",
    ".stl": "meshreg.io.stl:read",
    ".off": "meshreg.io.off:read",
    ".las": "meshreg.io.cloud:read",
    ".laz": "meshreg.io.cloud:read",
    ".e57": "meshreg.io.e57:read",
    ".xyz": "meshreg.io.xyz:read",
    ".csv": "meshreg.io.xyz:read",
    ".txt": "meshreg.io.xyz:read",
    ".asc": "meshreg.io.xyz:read",
    ".pts": "meshreg.io.xyz:read",
    ".tif": "meshreg.io.maps:read",
    ".tiff": "meshreg.io.maps:read",
    "": "meshreg.io.colmap:read",  # a folder
}
WRITERS: dict[str, str] = {
    ".obj": "meshreg.io.obj:write",
    ".ply": "meshreg.io.ply:write",
    ".glb": "meshreg.io.gltf:write",
    ".stl": "meshreg.io.stl:write",
    ".off": "meshreg.io.off:write",
    ".las": "meshreg.io.cloud_write:write",
    ".laz": "meshreg.io.cloud_write:write",
    ".e57": "meshreg.io.e57:write",
    ".xyz": "meshreg.io.xyz:write",
    ".csv": "meshreg.io.xyz:write",
    ".txt": "meshreg.io.xyz:write",
    ".tif": "meshreg.io.maps:write",
    ".tiff": "meshreg.io.maps:write",
}
REWRITERS: dict[str, str] = {
    "obj": "meshreg.io.obj:rewrite",
    "ply": "meshreg.io.ply:rewrite",
    "glb": "meshreg.io.gltf:rewrite",
    "gltf": "meshreg.io.gltf:rewrite",
    "stl": "meshreg.io.stl:rewrite",
    "off": "meshreg.io.off:rewrite",
    "las": "meshreg.io.cloud_write:rewrite",
    "e57": "meshreg.io.e57:rewrite",
    "xyz": "meshreg.io.xyz:rewrite",
    "colmap": "meshreg.io.colmap:rewrite",
    "maps": "meshreg.io.maps:rewrite",
}
# What is found out about a file before the work that could otherwise fail at its end.
CHECKS: dict[str, str] = {
    "glb": "meshreg.io.gltf_rewrite:require_writable",
    "gltf": "meshreg.io.gltf_rewrite:require_writable",
    "colmap": "meshreg.io.colmap:require_writable",
}


def load(entry: str) -> Callable[..., Any]:
    """Import the function that a table's "module:function" names."""
    module, _, name = entry.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function
