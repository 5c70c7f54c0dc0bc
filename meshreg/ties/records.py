"""The records of tie points. Metres, absolute, in the reference survey's CRS; east, north."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from meshreg.errors import UsageError
from meshreg.records import Float64

Point = tuple[float, float]
MAX_PAIRS = 10_000
MAX_NAME = 80


@dataclass(frozen=True)
class TiePair:
    """One thing on the ground, seen in both surveys.

    Attributes
    ----------
    id : int
        Different for every pair of a file.
    name : str
    reference, moving : (east, north) or None
        Where each survey, as delivered, has it [m]; None where it is not picked yet.
    """

    id: int
    name: str = ""
    reference: Point | None = None
    moving: Point | None = None

    def __post_init__(self) -> None:
        for which in ("reference", "moving"):
            point = getattr(self, which)
            if point is None:
                continue
            east, north = (float(value) for value in point)
            if not (math.isfinite(east) and math.isfinite(north)):
                raise UsageError(f"The {which} point of pair {self.id} is ({east}, {north}).")
            object.__setattr__(self, which, (east, north))

    @property
    def complete(self) -> bool:
        """Whether both points are picked."""
        return self.reference is not None and self.moving is not None


@dataclass(frozen=True)
class TiePoints:
    """All pairs of one pair of surveys.

    Attributes
    ----------
    pairs : tuple of TiePair
        In the order picked; their ids differ.
    crs : str or None
        Of all coordinates, if known.
    notes : tuple of str
        What was left out or guessed while reading, one plain sentence each.
    """

    pairs: tuple[TiePair, ...] = ()
    crs: str | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.pairs) > MAX_PAIRS:
            raise UsageError(f"{len(self.pairs)} pairs are too many; {MAX_PAIRS} are the limit.")
        ids = [pair.id for pair in self.pairs]
        if len(set(ids)) < len(ids):
            twice = sorted({i for i in ids if ids.count(i) > 1})
            raise UsageError(f"Pairs have the same id: {', '.join(map(str, twice))}.")

    @property
    def complete(self) -> tuple[TiePair, ...]:
        """The pairs of which both points are picked."""
        return tuple(pair for pair in self.pairs if pair.complete)

    def arrays(self) -> tuple[Float64, Float64]:
        """Return reference and moving points (N, 2) [m] of the complete pairs."""
        pairs = self.complete
        reference = np.array([pair.reference for pair in pairs], float).reshape(-1, 2)
        moving = np.array([pair.moving for pair in pairs], float).reshape(-1, 2)
        return reference, moving
