"""READ and WRITE: the only place that opens a survey file.

A format is a folder with a `Format`; `formats` is the table of them all.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from meshreg.errors import InputError, UsageError
from meshreg.io.formats import FORMATS, READERS, WRITERS, load
from meshreg.io.options import ReadOptions

if TYPE_CHECKING:
    from meshreg.io.result.record import read_registration as read_registration
    from meshreg.io.result.record import write_registration as write_registration
    from meshreg.records import Survey, Transform, Warp


def __getattr__(name: str) -> Any:
    if name in ("read_registration", "write_registration"):
        return getattr(importlib.import_module("meshreg.io.result.record"), name)
    raise AttributeError(f"module 'meshreg.io' has no attribute {name!r}")


def read_survey(
    path: str | Path | Sequence[str | Path],
    options: ReadOptions | None = None,
    **overrides: Any,
) -> Survey:
    """Read one survey: a mesh, a point cloud, or a DEM with its orthomosaic.

    Parameters
    ----------
    path : path, glob or sequence of paths
        A file; a folder with files of one format (or, where it has none, with folders of tiles
        that do), or a COLMAP model folder; a glob ("site/*.las"); a list; "dem.tif,ortho.tif".
        Several files are blocks of one survey and are merged.
    options : ReadOptions, optional
        What the files do not say themselves: shift, axes, up, unit, CRS.
    **overrides
        Single fields of `ReadOptions`, e.g. ``shift=(731000, 5705000, 0)``.

    Returns
    -------
    Survey
        Metres, x east, y north, z up; `source` names each file with its frame and checksum,
        `notes` says what was dropped, repaired or guessed. A cloud has one point to a place
        (`meshreg.io.unique`); its files keep theirs.

    Raises
    ------
    InputError
        A missing, empty, damaged or unknown file; a folder of several formats; blocks that do not
        fit together.
    UnsafeReferenceError
        A file that refers to something outside its folder.
    ResourceLimitError
        A texture page over `max_pixels`.
    UsageError
        An unknown option, or a value out of its range.
    """
    from meshreg.io import blocks, merging
    from meshreg.io.unique import without_repeats

    options = options or ReadOptions()
    known = {item.name for item in dataclasses.fields(ReadOptions)}
    if unknown := sorted(overrides.keys() - known):
        raise UsageError(f"unknown option {unknown[0]!r}.", remedy=f"There are {sorted(known)}.")
    options = dataclasses.replace(options, **overrides).checked()
    found = blocks.find_blocks(path)
    surveys = [blocks.read_block(block, options) for block in found]
    if len(found) > 1 and found[0].below:
        merging.require_apart(surveys, path)
    survey = surveys[0] if len(surveys) == 1 else merging.merge(surveys, path)
    _require_near(survey)
    return without_repeats(survey)


def _require_near(survey: Survey) -> None:
    """Refuse coordinates beyond measure, whichever reader they came through."""
    import numpy as np

    from meshreg.io.files.safe import FARTHEST

    farthest = float(np.abs(survey.bounds).max())
    if not farthest < FARTHEST:  # NaN too
        raise InputError(
            f"has coordinates of up to {farthest:.3g} m; {FARTHEST:g} is the limit.",
            file=survey.source[0].path if survey.source else None,
            remedy="Check its unit, shift and camera positions, or export it again.",
        )


def write_survey(survey: Survey, path: str | Path) -> tuple[Path, ...]:
    """Write a survey from memory to a new file; its suffix chooses the format.

    Returns
    -------
    tuple of Path
        All files written: the survey, its textures, its shift sidecar.

    Raises
    ------
    UsageError
        A suffix that is not written, or a geometry that the format cannot hold.
    OutputError
        The file could not be written; what was there before is intact.
    """
    path = Path(path)
    entry = WRITERS.get(path.suffix.lower())
    if entry is None:
        raise UsageError(
            f"{path.name!r}: surveys are not written as {path.suffix or 'a file without suffix'}.",
            remedy=f"Use one of {', '.join(WRITERS)}.",
        )
    files: tuple[Path, ...] = load(entry)(survey, path)
    return files


def rewrite_survey(
    survey: Survey,
    transform: Transform,
    folder: str | Path,
    reference: Survey | None = None,
    stem_suffix: str = "_registered",
    warp: Warp | None = None,
) -> tuple[Path, ...]:
    """Move every file of a survey, each in its own format, into the reference's coordinates.

    Parameters
    ----------
    survey : Survey
        The moving survey, as read from files.
    transform : Transform
        `reference_from_moving`, absolute.
    folder : path
        Where the files go, under their names with `stem_suffix`; made where missing.
    reference : Survey, optional
        Its first file's axes, shift and CRS are what the files are written in; without it they
        keep their own.
    stem_suffix : str
    warp : Warp, optional
        The bend that follows the transform.

    Returns
    -------
    tuple of Path
        All files written, textures and shift sidecars included.

    Raises
    ------
    UsageError
        The survey has no files, or a warp cannot be written in their format.
    OutputError
        A file could not be written, or did not read back as it should.
    InputError
        A source file has changed or gone since it was read.
    """
    from meshreg.io import blocks

    return blocks.rewrite(survey, transform, Path(folder), reference, stem_suffix, warp)


def require_warpable(survey: Survey) -> None:
    """Make sure that a warp can be written in the survey's formats.

    Raises
    ------
    UsageError
        A file's format moves as a whole only.
    """
    from meshreg.io import blocks

    blocks.require_warpable(survey)


def require_writable(survey: Survey, reference: Survey | None = None) -> None:
    """Make sure that a survey's files can be written in the reference's coordinates.

    It is asked before the work, so that nothing is refused at the end that could be refused at
    the start. Room on the disk is not looked at.

    Parameters
    ----------
    survey : Survey
        The moving survey, as read from files, in the reference's CRS.
    reference : Survey, optional
        As for `rewrite_survey`.

    Raises
    ------
    InputError
        A file whose content, or whose way to the other CRS, cannot be written in its format.
    """
    from meshreg.io import blocks

    blocks.require_writable(survey, reference)


def unchanged(survey: Survey) -> None:
    """Make sure that a survey's files, and those they refer to, are still those that were read.

    Raises
    ------
    InputError
        A file is gone, or sizes or times of change differ, and so does the checksum of a file
        that stands alone.
    """
    from meshreg.io.files.safe import fingerprint, sha256

    for source in survey.source:
        if not source.sha256:
            continue
        for path in (source.path, *source.companions):
            if not path.exists():
                raise InputError("has gone since it was read.", file=path)
        if fingerprint(source.path, source.companions) == source.fingerprint:
            continue
        if source.companions or sha256(source.path) != source.sha256:
            what = "it, or a file that it names, " if source.companions else ""
            raise InputError(
                f"{what}has changed since it was read.",
                file=source.path,
                remedy="Run again when nothing writes to it.",
            )


def same_files(reference: Survey, moving: Survey) -> str | None:
    """Return a warning where both surveys came from the same bytes, else None."""
    known = {source.sha256: source.path for source in reference.source if source.sha256}
    for source in moving.source:
        if source.sha256 in known:
            return (
                f"{known[source.sha256].name} and {source.path.name} are the same file: "
                "any offset found is zero by construction."
            )
    return None


__all__ = [
    "FORMATS",
    "READERS",
    "WRITERS",
    "ReadOptions",
    "load",
    "read_registration",
    "read_survey",
    "require_warpable",
    "require_writable",
    "rewrite_survey",
    "same_files",
    "unchanged",
    "write_registration",
    "write_survey",
]
