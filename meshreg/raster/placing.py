"""From a survey's own coordinates to a raster's, without passing through numbers of UTM size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshreg.records import Float64, Grid, Survey, Transform


@dataclass(frozen=True)
class Placing:
    """``raster = linear @ point + shift``: metres east and north of the grid's corner, and up.

    `point` is relative to the survey's origin; up is relative to `datum` [m].
    """

    linear: Float64
    shift: Float64
    datum: float

    def on_lattice(self, step: float) -> tuple[Float64, Float64]:
        """Matrix and shift to (column, row, up) in samples `step` [m] apart.

        Whole numbers are sample centres, sample (0, 0) lies half a step from the corner.
        """
        scale = np.array([1.0 / step, -1.0 / step, 1.0])
        shift = self.shift * scale - np.array([0.5, 0.5, 0.0])
        return self.linear * scale[:, None], shift

    @property
    def scale(self) -> float:
        """Metres on the raster per unit of the survey."""
        return float(np.cbrt(np.linalg.det(self.linear)))


def place(survey: Survey, grid: Grid, transform: Transform | None, heights: Float64) -> Placing:
    """Work out the placing of a survey on a grid, after `transform` if there is one.

    `heights` are some of the survey's, from its origin. The datum is the multiple of 100 m next
    to their middle, so that float32 heights keep their hundredths of a millimetre and most
    surveys of one place have the same.
    """
    heights = heights[np.isfinite(heights)]
    middle = float(np.median(heights)) if heights.size else 0.0
    if transform is None:
        linear, moved = np.eye(3), survey.origin
    else:
        linear = transform.linear
        moved = linear @ (survey.origin - transform.pivot) + (transform.pivot + transform.offset)
    up = float(moved[2]) + float(linear[2, 2]) * middle
    datum = 100.0 * round(up / 100.0)
    return Placing(linear, moved - np.array([grid.west, grid.north, datum]), datum)
