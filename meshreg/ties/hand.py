"""The paper's hand registration: one translation from picked pairs, by the RANSAC of III-B.

Bryson et al. (IROS 2013), V: 25 pairs were picked by hand in both mosaics of each site, outliers
rejected "in the same way" as III-B does, and the mean residual given with the offset (Table I).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.offsets import sift
from meshreg.records import Bool, Float64, OffsetEstimate, Transform
from meshreg.settings import SiftSettings
from meshreg.ties.records import TiePoints

PAIRS = 25  # as many as the paper's authors picked at each site
LEAST = 3  # fewer pairs cannot outvote a wrong one
_BLOCK = 2.0  # m: within it the models bend alike
MOST_LINES = 200  # pairs between which lines are drawn


@dataclass(frozen=True, eq=False)
class Hand:
    """What the pairs say.

    Attributes
    ----------
    east, north : float
        Mean offset of the pairs that agree: ADD to the moving survey [m].
    sigma : (2, 2) float64
        Covariance of that mean [m²].
    place : (2,) float64
        Centroid of the agreeing moving points: where the offset holds, if there is a yaw too.
    inliers : (N,) bool
        Of the complete pairs, in their order.
    residuals : (N,) float64
        Distance of each pair's own offset from the mean [m].
    sample, draws : int
        Of the RANSAC. The paper's are 10 and 4714.
    radius : float
        Within which a pair agrees [m].
    """

    east: float
    north: float
    sigma: Float64
    place: Float64
    inliers: Bool
    residuals: Float64
    sample: int
    draws: int
    radius: float

    @property
    def residual(self) -> float:
        """Mean distance of all pairs (Table I) [m]."""
        return float(self.residuals.mean())

    @property
    def residual_inliers(self) -> float:
        """Mean distance of the pairs that agree [m]."""
        return float(self.residuals[self.inliers].mean())

    @property
    def contradictory(self) -> bool:
        """Whether no more than half of the pairs agree: the pairs contradict one another."""
        return 2 * int(self.inliers.sum()) <= len(self.inliers)


def hand_registration(
    ties: TiePoints,
    settings: SiftSettings | None = None,
    seed: int = 0,
    motion: Transform | None = None,
) -> Hand | None:
    """Find the translation that most pairs share.

    Parameters
    ----------
    ties : TiePoints
    settings : SiftSettings, optional
        For the inlier radius (paper: 0.20 m), the sample and the confidence of the RANSAC. Of
        fewer than 20 pairs half are drawn: the published 10 would be all or most of them.
    seed : int
    motion : Transform, optional
        Turn of the moving survey about the vertical, before it is compared.

    Returns
    -------
    Hand or None
        None for fewer than three complete pairs.
    """
    reference, moving = ties.arrays()
    if len(reference) < LEAST:
        return None
    moving = moved(moving, motion)
    options = settings or SiftSettings()
    sample = max(1, min(options.sample, len(reference) // 2))
    options = dataclasses.replace(options, sample=sample)
    offsets = reference - moving
    found = sift.ransac(offsets, options, np.random.default_rng(seed))
    if found is None:
        return None
    (east, north), inliers = _last_fit(offsets, found.inliers, options.inlier_radius)
    return Hand(
        east,
        north,
        _spread(offsets[inliers], reference[inliers]),
        moving[inliers].mean(axis=0),
        inliers,
        np.hypot(*(offsets - [east, north]).T),
        sample,
        sift.draws(options),
        options.inlier_radius,
    )


def _last_fit(offsets: Float64, inliers: Bool, radius: float) -> tuple[Float64, Bool]:
    """Return the mean of the pairs that agree with that very mean, and which they are."""
    for turn in range(100):
        middle = offsets[inliers].mean(axis=0)
        near = np.hypot(*(offsets - middle).T) <= radius
        if turn > 10:  # in and out again: from here on none comes back
            near &= inliers
        if not near.any() or (near == inliers).all():
            break
        inliers = near
    return middle, inliers


def _spread(offsets: Float64, places: Float64) -> Float64:
    """(2, 2) covariance of the mean offset: pairs in one block of `_BLOCK` metres err alike."""
    if len(offsets) < LEAST:
        return 0.2**2 * np.eye(2)
    blocks = len(np.unique(np.floor(places / _BLOCK), axis=0))
    return np.asarray(np.cov(offsets.T) / blocks + 0.001**2 * np.eye(2))


def ties_estimate(
    ties: TiePoints,
    settings: SiftSettings | None = None,
    seed: int = 0,
    motion: Transform | None = None,
) -> OffsetEstimate:
    """Return the pairs as one more method's answer, marked as manual.

    Its covariance is that of a single pair and more: what one person misjudges alike in all pairs
    does not show in the scatter of their mean, and must not outweigh what was measured.

    Parameters
    ----------
    ties : TiePoints
    settings : SiftSettings, optional
    seed : int
    motion : Transform, optional
        By which the moving survey was turned first; the offset is that of the turned one.
    """
    complete = len(ties.complete)
    hand = hand_registration(ties, settings, seed, motion)
    if hand is None:
        reason = f"only {complete} complete pairs; {LEAST} are the least"
        return OffsetEstimate("ties", "failed", reason, manual=True)
    reference, moving = ties.arrays()
    evidence: dict[str, Any] = {
        "picked_reference": reference,
        "picked_moving": moving,
        "inliers": hand.inliers,
    }
    agree = int(hand.inliers.sum())
    sigma = agree * hand.sigma + (hand.radius / 4) ** 2 * np.eye(2)
    split = 2 * agree <= complete
    return OffsetEstimate(
        "ties",
        "weak" if split else "ok",
        f"only {agree} of {complete} pairs agree within {hand.radius:g} m" if split else "",
        hand.east,
        hand.north,
        sigma,
        agree / complete,
        evidence=evidence,
        manual=True,
    )


def free_hand(
    ties: TiePoints, settings: SiftSettings | None = None, seed: int = 0
) -> tuple[Hand | None, Transform | None]:
    """Find the translation that most pairs share, after their own turn where none alone will do.

    A translation, as the paper's, fits no survey that was delivered turned by degrees or in a wrong
    scale. The turn comes from the pairs, not from a registration that they are to check.

    Parameters
    ----------
    ties : TiePoints
    settings : SiftSettings, optional
    seed : int
        As of `hand_registration`.

    Returns
    -------
    Hand or None
    Transform or None
        Turn and scale about the middle of the moving points, by which they were moved first; None
        where the translation alone does as well, or half of the radius would not tell.
    """
    options = settings or SiftSettings()
    hand = hand_registration(ties, options, seed)
    if hand is None:
        return None, None
    turn = _own_turn(*ties.arrays(), np.random.default_rng(seed))
    _, moving = ties.arrays()
    if turn is None or _longest(moved(moving, turn) - moving) <= options.inlier_radius / 2:
        return hand, None
    turned = hand_registration(ties, options, seed, turn)
    if turned is None or turned.inliers.sum() <= hand.inliers.sum():
        return hand, None
    return turned, turn


def _own_turn(reference: Float64, moving: Float64, rng: np.random.Generator) -> Transform | None:
    """Median turn and scale of the longer lines between pairs: a quarter of them may be wrong."""
    if len(moving) > MOST_LINES:
        some = rng.choice(len(moving), MOST_LINES, replace=False)
        reference, moving = reference[some], moving[some]
    i, j = np.triu_indices(len(moving), 1)
    here, there = (points[j] - points[i] for points in (reference, moving))
    lengths = np.minimum(np.hypot(*here.T), np.hypot(*there.T))
    long = (lengths >= np.median(lengths)) & (lengths > 0)
    if not long.any():
        return None
    ratio = (here[long] @ [1, 1j]) / (there[long] @ [1, 1j])
    about = np.angle(np.sum(ratio / np.abs(ratio)))  # so that a half turn is not cut in two
    angle = about + np.median(np.angle(ratio * np.exp(-1j * about)))
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    scale = float(np.median(np.abs(ratio)))
    return Transform(rotation, scale, np.zeros(3), np.append(moving.mean(axis=0), 0.0))


def _longest(steps: Float64) -> float:
    return float(np.hypot(*steps.T).max(initial=0.0))


def moved(points: Float64, motion: Transform | None) -> Float64:
    """Move points (N, 2) [m] at the motion's own height."""
    if motion is None:
        return points
    level = np.full((len(points), 1), motion.pivot[2])
    return motion.apply(np.column_stack([points, level]))[:, :2]


def turn_degrees(turn: Transform | None) -> float | None:
    """Return the turn of a motion about the vertical [degrees, counterclockwise]."""
    if turn is None:
        return None
    return math.degrees(turn.yaw)


def hand_document(hand: Hand) -> dict[str, Any]:
    """Return the hand registration as plain values."""
    return {
        "east": hand.east,
        "north": hand.north,
        "sigma": np.sqrt(np.diag(hand.sigma)).tolist(),
        "covariance": hand.sigma.tolist(),
        "place": hand.place.tolist(),
        "pairs": len(hand.inliers),
        "inliers": int(hand.inliers.sum()),
        "residual": hand.residual,
        "residual_inliers": hand.residual_inliers,
        "radius": hand.radius,
        "sample": hand.sample,
        "draws": hand.draws,
        "contradictory": hand.contradictory,
    }
