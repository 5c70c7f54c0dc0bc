"""How far the moving survey is turned and stretched, before anything else looks at it.

One offset for the whole patch finds nothing once the heading is off by some degrees. A tile of it
is small enough to match all the same, so each tile of the moving survey is correlated once with
the reference; a yaw psi and a scale s then say where its peak must lie, and the surfaces are added
there (a Hough transform over similarities, with correlation surfaces for votes)::

    F(t, psi, s) = sum_k S_k(t + (s R(psi) - 1) c_k) / sqrt(number of tiles that see the reference)

with c_k the tile's centre from the centre of all. No hypothesis costs another transform.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from meshreg.heading.tile_surfaces import (
    CAP,
    TileSurfaces,
    channel_surfaces,
    joined,
    pooled,
    surfaces_bytes,
    surfaces_near,
)
from meshreg.offsets.correlate import Window
from meshreg.records import RASTER_OF, Bool, Float32, Float64, OffsetAt, SurveyRaster
from meshreg.settings import SearchSettings
from meshreg.statistics import MAD_TO_SIGMA, biweight

Pair = tuple[SurveyRaster, SurveyRaster]
ACROSS = 100  # voting cells along the patch: enough for 25 tiles, few enough for a fraction of 1 s
MIN_TILES = 4
MOST_BYTES = 2e9  # of the tiles' surfaces
PEAKS = 40  # places that are looked at again
STANDS_OUT = 3.0  # deviations over the best unrelated hypothesis; chance reaches 2
CHANCE = 5.0  # deviations: the best of some thousand unrelated hypotheses and offsets
WORTH_A_LOOK = 1.5  # less is chance; what lies between is looked at, and the judge asked
LEFT = 4  # coarse cells by which a tile may lie off where coarse cells put it
SMALL_YAW = np.deg2rad(0.9)  # `refine` turns up to 1° by itself; the rest is the vote's own error
PLAIN_SCALE = 0.005  # a scale nearer to 1 than this is not plainly wrong,
PLAIN_RATIO = 2.0  # nor one that explains under four fifths of what moves the tiles
FINE_SCALE = 0.002  # smaller ones are left to the finest tiles, where a scale is asked for
CLEAR = 3.0  # deviations: a lower peak of a single tile is not used for the fit


@dataclass(frozen=True)
class Turn:
    """The similarity that the tiles vote for, without its offset.

    Attributes
    ----------
    yaw : float
        Anticlockwise turn of the moving survey that lays it on the reference [rad].
    scale : float
        By which its lengths must be multiplied; 1 unless asked for or plainly wrong.
    stretch : float
        By which they would have to be multiplied to fit best.
    ratio : float
        Displacement of the tiles that the stretch explains over that which it leaves (both as
        root mean squares): internal distortion mimics a scale too, but leaves as much.
    offset : (east, north)
        At `centre` [m].
    centre : (east, north)
        Of the moving survey's tiles [m].
    cell : float
        Of the rasters that were voted on [m].
    gap : float
        Height above the best hypothesis at another offset, in deviations of chance.
    over_plain : float
        Height above the best hypothesis with yaw 0 and scale 1, in the same unit.
    channel : str
        "terrain", "image", or "terrain and image".
    trials : int
        Yaws times scales that were tried: by so much a chance match is more likely.
    """

    yaw: float
    scale: float
    stretch: float
    ratio: float
    offset: tuple[float, float]
    centre: tuple[float, float]
    cell: float
    gap: float
    over_plain: float
    channel: str
    trials: int

    def offset_at(self, places: Float64) -> Float64:
        """Offset (N, 2) [m] that turn and stretch mean at places (N, 2) of the moving survey."""
        c, s = self.stretch * math.cos(self.yaw), self.stretch * math.sin(self.yaw)
        arm = places - np.array(self.centre)
        return np.asarray(np.array(self.offset) + arm @ np.array([[c - 1, s], [-s, c - 1]]))

    @property
    def proven(self) -> bool:
        """Whether it stands out from chance by itself."""
        return self.gap >= STANDS_OUT

    @property
    def mimics_scale(self) -> bool:
        """Whether the stretch stands out of what it leaves, but is not plainly wrong."""
        return self.scale == 1.0 and abs(self.stretch - 1) >= PLAIN_SCALE and self.ratio >= 1.0

    @property
    def needed(self) -> bool:
        """Whether the survey must be turned or scaled before the methods look at it."""
        return abs(self.yaw) > SMALL_YAW or self.scale != 1.0


def vote(pairs: Mapping[str, Pair], settings: SearchSettings, radius: float) -> Turn | None:
    """Let the tiles of terrain and image vote on yaw and scale.

    Coarse cells are asked first, which see far for little; where nothing stands out on them, finer
    ones, down to the DEM's own: relief and texture that are a cell or two across are lost sooner.

    Parameters
    ----------
    pairs : mapping
        "dem" and "ortho" to (reference, moving).
    settings : SearchSettings
        `max_yaw` [degrees] and `max_scale`; with both 0 nothing is voted on.
    radius : float
        Half width of the search window [m].

    Returns
    -------
    Turn or None
        None where no hypothesis stands out.
    """
    max_yaw, max_scale = float(np.deg2rad(settings.max_yaw)), settings.max_scale
    if max_yaw <= 0 and max_scale <= 0:
        return None
    delivered = pairs
    pairs, moved, radius = _laid_together(pairs, radius)
    trials, best = 0, None
    for cell in _voting_cells(pairs, radius, max_yaw + max_scale):
        turn = _best_at(pairs, cell, radius, max_yaw, max_scale)
        if turn is None:
            continue
        trials += turn.trials
        if _inside(turn, settings) and (best is None or turn.gap > best.gap):
            best = turn
        if best is not None and best.proven:
            break
    if best is None or best.gap < WORTH_A_LOOK:
        return None
    centre = best.centre[0] - moved[0], best.centre[1] - moved[1]
    offset = best.offset[0] + moved[0], best.offset[1] + moved[1]
    best = replace(best, trials=trials, centre=centre, offset=offset)
    pairs = delivered
    if abs(best.yaw) <= SMALL_YAW and abs(best.stretch - 1) >= FINE_SCALE:
        finer = settled(pairs, best, best.offset_at)
        best = finer if _inside(finer, settings) else best
    return scaled(best, settings)


def not_voted(pairs: Mapping[str, Pair], settings: SearchSettings, radius: float) -> str:
    """Say that `vote` left out the DEM's own cells, as their surfaces are too large; '' if not."""
    turn = float(np.deg2rad(settings.max_yaw)) + settings.max_scale
    laid, _, half = _laid_together(pairs, radius)
    finest, cell = _voting_cells(laid, half, turn)[-1], laid["dem"][1].grid.cell
    if turn <= 0 or finest < 1.5 * cell:
        return ""
    needed = surfaces_bytes(laid["dem"][1], cell, half, turn) / 1e9
    return (
        f"turns and scales were searched for on cells of {finest:.3g} m and coarser: those of the "
        f"DEM, {cell:.3g} m, would need {needed:.3g} GB within the search radius of {radius:g} m"
    )


def _inside(turn: Turn, settings: SearchSettings) -> bool:
    """Whether a turn is one of those that were asked for."""
    most = np.deg2rad(settings.max_yaw) + SMALL_YAW, settings.max_scale + PLAIN_SCALE
    return bool(abs(turn.yaw) <= most[0] and abs(turn.stretch - 1) <= most[1])


def coarse_turn(
    pairs: Mapping[str, Pair], cell: float, settings: SearchSettings, radius: float
) -> Turn | None:
    """Return what the tiles vote for on cells of one size [m], without asking what it is worth."""
    max_yaw, max_scale = float(np.deg2rad(settings.max_yaw)), settings.max_scale
    if max_yaw <= 0 and max_scale <= 0:
        return None
    pairs, moved, radius = _laid_together(pairs, radius)
    turn = _best_at(pairs, cell, radius, max_yaw, max_scale)
    if turn is None:
        return None
    return replace(turn, offset=(turn.offset[0] + moved[0], turn.offset[1] + moved[1]))


def _laid_together(
    pairs: Mapping[str, Pair], radius: float
) -> tuple[Mapping[str, Pair], tuple[float, float], float]:
    """Lay the moving survey amid the offsets at which it meets the reference, if these are few.

    Returns the pairs, the shift [m east, north] and the radius [m] about it.
    """
    reference, moving = (raster.grid for raster in pairs["dem"])
    window = Window.around(reference, moving, radius)
    if window.empty:
        return pairs, (0.0, 0.0), radius
    half = 0.5 * max(float(np.ptp(window.east)), float(np.ptp(window.north)))
    if half > 0.9 * radius:
        return pairs, (0.0, 0.0), radius
    cell = moving.cell
    east, north = (
        cell * round(0.5 * float(axis[0] + axis[-1]) / cell) for axis in (window.east, window.north)
    )
    laid = {}
    for name, (still, raster) in pairs.items():
        grid = replace(raster.grid, west=raster.grid.west + east, north=raster.grid.north + north)
        laid[name] = still, replace(raster, grid=grid)
    return laid, (east, north), half + cell


def plainly_wrong(scale: float, ratio: float) -> bool:
    """Whether a scale is far from 1, and explains far more of the tiles than it leaves."""
    return abs(scale - 1) >= PLAIN_SCALE and ratio >= PLAIN_RATIO


def scaled(turn: Turn, settings: SearchSettings) -> Turn:
    """Return the turn with its stretch as the scale, where that is plainly wrong or asked for."""
    off = abs(turn.stretch - 1)
    plain = plainly_wrong(turn.stretch, turn.ratio)
    if settings.max_scale > 0 and (plain or (settings.free_scale and off >= FINE_SCALE)):
        return replace(turn, scale=turn.stretch)
    return turn


def settled(pairs: Mapping[str, Pair], turn: Turn, guess: OffsetAt) -> Turn:
    """Measure a turn again on the rasters' own cells, each tile looked for where it must lie.

    Parameters
    ----------
    pairs : mapping
        "dem" and "ortho" to (reference, moving); the moving survey may have been turned already.
    turn : Turn
        What coarse cells said.
    guess : callable
        Offset (N, 2) [m] of places (N, 2) in the moving survey of `pairs`.

    Returns
    -------
    Turn
        With the whole yaw and stretch; as it was where the tiles say nothing more.
    """
    found = {}
    for channel, name in RASTER_OF.items():
        reference, moving = pairs[name]
        reach = math.ceil(LEFT * turn.cell / moving.grid.cell)
        tiles = surfaces_near(reference, moving, channel, guess, reach)
        if tiles is not None:
            found[channel] = tiles
    if not found:
        return turn
    tiles = found["terrain"] if "terrain" in found else found["image"]
    split = len(tiles.surfaces)
    if len(found) == 2:
        tiles = joined(tiles, found["image"])
    lever = float(np.hypot(*_arm(tiles).T).max())
    left = 2 * turn.cell / max(lever, turn.cell)  # the coarse cells' own step, both ways
    seen = _seen(tiles, split, tiles.reach * tiles.cell - left * lever, left, left)
    best, fitted = CHANCE, None
    for which, members in enumerate(seen.members):
        if members.sum() < MIN_TILES or seen.highest[which].max() <= best:
            continue
        place = np.unravel_index(int(np.argmax(seen.highest[which])), seen.highest[which].shape)
        part = tiles.only(members), seen.arm[members]
        here = seen.at(which, int(place[0]), int(place[1]))
        value, offset, yaw, scale = _sharpened(*part, *here, seen.step)
        fit = _fitted(*part, offset, yaw, scale)
        if fit is not None and value > best:
            best, fitted = value, fit
    if fitted is None:
        return turn
    stretch = fitted[1] * turn.stretch
    # the ratio is that of the whole stretch to what is left
    left_over = abs(fitted[1] - 1) / max(fitted[3], 1e-9)
    ratio = abs(stretch - 1) / max(left_over, 1e-9)
    return replace(turn, yaw=turn.yaw + fitted[0], stretch=stretch, ratio=ratio)


def _voting_cells(pairs: Mapping[str, Pair], radius: float, turn: float) -> list[float]:
    """Cells [m] to vote on, multiples of the DEM's.

    `ACROSS` of the first lie across the smaller survey; each other is half as large, down to the
    DEM's own, as long as the surfaces of all tiles stay within `MOST_BYTES`.
    """
    raster = min(pairs["dem"], key=lambda r: int(r.valid.sum()))
    times = max(1, round(math.sqrt(max(int(raster.valid.sum()), 1)) / ACROSS))
    cells = [times * raster.grid.cell]
    while times > 1:
        times = (times + 1) // 2
        cell = times * raster.grid.cell
        if surfaces_bytes(pairs["dem"][1], cell, radius, turn) > MOST_BYTES:
            break
        cells.append(cell)
    return cells


def _best_at(
    pairs: Mapping[str, Pair], cell: float, radius: float, max_yaw: float, max_scale: float
) -> Turn | None:
    """Return what both channels vote for, or the one that stands out more without the other."""
    found = {}
    for channel, name in RASTER_OF.items():
        tiles = channel_surfaces(*pairs[name], channel, cell, radius, max_yaw + max_scale)
        if tiles is not None:
            found[channel] = tiles
    if not found:
        return None
    channels = list(found)
    tiles = found[channels[0]] if len(found) == 1 else joined(found["terrain"], found["image"])
    split = len(found[channels[0]].surfaces)
    turns = _voted(channels, tiles, split, radius, max_yaw, max_scale)
    for turn in turns:
        if turn.gap >= STANDS_OUT:
            return turn
    return max(turns, key=lambda turn: turn.gap, default=None)


@dataclass(frozen=True, eq=False)
class _Seen:
    """F over a lattice of yaws and scales: at each offset the highest, and what made it.

    `members` (3 × (M,)): all tiles, the first channel's, the second's; `highest` and `choice`
    (3, K, K) are theirs, on offsets of `cell` [m].
    """

    arm: Float64
    cell: float
    step: float
    hypotheses: list[tuple[float, float]]
    members: list[Bool]
    highest: Float32
    choice: NDArray[np.int32]

    def at(self, which: int, row: int, col: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the offset [m] and the hypothesis (yaw, scale) of a place."""
        reach = self.highest.shape[1] // 2
        offset = float(col - reach) * self.cell, float(reach - row) * self.cell
        return offset, self.hypotheses[self.choice[which, row, col]]


def _arm(tiles: TileSurfaces) -> Float64:
    """(M, 2) places of the tiles about their middle [m]."""
    return np.asarray(tiles.centres - tiles.centres.mean(axis=0))


def _seen(
    tiles: TileSurfaces, split: int, radius: float, max_yaw: float, max_scale: float
) -> _Seen:
    """Evaluate F over the lattice; `split` is the number of the first channel's tiles."""
    from meshreg.heading.voting_kernels import strongest

    coarse, arm = pooled(tiles), _arm(tiles)
    # one pooled cell at the outermost tile: half of a pooled peak's width
    step = coarse.cell / max(float(np.hypot(*arm.T).max()), coarse.cell)
    yaws = step * np.arange(-math.ceil(max_yaw / step), math.ceil(max_yaw / step) + 1)
    scales = 1 + step * np.arange(-math.ceil(max_scale / step), math.ceil(max_scale / step) + 1)
    hypotheses = [(0.0, 1.0)]
    hypotheses += [(y, s) for y in yaws for s in scales if (y, s) != (0.0, 1.0)]
    reach = max(1, int(radius / coarse.cell + 1e-6))
    shifts = np.stack([_starts(coarse, arm, *hypothesis, reach) for hypothesis in hypotheses])
    number = np.arange(len(arm))
    members = [number >= 0, number < split, number >= split]
    least = np.array([_least(int(part.sum())) for part in members])
    highest, choice = strongest(_packed(coarse), shifts, split, least, reach)
    return _Seen(arm, coarse.cell, step, hypotheses, members, highest, choice)


def _voted(
    channels: Sequence[str],
    tiles: TileSurfaces,
    split: int,
    radius: float,
    max_yaw: float,
    max_scale: float,
) -> list[Turn]:
    """Fit a similarity to the winner of each set of tiles.

    A channel that sees nothing must not spoil the other: all tiles are one set, and each channel's
    another.
    """
    seen = _seen(tiles, split, radius, max_yaw, max_scale)
    turns = []
    names = {0: " and ".join(channels)}
    if len(channels) == 2:
        names |= {1: channels[0], 2: channels[1]}
    for which, name in names.items():
        turn = _stood(name, tiles.only(seen.members[which]), seen, which)
        if turn is not None:
            turns.append(turn)
    return turns


def _stood(channel: str, tiles: TileSurfaces, seen: _Seen, which: int) -> Turn | None:
    """Look at the best places again with whole cells and quarter steps; fit the one that is left.

    `tiles` are those of the set `which` of what was seen.
    """
    cell, arm = seen.cell, seen.arm[seen.members[which]]
    reach = seen.highest.shape[1] // 2
    found = [
        _sharpened(tiles, arm, *seen.at(which, row, col), seen.step)
        for row, col in _peaks(seen.highest[which])
    ]
    plain = _plain(tiles, round(reach * cell / tiles.cell))
    if not found or plain.size < 30:
        return None
    spread = MAD_TO_SIGMA * float(np.median(np.abs(plain - np.median(plain))))
    found.sort(key=lambda one: -one[0])
    value, offset, yaw, scale = found[0]
    # nearer ones are flanks of the same match
    apart = max(0.5, 3 * cell)
    rivals = [v for v, o, _, _ in found if math.hypot(o[0] - offset[0], o[1] - offset[1]) > apart]
    if not (spread > 0 and rivals):
        return None
    fitted = _fitted(tiles, arm, offset, yaw, scale)
    if fitted is None:
        return None
    yaw, stretch, offset, ratio = fitted
    gap, over = (value - max(rivals)) / spread, (value - float(plain.max())) / spread
    centre = tiles.centres.mean(axis=0) - arm.mean(axis=0)
    place = float(centre[0]), float(centre[1])
    trials = len(seen.hypotheses)
    return Turn(yaw, 1.0, stretch, ratio, offset, place, tiles.cell, gap, over, channel, trials)


def _peaks(highest: Float32) -> list[tuple[int, int]]:
    """Rows and columns of the `PEAKS` highest local maxima."""
    from scipy.ndimage import maximum_filter

    tops = (maximum_filter(highest, 3) == highest) & np.isfinite(highest)
    places = np.argwhere(tops)
    order = np.argsort(-highest[tops], kind="stable")[:PEAKS]
    return [(int(row), int(col)) for row, col in places[order]]


def _sharpened(
    tiles: TileSurfaces,
    arm: Float64,
    offset: tuple[float, float],
    hypothesis: tuple[float, float],
    step: float,
) -> tuple[float, tuple[float, float], float, float]:
    """Return the highest F next to a hypothesis: its value, offset [m], yaw and scale."""
    yaw, scale = hypothesis
    near = 0.25 * step * np.arange(-2, 3)
    tried = [(yaw + y, scale + s) for y in near for s in near]
    middle = np.rint(np.array([-offset[1], offset[0]]) / tiles.cell).astype(int) + tiles.reach
    shifts = np.stack([_shifts(arm, y, s, tiles.cell) for y, s in tried])
    rows, cols = np.moveaxis(middle + shifts, -1, 0)[..., None, None]
    around = np.arange(-2, 3)
    last = 2 * tiles.reach
    rows = np.clip(rows + around[:, None], 0, last)
    cols = np.clip(cols + around[None, :], 0, last)
    index = np.arange(len(arm))[:, None, None], rows, cols
    count = tiles.scored[index].sum(axis=1)
    total = np.minimum(tiles.surfaces[index], CAP).sum(axis=1)
    values = np.where(count >= _least(len(arm)), total / np.sqrt(np.maximum(count, 1)), -np.inf)
    which, row, col = np.unravel_index(int(np.argmax(values)), values.shape)
    place = middle - tiles.reach + [around[row], around[col]]
    here = float(place[1]) * tiles.cell, float(-place[0]) * tiles.cell
    return (float(values[which, row, col]), here, *tried[which])


def _plain(tiles: TileSurfaces, reach: int) -> Float32:
    """F without yaw and scale at every offset that enough tiles see."""
    part = slice(tiles.reach - reach, tiles.reach + reach + 1)
    count = tiles.scored[:, part, part].sum(axis=0)
    total = np.minimum(tiles.surfaces[:, part, part], CAP).sum(axis=0)
    known = count >= _least(len(tiles.surfaces))
    return np.asarray((total / np.sqrt(np.maximum(count, 1)))[known], np.float32)


def _packed(tiles: TileSurfaces) -> NDArray[np.int32]:
    """Surfaces as whole numbers, each with its count (`voting_kernels.strongest`)."""
    from meshreg.heading.voting_kernels import BIAS, SCORED

    values = np.rint(np.clip(tiles.surfaces, -CAP, CAP) * (BIAS / 8)).astype(np.int32)
    return np.where(tiles.scored, SCORED + BIAS + values, 0).astype(np.int32)


def _least(tiles: int) -> int:
    """So many tiles must see the reference."""
    return max(MIN_TILES, math.ceil(0.2 * tiles))


def _starts(
    tiles: TileSurfaces, arm: Float64, yaw: float, scale: float, reach: int
) -> NDArray[np.int64]:
    """(M, 2) first row and column of the window of ±`reach` offsets in each tile's surface."""
    shifts = tiles.reach - reach + _shifts(arm, yaw, scale, tiles.cell)
    return np.clip(shifts, 0, 2 * (tiles.reach - reach))


def _shifts(arm: Float64, yaw: float, scale: float, cell: float) -> NDArray[np.int64]:
    """(M, 2) rows and columns by which each tile's peak lies off the common offset."""
    c, s = scale * math.cos(yaw), scale * math.sin(yaw)
    east = (c - 1) * arm[:, 0] - s * arm[:, 1]
    north = s * arm[:, 0] + (c - 1) * arm[:, 1]
    return np.rint(np.stack([-north, east], axis=1) / cell).astype(np.int64)


def _fitted(
    tiles: TileSurfaces, arm: Float64, offset: tuple[float, float], yaw: float, scale: float
) -> tuple[float, float, tuple[float, float], float] | None:
    """Fit a similarity to the tiles' own peaks next to where the winner puts them, twice.

    Returns yaw [rad], scale, offset [m], and how many times the displacement left over the scale
    explains (root mean squares over the tiles). Tukey's biweight at four robust deviations.
    """
    ratio = 0.0
    for _ in range(2):
        middle = np.array([-offset[1], offset[0]]) / tiles.cell + tiles.reach
        places = np.rint(middle).astype(int) + _shifts(arm, yaw, scale, tiles.cell)
        found = [_local_peak(s, *at) for s, at in zip(tiles.surfaces, places, strict=True)]
        use = np.array([peak is not None for peak in found])
        if use.sum() < MIN_TILES:
            return None
        peaks = np.array([peak for peak in found if peak is not None]) - tiles.reach
        moved = np.stack([peaks[:, 1], -peaks[:, 0]], axis=1) * tiles.cell + tiles.behind[use]
        answer = similarity(arm[use], moved, 0.05 * tiles.cell)
        if answer is None:
            return None
        offset, yaw, scale, ratio = answer
    return yaw, scale, offset, ratio


def similarity(
    arm: Float64, moved: Float64, floor: float
) -> tuple[tuple[float, float], float, float, float] | None:
    """Fit ``moved = t + (s R - 1) arm``, linear in t, s cos psi and s sin psi; `floor` in m."""
    design = np.zeros((len(arm), 2, 4))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, :, 2] = arm
    design[:, 0, 3], design[:, 1, 3] = -arm[:, 1], arm[:, 0]
    weights = np.ones(len(arm))
    for _ in range(20):
        normal = np.einsum("mij,m,mik->jk", design, weights, design)
        if not np.linalg.cond(normal) < 1e9:
            return None
        answer = np.linalg.solve(normal, np.einsum("mij,m,mi->j", design, weights, moved))
        left = np.hypot(*(moved - design @ answer).T)
        deviation = max(MAD_TO_SIGMA * float(np.median(left)) / 1.2, floor)
        weights = biweight(left / (4 * deviation))
    share = weights / weights.sum()
    scale = math.hypot(1 + answer[2], answer[3])
    explained = abs(scale - 1) * math.sqrt(float(share @ (arm**2).sum(axis=1)))
    ratio = explained / max(math.sqrt(float(share @ left**2)), floor)
    yaw = math.atan2(answer[3], 1 + answer[2])
    return (float(answer[0]), float(answer[1])), yaw, scale, ratio


def _local_peak(surface: Float32, row: int, col: int) -> tuple[float, float] | None:
    """Row and column, to a part of a cell, of a tile's peak within three cells; None without."""
    top, left = row - 4, col - 4
    part = surface[max(top, 0) : top + 9, max(left, 0) : left + 9]
    if part.shape != (9, 9):
        return None
    row, col = (int(i) for i in np.unravel_index(int(np.argmax(part)), part.shape))
    if not (0 < row < 8 and 0 < col < 8) or part[row, col] < CLEAR:
        return None
    place = []
    for before, here, after in (part[row - 1 : row + 2, col], part[row, col - 1 : col + 2]):
        bend = float(before + after - 2 * here)
        place.append(0.5 * float(before - after) / bend if bend < 0 else 0.0)
    return top + row + place[0], left + col + place[1]
