"""The simulated hand: ground-truth offsets as the paper's authors got them, 25 clicks a site."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from data_synth.scene import Scene
from data_synth.truth import common_points
from meshreg.offsets.sift import ransac
from meshreg.settings import Settings

PAIRS = 25
CLICK = 0.02  # m: standard deviation of a click along each axis, in each of the two mosaics
WRONG = 0.05  # share of pairs clicked on the wrong thing
WRONG_BY = (0.3, 1.0)  # m: how far from the right one that is


@dataclass(frozen=True)
class Hand:
    """What the hand finds.

    Attributes
    ----------
    east, north : float
        Mean offset of the pairs that agree [m].
    residual : float
        Mean distance of all the pairs' offsets from it [m] (Table I).
    residual_inliers : float
        The same over the pairs that agree.
    inliers, pairs : int
    """

    east: float
    north: float
    residual: float
    residual_inliers: float
    inliers: int
    pairs: int

    def as_dict(self) -> dict[str, Any]:
        """Plain values for the record."""
        return dict(self.__dict__)


def click(scene: Scene, seed: int) -> Hand | None:
    """Click 25 points of the ground that both surveys show, and reject outliers as III-B does.

    Parameters
    ----------
    scene : Scene
    seed : int

    Returns
    -------
    Hand or None
        None where the surveys have too little ground in common.
    """
    if scene.recipe.place.other_ground or scene.recipe.sfm.mirrored:
        return None
    moving, reference = common_points(scene, 0.2)
    if len(moving) < 2 * PAIRS:
        return None
    rng = np.random.default_rng([seed, 25])
    chosen = rng.choice(len(moving), PAIRS, replace=False)
    offsets = (reference - moving)[chosen, :2]
    offsets = offsets + rng.normal(0.0, np.hypot(CLICK, CLICK), offsets.shape)
    wrong = rng.random(PAIRS) < WRONG
    angle, far = rng.uniform(0, 2 * np.pi, PAIRS), rng.uniform(*WRONG_BY, PAIRS)
    astray = far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = np.where(wrong[:, None], offsets + astray, offsets)
    found = ransac(offsets, Settings.from_preset("paper").sift, rng)
    if found is None:
        return None
    away = np.hypot(*(offsets - [found.east, found.north]).T)
    return Hand(
        found.east,
        found.north,
        float(away.mean()),
        float(away[found.inliers].mean()),
        int(found.inliers.sum()),
        PAIRS,
    )
