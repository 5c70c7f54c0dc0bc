"""`register_pair`: the way data flows, on one page.

Bryson, Johnson-Roberson, Pizarro and Williams (IROS 2013) are followed section by section: both
surveys are rasterized on one lattice, SIFT on the mosaics (III-B), the terrain scan (III-C) and
mutual information (III-D) each propose an offset, and, beyond the paper, the proposals are judged
by one neutral measure, refined on tiles, and given a verdict. A survey whose heading or scale is
off by more than the methods bear is turned first, as its tiles vote.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from meshreg.heading import Pairs, Turn, turning
from meshreg.judge import findings, last_word
from meshreg.pipeline.answer import answer_of, bent
from meshreg.pipeline.checks import in_no_metres, prepared, require_different, surveys_apart
from meshreg.pipeline.decision import Clock, Manual, Progress, decide
from meshreg.pipeline.explaining import looked_over
from meshreg.pipeline.levels import rasterize_pair, rasterize_registered
from meshreg.pipeline.recording import registration_of, unlike
from meshreg.records import Registration, Survey, Transform
from meshreg.settings import Settings


def register_pair(  # noqa: PLR0913
    reference: Survey,
    moving: Survey,
    settings: Settings | None = None,
    *,
    reference_mask: Any = None,
    moving_mask: Any = None,
    manual: Manual | None = None,
    progress: Progress | None = None,
    settled: Callable[[Transform], object] | None = None,
    allow_same: bool = False,
) -> Registration:
    """Lay the moving (repeat) survey on the reference (original) one, and say how sure that is.

    Parameters
    ----------
    reference, moving : Survey
        In the same CRS, or both in local frames (`meshreg.io.frames.common_crs` brings them there).
    settings : Settings, optional
    reference_mask, moving_mask : callable, optional
        What to use of each survey (`meshreg.io.masks.read_mask`).
    manual : callable, optional
        ``manual(motion)`` is a person's proposal (`meshreg.ties.ties_estimate`), of the moving
        survey as `motion` turned it first, if that is not None. It is judged like the methods'.
    progress : callable, optional
        Called with a stage's name and the fraction of it that is done.
    settled : callable, optional
        Called with the transform once it stands, unless a warp is asked for.
    allow_same : bool
        Whether both surveys may come from the very same files.

    Returns
    -------
    Registration
        A failed registration is a value too: its verdict is "rejected" or "review".

    Raises
    ------
    UsageError
        If the surveys' CRS differ, or only one of them has a known scale.
    InputError
        If every file of both surveys is the same, and that is not allowed.
    ResourceLimitError
        If the search would take more memory than is free.
    """
    settings = settings or Settings()
    if not allow_same:
        require_different(reference, moving)
    if degrees := in_no_metres(reference, moving):
        return unlike(reference, moving, settings, degrees, {}, [])
    settings, radius, notes = prepared(reference, moving, settings)
    clock = Clock(progress or (lambda stage, fraction: None))
    if apart := surveys_apart(reference, moving, radius):
        return unlike(reference, moving, settings, apart, clock.seconds, notes)
    masks = {"reference": reference_mask, "moving": moving_mask}
    with clock.stage("rasterize"):
        pairs = rasterize_pair(reference, moving, settings, masks, clock.tell)

    def turned(turn: Turn) -> tuple[Pairs, Transform]:
        motion = turning(turn, moving.centre)
        return rasterize_pair(reference, moving, settings, masks, clock.tell, motion, pairs), motion

    # heading; SIFT (III-B), terrain (III-C), mutual information (III-D); judged, refined, lifted
    decision = decide(pairs, settings, radius, clock.tell, manual, turned)
    clock.seconds.update(decision.seconds)
    notes += decision.notes
    answer, decision = answer_of(reference, moving, decision, settings, pairs, clock)
    transform = answer.transform
    if settled is not None and transform is not None and settings.warp.model == "none":
        settled(transform)
    with clock.stage("apply"):
        rasters = rasterize_registered(moving, transform, settings, masks, pairs)
    with clock.stage("internal"):
        laid = bent(decision.refined, transform, rasters, settings)
    found, counted = looked_over(answer, reference, moving, decision, settings, radius, pairs)
    judgement = last_word(decision.placed, findings(found))
    notes += [*answer.notes, *filter(None, [laid[0].summary]), *counted]
    answer = dataclasses.replace(answer, found=found, notes=notes)
    both = reference, moving
    return registration_of(both, settings, decision, answer, judgement, laid, pairs, clock.seconds)
