"""The transform of a decision, what it may be off by, and the opt-in step on the 3-D surfaces."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from meshreg.deformation import Deformation, measure, warped_raster
from meshreg.heading import Pairs
from meshreg.height import STABLE
from meshreg.judge import Found
from meshreg.pipeline.decision import Clock, Decision, completed
from meshreg.records import Float64, Maps, Survey, Transform
from meshreg.refine import Polished, Refined, polish
from meshreg.settings import Settings
from meshreg.statistics import lever, registration_error


@dataclasses.dataclass(frozen=True, eq=False)
class Answer:
    """Where the moving survey belongs.

    Attributes
    ----------
    transform : Transform or None
        None when rejected.
    covariance : (7, 7) float64 or None
        At the transform's pivot.
    error : mapping or None
        As `meshreg.statistics.registration_error`, at the overlap's centroid.
    found : Found
    notes : list of str
    """

    transform: Transform | None
    covariance: Float64 | None
    error: dict[str, Any] | None
    found: Found
    notes: list[str]


def answer_of(
    reference: Survey,
    moving: Survey,
    decision: Decision,
    settings: Settings,
    pairs: Pairs,
    clock: Clock,
) -> tuple[Answer, Decision]:
    """Put what was decided together; maps are not tilted, which the decision then says too."""
    refined, found = decision.refined, decision.found
    if isinstance(moving.geometry, Maps) and decision.heights is not None:
        decision = dataclasses.replace(decision, heights=decision.heights.levelled())
    heights = decision.heights
    notes = [part.note for part in (refined, heights) if part is not None and part.note]
    transform, covariance, error = completed(moving, decision)
    if transform is None or heights is None or settings.refine.surfaces == "none":
        return Answer(transform, covariance, error, found, notes), decision
    with clock.stage("surfaces"):
        place, ground = heights.place, heights.ground
        stable = None if ground is None else (ground == STABLE, pairs["dem"][1].grid)
        kind, seed = settings.refine.surfaces, settings.seed
        said = polish(reference, moving, transform, place, error, stable, seed, kind=kind)
    if said.accepted and covariance is not None:
        covariance = _after_polishing(covariance, transform, said)
        error = registration_error(covariance, said.transform, said.transform.apply(place))
    found = dataclasses.replace(found, surfaces=said.doubt)
    return Answer(said.transform, covariance, error, found, [*notes, said.note]), decision


def _after_polishing(covariance: Float64, before: Transform, polished: Polished) -> Float64:
    """(7, 7) at the polished transform's pivot, from that of the one before at its own."""
    to = lever(polished.home - (before.pivot + before.offset))
    wide = polished.widened(to @ covariance @ to.T)
    back = lever(polished.transform.pivot + polished.transform.offset - polished.home)
    return np.asarray(back @ wide @ back.T)


def bent(
    refined: Refined | None,
    transform: Transform | None,
    rasters: Mapping[str, Any],
    settings: Settings,
) -> tuple[Deformation, dict[str, Any]]:
    """Measure how the models bend; where a warp is asked for and found, bend the moving maps."""
    rasters = dict(rasters)
    if refined is None or transform is None:
        return Deformation(""), rasters
    dems = rasters["reference_dem"], rasters["moving_dem"]
    internal = measure(refined.tiles, transform, *dems, settings.warp)
    if internal.warp is not None and settings.warp.model != "none":
        for name in ("moving_dem", "moving_ortho"):
            rasters[name] = warped_raster(rasters[name], internal.warp)
        return internal.applied(), rasters
    return dataclasses.replace(internal, warp=None), rasters
