"""The paper's hand registration: one translation from picked pairs, by the RANSAC of III-B.

Bryson et al. (IROS 2013), V: 25 pairs were picked by hand in both mosaics of each site, outliers
rejected "in the same way" as III-B does, and the mean residual given with the offset (Table I).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.offsets import sift
from meshreg.settings import SiftSettings
from meshreg.ties.records import TiePoints
from meshreg.types import Bool, Float64, OffsetEstimate, Transform

PAIRS = 25  # as many as the paper's authors picked at each site
LEAST = 3  # fewer pairs cannot outvote a wrong one


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
    inliers = found.inliers
    return Hand(
        found.east,
        found.north,
        sift.spread(offsets[inliers], reference[inliers]),
        moving[inliers].mean(axis=0),
        inliers,
        np.hypot(*(offsets - [found.east, found.north]).T),
        sample,
        sift.draws(options),
        options.inlier_radius,
    )


def ties_estimate(
    ties: TiePoints,
    settings: SiftSettings | None = None,
    seed: int = 0,
    motion: Transform | None = None,
) -> OffsetEstimate:
    """Return the pairs as one more method's answer, marked as manual.

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
    split = 2 * agree <= complete
    return OffsetEstimate(
        "ties",
        "weak" if split else "ok",
        f"only {agree} of {complete} pairs agree within {hand.radius:g} m" if split else "",
        hand.east,
        hand.north,
        hand.sigma,
        agree / complete,
        evidence=evidence,
        manual=True,
    )


def turn_first(transform: Transform | None, ties: TiePoints, radius: float) -> Transform | None:
    """Return a registration's turn and scale about the pairs' middle, if one offset cannot do.

    A translation alone, as the paper's, fits no survey that was delivered turned by degrees. Then
    the turn is taken from the registration and the pairs say the offset only.

    Parameters
    ----------
    transform : Transform or None
        `reference_from_moving`; None, nothing is known.
    ties : TiePoints
    radius : float
        Within which pairs agree [m]; half of it may be lost to the turn.
    """
    _, moving = ties.arrays()
    if transform is None or len(moving) < LEAST:
        return None
    middle = moving.mean(axis=0)
    away = np.column_stack([moving - middle, np.zeros(len(moving))])
    bent = np.hypot(*((away @ transform.linear.T - away)[:, :2]).T)
    if bent.max() <= radius / 2:
        return None
    return Transform(transform.rotation, transform.scale, np.zeros(3), np.append(middle, 0.0))


def moved(points: Float64, motion: Transform | None) -> Float64:
    """Move points (N, 2) [m] at the motion's own height."""
    if motion is None:
        return points
    level = np.full((len(points), 1), motion.pivot[2])
    return motion.apply(np.column_stack([points, level]))[:, :2]


@dataclass(frozen=True)
class Sector:
    """One ninth of the overlap's bounding box.

    `share` is how much of the overlap lies in it, `pairs` how many agreeing pairs.
    """

    name: str
    share: float
    pairs: int


_NAMES = (
    ("north-west", "north", "north-east"),
    ("west", "middle", "east"),
    ("south-west", "south", "south-east"),
)


def sectors(places: Float64, overlap: Float64) -> tuple[Sector, ...]:
    """Count points by ninths of the ground that both surveys show.

    Parameters
    ----------
    places : (N, 2) float64
        Reference points [m].
    overlap : (M, 2) float64
        Centres of equal cells of the ground that both surveys show [m].
    """
    if not len(overlap):
        return ()
    low, high = overlap.min(axis=0), overlap.max(axis=0)
    size = np.maximum(high - low, 1e-9)

    def ninths(points: Float64) -> Any:
        column = np.clip(3 * (points[:, 0] - low[0]) / size[0], 0, 2).astype(int)
        row = np.clip(3 * (high[1] - points[:, 1]) / size[1], 0, 2).astype(int)
        return np.bincount(3 * row + column, minlength=9).reshape(3, 3)

    ground = ninths(overlap) / len(overlap)
    inside = (places >= low - size / 20).all(axis=1) & (places <= high + size / 20).all(axis=1)
    counts = ninths(places[inside])
    return tuple(
        Sector(_NAMES[row][col], float(ground[row, col]), int(counts[row, col]))
        for row in range(3)
        for col in range(3)
    )


def weak_spots(parts: tuple[Sector, ...], least_share: float = 0.04) -> tuple[str, ...]:
    """Name the ninths that hold ground but no point; those of little ground are passed over."""
    return tuple(part.name for part in parts if part.share >= least_share and not part.pairs)


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
