"""Points that are no ground by their class: noise and water, left out of maps and counted.

ASPRS LAS 1.4 R15, table 17 (7 low noise, 9 water, 18 high noise), and its Topo-Bathy Lidar Domain
Profile 1.0 (2013): 40 is the bed and stays, 41 the water's surface, 42 a surface that was derived,
45 a return from the water where no bottom was found. Class 9 is older than that profile and has
been used for ground under water too; it is taken for the surface where there is a class 40 too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.records import Bool

NOISE = (7, 18)
WATER = (41, 42, 45)
OLD_WATER = (9,)
BED = (40,)
RECLASS = "Give the points of the bed a class of their own (2 ground, 40 bed), or none."


def in_classes(values: NDArray[Any], classes: tuple[int, ...]) -> Bool:
    """Return which values (N,) are one of the classes."""
    if values.dtype == np.uint8:
        table = np.zeros(256, np.bool_)
        table[list(classes)] = True
        return np.asarray(table[values])
    return np.asarray(np.isin(values, classes))


def class_notes(noise: int, water: int) -> list[str]:
    """Return what to say of the numbers of points that were left out."""
    notes = []
    if noise:
        notes.append(f"{noise} points classed as noise (7, 18) were left out.")
    if water:
        notes.append(
            f"{water} points classed as water (9, 41, 42, 45) were left out; the bed is 40."
        )
    return notes


def ground_classes(values: NDArray[Any], notes: list[str]) -> Bool | None:
    """Return which points are neither noise nor water, and note the others; None where all are."""
    noise, water = in_classes(values, NOISE), in_classes(values, WATER)
    if in_classes(values, BED).any():
        water |= in_classes(values, OLD_WATER)
    notes += class_notes(int(np.count_nonzero(noise)), int(np.count_nonzero(water)))
    drop = noise | water
    return ~drop if drop.any() else None
