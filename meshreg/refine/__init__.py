"""The rigid answer from tiles: offset, yaw and their covariance; opt-in on the 3-D surfaces.

Each tile of the moving survey is correlated alone, to a hundredth of a cell; the offsets of all are
then one random field, and the motion that fits best over the whole overlap is its best linear
unbiased estimate (`statistics.kriging`).
"""

from meshreg.refine.rigid import (
    PEAK_RESOLUTION,
    Refined,
    dem_ground,
    refine,
    with_scale,
)
from meshreg.refine.surfaces import (
    Polished,
    check_surfaces,
    polish,
)
from meshreg.refine.tears import (
    contradicts,
    find_tear,
    tear_of_tiles,
)
from meshreg.refine.tiles import (
    TileOffsets,
    correlated_tiles,
)

__all__ = [
    "PEAK_RESOLUTION",
    "Polished",
    "Refined",
    "TileOffsets",
    "check_surfaces",
    "contradicts",
    "correlated_tiles",
    "dem_ground",
    "find_tear",
    "polish",
    "refine",
    "tear_of_tiles",
    "with_scale",
]
