"""Open only what is safe to open, write whole files or none.

Every reader passes the names found inside a survey file through `resolve_reference`, those that it
looks for by itself through `beside` (a side file) or `require_inside` (what a folder holds), every
declared count through `require`; every writer goes through `atomic` or `folders`.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import stat
import struct
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshreg.errors import (
    InputError,
    MeshregError,
    ResourceLimitError,
    UnsafeReferenceError,
)
from meshreg.records import UInt8

_SCHEME_OR_DRIVE = re.compile(r"[A-Za-z][A-Za-z0-9+.\-]*:")
FARTHEST = 1e12  # coordinates from here on are damage: no unit makes the Earth that large
_FREELY = 900_000_000  # bytes of memory that any file may take
_MOST_EXPANDED = 1000  # bytes of memory for each byte of a file beyond its first 1,000,000
_COPY_BESIDE = "Copy it beside the survey file and write its plain name there."


class MissingReferenceError(InputError):
    """A file that another file refers to is not there (or its name fits several)."""


def decode_name(name: bytes | str) -> str:
    """Return a name from a file as text: UTF-8, else Latin-1 (which cannot fail)."""
    if isinstance(name, str):
        return name
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("latin-1")


def resolve_reference(folder: Path, name: str | bytes, *, root: Path) -> Path:
    """Find the file that a survey file names, never outside the survey's folder.

    Parameters
    ----------
    folder : Path
        Folder of the file that holds the reference.
    name : str or bytes
        The reference as written. Backslashes separate folders; bytes are tried as UTF-8, as
        Latin-1 and as the bytes of the file system. Letter case and Unicode normal form may
        differ where only one file then fits.
    root : Path
        The survey's folder; the result lies in it, links followed.

    Returns
    -------
    Path
        An existing regular file, below `folder`.

    Raises
    ------
    UnsafeReferenceError
        An absolute path, a drive, a UNC path, a scheme, ``..``, a NUL byte, a link that leaves
        `root`, or something that is not a regular file.
    MissingReferenceError
        No such file, or several that differ in letter case only.
    """
    shown = decode_name(name)
    for text in _spellings(name):
        parts = _safe_parts(text, shown)
        path = _walk(Path(folder), parts, Path(root).resolve(), shown)
        if path is not None:
            return path
    raise MissingReferenceError(
        f"the file {shown!r} that is referred to is not there.",
        file=folder,
        remedy="Copy it there, under that name.",
    )


def beside(folder: Path, name: str) -> Path | None:
    """Find a side file: one that is looked for by its usual name, and not named by anybody.

    Parameters
    ----------
    folder : Path
        The survey's folder.
    name : str
        With folders where it lies in one: "odm_georeferencing/coords.txt".

    Returns
    -------
    Path or None
        A regular file in `folder`, links followed; None where there is none of that name.

    Raises
    ------
    UnsafeReferenceError
        A link that leaves `folder`.
    """
    candidate = Path(folder) / name
    if not os.path.isfile(candidate):  # where the name is too long, too
        return None
    require_inside(candidate, folder)
    return candidate


def require_inside(path: Path, root: Path) -> None:
    """Refuse a file that was found in a folder, not named, if it is a link that leaves it.

    Raises
    ------
    UnsafeReferenceError
        The file that is meant, links followed, does not lie in `root`.
    """
    if not Path(path).resolve().is_relative_to(Path(root).resolve()):
        raise UnsafeReferenceError(
            "is a link that leaves the survey's folder; it is not opened.",
            file=path,
            remedy="Put the file itself there instead of a link, or remove the link.",
        )


def _spellings(name: str | bytes) -> list[str]:
    """Return the texts that a name may stand for, likeliest first, without repeats."""
    if isinstance(name, str):
        return [name]
    texts = [decode_name(name), name.decode("latin-1"), os.fsdecode(name)]
    return list(dict.fromkeys(texts))


def _safe_parts(text: str, shown: str) -> list[str]:
    """Split a reference into its folders and name, or say why it is refused."""
    path = text.strip().replace("\\", "/")
    why = ""
    if "\0" in path:
        why = "holds a NUL byte"
    elif path.startswith("/"):
        why = "is an absolute path"
    elif _SCHEME_OR_DRIVE.match(path):
        why = "starts with a drive or a scheme"
    elif ".." in path.split("/"):
        why = "climbs out of its folder by '..'"
    if why:
        raise UnsafeReferenceError(f"the reference {shown!r} {why}.", remedy=_COPY_BESIDE)
    parts = [part for part in path.split("/") if part not in ("", ".")]
    if not parts:
        raise UnsafeReferenceError(f"the reference {shown!r} names no file.")
    return parts


def _walk(folder: Path, parts: list[str], root: Path, shown: str) -> Path | None:
    """Go down from `folder`, one unique match a step, staying in `root`; None where none fits."""
    path = folder
    for last, part in ((index == len(parts) - 1, part) for index, part in enumerate(parts)):
        try:
            found = _entry(path, part, shown)
        except (OSError, ValueError):
            return None
        if found is None:
            return None
        path = path / found
        # Checked at every step, so that not even a listing is taken outside the root.
        if not path.resolve().is_relative_to(root):
            raise UnsafeReferenceError(
                f"the reference {shown!r} is a link that leaves the survey's folder.",
                file=path,
                remedy="Put the file itself there instead of a link.",
            )
        if last and not path.is_file():
            raise UnsafeReferenceError(
                f"the reference {shown!r} is not a regular file.", file=path, remedy=_COPY_BESIDE
            )
    return path


def _entry(folder: Path, part: str, shown: str) -> str | None:
    """Return the entry of `folder` called `part`, else the only one that folds to it."""
    if os.path.lexists(folder / part):
        return part
    fits = _listing(folder, os.stat(folder).st_mtime_ns).get(_folded(part), [])
    if len(fits) > 1:
        raise MissingReferenceError(
            f"the reference {shown!r} fits several files: {', '.join(sorted(fits))}.",
            file=folder,
            remedy="Keep one of them, under the name that is referred to.",
        )
    return fits[0] if fits else None


def _folded(text: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", text).casefold())


@functools.lru_cache(maxsize=16)
def _listing(folder: Path, changed: int) -> dict[str, list[str]]:
    """Return a folder's entries by folded name; kept, as a file may name thousands of pages."""
    del changed  # only makes the cache forget
    entries: dict[str, list[str]] = {}
    for entry in os.listdir(folder):
        entries.setdefault(_folded(entry), []).append(entry)
    return entries


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading; anything but a regular file is refused, without blocking.

    Raises
    ------
    InputError
        Missing, not readable, a folder, a pipe or a device.
    """
    try:
        # A look before opening: opening some devices already does something.
        _require_regular(os.stat(path).st_mode, path)
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | getattr(os, "O_NONBLOCK", 0))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        remedy = "Check the path and its permissions."
        raise InputError(f"cannot be opened: {reason}.", file=path, remedy=remedy) from error
    stream = os.fdopen(handle, "rb")
    try:
        _require_regular(os.fstat(stream.fileno()).st_mode, path)
    except BaseException:
        stream.close()
        raise
    return stream


def _require_regular(mode: int, path: Path) -> None:
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe, socket or device"
        raise InputError(f"is {kind}, not a file.", file=path, remedy="Name a regular file.")


def file_bytes(path: Path) -> UInt8:
    """Read a whole file into memory: (size,) uint8, read-only.

    It is read and not mapped: a page of a map that the file has lost since, as it was cut short
    or its disk went away, ends the process by SIGBUS.

    Raises
    ------
    InputError
        As `open_regular`; an empty file, and one that grows or shrinks while it is read.
    ResourceLimitError
        It is larger than the free memory.
    """
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size == 0:
            raise InputError("is empty.", file=path, remedy="Export or copy it again.")
        free = free_memory()
        if free is not None and size > free:
            raise ResourceLimitError(
                f"has {size / 1e9:.1f} GB; {free / 1e9:.1f} GB of memory are free.",
                file=path,
                remedy="Close other programs, or cut the survey into blocks.",
            )
        data = np.empty(size, np.uint8)
        done = 0
        while count := read_into(stream, data[done:], path):
            done += count
        if done < size or os.fstat(stream.fileno()).st_size != size:
            raise InputError("changed while it was read.", file=path, remedy="Read it again.")
        data.flags.writeable = False
        return data


def read_into(stream: BinaryIO, buffer: UInt8, path: Path) -> int:
    """Fill a buffer from a stream; return the bytes read, 0 at its end.

    Raises
    ------
    InputError
        The system cannot read the file (a bad disk, a share that went away).
    """
    try:
        return int(stream.readinto(buffer.data))  # type: ignore[attr-defined]
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}.", file=path, remedy="Check the disk or the share."
        ) from error


@contextlib.contextmanager
def data_errors(path: Path) -> Iterator[None]:
    """Turn errors that only values in a file bring about into an InputError that names it.

    These are errors of arithmetic, of text and of the libraries of coordinate systems and
    rasters; any other exception is a bug and stays one.
    """
    try:
        yield
    except MeshregError as error:
        if isinstance(error, InputError | ResourceLimitError):
            error.file = error.file or str(path)
        raise
    except Exception as error:
        kinds = (ArithmeticError, UnicodeError, struct.error, np.linalg.LinAlgError)
        library = type(error).__module__.partition(".")[0]
        if not isinstance(error, kinds) and library not in ("pyproj", "rasterio"):
            raise
        said = (" ".join(str(error).split()) or type(error).__name__).rstrip(".")
        raise InputError(
            f"holds values that cannot be worked with: {said[:200]}.",
            file=path,
            remedy="The file is damaged; export or copy it again.",
        ) from error


def require(
    count: int, item_bytes: float, available: int, file: Path, place: str, what: str
) -> None:
    """Refuse a declared count that the bytes left in the file cannot hold, before allocating.

    Parameters
    ----------
    count : int
        Items declared.
    item_bytes : float
        Least size of one item in the file [bytes].
    available : int
        Bytes left in the file for them.
    file, place, what
        For the message: the file, where the count stands, what is counted ("vertices").

    Raises
    ------
    InputError
        The count is negative or needs more than `available`.
    """
    if int(count) < 0 or int(count) * item_bytes > available:
        raise InputError(
            f"declares {int(count)} {what} of at least {item_bytes:g} bytes each, "
            f"but {int(available)} bytes are there for them.",
            file=file,
            place=place,
            remedy="The file is cut off or damaged; export or copy it again.",
        )


def require_proportion(needed: int, n_bytes: int, file: Path | str, what: str) -> None:
    """Refuse, before allocating, a small file that asks for much memory.

    What compresses to a thousandth of its size or less holds nothing: such files are made to
    fill memory. Up to `_FREELY` nothing is asked, so that a blank page of usual size is read.

    Parameters
    ----------
    needed : int
        Memory that reading takes at its peak [bytes].
    n_bytes : int
        Size of what is read, as it is stored [bytes].
    file, what
        For the message: the file, and what it declares ("20000 × 20000 pixels").

    Raises
    ------
    ResourceLimitError
    """
    if needed > _FREELY + _MOST_EXPANDED * max(0, n_bytes - 1_000_000):
        raise ResourceLimitError(
            f"declares {what}, which take {needed / 1e9:.1f} GB of memory, in {n_bytes} bytes.",
            file=file,
            remedy="It is damaged or empty; export it with fewer, or leave it out.",
        )


def free_memory() -> int | None:
    """Return the memory [bytes] that can be had without swapping; None where the system is mute."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if "MemAvailable" in line)
    except (OSError, StopIteration, ValueError):
        return None


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()  # type: ignore[arg-type]


def fingerprint(path: Path, companions: Sequence[Path] = ()) -> tuple[int, int]:
    """Return size [bytes] and time of last change [ns], to notice that a file has changed.

    With companions (texture pages, the files of a model whose `path` is their folder): the sums
    over all files.
    """
    size = time = 0
    for each in (*companions,) if os.path.isdir(path) and companions else (path, *companions):
        with open_regular(each) as stream:
            status = os.fstat(stream.fileno())
        size, time = size + status.st_size, time + status.st_mtime_ns
    return size, time


__all__: list[str] = [
    "FARTHEST",
    "MissingReferenceError",
    "beside",
    "data_errors",
    "decode_name",
    "file_bytes",
    "fingerprint",
    "free_memory",
    "open_regular",
    "read_into",
    "require",
    "require_inside",
    "require_proportion",
    "resolve_reference",
    "sha256",
]
