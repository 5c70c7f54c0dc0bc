"""Move a raster: sample it where each cell of a new north-up grid comes from.

One code serves files that are rotated, not square or in degrees, maps that go to another CRS, and
registered maps. A moved raster is always sampled anew; editing its header could not turn it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.errors import InputError, ResourceLimitError
from meshreg.records import Bool, Float32, Float64, Grid, UInt8

Forward = Callable[[Float64], Float64]
_STEP = 32  # cells between nodes at which the map is solved exactly
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
    from meshreg.io.maps import regrid_kernels

    source = Source(placed, grid)
    out = np.zeros((*grid.shape, *values.shape[2:]), values.dtype)
    seen = np.zeros(grid.shape, bool)
    ground, lattice = np.zeros((0, 0), np.float32), placed
    if surface is not None and source.tilts(surface[0]):
        ground, lattice = surface
    regrid_kernels.resample(
        _fixed(values.reshape(*valid.shape, -1)),
        _fixed(valid),
        _back(placed.matrix),
        source.nodes,
        source.step,
        _fixed(ground[..., None]),
        _fixed(np.isfinite(ground)),
        _back(lattice.matrix),
        source.lean,
        source.gain,
        placed.level,
        is_height,
        out.reshape(*grid.shape, -1),
        seen,
    )
    return out, seen


def _fixed(array: Any) -> Any:
    """Return a contiguous read-only view, so that the kernel is compiled once and not for both."""
    array = np.ascontiguousarray(array).view()
    array.flags.writeable = False
    return array


def _back(matrix: Float64) -> Float64:
    """Return the (2, 3) inverse of a (2, 3) affine matrix."""
    return np.asarray(np.linalg.inv(np.vstack([matrix, [0.0, 0.0, 1.0]]))[:2])


class Source:
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
