"""`register_pair`: the way data flows, on one page.

Bryson, Johnson-Roberson, Pizarro and Williams (IROS 2013) are followed section by section: both
surveys are rasterized on one lattice, SIFT on the mosaics (III-B), the terrain scan (III-C) and
mutual information (III-D) each propose an offset, and, beyond the paper, the proposals are judged
by one neutral measure, refined on tiles, and given a verdict. A survey whose heading or scale is
off by more than the methods bear is turned first, as its tiles vote.
"""

from __future__ import annotations

import dataclasses
import logging
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np

from meshreg import judge as judging
from meshreg import statistics
from meshreg.calibration import probability
from meshreg.errors import UsageError
from meshreg.heading import (
    Turned,
    as_delivered,
    on_heading_and_scale,
    turned_as_voted,
    turning,
)
from meshreg.heights import STABLE, Heights, fit_heights, stable_ground
from meshreg.offsets import ESTIMATORS, estimate_offset, search_radius
from meshreg.raster import rasterize
from meshreg.raster.grid import choose_cells, coarsened, common_grid, survey_grids
from meshreg.refine import Refined, dem_ground, refine, with_scale
from meshreg.settings import Settings
from meshreg.surfaces import Polished, check_surfaces, polish
from meshreg.types import (
    Float64,
    Grid,
    Maps,
    OffsetEstimate,
    Registration,
    Survey,
    SurveyRaster,
    Transform,
    Warp,
)
from meshreg.voting import Turn, vote
from meshreg.warp import Internal, check_model, measure
from meshreg.warp_rasters import warped_raster

log = logging.getLogger(__name__)
Progress = Callable[[str, float], None]
Manual = Callable[[Transform | None], OffsetEstimate]
Pairs = dict[str, tuple[SurveyRaster, SurveyRaster]]


def register_pair(
    reference: Survey,
    moving: Survey,
    settings: Settings | None = None,
    *,
    reference_mask: Any = None,
    moving_mask: Any = None,
    manual: Manual | None = None,
    progress: Progress | None = None,
) -> Registration:
    """Lay the moving (repeat) survey on the reference (original) one, and say how sure that is.

    Parameters
    ----------
    reference, moving : Survey
        In the same CRS, or both in local frames (`meshreg.io.frames.common_crs` brings them there).
    settings : Settings, optional
    reference_mask, moving_mask : callable, optional
        What to use of each survey (`meshreg.io.masks.read_mask`).
    manual : callable, optional
        ``manual(motion)`` is a person's proposal (`meshreg.ties.ties_estimate`), of the moving
        survey as `motion` turned it first, if that is not None. It is judged like the methods'.
    progress : callable, optional
        Called with a stage's name and the fraction of it that is done.

    Returns
    -------
    Registration
        A failed registration is a value too: its verdict is "rejected" or "review".

    Raises
    ------
    UsageError
        If the surveys' CRS differ, or only one of them has a known scale.
    """
    settings = settings or Settings()
    settings, radius, notes = prepared(reference, moving, settings)
    tell = progress or (lambda stage, fraction: None)
    clock = _Clock(tell)
    masks = {"reference": reference_mask, "moving": moving_mask}
    if apart := surveys_apart(reference, moving, radius):
        return _too_far(reference, moving, settings, apart, clock.seconds, notes)
    with clock.stage("rasterize"):
        pairs = rasterize_pair(reference, moving, settings, masks, tell)

    def turned(turn: Turn) -> tuple[Pairs, Transform]:
        motion = turning(turn, moving.centre)
        return rasterize_pair(reference, moving, settings, masks, tell, motion, pairs), motion

    decision = decide(pairs, settings, radius, tell, manual, turned)
    clock.seconds.update(decision.seconds)
    notes += decision.notes
    judgement, refined = decision.judgement, decision.refined
    if isinstance(moving.geometry, Maps) and decision.heights is not None:
        decision = dataclasses.replace(decision, heights=decision.heights.levelled())
    notes += [part.note for part in (refined, decision.heights) if part is not None and part.note]
    transform, covariance, error = completed(moving, decision)
    if (
        transform is not None
        and decision.heights is not None
        and settings.refine.surfaces != "none"
    ):
        with clock.stage("surfaces"):
            place, ground = decision.heights.place, decision.heights.ground
            stable = None if ground is None else (ground == STABLE, pairs["dem"][1].grid)
            said = polish(reference, moving, transform, place, error, stable, settings.seed)
        if said.accepted and covariance is not None:
            covariance = _after_polishing(covariance, transform, said)
            error = statistics.registration_error(
                covariance, said.transform, said.transform.apply(place)
            )
        transform, notes = said.transform, [*notes, said.note]
    with clock.stage("apply"):
        rasters = _lay_down(moving, transform, settings, masks, pairs)
    with clock.stage("internal"):
        internal, rasters = _internal(refined, transform, rasters, settings)
    notes += [internal.said] if internal.said else []
    return Registration(
        verdict=judgement.verdict,
        reason=judgement.reason,
        transform=transform,
        covariance=covariance,
        estimates=decision.estimates,
        hypotheses=tuple(_plain(h) for h in judgement.hypotheses[:5]),
        before=statistics.compare(
            rasters["reference_dem"],
            rasters["moving_dem_before"],
            rasters["reference_ortho"],
            rasters["moving_ortho_before"],
        ),
        after={}
        if transform is None
        else statistics.compare(
            rasters["reference_dem"],
            rasters["moving_dem"],
            rasters["reference_ortho"],
            rasters["moving_ortho"],
        ),
        reference=_about(reference),
        moving=_about(moving),
        settings=settings.as_dict(),
        versions=versions(),
        seconds=clock.seconds,
        notes=tuple(notes),
        registration_error=error,
        internal=internal.record or None,
        warp=internal.warp,
        false_alarm=judgement.false_alarm,
        probability=None if judgement.best is None else probability(judgement.false_alarm),
        evidence=rasters
        | {
            "residuals": internal.evidence or _residuals(refined, transform),
            "stable": _stable(decision.heights, transform, pairs["dem"][1], rasters, internal.warp),
            "motion": decision.motion,
            "channels": judgement.maps,
            "masked": {
                which: dict(pairs["dem"][i].masked)
                for i, which in enumerate(("reference", "moving"))
            },
        },
    )


def prepared(
    reference: Survey, moving: Survey, settings: Settings
) -> tuple[Settings, float, list[str]]:
    """Check the call; return the settings with cells and radius filled in, the radius, notes."""
    _check(reference, moving, settings)
    cells = choose_cells(reference, moving, settings.raster)
    radius = search_radius(settings, cells.dem)
    settings = settings.changed(
        {
            "search.radius": radius,
            "raster.dem_cell": cells.dem,
            "raster.ortho_cell": cells.ortho,
            "raster.sift_cell": cells.sift,
        }
    )
    return settings, radius, list(cells.notes)


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
    clock = _Clock(progress or (lambda stage, fraction: None))
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
    clock: _Clock,
    manual: Manual | None,
    turn: Turn | None,
    delivered: tuple[Transform, Pairs] | None = None,
) -> Decision:
    """Estimate, judge and refine on rasters; of the turned survey, where `delivered` is given."""
    motion, first = (None, pairs) if delivered is None else delivered
    scale = 1.0
    estimates: list[OffsetEstimate] = []
    with ThreadPoolExecutor(1) as beside:  # the evidence does not depend on what the methods say
        maps = beside.submit(judging.channel_maps, pairs, radius)
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
            refined = _refine(judgement, pairs, settings)
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


def versions() -> dict[str, str]:
    """Versions of meshreg, Python and the packages that the numbers depend on."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in (
        "meshreg",
        "numpy",
        "scipy",
        "numba",
        "opencv-python-headless",
        "rasterio",
        "pyproj",
    ):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


@dataclasses.dataclass
class _Clock:
    """Seconds per stage, and the word to the progress bar."""

    tell: Progress
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self.tell(name, 0.0)
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
        self.tell(name, 1.0)


def _check(reference: Survey, moving: Survey, settings: Settings) -> None:
    check_model(settings.warp.model)
    check_surfaces(settings.refine.surfaces)
    for method in settings.methods:
        if method not in ESTIMATORS:
            raise UsageError(
                f"Unknown method {method!r}.", remedy=f"There are: {', '.join(ESTIMATORS)}."
            )
    if reference.crs != moving.crs:
        raise UsageError(
            f"The surveys' CRS differ: {reference.crs} and {moving.crs}.",
            remedy="Bring the moving one to the other's with meshreg.io.frames.common_crs.",
        )
    if reference.scale_known != moving.scale_known:
        which = moving if reference.scale_known else reference
        raise UsageError(
            f"The scale of {which.name!r} is not known, that of the other survey is.",
            remedy="Give its camera positions (--positions) or scale bars (--scale).",
        )


def surveys_apart(reference: Survey, moving: Survey, radius: float) -> str:
    """Say that no offset within `radius` [m] can bring the surveys together; empty if one may."""
    a, b = reference.bounds, moving.bounds
    gaps = np.maximum(a[0, :2] - b[1, :2], b[0, :2] - a[1, :2])
    away = float(gaps.max())
    if away <= radius:
        return ""
    return (
        f"the surveys lie {away:.4g} m apart, beyond the search radius of {radius:g} m; check "
        "their shifts (--reference-shift, --moving-shift) and CRS"
    )


def _cells(settings: Settings) -> dict[str, float]:
    """Cell [m] of each kind of raster that the methods and the judge look at."""
    options = settings.raster
    cells = {"sift": options.sift_cell, "ortho": options.ortho_cell, "dem": options.dem_cell}
    needed = {ESTIMATORS[m].raster for m in settings.methods} | {"ortho", "dem"}
    return {name: float(cells[name] or 0.0) for name in needed}


def _lattice(cells: Mapping[str, float]) -> float | None:
    """Return the lattice [m] that holds all the cells; None if the coarsest is no multiple."""
    coarsest = max(cells.values())
    fits = all(abs(coarsest / c - round(coarsest / c)) < 1e-9 for c in cells.values())
    return coarsest if fits else None


def _levels(
    survey: Survey,
    grids: Mapping[str, Grid],
    settings: Settings,
    mask: Any,
    transform: Transform | None = None,
) -> dict[str, SurveyRaster]:
    """Rasterize a survey on the finest of the grids; the others are exact means where they fit."""
    finest = min(grids.values(), key=lambda grid: grid.cell)
    fine = rasterize(survey, finest, settings.raster, transform=transform, mask=mask)
    made = {}
    for name, grid in grids.items():
        times = round(grid.cell / finest.cell)
        if abs(grid.cell - times * finest.cell) < 1e-9 * grid.cell:
            made[name] = fine if times == 1 else coarsened(fine, times)
        else:
            made[name] = rasterize(survey, grid, settings.raster, transform=transform, mask=mask)
    return made


def rasterize_pair(
    reference: Survey,
    moving: Survey,
    settings: Settings,
    masks: Mapping[str, Any],
    tell: Progress,
    motion: Transform | None = None,
    known: Pairs | None = None,
) -> Pairs:
    """Both surveys at each cell that is needed, on one lattice.

    With a `motion` the moving survey is moved by it, and the reference taken from what is `known`.
    """
    cells = _cells(settings)
    lattice = _lattice(cells)

    def made(survey: Survey, which: str, motion: Transform | None) -> dict[str, SurveyRaster]:
        grids = survey_grids(survey, cells, lattice, transform=motion)
        return _levels(survey, grids, settings, masks[which], motion)

    if known is not None:
        moved = made(moving, "moving", motion)
        return {name: (known[name][0], moved[name]) for name in cells}
    still = made(reference, "reference", None)
    tell("rasterize", 0.5)
    moved = made(moving, "moving", motion)
    tell("rasterize", 1.0)
    return {name: (still[name], moved[name]) for name in cells}


def _refine(judgement: judging.Judgement, pairs: Pairs, settings: Settings) -> Refined:
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
    return refine(used, (best.east, best.north), best.sigma, agree)  # type: ignore[arg-type]


def completed(
    moving: Survey, decision: Decision
) -> tuple[Transform | None, Float64 | None, dict[str, Any] | None]:
    """Transform at the moving survey's centre, its covariance, and the error at the overlap."""
    refined, heights, transform = decision.refined, decision.heights, decision.transform
    if refined is None or heights is None or transform is None:
        return None, None, None
    transform = transform.at(moving.centre)
    covariance = _covariance(refined, heights, transform)
    place = transform.apply(heights.place)
    return transform, covariance, statistics.registration_error(covariance, transform, place)


def _lay_down(
    moving: Survey,
    transform: Transform | None,
    settings: Settings,
    masks: Mapping[str, Any],
    pairs: Pairs,
) -> dict[str, Any]:
    """Lay both surveys on common grids, which hold the moving one before and after.

    What SIFT looks at is not needed any more: cells are as large as the orthomosaic's.
    """
    rasters: dict[str, Any] = {}
    kept = {name: pairs[name] for name in ("dem", "ortho")}
    grids = {name: common_grid(a.grid, b.grid) for name, (a, b) in kept.items()}
    if transform is not None:
        cells = _cells(settings)
        there = survey_grids(moving, cells, _lattice(cells), transform=transform)
        grids = {name: common_grid(grid, there[name]) for name, grid in grids.items()}
    for name in kept:
        rasters[f"reference_{name}"] = statistics.on_grid(pairs[name][0], grids[name])
        rasters[f"moving_{name}_before"] = statistics.on_grid(pairs[name][1], grids[name])
    if transform is None:
        return rasters
    moved = _levels(moving, grids, settings, masks["moving"], transform)
    return rasters | {"moving_dem": moved["dem"], "moving_ortho": moved["ortho"]}


def _internal(
    refined: Refined | None,
    transform: Transform | None,
    rasters: Mapping[str, Any],
    settings: Settings,
) -> tuple[Internal, dict[str, Any]]:
    """Measure how the models bend; where a warp is asked for and found, bend the moving maps."""
    rasters = dict(rasters)
    if refined is None or transform is None:
        return Internal(""), rasters
    dems = rasters["reference_dem"], rasters["moving_dem"]
    internal = measure(refined.tiles, transform, *dems, settings.warp)
    if internal.warp is not None and settings.warp.model != "none":
        for name in ("moving_dem", "moving_ortho"):
            rasters[name] = warped_raster(rasters[name], internal.warp)
        return internal.applied(), rasters
    return dataclasses.replace(internal, warp=None), rasters


def _horizontal(refined: Refined, scale: float = 1.0) -> Transform:
    """Rotation about the vertical, horizontal offset and scale."""
    c, s = np.cos(refined.yaw), np.sin(refined.yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    # a tenth of a nanometre is the end of what float64 heights at UTM size can say
    offset = np.round(np.append(refined.offset, 0.0), 10)
    return Transform(rotation, scale, offset, np.append(refined.pivot, 0.0))


def _covariance(refined: Refined, heights: Heights, transform: Transform) -> Float64:
    """(7, 7) at the transform's pivot: the doubt of yaw and tilt grows with the lever."""
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


def _after_polishing(covariance: Float64, before: Transform, polished: Polished) -> Float64:
    """(7, 7) at the polished transform's pivot, from that of the one before at its own."""
    to = statistics.lever(polished.home - (before.pivot + before.offset))
    wide = polished.widened(to @ covariance @ to.T)
    back = statistics.lever(polished.transform.pivot + polished.transform.offset - polished.home)
    return np.asarray(back @ wide @ back.T)


def _stable(
    heights: Heights | None,
    transform: Transform | None,
    delivered: SurveyRaster,
    rasters: Mapping[str, Any],
    warp: Warp | None,
) -> Any:
    """Return which ground told the height and the tilt, as the registered DEM lies."""
    if heights is None or heights.ground is None or transform is None:
        return None
    return stable_ground(heights.ground, delivered.grid, transform, rasters["moving_dem"], warp)


def _residuals(refined: Refined | None, transform: Transform | None) -> dict[str, Float64]:
    if refined is None or refined.tiles is None or refined.residuals is None or transform is None:
        return {}
    assert refined.weights is not None
    level = np.full(len(refined.tiles.places), transform.pivot[2])
    places = transform.apply(np.column_stack([refined.tiles.places, level]))
    return {
        "east": places[:, 0],
        "north": places[:, 1],
        "d_east": refined.residuals[:, 0],
        "d_north": refined.residuals[:, 1],
        "weight": refined.weights,
    }


def _too_far(
    reference: Survey,
    moving: Survey,
    settings: Settings,
    reason: str,
    seconds: Mapping[str, float],
    notes: list[str],
) -> Registration:
    estimates = tuple(
        OffsetEstimate(m, "failed", "the surveys do not overlap") for m in settings.methods
    )
    return Registration(
        "rejected",
        reason,
        None,
        None,
        estimates,
        (),
        {},
        {},
        _about(reference),
        _about(moving),
        settings.as_dict(),
        versions(),
        dict(seconds),
        tuple(notes),
    )


def _plain(hypothesis: judging.Hypothesis) -> dict[str, Any]:
    """One candidate as plain values for the record."""
    return {
        "east": hypothesis.east,
        "north": hypothesis.north,
        "score": hypothesis.score,
        "channels": list(hypothesis.gaps),
        "methods": list(hypothesis.methods),
        "overlap": hypothesis.overlap,
    } | {f"{name}_gap": gap for name, gap in hypothesis.gaps.items()}


def _about(survey: Survey) -> dict[str, Any]:
    """Return what the record says of a survey."""
    geometry = survey.geometry
    counts: dict[str, int] = {}
    for source in survey.source:
        for key, count in source.counts.items():
            counts[key] = counts.get(key, 0) + count
    if not counts:
        for key in ("points", "faces", "textures"):
            if hasattr(geometry, key):
                counts[key] = len(getattr(geometry, key))
    shift = survey.source[0].frame.shift if survey.source else survey.origin
    return {
        "name": survey.name,
        "path": [source.path.name for source in survey.source],
        "sha256": [source.sha256 for source in survey.source],
        "counts": counts,
        "shift": shift.tolist(),
        "crs": survey.crs,
        "bounds": survey.bounds.tolist(),
        "notes": list(survey.notes),
    }
