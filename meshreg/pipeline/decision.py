"""What a pair of rasters says: the methods' proposals, judged, refined, lifted and tilted."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, partial
from typing import Any

import numpy as np

from meshreg import judge as judging
from meshreg.heading import (
    STANDS_OUT,
    Pairs,
    Turn,
    Turned,
    near_offset,
    not_voted,
    plainly_wrong,
    turned_as_voted,
    vote,
)
from meshreg.height import Heights, fit_heights
from meshreg.judge import Found, Stretch, findings, last_word
from meshreg.offsets import ESTIMATORS, estimate_offset
from meshreg.offsets.correlate import Window
from meshreg.offsets.neutral import FieldsOf, pair_fields
from meshreg.pipeline.narrowing import (
    NOWHERE,
    Elsewhere,
    cut,
    elsewhere,
    margin,
    narrowing,
    places,
)
from meshreg.pipeline.turned import as_delivered, check_heading_and_scale
from meshreg.records import (
    RASTER_OF,
    Channel,
    Float64,
    Grid,
    OffsetEstimate,
    Survey,
    SurveyRaster,
    Tear,
    Transform,
)
from meshreg.refine import (
    PEAK_RESOLUTION,
    Refined,
    contradicts,
    correlated_tiles,
    dem_ground,
    refine,
    tear_of_tiles,
    with_scale,
)
from meshreg.settings import Settings
from meshreg.statistics import RAYLEIGH, Ground, lever, registration_error

log = logging.getLogger(__name__)
Progress = Callable[[str, float], None]
TEAR_REACH = 1.0  # m that a part of a model may lie apart by and be found, in so many cells:
TEAR_CELLS = (12, 24)
TEAR_PART = 0.5  # cells: a smaller step is within what correlated tiles lean by
Manual = Callable[[Transform | None], OffsetEstimate]


@dataclasses.dataclass
class Clock:
    """Seconds per stage, and the word to the progress bar."""

    tell: Progress
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block; say that it begins and ends."""
        self.tell(name, 0.0)
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
        self.tell(name, 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Decision:
    """What a pair of rasters says.

    Attributes
    ----------
    estimates : tuple of OffsetEstimate
    judgement : Judgement
        With what speaks against it in its verdict.
    placed : Judgement
        Of the place alone.
    found : Found
        What the rules of the verdict were asked about.
    refined : Refined or None
        From the moving survey as it was delivered; None when rejected.
    seconds : mapping
        By stage: "vote", each method, "judge", "refine".
    heights : Heights or None
        None when rejected.
    notes : tuple of str
        What the user should know of the heading and the scale.
    motion : Transform or None
        By which the moving survey was turned before the methods looked at it: estimates,
        hypotheses and channel maps are those of the turned one.
    scale : float
        By which lengths are multiplied; 1 unless asked for or plainly wrong.
    """

    estimates: tuple[OffsetEstimate, ...]
    judgement: judging.Judgement
    placed: judging.Judgement
    refined: Refined | None
    seconds: Mapping[str, float]
    heights: Heights | None = None
    notes: tuple[str, ...] = ()
    motion: Transform | None = None
    scale: float = 1.0
    found: Found = dataclasses.field(default_factory=Found)

    @property
    def transform(self) -> Transform | None:
        """The whole `reference_from_moving`; None when rejected."""
        if self.refined is None or self.heights is None:
            return None
        return self.heights.transform(_horizontal(self.refined, self.scale))


def decide(
    pairs: Pairs,
    settings: Settings,
    radius: float,
    progress: Progress | None = None,
    manual: Manual | None = None,
    turned: Turned | None = None,
) -> Decision:
    """Estimate, judge and refine: everything of `register_pair` that looks at rasters alone.

    Parameters
    ----------
    pairs : mapping
        "dem", "ortho" and what else the methods look at ("sift") to (reference, moving).
    settings : Settings
    radius : float
        Half width of the search window [m].
    progress : callable, optional
    manual : callable, optional
        As of `register_pair`.
    turned : callable, optional
        ``turned(turn)`` makes the rasters of the turned moving survey again, and says by which
        motion; without it a survey that needs turning is looked at as it is.
    """
    clock = Clock(progress or (lambda stage, fraction: None))
    times = narrowing(_grids(pairs["dem"]), _grids(pairs["ortho"]), radius)
    if times > 1:
        return _narrowed(pairs, settings, radius, clock, manual, turned, times)
    return _asked(pairs, settings, radius, clock, manual, turned)


def _asked(
    pairs: Pairs,
    settings: Settings,
    radius: float,
    clock: Clock,
    manual: Manual | None,
    turned: Turned | None,
    beyond: Elsewhere = NOWHERE,
) -> Decision:
    """Decide; where nothing was proven, say which cells no turn was searched for on."""
    decision = _turned_if_voted(pairs, settings, radius, clock, manual, turned, beyond)
    if decision.motion is not None or decision.judgement.verdict == "accepted":
        return decision
    said = not_voted(pairs, settings.search, radius)
    return dataclasses.replace(decision, notes=(*decision.notes, said)) if said else decision


def _turned_if_voted(
    pairs: Pairs,
    settings: Settings,
    radius: float,
    clock: Clock,
    manual: Manual | None,
    turned: Turned | None,
    beyond: Elsewhere,
) -> Decision:
    """Turn the moving survey if its tiles ask for it; then estimate, judge and refine."""
    turn = None
    if settings.search.max_yaw > 0 or settings.search.max_scale > 0:
        with clock.stage("vote"):
            turn = vote(pairs, settings.search, radius)
    in_frame = partial(_in_frame, beyond=beyond)
    if turn is None or not turn.needed or turned is None:
        return in_frame(pairs, settings, radius, clock, manual, turn)
    log.info("the tiles vote for a turn: %s", turn)
    delivered = None
    if not turn.proven:  # what the tiles do not prove the judge may, who is told of all trials
        delivered = in_frame(pairs, settings, radius, clock, manual, None)
        if delivered.judgement.verdict == "accepted":
            return delivered
    with clock.stage("turn"):
        again, motion = turned_as_voted(pairs, turn, turned, settings.search)
    decision = in_frame(again, settings, radius, clock, manual, turn, (motion, pairs))
    if delivered is not None:
        known = delivered.judgement.verdict != "rejected"
        better = decision.judgement.false_alarm < delivered.judgement.false_alarm
        return decision if better or not known else delivered
    # the finer tiles may contradict the turn or the scale, if few of the coarse ones told it
    scaled = decision.scale != 1.0 and not settings.search.free_scale
    if decision.judgement.verdict != "accepted" and (decision.found.turned or scaled):
        delivered = in_frame(pairs, settings, radius, clock, manual, None)
        finest = delivered.found.stretch  # the vote's own rule, of the finest tiles
        plain = finest is not None and plainly_wrong(finest.value, finest.ratio)
        accepted = delivered.judgement.verdict == "accepted"
        return delivered if accepted and not (scaled and plain) else decision
    if decision.judgement.verdict != "rejected":
        return decision
    return in_frame(pairs, settings, radius, clock, manual, turn)


def _narrowed(
    pairs: Pairs,
    settings: Settings,
    radius: float,
    clock: Clock,
    manual: Manual | None,
    turned: Turned | None,
    times: int,
) -> Decision:
    """Look for places on coarse cells; decide at the one that is best on the pair's own."""
    search = settings.search
    about = margin(*(raster.grid for raster in pairs["dem"]))
    with clock.stage("coarse"):
        found = places(pairs, search, radius, times)
        picked = None if manual is None else manual(None)
        if picked is not None and picked.status != "failed":
            found = [(picked.east, picked.north), *found]
        cuts = [cut(pairs, place, about) for place in found]
        cuts = [part for part in cuts if not Window.around(*_grids(part["dem"]), radius).empty]
        if not cuts:  # nothing overlaps: it is told as ever
            cuts = [cut(pairs, (0.0, 0.0), about)]
        maps = [judging.channel_maps(part, radius, chance=False) for part in cuts]
        clear = [
            max((m.peak.gap for m in seen.values() if m.peak is not None), default=0.0)
            for seen in maps
        ]
        best = int(np.argmax(clear))
        if clear[best] < settings.judge.overwhelming_gap and turned is not None:
            turns = [vote(part, search, radius) for part in cuts]
            gaps = [0.0 if turn is None or not turn.needed else turn.gap for turn in turns]
            if max(gaps) >= STANDS_OUT or clear[best] < settings.judge.accept_gap:
                best = int(np.argmax(gaps)) if max(gaps) > 0 else best
        whole = Window.around(*_grids(pairs["dem"]), radius)
        beyond = elsewhere(maps[best], [m for k, m in enumerate(maps) if k != best], whole)

    def turned_and_cut(turn: Turn) -> tuple[Pairs, Transform]:
        assert turned is not None
        again, motion = turned(turn)
        kept = cuts[best]
        return {
            name: (kept[name][0], near_offset(moving, kept[name][0], (0.0, 0.0), radius))
            for name, (_, moving) in again.items()
        }, motion

    again = None if turned is None else turned_and_cut
    decision = _asked(cuts[best], settings, radius, clock, manual, again, beyond)
    cell = times * pairs["dem"][0].grid.cell
    note = (
        f"every offset within ±{radius:g} m was looked at in cells of {cell:.3g} m first, the "
        f"{len(cuts)} best places then in cells of {pairs['dem'][0].grid.cell:g} m"
    )
    return dataclasses.replace(decision, notes=(*decision.notes, note))


def _grids(pair: tuple[SurveyRaster, SurveyRaster]) -> tuple[Grid, Grid]:
    return pair[0].grid, pair[1].grid


def _in_frame(
    pairs: Pairs,
    settings: Settings,
    radius: float,
    clock: Clock,
    manual: Manual | None,
    turn: Turn | None,
    delivered: tuple[Transform, Pairs] | None = None,
    beyond: Elsewhere = NOWHERE,
) -> Decision:
    """Estimate, judge and refine on rasters; of the turned survey, where `delivered` is given."""
    motion, first = (None, pairs) if delivered is None else delivered
    scale = 1.0
    estimates: list[OffsetEstimate] = []
    fields = cache(pair_fields)  # until the end of this function: they are as large as the rasters
    with ThreadPoolExecutor(1) as beside:  # the evidence does not depend on what the methods say
        maps = beside.submit(judging.channel_maps, pairs, radius, fields)
        for method in settings.methods:
            with clock.stage(method):
                pair = pairs[ESTIMATORS[method].raster]
                estimates.append(estimate_offset(*pair, method, settings))
                log.info("%s: %s %s", method, estimates[-1].status, estimates[-1].reason)
        if manual is not None:
            estimates.append(_within(radius, manual(motion)))
        with clock.stage("judge"):
            trials = 1 if turn is None or motion is None else turn.trials
            seen = (trials * beyond.times, maps.result(), beyond.values)
            judgement = judging.judge(estimates, pairs, settings, radius, *seen)
    refined, heights = None, None
    notes: tuple[str, ...] = ()
    placed, found = judgement, Found()
    if judgement.best is not None and judgement.verdict != "rejected":
        with clock.stage("refine"):
            used = _supporting(judgement, pairs, settings)
            agree = judging.agree_distance(settings.judge, pairs["dem"])
            at = judgement.best.east, judgement.best.north
            refined = refine(used, at, judgement.best.sigma, agree, fields)
            contradicted = _against_ties(estimates, refined, motion, settings)
            estimates = [_beside(estimate, contradicted) for estimate in estimates]
            tear = _torn(used, refined.offset, fields)
            ground = dem_ground(*pairs["dem"], refined.offset)
            fitted, own = with_scale(refined, ground)
            stretch = _stretch(fitted, own, ground)
            if settings.search.free_scale or (motion is not None and motion.scale != 1.0):
                refined, scale, stretch = fitted, own, dataclasses.replace(stretch, fitted=True)
            else:  # what was not fitted may be off by what a fit finds, and by what that may err
                variance = (own - 1) ** 2 + fitted.scale_variance
                refined = dataclasses.replace(refined, scale_variance=variance)
            if motion is not None:
                refined, scale = as_delivered(refined, motion), scale * motion.scale
            horizontal = _horizontal(refined, scale)
            heights = fit_heights(*first["dem"], horizontal, refined.offset_at)
        scaled, notes = check_heading_and_scale(refined.yaw, scale, settings.search, turn, motion)
        found = Found(
            turned=refined.doubt,
            tilted=heights.doubt,
            scaled=scaled,
            stretch=stretch,
            gain=heights.gain,
            tear=tear,
            step=heights.step,
            sigma_up=float(np.sqrt(max(heights.covariance[0, 0], 0.0))),
            relief=heights.relief,
            undecided=refined.undecided,
            ties=contradicted,
        )
        judgement = last_word(placed, findings(found))
    told = (notes, motion, scale, found)
    return Decision(tuple(estimates), judgement, placed, refined, clock.seconds, heights, *told)


def _within(radius: float, estimate: OffsetEstimate) -> OffsetEstimate:
    """Fail a proposal beyond the search window: nothing there can be judged."""
    if max(abs(estimate.east), abs(estimate.north)) <= radius or estimate.status == "failed":
        return estimate
    where = f"({estimate.east:.2f}, {estimate.north:.2f}) m"
    reason = f"the offset {where} is outside the search radius of {radius:g} m"
    nan = float("nan")
    return dataclasses.replace(
        estimate, status="failed", reason=reason, east=nan, north=nan, sigma=None
    )


def _supporting(
    judgement: judging.Judgement, pairs: Pairs, settings: Settings
) -> list[tuple[SurveyRaster, SurveyRaster, Channel]]:
    """Return the rasters of the channels that put the best offset first.

    Others have tiles of chance.
    """
    best = judgement.best
    assert best is not None
    used = [
        (*pairs[RASTER_OF[part.name]], part.name)
        for name, part in judgement.maps.items()
        if best.gaps[name] >= settings.judge.support_gap
    ]
    return used or [(*pairs["dem"], "terrain")]


def _against_ties(
    estimates: Sequence[OffsetEstimate],
    refined: Refined,
    motion: Transform | None,
    settings: Settings,
) -> str:
    """Say by how much hand-picked points contradict the answer; '' where they do not."""
    radius = settings.sift.inlier_radius
    for estimate in estimates:
        if not estimate.manual:  # one beyond the search window contradicts too
            continue
        used = np.asarray(estimate.evidence.get("inliers", ()), bool)
        there = np.asarray(estimate.evidence.get("picked_reference", np.zeros((0, 2))))[used]
        here = np.asarray(estimate.evidence.get("picked_moving", np.zeros((0, 2))))[used]
        if not len(here):
            continue
        if motion is not None:
            level = np.full((len(here), 1), motion.pivot[2])
            here = motion.apply(np.hstack([here, level]))[:, :2]
        arm = here - refined.pivot
        turn = refined.yaw * np.stack([-arm[:, 1], arm[:, 0]], axis=1)
        apart = there - (here + refined.offset + turn)
        away = float(np.hypot(*apart.mean(axis=0)))
        beyond = int((np.hypot(*apart.T) > radius).sum())
        doubt = float(np.sqrt(np.trace(refined.covariance[:2, :2])))
        if away > max(radius, 3 * doubt):
            return (
                f"the tie points lie {away:.2f} m from the answer on average "
                f"({beyond} of {len(here)} further than {radius:g} m)"
            )
    return ""


def _beside(estimate: OffsetEstimate, contradicted: str) -> OffsetEstimate:
    """Return hand-picked points that contradict the answer as what they are: not "ok"."""
    if not (estimate.manual and contradicted and estimate.status == "ok"):
        return estimate
    return dataclasses.replace(estimate, status="weak", reason=contradicted)


def _torn(
    used: Sequence[tuple[SurveyRaster, SurveyRaster, Channel]],
    offset: Float64,
    fields: FieldsOf,
) -> Tear | None:
    """Find the largest tear that the tiles of a channel show, looked for further than a turn."""
    seen = []
    for reference, moving, channel in used:
        cell = moving.grid.cell
        reach = int(np.clip(np.ceil(TEAR_REACH / cell), *TEAR_CELLS))
        at = float(offset[0]), float(offset[1])
        tiles = correlated_tiles(reference, moving, channel, at, fields, reach)
        if tiles is not None:
            seen.append((tiles, cell, tear_of_tiles(tiles, PEAK_RESOLUTION * cell)))
    tears = [
        tear
        for tiles, cell, tear in seen
        if tear is not None
        and tear.size > TEAR_PART * cell
        and not any(contradicts(other, tear) for other, _, _ in seen if other is not tiles)
    ]
    return max(tears, key=lambda tear: tear.size, default=None)


def _stretch(refined: Refined, scale: float, ground: Ground) -> Stretch:
    """Put a fitted scale beside what it explains of the tiles' offsets and what it leaves."""
    arm = ground.places - refined.pivot
    corner = float(np.hypot(*arm.T).max())
    explained, left = 0.0, float("inf")
    if refined.tiles is not None and refined.residuals is not None:
        tile = refined.tiles.places - refined.pivot
        used = np.ones(len(tile), bool) if refined.weights is None else refined.weights > 0
        rest = (refined.residuals - (scale - 1) * tile)[used]
        rest = rest - np.median(rest, axis=0)
        explained = abs(scale - 1) * float(np.sqrt((tile[used] ** 2).sum(axis=1).mean()))
        left = float(np.median(np.hypot(*rest.T))) / RAYLEIGH[2] * np.sqrt(2)
    sigma = float(np.sqrt(refined.scale_variance))
    return Stretch(scale, sigma, abs(scale - 1) * corner, explained / max(left, 1e-9))


def _horizontal(refined: Refined, scale: float = 1.0) -> Transform:
    """Rotation about the vertical, horizontal offset and scale."""
    c, s = np.cos(refined.yaw), np.sin(refined.yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    # a tenth of a nanometre is the end of what float64 heights at UTM size can say
    offset = np.round(np.append(refined.offset, 0.0), 10)
    return Transform(rotation, scale, offset, np.append(refined.pivot, 0.0))


def completed(
    moving: Survey, decision: Decision
) -> tuple[Transform | None, Float64 | None, dict[str, Any] | None]:
    """Transform at the moving survey's centre, its covariance, and the error at the overlap."""
    refined, heights, transform = decision.refined, decision.heights, decision.transform
    if refined is None or heights is None or transform is None:
        return None, None, None
    transform = transform.at(moving.centre)
    covariance = covariance_of(decision, transform)
    place = transform.apply(heights.place)
    return transform, covariance, registration_error(covariance, transform, place)


def covariance_of(decision: Decision, transform: Transform) -> Float64:
    """(7, 7) at the transform's pivot: the doubt of yaw and tilt grows with the lever."""
    refined, heights = decision.refined, decision.heights
    assert refined is not None
    assert heights is not None
    start = np.append(refined.pivot, heights.place[2])
    covariance = np.zeros((7, 7))
    known = [0, 1, 5]
    covariance[np.ix_(known, known)] = refined.covariance
    covariance[6, 6] = refined.scale_variance
    carry = lever(transform.apply(heights.place) - transform.apply(start))
    covariance = carry @ covariance @ carry.T
    covariance[2:5, 2:5] += heights.covariance
    home = transform.pivot + transform.offset
    carry = lever(home - transform.apply(heights.place))
    covariance = carry @ covariance @ carry.T
    return np.asarray(0.5 * (covariance + covariance.T))
