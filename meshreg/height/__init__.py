"""Height and tilt from the ground that has not changed, and the gain of the heights.

The plane through what stable ground rose or fell by is fitted robustly, the moving survey laid on
it, and the ground found anew, until the plane lies still.
"""

from meshreg.height.lifting import (
    STABLE,
    Heights,
    fit_heights,
    stable_ground,
)

__all__ = [
    "STABLE",
    "Heights",
    "fit_heights",
    "stable_ground",
]
