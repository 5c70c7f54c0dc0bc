"""Write a file or a folder whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from meshreg.errors import InputError, OutputError, UsageError

if TYPE_CHECKING:
    from meshreg.io.manifest import Seen


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
            with contextlib.suppress(OSError):  # nothing was written through it
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
    path: Path,
    overwrite: bool = False,
    markers: tuple[str, ...] = ("registration.json",),
    command: str = "",
) -> Iterator[Path]:
    """Give a temporary folder beside `path`; it becomes `path` when the block ends well.

    A lock file beside `path` keeps a second run out; the lock ends with the process, however
    that dies, and what a killed run left behind is cleared away by the next one.

    Parameters
    ----------
    path : Path
        The folder to make.
    overwrite : bool
        Replace a folder that is there already. It must be empty, or hold one of `markers` and
        nothing but what meshreg wrote (`meshreg.io.manifest`): no other file is ever removed.
        A registration that was rejected may be replaced in any case.
    markers : tuple of str
        Names of files by which a former result is known.
    command : str
        What makes the folder; its files are entered in a manifest. "" for a folder within one.

    Raises
    ------
    UsageError
        `path` exists and may not be replaced (said before any work).
    OutputError
        Another run is writing there, or any OSError.
    """
    from meshreg.io.manifest import write_manifest

    path = Path(os.path.abspath(path))
    with as_output_error(path):
        seen = _require_replaceable(path, overwrite, markers)
    prefix = f".{short_name(path.name)}.{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:8]}"
    with as_output_error(path), _locked(path, path.with_name(prefix + ".lock")):
        _clear_leftovers(path, prefix)
        temporary, old = path.with_name(prefix + ".tmp"), path.with_name(prefix + ".old")
        temporary.mkdir()
        made = os.lstat(temporary)
        try:
            yield temporary
            if command:
                write_manifest(temporary, command)
            for folder, _, names in os.walk(temporary):
                for name in names:
                    _sync(Path(folder, name))
            _require_replaceable(path, overwrite, markers, seen)
            _swap_in(temporary, path, old)
        finally:  # a signal may come at any line: what lies where is looked up, not remembered
            if temporary.exists() and os.path.samestat(os.lstat(temporary), made):
                if old.exists() and not path.exists():
                    os.replace(old, path)
                shutil.rmtree(temporary, ignore_errors=True)
            for former in (temporary, old):
                if former.exists():
                    _discarded(former, path.with_name(path.name + ".kept"))


def _discarded(former: Path, kept: Path) -> None:
    """Remove a former result; once more if a signal comes meanwhile."""
    from meshreg.io.manifest import discard

    try:
        discard(former, kept)
    except BaseException:
        discard(former, kept)
        raise


def _require_replaceable(
    path: Path, overwrite: bool, markers: tuple[str, ...], seen: Seen | None = None
) -> Seen | None:
    """Refuse a path that may not be replaced; return what is there, for a second look."""
    from meshreg.io.manifest import require_only_ours

    if not os.path.lexists(path):
        return seen
    if not overwrite and not _is_rejected(path, markers):
        raise UsageError("exists already.", file=path, remedy="Choose another, or --overwrite.")
    if path.is_symlink() or not path.is_dir():
        raise UsageError("exists and is not a folder.", file=path, remedy="Choose another.")
    why = ""
    if os.path.ismount(path):
        why = "is a mount point"
    elif Path.cwd().is_relative_to(path.resolve()):
        why = "is the current folder, or holds it"
    elif Path(os.path.expanduser("~")).resolve().is_relative_to(path.resolve()):
        why = "is your home, or holds it"
    if why:
        raise UsageError(
            f"{why}; it cannot be replaced.", file=path, remedy="Choose a folder in it."
        )
    return require_only_ours(path, markers, seen)


def _is_rejected(path: Path, markers: tuple[str, ...]) -> bool:
    """Whether a folder holds a registration that was rejected, which nobody wants to keep."""
    if "registration.json" not in markers or not (path / "registration.json").is_file():
        return False
    from meshreg.io.document import read_registration

    try:
        return read_registration(path).verdict == "rejected"
    except InputError:
        return False


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
        with contextlib.suppress(OSError):  # it holds nothing that anybody needs
            os.close(handle)


def _clear_leftovers(path: Path, prefix: str) -> None:
    """Undo what a killed run left: drop its half result, put back the one it was replacing."""
    from meshreg.io.manifest import NAME, discard

    old, temporary = path.with_name(prefix + ".old"), path.with_name(prefix + ".tmp")
    if old.exists() and not path.exists():
        os.replace(old, path)
    kept = path.with_name(path.name + ".kept")
    if old.exists():
        discard(old, kept)
    if (temporary / NAME).exists():  # whole: the former result, if the two changed places
        discard(temporary, kept)
    if temporary.exists():
        shutil.rmtree(temporary)


def _swap_in(temporary: Path, path: Path, old: Path) -> None:
    """Rename `temporary` to `path`; what was there is at `temporary` or `old` then.

    Where the file system can, the two change places in one step, so that `path` is never missing;
    elsewhere a folder that is there is put back if the second rename fails.
    """
    if not path.exists():
        os.replace(temporary, path)
    elif not _exchange(temporary, path):
        os.replace(path, old)
        try:
            os.replace(temporary, path)
        except BaseException:
            os.replace(old, path)
            raise
    _sync_folder(path.parent)


def _exchange(one: Path, other: Path) -> bool:
    """Let two paths change places at once; False where the system or the file system cannot.

    renameat2(2) with RENAME_EXCHANGE, of Linux 3.15 and glibc 2.28.
    """
    import ctypes

    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError):
        return False
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    if call(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM):
        return False
    raise OSError(number, os.strerror(number), str(other))
