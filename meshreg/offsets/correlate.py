"""Sums over the overlap, for every offset in a window at once, by FFT.

A moving raster laid `s` rows and columns further on the reference pairs the cells
``reference[r + s] ~ moving[r]``. For each of the exhaustive searches all that is needed is
``sum_r a[r + s] * b[r]`` for several pairs of arrays a, b that are zero outside their masks
(Padfield, "Masked object registration in the Fourier domain", IEEE TIP 21(5), 2012).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import UsageError
from meshreg.records import Bool, Float64, Grid

Complex = NDArray[np.complexfloating[Any, Any]]
_SMALL = 1 << 16  # cells of a transform; more of them at once would leave the cache
WORKERS = min(2, os.cpu_count() or 1)  # fixed, so that results do not depend on the machine's size


@dataclass(frozen=True)
class Window:
    """The offsets that are searched: whole cells from the nominal position.

    Attributes
    ----------
    cell : float
        Step of the search [m].
    rows, cols : (K,), (L,) int
        Shifts `s` of the moving raster's first row and column in the reference raster.
    east, north : (L,), (K,) float64
        The offsets [m] that they mean: what is added to moving coordinates.
    shapes : pair of pairs
        Shapes of the reference and the moving raster.
    """

    cell: float
    rows: NDArray[np.int64]
    cols: NDArray[np.int64]
    east: Float64
    north: Float64
    shapes: tuple[tuple[int, int], tuple[int, int]]

    @classmethod
    def around(cls, reference: Grid, moving: Grid, radius: float) -> Window:
        """Return all offsets of up to `radius` metres east or north, on the grids' lattice.

        Those at which the rasters have no cell in common are left out: a small plot costs as much
        as its own size asks, however far one looks for it.

        Raises
        ------
        UsageError
            If the grids differ in cell size or are not shifted by whole cells.
        """
        if not np.isclose(reference.cell, moving.cell, rtol=1e-9, atol=0):
            raise UsageError(
                f"The rasters' cells differ: {reference.cell} and {moving.cell} m.",
                remedy="Rasterize both on the same cell.",
            )
        cell = reference.cell
        row = (reference.north - moving.north) / cell
        col = (moving.west - reference.west) / cell
        if max(abs(row - round(row)), abs(col - round(col))) > 1e-3:
            raise UsageError(
                f"The rasters' grids are {row:.4f} rows and {col:.4f} columns apart, "
                "not a whole number.",
                remedy="Snap both to one lattice (meshreg.raster.survey_grid).",
            )
        reach = max(1, int(np.floor(radius / cell + 1e-6)))
        down, across = (
            np.arange(max(-reach, 1 - there - nominal), min(reach, here - 1 - nominal) + 1)
            for nominal, here, there in zip(
                (round(row), round(col)), reference.shape, moving.shape, strict=True
            )
        )
        return cls(
            cell,
            down + round(row),
            across + round(col),
            np.asarray(across * cell, np.float64),
            np.asarray(-down * cell, np.float64),
            (reference.shape, moving.shape),
        )

    @property
    def empty(self) -> bool:
        """Whether the rasters do not overlap at any offset of the window."""
        return not (len(self.rows) and len(self.cols))

    def exclusion(self, cells: float) -> float:
        """Return how far from a peak [m] its rivals begin.

        Half a metre, or so many cells where those are coarse; a tenth of a small plot's window.
        """
        wide = float(max(np.ptp(self.east), np.ptp(self.north)))
        return max(min(0.5, 0.1 * wide), cells * self.cell)

    @property
    def area(self) -> float:
        """Area of the offsets that are searched [m²]."""
        return float(np.ptp(self.east) * np.ptp(self.north))

    @cached_property
    def padded(self) -> tuple[int, int]:
        """Smallest FFT size at which no offset in the window wraps round."""
        from scipy.fft import next_fast_len

        sizes = []
        for axis, shifts in enumerate((self.rows, self.cols)):
            n_reference, n_moving = self.shapes[0][axis], self.shapes[1][axis]
            need = max(n_reference, n_moving)
            if len(shifts):
                need = max(need, n_reference - shifts[0], n_moving + shifts[-1])
            # axis 1 is the real transform's, which likes its own sizes
            sizes.append(int(next_fast_len(int(need), real=axis == 1)))
        return sizes[0], sizes[1]


@dataclass(frozen=True)
class Correlator:
    """Masked sums over the window's offsets; each array is transformed once and reused.

    `single` computes in float32, twice as fast: for fields of zero mean and unit size, where six
    digits are plenty, not for heights or exact counts. `workers` are the threads of a transform:
    for a small window more than one cost more than they bring.
    """

    window: Window
    single: bool = False
    workers: int | None = None

    def transform(self, array: Any) -> Complex:
        """Forward transform of one raster, zero outside its mask."""
        from scipy.fft import rfft2

        array = np.asarray(array, np.float32 if self.single else np.float64)
        return np.asarray(rfft2(array, s=self.window.padded, workers=self.workers or WORKERS))

    def sums(self, *pairs: tuple[Complex, Complex]) -> Float64:
        """``sum over pairs of sum_r a[r + s] b[r]`` for each offset, (K, L) float64."""
        return self._windowed(_product(pairs))

    def transforms(self, arrays: Sequence[Any]) -> Sequence[Complex]:
        """Forward transform of each; of small ones at once, since each call has its price."""
        if self._small:
            return list(self.transform(np.stack(arrays)))
        return [self.transform(array) for array in arrays]

    def all_sums(self, *sums: Sequence[tuple[Complex, Complex]]) -> Sequence[Float64]:
        """Compute `sums` of each set of pairs; of small ones at once."""
        if self._small:
            return list(self._windowed(np.stack([_product(pairs) for pairs in sums])))
        return [self.sums(*pairs) for pairs in sums]

    @property
    def _small(self) -> bool:
        rows, cols = self.window.padded
        return rows * cols <= _SMALL

    def _windowed(self, product: Complex) -> Float64:
        cols = self.window.cols % self.window.padded[1]
        return np.asarray(self.rows_back(product)[..., cols], np.float64)

    def rows_back(self, product: Any) -> Any:
        """Inverse transform (..., K, padded columns) of the window's rows alone.

        Transforming the columns first leaves only the rows that are asked for to the second pass.
        """
        from scipy.fft import ifft, irfft

        size = self.window.padded
        half = ifft(product, axis=-2, workers=self.workers or WORKERS, overwrite_x=True)
        asked = half[..., self.window.rows % size[0], :]
        return irfft(asked, n=size[1], axis=-1, workers=self.workers or WORKERS, overwrite_x=True)

    def counts(self, a: Complex, b: Complex) -> Float64:
        """Like `sums`, of two masks: whole numbers."""
        return np.rint(self.sums((a, b)))


def _product(pairs: Sequence[tuple[Complex, Complex]]) -> Complex:
    product = pairs[0][0] * np.conj(pairs[0][1])
    for a, b in pairs[1:]:
        product += a * np.conj(b)
    return product


def overlap_floor(counts: Float64, share: float) -> Bool:
    """Return where the overlap is scored: at least `share` of the largest in the window."""
    largest = float(counts.max()) if counts.size else 0.0
    return np.asarray(counts >= max(share * largest, 1.0))
