"""A lattice of square cells, and a survey's heights and color on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import UsageError
from meshreg.records.arrays import NOTHING, Bool, Float32, Float64, UInt8, frozen, put

Channel = Literal["terrain", "image"]
# which raster of a pair each is of
RASTER_OF: dict[Channel, str] = {"terrain": "dem", "image": "ortho"}


@dataclass(frozen=True)
class Grid:
    """A north-up raster lattice. This class is the only place where the half cell is written.

    Attributes
    ----------
    west, north : float
        Outer north-west corner (of the cell, not its centre), absolute [m].
    cell : float
        Side of a cell [m].
    shape : (rows, cols)
    crs : str or None
    """

    west: float
    north: float
    cell: float
    shape: tuple[int, int]
    crs: str | None = None

    def __post_init__(self) -> None:
        if not (self.cell > 0 and np.isfinite([self.west, self.north, self.cell]).all()):
            raise UsageError(
                f"Grid needs finite corners and a positive cell; got west {self.west}, "
                f"north {self.north}, cell {self.cell}."
            )
        rows, cols = self.shape
        if rows < 1 or cols < 1:
            raise UsageError(f"Grid.shape is {self.shape}; it needs at least one row and column.")
        put(self, "shape", (int(rows), int(cols)))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Outer edges: west, south, east, north [m]."""
        rows, cols = self.shape
        return (
            self.west,
            self.north - rows * self.cell,
            self.west + cols * self.cell,
            self.north,
        )

    def row_col(self, east: Any, north: Any) -> tuple[Float64, Float64]:
        """Fractional row and column of absolute points; whole numbers are cell centres."""
        row = (self.north - np.asarray(north, float)) / self.cell - 0.5
        col = (np.asarray(east, float) - self.west) / self.cell - 0.5
        return row, col

    def east_north(self, row: Any, col: Any) -> tuple[Float64, Float64]:
        """Absolute coordinates [m] of fractional rows and columns (inverse of `row_col`)."""
        east = self.west + (np.asarray(col, float) + 0.5) * self.cell
        north = self.north - (np.asarray(row, float) + 0.5) * self.cell
        return east, north

    def divided(self, times: int) -> Grid:
        """Return the same extent in cells `times` smaller."""
        rows, cols = self.shape
        return replace(self, cell=self.cell / times, shape=(rows * times, cols * times))


@dataclass(frozen=True, eq=False)
class SurveyRaster:
    """A survey seen from above on a grid: area means per cell.

    Attributes
    ----------
    grid : Grid
    height : (H, W) float32
        Metres up, absolute minus `datum`, NaN where there is no surface.
    color : (H, W, 3) uint8
        Zero where `color_valid` is False.
    valid : (H, W) bool
        Where `height` is a number.
    color_valid : (H, W) bool
        Where `color` was seen.
    samples : (H, W) uint16
        Fine samples (mesh) or points (cloud) behind each height.
    datum : float
        Metres to add to `height` for absolute heights, so that float32 keeps its millimetres.
    masked : mapping
        Counts of what was left out: "floaters", "flat color", "mask", ...
    """

    grid: Grid
    height: Float32
    color: UInt8
    valid: Bool
    color_valid: Bool
    samples: NDArray[np.uint16]
    datum: float = 0.0
    masked: Mapping[str, int] = field(default_factory=lambda: NOTHING)

    def __post_init__(self) -> None:
        shape = self.grid.shape
        put(self, "height", frozen(self.height, np.float32, shape, "SurveyRaster.height"))
        put(self, "color", frozen(self.color, np.uint8, (*shape, 3), "SurveyRaster.color"))
        put(self, "valid", frozen(self.valid, np.bool_, shape, "SurveyRaster.valid"))
        seen = frozen(self.color_valid, np.bool_, shape, "SurveyRaster.color_valid")
        put(self, "color_valid", seen)
        put(self, "samples", frozen(self.samples, np.uint16, shape, "SurveyRaster.samples"))

    def mask_of(self, channel: Channel) -> Bool:
        """(H, W) bool: where a channel has data."""
        return self.valid if channel == "terrain" else self.color_valid
