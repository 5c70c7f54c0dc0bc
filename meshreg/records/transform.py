"""A similarity about a pivot."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from meshreg.errors import UsageError
from meshreg.records.arrays import Float64, frozen, put


@dataclass(frozen=True, eq=False)
class Transform:
    """Similarity ``reference = pivot + offset + scale * rotation @ (moving - pivot)``.

    Attributes
    ----------
    rotation : (3, 3) float64
        Proper rotation.
    scale : float
    offset : (3,) float64
        East, north, up [m] by which the pivot moves.
    pivot : (3,) float64
        Absolute point [m] about which rotation and scale act.
    """

    rotation: Float64 = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    offset: Float64 = field(default_factory=lambda: np.zeros(3))
    pivot: Float64 = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        put(self, "rotation", frozen(self.rotation, np.float64, (3, 3), "Transform.rotation"))
        put(self, "offset", frozen(self.offset, np.float64, (3,), "Transform.offset"))
        put(self, "pivot", frozen(self.pivot, np.float64, (3,), "Transform.pivot"))
        error = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        if not (error < 1e-6 and np.linalg.det(self.rotation) > 0):
            raise UsageError(
                f"Transform.rotation is not a proper rotation (|R R' - 1| up to {error:.3g}, "
                f"determinant {np.linalg.det(self.rotation):.6g})."
            )
        if not self.scale > 0:
            raise UsageError(f"Transform.scale is {self.scale}; it must be positive.")

    @property
    def linear(self) -> Float64:
        """(3, 3) float64: scale times rotation."""
        return self.scale * self.rotation

    @property
    def matrix(self) -> Float64:
        """(4, 4) float64 acting on absolute column vectors."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.linear
        matrix[:3, 3] = self.pivot + self.offset - self.linear @ self.pivot
        return matrix

    @property
    def yaw(self) -> float:
        """Turn about the vertical, counterclockwise from above [rad]."""
        return math.atan2(self.rotation[1, 0], self.rotation[0, 0])

    @property
    def tilt(self) -> float:
        """Angle by which it tilts the vertical [rad]."""
        east, north, up = self.rotation[:, 2]
        return math.atan2(math.hypot(east, north), up)  # the cosine alone loses a small angle

    @classmethod
    def from_matrix(cls, matrix: Any, pivot: Any = (0.0, 0.0, 0.0)) -> Transform:
        """Read a 4×4 similarity; its `offset` is stated at `pivot`."""
        matrix = np.asarray(matrix, float)
        if matrix.shape != (4, 4) or not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise UsageError(f"Expected a 4×4 matrix ending in 0 0 0 1; got {matrix.tolist()}.")
        pivot = np.asarray(pivot, float)
        determinant = np.linalg.det(matrix[:3, :3])
        if not determinant > 0:
            raise UsageError(f"The matrix mirrors or flattens (determinant {determinant:.6g}).")
        scale = float(np.cbrt(determinant))
        offset = matrix[:3, :3] @ pivot + matrix[:3, 3] - pivot
        return cls(matrix[:3, :3] / scale, scale, offset, pivot)

    def apply(self, points: Any) -> Float64:
        """Move absolute points (..., 3) [m]."""
        points = np.asarray(points, float)
        return np.asarray((points - self.pivot) @ self.linear.T + (self.pivot + self.offset))

    def inverse(self) -> Transform:
        """Return the transform that takes reference back to moving."""
        rotation, scale = self.rotation.T, 1.0 / self.scale
        return Transform(rotation, scale, -self.offset, self.pivot + self.offset)

    def at(self, pivot: Any) -> Transform:
        """Return the same transform with its `offset` stated at another pivot."""
        pivot = np.asarray(pivot, float)
        return Transform(self.rotation, self.scale, self.apply(pivot) - pivot, pivot)

    def __matmul__(self, first: Transform) -> Transform:
        """Chain two transforms: ``(a @ b).apply(x) == a.apply(b.apply(x))``."""
        middle = first.pivot + first.offset
        offset = first.offset + self.apply(middle) - middle
        return Transform(
            self.rotation @ first.rotation, self.scale * first.scale, offset, first.pivot
        )
