"""Names of the files that a moved survey is written to, all known before the first is written."""

from __future__ import annotations

import os
import re
import unicodedata
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from meshreg.io.files.atomic import short_name
from meshreg.io.files.safe import sha256
from meshreg.records import SourceFile, Survey

_LONGEST = 255  # bytes of a name, in every usual file system
_ROOM = 40  # of them kept for "_registered", a number, a side file's suffix
# What a result or a moved file's folder holds besides; a texture page must not be taken for it.
_OURS = re.compile(
    r"(?i)registration\.json|moved\.json|transform\w*\.txt|(reference|moving)_(dem|ortho)\.tif"
    r"|report\.html|evidence\.npz|settings\.toml|log\.txt|manifest\S*|figures(/.*)?"
)


@dataclass(frozen=True)
class Planned:
    """A file to be written: `source` knows the names of its companions' copies."""

    source: SourceFile
    name: str


def planned(survey: Survey, suffix: str) -> tuple[Planned, ...]:
    """Return the name of every moved file; no two files of other content have one name.

    A moved file is called as the source with `suffix`, and a number where an earlier block has
    that name. Texture pages and material files keep their names; of two that would meet, the
    later's block has them called after its survey file, and what refers to them is rewritten.
    """
    plan = []
    taken: set[str] = set()
    copies: dict[str, Path] = {}  # folded name of a copy -> whose copy it is
    names: dict[Path, PurePosixPath] = {}  # of each companion's copy
    for source in survey.source:
        name = _free_name(source.path, suffix, taken)
        renamed: dict[Path, str] = {}
        folder = source.path.parent
        # a DEM is no companion that is copied with its orthomosaic, nor are a model's parts
        copied = () if source.format in ("maps", "colmap") else source.companions
        inside = [file for file in copied if file.is_relative_to(folder)]
        # material files last: one that names a renamed page is a file of its own
        for last in (False, True):
            group = [file for file in inside if (file.suffix.lower() == ".mtl") == last]
            new = [file for file in dict.fromkeys(group) if file not in names]
            alone = last and bool(renamed)
            for number in range(len(copies) + 3):
                targets = {file: _target(file.relative_to(folder), name, number) for file in new}
                # all or none of them: the pages of one material may be told by their number only
                if all(_may_be(target, file, copies, alone) for file, target in targets.items()):
                    break
            names |= targets
            copies |= {_folded(target): file for file, target in targets.items()}
            for file in group:
                if names[file] != PurePosixPath(file.relative_to(folder).as_posix()):
                    renamed[file] = str(names[file])
        plan.append(Planned(replace(source, copies=renamed), name))
    return tuple(plan)


def _target(place: Path, name: str, number: int) -> PurePosixPath:
    """Return where a companion's copy goes: its own place, or one with the survey file's name."""
    here = PurePosixPath(place.as_posix())
    if number == 0:
        return here
    stem = re.sub(r"[^A-Za-z0-9.-]+", "_", short_name(Path(name).stem, 60))
    more = f"_{number}" if number > 1 else ""
    return here.with_name(f"{stem}{more}_{here.name}")


def _may_be(target: PurePosixPath, companion: Path, copies: dict[str, Path], alone: bool) -> bool:
    """Whether a copy may go to `target`: nothing else goes there, or (not `alone`) equal bytes."""
    if _OURS.fullmatch(str(target)):
        return False
    other = copies.get(_folded(target))
    if other is None or other == companion:
        return True
    if alone or other.stat().st_size != companion.stat().st_size:
        return False
    return sha256(other) == sha256(companion)


def _folded(path: PurePosixPath | str) -> str:
    """Return a name as file systems that fold letter case and normal form see it."""
    return unicodedata.normalize("NFC", str(path)).casefold()


def _free_name(path: Path, suffix: str, taken: set[str]) -> str:
    """Return a name for the moved file whose stem, side files' too, no earlier block has."""
    copc = path.name.lower().endswith(".copc.laz")  # its index does not survive; it becomes LAZ
    stem, end = (path.name[: -len(".copc.laz")], ".laz") if copc else (path.stem, path.suffix)
    room = _LONGEST - _ROOM - len(os.fsencode(suffix)) - len(os.fsencode(end))
    stem = short_name(stem, room)
    found = f"{stem}{suffix}"
    for number in range(2, len(taken) + 3):
        if _folded(found) not in taken:
            break
        found = f"{stem}{suffix}_{number}"
    taken.add(_folded(found))
    return found + end
