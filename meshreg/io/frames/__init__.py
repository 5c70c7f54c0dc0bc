"""Where a file's coordinates lie: CRS, units, axes, shifts, and what files beside it say."""

from meshreg.io.frames.place import common_crs, reframe

__all__ = ["common_crs", "reframe"]
