"""Meshes without textures: STL and OFF."""

from meshreg.io.format import Format

STL = Format(
    keys=("stl",),
    suffixes=(".stl",),
    read="meshreg.io.other.stl:read",
    rewrite="meshreg.io.other.stl:rewrite",
    write="meshreg.io.other.stl:write",
    written=(".stl",),
)
OFF = Format(
    keys=("off",),
    suffixes=(".off",),
    read="meshreg.io.other.off:read",
    rewrite="meshreg.io.other.off:rewrite",
    write="meshreg.io.other.off:write",
    written=(".off",),
)
