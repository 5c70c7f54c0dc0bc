"""What to use of a survey: rasters and polygons."""

from meshreg.io.masks.read import Mask, read_mask

__all__ = ["Mask", "read_mask"]
