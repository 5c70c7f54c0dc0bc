"""A score for every offset: its peak, the sub-cell peak, the gap to the second, its sigma."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.records import Float64
from meshreg.statistics.scale import MAD_TO_SIGMA


@dataclass(frozen=True)
class Peak:
    """The highest point of a surface.

    Attributes
    ----------
    east, north : float
        Sub-cell position [m].
    value : float
        The surface's value at the best cell.
    gap : float
        Height above the best other peak, in robust deviations of the surface.
    second : (east, north) or None
        Where that other peak is.
    sigma : (2, 2) float64
        Covariance of (east, north) [m²].
    border : bool
        Whether the peak lies on the edge of what was searched.
    index : (row, col)
    whole : (east, north)
        Position of the best cell [m].
    """

    east: float
    north: float
    value: float
    gap: float
    second: tuple[float, float] | None
    sigma: Float64
    border: bool
    index: tuple[int, int]
    whole: tuple[float, float]


def find_peak(surface: Float64, east: Float64, north: Float64, exclusion: float) -> Peak | None:
    """Find the highest finite value of a surface, higher being better.

    Parameters
    ----------
    surface : (K, L) float64
        NaN where not scored.
    east, north : (L,), (K,) float64
        Offsets [m] of columns and rows, evenly spaced.
    exclusion : float
        Other peaks count only further than this from the best [m]; widened to where the best
        peak's own flank has fallen by half, so that a broad peak is not its own rival.

    Returns
    -------
    Peak or None
        None when nothing was scored.
    """
    if not np.isfinite(surface).any():
        return None
    row, col = (int(i) for i in np.unravel_index(np.nanargmax(surface), surface.shape))
    value = float(surface[row, col])
    far = _beyond(surface, east, north, row, col, exclusion)
    spread = _spread(surface[far] if far.any() else surface)
    second, gap = None, 0.0
    if far.any():
        rivals = np.where(far, surface, -np.inf)
        r, c = np.unravel_index(np.argmax(rivals), rivals.shape)
        if np.isfinite(rivals[r, c]):
            second = (float(east[c]), float(north[r]))
            gap = (value - float(rivals[r, c])) / spread if spread > 0 else 0.0
    d_row, d_col, hessian = _quadratic(surface, row, col)
    cell = float(abs(east[1] - east[0])) if len(east) > 1 else 1.0
    return Peak(
        east=float(east[col] + d_col * cell),
        north=float(north[row] + d_row * (north[1] - north[0] if len(north) > 1 else 0.0)),
        value=value,
        gap=float(gap),
        second=second,
        sigma=_sigma(surface, far, hessian, cell),
        border=_touches_border(surface, row, col),
        index=(row, col),
        whole=(float(east[col]), float(north[row])),
    )


def gap_at(
    surface: Float64, east: Float64, north: Float64, at: tuple[float, float], reach: float
) -> tuple[float, float, tuple[float, float]]:
    """How a hypothesis stands on a surface: gap, value and place of its local maximum.

    The local maximum within `reach` metres of `at` is compared with the best value elsewhere
    (beyond it); the gap is negative where something else is higher.
    """
    near = _distance(east, north, at) <= reach
    if not np.isfinite(surface[near]).any():
        return float("-inf"), float("nan"), at
    inside = np.where(near & np.isfinite(surface), surface, -np.inf)
    row, col = (int(i) for i in np.unravel_index(np.argmax(inside), inside.shape))
    far = _beyond(surface, east, north, row, col, reach)
    spread = _spread(surface[far] if far.any() else surface)
    rival = float(np.max(surface[far])) if far.any() else float("inf")
    gap = (float(surface[row, col]) - rival) / spread if spread > 0 else 0.0
    return gap, float(surface[row, col]), (float(east[col]), float(north[row]))


def _distance(east: Float64, north: Float64, at: tuple[float, float]) -> Float64:
    return np.asarray(np.hypot(east[None, :] - at[0], north[:, None] - at[1]))


def _spread(values: Float64) -> float:
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))


def _beyond(
    surface: Float64, east: Float64, north: Float64, row: int, col: int, exclusion: float
) -> Any:
    """Scored cells that do not belong to the peak at (row, col)."""
    distance = _distance(east, north, (float(east[col]), float(north[row])))
    finite = np.isfinite(surface)
    level = float(np.median(surface[finite]))
    half = 0.5 * (float(surface[row, col]) + level)
    cell = float(abs(east[1] - east[0])) if len(east) > 1 else 1.0
    radius = exclusion
    # Follow the peak's own flank outward, ring by ring, while most of the ring stays above half
    # height; a rival hill is not part of the flank, and no peak is wider than half the window.
    limit = 0.5 * float(max(np.ptp(east), np.ptp(north)))
    ring = cell
    while ring <= limit:
        members = finite & (np.abs(distance - ring) <= 0.5 * cell)
        if not members.any() or float(np.median(surface[members])) < half:
            break
        radius = max(radius, 2.0 * ring)
        ring += cell
    return finite & (distance > radius)


def _quadratic(surface: Float64, row: int, col: int) -> tuple[float, float, Float64]:
    """Vertex (in cells) and Hessian (per cell²) of the quadratic through 3 × 3 cells."""
    rows, cols = surface.shape
    if not (0 < row < rows - 1 and 0 < col < cols - 1):
        return 0.0, 0.0, np.zeros((2, 2))
    patch = surface[row - 1 : row + 2, col - 1 : col + 2]
    if not np.isfinite(patch).all():
        return 0.0, 0.0, np.zeros((2, 2))
    gradient = 0.5 * np.array([patch[2, 1] - patch[0, 1], patch[1, 2] - patch[1, 0]])
    mixed = 0.25 * (patch[2, 2] + patch[0, 0] - patch[0, 2] - patch[2, 0])
    down = patch[2, 1] + patch[0, 1] - 2 * patch[1, 1]
    right = patch[1, 2] + patch[1, 0] - 2 * patch[1, 1]
    hessian = np.array([[down, mixed], [mixed, right]])
    if not (down < 0 and right < 0 and np.linalg.det(hessian) > 0):
        return 0.0, 0.0, np.zeros((2, 2))
    step = np.clip(-np.linalg.solve(hessian, gradient), -1.0, 1.0)
    return float(step[0]), float(step[1]), hessian


def _sigma(surface: Float64, far: Any, hessian: Float64, cell: float) -> Float64:
    """Covariance of the peak: the surface's own noise, pushed through the peak's curvature.

    Away from the peak the surface is what chance makes of this ground. Its gradient there has
    covariance G; added to the peak it moves the vertex by H⁻¹ g, so the vertex has covariance
    H⁻¹ G H⁻¹. A floor of a twentieth of a cell stands for the quadratic's own error.
    """
    floor = (0.05 * cell) ** 2 * np.eye(2)
    if not hessian.any():
        return cell**2 * np.eye(2)
    d_row = 0.5 * (surface[2:, 1:-1] - surface[:-2, 1:-1])
    d_col = 0.5 * (surface[1:-1, 2:] - surface[1:-1, :-2])
    use = far[1:-1, 1:-1] & np.isfinite(d_row) & np.isfinite(d_col)
    if use.sum() < 9:
        return cell**2 * np.eye(2)
    noise = np.cov(np.stack([d_row[use], d_col[use]]))
    inverse = np.linalg.inv(hessian)
    covariance = inverse @ noise @ inverse * cell**2
    covariance = covariance[::-1, ::-1].copy()  # (row, col) to (east, north)
    covariance[0, 1] *= -1  # rows grow southward
    covariance[1, 0] *= -1
    return np.asarray(covariance + floor)


def _touches_border(surface: Float64, row: int, col: int) -> bool:
    """Whether the peak cell is on the window's edge, or has an unscored neighbour."""
    rows, cols = surface.shape
    if not (0 < row < rows - 1 and 0 < col < cols - 1):
        return True
    return not bool(np.isfinite(surface[row - 1 : row + 2, col - 1 : col + 2]).all())
