"""A smooth bend that follows a transform."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.errors import UsageError
from meshreg.records.arrays import Float64, frozen, put


def cubic_weights(fraction: Any, derivative: bool = False) -> Float64:
    """(..., 4) weights of the four uniform cubic B-splines over an interval, at 0-1 within it.

    With `derivative` their slopes per interval. De Boor, A Practical Guide to Splines, chapter X.
    """
    t = np.asarray(fraction, float)
    u = 1.0 - t
    if derivative:
        parts = (-3 * u**2, 9 * t**2 - 12 * t, -9 * t**2 + 6 * t + 3, 3 * t**2)
    else:
        parts = (u**3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    return np.stack(parts, axis=-1) / 6.0


@dataclass(frozen=True, eq=False)
class Warp:
    """A smooth bend that follows the rigid transform: ``reference = p + d(p)``, ``p = T(moving)``.

    The displacement d depends on east and north alone. Every model is kept in one form, bicubic
    B-splines on a box (a polynomial of degree 3 or less is one interval of it). Outside the box d
    is held at the value of the nearest place on its edge.

    Attributes
    ----------
    horizontal, vertical : str
        Names of the models: "rigid", "similarity", "dome", "quadratic" or "spline".
    low, high : (2,) float64
        South-west and north-east corner of the box, east and north [m], absolute in the reference.
    coefficients : (R, C, 3) float64
        East, north, up [m]; R - 3 equal intervals from south to north, C - 3 from west to east.
    """

    horizontal: str
    vertical: str
    low: Float64
    high: Float64
    coefficients: Float64

    def __post_init__(self) -> None:
        put(self, "low", frozen(self.low, np.float64, (2,), "Warp.low"))
        put(self, "high", frozen(self.high, np.float64, (2,), "Warp.high"))
        table = frozen(self.coefficients, np.float64, (None, None, 3), "Warp.coefficients")
        put(self, "coefficients", table)
        if min(table.shape[:2]) < 4 or not np.isfinite(table).all():
            raise UsageError(
                f"Warp.coefficients of shape {table.shape} must be finite, and at least (4, 4, 3)."
            )
        if not (self.high > self.low).all():
            raise UsageError(f"Warp's box from {self.low} to {self.high} is empty.")

    def displacement(self, points: Any) -> Float64:
        """East, north, up (N, 3) [m] by which points (N, 2 or 3) after the transform move."""
        points = np.asarray(points, float)
        moved = np.empty((len(points), 3))
        for start in range(0, len(points), 1 << 16):  # a block's weights stay in the cache
            part = slice(start, start + (1 << 16))
            moved[part] = self._sum(points[part], (False, False))
        return moved

    def gradient(self, points: Any) -> Float64:
        """(N, 3, 2): slopes of the displacement along east and north, inside the box."""
        points = np.asarray(points, float)
        slopes = [self._sum(points, (along == 1, along == 0)) for along in (0, 1)]
        return np.asarray(np.stack(slopes, axis=-1) / self._steps)

    def apply(self, points: Any) -> Float64:
        """Bend absolute points (N, 3) [m] that the transform has moved."""
        points = np.asarray(points, float)
        return np.asarray(points + self.displacement(points))

    def inverse(self, points: Any) -> Float64:
        """Undo `apply`, by fixed-point iteration: ``p = q - d(p)``, as d is a contraction.

        Raises
        ------
        UsageError
            If it does not settle, because the warp folds the ground.
        """
        points = np.asarray(points, float)
        found = points
        tolerance = 1e-11 + 4 * float(np.spacing(np.abs(points).max(initial=1.0)))
        for _ in range(100):
            before, found = found, points - self.displacement(found)
            if np.abs(found - before).max(initial=0.0) <= tolerance:
                return np.asarray(found)
        raise UsageError("The warp cannot be inverted: it folds the ground.")

    @property
    def _steps(self) -> Float64:
        """Length of an interval along east and north [m]."""
        rows, cols = self.coefficients.shape[:2]
        return np.asarray((self.high - self.low) / [cols - 3, rows - 3])

    def _sum(self, points: Float64, slope: tuple[bool, bool]) -> Float64:
        """Sum the splines; `slope` asks for the derivative along north, east (per interval)."""
        place = (np.clip(points[:, :2], self.low, self.high) - self.low) / self._steps
        rows, cols = self.coefficients.shape[:2]
        first = np.minimum(np.nan_to_num(place).astype(int), [cols - 4, rows - 4])
        along_east = cubic_weights(place[:, 0] - first[:, 0], slope[1])
        along_north = cubic_weights(place[:, 1] - first[:, 1], slope[0])
        total = np.zeros((len(points), 3))
        for i in range(4):
            for j in range(4):
                weight = along_north[:, i] * along_east[:, j]
                total += weight[:, None] * self.coefficients[first[:, 1] + i, first[:, 0] + j]
        return total
