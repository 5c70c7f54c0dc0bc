"""How far the moving survey is turned and stretched, before anything else looks at it.

Each tile of it is correlated once with the reference; a yaw psi and a scale s then say where its
peak must lie, and the surfaces are added there::

    F(t, psi, s) = sum_k S_k(t + (s R(psi) - 1) c_k) / sqrt(number of tiles that see the reference)

What this does to the verdict is the pipeline's.
"""

from meshreg.heading.tile_surfaces import (
    near_offset,
    part_of,
)
from meshreg.heading.turned import (
    Pairs,
    Turned,
    turned_as_voted,
    turning,
)
from meshreg.heading.voting import (
    SMALL_YAW,
    STANDS_OUT,
    Turn,
    coarse_turn,
    not_voted,
    plainly_wrong,
    vote,
)

__all__ = [
    "SMALL_YAW",
    "STANDS_OUT",
    "Pairs",
    "Turn",
    "Turned",
    "coarse_turn",
    "near_offset",
    "not_voted",
    "part_of",
    "plainly_wrong",
    "turned_as_voted",
    "turning",
    "vote",
]
