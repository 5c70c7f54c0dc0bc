"""The one measure by which every candidate offset is judged, whichever method proposed it.

Terrain and image are each reduced to a few change-resistant fields (`channels`). A field's
correlation over the overlap, ``C / sqrt(Q1 Q2) * sqrt(N)``, has the same spread under chance at
every overlap N; fields of one channel are added in units of that spread. What chance can do on
this very ground is measured on the same two surveys with the moving one mirrored, turned, or cut
into halves or quarters that change places: same texture, same holes, no true match.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal

import numpy as np

from meshreg.offsets.channels import grey, high_pass, local_normalised, orientation
from meshreg.offsets.correlate import Complex, Correlator, overlap_floor
from meshreg.records import Bool, Channel, Float64, Grid, SurveyRaster
from meshreg.statistics import MAD_TO_SIGMA

_MANY = 1 << 16  # offsets: a quarter of them tells their spread as well
Kind = Literal["scalar", "vector", "director"]
Parts = tuple[Float64, ...]
Step = tuple[int, int]


@dataclass(frozen=True)
class Fields:
    """A channel's change-resistant fields of one raster, zero outside their common mask.

    `parts` holds for each field the components that are correlated together; `kinds` how they
    turn with the raster: a scalar, a vector (d/drow, d/dcol), or a director (doubled angle).
    """

    mask: Bool
    parts: tuple[Parts, ...]
    kinds: tuple[Kind, ...]

    def mapped(self, change: Callable[[Any], Any]) -> Fields:
        """Return the same fields with `change` applied to every array."""
        parts = tuple(tuple(change(p) for p in field) for field in self.parts)
        return Fields(change(self.mask), parts, self.kinds)

    def turned(self, turn: int, flip: bool) -> Fields:
        """Return the fields that the raster would have, turned by quarter turns, then flipped."""
        kinds, parts = self.kinds, self.parts
        for _ in range(turn % 4):
            parts = tuple(_quarter_turn(k, p) for k, p in zip(kinds, parts, strict=True))
        if flip:
            parts = tuple(_flipped(k, p) for k, p in zip(kinds, parts, strict=True))

        def moved(array: Any) -> Any:
            array = np.rot90(array, turn)
            return np.ascontiguousarray(np.fliplr(array) if flip else array)

        return Fields(self.mask, parts, kinds).mapped(moved)

    def exchanged(self, down: bool, across: bool) -> tuple[Fields, tuple[Step, ...]]:
        """Return the fields with their halves (both: quarters) in each other's place, and how far.

        The steps are the whole numbers of rows and columns by which the parts were moved; where a
        survey has a true match, the exchanged one has a part of it at each of them.
        """
        rows, cols = (np.flatnonzero(self.mask.any(axis=axis)) for axis in (1, 0))
        if not rows.size:
            return self, ((0, 0),)
        box = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        height, width = rows[-1] + 1 - rows[0], cols[-1] + 1 - cols[0]
        half = int(height // 2 * down), int(width // 2 * across)

        def moved(array: Any) -> Any:
            array = array.copy()
            array[box] = np.roll(array[box], half, (0, 1))
            return array

        steps = (half[0], half[0] - int(height)), (half[1], half[1] - int(width))
        places = [axis if step else (0,) for axis, step in zip(steps, half, strict=True)]
        return self.mapped(moved), tuple((row, col) for row in places[0] for col in places[1])


def _quarter_turn(kind: Kind, parts: Parts) -> Parts:
    if kind == "scalar":
        return parts
    first, second = parts
    return (-second, first) if kind == "vector" else (-first, -second)


def _flipped(kind: Kind, parts: Parts) -> Parts:
    return parts if kind == "scalar" else (parts[0], -parts[1])


def fields(raster: SurveyRaster, channel: Channel) -> Fields:
    """Reduce a raster to its change-resistant fields: height or grey, and slope directions."""
    kinds: tuple[Kind, ...]
    if channel == "terrain":
        mask = raster.valid
        height = raster.height.astype(np.float64)
        height = np.where(mask, height - (np.median(height[mask]) if mask.any() else 0.0), 0.0)
        slope, inner = orientation(height, mask, 1.0, signed=True)
        parts: list[Parts] = [
            (high_pass(height, mask, 2.0),),
            (high_pass(height, mask, 5.0),),
            slope,
        ]
        kinds = ("scalar", "scalar", "vector")
    else:
        mask, image = raster.color_valid, grey(raster)
        # bleached coral is bright where it was dark: signed edges are sharp, unsigned survive
        coarse, inner = orientation(image, mask, 3.0, signed=False)
        parts = [
            (np.clip(local_normalised(image, mask, 6.0), -3, 3),),
            orientation(image, mask, 1.0, signed=True)[0],
            orientation(image, mask, 1.0, signed=False)[0],
            coarse,
        ]
        kinds = ("scalar", "vector", "director", "director")
    kept = tuple(tuple(np.where(inner, p, 0.0) for p in field) for field in parts)
    return Fields(inner, kept, kinds)


def pair_fields(
    reference: SurveyRaster, moving: SurveyRaster, channel: Channel
) -> tuple[Fields, Fields]:
    """Return `fields` of both surveys."""
    return fields(reference, channel), fields(moving, channel)


FieldsOf = Callable[[SurveyRaster, SurveyRaster, Channel], tuple[Fields, Fields]]


@dataclass(frozen=True)
class Spectra:
    """Forward transforms of a raster's fields, made once for many windows of one shape."""

    mask: Complex
    parts: tuple[tuple[Complex, ...], ...]
    powers: tuple[Complex, ...]


def spectra(of: Fields, correlator: Correlator) -> Spectra:
    """Transform a raster's fields."""
    powers = [sum(p**2 for p in field) for field in of.parts]
    parts = [p for field in of.parts for p in field]
    mask, *rest = correlator.transforms([of.mask, *powers, *parts])
    after = iter(rest[len(powers) :])
    fields = tuple(tuple(islice(after, len(field))) for field in of.parts)
    return Spectra(mask, fields, tuple(rest[: len(powers)]))


def surface(
    first: Spectra, second: Spectra, correlator: Correlator, min_overlap: float
) -> tuple[Float64, Float64]:
    """Evidence for each offset, in deviations of what chance does, and the overlap's cells.

    Returns
    -------
    evidence : (K, L) float64
        NaN where the overlap is too small.
    counts : (K, L) float64
    """
    each, counts, scored = evidence_of_fields(first, second, correlator, min_overlap)
    total = np.zeros(counts.shape)
    for field in each:
        total += field
    evidence = _in_deviations(total, scored)
    return np.where(scored, evidence, np.nan), counts


def evidence_of_fields(
    first: Spectra, second: Spectra, correlator: Correlator, min_overlap: float
) -> tuple[list[Float64], Float64, Bool]:
    """Evidence (K, L) of each field, 0 where unknown; the overlap's cells; where it is scored."""
    counts = correlator.counts(first.mask, second.mask)
    scored = overlap_floor(counts, min_overlap)
    each = []
    for a, b, power_a, power_b in zip(
        first.parts, second.parts, first.powers, second.powers, strict=True
    ):
        cross, *powers = correlator.all_sums(
            list(zip(a, b, strict=True)), [(power_a, second.mask)], [(first.mask, power_b)]
        )
        power = np.sqrt(np.maximum(powers[0], 0) * np.maximum(powers[1], 0))
        usable = scored & (power > 1e-6 * np.maximum(power.max(), 1e-300))
        z = np.divide(cross, power, out=np.zeros_like(cross), where=usable) * np.sqrt(counts)
        each.append(_in_deviations(z, usable))
    return each, counts, scored


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


def _in_deviations(values: Float64, use: Any) -> Float64:
    """Subtract the median and divide by the robust spread of the cells in use."""
    some = (slice(None, None, 2 if values.size > _MANY else 1),) * 2
    known = values[some][use[some]]
    if not known.size:
        return np.zeros_like(values)
    middle = float(np.median(known))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(known - middle)))
    return (values - middle) / spread if spread > 0 else np.zeros_like(values)
