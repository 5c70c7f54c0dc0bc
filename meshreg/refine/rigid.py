"""The rigid answer from tile offsets: offset, yaw and their covariance.

Both surveys are cut into tiles that are matched alone (`tiles`). A rotation about the vertical
shows as tile offsets that turn; what is left is the internal distortion of the two models. The
answer is the rigid motion that fits the whole overlap best, which is not the one that fits the
tiles best (`kriging`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from meshreg.offsets import neutral
from meshreg.offsets.channels import smooth
from meshreg.records import Bool, Channel, Finding, Float64, OffsetAt, SurveyRaster
from meshreg.refine.tiles import (
    MAX_YAW,
    Overlap,
    Relief,
    TileOffsets,
    correlated_tiles,
    polished_tiles,
    spread_of_fields,
)
from meshreg.statistics import (
    MAD_TO_SIGMA,
    Ground,
    best_motion,
    biweight,
    block_sandwich,
    design,
    overlap_ground,
)

MIN_TILES = 6
LEAST_FOR_SCALE = 12  # tiles, for a scale of their own
UNKNOWN_SCALE = 0.01 / 3  # sigma: beyond 1 % a scale is plainly wrong, and found before (`voting`)
NODES = 20  # along the overlap's side
# Kriging takes the warp to be smooth and the tiles to err independently; small tiles, with few
# details each, do so less. The variance is larger by HONEST_SIDE over the cells along a tile's
# side. Measured on synthetic pairs of 12 to 25 m (coverage of the stated region).
HONEST_SIDE = 45
# Cells: what sampling alone leaves open, alike for all tiles, so that their scatter does not show
# it; for peaks of correlation (a parabola through whole cells leans towards them), and polished.
PEAK_RESOLUTION, RESOLUTION = 0.05, 0.005
RELIEF_CELLS = 5.0  # of an image: its surroundings, as the judge's local contrast sees them


@dataclass(frozen=True, eq=False)
class Refined:
    """The horizontal answer at `pivot`: offset, yaw, covariance and what is left per tile.

    Attributes
    ----------
    pivot : (2,) float64
        Absolute east and north [m] in the moving survey, centroid of the overlap.
    offset : (2,) float64
        East and north [m] at the pivot.
    yaw : float
        Anticlockwise turn of the moving survey [rad]; 0 where it is not significant.
    covariance : (3, 3) float64
        Of (east, north, yaw).
    scale_variance : float
        Of the scale by which lengths are multiplied, where one was fitted (`with_scale`); else 0.
    tiles : TileOffsets or None
    residuals : (M, 2) float64
        Tile offset less the rigid answer's [m].
    weights : (M,) float64
    note : str
        What the user should know.
    doubt : Finding or None
        Why the answer cannot be accepted, if so.
    undecided : float
        Where the image alone tells: what its tones and edges disagree by, in cells (one sigma).
    offset_at : callable or None
        Most likely offset (N, 2) [m] at places (N, 2) in the moving survey, internal warp included.
    """

    pivot: Float64
    offset: Float64
    yaw: float
    covariance: Float64
    tiles: TileOffsets | None = None
    residuals: Float64 | None = None
    weights: Float64 | None = None
    note: str = ""
    doubt: Finding | None = None
    scale_variance: float = 0.0
    undecided: float = 0.0
    offset_at: OffsetAt | None = None


def refine(
    rasters: Sequence[tuple[SurveyRaster, SurveyRaster, Channel]],
    offset: tuple[float, float],
    sigma: Float64,
    agree: float,
    fields: neutral.FieldsOf = neutral.pair_fields,
) -> Refined:
    """Refine an offset and find a small yaw (to ±1°) from the offsets of tiles.

    Parameters
    ----------
    rasters : sequence of (reference, moving, channel)
        The channels that support the offset.
    offset : (east, north)
        The judged offset [m].
    sigma : (2, 2) float64
        Its covariance, used where the tiles are too few.
    agree : float
        The refined offset may differ from the judged one by this much [m].
    fields : callable, optional
        Instead of `neutral.pair_fields`, where their fields are known already.
    """
    ground = dem_ground(rasters[0][0], rasters[0][1], offset)
    centre = ground.share @ ground.places
    coarse = Refined(centre, np.array(offset), 0.0, _block_diagonal(sigma, MAX_YAW**2 / 9))
    found = [correlated_tiles(a, b, channel, offset, fields) for a, b, channel in rasters]
    tiles = _joined(found)
    if not _enough(tiles):
        return replace(coarse, note="too few tiles match on their own to measure yaw")
    assert tiles is not None
    rough = fit(tiles, centre)
    answers = []
    for (reference, moving, channel), own in zip(rasters, found, strict=True):
        cell = moving.grid.cell
        answer = _of_peaks(own, rough, ground, PEAK_RESOLUTION * cell)
        if channel == "terrain":
            finer = _polished(reference, moving, ground, rough)
            if finer is not None:
                finer = _stated(finer, RESOLUTION * cell)
                answer = finer if answer is None else blended(finer, answer)
        elif answer is not None:
            assert answer.tiles is not None
            light = spread_of_fields(reference, moving, channel, answer.tiles, fields)
            answer = replace(answer, undecided=float(np.sqrt(np.linalg.eigvalsh(light)[1])) / cell)
            light = light + relief_height(reference, moving, offset) ** 2 * np.eye(2)
            apart = 4 * ground.share @ ((ground.places - centre) ** 2).sum(axis=1)
            turn = 0.5 * np.trace(light) / apart  # one side displaced, the other not
            answer = _added(answer, _block_diagonal(light, turn))
        answers += [] if answer is None else [answer]
    if answers:
        best = answers[0] if len(answers) == 1 else replace(combined(*answers), undecided=0.0)
    else:  # neither channel has enough tiles of its own
        best = replace(rough, covariance=misfit(tiles) * rough.covariance)
        best = _stated(best, PEAK_RESOLUTION * max(moving.grid.cell for _, moving, _ in rasters))
    if abs(best.yaw) > MAX_YAW:
        turn = np.rad2deg(best.yaw)
        said = f"the surveys are turned by about {turn:.1f}°, beyond ±1°"
        return replace(coarse, doubt=Finding("heading", said, values={"degrees": turn}))
    moved = float(np.hypot(*(best.offset - offset)))
    if moved > agree:
        said = f"tiles alone lie {moved:.2f} m from the whole's offset"
        return replace(coarse, doubt=Finding("pieces", said, values={"apart": moved}))
    return best


def _of_peaks(
    tiles: TileOffsets | None, rough: Refined, ground: Ground, resolution: float
) -> Refined | None:
    """Rigid answer of one channel's peaks of correlation that the rough fit can explain."""
    if not _enough(tiles):
        return None
    assert tiles is not None
    kept = tiles.only(_explained(tiles, rough))
    if not _enough(kept):
        return None
    return _stated(fit_overlap(kept, ground, rough.pivot), resolution)


def _explained(tiles: TileOffsets, rough: Refined) -> Bool:
    """Tell which tiles lie within four robust deviations of their channel's own rigid fit."""
    weights = fit(tiles, rough.pivot).weights
    assert weights is not None
    return np.asarray(weights > 0)


def relief_height(
    reference: SurveyRaster, moving: SurveyRaster, offset: tuple[float, float]
) -> float:
    """Rms height [m] of the ground about its surroundings (`RELIEF_CELLS`), as far as it recurs.

    By so much light can displace what an image shows: a shadow's edge lies a height away from the
    edge that casts it where the light stands at 45°, on its other side if the light does; and all
    tiles are displaced alike, so that their scatter does not tell. The covariance of both surveys'
    heights has none of their noise in it; two of its sigmas are added. 0 where no height is known.
    """
    overlap = Overlap.at(reference.grid, moving.grid, offset)
    if overlap.side < 1:
        return 0.0
    here = np.s_[slice(*overlap.rows), slice(*overlap.cols)]
    there = tuple(
        slice(low + step, high + step)
        for (low, high), step in zip((overlap.rows, overlap.cols), overlap.shift, strict=True)
    )
    heights, known = [], np.ones((1, 1), bool)
    for raster, part in ((reference, there), (moving, here)):
        mask = raster.valid
        height = np.where(mask, raster.height.astype(np.float64), 0.0)
        height -= np.median(height[mask]) if mask.any() else 0.0
        heights.append((height - smooth(np.where(mask, height, 0.0), mask, RELIEF_CELLS))[part])
        known = known & mask[part]
    if not known.any():
        return 0.0
    first, second = (height[known] for height in heights)
    independent = max(len(first) / RELIEF_CELLS**2, 1.0)
    doubt = 2.0 * np.sqrt(np.mean(first**2) * np.mean(second**2) / independent)
    return float(np.sqrt(max(np.mean(first * second), 0.0) + doubt))


def combined(first: Refined, second: Refined) -> Refined:
    """Answer of two independent channels, each weighed by its covariance.

    What they differ by beyond their covariances is an error of one of them, and nothing says of
    which: the more probable the one is, the less of it is the answer's (the variance between two
    hypotheses, ``p (1 - p) d d'``, with p as the weights are), and it goes in with the share that
    chance does not explain, as a random effect (DerSimonian and Laird, Controlled Clinical Trials
    7, 1986). No step in the covariances or the offsets makes the answer jump.
    """
    inverse = [np.linalg.inv(r.covariance) for r in (first, second)]
    covariance = np.linalg.inv(inverse[0] + inverse[1])
    values = [np.append(r.offset, r.yaw) for r in (first, second)]
    answer = covariance @ (inverse[0] @ values[0] + inverse[1] @ values[1])
    return _between(first, second, answer, 0.5 * (covariance + covariance.T), 1)


def blended(finer: Refined, coarser: Refined) -> Refined:
    """Answer of two readings of the same ground: the surer one nearly alone, yet without a jump.

    They do not support each other, so that the covariance is no smaller than theirs.
    """
    weight = _size(coarser) ** 2 / (_size(finer) ** 2 + _size(coarser) ** 2)
    values = [np.append(r.offset, r.yaw) for r in (finer, coarser)]
    answer = weight * values[0] + (1 - weight) * values[1]
    covariance = weight * finer.covariance + (1 - weight) * coarser.covariance
    return _between(finer, coarser, answer, covariance, 2)


def _between(
    first: Refined, second: Refined, answer: Float64, covariance: Float64, power: int
) -> Refined:
    """Add to the covariance what two answers differ by beyond chance; keep the surer's tiles."""
    apart = np.append(first.offset - second.offset, first.yaw - second.yaw)
    sizes = np.array([_size(first), _size(second)]) ** power
    weights = sizes[::-1] / sizes.sum()
    both = first.covariance + second.covariance
    chance = 2.0 / max(float(apart[:2] @ np.linalg.solve(both[:2, :2], apart[:2])), 2.0)
    of_yaw = 1.0 / max(float(apart[2] ** 2 / both[2, 2]), 1.0)
    apart *= np.sqrt(1.0 - np.array([chance, chance, of_yaw]))
    covariance = covariance + weights.prod() * np.outer(apart, apart)
    surer = first if weights[0] >= weights[1] else second
    if surer.yaw == 0 and abs(answer[2]) <= 2 * np.sqrt(covariance[2, 2]):  # as `fit_overlap`
        answer[2] = 0.0
        covariance = _block_diagonal(covariance[:2, :2], covariance[2, 2])
    assert surer.offset_at is not None
    step = replace(surer, offset=answer[:2] - surer.offset, yaw=float(answer[2]) - surer.yaw)
    whole: OffsetAt = partial(_moved, surer.offset_at, step)
    moved = replace(
        surer, offset=answer[:2], yaw=float(answer[2]), covariance=covariance, offset_at=whole
    )
    return _with_residuals(moved)


def _moved(offset_at: OffsetAt, step: Refined, places: Float64) -> Float64:
    """Offsets (N, 2) [m] of a field that a rigid step moves."""
    return np.asarray(offset_at(places) + _rigid(step, places))


def _stated(refined: Refined, resolution: float) -> Refined:
    """Add to the covariance what sampling alone leaves open [m]."""
    return _added(refined, np.diag([resolution**2, resolution**2, 0.0]))


def _added(refined: Refined, floor: Float64) -> Refined:
    """Add to the covariance what the scatter of tiles does not show."""
    return replace(refined, covariance=refined.covariance + floor)


def misfit(tiles: TileOffsets) -> float:
    """By how much the variance is larger than the tiles' scatter tells."""
    return max(1.0, HONEST_SIDE / tiles.side)


def _polished(
    reference: SurveyRaster, moving: SurveyRaster, ground: Ground, start: Refined
) -> Refined | None:
    """Polish the tiles from the rigid answer, and again from what they say, until it stays."""
    still, moved, offset = Relief.of(reference), Relief.of(moving), start.offset
    guess: OffsetAt = partial(_rigid, start)
    for _ in range(4):
        tiles = polished_tiles(still, moved, offset, guess)
        if not _enough(tiles):
            return None
        assert tiles is not None
        answer = fit_overlap(tiles, ground, start.pivot)
        assert answer.offset_at is not None
        guess = answer.offset_at
        step, offset = np.hypot(*(answer.offset - offset)), answer.offset
        if step < 0.005 * moving.grid.cell:
            break
    return answer


def fit_overlap(tiles: TileOffsets, ground: Ground, pivot: Float64) -> Refined:
    """Rigid motion that fits the whole ground best; the yaw is 0 where it is under two sigmas.

    The ground counts as the reference sees it: where the models stretch, so do its cells. It might
    as well count as the moving survey sees it, which is what the same pair the other way round will
    do: half of what that changes is added to the doubt. So is all that changes where the tiles that
    were left out are not: what counts as ground that has not changed is a choice.
    """
    places, offsets = tiles.places, tiles.offsets
    motion = best_motion(places, offsets, ground, pivot, yaw_free=True, noise=tiles.noise)
    either = motion.answer
    share = ground.share * np.clip(motion.field.growth(ground.places), 0.5, 2.0)
    ground = replace(ground, share=share / share.sum())
    motion = best_motion(
        places, offsets, ground, pivot, yaw_free=True, start=motion, noise=tiles.noise
    )
    everything = motion
    if not motion.used.all():
        everything = replace(motion, used=np.ones(len(places), bool))
        everything = best_motion(
            places, offsets, ground, pivot, yaw_free=True, start=everything, noise=tiles.noise
        )
    half, choice = 0.5 * (motion.answer - either), everything.answer - motion.answer
    covariance, yaw = motion.covariance, float(motion.answer[2])
    offset = motion.answer[:2]
    if abs(yaw) <= 2 * np.sqrt(covariance[2, 2]):
        still = best_motion(
            places, offsets, ground, pivot, yaw_free=False, start=motion, noise=tiles.noise
        )
        yaw, offset = 0.0, still.answer
        covariance = _block_diagonal(still.covariance, covariance[2, 2])
    covariance = misfit(tiles) * covariance + np.outer(half, half) + np.outer(choice, choice)
    used = motion.used.astype(np.float64)
    answer = Refined(pivot, offset, yaw, covariance, tiles, weights=used, offset_at=motion.field)
    return _with_residuals(answer)


def with_scale(refined: Refined, ground: Ground) -> tuple[Refined, float]:
    """Return the answer that knows the variance of its scale, and the scale.

    That of the similarity which fits all of the ground best, from the refined tiles by kriging, as
    the rest of the answer; 1, known to a third of a per cent, where they are too few.
    """
    tiles = refined.tiles
    if tiles is None or len(tiles.places) < LEAST_FOR_SCALE:
        return replace(refined, scale_variance=UNKNOWN_SCALE**2), 1.0
    motion = best_motion(
        tiles.places,
        tiles.offsets,
        ground,
        refined.pivot,
        yaw_free=True,
        scale_free=True,
        noise=tiles.noise,
    )
    similar = motion.answer[2:] + np.array([0.0, 1.0])  # s sin psi, s cos psi
    scale = float(np.hypot(*similar))
    slope = similar / scale
    variance = misfit(tiles) * float(slope @ motion.covariance[2:, 2:] @ slope)
    return replace(refined, scale_variance=variance / scale**2), scale


def _rigid(refined: Refined, places: Float64) -> Float64:
    """Offset (N, 2) [m] that the answer means at places (N, 2)."""
    arm = places - refined.pivot
    return refined.offset + refined.yaw * np.stack([-arm[:, 1], arm[:, 0]], axis=1)


def _with_residuals(refined: Refined) -> Refined:
    assert refined.tiles is not None
    left = refined.tiles.offsets - _rigid(refined, refined.tiles.places)
    return replace(refined, residuals=left)


def _enough(tiles: TileOffsets | None) -> bool:
    return tiles is not None and len(np.unique(tiles.block)) >= MIN_TILES


def _size(refined: Refined) -> float:
    return float(np.trace(refined.covariance[:2, :2]))


def fit(tiles: TileOffsets, pivot: Float64) -> Refined:
    """Robust rigid fit of tile offsets: ``d = t + yaw * (-(n - n0), e - e0)``.

    Tukey's biweight at 4 robust deviations, one deviation per channel. The covariance is the
    block sandwich (`statistics.sandwich`), since channels at one place err alike.
    """
    columns = design(tiles.places, pivot, 3)
    middle = np.median(tiles.offsets, axis=0)
    answer = np.append(middle, _median_turn(tiles, pivot, middle))
    for _ in range(20):
        residual = tiles.offsets - columns @ answer
        size = np.hypot(*residual.T)
        scale = _scales(size, tiles.channel)
        weights = biweight(size / (4 * scale)) / scale**2
        normal = np.einsum("mij,m,mik->jk", columns, weights, columns)
        step = np.linalg.solve(normal, np.einsum("mij,m,mi->j", columns, weights, residual))
        answer = answer + step
        if np.abs(step[:2]).max() < 1e-9:
            break
    residual = tiles.offsets - columns @ answer
    scores = np.einsum("mij,m,mi->mj", columns, weights, residual)
    covariance = block_sandwich(normal, scores, tiles.block, columns.shape[2])
    weights = weights / weights.max()
    return Refined(pivot, answer[:2], float(answer[2]), covariance, tiles, residual, weights)


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


def _joined(found: Sequence[TileOffsets | None]) -> TileOffsets | None:
    """Tiles of both channels; blocks are by place, on a common lattice of the coarser tiles."""
    parts = [tiles for tiles in found if tiles is not None]
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
        min(p.side for p in parts),
    )


def dem_ground(
    reference: SurveyRaster, moving: SurveyRaster, offset: tuple[float, float] | Float64
) -> Ground:
    """Places [m] in the moving survey that stand for its cells that fall on reference cells."""
    here, there = (
        raster.valid if raster.valid.any() else raster.color_valid for raster in (moving, reference)
    )
    ground = overlap_ground((there, here), (reference.grid, moving.grid), offset, NODES)
    if ground is None:  # it does not overlap there: all of it stands for what may
        ground = overlap_ground((here, here), (moving.grid, moving.grid), (0.0, 0.0), NODES)
    assert ground is not None
    return ground


def _block_diagonal(sigma: Float64, yaw_variance: float) -> Float64:
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = sigma
    covariance[2, 2] = yaw_variance
    return covariance
