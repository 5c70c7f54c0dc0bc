"""Write a file or a folder whole or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from meshreg.errors import OutputError, UsageError


@contextlib.contextmanager
def as_output_error(path: Path) -> Iterator[None]:
    """Turn any OSError of the block into an OutputError that names `path`."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot be written: {error.strerror or error}. What was there before is intact.",
            file=path,
            remedy="Free space, or choose a folder that you may write to.",
        ) from error


def short_name(name: str, most: int = 100) -> str:
    """Return the beginning of a name, at most so many bytes of it."""
    while len(os.fsencode(name)) > most:
        name = name[:-1]
    return name


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _sync_folder(path: Path) -> None:
    """Make a rename last; the new file is in place already, so that failing here is no failure."""
    with contextlib.suppress(OSError):
        _sync(path)


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; it becomes `path` when the block ends well.

    The temporary file exists (empty) and has the suffix of `path`. When the block raises, it is
    removed and what was at `path` stays. What a killed process left of its own is removed first.

    Raises
    ------
    OutputError
        For any OSError: full disk, no permission, no such folder.
    """
    path = Path(path)
    with as_output_error(path):
        _clear_partial(path)
        temporary, handle = _new_partial(path)
        try:
            yield temporary
            _sync(temporary)
            os.replace(temporary, path)
            _sync_folder(path.parent)
        finally:
            temporary.unlink(missing_ok=True)
            os.close(handle)


def _new_partial(path: Path) -> tuple[Path, int]:
    """Make an empty temporary file beside `path`; the lock says that its process lives."""
    import fcntl  # POSIX only

    before, after = _partial_name(path)
    while True:
        temporary = path.with_name(before + secrets.token_hex(6) + after)
        handle = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o666)
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if temporary.exists():  # else another process took it for a dead one's, just now
                return temporary, handle
        os.close(handle)


def _clear_partial(path: Path) -> None:
    """Remove temporary files of `path` whose process was killed: nobody holds their lock."""
    import fcntl  # POSIX only

    before, after = _partial_name(path)
    length = len(before) + 12 + len(after)
    with contextlib.suppress(OSError):  # no such folder: told when the file is made
        for name in os.listdir(path.parent):
            if len(name) != length or not (name.startswith(before) and name.endswith(after)):
                continue
            with contextlib.suppress(OSError):
                handle = os.open(path.with_name(name), os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(path.with_name(name))
                finally:
                    os.close(handle)


def _partial_name(path: Path) -> tuple[str, str]:
    """Return what stands before and after the twelve random digits of a temporary file's name."""
    return f".{short_name(path.stem)}.", f".tmp{path.suffix}"


@contextlib.contextmanager
def atomic_folder(
    path: Path, overwrite: bool = False, markers: tuple[str, ...] = ("registration.json",)
) -> Iterator[Path]:
    """Give a temporary folder beside `path`; it becomes `path` when the block ends well.

    A lock file beside `path` keeps a second run out; the lock ends with the process, however
    that dies, and what a killed run left behind is cleared away by the next one.

    Parameters
    ----------
    path : Path
        The folder to make.
    overwrite : bool
        Replace a folder that is there already. It must be empty or hold one of `markers`, so
        that only a former result is ever deleted.
    markers : tuple of str
        Names of files by which a former result is known.

    Raises
    ------
    UsageError
        `path` exists and may not be replaced (said before any work).
    OutputError
        Another run is writing there, or any OSError.
    """
    path = Path(os.path.abspath(path))
    with as_output_error(path):
        _require_replaceable(path, overwrite, markers)
    prefix = f".{short_name(path.name)}.{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:8]}"
    with as_output_error(path), _locked(path, path.with_name(prefix + ".lock")):
        _clear_leftovers(path, prefix)
        temporary = path.with_name(prefix + ".tmp")
        temporary.mkdir()
        try:
            yield temporary
            for folder, _, names in os.walk(temporary):
                for name in names:
                    _sync(Path(folder, name))
            _require_replaceable(path, overwrite, markers)
            _swap_in(temporary, path, path.with_name(prefix + ".old"))
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _require_replaceable(path: Path, overwrite: bool, markers: tuple[str, ...]) -> None:
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise UsageError("exists already.", file=path, remedy="Choose another, or --overwrite.")
    if path.is_symlink() or not path.is_dir():
        raise UsageError("exists and is not a folder.", file=path, remedy="Choose another.")
    names = os.listdir(path)
    if names and not any(marker in names for marker in markers):
        raise UsageError(
            f"holds {len(names)} files and folders, but no {' or '.join(markers)}: it is no former "
            "result and will not be deleted.",
            file=path,
            remedy="Choose another folder.",
        )


@contextlib.contextmanager
def _locked(path: Path, lock: Path) -> Iterator[None]:
    """Hold `lock` for this process; the kernel lets go of it when the process ends."""
    import fcntl  # POSIX only

    while True:
        handle = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The former holder may have removed the file between our open and our lock.
            held = os.path.exists(lock) and os.path.samestat(os.fstat(handle), os.stat(lock))
        except BlockingIOError:
            owner = os.read(handle, 32).decode("ascii", "replace").strip() or "unknown"
            os.close(handle)
            raise OutputError(
                f"another run (process {owner}) is writing there.",
                file=path,
                remedy="Wait for it, or choose another folder.",
            ) from None
        except BaseException:
            os.close(handle)
            raise
        if held:
            break
        os.close(handle)
    try:
        os.ftruncate(handle, 0)
        os.write(handle, f"{os.getpid()}\n".encode())
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(handle)


def _clear_leftovers(path: Path, prefix: str) -> None:
    """Undo what a killed run left: drop its half result, put back the one it was replacing."""
    old = path.with_name(prefix + ".old")
    if old.exists() and not path.exists():
        os.replace(old, path)
    for leftover in (old, path.with_name(prefix + ".tmp")):
        if leftover.exists():
            shutil.rmtree(leftover)


def _swap_in(temporary: Path, path: Path, old: Path) -> None:
    """Rename `temporary` to `path`; a folder that is there is put back if that fails."""
    if path.exists():
        os.replace(path, old)
        try:
            os.replace(temporary, path)
        except BaseException:
            os.replace(old, path)
            raise
        shutil.rmtree(old, ignore_errors=True)
    else:
        os.replace(temporary, path)
    _sync_folder(path.parent)
