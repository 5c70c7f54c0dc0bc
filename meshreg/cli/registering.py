"""`meshreg register`."""

from __future__ import annotations

import dataclasses
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from meshreg.cli import pairing
from meshreg.cli.common import (
    LOG,
    NewFolder,
    SurveyRequest,
    named_files,
    new_folder,
    read,
    read_masks,
    require_disk,
)
from meshreg.cli.console import Progress, Terminal, logging_to
from meshreg.cli.drawing import figure_worker
from meshreg.cli.guard import Unfinished
from meshreg.cli.reporting import add_report
from meshreg.cli.validating import read_manual
from meshreg.settings import Settings

if TYPE_CHECKING:
    from meshreg.records import Registration, Survey, Transform


@dataclass(frozen=True)
class RegisterRequest:
    """Everything that `meshreg register` was asked."""

    reference: SurveyRequest
    moving: SurveyRequest
    out: Path
    masks: tuple[str, ...] = ()
    settings: Settings = field(default_factory=Settings)
    overwrite: bool = False
    ties: str | None = None
    config: Path | None = None  # the file that the settings came from
    allow_same: bool = False


def _new(request: RegisterRequest) -> NewFolder:
    surveys = (request.reference, request.moving)
    inputs = named_files(surveys, request.masks, request.ties, (request.config,))
    return NewFolder(request.out, request.overwrite, "register", "registration.json", inputs)


def register(request: RegisterRequest, voice: Terminal, unfinished: Unfinished) -> Registration:
    """Run the main job: read, register, write OUT whole."""
    with (
        new_folder(_new(request), unfinished) as folder,
        logging_to(voice, folder / "log.txt"),
        Progress(voice) as progress,
    ):
        return register_into(folder, request, progress)


def register_into(folder: Path, request: RegisterRequest, progress: Progress) -> Registration:
    """Read, register, write everything into a folder that is there already."""
    from meshreg.io import require_writable, rewrite_survey, unchanged
    from meshreg.io.frames.place import common_crs
    from meshreg.io.result.manifest import require_apart, survey_files
    from meshreg.records import Maps

    _log_start(request)
    with (
        figure_worker(request.reference.path, request.moving.path) as begin,
        ThreadPoolExecutor(1) as beside,
    ):
        clock = time.perf_counter()
        reference, moving, notes = _read_both(request, progress)
        require_apart(request.out, survey_files(reference, moving))
        masks = read_masks(request.masks, {"reference": reference, "moving": moving})
        moving, crs_notes = common_crs(reference, moving)
        notes += crs_notes
        for note in notes:
            LOG.warning("%s", note)
        manual, picked = read_manual(request.ties, reference, request.settings)
        notes += picked
        require_writable(moving, reference)
        require_disk(folder, moving)
        pairing.require_memory((reference, moving), request.settings)
        reading = time.perf_counter() - clock
        from meshreg.io.result.record import with_frames, write_record_files
        from meshreg.pipeline import register_pair

        moved: list[Future[tuple[Path, ...]]] = []

        def settled(transform: Transform) -> None:
            if not isinstance(moving.geometry, Maps):  # whose kernels want the machine alone
                moved.append(beside.submit(rewrite_survey, moving, transform, folder, reference))

        registration = register_pair(
            reference,
            moving,
            request.settings,
            reference_mask=masks["reference"],
            moving_mask=masks["moving"],
            manual=manual,
            progress=progress,
            settled=settled,
            allow_same=request.allow_same,
        )
        for survey in (reference, moving):
            unchanged(survey)
        later = pairing.masked_notes(registration)
        if registration.verdict != "accepted":
            later += pairing.unit_notes((reference, moving))
        for note in later:
            LOG.warning("%s", note)
        notes += later
        registration = dataclasses.replace(
            with_frames(registration, reference, moving),
            notes=(*registration.notes, *notes),
            seconds={"read": reading, **registration.seconds},
        )
        _log_result(registration)
        progress("write", 0.0)
        finish = begin(registration, folder / "figures")
        write_record_files(
            registration,
            folder,
            reference=reference,
            moving=moving,
            moved=None if not moved else moved[0].result,
        )
        add_report(registration, folder)
        progress("figures", 0.0)
        finish()
    progress("figures", 1.0)
    return registration


def _read_both(request: RegisterRequest, progress: Progress) -> tuple[Survey, Survey, list[str]]:
    """Read both surveys, the moving one in the reference's frame; and what to say of them."""
    from meshreg.io import require_warpable, same_files

    progress("read", 0.0)
    reference = read(request.reference, "reference")
    progress("read", 0.5)
    moving = read(request.moving, "moving")
    if request.settings.warp.model != "none":
        require_warpable(moving)
    if not request.allow_same:
        from meshreg.pipeline import require_different

        require_different(reference, moving)
    requests = (request.reference, request.moving)
    pairing.require_scale(requests, (reference, moving))
    radius = request.settings.search.radius or 10.0
    moving, notes = pairing.same_frame(requests, (reference, moving), radius)
    notes += pairing.level_notes((reference, moving))
    if same := same_files(reference, moving):
        notes.append(same)
    return reference, moving, notes


def _log_start(request: RegisterRequest) -> None:
    from meshreg import __version__

    LOG.info("meshreg %s, Python %s, %s", __version__, sys.version.split()[0], sys.platform)
    LOG.info("register %s %s -o %s", request.reference.name, request.moving.name, request.out)
    LOG.info("settings %s", request.settings.as_dict())


def _log_result(registration: Registration) -> None:
    for e in registration.estimates:
        found = f"east {e.east:+.4f} m, north {e.north:+.4f} m, gap {e.gap:.2f}"
        LOG.info("%s: %s; %s; %s", e.method, e.status, found, e.reason)
    for place, hypothesis in enumerate(registration.hypotheses, 1):
        LOG.info("hypothesis %d: %s", place, dict(hypothesis))
    for stage, seconds in registration.seconds.items():
        LOG.info("%s took %.2f s", stage, seconds)
    if registration.transform is not None:
        LOG.info("offset (east, north, up) [m]: %s", registration.transform.offset.tolist())
    LOG.info("%s: %s", registration.verdict, registration.reason)
