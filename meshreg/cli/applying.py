"""`meshreg apply`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.markup import escape

from meshreg.cli.common import (
    NewFolder,
    SurveyRequest,
    named_files,
    new_folder,
    read,
    require_disk,
)
from meshreg.cli.console import Progress, Terminal, logging_to
from meshreg.cli.guard import Unfinished
from meshreg.errors import UsageError
from meshreg.records import Frame, PointCloud

if TYPE_CHECKING:
    from meshreg.records import Registration, Survey

MOVED = "moved.json"  # by which a folder that `apply` wrote is known


@dataclass(frozen=True)
class ApplyRequest:
    """Everything that `meshreg apply` was asked."""

    registration: Path
    survey: SurveyRequest
    out: Path
    overwrite: bool = False


def apply(request: ApplyRequest, voice: Terminal, unfinished: Unfinished) -> dict[str, Any]:
    """Move a further file of the moving survey by a registration that was found."""
    from meshreg.io import require_warpable, require_writable, rewrite_survey, unchanged
    from meshreg.io.files.atomic import as_output_error
    from meshreg.io.result.manifest import require_apart, survey_files
    from meshreg.io.result.record import read_registration, reference_stand_in, to_json

    registration = read_registration(request.registration)
    if registration.transform is None:
        raise UsageError(
            f"This registration was rejected ({registration.reason}); it moves nothing.",
            file=request.registration,
        )
    inputs = named_files((request.survey,), others=(request.registration,))
    new = NewFolder(request.out, request.overwrite, "apply", MOVED, inputs)
    with (
        new_folder(new, unfinished) as folder,
        logging_to(voice),
        Progress(voice) as progress,
    ):
        progress("read", 0.0)
        survey, notes = _read_like(request.survey, registration)
        require_apart(request.out, survey_files(survey))
        if registration.verdict == "review":
            notes.append("The registration is in review: this is its best hypothesis only.")
        stand_in = reference_stand_in(registration)
        require_writable(survey, stand_in)
        if registration.warp is not None:
            require_warpable(survey)
        require_disk(folder, survey)
        progress("write", 0.0)
        warp = registration.warp
        files = rewrite_survey(survey, registration.transform, folder, stand_in, warp=warp)
        unchanged(survey)
        document = {
            "schema": "meshreg.applied/1",
            "registration": str(request.registration),
            "verdict": registration.verdict,
            "survey": survey.name,
            "reference_from_moving": registration.transform.matrix.tolist(),
            "warped": warp is not None,
            "files": [str(request.out / path.relative_to(folder)) for path in files],
            "notes": [*survey.notes, *notes],
        }
        with as_output_error(request.out):
            (folder / MOVED).write_text(to_json(document), encoding="utf-8")
        progress("write", 1.0)
    for note in notes:
        voice.warn(note)
    return document


def _read_like(request: SurveyRequest, registration: Registration) -> tuple[Survey, list[str]]:
    """Read a further file of the moving survey; where it is placed as that one was, say so.

    A file without a shift of its own that lies off the registered survey by exactly the shift
    which that one had was exported in the same local coordinates.
    """
    from meshreg.io.frames.place import reframe

    survey = read(request)
    if not survey.scale_known:
        return _as_registered(survey, registration)
    crs = registration.moving.get("crs")
    if survey.crs is not None and crs is not None and survey.crs != crs:
        survey = reframe(survey, crs)
    bounds = np.asarray(registration.moving.get("bounds") or np.full((2, 3), np.nan), float)
    shift = np.asarray(registration.moving.get("shift") or np.zeros(3), float)
    if not np.isfinite(bounds).all() or _meets(survey.bounds, bounds):
        return survey, []
    unshifted = not any(source.frame.shift.any() for source in survey.source)
    if request.options.shift is None and shift.any() and unshifted:
        said = (float(shift[0]), float(shift[1]), float(shift[2]))
        options = dataclasses.replace(request.options, shift=said)
        shifted = read(dataclasses.replace(request, options=options))
        if _meets(shifted.bounds, bounds):
            text = ", ".join(f"{value:.12g}" for value in said)
            return shifted, [f"The registered survey's shift ({text}) was added to it."]
    return survey, [
        f"{survey.name!r} lies wholly outside the survey that was registered: is it the same "
        "survey, and is its shift right (--shift)?"
    ]


def _as_registered(survey: Survey, registration: Registration) -> tuple[Survey, list[str]]:
    """Lay a model of unknown scale as it was laid when it was registered.

    Raises
    ------
    UsageError
        It is another model: nothing says how the frames of the two lie to each other.
    """
    from meshreg.io.frames.mover import to_absolute, to_file

    said = registration.moving
    if survey.source[0].sha256 not in (said.get("sha256") or ()) or said.get("axes") is None:
        raise UsageError(
            f"The scale and the frame of {survey.name!r} are arbitrary, and it is not the model "
            "that was registered.",
            remedy="Register it itself, or give the file of that model.",
        )
    geometry, was = survey.geometry, survey.source[0].frame
    assert isinstance(geometry, PointCloud)  # a COLMAP model, the only kind without a scale
    frame = Frame(said["axes"], said["shift"], said.get("file_crs"), said.get("file_crs"))
    points = to_absolute(frame, to_file(was, geometry.points + survey.origin))
    origin = np.round(points.mean(axis=0))
    return (
        dataclasses.replace(
            survey,
            geometry=dataclasses.replace(geometry, points=points - origin),
            origin=origin,
            crs=said.get("crs"),
            source=(dataclasses.replace(survey.source[0], frame=frame),),
        ),
        ["Its scale and place are those that it had when it was registered."],
    )


def _meets(bounds: Any, other: Any) -> bool:
    """Whether two boxes share ground, east and north."""
    return bool((bounds[0, :2] <= other[1, :2]).all() and (other[0, :2] <= bounds[1, :2]).all())


def show_applied(document: dict[str, Any], voice: Terminal) -> None:
    """Print what `apply` wrote."""
    for name in document["files"]:
        voice.say(escape(name))
