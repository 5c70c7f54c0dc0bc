"""Move a raster: sample it where each cell of a new north-up grid comes from.

One code serves files that are rotated, not square or in degrees, maps that go to another CRS, and
registered maps. A moved raster is always sampled anew; editing its header could not turn it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError, ResourceLimitError
from meshreg.types import Bool, Float32, Float64, Grid, UInt8

Forward = Callable[[Float64], Float64]
_STEP = 32  # cells between nodes at which the map is solved exactly
_ROWS = 1 << 20  # cells sampled at once
MAX_CELLS = 2_000_000_000


@dataclass(frozen=True, eq=False)
class Placed:
    """How a raster lies: `matrix` (2, 3) takes (col, row, 1) of outer pixel corners to file x, y.

    `forward` takes file points (N, 3) to absolute east, north, up [m]; `level` is a height in the
    middle of the data, in the file's unit, at which x and y are related.
    """

    matrix: Float64
    shape: tuple[int, int]
    forward: Forward
    level: float = 0.0

    def absolute(self, col: Float64, row: Float64) -> Float64:
        """Return absolute points (N, 3) of pixel positions at `level`."""
        xy = np.stack([col, row, np.ones_like(col)], axis=-1) @ self.matrix.T
        return self.forward(np.column_stack([xy, np.full(len(xy), self.level)]))


def placed_grid(grid: Grid, forward: Forward, level: float = 0.0) -> Placed:
    """Return how a north-up raster in memory lies under `forward`."""
    matrix = np.array([[grid.cell, 0, grid.west], [0, -grid.cell, grid.north]])
    return Placed(matrix, grid.shape, forward, level)


def covering_grid(placed: Placed, crs: str | None, cell: float | None = None) -> Grid:
    """Return a north-up grid that covers a raster, its edges on whole multiples of the cell.

    Parameters
    ----------
    placed : Placed
    crs : str or None
        Of absolute coordinates.
    cell : float, optional
        Side [m]; by default that of a square as large as the raster's middle pixel.
    """
    rows, cols = placed.shape
    along = np.linspace(0, 1, 33)
    col = np.concatenate([along * cols, along * cols, 0 * along, 0 * along + cols])
    row = np.concatenate([0 * along, 0 * along + rows, along * rows, along * rows])
    edge = placed.absolute(col, row)[:, :2]
    if cell is None:
        middle = np.array([cols / 2, rows / 2])
        here = placed.absolute(*(middle[:, None] + np.array([[0, 1, 0], [0, 0, 1]])))[:, :2]
        # A round number: differences of large coordinates end in digits that mean nothing.
        cell = float(f"{np.sqrt(abs(np.linalg.det(here[1:] - here[0]))):.6g}")
    if not (np.isfinite(edge).all() and cell > 0):
        raise InputError("cannot be laid on a map: its corners are not finite there.")
    # Edges that are whole multiples already must not gain a row by rounding.
    west, south = np.floor(edge.min(axis=0) / cell + 1e-6)
    east, north = np.ceil(edge.max(axis=0) / cell - 1e-6)
    shape = (max(int(north - south), 1), max(int(east - west), 1))
    if shape[0] * shape[1] > MAX_CELLS:
        raise ResourceLimitError(
            f"would need {shape[0]} × {shape[1]} cells of {cell:g} m; {MAX_CELLS} are the limit."
        )
    return Grid(float(west * cell), float(north * cell), cell, shape, crs)


def regrid(
    values: Float32 | UInt8,
    valid: Bool,
    placed: Placed,
    grid: Grid,
    *,
    is_height: bool,
    surface: tuple[Float32, Placed] | None = None,
) -> tuple[Float32 | UInt8, Bool]:
    """Sample a raster bilinearly at the cell centres of `grid`.

    Parameters
    ----------
    values : (H, W) float32 or (H, W, C) uint8
    valid : (H, W) bool
        A new cell is valid where the nearest old pixel is; its value is the mean of the valid
        ones among the four around, by their bilinear weights.
    placed : Placed
    grid : Grid
    is_height : bool
        `values` are heights in the file's unit: they move up and down with the points.
    surface : (heights, their Placed), optional
        The DEM in file coordinates, for maps that tilt: a point's height then shifts it sideways.

    Returns
    -------
    values : (H', W') or (H', W', C), as `values`; heights absolute, NaN where not valid
    valid : (H', W') bool
    """
    source = _Source(placed, grid)
    rows, cols = grid.shape
    out = np.zeros((rows, cols, *values.shape[2:]), values.dtype)
    seen = np.zeros((rows, cols), bool)
    tilted = surface is not None and source.tilts(surface[0])
    for part in _row_blocks(rows, cols):
        x, y, up = source.at(part)
        height = np.full_like(x, placed.level)
        if tilted and surface is not None:
            for _ in range(3):  # a contraction by tilt times slope
                dx, dy = np.multiply.outer(source.lean, height - placed.level)
                sampled, known = _sample(
                    surface[0], np.isfinite(surface[0]), surface[1], x + dx, y + dy
                )
                height = np.where(known, sampled, height)
            dx, dy = np.multiply.outer(source.lean, height - placed.level)
            x, y = x + dx, y + dy
        part_values, seen[part] = _sample(values, valid, placed, x, y)
        if is_height:
            part_values = up + source.gain * (part_values - placed.level)
            part_values[~seen[part]] = np.nan
        elif out.dtype == np.uint8:
            part_values = np.rint(part_values)
        out[part] = part_values
    return out, seen


class _Source:
    """Where the cells of a grid come from: exact at nodes, bilinear between them.

    At a cell, file coordinates are ``(x, y) + lean * (z - level)`` and the new height is
    ``up + gain * (z - level)``, for the file height z.
    """

    def __init__(self, placed: Placed, grid: Grid) -> None:
        self.placed, self.grid = placed, grid
        rows, cols = placed.shape
        centre = placed.matrix @ [cols / 2, rows / 2, 1.0]
        self.pixel = float(np.sqrt(abs(np.linalg.det(placed.matrix[:, :2]))))
        self.start = np.array([*centre, placed.level])
        # Central differences over some ten pixels: the map is smooth at that size.
        step = np.diag([10 * self.pixel, 10 * self.pixel, 10.0])
        ends = placed.forward(np.concatenate([self.start + step, self.start - step]))
        self.slope = ((ends[:3] - ends[3:]) / (2 * np.diag(step)[:, None])).T
        self.back = np.linalg.inv(self.slope[:2, :2])
        self.lean = -self.back @ self.slope[:2, 2]
        self.gain = float(self.slope[2, 2] + self.slope[2, :2] @ self.lean)
        self.step = _STEP
        while True:
            self.nodes = self._nodes()
            if self.step == 1 or self._off_between_nodes() < 0.01 * self.pixel:
                break
            self.step //= 2

    def tilts(self, heights: Float32) -> bool:
        """Whether heights shift points sideways by a thousandth of a pixel or more."""
        finite = heights[np.isfinite(heights)]
        spread = float(np.ptp(finite)) if len(finite) else 0.0
        return bool(np.abs(self.lean).max() * spread > 1e-3 * self.pixel)

    def _nodes(self) -> Float64:
        rows, cols = (np.arange(0, n + self.step, self.step, dtype=float) for n in self.grid.shape)
        return self._solve(*np.meshgrid(rows, cols, indexing="ij"))

    def _solve(self, row: Float64, col: Float64) -> Float64:
        """Return file x, y and absolute up of cells, (..., 3), by Newton's method."""
        east, north = self.grid.east_north(row, col)
        target = np.stack([east.ravel(), north.ravel()], axis=1)
        points = np.tile(self.start, (len(target), 1))
        for _ in range(20):
            there = self.placed.forward(points)
            step = (target - there[:, :2]) @ self.back.T
            points[:, :2] += step
            if np.abs(step).max() < 1e-6 * self.pixel:
                break
        else:
            raise InputError("cannot be laid on a map there: the change of coordinates diverges.")
        return np.column_stack([points[:, :2], there[:, 2]]).reshape(*row.shape, 3)

    def _off_between_nodes(self) -> float:
        """Return how far (in file x, y) interpolation is off in the middle between nodes."""
        nodes = self.nodes
        middle = (nodes[1:, 1:] + nodes[:-1, 1:] + nodes[1:, :-1] + nodes[:-1, :-1]) / 4
        row, col = (self.step * (np.arange(n) + 0.5) for n in middle.shape[:2])
        exact = self._solve(*np.meshgrid(row, col, indexing="ij"))
        return float(np.abs(exact - middle)[..., :2].max())

    def at(self, rows: slice) -> tuple[Float64, Float64, Float64]:
        """Return file x, y and absolute up at `level` of a block of whole rows."""
        row = np.arange(rows.start, rows.stop) / self.step
        col = np.arange(self.grid.shape[1]) / self.step
        upper, left = row.astype(int), col.astype(int)
        down, right = (row - upper)[:, None, None], (col - left)[None, :, None]
        band = self.nodes[upper] * (1 - down) + self.nodes[upper + 1] * down
        x, y, up = np.moveaxis(band[:, left] * (1 - right) + band[:, left + 1] * right, 2, 0)
        return x, y, up


def _row_blocks(rows: int, cols: int) -> Iterator[slice]:
    step = max(1, _ROWS // cols)
    for start in range(0, rows, step):
        yield slice(start, min(start + step, rows))


def _sample(
    values: NDArray[np.float32] | UInt8, valid: Bool, placed: Placed, x: Float64, y: Float64
) -> tuple[Float64, Bool]:
    """Return bilinear values at file positions and whether the pixel there is valid."""
    rows, cols = valid.shape
    back = np.linalg.inv(placed.matrix[:, :2])
    col, row = np.tensordot(back, np.stack([x, y]) - placed.matrix[:, 2, None, None], 1) - 0.5
    near_row, near_col = np.rint(row), np.rint(col)
    inside = (near_row >= 0) & (near_row < rows) & (near_col >= 0) & (near_col < cols)
    ok = np.zeros(x.shape, bool)
    ok[inside] = valid[near_row[inside].astype(int), near_col[inside].astype(int)]
    row, col = row[ok], col[ok]
    top, left = np.floor(row).astype(int), np.floor(col).astype(int)
    total = np.zeros((len(row), *values.shape[2:]))
    weight = np.zeros(len(row))
    for down in (0, 1):
        for right in (0, 1):
            r, c = np.clip(top + down, 0, rows - 1), np.clip(left + right, 0, cols - 1)
            share = np.abs(1 - down - (row - top)) * np.abs(1 - right - (col - left)) * valid[r, c]
            weight += share
            value = np.where(share > 0, values[r, c].T, 0).T  # NaN times nothing is nothing
            total += (share * value.T).T
    out = np.zeros((*x.shape, *values.shape[2:]))
    out[ok] = (total.T / weight).T
    return out, ok
