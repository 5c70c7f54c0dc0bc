"""Hold a registration against hand-picked pairs, as the paper does: Table I and Figure 2."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.records import Float64, OffsetEstimate, Registration, Transform
from meshreg.statistics import lever
from meshreg.ties.cover import sectors, weak_spots
from meshreg.ties.hand import (
    LEAST,
    Hand,
    free_hand,
    hand_document,
    moved,
    turn_degrees,
)
from meshreg.ties.placing import Placing
from meshreg.ties.records import TiePoints

SCHEMA = "meshreg.validation/1"
# `refine` turns by up to 1° itself; where the whole turn is more, the survey was turned first
_OWN_YAW = math.radians(1.0)
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
    moving : (N, 2) float64
        Moving point of each complete pair, turned as the hand registration says [m].
    after : (N, 2) float64 or None
        Reference point less registered moving point of each complete pair [m].
    """

    document: Mapping[str, Any]
    hand: Hand
    ties: TiePoints
    moving: Float64
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
    turned: tuple[float, float] | None = None,
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
    turned : (degrees, scale), optional
        By how much the moving survey was turned and scaled about its centre before the methods
        looked at it, as the result's evidence says; else it is taken from the whole turn.

    Returns
    -------
    Validation
        "confirmed" in its document: most pairs agree, the result lies within `radius` of them in
        their middle, and most of them lie within `radius` after registration.

    Raises
    ------
    InputError
        Fewer than three complete pairs, or pairs that lie outside of the surveys.
    """
    from meshreg.settings import SiftSettings

    _require_inside(registration, ties)
    hand, turn = free_hand(ties, SiftSettings(inlier_radius=radius), seed)
    if hand is None:
        raise InputError(
            f"{len(ties.complete)} complete pairs are too few; {LEAST} are the least.",
            remedy="Pick some 25: meshreg pick.",
        )
    reference, moving = ties.arrays()
    after = None if placing is None else reference - placing.to_reference(moving)
    place = hand.place if turn is None else turn.inverse().apply([*hand.place, 0.0])[:2]
    motion = _methods_motion(registration, turned)
    fused = _fused(registration, hand, after, placing, place)
    parts = sectors(reference[hand.inliers], np.zeros((0, 2)) if overlap is None else overlap)
    document = {
        "schema": SCHEMA,
        "confirmed": _confirmed(hand, fused, radius),
        "ties": {**(about or {}), "pairs": len(moving), "open": len(ties.pairs) - len(moving),
                 "notes": list(ties.notes)},
        "hand": hand_document(hand),
        "turned_first": turn_degrees(turn),
        "scaled_first": None if turn is None else turn.scale,
        "table_one": {"offset": math.hypot(hand.east, hand.north), "mean_residual": hand.residual},
        "methods_turned": turn_degrees(motion),
        "methods": {e.method: _method(e, hand, motion, place) for e in registration.estimates},
        "fused": fused,
        "pairs": _pairs(ties, hand, after),
        "weak_spots": list(weak_spots(parts)),
        "sectors": [{"name": s.name, "share": s.share, "pairs": s.pairs} for s in parts],
    }  # fmt: skip
    return Validation(document, hand, ties, moved(moving, turn), after)


def _require_inside(registration: Registration, ties: TiePoints) -> None:
    for which, points in zip(("reference", "moving"), ties.arrays(), strict=True):
        bounds = np.array(getattr(registration, which).get("bounds") or np.nan, float)
        if bounds.shape == (2, 3):
            require_inside(which, bounds, points)


def require_inside(which: str, bounds: Float64, points: Float64) -> None:
    """Refuse pairs in another frame: every point (N, 2) outside of its survey's bounds (2, 3) [m].

    Raises
    ------
    InputError
    """
    low, high = bounds[0, :2], bounds[1, :2]
    margin = _MARGIN * (high - low)
    inside = ((points >= low - margin) & (points <= high + margin)).all(axis=1)
    if len(points) and not inside.any():
        east, north = points.mean(axis=0)
        raise InputError(
            f"The {which} points lie around ({east:.2f}, {north:.2f}), the survey spans east "
            f"{low[0]:.2f} to {high[0]:.2f}, north {low[1]:.2f} to {high[1]:.2f}.",
            remedy="Give pairs in the surveys' coordinates as delivered (CRS, shift, "
            "which of the two is the reference).",
        )


def _methods_motion(
    registration: Registration, turned: tuple[float, float] | None
) -> Transform | None:
    """Return by which motion the moving survey was turned before the methods looked at it.

    It was turned about its centre, the transform's pivot. Where only the whole turn is known, it
    lacks what the tiles added: some tenths of a degree, which at the distance of the pairs' middle
    from that centre is millimetres.
    """
    transform = registration.transform
    if transform is None:
        return None
    yaw, scale = transform.yaw, transform.scale
    if turned is not None:
        yaw, scale = math.radians(turned[0]), turned[1]
    elif abs(yaw) <= _OWN_YAW and scale == 1.0:
        return None
    c, s = math.cos(yaw), math.sin(yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Transform(rotation, scale, np.zeros(3), transform.pivot)


def _method(
    estimate: OffsetEstimate, hand: Hand, motion: Transform | None, place: Float64
) -> dict[str, Any]:
    """Compare a method's answer where the pairs are; its offset is of the survey as turned first.

    `place` (2,) is the pairs' middle in the moving survey as delivered.
    """
    found = math.isfinite(estimate.east) and math.isfinite(estimate.north)
    start = moved(place[None], motion)[0] - hand.place
    offset = start + np.array([estimate.east, estimate.north])
    difference = offset - [hand.east, hand.north]
    return {
        "status": estimate.status,
        "manual": estimate.manual,
        "offset": offset.tolist() if found else None,
        "difference": difference.tolist() if found else None,
        "error": float(np.hypot(*difference)) if found else None,
        "reason": estimate.reason,
    }


def _fused(
    registration: Registration,
    hand: Hand,
    after: Float64 | None,
    placing: Placing | None,
    place: Float64,
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
            "within": None,
        }
    home = placing.to_reference(place)[0]
    offset = home - hand.place
    difference = offset - [hand.east, hand.north]
    distances = np.hypot(*after.T)
    return {
        "verdict": registration.verdict,
        "offset": offset.tolist(),
        "difference": difference.tolist(),
        "error": float(np.hypot(*difference)),
        "sigmas": _sigmas(registration, hand, difference, home),
        "residual": float(distances.mean()),
        "residual_inliers": float(distances[hand.inliers].mean()),
        "within": int((distances[hand.inliers] <= hand.radius).sum()),
    }


def _sigmas(
    registration: Registration, hand: Hand, difference: Float64, home: Float64
) -> float | None:
    """Mahalanobis distance by what the record and the pairs say of their own doubt.

    `home` (2,) is the pairs' middle after registration: the doubt of the yaw grows with its
    distance from the pivot.
    """
    covariance, transform = registration.covariance, registration.transform
    if covariance is None or transform is None:
        return None
    carry = lever(np.append(home - (transform.pivot + transform.offset)[:2], 0.0))
    total = (carry @ covariance @ carry.T)[:2, :2] + hand.sigma
    if not np.isfinite(total).all():
        return None
    return float(np.sqrt(difference @ np.linalg.solve(total, difference)))


def _confirmed(hand: Hand, fused: Mapping[str, Any], radius: float) -> bool:
    if fused["error"] is None or hand.contradictory:
        return False
    return bool(fused["error"] <= radius and 2 * fused["within"] > hand.inliers.sum())


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
