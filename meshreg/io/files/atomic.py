"""Write a file or a folder whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from meshreg.errors import OutputError
from meshreg.io.files.safe import open_regular, sha256


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
        made: list[Path] = []
        handle = -1
        try:
            handle = _new_partial(path, made)
            temporary = made[-1]
            yield temporary
            _sync(temporary)
            os.replace(temporary, path)
            _sync_folder(path.parent)
        finally:
            for temporary in made:
                temporary.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # nothing was written through it
                os.close(handle)


def _new_partial(path: Path, made: list[Path]) -> int:
    """Make an empty temporary file beside `path`; the lock says that its process lives.

    Its name is the last in `made`, and is there before the file: a signal may come between.
    """
    import fcntl  # POSIX only

    before, after = _partial_name(path)
    while True:
        temporary = path.with_name(before + secrets.token_hex(6) + after)
        made.append(temporary)
        handle = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o666)
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if temporary.exists():  # else another process took it for a dead one's, just now
                return handle
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


def copy_file(source: Path, target: Path) -> None:
    """Copy a regular file's bytes to a new file; refuse to replace one of other content.

    Raises
    ------
    OutputError
        `target` exists and differs, or any OSError.
    """
    if os.path.lexists(target):
        if target.is_file() and sha256(target) == sha256(source):
            return
        raise OutputError(
            "exists already with other content.", file=target, remedy="Choose another folder."
        )
    with as_output_error(target):
        target.parent.mkdir(parents=True, exist_ok=True)
    with (
        open_regular(source) as stream,
        atomic_file(target) as temporary,
        open(temporary, "wb") as out,
    ):
        shutil.copyfileobj(stream, out, 1 << 20)
