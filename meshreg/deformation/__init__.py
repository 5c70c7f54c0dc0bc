"""How the two models bend against each other: rigid to spline, held out; bent maps.

A model is a smooth displacement of the tiles' offsets; the simplest whose prediction of tiles that
it has not seen is as good as any other's is kept.
"""

from meshreg.deformation.internal import (
    Deformation,
    check_model,
    measure,
)
from meshreg.deformation.warp_rasters import (
    warped_raster,
)

__all__ = [
    "Deformation",
    "check_model",
    "measure",
    "warped_raster",
]
