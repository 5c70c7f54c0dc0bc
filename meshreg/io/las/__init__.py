"""LAS, LAZ and COPC point clouds."""

from meshreg.io.format import Format

FORMAT = Format(
    keys=("las",),
    suffixes=(".las", ".laz"),
    read="meshreg.io.las.read:read",
    rewrite="meshreg.io.las.write:rewrite",
    write="meshreg.io.las.write:write",
    written=(".las", ".laz"),
    magic=((b"LASF", "LAS", (".las", ".laz")),),
)
