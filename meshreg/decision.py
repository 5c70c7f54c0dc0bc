"""What a pair of rasters says: the methods' proposals, judged, refined, lifted and tilted."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from meshreg import judge as judging
from meshreg import statistics
from meshreg.heading import (
    Pairs,
    Turned,
    as_delivered,
    on_heading_and_scale,
    turned_as_voted,
)
from meshreg.heights import Heights, fit_heights
from meshreg.offsets import ESTIMATORS, estimate_offset
from meshreg.offsets.neutral import FieldsOf, pair_fields
from meshreg.refine import Refined, dem_ground, refine, with_scale
from meshreg.settings import Settings
from meshreg.types import (
    Float64,
    OffsetEstimate,
    Survey,
    Transform,
)
from meshreg.voting import Turn, vote

log = logging.getLogger(__name__)
Progress = Callable[[str, float], None]
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
        With the doubts of the refinement in its verdict.
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
    refined: Refined | None
    seconds: Mapping[str, float]
    heights: Heights | None = None
    notes: tuple[str, ...] = ()
    motion: Transform | None = None
    scale: float = 1.0

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
    turn = None
    if settings.search.max_yaw > 0 or settings.search.max_scale > 0:
        with clock.stage("vote"):
            turn = vote(pairs, settings.search, radius)
    if turn is not None and turn.needed and turned is not None:
        log.info("the tiles vote for a turn: %s", turn)
        with clock.stage("turn"):
            again, motion = turned_as_voted(pairs, turn, turned, settings.search, radius)
        decision = _in_frame(again, settings, radius, clock, manual, turn, (motion, pairs))
        if decision.judgement.verdict != "rejected":
            return decision
    return _in_frame(pairs, settings, radius, clock, manual, turn)


def _in_frame(
    pairs: Pairs,
    settings: Settings,
    radius: float,
    clock: Clock,
    manual: Manual | None,
    turn: Turn | None,
    delivered: tuple[Transform, Pairs] | None = None,
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
            judgement = judging.judge(estimates, pairs, settings, radius, trials, maps.result())
    refined, heights = None, None
    notes: tuple[str, ...] = ()
    if judgement.best is not None and judgement.verdict != "rejected":
        with clock.stage("refine"):
            refined = _refine(judgement, pairs, settings, fields)
            if settings.search.free_scale or (motion is not None and motion.scale != 1.0):
                ground = dem_ground(*pairs["dem"], refined.offset)
                refined, scale = with_scale(refined, ground)
            if motion is not None:
                refined, scale = as_delivered(refined, motion), scale * motion.scale
            heights = fit_heights(*first["dem"], _horizontal(refined, scale), refined.offset_at)
            judgement = judgement.doubted(refined.doubt).doubted(heights.doubt)
        judgement, notes = on_heading_and_scale(
            judgement, refined.yaw, scale, settings.search, turn, motion
        )
    told = (notes, motion, scale)
    return Decision(tuple(estimates), judgement, refined, clock.seconds, heights, *told)


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


def _refine(
    judgement: judging.Judgement, pairs: Pairs, settings: Settings, fields: FieldsOf
) -> Refined:
    best = judgement.best
    assert best is not None
    # a channel that does not put this offset first has tiles of chance: leave it out
    used = [
        (*pairs["dem" if name == "terrain" else "ortho"], name)
        for name in judgement.maps
        if best.gaps[name] >= settings.judge.support_gap
    ]
    if not used:
        used = [(*pairs["dem"], "terrain")]
    agree = judging.agree_distance(settings.judge, pairs["dem"][0].grid.cell)
    at = best.east, best.north
    return refine(used, at, best.sigma, agree, fields)  # type: ignore[arg-type]


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
    return transform, covariance, statistics.registration_error(covariance, transform, place)


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
    carry = statistics.lever(transform.apply(heights.place) - transform.apply(start))
    covariance = carry @ covariance @ carry.T
    covariance[2:5, 2:5] += heights.covariance
    home = transform.pivot + transform.offset
    carry = statistics.lever(home - transform.apply(heights.place))
    covariance = carry @ covariance @ carry.T
    return np.asarray(0.5 * (covariance + covariance.T))
