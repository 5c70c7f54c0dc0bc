"""`meshreg demo`: the main job on a reef that is made on the spot, or on two real beaches."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from meshreg.cli.common import NewFolder, SurveyRequest, new_folder
from meshreg.cli.console import Progress, Terminal, logging_to
from meshreg.cli.guard import Unfinished
from meshreg.cli.registering import RegisterRequest, register, register_into
from meshreg.settings import Settings

if TYPE_CHECKING:
    from meshreg.records import Registration

BEACH = Path(__file__).parent.parent / "demo_data"
SCENARIO, SIZE = "abrolhos_12mo", 12.0  # m; a patch that is made and registered within a minute
NAMES = ("reference", "moving")


@dataclass(frozen=True)
class Demonstration:
    """A registration, and how far it is from the truth where that is known.

    Attributes
    ----------
    registration : Registration
    true : tuple of float, optional
        Offset east, north, up [m] at the overlap's centroid, and the turn [degrees].
    found : tuple of float, optional
        The same as registered; None too where the registration was rejected.
    """

    registration: Registration
    true: tuple[float, ...] | None = None
    found: tuple[float, ...] | None = None

    @property
    def errors(self) -> tuple[float, ...] | None:
        """Found less true, east, north, up [m], turn [degrees]."""
        if self.true is None or self.found is None:
            return None
        return tuple(f - t for f, t in zip(self.found, self.true, strict=True))


def real(out: Path, overwrite: bool, voice: Terminal, unfinished: Unfinished) -> Demonstration:
    """Register the pair of surveys that the package carries."""
    from meshreg.io.options import ReadOptions

    reference, moving = (
        SurveyRequest(str(BEACH / f"beach_{year}.obj"), ReadOptions()) for year in (2018, 2019)
    )
    settings = Settings().changed({"search.radius": 20.0})
    request = RegisterRequest(reference, moving, out, settings=settings, overwrite=overwrite)
    return Demonstration(register(request, voice, unfinished))


def made(out: Path, overwrite: bool, voice: Terminal, unfinished: Unfinished) -> Demonstration:
    """Make two surveys of a reef in OUT/surveys, register them in OUT, compare with the truth."""
    from data_synth.make import write_pair
    from data_synth.recipe import load
    from meshreg.io.options import ReadOptions

    with (
        new_folder(NewFolder(out, overwrite, "demo", "registration.json"), unfinished) as folder,
        logging_to(voice, folder / "log.txt"),
        Progress(voice) as progress,
    ):
        surveys = folder / "surveys"
        write_pair(load(SCENARIO), surveys, size=SIZE, format="obj", progress=progress)
        reference, moving = (
            SurveyRequest(str(surveys / f"{n}.obj"), ReadOptions(), f"surveys/{n}.obj")
            for n in NAMES
        )
        registration = register_into(folder, RegisterRequest(reference, moving, out), progress)
        truth = json.loads((surveys / "truth.json").read_text(encoding="utf-8"))
    return compared(registration, truth)


def compared(registration: Registration, truth: Mapping[str, Any]) -> Demonstration:
    """Read the true and the found offset at the centroid of the true overlap."""
    centroid = np.array(truth["centroid"])

    def at_centroid(matrix: Any) -> tuple[float, ...]:
        moved = matrix[:3, :3] @ centroid + matrix[:3, 3] - centroid
        return *moved.tolist(), math.degrees(math.atan2(matrix[1, 0], matrix[0, 0]))

    true = at_centroid(np.array(truth["reference_from_moving"]))
    transform = registration.transform
    found = None if transform is None else at_centroid(transform.matrix)
    return Demonstration(registration, true, found)


def introduce(real_pair: bool, voice: Terminal) -> None:
    """Say what is going to be registered."""
    if real_pair:
        voice.say("Two drone surveys of one beach, eight months apart; the later one was moved on")
        voice.say("purpose. To find: about +13.4 m east, -8.7 m north, +1.25 m up, within 2 m.")
    else:
        voice.say(f"A coral reef of {SIZE:g} x {SIZE:g} m, made with known truth: two surveys as")
        voice.say("textured meshes, twelve months and a mass bleaching apart.")


def document(done: Demonstration) -> dict[str, Any]:
    """Return the registration as `meshreg register --json` does, the errors among its notes."""
    from meshreg.io.result.document import registration_document

    registration = done.registration
    if done.errors is not None:
        notes = (*registration.notes, f"Against the truth: {_said(done.errors)}.")
        registration = dataclasses.replace(registration, notes=notes)
    return registration_document(registration)


def show(done: Demonstration, out: Path, voice: Terminal) -> None:
    """Print the result, how far it is from the truth, and where the pictures are."""
    from meshreg.cli import result

    result.show(done.registration, out, voice)
    if done.true is not None and done.found is not None and done.errors is not None:
        table = Table(title="against the truth", title_justify="left", title_style="bold")
        for column in ("at the overlap's centroid", "true", "found", "error"):
            table.add_column(column, justify="left" if column.startswith("at") else "right")
        names, forms = ("east [m]", "north [m]", "up [m]", "yaw [°]"), "+.4f"
        rows = zip(names, done.true, done.found, done.errors, strict=True)
        for name, *values in rows:
            table.add_row(escape(name), *(format(value, forms) for value in values))
        voice.out.print(table)
        voice.say(f"[bold]Error:[/] {_said(done.errors)}")
    voice.say(f"Figures: [bold]{escape(str(out / 'figures'))}[/]")


def _said(errors: tuple[float, ...]) -> str:
    east, north, up, yaw = errors
    return f"{math.hypot(east, north):.4f} m horizontally, {up:+.4f} m vertically, {yaw:+.4f}° yaw"
