"""`meshreg selftest`."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from meshreg.cli import pairing
from meshreg.cli.common import (
    LOG,
    NewFolder,
    SurveyRequest,
    named_files,
    new_folder,
    read,
    read_masks,
)
from meshreg.cli.console import Progress, Terminal, logging_to
from meshreg.cli.guard import Unfinished
from meshreg.settings import Settings

FILE = "selftest.json"


@dataclass(frozen=True)
class SelftestRequest:
    """Everything that `meshreg selftest` was asked."""

    reference: SurveyRequest
    moving: SurveyRequest
    out: Path | None = None
    masks: tuple[str, ...] = ()
    settings: Settings = field(default_factory=Settings)
    count: int = 8
    overwrite: bool = False
    config: Path | None = None
    allow_same: bool = False


def selftest(request: SelftestRequest, voice: Terminal, unfinished: Unfinished) -> dict[str, Any]:
    """Read both surveys, put known shifts into the moving one, say what came back."""
    with _folder(request, unfinished) as folder:
        log = None if folder is None else folder / "log.txt"
        with logging_to(voice, log), Progress(voice) as progress:
            document = _tested(request, progress)
        if folder is not None:
            from meshreg.io.files.atomic import as_output_error
            from meshreg.io.result.document import to_json

            with as_output_error(folder / FILE):
                (folder / FILE).write_text(to_json(document), encoding="utf-8")
    return document


@contextlib.contextmanager
def _folder(request: SelftestRequest, unfinished: Unfinished) -> Iterator[Path | None]:
    if request.out is None:
        yield None
        return
    surveys = (request.reference, request.moving)
    inputs = named_files(surveys, request.masks, others=(request.config,))
    new = NewFolder(request.out, request.overwrite, "selftest", FILE, inputs)
    with new_folder(new, unfinished) as folder:
        yield folder


def _tested(request: SelftestRequest, progress: Progress) -> dict[str, Any]:
    from meshreg.io.frames.place import common_crs
    from meshreg.io.result.manifest import require_apart, survey_files
    from meshreg.pipeline import self_test

    progress("read", 0.0)
    reference = read(request.reference, "reference")
    progress("read", 0.5)
    moving = read(request.moving, "moving")
    if request.out is not None:
        require_apart(request.out, survey_files(reference, moving))
    requests = (request.reference, request.moving)
    pairing.require_scale(requests, (reference, moving))
    radius = request.settings.search.radius or 10.0
    moving, notes = pairing.same_frame(requests, (reference, moving), radius)
    masks = read_masks(request.masks, {"reference": reference, "moving": moving})
    moving, crs_notes = common_crs(reference, moving)
    for note in (*notes, *crs_notes):
        LOG.warning("%s", note)
    result = self_test(
        reference,
        moving,
        request.settings,
        count=request.count,
        reference_mask=masks["reference"],
        moving_mask=masks["moving"],
        progress=progress,
        allow_same=request.allow_same,
    )
    return result.document()


def show(document: dict[str, Any], voice: Terminal) -> None:
    """Print a line per trial, their rms, and what this plot can resolve."""
    color = {"accepted": "green", "review": "yellow", "rejected": "red"}[document["verdict"]]
    verdict = f"[bold {color}]{document['verdict'].upper()}[/]"
    voice.say(f"the pair as it is: {verdict}: {escape(document['reason'])}")
    if not document["trials"]:
        voice.say("Nothing was put in: there is no registration to compare with.")
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("east", "north", "up [m]", "yaw [°]", "verdict"):
        table.add_column(name, justify="left" if name == "verdict" else "right")
    for name in ("error east", "north", "up [mm]", "yaw [°]"):
        table.add_column(name, justify="right")
    for trial in document["trials"]:
        table.add_row(
            *(f"{value:+.4f}" for value in (*trial["shift"], trial["yaw_degrees"])),
            trial["verdict"],
            *(_number(value, 1000.0, "+.2f") for value in trial["error"]),
            _number(trial["yaw_error_degrees"], 1.0, "+.4f"),
        )
    voice.out.print(table)
    rms, resolved = document["rms"], document["resolved"]
    voice.say(
        f"rms error: horizontal {_number(rms['horizontal'], 1000.0, '.2f')} mm, "
        f"up {_number(rms['up'], 1000.0, '.2f')} mm, yaw {_number(rms['yaw_degrees'], 1.0, '.4f')}°"
    )
    if document["lost"]:
        total = len(document["trials"])
        voice.say(f"[red]{document['lost']} of {total} shifts were not found again[/]")
    voice.say(
        "[bold]smallest shift that this plot can resolve (95 %):[/] "
        f"horizontal {_number(resolved['horizontal'], 1000.0, '.1f')} mm, "
        f"up {_number(resolved['up'], 1000.0, '.1f')} mm"
    )
    error = document["registration_error"]
    if error is not None:
        sigmas = " / ".join(f"{1000 * error[axis]:.1f}" for axis in "xyz")
        voice.say(f"with what has changed on the ground, 1 sigma east / north / up: {sigmas} mm")


def _number(value: float | None, times: float, form: str) -> str:
    return "–" if value is None or not math.isfinite(value) else format(times * value, form)
