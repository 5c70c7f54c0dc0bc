"""COLMAP models: cameras, images and points in one folder."""

from meshreg.io.format import Format

FORMAT = Format(
    keys=("colmap",),
    suffixes=("",),
    read="meshreg.io.colmap.read:read",
    rewrite="meshreg.io.colmap.read:rewrite",
    require_writable="meshreg.io.colmap.read:require_writable",
    whole="COLMAP models are",
)
