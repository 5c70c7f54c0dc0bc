"""How far each tile of the moving survey must go, measured alone.

Two measures: correlation, which finds a tile from up to ±1° of yaw away, and Gauss-Newton on
high-passed heights, which then reads it to a hundredth of a cell. High-passing takes out the warp
and doming that bias a fit of raw heights by centimetres; working tile by tile keeps the internal
horizontal warp of the models from bending a single global fit toward where they happen to agree.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.offsets import correlate, neutral
from meshreg.offsets.channels import smooth
from meshreg.offsets.correlate import Correlator, Window
from meshreg.offsets.error_bars import whole_shift
from meshreg.offsets.surface import find_peak
from meshreg.records import Bool, Channel, Float64, Grid, OffsetAt, SurveyRaster

MAX_YAW = np.deg2rad(1.0)
HIGH_PASS = 2.0  # cells: finer than any warp, coarser than the noise of single cells
# The fields are two of tones and two of edges, and what all lean to none of them shows: two
# sigmas of what they differ by (the variance of two about their mean, doubled for its own doubt).
ALIKE = 2.0
STACKED = 64  # tiles whose evidence is added, at most
# Cells about a tile's own offset: what a field would have instead of it lies within the fields'
# own width (`neutral.fields`: six cells, to either side); beyond it is chance.
STACK_REACH, PEAK_REACH = 24, 1.5
TILE_CELLS = 36  # at most; on small patches at least 7 tiles a side as long as they hold 16 cells


@dataclass(frozen=True, eq=False)
class TileOffsets:
    """How far each tile must go.

    Attributes
    ----------
    places : (M, 2) float64
        Centres of the moving tiles, absolute east and north [m].
    offsets : (M, 2) float64
        East and north [m] to add to moving coordinates.
    block : (M,) int
        Tiles at the same place share a block, whichever channel saw them.
    channel : (M,) int
        Which of the channels matched it.
    side : int
        Cells along a tile's side.
    noise : (M, 2) float64 or None
        Variance of each tile's east and north, in units that all tiles share; None: alike.
    """

    places: Float64
    offsets: Float64
    block: np.ndarray
    channel: np.ndarray
    side: int = TILE_CELLS
    noise: Float64 | None = None

    def only(self, keep: Bool) -> TileOffsets:
        """Return the tiles where `keep` (M,) is True."""
        block, channel = self.block[keep], self.channel[keep]
        noise = None if self.noise is None else self.noise[keep]
        return TileOffsets(self.places[keep], self.offsets[keep], block, channel, self.side, noise)


@dataclass(frozen=True)
class Overlap:
    """The moving cells that fall on the reference at an offset, to the cell.

    `rows` and `cols` are (low, high) in the moving raster; `shift` takes a moving cell's row and
    column to the reference's; `offset` is the (east, north) that this means exactly [m].
    """

    rows: tuple[int, int]
    cols: tuple[int, int]
    shift: tuple[int, int]
    offset: tuple[float, float]

    @classmethod
    def at(cls, reference: Grid, moving: Grid, offset: tuple[float, float]) -> Overlap:
        """Return the overlap at the whole-cell offset nearest to `offset`."""
        cell = moving.cell
        steps = round(offset[1] / cell), round(offset[0] / cell)
        row, col = whole_shift((reference, moving), (steps[1] * cell, steps[0] * cell))
        rows = max(0, -row), min(moving.shape[0], reference.shape[0] - row)
        cols = max(0, -col), min(moving.shape[1], reference.shape[1] - col)
        return cls(rows, cols, (row, col), (steps[1] * cell, steps[0] * cell))

    @property
    def side(self) -> int:
        """Cells along the shorter side; not positive where nothing overlaps."""
        return min(self.rows[1] - self.rows[0], self.cols[1] - self.cols[0])

    def tiles(self, side: int) -> list[tuple[int, int]]:
        """Top left corners of tiles of `side` cells, from edge to edge: they overlap a little."""
        axes = []
        for low, high in (self.rows, self.cols):
            count = -(-(high - low) // side)
            axes.append(np.rint(np.linspace(low, high - side, count)).astype(int).tolist())
        return [(top, left) for top in axes[0] for left in axes[1]]


def correlated_tiles(
    reference: SurveyRaster,
    moving: SurveyRaster,
    channel: Channel,
    offset: tuple[float, float],
    fields: neutral.FieldsOf = neutral.pair_fields,
    least_reach: int = 0,
) -> TileOffsets | None:
    """Match each tile by the neutral measure, within the reach of a yaw of ±1° at least.

    `least_reach` [cells] is how far it is looked for, where that is more.
    """
    overlap = Overlap.at(reference.grid, moving.grid, offset)
    if overlap.side < 32:
        return None
    first, second = fields(reference, moving, channel)
    side = int(np.clip(overlap.side // 5, 16, 128))
    span = overlap.rows[1] - overlap.rows[0], overlap.cols[1] - overlap.cols[0]
    reach = int(np.ceil(0.5 * np.hypot(*span) * MAX_YAW)) + 3
    reach = max(reach, least_reach)
    tiles = overlap.tiles(side)

    def matched(tile: tuple[int, int]) -> tuple[float, float] | None:
        return _correlate_tile(first, second, (*tile, side), overlap, reach, moving.grid.cell)

    with ThreadPoolExecutor(correlate.WORKERS) as several:
        steps = list(several.map(matched, tiles))
    found = []
    for (top, left), step in zip(tiles, steps, strict=True):
        if step is not None:
            middle = moving.grid.east_north(top + 0.5 * (side - 1), left + 0.5 * (side - 1))
            found.append((*middle, overlap.offset[0] + step[0], overlap.offset[1] + step[1]))
    return _as_tiles(found, int(channel == "image"), side)


def _correlate_tile(
    first: neutral.Fields,
    second: neutral.Fields,
    tile: tuple[int, int, int],
    overlap: Overlap,
    reach: int,
    cell: float,
) -> tuple[float, float] | None:
    """Offset (east, north) [m] of one tile from the common shift; None where it has no peak."""
    cut = _tile_spectra(first, second, tile, overlap.shift, reach, cell)
    if cut is None:
        return None
    surface, _ = neutral.surface(*cut, 0.5)
    window = cut[2].window
    peak = find_peak(surface, window.east, window.north, exclusion=3 * cell)
    if peak is None or peak.border or peak.gap < 0.5:
        return None
    return peak.east, peak.north


def _tile_spectra(
    first: neutral.Fields,
    second: neutral.Fields,
    tile: tuple[int, int, int],
    shift: tuple[int, int],
    reach: int,
    cell: float,
) -> tuple[neutral.Spectra, neutral.Spectra, Correlator] | None:
    """Transform a moving tile and the reference about it; None where half is unknown.

    The window's east and north are from the common shift.
    """
    top, left, side = tile
    up, west = max(0, top + shift[0] - reach), max(0, left + shift[1] - reach)
    big = (
        slice(up, max(up, top + shift[0] + side + reach)),
        slice(west, max(west, left + shift[1] + side + reach)),
    )
    small = (slice(top, top + side), slice(left, left + side))
    a, b = first.mapped(lambda f: f[big]), second.mapped(lambda f: f[small])
    if not (a.mask.size and b.mask.mean() >= 0.5 and a.mask.mean() >= 0.5):
        return None
    steps = np.arange(-reach, reach + 1)
    window = Window(
        cell,
        steps + (top + shift[0] - up),
        steps + (left + shift[1] - west),
        np.asarray(steps * cell, np.float64),
        np.asarray(-steps * cell, np.float64),
        (a.mask.shape, b.mask.shape),
    )
    correlator = Correlator(window, single=True, workers=1)
    return neutral.spectra(a, correlator), neutral.spectra(b, correlator), correlator


def spread_of_fields(
    reference: SurveyRaster,
    moving: SurveyRaster,
    channel: Channel,
    tiles: TileOffsets,
    fields: neutral.FieldsOf = neutral.pair_fields,
) -> Float64:
    """Covariance (2, 2) [m²] of what a channel's fields disagree on, alike at all tiles.

    Light from another side moves tones one way and edges another, at all tiles alike, so that
    their scatter does not tell. Each field's evidence is therefore added over the tiles, each
    about its own offset, and what the field would have instead of the tiles' common answer goes
    in by its evidence, unless chance explains the preference. So does a rival of the common
    answer that lies beside it.

    Parameters
    ----------
    reference, moving : SurveyRaster
    channel : "terrain" or "image"
    tiles : TileOffsets
        Of this channel (`correlated_tiles`).
    fields : callable, optional
        Instead of `neutral.pair_fields`, where their fields are known already.
    """
    first, second = fields(reference, moving, channel)
    cell, side = moving.grid.cell, tiles.side
    some = np.linspace(0, len(tiles.places) - 1, min(len(tiles.places), STACKED)).astype(int)
    row, col = moving.grid.row_col(*tiles.places[some].T)
    shifts = [
        Overlap.at(reference.grid, moving.grid, (float(east), float(north))).shift
        for east, north in tiles.offsets[some]
    ]

    def stacked(at: int) -> Float64 | None:
        corner = round(row[at] - 0.5 * (side - 1)), round(col[at] - 0.5 * (side - 1))
        cut = _tile_spectra(first, second, (*corner, side), shifts[at], STACK_REACH, cell)
        return None if cut is None else np.stack(neutral.evidence_of_fields(*cut, 0.5)[0])

    with ThreadPoolExecutor(correlate.WORKERS) as several:
        found = [part for part in several.map(stacked, range(len(some))) if part is not None]
    if not found:
        return np.zeros((2, 2))
    along = np.arange(-STACK_REACH, STACK_REACH + 1).astype(np.float64) * cell
    away = np.hypot(along[None, :], along[:, None])
    ring = away > 0.6 * STACK_REACH * cell
    stack = np.sum(found, axis=0)
    each = [_in_deviations_of(part, ring) for part in stack]
    total = _in_deviations_of(np.sum(each, axis=0), ring)
    answer = find_peak(np.where(away <= PEAK_REACH * cell, total, np.nan), along, -along, cell)
    assert answer is not None
    home = answer.index
    spread, weights = np.zeros((2, 2)), 0.0
    for part in each:
        peak = find_peak(part, along, -along, 3 * cell)
        if peak is None or peak.value <= 0:
            continue
        plain = 1.0 - np.exp(-0.5 * (peak.value - part[home]) ** 2)
        apart = np.array([peak.east - answer.east, peak.north - answer.north])
        spread += peak.value * plain * np.outer(apart, apart)
        weights += peak.value
    spread /= max(weights, 1e-12)
    rival = find_peak(total, along, -along, 3 * cell)
    if rival is not None:
        for place in filter(None, [rival.second, rival.whole]):
            at = round(place[1] / -cell) + STACK_REACH, round(place[0] / cell) + STACK_REACH
            apart = np.array([place[0] - answer.east, place[1] - answer.north])
            chance = np.exp(-0.5 * max(total[home] - total[at], 0.0) ** 2)
            spread += chance / (1 + chance) * np.outer(apart, apart)
    return np.asarray(ALIKE**2 * spread)


def _in_deviations_of(stack: Float64, ring: Bool) -> Float64:
    """Evidence in deviations of what it is in a ring that no answer of the tiles lies in."""
    return (stack - np.median(stack[ring])) / max(float(np.std(stack[ring])), 1e-12)


def polished_tiles(
    reference: Relief, moving: Relief, offset: Float64, guess: OffsetAt
) -> TileOffsets | None:
    """Read each tile's offset by robust Gauss-Newton on high-passed heights.

    Parameters
    ----------
    reference, moving : Relief
    offset : (2,) float64
        East and north [m] of the whole, which says where the surveys overlap.
    guess : callable
        Of places (M, 2): the offsets (M, 2) to start from. A tile's offset is that of its centre
        only as far as the guess bends as the models do, since the relief that tells it may lie to
        one side. A tile that runs more than three cells from its start, or shows too little, is
        left out.

    Notes
    -----
    Residual ``r = f1(u + b(u) + t) - f2(u)``, Tukey's biweight at four robust deviations, slopes
    as the mean of both surveys' (so that neither survey's noise shrinks the step).
    """
    overlap = Overlap.at(reference.grid, moving.grid, (float(offset[0]), float(offset[1])))
    side = int(np.clip(overlap.side // 7, 16, TILE_CELLS))
    if overlap.side < 3 * side:
        return None
    from meshreg.refine.tile_kernels import polish

    tiles = overlap.tiles(side)
    row, col, bounds = _known_cells(moving.mask, tiles, side)
    bend = _Bend.of(guess, moving.grid, side)
    start = bend.at(np.stack([row, col]))
    bent = np.stack(moving.grid.east_north(row, col), axis=1) + start
    added = polish(
        reference.layers,
        moving.layers,
        np.column_stack([row, col, bent]),
        bounds,
        np.full(len(tiles), side**2),
        np.array([reference.grid.west, reference.grid.north]),
        reference.grid.cell,
    )
    found = np.isfinite(added[:, 0])
    if not found.any():
        return None
    middle = np.array(tiles, float)[found].T + 0.5 * (side - 1)
    places = np.stack(moving.grid.east_north(*middle), axis=1)
    number = len(places)
    offsets = bend.at(middle) + added[found, :2]
    noise = added[found, 2:]
    return TileOffsets(places, offsets, np.arange(number), np.zeros(number, int), side, noise)


def _known_cells(
    mask: Bool, tiles: list[tuple[int, int]], side: int
) -> tuple[Float64, Float64, np.ndarray]:
    """Rows and columns of the cells in `mask`, tile after tile, and where each tile's begin."""
    rows, cols, bounds = [], [], [0]
    for top, left in tiles:
        row, col = np.nonzero(mask[top : top + side, left : left + side])
        rows.append(row + float(top))
        cols.append(col + float(left))
        bounds.append(bounds[-1] + len(row))
    return np.concatenate(rows), np.concatenate(cols), np.array(bounds)


@dataclass(frozen=True, eq=False)
class _Bend:
    """A guess of the offset, computed at nodes `step` cells apart and smooth between them."""

    step: int
    nodes: Float64  # (2, R, C): spline coefficients of east and north [m]

    @classmethod
    def of(cls, guess: OffsetAt, grid: Grid, side: int) -> _Bend:
        from scipy.ndimage import spline_filter

        step = max(side // 4, 1)
        rows, cols = (np.arange(-step, length + 2 * step, step) for length in grid.shape)
        row, col = np.meshgrid(rows, cols, indexing="ij")
        places = np.stack(grid.east_north(row.ravel(), col.ravel()), axis=1)
        offsets = guess(places).T.reshape(2, len(rows), len(cols))
        return cls(step, np.stack([spline_filter(part, 3) for part in offsets]))

    def at(self, row_col: Float64) -> Float64:
        """Offset (N, 2) [m] at rows and columns (2, N)."""
        from scipy.ndimage import map_coordinates

        at = row_col / self.step + 1.0
        return np.stack([map_coordinates(p, at, order=3, prefilter=False) for p in self.nodes], 1)


@dataclass(frozen=True, eq=False)
class Relief:
    """What the fit of a tile reads of a survey (`tile_kernels`).

    Attributes
    ----------
    grid : Grid
    layers : (5, H, W) float64
        High-passed heights, the same as coefficients of a cubic spline, their slopes along east
        and north [1/m], and 1 where they are known, three cells from any unknown one.
    """

    grid: Grid
    layers: Float64

    @property
    def mask(self) -> Bool:
        """(H, W) bool: where the relief is known."""
        return np.asarray(self.layers[4] > 0)

    @classmethod
    def of(cls, raster: SurveyRaster) -> Relief:
        """Prepare a survey's heights."""
        from scipy.ndimage import binary_erosion, spline_filter

        mask = raster.valid
        height = raster.height.astype(np.float64)
        height = np.where(mask, height - (np.median(height[mask]) if mask.any() else 0.0), 0.0)
        field = np.where(mask, height - smooth(height, mask, HIGH_PASS), 0.0)
        d_row, d_col = (np.asarray(d, np.float64) for d in np.gradient(field))
        inner = binary_erosion(mask, iterations=3, border_value=0)
        cell = raster.grid.cell
        return cls(
            raster.grid,
            np.stack([field, spline_filter(field, 3), d_col / cell, -d_row / cell, inner]),
        )


def _as_tiles(found: list[tuple[Any, ...]], channel: int, side: int) -> TileOffsets | None:
    if not found:
        return None
    rows = np.array(found, float)
    number = len(rows)
    channels = np.full(number, channel)
    return TileOffsets(rows[:, :2], rows[:, 2:], np.arange(number), channels, side)
