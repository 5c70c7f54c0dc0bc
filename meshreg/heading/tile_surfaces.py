"""Each tile of the moving survey correlated with the reference, at every offset of a window.

The fields are those of the neutral measure (`offsets.neutral`), at equal power and added before
the inverse transform, so that a tile costs four of them. The reference is transformed once.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from meshreg.offsets import neutral
from meshreg.offsets.correlate import WORKERS
from meshreg.raster.grid import cell_offset, coarsened
from meshreg.records import Bool, Channel, Float32, Float64, Grid, OffsetAt, SurveyRaster
from meshreg.statistics import MAD_TO_SIGMA

TILES = 5  # along the patch
TILE_CELLS = (16, 24)  # a larger tile's corners run off its peak when it is turned by 8°
MOST = 120  # tiles of a channel: more of them find no more
CAP = 6.0  # deviations: one tile cannot decide


@dataclass(frozen=True, eq=False)
class TileSurfaces:
    """Correlation surfaces of a channel's tiles, in deviations of each surface.

    `surfaces`, `scored` (M, K, K); `centres` (M, 2) absolute east and north [m]. Row 0 is the
    northernmost offset, +`reach` cells; the column of offset 0 is `reach`. Where the offsets count
    from a guess for each tile, `behind` (M, 2) [m east, north] is what whole cells left of it.
    """

    cell: float
    reach: int
    surfaces: Float32
    scored: Bool
    centres: Float64
    behind: Float64

    def only(self, which: Bool) -> TileSurfaces:
        """Return the tiles that `which` (M,) picks."""
        surfaces, scored = self.surfaces[which], self.scored[which]
        return dataclasses.replace(
            self,
            surfaces=surfaces,
            scored=scored,
            centres=self.centres[which],
            behind=self.behind[which],
        )


def channel_surfaces(
    reference: SurveyRaster,
    moving: SurveyRaster,
    channel: Channel,
    cell: float,
    radius: float,
    turn: float,
) -> TileSurfaces | None:
    """Correlate each tile of a channel with the reference; None where there are too few."""
    times = max(1, round(cell / moving.grid.cell))
    arm = 0.5 * math.hypot(*moving.grid.shape) * moving.grid.cell
    half = radius + arm * turn + 2 * cell
    here = (0.0, 0.0)
    reference, moving = (
        near_offset(reference, moving, here, half),
        near_offset(moving, reference, here, half),
    )
    if min(*reference.grid.shape, *moving.grid.shape) < TILE_CELLS[0] // 2 * times:
        return None
    reference, moving = coarsened(reference, times), coarsened(moving, times)
    first, second = neutral.fields(reference, channel), neutral.fields(moving, channel)
    side = int(np.clip(math.sqrt(second.mask.sum()) / TILES, *TILE_CELLS))
    side = min(side, *moving.grid.shape)
    reach = math.ceil(half / moving.grid.cell)
    found = _correlate(first, second, (reference.grid, moving.grid), side, reach)
    if not found:
        return None
    surfaces, scored, centres = (np.array(part) for part in zip(*found, strict=True))
    return TileSurfaces(moving.grid.cell, reach, surfaces, scored, centres, np.zeros_like(centres))


def surfaces_bytes(moving: SurveyRaster, cell: float, radius: float, turn: float) -> float:
    """Reckon the bytes that both channels' surfaces take: each channel's, joined, and pooled."""
    times = max(1, round(cell / moving.grid.cell))
    arm = 0.5 * math.hypot(*moving.grid.shape) * moving.grid.cell
    width = 2 * math.ceil((radius + arm * turn) / cell + 2) + 1
    cells = int(moving.valid.sum()) / times**2
    side = float(np.clip(math.sqrt(cells) / TILES, *TILE_CELLS))
    return 2 * min(MOST, cells / side**2) * width**2 * (2 * 5 + 4)


def surfaces_near(
    reference: SurveyRaster,
    moving: SurveyRaster,
    channel: Channel,
    guess: OffsetAt,
    reach: int,
) -> TileSurfaces | None:
    """Correlate each tile with the reference about its own guessed offset, to ±`reach` cells.

    At the rasters' own cell; None where there are no tiles.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    if min(moving.grid.shape) < TILE_CELLS[1]:
        return None
    first, second = neutral.fields(reference, channel), neutral.fields(moving, channel)
    side, cell = TILE_CELLS[1], moving.grid.cell
    still, moved = _stacked(first), _stacked(second)
    fields = len(still) - 2
    nominal = np.array(cell_offset(reference.grid, moving.grid))
    size = int(next_fast_len(side + 2 * reach, real=True))
    found = []
    for top, left in _some(_corners(second.mask.shape, side), second.mask, side):
        tile = moved[:, top : top + side, left : left + side]
        area = float(tile[-2].sum())
        middle = np.array(moving.grid.east_north(top + 0.5 * (side - 1), left + 0.5 * (side - 1)))
        there = np.ravel(guess(middle[None]))
        whole = np.rint(np.array([-there[1], there[0]]) / cell).astype(int)
        row, col = nominal + whole + [top - reach, left - reach]
        patch = _patch(still, int(row), int(col), side + 2 * reach)
        a = rfft2(patch, s=(size, size))
        b = np.conj(rfft2(tile, s=(size, size)))
        products = (
            (a[:fields] * b[:fields]).sum(axis=0),
            a[-2] * b[-2],
            a[-1] * b[-2],
            a[-2] * b[-1],
        )
        sums = irfft2(np.stack(products), s=(size, size))[:, : 2 * reach + 1, : 2 * reach + 1]
        surface, scored = _normalised(sums, np.ones(sums.shape[1:], bool), area)
        if scored.any():
            behind = np.array([whole[1], -whole[0]]) * cell - there
            found.append((surface, scored, middle, behind))
    if not found:
        return None
    return TileSurfaces(cell, reach, *(np.array(part) for part in zip(*found, strict=True)))


def _patch(fields: Float32, row: int, col: int, side: int) -> Float32:
    """(K, side, side) of the fields from a row and column on; 0 outside of them."""
    patch = np.zeros((len(fields), side, side), np.float32)
    rows = slice(max(row, 0), max(min(row + side, fields.shape[1]), 0))
    cols = slice(max(col, 0), max(min(col + side, fields.shape[2]), 0))
    if rows.stop > rows.start and cols.stop > cols.start:
        part = fields[:, rows, cols]
        top, left = rows.start - row, cols.start - col
        patch[:, top : top + part.shape[1], left : left + part.shape[2]] = part
    return patch


def _some(corners: list[tuple[int, int]], mask: Bool, side: int) -> list[tuple[int, int]]:
    """Return corners of tiles at least half of which is known: `MOST` at most, evenly spread."""
    full = [
        (top, left)
        for top, left in corners
        if np.count_nonzero(mask[top : top + side, left : left + side]) >= 0.5 * side**2
    ]
    return full[:: max(1, -(-len(full) // MOST))]


def near_offset(
    raster: SurveyRaster, other: SurveyRaster, offset: tuple[float, float], half: float
) -> SurveyRaster:
    """Cut off what lies further than `half` m from the other raster, which is moved by `offset`."""
    grid, (west, south, east, north) = raster.grid, other.grid.bounds
    west, east = west + offset[0], east + offset[0]
    south, north = south + offset[1], north + offset[1]
    rows, cols = grid.shape
    top = int(np.clip((grid.north - north - half) / grid.cell, 0, rows - 1))
    bottom = int(np.clip(math.ceil((grid.north - south + half) / grid.cell), top + 1, rows))
    left = int(np.clip((west - half - grid.west) / grid.cell, 0, cols - 1))
    right = int(np.clip(math.ceil((east + half - grid.west) / grid.cell), left + 1, cols))
    return part_of(raster, slice(top, bottom), slice(left, right))


def part_of(raster: SurveyRaster, rows: slice, cols: slice) -> SurveyRaster:
    """Return those rows and columns of a raster, as views."""
    grid, part = raster.grid, (rows, cols)
    shape = rows.stop - rows.start, cols.stop - cols.start
    if shape == grid.shape:
        return raster
    corner = grid.west + cols.start * grid.cell, grid.north - rows.start * grid.cell
    return dataclasses.replace(
        raster,
        grid=Grid(*corner, grid.cell, shape, grid.crs),
        height=raster.height[part],
        color=raster.color[part],
        valid=raster.valid[part],
        color_valid=raster.color_valid[part],
        samples=raster.samples[part],
    )


def _correlate(
    first: neutral.Fields,
    second: neutral.Fields,
    grids: tuple[Grid, Grid],
    side: int,
    reach: int,
) -> list[tuple[Float32, Bool, tuple[float, float]]]:
    """Each tile's surface: the neutral fields' normalised correlation, its mask and its centre.

    The fields have equal power and are added before the inverse transform. Surfaces are shifted by
    whole cells: what is left of the grids' own shift is under half a cell.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    still, moved = _stacked(first), _stacked(second)
    rows, cols = first.mask.shape
    size = int(next_fast_len(rows + side)), int(next_fast_len(cols + side, real=True))
    spectra = rfft2(still, s=size, workers=WORKERS)
    fields = len(still) - 2
    cell = grids[1].cell
    nominal = (grids[0].north - grids[1].north) / cell, (grids[1].west - grids[0].west) / cell
    steps = np.arange(-reach, reach + 1)
    found = []
    for top, left in _some(_corners(second.mask.shape, side), second.mask, side):
        tile = moved[:, top : top + side, left : left + side]
        area = float(tile[-2].sum())
        small = np.conj(rfft2(tile, s=size, workers=WORKERS))
        products = (
            (spectra[:fields] * small[:fields]).sum(axis=0),
            spectra[-2] * small[-2],
            spectra[-1] * small[-2],
            spectra[-2] * small[-1],
        )
        sums = irfft2(np.stack(products), s=size, workers=WORKERS)
        row, col = steps + round(nominal[0]) + top, steps + round(nominal[1]) + left
        cut = sums[:, (row % size[0])[:, None], (col % size[1])[None, :]]
        there = ((row > -side) & (row < rows))[:, None] & ((col > -side) & (col < cols))[None, :]
        surface, scored = _normalised(cut, there, area)
        if scored.any():
            middle = grids[1].east_north(top + 0.5 * (side - 1), left + 0.5 * (side - 1))
            found.append((surface, scored, (float(middle[0]), float(middle[1]))))
    return found


def _stacked(fields: neutral.Fields) -> Float32:
    """(K + 2, H, W): the parts of all fields at equal power, the mask, the sum of their squares."""
    count = max(int(fields.mask.sum()), 1)
    parts = []
    for field in fields.parts:
        power = math.sqrt(sum(float((part**2).sum()) for part in field) / count)
        parts += [part / max(power, 1e-12) for part in field]
    power = np.sum([part**2 for part in parts], axis=0)
    return np.stack([*parts, fields.mask, power]).astype(np.float32)


def _corners(shape: tuple[int, int], side: int) -> list[tuple[int, int]]:
    """Top left corners of as many whole tiles as fit, in the middle of the raster."""
    firsts = [range((size % side) // 2, size - side + 1, side) for size in shape]
    return [(top, left) for top in firsts[0] for left in firsts[1]]


def _normalised(sums: Float32, there: Bool, area: float) -> tuple[Float32, Bool]:
    """Correlation coefficient times the root of the overlap, in deviations of the surface."""
    cross, counts, power_first, power_second = sums
    counts = np.rint(counts)
    scored = there & (counts >= 0.5 * area) & (power_first > 1e-3 * area) & (power_second > 0)
    if scored.sum() < 30:
        return np.zeros_like(cross), np.zeros(cross.shape, bool)
    power = np.sqrt(np.where(scored, power_first * power_second, 1.0))
    values = np.where(scored, cross / power * np.sqrt(counts / area), 0.0)
    seen = values[scored]
    middle = float(np.median(seen))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(seen - middle)))
    if spread <= 0:
        return np.zeros_like(cross), np.zeros(cross.shape, bool)
    return np.where(scored, (values - middle) / spread, 0.0).astype(np.float32), scored


def joined(first: TileSurfaces, second: TileSurfaces) -> TileSurfaces:
    """Tiles of both channels, on the offsets of the first (the second's nearest ones)."""
    places = np.arange(-first.reach, first.reach + 1) * (first.cell / second.cell)
    index = np.clip(np.rint(places).astype(int) + second.reach, 0, 2 * second.reach)
    pick = np.ix_(np.arange(len(second.surfaces)), index, index)
    return TileSurfaces(
        first.cell,
        first.reach,
        np.concatenate([first.surfaces, second.surfaces[pick]]),
        np.concatenate([first.scored, second.scored[pick]]),
        np.concatenate([first.centres, second.centres]),
        np.concatenate([first.behind, second.behind]),
    )


def pooled(tiles: TileSurfaces) -> TileSurfaces:
    """Halve the offsets' lattice by the largest of each 3 x 3 about every second one."""
    first, half = tiles.reach % 2, tiles.reach // 2  # so that offset 0 stays in the middle
    surfaces = tiles.surfaces
    for axis in (1, 2):
        padded = np.pad(surfaces, [(int(k == axis), int(k == axis)) for k in range(3)], mode="edge")
        parts = [
            np.take(padded, 2 * np.arange(2 * half + 1) + first + step, axis=axis)
            for step in range(3)
        ]
        surfaces = np.maximum(np.maximum(parts[0], parts[1]), parts[2])
    part = slice(first, first + 4 * half + 1, 2)
    surfaces, scored = np.minimum(surfaces, CAP), tiles.scored[:, part, part]
    return TileSurfaces(2 * tiles.cell, half, surfaces, scored, tiles.centres, tiles.behind)
