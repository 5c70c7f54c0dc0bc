"""What was decided about a pair."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from meshreg.errors import UsageError
from meshreg.records.arrays import NOTHING, Float64, frozen, put
from meshreg.records.estimate import OffsetEstimate
from meshreg.records.finding import Finding
from meshreg.records.transform import Transform
from meshreg.records.warp import Warp

Verdict = Literal["accepted", "review", "rejected"]


@dataclass(frozen=True, eq=False)
class Registration:
    """What was decided about a pair of surveys, with everything needed to check it.

    Attributes
    ----------
    verdict : "accepted", "review" or "rejected"
    reason : str
    transform : Transform or None
        `reference_from_moving` in absolute coordinates, pivot at the centre of the moving
        survey's bounding box; None when rejected, the best hypothesis when in review.
    covariance : (7, 7) float64 or None
        Of (east, north, up [m], tilt_east, tilt_north, yaw [rad], scale [-]) at the transform's
        pivot; the angles are right-handed turns about the east, north and up axes. A scale that
        was not fitted has the variance of what it may be off by. The internal bending of the
        models is not in it. None unless accepted: an answer that is not proven has no error bar.
    estimates : tuple of OffsetEstimate
    hypotheses : tuple of mappings
        Ranked candidates with their neutral scores.
    before, after : mapping
        Overlap, height median, NMAD, RMSE [m], image similarity.
    reference, moving : mapping
        path, sha256, counts, shift, crs of each survey.
    settings, versions, seconds : mapping
    notes : tuple of str
    registration_error : mapping or None
        Standard deviations x, y, z and the largest in any direction, `isotropic` [m], at `at`, the
        centroid of the overlap in the reference (`meshreg.statistics.registration_error`).
    internal : mapping or None
        The internal error: `said` in words, whether a warp was `applied`, and numbers of the
        `horizontal` and `vertical` model (`deformation`); None where it was not measured.
    false_alarm : float or None
        Chance that unrelated ground would make the best hypothesis stand out as much, measured on
        the pair itself (`meshreg.judge`).
    findings : tuple of Finding
        What speaks against accepting the pair (`judge.verdict`), in the order of the reason; empty
        where nothing does.
    heights_gain : mapping or None
        How many times as high the moving survey's relief is as the reference's: `value`, and
        `sigma` of its natural logarithm (`height.gain`), both None with the `reason` where that
        could not be told; None where it was not looked for.
    warp : Warp or None
        The bend that was applied after the transform, where one was asked for and found.
    evidence : mapping
        In memory only: rasters before and after, residual field; for figures.
    schema : str
    """

    verdict: Verdict
    reason: str
    transform: Transform | None
    covariance: Float64 | None
    estimates: tuple[OffsetEstimate, ...]
    hypotheses: tuple[Mapping[str, Any], ...]
    before: Mapping[str, Any]
    after: Mapping[str, Any]
    reference: Mapping[str, Any]
    moving: Mapping[str, Any]
    settings: Mapping[str, Any]
    versions: Mapping[str, str]
    seconds: Mapping[str, float]
    notes: tuple[str, ...] = ()
    evidence: Mapping[str, Any] = field(default_factory=lambda: NOTHING)
    schema: str = "meshreg.registration/2"
    registration_error: Mapping[str, Any] | None = None
    internal: Mapping[str, Any] | None = None
    warp: Warp | None = None
    false_alarm: float | None = None
    findings: tuple[Finding, ...] = ()
    heights_gain: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.covariance is not None:
            covariance = frozen(self.covariance, np.float64, (7, 7), "Registration.covariance")
            put(self, "covariance", covariance)
        if (self.transform is None) != (self.verdict == "rejected"):
            raise UsageError(
                f"A registration that is {self.verdict} "
                + ("cannot carry a transform." if self.transform else "needs a transform.")
            )
