"""E57 point clouds, of several scans."""

from meshreg.io.format import Format

FORMAT = Format(
    keys=("e57",),
    suffixes=(".e57",),
    read="meshreg.io.e57.read:read",
    rewrite="meshreg.io.e57.read:rewrite",
    write="meshreg.io.e57.read:write",
    written=(".e57",),
    magic=((b"ASTM-E57", "E57", (".e57",)),),
)
