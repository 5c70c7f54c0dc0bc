"""A survey that was turned first: the whole answer, and what to say of its heading and scale."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from meshreg.heading import SMALL_YAW, Turn
from meshreg.records import Float64, OffsetAt, Transform
from meshreg.refine import Refined
from meshreg.settings import SearchSettings


def check_heading_and_scale(
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
    turned = 0.0 if motion is None else motion.yaw
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
            "can mimic; its scale was left as it is",
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
        yaw=refined.yaw + motion.yaw,
        tiles=tiles,
        offset_at=refined.offset_at and partial(_offset_at, refined.offset_at, motion),
    )


def _offset_at(turned: OffsetAt, motion: Transform, places: Float64) -> Float64:
    """Offset (N, 2) [m] of places as delivered, from that of the turned ones."""
    points = np.column_stack([places, np.full(len(places), motion.pivot[2])])
    there = motion.apply(points)[:, :2]
    return np.asarray(there + turned(there) - places)
