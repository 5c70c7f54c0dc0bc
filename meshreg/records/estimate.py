"""What one method says of the offset."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from meshreg.records.arrays import NOTHING, Float64, frozen, put

Status = Literal["ok", "weak", "failed"]

# of places (N, 2): how far the ground there must go [m], (N, 2)
OffsetAt = Callable[[Float64], Float64]


@dataclass(frozen=True, eq=False)
class OffsetEstimate:
    """One method's answer: how far the moving survey must go east and north.

    Attributes
    ----------
    method : str
        Key in `meshreg.offsets.ESTIMATORS`.
    status : "ok", "weak" or "failed"
    reason : str
        Why not ok; empty when ok.
    east, north : float
        Offset [m] to ADD to moving coordinates to lay them on the reference; NaN when failed.
    sigma : (2, 2) float64 or None
        Mean square error of (east, north) [m²], given that it is the right peak
        (`meshreg.offsets.error_bars`).
    score : float
        The method's own measure at its best offset.
    gap : float
        How far the best peak stands above the second, in robust deviations of the surface.
    overlap : float
        Share of the smaller survey's cells that overlap at the offset.
    seconds : float
    evidence : mapping
        Arrays for the report: the score surface, matches, and so on.
    manual : bool
        Whether a person found it (`meshreg.ties`), not a method.
    """

    method: str
    status: Status
    reason: str = ""
    east: float = float("nan")
    north: float = float("nan")
    sigma: Float64 | None = None
    score: float = float("nan")
    gap: float = float("nan")
    overlap: float = 0.0
    seconds: float = 0.0
    evidence: Mapping[str, Any] = field(default_factory=lambda: NOTHING)
    manual: bool = False

    def __post_init__(self) -> None:
        if self.sigma is not None:
            put(self, "sigma", frozen(self.sigma, np.float64, (2, 2), "OffsetEstimate.sigma"))
