"""What the jobs of the command line share: surveys as named, new folders, masks, limits."""

from __future__ import annotations

import glob
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from meshreg.errors import OutputError, ResourceLimitError, UsageError

if TYPE_CHECKING:
    from meshreg.cli.guard import Unfinished
    from meshreg.io.options import ReadOptions
    from meshreg.records import Survey

LOG = logging.getLogger("meshreg")
Mask = Callable[[Any], Any]
_ROOM = 200e6  # bytes wanted on the disk beside the copies of the moving survey's files


@dataclass(frozen=True)
class SurveyRequest:
    """A survey as the user names it, with what they say about it."""

    path: str
    options: ReadOptions
    called: str = ""  # in the log, where the path is a passing one

    @property
    def name(self) -> str:
        """What the log calls it."""
        return self.called or self.path


@dataclass(frozen=True)
class NewFolder:
    """A folder to be made for a command's result.

    Attributes
    ----------
    out : Path
    overwrite : bool
    command : str
        For the manifest.
    marker : str
        The file by which a former result of the command is known.
    inputs : tuple of path
        Files and folders that the command line names; none of them may lie in `out`.
    """

    out: Path
    overwrite: bool
    command: str
    marker: str
    inputs: tuple[str | Path, ...] = ()


@contextmanager
def new_folder(new: NewFolder, unfinished: Unfinished) -> Iterator[Path]:
    """Give a temporary folder that becomes `new.out` when the block ends well.

    That the folder can be written and the disk is not full is found out here, before the work.
    """
    from meshreg.io.files.atomic import as_output_error
    from meshreg.io.result.folders import atomic_folder
    from meshreg.io.result.manifest import require_apart

    with as_output_error(new.out):
        require_apart(new.out, new.inputs)
        new.out.absolute().parent.mkdir(parents=True, exist_ok=True)
    made = None
    try:
        with (
            atomic_folder(new.out, new.overwrite, (new.marker,), new.command) as folder,
            unfinished.holding(folder),
        ):
            made = folder.stat().st_ino
            yield folder
    except BaseException as error:
        with suppress(OSError):
            if made is not None and new.out.stat().st_ino == made:  # stopped after the last step
                error.add_note("the result was complete already.")
        raise


@contextmanager
def in_place() -> Iterator[None]:
    """Let what stops the block say that some files of a result may be new by then."""
    try:
        yield
    except BaseException as error:
        error.add_note("some files may be new already, each of them whole.")
        raise


def named_files(
    surveys: Sequence[SurveyRequest],
    masks: Sequence[str] = (),
    tables: str | None = None,
    others: Sequence[Path | None] = (),
) -> tuple[Path, ...]:
    """Return the files and folders that a command line names; patterns are looked up.

    Parameters
    ----------
    surveys : sequence of SurveyRequest
    masks : sequence of str
        As in `read_masks`.
    tables : str, optional
        Tie points: one file, or two with a comma between.
    others : sequence of path or None
    """
    found = [path for path in others if path is not None]
    found += [r.options.positions for r in surveys if r.options.positions is not None]
    from meshreg.io.finding import split_pair

    for text in (*(r.path for r in surveys), *(_mask(m)[2] for m in masks), tables):
        if text is None:
            continue
        if os.path.lexists(text):
            found.append(Path(text))
        elif here := [Path(name) for name in glob.glob(text, recursive=True)]:
            found += here
        else:
            found += split_pair(text)
    return tuple(found)


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
    LOG.info("%s: %s from %s", name or "survey", survey.name, request.name)
    for note in survey.notes:
        LOG.info("%s: %s", survey.name, note)
    return survey


def read_masks(said: Sequence[str], surveys: Mapping[str, Survey]) -> dict[str, Mask | None]:
    """Read the masks of each survey, written `[reference:|moving:][not:]FILE`.

    A mask holds for the reference unless it says `moving:`: at the right offset that is enough,
    because only ground that both surveys show is compared. `not:` leaves out what is inside. Its
    coordinates are those of the survey that it holds for, as that came (before it was taken to the
    reference's CRS).
    """
    from meshreg.io.masks.read import read_mask

    found: dict[str, list[Callable[[Any], Any]]] = {"reference": [], "moving": []}
    for text in said:
        which, invert, name = _mask(text)
        if which not in surveys:
            raise UsageError(f"--mask {text!r}: there is no {which} survey here.")
        here, common = surveys[which], surveys["reference"].crs
        mask = read_mask(name, invert, here.crs or common, here)
        if common is not None and mask.crs not in (None, common):
            mask = mask.to(common)
        found[which].append(mask)
        LOG.info("mask of the %s: %s%s", which, "all but " if invert else "", name)
    return {which: _every(masks) for which, masks in found.items()}


def _mask(text: str) -> tuple[str, bool, str]:
    """Split `[reference:|moving:][not:]FILE` into survey, whether it is inverted, and file."""
    which, name, invert = "reference", text, False
    while (parts := name.partition(":"))[0] in ("reference", "moving", "not") and parts[2]:
        if parts[0] == "not":
            invert = not invert
        else:
            which = parts[0]
        name = parts[2]
    return which, invert, name


@dataclass(frozen=True)
class _EveryMask:
    """Uses what all of several masks use."""

    masks: tuple[Any, ...]

    def __call__(self, grid: Any) -> Any:
        return np.logical_and.reduce([mask(grid) for mask in self.masks])

    def at(self, east: Any, north: Any) -> Any:
        """Return which places are used, as `meshreg.io.masks.Mask.at`."""
        return np.logical_and.reduce([mask.at(east, north) for mask in self.masks])


def _every(masks: list[Callable[[Any], Any]]) -> Mask | None:
    """Return the mask that uses what all of them use; None where there is none."""
    if len(masks) < 2:
        return masks[0] if masks else None
    return _EveryMask(tuple(masks))


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
