"""`register_pair`: the way data flows, on one page.

Bryson, Johnson-Roberson, Pizarro and Williams (IROS 2013) are followed section by section: both
surveys are rasterized on one lattice, SIFT on the mosaics (III-B), the terrain scan (III-C) and
mutual information (III-D) each propose an offset, and, beyond the paper, the proposals are judged
by one neutral measure, refined on tiles, and given a verdict.
"""

from __future__ import annotations

import dataclasses
import logging
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from meshreg import judge as judging
from meshreg import statistics
from meshreg.errors import UsageError
from meshreg.offsets import ESTIMATORS, estimate_offset, search_radius
from meshreg.raster import rasterize
from meshreg.raster.grid import choose_cells, coarsened, common_grid, survey_grid
from meshreg.refine import Refined, refine
from meshreg.settings import Settings
from meshreg.types import (
    Float64,
    Grid,
    OffsetEstimate,
    Registration,
    Survey,
    SurveyRaster,
    Transform,
)

log = logging.getLogger(__name__)
Progress = Callable[[str, float], None]
Pairs = dict[str, tuple[SurveyRaster, SurveyRaster]]


def register_pair(
    reference: Survey,
    moving: Survey,
    settings: Settings | None = None,
    *,
    reference_mask: Any = None,
    moving_mask: Any = None,
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
    _check(reference, moving, settings)
    tell = progress or (lambda stage, fraction: None)
    clock = _Clock(tell)
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
    notes = [*cells.notes]
    masks = {"reference": reference_mask, "moving": moving_mask}
    away = _gap_between(reference, moving)
    if away > radius:
        return _too_far(reference, moving, settings, away, clock.seconds, notes)
    with clock.stage("rasterize"):
        pairs = _rasterize(reference, moving, settings, masks, tell)
    decision = decide(pairs, settings, radius, tell)
    clock.seconds.update(decision.seconds)
    judgement, refined = decision.judgement, decision.refined
    notes += [refined.note] if refined is not None and refined.note else []
    with clock.stage("apply"):
        transform, up_sigma, rasters = _lay_down(reference, moving, refined, settings, masks, pairs)
    return Registration(
        verdict=judgement.verdict,
        reason=judgement.reason,
        transform=transform,
        covariance=None if refined is None else _covariance(refined, up_sigma, transform),
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
        evidence=rasters
        | {
            "residuals": _residuals(refined),
            "channels": judgement.maps,
            "false_alarm": judgement.false_alarm,
            "masked": {
                which: dict(pairs["dem"][i].masked)
                for i, which in enumerate(("reference", "moving"))
            },
        },
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Decision:
    """What a pair of rasters says, before the transform is completed by its height.

    Attributes
    ----------
    estimates : tuple of OffsetEstimate
    judgement : Judgement
        With the doubts of the refinement in its verdict.
    refined : Refined or None
        None when rejected.
    seconds : mapping
        By stage: each method, "judge", "refine".
    """

    estimates: tuple[OffsetEstimate, ...]
    judgement: judging.Judgement
    refined: Refined | None
    seconds: Mapping[str, float]


def decide(
    pairs: Pairs, settings: Settings, radius: float, progress: Progress | None = None
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
    """
    clock = _Clock(progress or (lambda stage, fraction: None))
    estimates = []
    for method in settings.methods:
        with clock.stage(method):
            estimates.append(estimate_offset(*pairs[ESTIMATORS[method].raster], method, settings))
            log.info("%s: %s %s", method, estimates[-1].status, estimates[-1].reason)
    with clock.stage("judge"):
        judgement = judging.judge(estimates, pairs, settings, radius)
    refined = None
    if judgement.best is not None and judgement.verdict != "rejected":
        with clock.stage("refine"):
            refined = _refine(judgement, pairs, settings)
            judgement = judgement.doubted(refined.doubt)
    return Decision(tuple(estimates), judgement, refined, clock.seconds)


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
        self.seconds[name] = time.perf_counter() - started
        self.tell(name, 1.0)


def _check(reference: Survey, moving: Survey, settings: Settings) -> None:
    for method in settings.methods:
        if method not in ESTIMATORS:
            raise UsageError(
                f"Unknown method {method!r}.", remedy=f"There are: {', '.join(ESTIMATORS)}."
            )
    if reference.crs is not None and moving.crs is not None and reference.crs != moving.crs:
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


def _gap_between(reference: Survey, moving: Survey) -> float:
    """Largest empty distance [m] along east or north between the bounding boxes; 0 if they meet."""
    a, b = reference.bounds, moving.bounds
    gaps = np.maximum(a[0, :2] - b[1, :2], b[0, :2] - a[1, :2])
    return float(max(gaps.max(), 0.0))


def _cells(settings: Settings) -> dict[str, float]:
    """Cell [m] of each kind of raster that the methods and the judge look at."""
    options = settings.raster
    cells = {"sift": options.sift_cell, "ortho": options.ortho_cell, "dem": options.dem_cell}
    needed = {ESTIMATORS[m].raster for m in settings.methods} | {"ortho", "dem"}
    return {name: float(cells[name] or 0.0) for name in needed}


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


def _rasterize(
    reference: Survey, moving: Survey, settings: Settings, masks: Mapping[str, Any], tell: Progress
) -> Pairs:
    """Both surveys at each cell that is needed, on one lattice."""
    cells = _cells(settings)
    coarsest = max(cells.values())
    made = []
    for done, (which, survey) in enumerate((("reference", reference), ("moving", moving))):
        fits = all(abs(coarsest / c - round(coarsest / c)) < 1e-9 for c in cells.values())
        grids = {n: survey_grid(survey, c, coarsest if fits else None) for n, c in cells.items()}
        made.append(_levels(survey, grids, settings, masks[which]))
        tell("rasterize", 0.5 * (done + 1))
    return {name: (made[0][name], made[1][name]) for name in cells}


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


def _lay_down(
    reference: Survey,
    moving: Survey,
    refined: Refined | None,
    settings: Settings,
    masks: Mapping[str, Any],
    pairs: Pairs,
) -> tuple[Transform | None, float, dict[str, Any]]:
    """Complete the transform by its height, and rasterize both surveys on common grids."""
    rasters: dict[str, Any] = {}
    horizontal = None if refined is None else _horizontal(refined, moving)
    grids = {name: common_grid(a.grid, b.grid) for name, (a, b) in pairs.items()}
    for name in ("dem", "ortho"):
        rasters[f"reference_{name}"] = statistics.on_grid(pairs[name][0], grids[name])
        rasters[f"moving_{name}_before"] = statistics.on_grid(pairs[name][1], grids[name])
    if horizontal is not None:
        moved = _levels(moving, grids, settings, masks["moving"], horizontal)
        rasters |= {"moving_dem": moved["dem"], "moving_ortho": moved["ortho"]}
    if horizontal is None:
        return None, float("nan"), rasters
    up, up_sigma = statistics.height_offset(rasters["reference_dem"], rasters["moving_dem"])
    for name in ("dem", "ortho"):
        raster = rasters[f"moving_{name}"]
        rasters[f"moving_{name}"] = dataclasses.replace(raster, datum=raster.datum + up)
    offset = horizontal.offset + np.array([0.0, 0.0, up])
    return dataclasses.replace(horizontal, offset=offset), up_sigma, rasters


def _horizontal(refined: Refined, moving: Survey) -> Transform:
    """Rotation about the vertical and horizontal offset, stated at the moving survey's centre."""
    c, s = np.cos(refined.yaw), np.sin(refined.yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    pivot = np.append(refined.pivot, moving.centre[2])
    # a tenth of a nanometre is the end of what float64 heights at UTM size can say
    offset = np.round(np.append(refined.offset, 0.0), 10)
    return Transform(rotation, 1.0, offset, pivot).at(moving.centre)


def _covariance(refined: Refined, up_sigma: float, transform: Transform | None) -> Float64:
    """Of (east, north, up, yaw) at the transform's pivot: yaw's doubt grows with the lever."""
    assert transform is not None
    lever = transform.pivot[:2] - refined.pivot
    carry = np.eye(3)
    carry[0, 2], carry[1, 2] = -lever[1], lever[0]
    moved = carry @ refined.covariance @ carry.T
    covariance = np.zeros((4, 4))
    keep = np.ix_([0, 1, 3], [0, 1, 3])
    covariance[keep] = moved
    covariance[2, 2] = up_sigma**2
    return covariance


def _residuals(refined: Refined | None) -> dict[str, Float64]:
    if refined is None or refined.tiles is None or refined.residuals is None:
        return {}
    assert refined.weights is not None
    return {
        "east": refined.tiles.places[:, 0],
        "north": refined.tiles.places[:, 1],
        "d_east": refined.residuals[:, 0],
        "d_north": refined.residuals[:, 1],
        "weight": refined.weights,
    }


def _too_far(
    reference: Survey,
    moving: Survey,
    settings: Settings,
    away: float,
    seconds: Mapping[str, float],
    notes: list[str],
) -> Registration:
    reason = (
        f"the surveys lie {away:.4g} m apart, beyond the search radius of "
        f"{settings.search.radius:g} m; check their shifts "
        "(--reference-shift, --moving-shift) and CRS"
    )
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
