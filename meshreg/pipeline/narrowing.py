"""Where to look closely: coarse cells first, where the window of offsets is a large one.

A small plot in a large reference, looked for far off, costs the square of the radius over the
cell. Where that is much, both channels' evidence and the tiles' vote are asked on coarser cells at
every offset, and the pair's own cells about the few offsets that come out best. What the best of
them is then worth is judged in view of all the others, and of how much was looked through.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from meshreg.heading import coarse_turn, near_offset, part_of
from meshreg.judge import SCORED_OVERLAP, ChannelMap
from meshreg.offsets import neutral
from meshreg.offsets.correlate import Correlator, Window
from meshreg.raster.grid import coarsened
from meshreg.records import RASTER_OF, Channel, Float64, Grid, SurveyRaster
from meshreg.settings import SearchSettings

Pair = tuple[SurveyRaster, SurveyRaster]
PLENTY = 2_000_000  # cells of a transform of the image, up to which every offset is looked at
COARSE = 1_000_000  # of the coarse one
LEAST_GAIN = 3  # times that a closer window must be smaller
MARGIN = 100  # DEM cells about a place: the default search radius
LEAST_ACROSS = 32  # coarse cells across the smaller survey
PLACES = 6
AS_MUCH = 0.9  # of the overlap that another window has: seen there as well as here
PEAKS = 4  # of each channel, and of both together


@dataclass(frozen=True)
class Elsewhere:
    """What was seen beyond the window that is judged.

    Attributes
    ----------
    times : int
        The offsets that were searched, over those in the window: chance is so much likelier.
    values : mapping
        The highest evidence of each channel at another place.
    """

    times: int = 1
    values: Mapping[str, float] = field(default_factory=dict)


NOWHERE = Elsewhere()


def margin(reference: Grid, moving: Grid) -> float:
    """Return how far [m] about a place the pair's own cells are looked at."""
    smaller = min(max(reference.shape), max(moving.shape))
    return max(MARGIN, smaller // 2) * reference.cell


def narrowing(dem: tuple[Grid, Grid], ortho: tuple[Grid, Grid], radius: float) -> int:
    """Return the DEM cells to a cell of the first look; 1 where every offset is looked at at once.

    Parameters
    ----------
    dem, ortho : (reference, moving) Grid
    radius : float
        Half width of the search window [m].
    """
    window = Window.around(*ortho, radius)
    about = margin(*dem)
    if window.empty or radius <= 2 * about or math.prod(window.padded) <= PLENTY:
        return 1
    closer = math.prod(cut_sizes(*ortho, radius, about))
    if LEAST_GAIN * closer > math.prod(window.padded):
        return 1
    across = min(min(grid.shape) for grid in dem)
    times = math.ceil(math.sqrt(math.prod(Window.around(*dem, radius).padded) / COARSE))
    return max(1, min(times, across // LEAST_ACROSS))


def cut_sizes(reference: Grid, moving: Grid, radius: float, about: float) -> tuple[int, int]:
    """Rows and columns of the transform that holds both surveys, cut to `about` m of a place."""
    whole = Window.around(reference, moving, radius).padded
    more = math.ceil(2 * about / reference.cell)
    rows, cols = (
        min(a, b + more) + min(b, a + more)
        for a, b in zip(reference.shape, moving.shape, strict=True)
    )
    return min(rows, whole[0]), min(cols, whole[1])


def places(
    pairs: Mapping[str, Pair], settings: SearchSettings, radius: float, times: int
) -> list[tuple[float, float]]:
    """Return the offsets (east, north) [m] that are best on cells of `times` DEM cells.

    Parameters
    ----------
    pairs : mapping
        "dem" and "ortho" to (reference, moving).
    settings : SearchSettings
    radius : float
        Half width of the search window [m].
    times : int
        As `narrowing` returns it.
    """
    cell = times * pairs["dem"][0].grid.cell
    seen: list[tuple[Window, Float64]] = []
    for channel, name in RASTER_OF.items():
        found = _coarse_evidence(pairs[name], channel, cell, radius)
        if found is not None:
            seen.append(found)
    if len(seen) == 2 and seen[0][1].shape == seen[1][1].shape:
        seen.insert(0, (seen[0][0], seen[0][1] + seen[1][1]))
    ranked = [_tops(window, surface) for window, surface in seen]
    turn = coarse_turn(pairs, cell, settings, radius)
    if turn is not None:
        ranked.insert(0, [turn.offset])
    apart = 0.5 * margin(*(raster.grid for raster in pairs["dem"]))
    kept: list[tuple[float, float]] = []
    for rank in range(PEAKS):
        for tops in ranked:
            if rank < len(tops) and all(math.dist(tops[rank], one) > apart for one in kept):
                kept.append(tops[rank])
    return kept[:PLACES]


def cut(pairs: Mapping[str, Pair], place: tuple[float, float], about: float) -> dict[str, Pair]:
    """Cut off of both surveys what lies further than `about` m from the other, moved to a place."""
    return {
        name: (
            near_offset(reference, moving, place, about),
            near_offset(moving, reference, (-place[0], -place[1]), about),
        )
        for name, (reference, moving) in pairs.items()
    }


def elsewhere(
    chosen: Mapping[str, ChannelMap],
    others: list[Mapping[str, ChannelMap]],
    whole: Window,
) -> Elsewhere:
    """Say what the other places show at offsets at which the chosen one's cut shows less."""
    values: dict[str, float] = {}
    for name, channel in chosen.items():
        for other in others:
            if name not in other:
                continue
            beside, surface = other[name], other[name].surface
            seen = _counts_at(channel, beside.window) >= AS_MUCH * beside.counts
            rest = surface[~seen & np.isfinite(surface)]
            if rest.size:
                values[name] = max(values.get(name, -math.inf), float(rest.max()))
    area = min((channel.window.area for channel in chosen.values()), default=whole.area)
    return Elsewhere(max(1, math.ceil(whole.area / max(area, 1e-12))), values)


def _counts_at(channel: ChannelMap, window: Window) -> Float64:
    """Cells of a channel's overlap at the offsets of another window; 0 outside of its own."""
    counts = np.zeros((len(window.north), len(window.east)))
    own = channel.window
    rows = np.rint((own.north[0] - window.north) / own.cell).astype(int)
    cols = np.rint((window.east - own.east[0]) / own.cell).astype(int)
    inner = [
        np.flatnonzero((index >= 0) & (index < size))
        for index, size in zip((rows, cols), channel.counts.shape, strict=True)
    ]
    counts[np.ix_(*inner)] = channel.counts[np.ix_(rows[inner[0]], cols[inner[1]])]
    return counts


def _coarse_evidence(
    pair: Pair, channel: Channel, cell: float, radius: float
) -> tuple[Window, Float64] | None:
    """Evidence of a channel for each offset, on coarse cells of one lattice."""
    masks = [raster.mask_of(channel) for raster in pair]
    if min(int(mask.sum()) for mask in masks) < 100:
        return None
    times = max(1, round(cell / pair[0].grid.cell))
    reference, moving = (coarsened(_aligned(raster, times), times) for raster in pair)
    window = Window.around(reference.grid, moving.grid, radius)
    if window.empty:
        return None
    correlator = Correlator(window, single=True)
    spectra = [
        neutral.spectra(fields, correlator)
        for fields in neutral.pair_fields(reference, moving, channel)
    ]
    surface, _ = neutral.surface(spectra[0], spectra[1], correlator, SCORED_OVERLAP)
    return window, surface


def _aligned(raster: SurveyRaster, times: int) -> SurveyRaster:
    """Cut rows in the north and columns in the west, so that blocks lie on one lattice."""
    grid = raster.grid
    top = round(grid.north / grid.cell) % times
    left = -round(grid.west / grid.cell) % times
    if top >= grid.shape[0] or left >= grid.shape[1]:
        return raster
    return part_of(raster, slice(top, grid.shape[0]), slice(left, grid.shape[1]))


def _tops(window: Window, surface: Float64) -> list[tuple[float, float]]:
    """Offsets of the `PEAKS` highest local maxima."""
    from scipy.ndimage import maximum_filter

    known = np.where(np.isfinite(surface), surface, -np.inf)
    tops = (maximum_filter(known, 7) == known) & np.isfinite(known)
    at = np.argwhere(tops)
    order = np.argsort(-known[tops], kind="stable")[:PEAKS]
    return [(float(window.east[col]), float(window.north[row])) for row, col in at[order]]
