"""ESTIMATE: how far the moving survey must go, by each of the paper's three methods.

A method is one module and one line in `ESTIMATORS`. It never raises for its data: a method that
fails is a value with a reason, since three methods vote.
"""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from meshreg.errors import UsageError
from meshreg.offsets.correlate import Window
from meshreg.offsets.error_bars import (
    FLOOR,
    correlated_blocks,
    error_bar,
    ground_of,
    whole_shift,
)
from meshreg.offsets.surface import Peak
from meshreg.records import Bool, Channel, Float64, OffsetEstimate, SurveyRaster
from meshreg.settings import Settings

log = logging.getLogger(__name__)
Estimate = Callable[[SurveyRaster, SurveyRaster, Settings], OffsetEstimate]


@dataclass(frozen=True)
class Estimator:
    """One method: the raster it looks at ("dem", "ortho" or "sift") and its function."""

    raster: Literal["dem", "ortho", "sift"]
    channel: Channel
    run: Estimate


def estimate_offset(
    reference: SurveyRaster,
    moving: SurveyRaster,
    method: str = "terrain",
    settings: Settings | None = None,
) -> OffsetEstimate:
    """Estimate the offset between two rasters by one method.

    Parameters
    ----------
    reference, moving : SurveyRaster
        Same cell, grids shifted by whole cells (as `meshreg.rasterize` makes them on one lattice).
    method : str
        A key of `ESTIMATORS`: "sift", "terrain" or "mutual_information".
    settings : Settings, optional

    Returns
    -------
    OffsetEstimate
        East and north [m] to ADD to moving coordinates; `status` "failed" with a reason where
        the data do not tell.

    Raises
    ------
    UsageError
        If the method is unknown or the grids do not fit together.
    """
    settings = settings or Settings()
    if method not in ESTIMATORS:
        raise UsageError(
            f"Unknown method {method!r}.", remedy=f"There are: {', '.join(ESTIMATORS)}."
        )
    started = time.perf_counter()
    estimate = ESTIMATORS[method].run(reference, moving, settings)
    return dataclasses.replace(estimate, seconds=time.perf_counter() - started)


def estimate_offsets(
    rasters: Mapping[str, tuple[SurveyRaster, SurveyRaster]],
    settings: Settings | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[OffsetEstimate, ...]:
    """Run every method in `settings.methods` on the pair of rasters that it looks at.

    Parameters
    ----------
    rasters : mapping
        "dem", "ortho" and "sift" to (reference, moving).
    settings : Settings, optional
    progress : callable, optional
        Called with a method's name and the fraction done.
    """
    settings = settings or Settings()
    estimates = []
    for method in settings.methods:
        if progress:
            progress(method, 0.0)
        if method not in ESTIMATORS:
            raise UsageError(
                f"Unknown method {method!r}.", remedy=f"There are: {', '.join(ESTIMATORS)}."
            )
        pair = rasters[ESTIMATORS[method].raster]
        estimates.append(estimate_offset(*pair, method, settings))
        log.info("%s: %s %s", method, estimates[-1].status, estimates[-1].reason)
        if progress:
            progress(method, 1.0)
    return tuple(estimates)


def failed(method: str, reason: str, evidence: Mapping[str, Any] | None = None) -> OffsetEstimate:
    """Return the value that says that a method found nothing, and why."""
    return OffsetEstimate(method, "failed", reason, evidence=evidence or {})


def search_radius(settings: Settings, dem_cell: float) -> float:
    """Half width of the window [m]: as asked, or 10 m, more where the DEM's cell is coarse."""
    if settings.search.radius is not None:
        return settings.search.radius
    return 10.0 * max(1.0, dem_cell / 0.10)


def _terrain(reference: SurveyRaster, moving: SurveyRaster, settings: Settings) -> OffsetEstimate:
    from meshreg.offsets import terrain

    for raster, which in ((reference, "reference"), (moving, "moving")):
        if raster.valid.sum() < 100:
            return failed("terrain", f"the {which} DEM has {int(raster.valid.sum())} cells")
    radius = search_radius(settings, reference.grid.cell)
    window = Window.around(reference.grid, moving.grid, radius)
    return _exhaustive("terrain", terrain.scan, reference, moving, settings, window)


def _mutual_information(
    reference: SurveyRaster, moving: SurveyRaster, settings: Settings
) -> OffsetEstimate:
    from meshreg.offsets import mutual_information

    reason = _no_image(reference, moving)
    if reason:
        return failed("mutual_information", reason)
    radius = search_radius(settings, reference.grid.cell)
    window = Window.around(reference.grid, moving.grid, radius)
    return _exhaustive(
        "mutual_information", mutual_information.scan, reference, moving, settings, window
    )


def _exhaustive(
    method: str,
    scan: Callable[..., Any],
    reference: SurveyRaster,
    moving: SurveyRaster,
    settings: Settings,
    window: Window,
) -> OffsetEstimate:
    """Turn a scanned surface into an estimate; the same rules for each exhaustive search."""
    if window.empty:
        return failed(method, "the surveys do not overlap within the search window")
    peak, score, evidence = scan(reference, moving, settings, window)
    evidence = dict(evidence) | {"east": window.east, "north": window.north}
    counts, pairs = evidence.pop("counts"), evidence.pop("pairs")
    if peak is None:
        largest = int(counts.max()) if counts.size else 0
        why = "the surveys do not overlap" if largest < 100 else "the ground or image is flat"
        return failed(method, f"nothing to compare within the search window: {why}", evidence)
    evidence |= {"best": (peak.east, peak.north), "second": peak.second}
    smaller = min(counts.max(), *(int(_mask(r, method).sum()) for r in (reference, moving)))
    overlap = float(counts[peak.index]) / max(float(smaller), 1.0)
    if peak.border:
        radius = search_radius(settings, reference.grid.cell)
        where = f"the best offset ({peak.east:.2f}, {peak.north:.2f}) m is at the edge of "
        if max(abs(peak.east), abs(peak.north)) > radius - 2 * window.cell:
            reason = (
                f"search border: {where}what could be searched (±{radius:g} m); try a larger "
                "--search-radius"
            )
        else:
            reason = f"{where}where the surveys overlap at all"
        return failed(method, reason, evidence)
    weak = peak.gap < 1.0
    return OffsetEstimate(
        method,
        "weak" if weak else "ok",
        f"the second peak is almost as good (gap {peak.gap:.2f})" if weak else "",
        peak.east,
        peak.north,
        _sigma(reference, moving, (_mask(reference, method), _mask(moving, method)), peak, pairs),
        score,
        peak.gap,
        min(overlap, 1.0),
        evidence=evidence,
    )


def _sigma(
    reference: SurveyRaster,
    moving: SurveyRaster,
    masks: tuple[Bool, Bool],
    peak: Peak,
    pairs: Callable[[tuple[int, int]], list[tuple[Float64, Float64]]],
) -> Float64:
    """Mean square error of a peak as its blocks tell it; of its curvature where they do not."""
    at, grids = (peak.east, peak.north), (reference.grid, moving.grid)
    fields = pairs(whole_shift(grids, peak.whole))
    blocks = correlated_blocks(fields, masks, grids, peak.whole, at)
    ground = ground_of(masks, grids, at)
    if blocks is None or ground is None:
        return peak.sigma
    sigma = error_bar(at, blocks, ground, FLOOR * moving.grid.cell)
    return peak.sigma if sigma is None else sigma


def _mask(raster: SurveyRaster, method: str) -> Bool:
    return raster.mask_of(ESTIMATORS[method].channel)


def _no_image(reference: SurveyRaster, moving: SurveyRaster) -> str:
    for raster, which in ((reference, "reference"), (moving, "moving")):
        if raster.color_valid.sum() < 100:
            return f"the {which} survey has no color"
        if np.ptp(raster.color[raster.color_valid].max(axis=1)) == 0:
            return f"the {which} image is blank"
    return ""


def _sift(reference: SurveyRaster, moving: SurveyRaster, settings: Settings) -> OffsetEstimate:
    from meshreg.offsets import sift

    reason = _no_image(reference, moving)
    if reason:
        return failed("sift", reason)
    options = settings.sift
    radius = search_radius(settings, reference.grid.cell)
    consensus, evidence = sift.match(reference, moving, settings, radius)
    total = len(evidence["inliers"])
    if consensus is None:
        return failed("sift", f"only {total} matches", evidence)
    count = int(consensus.inliers.sum())
    evidence = dict(evidence) | {"false_alarms": consensus.false_alarms}
    if options.exhaustive_vote and consensus.false_alarms > options.max_false_alarms:
        reason = (
            f"{count} of {total} matches agree, as chance alone would have it "
            f"(expected number of false alarms {consensus.false_alarms:.2g})"
        )
        return failed("sift", reason, evidence)
    if max(abs(consensus.east), abs(consensus.north)) > radius:
        where = f"({consensus.east:.2f}, {consensus.north:.2f}) m"
        return failed("sift", f"the consensus {where} is outside the search radius", evidence)
    by_chance = consensus.false_alarms > options.max_false_alarms
    return OffsetEstimate(
        "sift",
        "weak" if by_chance else "ok",
        "chance alone would bring as many matches together" if by_chance else "",
        consensus.east,
        consensus.north,
        sift.spread(reference, moving, consensus, evidence, options.inlier_radius),
        count / total,
        (count - consensus.second) / max(np.sqrt(max(consensus.second, 1)), 1.0),
        float("nan"),
        evidence=evidence,
    )


ESTIMATORS: dict[str, Estimator] = {
    "sift": Estimator("sift", "image", _sift),
    "terrain": Estimator("dem", "terrain", _terrain),
    "mutual_information": Estimator("ortho", "image", _mutual_information),
}
