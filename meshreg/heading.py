"""A survey that was turned first: by which motion, the whole answer, and what to say of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from meshreg.refine import Refined
from meshreg.settings import SearchSettings
from meshreg.types import Float64, OffsetAt, SurveyRaster, Transform
from meshreg.voting import SMALL_YAW, Turn, scaled, settled

STRAIGHT = np.deg2rad(0.1)  # the refinement takes what is left
Pairs = dict[str, tuple[SurveyRaster, SurveyRaster]]
Turned = Callable[[Turn], tuple[Pairs, Transform]]


def turning(turn: Turn, centre: Float64) -> Transform:
    """Return the motion about `centre` (3,) [m] that a vote asks for."""
    c, s = np.cos(turn.yaw), np.sin(turn.yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Transform(rotation, turn.scale, np.zeros(3), centre)


def yaw_of(motion: Transform) -> float:
    """Return the angle [rad], counter-clockwise, by which a motion turns about the vertical."""
    return float(np.arctan2(motion.rotation[1, 0], motion.rotation[0, 0]))


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


def on_heading_and_scale(
    yaw: float,
    scale: float,
    settings: SearchSettings,
    turn: Turn | None,
    motion: Transform | None,
) -> tuple[str, tuple[str, ...]]:
    """Say that a scale is plainly wrong, which is a doubt, and what the heading is off by.

    `yaw` [rad] and `scale` are those of the whole answer; `motion` is how the survey was turned
    before the search.
    """
    scaled = ""
    notes: tuple[str, ...] = ()
    turned = 0.0 if motion is None else yaw_of(motion)
    if abs(turned) > SMALL_YAW:
        notes += (
            f"the moving survey's heading is off by {np.rad2deg(-yaw):+.2f}°: it was turned by "
            f"{np.rad2deg(turned):+.2f}° about its centre before the search, and the methods' "
            "offsets are those of the turned survey",
        )
    if settings.free_scale and scale != 1.0:
        notes += (f"the moving survey's lengths are multiplied by {scale:.5f}",)
    elif scale != 1.0:
        scaled = f"the moving survey is {_missized(scale)}: check the scale bars"
    elif turn is not None and turn.mimics_scale:
        notes += (
            f"the moving survey seems {_missized(turn.stretch)}, which internal distortion "
            "can feign; its scale was left as it is",
        )
    return scaled, notes


def _missized(scale: float) -> str:
    """Tell in words what multiplying lengths by `scale` mends."""
    return f"{100 * abs(1 / scale - 1):.1f} % too {'small' if scale > 1 else 'large'}"


def as_delivered(refined: Refined, motion: Transform) -> Refined:
    """Put the answer for the turned survey and the turn together: one from the delivered one."""

    def back(places: Float64) -> Float64:
        points = np.column_stack([places, np.full(len(places), motion.pivot[2])])
        return motion.inverse().apply(points)[:, :2]

    pivot = back(refined.pivot[None])[0]
    tiles = refined.tiles
    if tiles is not None:
        places = back(tiles.places)
        tiles = replace(tiles, places=places, offsets=tiles.places + tiles.offsets - places)
    return replace(
        refined,
        pivot=pivot,
        offset=refined.pivot + refined.offset - pivot,
        yaw=refined.yaw + yaw_of(motion),
        tiles=tiles,
        offset_at=refined.offset_at and partial(_offset_at, refined.offset_at, motion),
    )


def _offset_at(turned: OffsetAt, motion: Transform, places: Float64) -> Float64:
    """Offset (N, 2) [m] of places as delivered, from that of the turned ones."""
    points = np.column_stack([places, np.full(len(places), motion.pivot[2])])
    there = motion.apply(points)[:, :2]
    return np.asarray(there + turned(there) - places)
