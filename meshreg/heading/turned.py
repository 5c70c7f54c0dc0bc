"""A survey that is turned before anything else looks at it, and by which motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from meshreg.heading.voting import SMALL_YAW, Turn, scaled, settled
from meshreg.records import Float64, SurveyRaster, Transform
from meshreg.settings import SearchSettings

STRAIGHT = np.deg2rad(0.1)  # the refinement takes what is left
Pairs = dict[str, tuple[SurveyRaster, SurveyRaster]]
Turned = Callable[[Turn], tuple[Pairs, Transform]]


def turning(turn: Turn, centre: Float64) -> Transform:
    """Return the motion about `centre` (3,) [m] that a vote asks for."""
    c, s = np.cos(turn.yaw), np.sin(turn.yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Transform(rotation, turn.scale, np.zeros(3), centre)


def turned_as_voted(
    pairs: Pairs, turn: Turn, turned: Turned, settings: SearchSettings
) -> tuple[Pairs, Transform]:
    """Turn the moving survey; the tiles of one that was far off are then measured anew.

    Parameters
    ----------
    pairs : mapping
        "dem" and "ortho" to (reference, moving), as delivered.
    turn : Turn
        What their tiles vote for.
    turned : callable
        ``turned(turn)`` makes the rasters of the turned survey, and says by which motion.
    settings : SearchSettings
    """
    if abs(turn.yaw) <= SMALL_YAW:
        return turned(turn)
    # unturned tiles run off their peaks, which by itself feigns a scale of a per cent
    upright = turned(replace(turn, scale=1.0))
    there = partial(_still_off, turn, upright[1])
    again = scaled(settled(upright[0], turn, there), settings)
    if abs(again.yaw - turn.yaw) < STRAIGHT and again.scale == 1.0:
        return upright
    return turned(again)


def _still_off(turn: Turn, motion: Transform, places: Float64) -> Float64:
    """Offset (N, 2) [m] that a turn leaves at places (N, 2) of a survey that `motion` moved."""
    level = np.column_stack([places, np.full(len(places), motion.pivot[2])])
    delivered = motion.inverse().apply(level)[:, :2]
    return np.asarray(delivered + turn.offset_at(delivered) - places)
