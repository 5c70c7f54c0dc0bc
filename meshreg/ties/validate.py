"""Hold a registration against hand-picked pairs, as the paper does: Table I and Figure 2."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.statistics import lever
from meshreg.ties.hand import (
    LEAST,
    Hand,
    hand_document,
    hand_registration,
    sectors,
    turn_first,
    weak_spots,
)
from meshreg.ties.placing import Placing
from meshreg.ties.records import TiePoints
from meshreg.types import Float64, OffsetEstimate, Registration, Transform

SCHEMA = "meshreg.validation/1"
_MARGIN = 0.1  # of a survey's size: pairs further outside are in another frame


@dataclass(frozen=True, eq=False)
class Validation:
    """What a figure needs beside the document.

    Attributes
    ----------
    document : mapping
        `validation.json`.
    hand : Hand
    ties : TiePoints
    after : (N, 2) float64 or None
        Reference point less registered moving point of each complete pair [m].
    """

    document: Mapping[str, Any]
    hand: Hand
    ties: TiePoints
    after: Float64 | None


def validate(
    registration: Registration,
    ties: TiePoints,
    placing: Placing | None = None,
    *,
    radius: float = 0.20,
    seed: int = 0,
    overlap: Float64 | None = None,
    about: Mapping[str, Any] | None = None,
) -> Validation:
    """Compare each method's offset and the result with the pairs' own translation.

    Parameters
    ----------
    registration : Registration
    ties : TiePoints
        In the coordinates of the surveys as delivered.
    placing : Placing, optional
        Of the same registration; none where it is rejected.
    radius : float
        Within which pairs agree [m]; the paper's 0.20.
    seed : int
        Of the RANSAC.
    overlap : (M, 2) float64, optional
        Places of the common ground [m], to say where pairs are missing.
    about : mapping, optional
        Where the pairs come from, for the document.

    Returns
    -------
    Validation
        "confirmed" in its document: most pairs agree, and the result lies within `radius` of them.

    Raises
    ------
    InputError
        Fewer than three complete pairs, or pairs that lie outside of the surveys.
    """
    from meshreg.settings import SiftSettings

    _require_inside(registration, ties)
    turn = turn_first(registration.transform, ties, radius)
    hand = hand_registration(ties, SiftSettings(inlier_radius=radius), seed, turn)
    if hand is None:
        raise InputError(
            f"{len(ties.complete)} complete pairs are too few; {LEAST} are the least.",
            remedy="Pick some 25: meshreg pick.",
        )
    reference, moving = ties.arrays()
    after = None if placing is None else reference - placing.to_reference(moving)
    fused = _fused(registration, hand, after, placing, turn)
    parts = sectors(reference[hand.inliers], np.zeros((0, 2)) if overlap is None else overlap)
    document = {
        "schema": SCHEMA,
        "confirmed": _confirmed(hand, fused, radius),
        "ties": {**(about or {}), "pairs": len(moving), "open": len(ties.pairs) - len(moving),
                 "notes": list(ties.notes)},
        "hand": hand_document(hand),
        "turned_first": None if turn is None else _degrees(turn),
        "table_one": {"offset": math.hypot(hand.east, hand.north), "mean_residual": hand.residual},
        "methods": {e.method: _method(e, hand, turn) for e in registration.estimates},
        "fused": fused,
        "pairs": _pairs(ties, hand, after),
        "weak_spots": list(weak_spots(parts)),
        "sectors": [{"name": s.name, "share": s.share, "pairs": s.pairs} for s in parts],
    }  # fmt: skip
    return Validation(document, hand, ties, after)


def _require_inside(registration: Registration, ties: TiePoints) -> None:
    """Refuse pairs in another frame: every one of them outside of its survey's bounds."""
    for which, points in zip(("reference", "moving"), ties.arrays(), strict=True):
        bounds = np.array(getattr(registration, which).get("bounds") or np.nan, float)
        if bounds.shape != (2, 3) or not len(points):
            continue
        low, high = bounds[0, :2], bounds[1, :2]
        margin = _MARGIN * (high - low)
        if not ((points >= low - margin) & (points <= high + margin)).all(axis=1).any():
            east, north = points.mean(axis=0)
            raise InputError(
                f"The {which} points lie around ({east:.2f}, {north:.2f}), the survey spans east "
                f"{low[0]:.2f} to {high[0]:.2f}, north {low[1]:.2f} to {high[1]:.2f}.",
                remedy="Give pairs in the surveys' coordinates as delivered (CRS, shift, "
                "which of the two is the reference).",
            )


def _degrees(turn: Transform) -> float:
    return math.degrees(math.atan2(turn.rotation[1, 0], turn.rotation[0, 0]))


def _method(estimate: OffsetEstimate, hand: Hand, turn: Transform | None) -> dict[str, Any]:
    found = math.isfinite(estimate.east) and math.isfinite(estimate.north) and turn is None
    east, north = estimate.east - hand.east, estimate.north - hand.north
    return {
        "status": estimate.status,
        "manual": estimate.manual,
        "offset": [estimate.east, estimate.north] if found else None,
        "difference": [east, north] if found else None,
        "error": math.hypot(east, north) if found else None,
        "reason": estimate.reason
        or ("" if turn is None else "the methods looked at another turn of the moving survey"),
    }


def _fused(
    registration: Registration,
    hand: Hand,
    after: Float64 | None,
    placing: Placing | None,
    turn: Transform | None,
) -> dict[str, Any]:
    """Compare the result where the pairs are: with a yaw its offset differs from place to place."""
    if placing is None or after is None or registration.transform is None:
        return {
            "verdict": registration.verdict,
            "offset": None,
            "difference": None,
            "error": None,
            "sigmas": None,
            "residual": None,
            "residual_inliers": None,
        }
    place = hand.place if turn is None else turn.inverse().apply([*hand.place, 0.0])[:2]
    offset = placing.to_reference(place)[0] - hand.place
    difference = offset - [hand.east, hand.north]
    distances = np.hypot(*after.T)
    return {
        "verdict": registration.verdict,
        "offset": offset.tolist(),
        "difference": difference.tolist(),
        "error": float(np.hypot(*difference)),
        "sigmas": _sigmas(registration, hand, difference),
        "residual": float(distances.mean()),
        "residual_inliers": float(distances[hand.inliers].mean()),
    }


def _sigmas(registration: Registration, hand: Hand, difference: Float64) -> float | None:
    """Mahalanobis distance by what the record and the pairs say of their own doubt."""
    covariance, transform = registration.covariance, registration.transform
    if covariance is None or transform is None:
        return None
    carry = lever(np.append(hand.place - transform.pivot[:2], 0.0))
    total = (carry @ covariance @ carry.T)[:2, :2] + hand.sigma
    if not np.isfinite(total).all():
        return None
    return float(np.sqrt(difference @ np.linalg.solve(total, difference)))


def _confirmed(hand: Hand, fused: Mapping[str, Any], radius: float) -> bool:
    return fused["error"] is not None and not hand.contradictory and fused["error"] <= radius


def _pairs(ties: TiePoints, hand: Hand, after: Float64 | None) -> list[dict[str, Any]]:
    rows = []
    for k, pair in enumerate(ties.complete):
        rows.append(
            {
                "id": pair.id,
                "name": pair.name,
                "reference": list(pair.reference or ()),
                "moving": list(pair.moving or ()),
                "agrees": bool(hand.inliers[k]),
                "residual": float(hand.residuals[k]),
                "residual_after": None if after is None else float(np.hypot(*after[k])),
            }
        )
    return rows
