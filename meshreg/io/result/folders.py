"""A result's folder: made beside its place, and put there once it is whole."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import hashlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.files.atomic import _sync, _sync_folder, as_output_error, short_name
from meshreg.io.result.document import read_registration
from meshreg.io.result.manifest import NAME, Seen, discard, require_only_ours, write_manifest


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
        nothing but what meshreg wrote (`manifest`): no other file is ever removed.
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
    try:
        discard(former, kept)
    except BaseException:
        discard(former, kept)
        raise


def _require_replaceable(
    path: Path, overwrite: bool, markers: tuple[str, ...], seen: Seen | None = None
) -> Seen | None:
    """Refuse a path that may not be replaced; return what is there, for a second look."""
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
