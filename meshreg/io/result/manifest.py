"""`manifest.json`: which files of a folder meshreg wrote, so that it removes no others.

A folder of results from before there were manifests is known by the names in `_FORMER`. A file of
ours that was changed since is the user's: it is no more removed than one that we never wrote.
GDAL's `*.aux.xml` beside a map of ours (QGIS writes them when it opens one) go with the map.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from meshreg.errors import InputError, UsageError
from meshreg.io.files.atomic import as_output_error, atomic_file
from meshreg.io.files.safe import open_regular

if TYPE_CHECKING:
    from meshreg.records import Survey

NAME = "manifest.json"
SCHEMA = "meshreg.manifest/1"
_MAX_BYTES = 64_000_000  # a record of 300,000 files
_MOST = 1000  # foreign files that are counted
_LOG = logging.getLogger("meshreg")
Seen = dict[str, tuple[int, ...]]  # of each file of ours: what `os.stat` said when it was hashed

# What a process that was killed while it wrote a file leaves (`files.atomic`).
_HALF = re.compile(r"((?:.*/)?)\.([^/]+)\.[0-9a-f]{12}\.tmp(\.[^/.]+)?")
# Names within a folder, by the file that such a folder is known by.
_MODEL = r"(cameras|images|points3D|rigs|frames)\.(bin|txt)"
_SHIFTS = r"(_offset\.xyz|\.survey\.toml)"
_FORMER: dict[str, str] = {
    "registration.json": r"registration\.json|settings\.toml|log\.txt|report\.html|evidence\.npz"
    r"|validation\.(json|html)|transform(_inverse)?(_[^/]*)?\.txt"
    r"|(reference|moving)_(dem|ortho)\.tif|figures/[a-z0-9_]+\.png"
    rf"|MOVING_registered(_\d+)?({_SHIFTS}|\.[a-z0-9]+|/{_MODEL})",
    "dem.tif": r"(dem|ortho)\.tif|log\.txt",
    "moved.json": rf"moved\.json|[^/]+_(registered|moved)(_\d+)?({_SHIFTS}|\.[a-z0-9]+|/{_MODEL})",
    "selftest.json": r"selftest\.json|log\.txt",
    "truth.json": rf"truth\.json|(reference|moving)({_SHIFTS}"
    r"|(_\d+)?\.(obj|mtl|ply|laz|glb|jpg|png)"
    rf"|/(positions\.csv|{_MODEL}|(ref|mov)_\d+\.jpg))",
    "benchmark.json": r"(benchmark|summary|calibration)\.json|pairs\.csv|index\.html"
    r"|pairs/[a-z0-9_]+_\d{4}\.json|sites/site_\d+\.npz|figures/[a-z0-9_]+\.png",
}


def write_manifest(folder: Path, command: str, names: Sequence[str] | None = None) -> None:
    """Enter the files of `folder` into its manifest: `names`, or all that there are.

    `command` is what wrote them.

    Raises
    ------
    OSError
        If a file cannot be read or the manifest cannot be written.
    """
    found = _walk(folder) if names is None else names
    files = {name: _entry(folder / name) for name in found if name != NAME}
    _save(folder, {"schema": SCHEMA, "command": command, "files": files})


def write_into(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a result that is there already, each whole, and enter them in its manifest.

    They are entered before, beside what they replace, so that also a run that is killed in between
    leaves only files that are known to be ours. Where there is no manifest, none is made.

    Raises
    ------
    OutputError
        One cannot be written; those before it are new.
    """
    document = _document(folder) if (folder / NAME).is_file() else None
    coming = {
        name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        for name, data in files.items()
    }
    if document is not None:
        known = document["files"]
        waiting = {
            name: {**_present(folder / name, known[name]), "coming": entry}
            if name in known
            else entry
            for name, entry in coming.items()
        }
        _save(folder, {**document, "files": {**known, **waiting}})
    for name, data in files.items():
        with as_output_error(folder / name):
            (folder / name).parent.mkdir(exist_ok=True)
        with atomic_file(folder / name) as partial:
            partial.write_bytes(data)
    if document is not None:
        _save(folder, {**document, "files": {**document["files"], **coming}})


def require_ours(folder: Path, names: Sequence[str]) -> None:
    """Refuse, before the work, to write over a file that meshreg did not write.

    Raises
    ------
    UsageError
        One of `names` is in `folder`, and its manifest does not know it as it is.
    """
    if not (folder / NAME).is_file():
        return  # a former result: its names are known to be ours
    known = _document(folder)["files"]
    for name in names:
        if os.path.lexists(folder / name) and not _is_as_written(folder / name, known.get(name)):
            raise UsageError(
                "is not as meshreg wrote it, and would be written over.",
                file=folder / name,
                remedy="Move it elsewhere first.",
            )


def are_as_written(folder: Path, names: Sequence[str]) -> bool:
    """Whether the manifest of `folder` knows each of `names` as it is, byte for byte.

    Raises
    ------
    UsageError
        The manifest is damaged.
    """
    if not (folder / NAME).is_file():
        return False
    known = _document(folder)["files"]
    return all(_is_as_written(folder / name, known.get(name)) for name in names)


def require_only_ours(folder: Path, markers: Sequence[str], seen: Seen | None = None) -> Seen:
    """Refuse a folder that may not be replaced as a whole.

    Parameters
    ----------
    folder : Path
    markers : sequence of str
        Files by which a former result is known.
    seen : dict, optional
        What this function returned before: files that have not been touched since are not read
        again.

    Returns
    -------
    dict
        Every file in it; empty for an empty folder.

    Raises
    ------
    UsageError
        No former result, or one that holds other files too: the first five are named.
    """
    if not os.listdir(folder):
        return {}
    present = [marker for marker in markers if (folder / marker).is_file()]
    if not present:
        count = len(os.listdir(folder))
        raise UsageError(
            f"holds {count} files and folders, but no {' or '.join(markers)}: it is not a former "
            "result and will not be deleted.",
            file=folder,
            remedy="Choose another folder.",
        )
    ours = _Ours(folder, present[0])
    found: Seen = {}
    foreign = []
    for name in _walk(folder):
        if ours.holds(name, None if seen is None else seen.get(name)):
            found[name] = _signature(folder / name)
        else:
            foreign.append(name)
            if len(foreign) > _MOST:
                break
    if foreign:
        more = f" and {len(foreign) - 5} more" if len(foreign) > 5 else ""
        many = "more than " if len(foreign) > _MOST else ""
        raise UsageError(
            f"holds {many}{min(len(foreign), _MOST)} files that meshreg did not write, or that "
            f"were changed since: {', '.join(foreign[:5])}{more}. Nothing is deleted.",
            file=folder,
            remedy="Move them elsewhere, or choose another folder.",
        )
    return found


def require_apart(folder: Path, inputs: Sequence[str | Path]) -> None:
    """Refuse a folder for the result that holds one of the files that are read.

    Raises
    ------
    UsageError
        Naming the first five.
    """
    if not folder.is_dir():
        return
    home = folder.resolve()
    inside = [str(path) for path in inputs if Path(path).resolve().is_relative_to(home)]
    if inside:
        names = list(dict.fromkeys(inside))
        more = f" and {len(names) - 5} more" if len(names) > 5 else ""
        raise UsageError(
            f"holds files that are read: {', '.join(names[:5])}{more}. Nothing is deleted.",
            file=folder,
            remedy="Choose another folder for the result.",
        )


def discard(folder: Path, kept: Path) -> None:
    """Remove a former result, file by file; what is not ours is kept, in the folder `kept`.

    Failures are passed over: the next run clears away what is left.
    """
    marker = next((name for name in _FORMER if (folder / name).is_file()), "")
    with contextlib.suppress(OSError, UsageError):
        ours = _Ours(folder, marker)
        names = [name for name in _walk(folder) if ours.holds(name)]
        # last what tells which are ours, so that a second attempt knows them too
        names.sort(key=lambda name: name in (NAME, marker))
        for name in names:
            with contextlib.suppress(OSError):
                os.unlink(folder / name)
    for place, _, _ in os.walk(folder, topdown=False):
        with contextlib.suppress(OSError):
            os.rmdir(place)
    if folder.exists() and (left := [n for n in islice(_walk(folder), 6) if n != NAME]):
        kept = _free_name(kept)
        with contextlib.suppress(OSError):
            os.rename(folder, kept)
            _LOG.warning("%s holds files that were not removed: %s", kept, ", ".join(left))


def survey_files(*surveys: Survey) -> list[Path]:
    """Return every file that surveys were read from, the files that these refer to included."""
    files: list[Path] = []
    for survey in surveys:
        for source in survey.source:
            files += [
                source.path,
                *source.companions,
                *([source.sidecar] if source.sidecar else []),
            ]
    return files


def _free_name(path: Path) -> Path:
    names = (path, *(path.with_name(f"{path.name}{number}") for number in range(2, 1000)))
    return next(name for name in names if not os.path.lexists(name))


class _Ours:
    """Tells which files of a folder meshreg wrote."""

    def __init__(self, folder: Path, marker: str) -> None:
        self._folder = folder
        self._known: dict[str, Any] | None = None
        if (folder / NAME).is_file():
            self._known = _document(folder)["files"]
        former = self._known is None and marker
        self._former = re.compile(_former(folder, marker)) if former else None

    def holds(self, name: str, seen: tuple[int, ...] | None = None) -> bool:
        """Whether the file `name` is ours; `seen` is its signature when it was so before."""
        path = self._folder / name
        if name.endswith("/"):  # an empty folder: ours if we made it, or what was in it
            return any(known.startswith(name) for known in self._known or ())
        if path.is_symlink() or not path.is_file():
            return False
        if seen is not None and seen == _signature(path):
            return True
        if half := _HALF.fullmatch(name):
            return self._names(f"{half[1]}{half[2]}{half[3] or ''}")
        if name.endswith(".aux.xml"):
            return self.holds(name.removesuffix(".aux.xml"))
        if self._known is not None and (name == NAME or name in self._known):
            return name == NAME or _is_as_written(path, self._known[name])
        return self._known is None and self._names(name)

    def _names(self, name: str) -> bool:
        """Whether we write a file of this name."""
        if self._known is not None:
            return name in self._known or name == NAME
        return self._former is not None and self._former.fullmatch(name) is not None


def _former(folder: Path, marker: str) -> str:
    """Return the pattern of the names in a folder from before there were manifests."""
    pattern = _FORMER.get(marker, "(?!)")
    if "MOVING" not in pattern:
        return pattern
    stems: list[str] = []
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        if (folder / marker).stat().st_size < _MAX_BYTES:
            record = json.loads((folder / marker).read_text(encoding="utf-8"))
            stems = [Path(str(path)).stem for path in record["moving"]["path"]]
    any_of = "|".join(re.escape(stem.removesuffix(".copc")) for stem in stems) or "(?!)"
    return pattern.replace("MOVING", f"({any_of})")


def _walk(folder: Path, prefix: str = "") -> Iterator[str]:
    """Give what is in a folder, by relative names with "/": files, and folders that are empty."""
    for entry in sorted(os.listdir(folder)):
        name, path = prefix + entry, folder / entry
        if path.is_symlink() or not path.is_dir():
            yield name
        elif os.listdir(path):
            yield from _walk(path, name + "/")
        else:
            yield name + "/"


def _entry(path: Path) -> dict[str, Any]:
    if path.is_dir():
        return {"bytes": 0, "sha256": ""}
    return {"bytes": path.stat().st_size, "sha256": _sha256(path)}


def _sha256(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _is_as_written(path: Path, entry: dict[str, Any] | None) -> bool:
    if entry is None or path.is_symlink() or not path.is_file():
        return False
    either = [entry, entry["coming"]] if _is_entry(entry.get("coming")) else [entry]
    sizes = [one for one in either if one["bytes"] == path.stat().st_size]
    return bool(sizes) and _sha256(path) in [one["sha256"] for one in sizes]


def _present(path: Path, entry: dict[str, Any]) -> dict[str, Any]:
    """Return what is there: of an entry that a killed run left with two, the one that it is."""
    coming: dict[str, Any] = entry.get("coming") or {}
    return coming if _is_entry(coming) and _is_as_written(path, coming) else entry


def _is_entry(entry: Any) -> bool:
    return (
        isinstance(entry, dict)
        and type(entry.get("bytes")) is int
        and isinstance(entry.get("sha256"), str)
    )


def _signature(path: Path) -> tuple[int, ...]:
    status = os.lstat(path)
    return (status.st_ino, status.st_size, status.st_mtime_ns, status.st_mode)


def _document(folder: Path) -> dict[str, Any]:
    """Read the manifest of a folder.

    Raises
    ------
    UsageError
        It is none: then nothing says what in that folder is ours.
    """
    path = folder / NAME
    why = "is damaged"
    try:
        with open_regular(path) as stream:
            text = stream.read(_MAX_BYTES + 1)
        document: Any = json.loads(text.decode("utf-8")) if len(text) <= _MAX_BYTES else None
        if _is_manifest(document):
            return dict(document)
        if isinstance(document, dict) and str(document.get("schema")).startswith("meshreg."):
            why = "is of another version of meshreg"
    except (InputError, OSError, ValueError, RecursionError):
        pass
    raise UsageError(
        f"{why}, so that nothing tells which files here meshreg wrote.",
        file=path,
        remedy="Choose another folder, or remove this one yourself.",
    )


def _is_manifest(document: Any) -> bool:
    return (
        isinstance(document, dict)
        and document.get("schema") == SCHEMA
        and isinstance(document.get("files"), dict)
        and all(map(_is_entry, document["files"].values()))
    )


def _save(folder: Path, document: dict[str, Any]) -> None:
    text = json.dumps(document, indent=1, sort_keys=True)
    with atomic_file(folder / NAME) as partial:
        partial.write_text(text + "\n", encoding="utf-8")
