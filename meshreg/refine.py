"""From the search's cell to the ground's own detail: tile offsets, yaw and their covariance.

Both surveys are cut into tiles; each tile is matched on its own, close to the offset already
found, in each channel. A rotation about the vertical shows as tile offsets that turn; what is
left is the internal distortion of the two models, which also says how sure the answer is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshreg.offsets import neutral
from meshreg.offsets.correlate import Correlator, Window
from meshreg.offsets.surface import MAD_TO_SIGMA, find_peak
from meshreg.types import Float64, SurveyRaster

MAX_YAW = np.deg2rad(1.0)
MIN_TILES = 6


@dataclass(frozen=True, eq=False)
class TileOffsets:
    """How far each tile must go, measured alone.

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
    """

    places: Float64
    offsets: Float64
    block: np.ndarray
    channel: np.ndarray


@dataclass(frozen=True, eq=False)
class Refined:
    """The horizontal answer at `pivot`: offset, yaw, covariance and what is left per tile.

    Attributes
    ----------
    pivot : (2,) float64
        Absolute east and north [m] in the moving survey, centre of the tiles used.
    offset : (2,) float64
        East and north [m] at the pivot.
    yaw : float
        Anticlockwise turn of the moving survey [rad]; 0 where it is not significant.
    covariance : (3, 3) float64
        Of (east, north, yaw).
    tiles : TileOffsets or None
    residuals : (M, 2) float64
        Tile offset less the rigid answer's [m].
    weights : (M,) float64
    note : str
        What the user should know.
    doubt : str
        Why the answer cannot be accepted, if so.
    """

    pivot: Float64
    offset: Float64
    yaw: float
    covariance: Float64
    tiles: TileOffsets | None = None
    residuals: Float64 | None = None
    weights: Float64 | None = None
    note: str = ""
    doubt: str = ""


def refine(
    rasters: Sequence[tuple[SurveyRaster, SurveyRaster, neutral.Channel]],
    offset: tuple[float, float],
    sigma: Float64,
    agree: float,
) -> Refined:
    """Refine an offset and find a small yaw (to ±1°) from the offsets of tiles.

    Parameters
    ----------
    rasters : sequence of (reference, moving, channel)
    offset : (east, north)
        The judged offset [m].
    sigma : (2, 2) float64
        Its covariance, used where the tiles are too few.
    agree : float
        The refined offset may differ from the judged one by this much [m].
    """
    measured = [
        tile_offsets(reference, moving, channel, offset) for reference, moving, channel in rasters
    ]
    tiles = _joined([m for m in measured if m is not None])
    centre = _overlap_centre(rasters[0][0], rasters[0][1], offset)
    coarse = Refined(centre, np.array(offset), 0.0, _block_diagonal(sigma, MAX_YAW**2 / 9))
    if tiles is None or len(np.unique(tiles.block)) < MIN_TILES:
        return replace(coarse, note="too few tiles match on their own to measure yaw")
    turning = fit(tiles, centre, yaw_free=True)
    yaw_sigma = float(np.sqrt(turning.covariance[2, 2]))
    significant = abs(turning.yaw) > 2 * yaw_sigma
    if significant and abs(turning.yaw) > MAX_YAW:
        turn = np.rad2deg(turning.yaw)
        doubt = f"the surveys are turned by about {turn:.1f}°, beyond the ±1° searched"
        return replace(coarse, doubt=doubt)
    best = turning if significant else fit(tiles, centre, yaw_free=False)
    if float(np.hypot(*(best.offset - offset))) > agree:
        moved = float(np.hypot(*(best.offset - offset)))
        return replace(
            coarse, doubt=f"tiles matched alone lie {moved:.2f} m from the whole's offset"
        )
    return best


def tile_offsets(
    reference: SurveyRaster,
    moving: SurveyRaster,
    channel: neutral.Channel,
    offset: tuple[float, float],
) -> TileOffsets | None:
    """Match each tile of the moving raster alone, within the reach of a yaw of ±1°."""
    first, second = neutral.fields(reference, channel), neutral.fields(moving, channel)
    cell = moving.grid.cell
    nominal = Window.around(reference.grid, moving.grid, cell)
    row0 = int(nominal.rows[1] - round(offset[1] / cell))
    col0 = int(nominal.cols[1] + round(offset[0] / cell))
    rows, cols = moving.grid.shape
    r_low, r_high = max(0, -row0), min(rows, reference.grid.shape[0] - row0)
    c_low, c_high = max(0, -col0), min(cols, reference.grid.shape[1] - col0)
    if min(r_high - r_low, c_high - c_low) < 32:
        return None
    side = int(np.clip(min(r_high - r_low, c_high - c_low) // 5, 16, 128))
    half_diagonal = 0.5 * np.hypot(r_high - r_low, c_high - c_low)
    reach = int(np.ceil(half_diagonal * MAX_YAW)) + 3
    places, offsets, blocks = [], [], []
    for index_r, top in enumerate(range(r_low, r_high - side + 1, side)):
        for index_c, left in enumerate(range(c_low, c_high - side + 1, side)):
            found = _match_tile(first, second, (top, left, side), (row0, col0), reach, cell)
            if found is None:
                continue
            d_east, d_north = found
            middle = (top + 0.5 * side - 0.5, left + 0.5 * side - 0.5)
            places.append(moving.grid.east_north(*middle))
            exact = (
                (col0 - int(nominal.cols[1])) * cell + d_east,
                (int(nominal.rows[1]) - row0) * cell + d_north,
            )
            offsets.append(exact)
            blocks.append(1000 * index_r + index_c)
    if not places:
        return None
    return TileOffsets(
        np.array(places, float),
        np.array(offsets, float),
        np.array(blocks),
        np.zeros(len(blocks), int) + (channel == "image"),
    )


def _match_tile(
    first: neutral.Fields,
    second: neutral.Fields,
    tile: tuple[int, int, int],
    shift: tuple[int, int],
    reach: int,
    cell: float,
) -> tuple[float, float] | None:
    """Offset (east, north) [m] of one tile from the common shift; None where it has no peak."""
    top, left, side = tile
    up, west = max(0, top + shift[0] - reach), max(0, left + shift[1] - reach)
    big = (
        slice(up, top + shift[0] + side + reach),
        slice(west, left + shift[1] + side + reach),
    )
    small = (slice(top, top + side), slice(left, left + side))
    a, b = first.mapped(lambda f: f[big]), second.mapped(lambda f: f[small])
    if b.mask.mean() < 0.5 or a.mask.mean() < 0.5:
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
    correlator = Correlator(window)
    surface, _ = neutral.surface(
        neutral.spectra(a, correlator), neutral.spectra(b, correlator), correlator, 0.5
    )
    peak = find_peak(surface, window.east, window.north, exclusion=3 * cell)
    if peak is None or peak.border or peak.gap < 0.5:
        return None
    return peak.east, peak.north


def fit(tiles: TileOffsets, pivot: Float64, *, yaw_free: bool, iterations: int = 20) -> Refined:
    """Robust rigid fit of tile offsets: ``d = t + yaw * (-(n - n0), e - e0)``.

    Tukey's biweight at 4 robust deviations, one deviation per channel. The covariance is the
    block sandwich ``H⁻¹ (sum_b g_b g_b') H⁻¹``, since channels at one place err alike.
    """
    arm = tiles.places - pivot
    count = 3 if yaw_free else 2
    design = np.zeros((len(arm), 2, 3))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, 0, 2], design[:, 1, 2] = -arm[:, 1], arm[:, 0]
    design = design[:, :, :count]
    answer = np.zeros(count)
    answer[:2] = np.median(tiles.offsets, axis=0)
    if yaw_free:
        answer[2] = _median_turn(tiles, pivot, answer[:2])
    weights = np.ones(len(arm))
    for _ in range(iterations):
        residual = tiles.offsets - design @ answer
        size = np.hypot(*residual.T)
        scale = _scales(size, tiles.channel)
        weights = np.clip(1 - (size / (4 * scale)) ** 2, 0, None) ** 2 / scale**2
        normal = np.einsum("mij,m,mik->jk", design, weights, design)
        step = np.linalg.solve(normal, np.einsum("mij,m,mi->j", design, weights, residual))
        answer = answer + step
        if np.abs(step[:2]).max() < 1e-9:
            break
    residual = tiles.offsets - design @ answer
    covariance = np.zeros((3, 3))
    covariance[:count, :count] = _sandwich(design, weights, residual, tiles.block)
    if not yaw_free:
        covariance[2, 2] = fit(tiles, pivot, yaw_free=True, iterations=3).covariance[2, 2]
    yaw = float(answer[2]) if yaw_free else 0.0
    return Refined(pivot, answer[:2], yaw, covariance, tiles, residual, weights / weights.max())


def _median_turn(tiles: TileOffsets, pivot: Float64, offset: Float64) -> float:
    """Median over tiles of the turn that each shows alone: a start that outliers cannot move."""
    arm, rest = tiles.places - pivot, tiles.offsets - offset
    length2 = (arm**2).sum(axis=1)
    far = length2 >= np.median(length2)
    turn = (arm[:, 0] * rest[:, 1] - arm[:, 1] * rest[:, 0])[far] / length2[far]
    return float(np.median(turn))


def _scales(size: Float64, channel: np.ndarray) -> Float64:
    """Robust deviation of the residual lengths of each tile's channel."""
    scale = np.empty(len(size))
    for c in np.unique(channel):
        members = channel == c
        scale[members] = max(MAD_TO_SIGMA * float(np.median(size[members])) / 1.2, 1e-6)
    return scale


def _sandwich(design: Float64, weights: Float64, residual: Float64, block: np.ndarray) -> Float64:
    bread = np.linalg.inv(np.einsum("mij,m,mik->jk", design, weights, design))
    scores = np.einsum("mij,m,mi->mj", design, weights, residual)
    names = np.unique(block)
    sums = np.array([scores[block == name].sum(axis=0) for name in names])
    sums -= sums.mean(axis=0)
    freedom = len(names) / max(len(names) - design.shape[2], 1)
    return np.asarray(bread @ (sums.T @ sums) @ bread * freedom)


def _joined(parts: Sequence[TileOffsets]) -> TileOffsets | None:
    """Tiles of both channels; blocks are by place, on a common lattice of the coarser tiles."""
    if not parts:
        return None
    places = np.concatenate([p.places for p in parts])
    n_side = max(2, round(np.sqrt(max(len(p.places) for p in parts))))
    low, high = places.min(axis=0), places.max(axis=0)
    bins = np.minimum(
        ((places - low) / np.maximum(high - low, 1e-9) * n_side).astype(int), n_side - 1
    )
    return TileOffsets(
        places,
        np.concatenate([p.offsets for p in parts]),
        bins[:, 0] * n_side + bins[:, 1],
        np.concatenate([p.channel for p in parts]),
    )


def _overlap_centre(
    reference: SurveyRaster, moving: SurveyRaster, offset: tuple[float, float]
) -> Float64:
    """Centroid [m], in moving coordinates, of the moving cells that fall on reference cells."""
    mask = moving.valid if moving.valid.any() else moving.color_valid
    target = reference.valid if reference.valid.any() else reference.color_valid
    row, col = np.nonzero(mask)
    east, north = moving.grid.east_north(row, col)
    r, c = reference.grid.row_col(east + offset[0], north + offset[1])
    r, c = np.rint(r).astype(int), np.rint(c).astype(int)
    rows, cols = reference.grid.shape
    inside = (r >= 0) & (r < rows) & (c >= 0) & (c < cols)
    inside[inside] = target[r[inside], c[inside]]
    if not inside.any():
        inside[:] = True
    return np.array([east[inside].mean(), north[inside].mean()])


def _block_diagonal(sigma: Float64, yaw_variance: float) -> Float64:
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = sigma
    covariance[2, 2] = yaw_variance
    return covariance
