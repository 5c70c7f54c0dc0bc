"""The table of formats: a new one is its folder with a `Format`, and its name here."""

from __future__ import annotations

from meshreg.io import colmap, e57, gltf, las, maps, obj, other, ply, text
from meshreg.io.format import Format, load

FORMATS: tuple[Format, ...] = (
    obj.FORMAT,
    ply.FORMAT,
    gltf.FORMAT,
    other.STL,
    other.OFF,
    las.FORMAT,
    e57.FORMAT,
    text.FORMAT,
    maps.FORMAT,
    colmap.FORMAT,
)
BY_KEY = {key: known for known in FORMATS for key in known.keys}
READERS = {suffix: known.read for known in FORMATS for suffix in known.suffixes}
WRITERS = {suffix: known.write for known in FORMATS for suffix in known.written}
MAGIC = tuple(line for known in FORMATS for line in known.magic)

__all__ = ["BY_KEY", "FORMATS", "MAGIC", "READERS", "WRITERS", "Format", "load"]
