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
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from meshreg.offsets.surface import MAD_TO_SIGMA
from meshreg.settings import SearchSettings
from meshreg.tile_surfaces import TileSurfaces, channel_surfaces, joined, pooled
from meshreg.types import Float32, Float64, SurveyRaster

Pair = tuple[SurveyRaster, SurveyRaster]
ACROSS = 100  # voting cells along the patch: enough for 25 tiles, few enough for a fraction of 1 s
MIN_TILES = 4
STANDS_OUT = 3.0  # deviations over the best unrelated hypothesis; chance reaches 2
SMALL_YAW = np.deg2rad(0.9)  # `refine` turns up to 1° by itself; the rest is the vote's own error
PLAIN_SCALE = 0.01  # a scale nearer to 1 than this is not plainly wrong,
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
        Of the centre of the moving survey's tiles [m].
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
    gap: float
    over_plain: float
    channel: str
    trials: int

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
    cell = _voting_cell(pairs)
    found = {}
    for channel, name in (("terrain", "dem"), ("image", "ortho")):
        tiles = channel_surfaces(*pairs[name], channel, cell, radius, max_yaw + max_scale)  # type: ignore[arg-type]
        if tiles is not None:
            found[channel] = tiles
    if len(found) == 2:  # a channel that sees nothing must not spoil the other: it is tried alone
        found = {"terrain and image": joined(found["terrain"], found["image"])} | found
    best = None
    for name, tiles in found.items():
        best = _voted(name, tiles, radius, max_yaw, max_scale)
        if best is not None and best.gap >= STANDS_OUT:
            break
    if best is None or best.gap < STANDS_OUT:
        return None
    off = abs(best.stretch - 1)
    plain = off >= PLAIN_SCALE and best.ratio >= PLAIN_RATIO
    if max_scale > 0 and (plain or (settings.free_scale and off >= FINE_SCALE)):
        best = replace(best, scale=best.stretch)
    inside = abs(best.yaw) <= max_yaw + SMALL_YAW and off <= max_scale + PLAIN_SCALE
    return best if inside else None


def _voting_cell(pairs: Mapping[str, Pair]) -> float:
    """Cell [m] that lays about `ACROSS` cells along the smaller survey, a multiple of the DEM's."""
    raster = min(pairs["dem"], key=lambda r: int(r.valid.sum()))
    across = math.sqrt(max(int(raster.valid.sum()), 1))
    return raster.grid.cell * max(1, round(across / ACROSS))


def _voted(
    channel: str, tiles: TileSurfaces, radius: float, max_yaw: float, max_scale: float
) -> Turn | None:
    """Evaluate F over the lattice of yaws and scales, and fit a similarity to the winner."""
    coarse = pooled(tiles)
    arm = tiles.centres - tiles.centres.mean(axis=0)
    # one pooled cell at the outermost tile: half of a pooled peak's width
    step = coarse.cell / max(float(np.hypot(*arm.T).max()), coarse.cell)
    yaws = step * np.arange(-math.ceil(max_yaw / step), math.ceil(max_yaw / step) + 1)
    scales = 1 + step * np.arange(-math.ceil(max_scale / step), math.ceil(max_scale / step) + 1)
    hypotheses = [(0.0, 1.0)]
    hypotheses += [(y, s) for y in yaws for s in scales if (y, s) != (0.0, 1.0)]
    reach = max(1, int(radius / coarse.cell + 1e-6))
    highest = plain = _evidence(coarse, arm, 0.0, 1.0, reach)
    choice = np.zeros(highest.shape, np.int32)
    for number, (yaw, scale) in enumerate(hypotheses):
        evidence = _evidence(coarse, arm, yaw, scale, reach)
        choice[evidence > highest] = number
        highest = np.maximum(evidence, highest)
    known = plain[np.isfinite(plain)]
    if known.size < 30:
        return None
    spread = MAD_TO_SIGMA * float(np.median(np.abs(known - np.median(known))))
    row, col = np.unravel_index(int(np.argmax(highest)), highest.shape)
    away = np.hypot(*(np.indices(highest.shape) - np.reshape([row, col], (2, 1, 1)))) * coarse.cell
    rivals = highest[away > max(0.5, 3 * coarse.cell)]  # nearer ones are flanks of the same match
    if not (spread > 0 and rivals.size and np.isfinite(rivals.max())):
        return None
    offset = float(col - reach) * coarse.cell, float(reach - row) * coarse.cell
    fitted = _fitted(tiles, offset, *hypotheses[choice[row, col]])
    if fitted is None:
        return None
    yaw, stretch, offset, ratio = fitted
    value, trials = float(highest.max()), len(hypotheses)
    gap, over_plain = (value - float(v) for v in (rivals.max(), known.max()))
    return Turn(
        yaw, 1.0, stretch, ratio, offset, gap / spread, over_plain / spread, channel, trials
    )


def _evidence(tiles: TileSurfaces, arm: Float64, yaw: float, scale: float, reach: int) -> Float32:
    """F for one yaw and scale at every offset; -inf where too few tiles see the reference."""
    shape = (2 * reach + 1, 2 * reach + 1)
    total, count = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    shifts = tiles.reach - reach + _shifts(arm, yaw, scale, tiles.cell)
    shifts = np.clip(shifts, 0, 2 * (tiles.reach - reach))
    for surface, scored, (row, col) in zip(tiles.surfaces, tiles.scored, shifts, strict=True):
        part = (slice(row, row + shape[0]), slice(col, col + shape[1]))
        total += surface[part]
        count += scored[part]
    least = max(MIN_TILES, 0.2 * len(tiles.surfaces))
    return np.where(count >= least, total / np.sqrt(np.maximum(count, 1)), -np.inf)


def _shifts(arm: Float64, yaw: float, scale: float, cell: float) -> np.ndarray:
    """(M, 2) rows and columns by which each tile's peak lies off the common offset."""
    c, s = scale * math.cos(yaw), scale * math.sin(yaw)
    east = (c - 1) * arm[:, 0] - s * arm[:, 1]
    north = s * arm[:, 0] + (c - 1) * arm[:, 1]
    return np.rint(np.stack([-north, east], axis=1) / cell).astype(int)


def _fitted(
    tiles: TileSurfaces, offset: tuple[float, float], yaw: float, scale: float
) -> tuple[float, float, tuple[float, float], float] | None:
    """Fit a similarity to the tiles' own peaks next to where the winner puts them, twice.

    Returns yaw [rad], scale, offset [m], and how many times the displacement left over the scale
    explains (root mean squares over the tiles). Tukey's biweight at four robust deviations.
    """
    arm = tiles.centres - tiles.centres.mean(axis=0)
    ratio = 0.0
    for _ in range(2):
        middle = np.array([-offset[1], offset[0]]) / tiles.cell + tiles.reach
        places = np.rint(middle).astype(int) + _shifts(arm, yaw, scale, tiles.cell)
        found = [_local_peak(s, *at) for s, at in zip(tiles.surfaces, places, strict=True)]
        use = np.array([peak is not None for peak in found])
        if use.sum() < MIN_TILES:
            return None
        peaks = np.array([peak for peak in found if peak is not None]) - tiles.reach
        moved = np.stack([peaks[:, 1], -peaks[:, 0]], axis=1) * tiles.cell
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
        weights = np.clip(1 - (left / (4 * deviation)) ** 2, 0, None) ** 2
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
