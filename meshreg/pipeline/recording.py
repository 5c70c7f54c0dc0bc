"""The record of a pair, from what its stages found."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from meshreg import judge as judging
from meshreg.deformation import Deformation
from meshreg.heading import Pairs
from meshreg.height import Heights, stable_ground
from meshreg.judge import Judgement
from meshreg.pipeline.answer import Answer
from meshreg.pipeline.compare import APART, compare
from meshreg.pipeline.decision import Decision
from meshreg.records import (
    Finding,
    Float64,
    Gain,
    OffsetEstimate,
    Registration,
    Survey,
    SurveyRaster,
    Transform,
    Warp,
)
from meshreg.refine import Refined
from meshreg.settings import Settings


def registration_of(
    surveys: tuple[Survey, Survey],
    settings: Settings,
    decision: Decision,
    answer: Answer,
    judgement: Judgement,
    laid: tuple[Deformation, Mapping[str, Any]],
    delivered: Pairs,
    seconds: Mapping[str, float],
) -> Registration:
    """Return the record: `surveys` are (reference, moving), `delivered` their first rasters.

    `laid` is how they bend against each other, and the rasters of both as they lie in the end.
    """
    transform, (internal, rasters) = answer.transform, laid
    proven = judgement.verdict == "accepted"  # else it is not known how far off it may be
    dem, warp = delivered["dem"], internal.warp
    return Registration(
        verdict=judgement.verdict,
        reason=judgement.reason,
        transform=transform,
        covariance=answer.covariance if proven else None,
        estimates=decision.estimates,
        hypotheses=tuple(_plain(h) for h in judgement.hypotheses[:5]),
        before=_compared(rasters, "_before"),
        after=_compared(rasters, "") if transform is not None else {},
        reference=_about(surveys[0]),
        moving=_about(surveys[1]),
        settings=settings.as_dict(),
        versions=versions(),
        seconds=seconds,
        notes=tuple(answer.notes),
        registration_error=answer.error if proven else None,
        internal=internal.record or None,
        warp=warp,
        false_alarm=judgement.false_alarm,
        findings=judgement.findings,
        heights_gain=_gain(answer.found.gain),
        evidence={
            **rasters,
            "residuals": internal.evidence or _residuals(decision.refined, transform),
            "stable": _stable(decision.heights, transform, dem[1], rasters, warp),
            "motion": decision.motion,
            "channels": judgement.maps,
            "masked": {
                which: dict(raster.masked)
                for which, raster in zip(("reference", "moving"), dem, strict=True)
            },
        },
    )


def _compared(rasters: Mapping[str, Any], stage: str) -> dict[str, Any]:
    """Compare the reference with the moving survey at a stage, "_before" or ""."""
    if f"moving_dem{stage}" not in rasters:
        return dict(APART)
    dems = rasters["reference_dem"], rasters[f"moving_dem{stage}"]
    return compare(*dems, rasters["reference_ortho"], rasters[f"moving_ortho{stage}"])


def _gain(gain: Gain | None) -> dict[str, Any] | None:
    """Return the gain of the heights for the record; None where it was not looked for."""
    if gain is None:
        return None
    if gain.unknown:
        return {"value": None, "sigma": None, "reason": gain.unknown}
    return {"value": gain.value, "sigma": gain.sigma}


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


def unlike(
    reference: Survey,
    moving: Survey,
    settings: Settings,
    against: Sequence[Finding],
    seconds: Mapping[str, float],
    notes: Sequence[str],
) -> Registration:
    """Return the record of surveys that cannot be compared, and why."""
    estimates = tuple(
        OffsetEstimate(m, "failed", "the surveys do not overlap") for m in settings.methods
    )
    return Registration(
        "rejected",
        "; ".join(finding.text for finding in against),
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
        findings=tuple(against),
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
