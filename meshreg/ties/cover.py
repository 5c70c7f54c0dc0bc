"""Where pairs stand on the ground that both surveys show, and where they are missing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.records import Float64


@dataclass(frozen=True)
class Sector:
    """One ninth of the overlap's bounding box.

    `share` is how much of the overlap lies in it, `pairs` how many agreeing pairs.
    """

    name: str
    share: float
    pairs: int


_NAMES = (
    ("north-west", "north", "north-east"),
    ("west", "middle", "east"),
    ("south-west", "south", "south-east"),
)


def sectors(places: Float64, overlap: Float64) -> tuple[Sector, ...]:
    """Count points by ninths of the ground that both surveys show.

    Parameters
    ----------
    places : (N, 2) float64
        Reference points [m].
    overlap : (M, 2) float64
        Centres of equal cells of the ground that both surveys show [m].
    """
    if not len(overlap):
        return ()
    low, high = overlap.min(axis=0), overlap.max(axis=0)
    size = np.maximum(high - low, 1e-9)

    def ninths(points: Float64) -> Any:
        column = np.clip(3 * (points[:, 0] - low[0]) / size[0], 0, 2).astype(int)
        row = np.clip(3 * (high[1] - points[:, 1]) / size[1], 0, 2).astype(int)
        return np.bincount(3 * row + column, minlength=9).reshape(3, 3)

    ground = ninths(overlap) / len(overlap)
    inside = (places >= low - size / 20).all(axis=1) & (places <= high + size / 20).all(axis=1)
    counts = ninths(places[inside])
    return tuple(
        Sector(_NAMES[row][col], float(ground[row, col]), int(counts[row, col]))
        for row in range(3)
        for col in range(3)
    )


def weak_spots(parts: tuple[Sector, ...], least_share: float = 0.04) -> tuple[str, ...]:
    """Name the ninths that hold ground but no point; those of little ground are passed over."""
    return tuple(part.name for part in parts if part.share >= least_share and not part.pairs)
