"""Robust Gauss-Newton on one tile after another, all cores at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.jit import jit, prange
from meshreg.statistics.scale import MAD_TO_SIGMA

STEPS = 15
STILL = 1e-7  # m; a step this small ends the search
ONE_WAY = 1e4  # condition from which the relief tells only one direction


@jit(parallel=True)
def polish(
    still: Any, moved: Any, places: Any, bounds: Any, sizes: Any, origin: Any, cell: float
) -> Any:
    """Find what to add to the tiles' offsets so that they fit, and how sure it is: (M, 4).

    East and north [m], and the variance of each [m²] that the misfit of single cells leaves, as if
    each erred alone: it says by how much one tile is better known than another. NaN where a tile
    does not fit.

    Parameters
    ----------
    still, moved : (5, H, W) float64
        Layers of a `refine.tiles.Relief`.
    places : (N, 4) float64
        Row and column in `moved`, and the bent place [m east, m north], of the cells of all tiles.
    bounds : (M + 1,) int64
        Where each tile's places begin.
    sizes : (M,) int64
        Cells of each tile; over half of them must be used.
    origin : (2,) float64
        West and north edge [m] of `still`.
    cell : float
    """
    tiles = len(bounds) - 1
    answers = np.full((tiles, 4), np.nan)
    for tile in prange(tiles):
        number = np.int64(tile)
        first, last = bounds[number], bounds[number + 1]
        if last - first >= 0.5 * sizes[number]:
            part = places[first:last]
            found = _fitted(still, moved, part, origin, cell)
            for k in range(4):
                answers[number, k] = found[k]
    return answers


@jit()
def _fitted(still: Any, moved: Any, places: Any, origin: Any, cell: float) -> Any:
    count = len(places)
    residual, weight = np.empty(count), np.empty(count)
    slopes = np.empty((count, 2))
    east, north, step_east, step_north = 0.0, 0.0, np.inf, np.inf
    var_east, var_north = np.inf, np.inf
    for _ in range(STEPS):
        edge = (origin[0] - east, origin[1] - north)
        used = _residuals(still, moved, places, edge, cell, residual, slopes)
        if used < 0.5 * count:
            return np.nan, np.nan, np.nan, np.nan
        _biweight(residual[:used], weight[:used])
        a, b, d, p, q, total, misfit = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(used):
            x, y = slopes[k, 0], slopes[k, 1]
            a += weight[k] * x * x
            b += weight[k] * x * y
            d += weight[k] * y * y
            p += weight[k] * x * residual[k]
            q += weight[k] * y * residual[k]
            total += weight[k]
            misfit += weight[k] * residual[k] * residual[k]
        middle, reach = 0.5 * (a + d), np.hypot(0.5 * (a - d), b)
        if not middle + reach < ONE_WAY * (middle - reach):
            return np.nan, np.nan, np.nan, np.nan
        determinant = a * d - b * b
        var_east, var_north = misfit / total * d / determinant, misfit / total * a / determinant
        step_east = (b * q - d * p) / determinant
        step_north = (b * p - a * q) / determinant
        east += step_east
        north += step_north
        if max(abs(step_east), abs(step_north)) < STILL:
            break
    if np.hypot(east, north) <= 3 * cell and max(abs(step_east), abs(step_north)) < 0.01 * cell:
        return east, north, var_east, var_north
    return np.nan, np.nan, np.nan, np.nan


@jit()
def _residuals(
    still: Any, moved: Any, places: Any, edge: Any, cell: float, residual: Any, slopes: Any
) -> int:
    """Fill residuals and mean slopes where both surveys are known; return their number."""
    _, rows, cols = still.shape
    used = 0
    for k in range(len(places)):
        col = (places[k, 2] - edge[0]) / cell - 0.5
        row = (edge[1] - places[k, 3]) / cell - 0.5
        i, j = np.int64(np.rint(row)), np.int64(np.rint(col))
        if i < 0 or j < 0 or i >= rows or j >= cols or still[4, i, j] == 0:
            continue
        r, c = np.int64(places[k, 0]), np.int64(places[k, 1])
        residual[used] = _spline_at(still[1], row, col) - moved[0, r, c]
        for axis in range(2):
            here = _bilinear_at(still[2 + axis], row, col)
            slopes[used, axis] = 0.5 * (moved[2 + axis, r, c] + here)
        used += 1
    return used


@jit()
def _spline_at(coefficients: Any, row: float, col: float) -> float:
    """Cubic B-spline; the sixteen coefficients around must be inside."""
    i, j = np.int64(np.floor(row)), np.int64(np.floor(col))
    down, across = _weights(row - i), _weights(col - j)
    total = 0.0
    for y in range(4):
        line = 0.0
        for x in range(4):
            line += across[x] * coefficients[i - 1 + y, j - 1 + x]
        total += down[y] * line
    return total


@jit()
def _weights(t: float) -> Any:
    u = 1.0 - t
    return (
        u * u * u / 6.0,
        2.0 / 3.0 - 0.5 * t * t * (2.0 - t),
        2.0 / 3.0 - 0.5 * u * u * (2.0 - u),
        t * t * t / 6.0,
    )


@jit()
def _bilinear_at(values: Any, row: float, col: float) -> float:
    i, j = np.int64(np.floor(row)), np.int64(np.floor(col))
    y, x = row - i, col - j
    above = (1.0 - x) * values[i, j] + x * values[i, j + 1]
    below = (1.0 - x) * values[i + 1, j] + x * values[i + 1, j + 1]
    return float((1.0 - y) * above + y * below)


@jit()
def _biweight(residual: Any, weight: Any) -> None:
    """Fill Tukey's biweight at four robust deviations."""
    middle = np.median(residual)
    spread = MAD_TO_SIGMA * np.median(np.abs(residual - middle))
    limit = max(4 * spread, 1e-12)
    for k in range(len(residual)):
        inner = max(1.0 - (residual[k] / limit) ** 2, 0.0)
        weight[k] = inner * inner
