"""Read and rewrite the files of a survey one by one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.files.naming import Planned, planned
from meshreg.io.files.safe import data_errors, fingerprint, sha256
from meshreg.io.finding import Block, find_blocks
from meshreg.io.formats import BY_KEY, READERS, load
from meshreg.io.frames.mover import Mover, is_plain
from meshreg.io.frames.place import make_mover, registered_frame, to_file
from meshreg.io.frames.sidecar import write_metadata, write_shift
from meshreg.io.options import ReadOptions
from meshreg.records import Float64, Frame, SourceFile, Survey, Transform, Warp

__all__ = ["Block", "find_blocks", "read_block", "require_warpable", "require_writable", "rewrite"]


def read_block(block: Block, options: ReadOptions) -> Survey:
    """Read one block; record its files' checksums and make sure that none changed meanwhile."""
    for name in ("scale", "positions") if block.reader != READERS[""] else ():
        if getattr(options, name) is not None:
            raise UsageError(
                f"{name} is for COLMAP models.",
                file=block.path,
                remedy="Give the unit, as a name or as its length in metres."
                if name == "scale"
                else None,
            )
    is_file = block.path.is_file()
    before = fingerprint(block.path) if is_file else None
    with data_errors(block.path):
        survey = cast(Survey, load(block.reader)(block.maps or block.path, options))
    if block.note:
        survey = replace(survey, notes=(block.note, *survey.notes))
    if is_file and fingerprint(block.path) != before:
        raise InputError("changed while it was read.", file=block.path, remedy="Read it again.")
    return replace(survey, source=tuple(_recorded(source) for source in survey.source))


def _recorded(source: SourceFile) -> SourceFile:
    if not source.path.is_file() or (source.sha256 and source.fingerprint != (0, 0)):
        return source
    mark = fingerprint(source.path, source.companions)
    return replace(source, sha256=sha256(source.path), fingerprint=mark)


def require_warpable(survey: Survey) -> None:
    """Do `meshreg.io.require_warpable`."""
    for source in survey.source:
        if whole := BY_KEY[source.format].whole:
            raise UsageError(
                f"cannot be warped: {whole} moved as a whole.",
                file=source.path,
                remedy="Export the survey as .obj, .ply or .laz, or register with --warp none.",
            )


def require_writable(survey: Survey, reference: Survey | None = None) -> None:
    """Do `meshreg.io.require_writable`."""
    for plan, mover in _plans(survey, Transform(), reference, "_registered"):
        if entry := BY_KEY[plan.source.format].require_writable:
            load(entry)(plan.source, mover, _sample(survey, plan.source))


def _sample(survey: Survey, source: SourceFile) -> Float64:
    """Return some of a survey's points (N, 3) in a file's own coordinates."""
    points = getattr(survey.geometry, "points", np.empty((0, 3)))
    some = points[:: max(1, len(points) // 1000)] + survey.origin
    return to_file(_frame_of(source, survey), some) if len(some) else some


def _frame_of(source: SourceFile, survey: Survey) -> Frame:
    """Return a file's frame, leading to the CRS that its survey was taken to."""
    start = source.frame
    if start.crs is not None and survey.crs is not None and start.crs != survey.crs:
        return replace(start, crs=survey.crs)
    return start


def _plans(
    survey: Survey,
    transform: Transform,
    reference: Survey | None,
    suffix: str,
    warp: Warp | None = None,
) -> Iterator[tuple[Planned, Mover]]:
    """Give every file's source and new name with what moves it to its new frame."""
    centre = transform.apply(survey.centre)
    home = reference.source[0] if reference is not None and reference.source else None
    for plan in planned(survey, suffix):
        source = plan.source
        target = registered_frame(home or source, source, centre=centre)
        local = to_file(_frame_of(source, survey), survey.centre[None])[0]
        yield plan, make_mover(source, transform, target, centre=local, warp=warp)


def rewrite(
    survey: Survey,
    transform: Transform,
    folder: Path,
    reference: Survey | None,
    suffix: str,
    warp: Warp | None = None,
) -> tuple[Path, ...]:
    """Do `meshreg.io.rewrite_survey`."""
    if warp is not None:
        require_warpable(survey)
    if not survey.source:
        raise UsageError(f"survey {survey.name!r} was made in memory; it has no files to rewrite.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot be made: {error.strerror}.", file=folder) from error
    written: list[Path] = []
    for plan, mover in _plans(survey, transform, reference, suffix, warp):
        source, target = plan.source, mover.frame
        path = folder / plan.name
        with data_errors(source.path):
            written += load(BY_KEY[source.format].rewrite)(source, mover, path)
        if source.format != "maps":
            in_file = source.format == "e57" or (source.format == "las" and is_plain(target))
            written += write_shift(path, target, carries_crs=in_file)
            if source.sidecar is not None and source.sidecar.name == "metadata.xml":
                written += write_metadata(path, target)
    return tuple(dict.fromkeys(written))
