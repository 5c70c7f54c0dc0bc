"""Deep zoom: square tiles of a GeoTIFF, read from its overviews, one open file a thread.

Level 0 shows the whole raster in one tile, each further one halves the cell, the last is the
raster itself: no tile is sampled between cells.
"""

from __future__ import annotations

import math
import threading
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.io.maps.geotiff import lattice, opened
from meshreg.records import Bool, Float64, Grid, UInt8

SIDE = 256  # pixels of a tile
_ANY_SIZE = 1 << 62


class TileSource:
    """A GeoTIFF of red, green, blue and alpha, north-up, that gives tiles to many threads.

    Attributes
    ----------
    path : Path
    grid : Grid
        Its cells.
    levels : int
        Levels are 0 to ``levels - 1``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with opened(path, _ANY_SIZE) as dataset:
            (cell, _, west), (_, _, north) = lattice(dataset, path).tolist()
            if dataset.count != 4 or dataset.dtypes[0] != "uint8":
                raise InputError(
                    f"has {dataset.count} bands of {dataset.dtypes[0]}; a picture made by meshreg "
                    "has four of uint8.",
                    file=path,
                )
            self.grid = Grid(west, north, cell, dataset.shape)
        longest = max(self.grid.shape)
        self.levels = max(0, math.ceil(math.log2(longest / SIDE))) + 1
        self._mine = threading.local()
        self._open: list[Any] = []
        self._lock = threading.Lock()

    @property
    def resolutions(self) -> list[float]:
        """Cell of each level [m]."""
        return [self.grid.cell * 2 ** (self.levels - 1 - k) for k in range(self.levels)]

    def tile(self, level: int, column: int, row: int) -> bytes | None:
        """Return a tile as PNG with alpha; None outside the raster."""
        if not 0 <= level < self.levels:
            return None
        step = 2 ** (self.levels - 1 - level)
        rows, cols = self.grid.shape
        top, left = row * SIDE * step, column * SIDE * step
        if min(row, column) < 0 or top >= rows or left >= cols:
            return None
        part = self._read(top, left, step, SIDE)
        picture = np.zeros((SIDE, SIDE, 4), np.uint8)
        picture[: part.shape[0], : part.shape[1]] = part
        return _png(picture)

    def mask(self, side: int = 256) -> tuple[Bool, float]:
        """Return where there is a picture, at most about `side` cells wide, and the cell [m]."""
        step = max(1, math.ceil(max(self.grid.shape) / side))
        return self._read(0, 0, step, side)[..., 3] > 127, self.grid.cell * step

    def close(self) -> None:
        """Close every thread's file."""
        with self._lock:
            for dataset in self._open:
                dataset.close()
            self._open.clear()
            self._mine = threading.local()

    def _dataset(self) -> Any:
        """Return this thread's handle: GDAL's datasets may not be shared between threads."""
        if not hasattr(self._mine, "dataset"):
            import rasterio

            self._mine.dataset = rasterio.open(self.path, driver="GTiff", sharing=False)
            with self._lock:
                self._open.append(self._mine.dataset)
        return self._mine.dataset

    def _read(self, top: int, left: int, step: int, side: int) -> UInt8:
        """Mean of blocks of `step` cells from a corner on, at most `side` of them each way.

        Incomplete blocks at the south and east edge are left out, so that a coarse cell lies
        where the level's grid has it; of a raster thinner than a block, one is kept.
        """
        from rasterio.enums import Resampling
        from rasterio.windows import Window

        left_over = [n - start for n, start in zip(self.grid.shape, (top, left), strict=True)]
        rows, cols = (max(1, min(side, n // step)) for n in left_over)
        high, wide = (min(n * step, rest) for n, rest in zip((rows, cols), left_over, strict=True))
        bands = self._dataset().read(
            [1, 2, 3, 4],
            window=Window(left, top, wide, high),
            out_shape=(4, rows, cols),
            resampling=Resampling.average if step > 1 else Resampling.nearest,
        )
        return np.ascontiguousarray(np.moveaxis(bands, 0, 2))


def _png(picture: UInt8) -> bytes:
    from PIL import Image

    stream = BytesIO()
    Image.fromarray(picture, "RGBA").save(stream, "PNG", compress_level=1)
    return stream.getvalue()


def overlap_points(reference: TileSource, moving: TileSource, shown_from_reference: Any) -> Float64:
    """Return cell centres (M, 2) [m] of the reference's ground that the moving picture shows too.

    Parameters
    ----------
    reference, moving : TileSource
    shown_from_reference : callable
        Takes reference points (N, 2) to the coordinates of the moving picture.
    """
    seen, cell = reference.mask(96)
    row, col = np.nonzero(seen)
    grid = reference.grid
    points = np.column_stack([grid.west + (col + 0.5) * cell, grid.north - (row + 0.5) * cell])
    other, other_cell = moving.mask(512)
    shown = np.asarray(shown_from_reference(points), float).reshape(-1, 2)
    i = np.floor((moving.grid.north - shown[:, 1]) / other_cell)
    j = np.floor((shown[:, 0] - moving.grid.west) / other_cell)
    inside = (i >= 0) & (i < other.shape[0]) & (j >= 0) & (j < other.shape[1])
    inside[inside] = other[i[inside].astype(int), j[inside].astype(int)]
    return np.asarray(points[inside])
