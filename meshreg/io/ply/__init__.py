"""PLY, of text and binary: meshes with texture pages, clouds with any attribute."""

from meshreg.io.format import Format

FORMAT = Format(
    keys=("ply",),
    suffixes=(".ply",),
    read="meshreg.io.ply.read:read",
    rewrite="meshreg.io.ply.write:rewrite",
    write="meshreg.io.ply.write:write",
    written=(".ply",),
    magic=((b"ply", "PLY", (".ply",)),),
)
