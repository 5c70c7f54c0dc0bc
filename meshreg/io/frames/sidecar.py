"""Small files beside a survey that say where it is, of every program that is known.

Exports are often moved near zero and the shift kept in a second file. Every known kind is looked
for; two that disagree are refused, because the wrong one would move the survey by kilometres.
What is recognized but not read is named in a note. The list is in docs/georeference.md.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from meshreg.errors import InputError
from meshreg.io.files.safe import beside, require_inside
from meshreg.io.frames import sidecar_readers as readers
from meshreg.io.frames.sidecar_readers import SidecarInfo, join
from meshreg.io.frames.sidecar_write import write_metadata, write_shift
from meshreg.io.options import ReadOptions

__all__ = ["SidecarInfo", "find_sidecar", "is_sidecar", "join", "write_metadata", "write_shift"]

_ODM_FOLDER = "odm_georeferencing"
_ODM_NAMES = ("coords.txt", "odm_georeferencing_model_geo.txt")
_SHIFT_NAMES = ("SHIFT.txt", "shift.txt", "Shift.txt")
_OFFSET_END = "_offset.xyz"


def find_sidecar(
    path: Path,
    *,
    shared: bool = True,
    own: SidecarInfo | None = None,
    given: ReadOptions | None = None,
    again: bool = False,
) -> SidecarInfo | None:
    """Read all sidecars of one survey file and join them.

    Parameters
    ----------
    path : Path
        The survey file; it need not exist.
    shared : bool
        Also read files that speak for a whole folder (offset.xyz, coords.txt, SHIFT.txt,
        metadata.xml). Formats that state absolute coordinates themselves are not meant by those.
    own : SidecarInfo, optional
        What the survey file says itself; the sidecars must not contradict it.
    given : ReadOptions, optional
        What the user says: of that, contradicting sidecars do not matter.
    again : bool
        They were read and compared before; of two that disagree the first counts.

    Returns
    -------
    SidecarInfo or None
        None where there is no sidecar.

    Raises
    ------
    InputError
        A sidecar that is malformed (with its line), or two that disagree (naming both).
    """
    path = Path(path)
    joined = own or SidecarInfo()
    settled = readers.KEYS if again else _settled(given)
    for folder, name, reader in _candidates(path, shared):
        candidate = beside(folder, name) if name != path.name else None
        said = None if candidate is None else reader(candidate)
        if said is not None:
            joined = join(joined, said, settled)
    return joined if joined.path is not None or joined.notes else None


def _settled(given: ReadOptions | None) -> frozenset[str]:
    """Return what the user has said, so that no file need agree on it."""
    if given is None:
        return frozenset()
    keys = {key for key in ("shift", "crs", "unit") if getattr(given, key) is not None}
    if given.axes is not None or given.up is not None:
        keys |= {"axes", "up"}
    return frozenset(keys)


def is_sidecar(path: Path) -> bool:
    """Whether a file is known as a sidecar by its name, and for .xyz and .txt by its content."""
    name = path.name.lower()
    if name.endswith((".survey.toml", ".prj")):
        return True
    if name in (*_ODM_NAMES, "proj.txt", "shift.txt", "offset.txt"):
        return True
    if name == "offset.xyz" or name.endswith(_OFFSET_END):
        try:
            require_inside(path, path.parent)
            return readers.read_offset(path) is not None
        except InputError:
            return False
    return False


def _candidates(path: Path, shared: bool) -> Iterator[tuple[Path, str, Any]]:
    """Give the folder and the name of each side file that may be there, and what reads it."""
    folder, stem = path.parent, path.stem
    if path.name.lower().endswith(".copc.laz"):
        stem = path.name[: -len(".copc.laz")]
    for name in dict.fromkeys((stem, path.stem)):
        yield folder, f"{name}.survey.toml", readers.read_toml
        yield folder, f"{name}{_OFFSET_END}", readers.read_offset
        yield folder, f"{name}.prj", readers.read_prj
        yield folder, f"{name}_wkt.prj", readers.read_prj
    for name in dict.fromkeys((stem, path.name)):
        for suffix in (".rcInfo", ".rcinfo", ".rsInfo", ".rsinfo"):
            yield folder, f"{name}{suffix}", readers.tell_realityscan
    if not shared:
        return
    yield from _of_a_project(folder, stem)
    yield folder, "offset.xyz", readers.read_offset
    yield folder, "offset.txt", readers.read_offset_txt
    for name in _SHIFT_NAMES:
        if os.path.isfile(folder / name):
            yield folder, name, readers.read_shift_txt
            break
    for name in _ODM_NAMES:
        yield folder, name, readers.read_coords
    # OpenDroneMap keeps it apart: odm_texturing/odm_textured_model_geo.obj is what it speaks of.
    for place in (folder.absolute().parent, folder):
        if place == folder or (folder.name.startswith("odm_texturing") and stem.endswith("_geo")):
            for name in _ODM_NAMES:
                yield place, f"{_ODM_FOLDER}/{name}", readers.read_coords
    yield folder, "metadata.xml", readers.read_metadata
    # ContextCapture's Data/Tile_1/Tile_1.obj is spoken of two folders up.
    whole = folder.absolute()
    above = list(whole.parents)[:2]
    for place, meant in zip(
        above,
        (whole.name in ("Data", stem) or stem.startswith(whole.name), whole.parent.name == "Data"),
        strict=False,
    ):
        reader = readers.read_metadata if meant else readers.tell_metadata
        yield place, "metadata.xml", reader
    yield folder, "tileset.json", readers.tell_tileset
    yield folder, "reference_lla.json", readers.tell_opensfm


def _of_a_project(folder: Path, stem: str) -> Iterator[tuple[Path, str, Any]]:
    """Give Pix4D's files, which are called after the project: site for site_simplified_3d_mesh."""
    names = _offset_names(folder)
    fits = [name for name in names if stem.startswith(name + "_") and name + "_offset" != stem]
    if fits and stem not in names:
        name = max(fits, key=len)
        yield folder, f"{name}{_OFFSET_END}", readers.read_offset
        yield folder, f"{name}_wkt.prj", readers.read_prj
    project = list(folder.absolute().parents)[:2]
    if len(project) == 2 and folder.absolute().parent.name == "2_densification":
        kept = "1_initial/params"
        for name in _offset_names(project[1] / kept):
            if stem.startswith(name):
                yield project[1], f"{kept}/{name}{_OFFSET_END}", readers.read_offset
                yield project[1], f"{kept}/{name}_wkt.prj", readers.read_prj


def _offset_names(folder: Path) -> tuple[str, ...]:
    """Return what stands before "_offset.xyz" in the names of a folder's files."""
    try:
        return _offset_names_of(folder, os.stat(folder).st_mtime_ns)
    except OSError:
        return ()


@functools.lru_cache(maxsize=16)
def _offset_names_of(folder: Path, changed: int) -> tuple[str, ...]:
    del changed  # only makes the cache forget
    names = (entry for entry in os.listdir(folder) if entry.endswith(_OFFSET_END))
    return tuple(sorted(entry[: -len(_OFFSET_END)] for entry in names))
