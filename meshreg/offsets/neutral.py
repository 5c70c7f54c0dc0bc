"""The one measure by which every candidate offset is judged, whichever method proposed it.

Terrain and image are each reduced to a few change-resistant fields (`channels`). A field's
correlation over the overlap, ``C / sqrt(Q1 Q2) * sqrt(N)``, has the same spread under chance at
every overlap N; fields of one channel are added in units of that spread. What chance can do on
this very ground is measured on the same two surveys with the moving one mirrored and turned:
same texture, same holes, no true match.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from meshreg.offsets.channels import grey, high_pass, local_normalised, orientation
from meshreg.offsets.correlate import Correlator, Window, overlap_floor
from meshreg.offsets.surface import MAD_TO_SIGMA
from meshreg.types import Bool, Float64, Grid, SurveyRaster

Channel = Literal["terrain", "image"]


@dataclass(frozen=True)
class Field:
    """Components that are correlated together, zero outside `mask`."""

    name: str
    parts: tuple[Float64, ...]
    mask: Bool


def fields(raster: SurveyRaster, channel: Channel) -> list[Field]:
    """Change-resistant fields of one raster."""
    if channel == "terrain":
        mask = raster.valid
        height = raster.height.astype(np.float64)
        height = np.where(mask, height - (np.median(height[mask]) if mask.any() else 0.0), 0.0)
        fine = Field("height above 2 cells' mean", (high_pass(height, mask, 2.0),), mask)
        coarse = Field("height above 5 cells' mean", (high_pass(height, mask, 5.0),), mask)
        slope = Field("slope direction", *orientation(height, mask, 1.0, signed=True))
        return [fine, coarse, slope]
    mask = raster.color_valid
    image = grey(raster)
    level = Field("grey", (np.clip(local_normalised(image, mask, 6.0), -3, 3),), mask)
    signed = Field("edge direction", *orientation(image, mask, 1.0, signed=True))
    unsigned = Field("edge direction, either sign", *orientation(image, mask, 1.0, signed=False))
    coarse = Field("coarse edges, either sign", *orientation(image, mask, 3.0, signed=False))
    return [level, signed, unsigned, coarse]


def surface(
    first: Sequence[Field], second: Sequence[Field], window: Window, min_overlap: float
) -> tuple[Float64, Float64]:
    """Evidence for each offset, in deviations of what chance does, and the overlap's cells.

    Returns
    -------
    evidence : (K, L) float64
        NaN where the overlap is too small.
    counts : (K, L) float64
    """
    correlator = Correlator(window)
    counts = np.zeros((len(window.rows), len(window.cols)))
    total = np.zeros_like(counts)
    scored = np.ones(counts.shape, bool)
    for a, b in zip(first, second, strict=True):
        mask1, mask2 = correlator.transform(a.mask), correlator.transform(b.mask)
        n = correlator.counts(mask1, mask2)
        scored &= overlap_floor(n, min_overlap)
        pairs = [
            (correlator.transform(p), correlator.transform(q))
            for p, q in zip(a.parts, b.parts, strict=True)
        ]
        cross = correlator.sums(*pairs)
        power1 = correlator.sums((correlator.transform(_power(a)), mask2))
        power2 = correlator.sums((mask1, correlator.transform(_power(b))))
        power = np.sqrt(np.maximum(power1, 0) * np.maximum(power2, 0))
        usable = scored & (power > 1e-12 * np.maximum(n, 1))
        z = np.divide(cross, power, out=np.zeros_like(cross), where=usable) * np.sqrt(n)
        total += _in_deviations(z, usable)
        counts = np.maximum(counts, n)
    evidence = _in_deviations(total, scored)
    return np.where(scored, evidence, np.nan), counts


def mirrored(field: Field, turn: int, flip: bool) -> Field:
    """Return the field turned by quarter turns and flipped: same texture, another place.

    Components that are directions need no turning along: under chance their sign is arbitrary.
    """

    def turned(array: Any) -> Any:
        array = np.rot90(array, turn)
        return np.ascontiguousarray(np.fliplr(array) if flip else array)

    return Field(field.name, tuple(turned(p) for p in field.parts), turned(field.mask))


def turned_grid(grid: Grid, turn: int) -> Grid:
    """Grid of a turned raster, about the same centre, kept on the lattice."""
    if turn % 2 == 0:
        return grid
    rows, cols = grid.shape
    shift = (cols - rows) // 2
    return Grid(
        grid.west + shift * grid.cell,
        grid.north + shift * grid.cell,
        grid.cell,
        (cols, rows),
        grid.crs,
    )


def _power(field: Field) -> Float64:
    return np.asarray(sum(part**2 for part in field.parts))


def _in_deviations(values: Float64, use: Any) -> Float64:
    """Subtract the median and divide by the robust spread of the cells in use."""
    if not use.any():
        return np.zeros_like(values)
    middle = float(np.median(values[use]))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(values[use] - middle)))
    return (values - middle) / spread if spread > 0 else np.zeros_like(values)
