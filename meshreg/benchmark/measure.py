"""Register a pair, and measure each method's answer and the fused one against the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from meshreg.benchmark.hand import Hand
from meshreg.benchmark.rasters import turned
from meshreg.offsets import search_radius
from meshreg.pipeline import Decision, decide
from meshreg.records import (
    Float64,
    OffsetEstimate,
    Registration,
    SurveyRaster,
    Transform,
    Verdict,
)
from meshreg.refine import Refined
from meshreg.settings import Settings

SUCCESS = 0.25  # m: a larger error is a failure
LEVEL_95 = -2.0 * math.log(0.05)  # chi-square, 2 degrees of freedom
NORMAL_95 = 1.959964  # of one axis, in deviations
Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Answer:
    """Offset [m] at a pivot, turn about it, covariance of (east, north, yaw)."""

    pivot: Float64
    offset: Float64
    yaw: float
    covariance: Float64 | None

    def at(self, place: Float64) -> tuple[Float64, Float64 | None]:
        """Return offset (2,) and covariance (2, 2) at another place (east, north) of the moving."""
        arm = place - self.pivot
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        offset = self.offset + np.array([[c - 1, -s], [s, c - 1]]) @ arm
        if self.covariance is None:
            return offset, None
        carry = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
        return offset, carry @ self.covariance @ carry.T


def register_rasters(
    pairs: Mapping[str, tuple[SurveyRaster, SurveyRaster]],
    settings: Settings,
    radius: float | None = None,
) -> Decision:
    """Decide on a pair of rasters exactly as `meshreg.register_pair` does on its own.

    Parameters
    ----------
    pairs : mapping
        "dem", "ortho" and "sift" to (reference, moving).
    settings : Settings
    radius : float, optional
        Half width of the search window [m]; by default the settings', or what the DEM's cell asks.
    """
    cell = pairs["dem"][0].grid.cell
    radius = search_radius(settings, cell) if radius is None else radius
    settings = settings.changed({"search.radius": radius})
    again = partial(turned, dict(pairs))
    return decide(dict(pairs), settings, radius, turned=again)


def of_decision(
    decision: Decision, preset: str, truth: Mapping[str, Any], hand: Hand | None
) -> list[Row]:
    """Return a row for each method and one for the fused answer."""
    judgement, refined = decision.judgement, decision.refined
    answer = None
    if refined is not None:
        answer = Answer(refined.pivot, refined.offset, refined.yaw, _checked(refined))
    verdict = _Verdict(judgement.verdict, judgement.reason, judgement.false_alarm)
    best = judgement.best
    gaps = {} if best is None else dict(best.gaps)
    fused = _fused_row(answer, verdict, gaps, decision.seconds)
    variance = 0.0 if decision.heights is None else float(decision.heights.covariance[0, 0])
    fused |= _error_up(decision.transform, truth, math.sqrt(variance))
    rows = [_method_row(e) for e in decision.estimates]
    return _finished(rows, fused, answer, preset, truth, hand)


def of_registration(
    registration: Registration, preset: str, truth: Mapping[str, Any], hand: Hand | None
) -> list[Row]:
    """Return the rows of a pair that went the whole way."""
    answer, transform = None, registration.transform
    if transform is not None:
        turn = transform.yaw
        covariance = registration.covariance
        if covariance is not None:
            covariance = covariance[np.ix_([0, 1, 5], [0, 1, 5])]
        answer = Answer(transform.pivot[:2], transform.offset[:2], turn, covariance)
    alarm = 1.0 if registration.false_alarm is None else registration.false_alarm
    verdict = _Verdict(registration.verdict, registration.reason, alarm)
    first = registration.hypotheses[0] if registration.hypotheses else {}
    gaps = {c: first[f"{c}_gap"] for c in first.get("channels", ())}
    fused = _fused_row(answer, verdict, gaps, registration.seconds)
    stated = registration.registration_error or {}
    fused |= _error_up(transform, truth, stated.get("z", 0.0))
    rows = [_method_row(e) for e in registration.estimates]
    return _finished(rows, fused, answer, preset, truth, hand)


def _error_up(transform: Transform | None, truth: Mapping[str, Any], sigma: float) -> Row:
    """Error [m] in height at the centroid, and whether the stated 95 % hold the truth."""
    if transform is None or truth.get("centroid") is None:
        return {}
    centroid = np.array(truth["centroid"])
    error = float(transform.apply(centroid)[2] - centroid[2] - truth["offset"][2])
    if sigma <= 0:
        return {"error_up": error}
    return {"error_up": error, "sigma_up": sigma, "covered_up": abs(error) <= NORMAL_95 * sigma}


@dataclass(frozen=True)
class _Verdict:
    verdict: Verdict
    reason: str
    false_alarm: float


def _checked(refined: Refined) -> Float64 | None:
    return refined.covariance if np.isfinite(refined.covariance).all() else None


def _method_row(estimate: OffsetEstimate) -> Row:
    row: Row = {
        "method": estimate.method,
        "status": estimate.status,
        "reason": estimate.reason,
        "gap": estimate.gap,
        "score": estimate.score,
        "seconds": estimate.seconds,
        "_answer": None,
    }
    if "inliers" in estimate.evidence:
        inliers = np.asarray(estimate.evidence["inliers"], bool)
        row |= {
            "matches": int(inliers.size),
            "inliers": int(inliers.sum()),
            "inlier_share": float(inliers.mean()) if inliers.size else 0.0,
        }
    if estimate.status != "failed":
        covariance = None
        if estimate.sigma is not None:  # a translation: the same everywhere
            covariance = np.zeros((3, 3))
            covariance[:2, :2] = estimate.sigma
        here = np.array([estimate.east, estimate.north])
        row["_answer"] = Answer(np.zeros(2), here, 0.0, covariance)
    return row


def _fused_row(
    answer: Answer | None,
    verdict: _Verdict,
    gaps: Mapping[str, float],
    seconds: Mapping[str, float],
) -> Row:
    return {
        "method": "fused",
        "status": "failed" if answer is None else "ok",
        "reason": verdict.reason,
        "verdict": verdict.verdict,
        "false_alarm": verdict.false_alarm,
        "gap": max(gaps.values(), default=float("nan")),
        "terrain_gap": gaps.get("terrain"),
        "image_gap": gaps.get("image"),
        "seconds": float(sum(seconds.values())),
        "_answer": answer,
    }


def _finished(
    rows: list[Row],
    fused: Row,
    answer: Answer | None,
    preset: str,
    truth: Mapping[str, Any],
    hand: Hand | None,
) -> list[Row]:
    """Add to each row its offset where it is judged, and its errors."""
    known = truth.get("centroid") is not None
    place = np.array(truth["centroid"][:2]) if known else None
    if place is None and answer is not None:
        place = answer.pivot
    done = []
    for measured in [*rows, fused]:
        row = {**measured, "preset": preset}
        one: Answer | None = row.pop("_answer")
        if one is not None and place is not None:
            offset, sigma = one.at(place)
            row.update(east=float(offset[0]), north=float(offset[1]), yaw=one.yaw)
            if known:
                row.update(_errors(offset, sigma, np.array(truth["offset"][:2])))
            if hand is not None:
                away = offset - [hand.east, hand.north]
                row["error_hand"] = float(np.hypot(*away))
        if known:
            error = row.get("error")
            row["success"] = error is not None and error < SUCCESS
        done.append(row)
    return done


def _errors(offset: Float64, sigma: Float64 | None, true: Float64) -> Row:
    """Error [m], and whether the stated 95 % region covers the truth."""
    away = offset - true
    row: Row = {"error": float(np.hypot(*away))}
    if sigma is not None and np.isfinite(sigma).all() and np.linalg.det(sigma) > 0:
        distance2 = float(away @ np.linalg.solve(sigma, away))
        row |= {
            "distance2": distance2,
            "covered": distance2 <= LEVEL_95,
            "sigma": float(np.sqrt(np.linalg.eigvalsh(sigma)[-1])),
        }
    return row
