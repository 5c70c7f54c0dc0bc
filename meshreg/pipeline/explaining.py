"""What is looked at once the answer stands: layers, walls, tilt, and why nothing was found."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from meshreg import judge as judging
from meshreg.heading import Pairs
from meshreg.judge import Found, findings, last_word, second_surface
from meshreg.pipeline.answer import Answer
from meshreg.pipeline.decision import Decision
from meshreg.pipeline.far_pose import far_pose
from meshreg.pipeline.postures import axes_after, other_axes, posture
from meshreg.records import Layer, Survey
from meshreg.settings import Settings


def looked_over(
    answer: Answer,
    reference: Survey,
    moving: Survey,
    decision: Decision,
    settings: Settings,
    radius: float,
    pairs: Pairs,
) -> tuple[Found, list[str]]:
    """Add to what was found what the surveys themselves show; return it, and notes."""
    layers = (
        second_surface(reference, pairs["dem"][0], settings.seed),
        second_surface(moving, pairs["dem"][1], settings.seed),
    )
    dips = (posture(reference).dip, posture(moving).dip)
    transform = answer.transform
    tilt = 0.0 if transform is None else math.degrees(transform.tilt)
    found = dataclasses.replace(answer.found, layers=layers, dips=dips, tilt=tilt)
    if last_word(decision.placed, findings(found)).verdict != "accepted":
        found = _explained(found, reference, moving, decision, settings, radius, pairs)
    return found, _counted(layers)


def _counted(layers: Sequence[Layer | None]) -> list[str]:
    """Say where a survey holds more than one surface in a share of its cells worth saying."""
    return [
        f"{layer.cells:.0%} of the {which} survey's cells hold more than one surface (overhangs, "
        "plants, or points off the ground); the top one is compared"
        for which, layer in zip(("reference", "moving"), layers, strict=True)
        if layer is not None and layer.cells >= 0.01
    ]


def _axes(
    reference: Survey, moving: Survey, decision: Decision, settings: Settings, radius: float
) -> str:
    """Name the axes with which image, relief, or bounds and slopes would agree; '' for none.

    Bounds come last: they alone cannot tell depths from north, east and down.
    """
    gain, maps, limit = (
        decision.found.gain,
        decision.judgement.maps,
        settings.judge.accept_gap,
    )
    said = ""
    if gain is not None and gain.inverted:
        said = axes_after(reference, moving, np.diag([1.0, 1.0, -1.0]), "the relief")
    elif judging.turned_map(maps, settings.judge) == judging.EXCHANGED:
        exchange = np.eye(3)[[1, 0, 2]]
        agree = [n for n, part in maps.items() if part.turned.get(judging.EXCHANGED, 0.0) >= limit]
        if "terrain" not in agree:  # its heights are negated too, as north, east and down are
            exchange[2, 2] = -1.0
        said = axes_after(reference, moving, exchange, f"the {agree[0]}")
    return said or other_axes(reference, moving, radius)


def _explained(
    found: Found,
    reference: Survey,
    moving: Survey,
    decision: Decision,
    settings: Settings,
    radius: float,
    pairs: Pairs,
) -> Found:
    """Try other axes on a pair that is not accepted, and a far turn or scale on a rejected one."""
    axes = _axes(reference, moving, decision, settings, radius)
    lost = decision.placed.verdict == "rejected" and not axes
    far = far_pose(pairs, radius, settings.search) if lost else None
    return dataclasses.replace(found, axes=axes, far=far)
