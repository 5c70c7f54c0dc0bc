"""Wavefront OBJ with its material files and texture pages."""

from meshreg.io.format import Format

FORMAT = Format(
    keys=("obj",),
    suffixes=(".obj",),
    read="meshreg.io.obj.read:read",
    rewrite="meshreg.io.obj.write:rewrite",
    write="meshreg.io.obj.write:write",
    written=(".obj",),
)
