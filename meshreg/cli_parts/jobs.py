"""What the commands do once their arguments are understood; every word goes through a Voice."""

from __future__ import annotations

import dataclasses
import logging
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from meshreg.cli_parts.console import Progress, Voice, logging_to
from meshreg.cli_parts.guard import Unfinished
from meshreg.errors import OutputError, ResourceLimitError
from meshreg.settings import Settings

if TYPE_CHECKING:
    from meshreg.io.options import ReadOptions
    from meshreg.types import Registration, Survey

_LOG = logging.getLogger("meshreg")
_ROOM = 200e6  # bytes wanted on the disk beside the copies of the moving survey's files


@dataclass(frozen=True)
class SurveyRequest:
    """A survey as the user names it, with what they say about it."""

    path: str
    options: ReadOptions
    masks: tuple[str, ...] = ()


@dataclass(frozen=True)
class RegisterRequest:
    """Everything that `meshreg register` was asked."""

    reference: SurveyRequest
    moving: SurveyRequest
    out: Path
    settings: Settings = field(default_factory=Settings)
    overwrite: bool = False


@contextmanager
def new_folder(
    out: Path, overwrite: bool, unfinished: Unfinished, marker: str
) -> Iterator[Path]:
    """Give a temporary folder that becomes `out` when the block ends well.

    That the folder can be written and the disk is not full is found out here, before the work.
    """
    from meshreg.io.atomic import as_output_error, atomic_folder

    with as_output_error(out):
        out.absolute().parent.mkdir(parents=True, exist_ok=True)
    with atomic_folder(out, overwrite, (marker,)) as folder, unfinished.holding(folder):
        yield folder


def require_disk(folder: Path, survey: Survey | None) -> None:
    """Refuse, with numbers, before the work if the disk cannot take the result."""
    wanted = _ROOM
    if survey is not None:
        files = [p for source in survey.source for p in (source.path, *source.companions)]
        wanted += 1.2 * sum(path.stat().st_size for path in set(files) if path.is_file())
    free = shutil.disk_usage(folder).free
    if free < wanted:
        raise OutputError(
            f"has {free / 1e6:.0f} MB free; the result may take {wanted / 1e6:.0f} MB.",
            file=folder.parent,
            remedy="Free some disk, or choose another place with -o.",
        )


def read(request: SurveyRequest, name: str = "") -> Survey:
    """Read one survey and log what was found."""
    from meshreg.io import read_survey

    survey = read_survey(request.path, request.options)
    _LOG.info("%s: %s from %s", name or "survey", survey.name, request.path)
    for note in survey.notes:
        _LOG.info("%s: %s", survey.name, note)
    return survey


def register(request: RegisterRequest, voice: Voice, unfinished: Unfinished) -> Registration:
    """Run the main job: read, register, write OUT whole."""
    from meshreg.io import same_files, unchanged
    from meshreg.io.frames import common_crs
    from meshreg.io.record import write_record_files
    from meshreg.pipeline import register_pair
    from meshreg.report import draw_figures

    with (
        new_folder(request.out, request.overwrite, unfinished, "registration.json") as folder,
        logging_to(voice, folder / "log.txt"),
        Progress(voice) as progress,
    ):
        _log_start(request)
        clock = time.perf_counter()
        progress("read", 0.0)
        reference = read(request.reference, "reference")
        progress("read", 0.5)
        moving = read(request.moving, "moving")
        notes = []
        if same := same_files(reference, moving):
            notes.append(same)
        moving, crs_notes = common_crs(reference, moving)
        notes += crs_notes
        for note in notes:
            _LOG.warning("%s", note)
        require_disk(folder, moving)
        masks = [_mask(side.masks) for side in (request.reference, request.moving)]
        reading = time.perf_counter() - clock
        registration = register_pair(
            reference,
            moving,
            request.settings,
            reference_mask=masks[0],
            moving_mask=masks[1],
            progress=progress,
        )
        for survey in (reference, moving):
            unchanged(survey)
        registration = dataclasses.replace(
            registration,
            notes=(*registration.notes, *notes),
            seconds={"read": reading, **registration.seconds},
        )
        _LOG.info("%s: %s", registration.verdict, registration.reason)
        progress("write", 0.0)
        write_record_files(registration, folder, reference=reference, moving=moving)
        progress("figures", 0.0)
        draw_figures(registration, folder / "figures")
        progress("figures", 1.0)
    return registration


def _log_start(request: RegisterRequest) -> None:
    from meshreg import __version__

    _LOG.info("meshreg %s, Python %s, %s", __version__, sys.version.split()[0], sys.platform)
    _LOG.info("register %s %s -o %s", request.reference.path, request.moving.path, request.out)
    _LOG.info("settings %s", request.settings.as_dict())


def _mask(paths: Sequence[str]) -> Callable[..., Any] | None:
    if not paths:
        return None
    from meshreg.io.masks import read_mask

    masks = [read_mask(path) for path in paths]
    if len(masks) == 1:
        return masks[0]

    def every(grid: Any) -> Any:
        used = masks[0](grid)
        for mask in masks[1:]:
            used = used & mask(grid)
        return used

    return every


def out_of_memory(error: MemoryError) -> ResourceLimitError:
    """Say a MemoryError as the resource limit that it is."""
    said = f" ({error})" if str(error) else ""
    return ResourceLimitError(
        f"There was not enough memory{said}; this machine has {_memory():.1f} GB.",
        remedy="Use coarser cells (--dem-cell, --ortho-cell, --sift-cell) or a larger machine.",
    )


def _memory() -> float:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (ValueError, OSError):
        return float("nan")
