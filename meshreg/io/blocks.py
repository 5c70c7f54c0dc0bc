"""Read and rewrite the files of a survey one by one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io import READERS, REWRITERS, load
from meshreg.io.finding import Block, find_blocks
from meshreg.io.frames import make_mover, registered_frame, to_file
from meshreg.io.mover import is_plain
from meshreg.io.options import ReadOptions
from meshreg.io.safe import fingerprint, sha256
from meshreg.io.sidecar import write_shift
from meshreg.types import SourceFile, Survey, Transform, Warp

__all__ = ["Block", "find_blocks", "read_block", "require_warpable", "rewrite"]


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
        if source.format in ("glb", "gltf", "colmap"):
            kind = "COLMAP models are" if source.format == "colmap" else "glTF files are"
            raise UsageError(
                f"cannot be warped: {kind} moved as a whole.",
                file=source.path,
                remedy="Export the survey as .obj, .ply or .laz, or register with --warp none.",
            )


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
    centre = transform.apply(survey.centre)
    home = reference.source[0] if reference is not None and reference.source else None
    written: list[Path] = []
    taken: set[str] = set()
    for source in survey.source:
        target = registered_frame(home or source, source, centre=centre)
        start = source.frame
        if start.crs is not None and survey.crs is not None and start.crs != survey.crs:
            start = replace(start, crs=survey.crs)
        local = to_file(start, survey.centre[None])[0]
        mover = make_mover(source, transform, target, centre=local, warp=warp)
        path = folder / _free_name(source.path, suffix, taken)
        written += load(REWRITERS[source.format])(source, mover, path)
        if source.format != "maps":
            in_file = source.format == "e57" or (source.format == "las" and is_plain(target))
            written += write_shift(path, target, carries_crs=in_file)
    return tuple(dict.fromkeys(written))


def _free_name(path: Path, suffix: str, taken: set[str]) -> str:
    """Return a name for the moved file that no earlier block has."""
    copc = path.name.lower().endswith(".copc.laz")  # its index does not survive; it becomes LAZ
    stem, end = (path.name[: -len(".copc.laz")], ".laz") if copc else (path.stem, path.suffix)
    name = f"{stem}{suffix}{end}"
    for number in range(2, len(taken) + 3):
        if name.lower() not in taken:
            break
        name = f"{stem}{suffix}_{number}{end}"
    taken.add(name.lower())
    return name
