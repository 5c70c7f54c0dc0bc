"""What the stages find beside the offset, and what speaks against accepting a pair."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from meshreg.records.arrays import NOTHING, Float64


@dataclass(frozen=True)
class Layer:
    """A second surface in a survey.

    Attributes
    ----------
    cells : float
        Share of the cells that hold a second surface.
    common : float
        Share of the cells whose second surface lies at the one offset that most share.
    where_seen : float
        The same, of the cells where a copy at that offset would stand off the first surface.
    offset : (east, north, up)
        That offset [m].
    """

    cells: float
    common: float = 0.0
    where_seen: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Gain:
    """Height of the moving survey's relief over the reference's.

    Attributes
    ----------
    value : float
    sigma : float
        Standard deviation of its natural logarithm; infinite where no relief recurs.
    departs : bool
        Whether each width that tells it differs from 1 by more than three sigmas and more than
        a tenth, all to the same side.
    inverted : bool
        Whether the relief recurs upside down: what rises in one survey falls in the other.
    """

    value: float = 1.0
    sigma: float = float("inf")
    departs: bool = False
    inverted: bool = False

    @property
    def unknown(self) -> str:
        """Why the gain was not determined; '' where it was."""
        if np.isfinite(self.sigma):
            return ""
        return "the relief recurs upside down" if self.inverted else "no relief recurs"


@dataclass(frozen=True, eq=False)
class Tear:
    """Two parts of a survey that lie apart by a step.

    Attributes
    ----------
    apart : (K,) float64
        What must be added to the smaller part beyond the rest: east and north, or up alone [m].
    sigma : float
        Standard deviation of its largest component [m].
    share : float
        Of the tiles that lie in the smaller part.
    side : str
        Where that part lies: "east", "north-east", ...
    places : (M, 2) float64
        Of the tiles of the smaller part: east and north [m].
    """

    apart: Float64
    sigma: float
    share: float
    side: str
    places: Float64 = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def size(self) -> float:
        """Length of `apart` [m]."""
        return float(np.linalg.norm(self.apart))


Severity = Literal["review", "rejected"]


@dataclass(frozen=True)
class Finding:
    """One thing that speaks against accepting a pair.

    Attributes
    ----------
    code : str
        What it is, for programs: `meshreg.judge.CODES` has all of them.
    text : str
        A sentence for people.
    severity : "review" or "rejected"
        The best verdict that it leaves.
    values : mapping
        The numbers in the text, by name; lengths in metres.
    """

    code: str
    text: str
    severity: Severity = "review"
    values: Mapping[str, float] = field(default_factory=lambda: NOTHING)
