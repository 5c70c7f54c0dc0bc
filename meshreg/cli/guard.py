"""Stop a job within two seconds of Ctrl-C or SIGTERM and leave nothing half done.

A signal reaches Python code only when the native call in progress returns (SIFT or a kernel may
take ten seconds). So the job runs in a thread of its own, and the main thread waits for it or for
a signal: first it asks the job to stop, which undoes its work on the way out; a job that does not
hear in time is abandoned with the process, after its temporary folder is removed.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

_T = TypeVar("_T")
PATIENCE = 1.5  # seconds that a job has to undo its work


class StoppedError(BaseException):
    """The job was stopped by a signal; not an Exception, so that no `except Exception` eats it."""

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number

    @property
    def exit_code(self) -> int:
        """130 for SIGINT, 143 for SIGTERM."""
        return 128 + self.number


class Unfinished:
    """Temporary folders of the running job, for when it cannot remove them itself."""

    def __init__(self) -> None:
        self._folders: dict[Path, os.stat_result] = {}

    @contextmanager
    def holding(self, folder: Path) -> Iterator[Path]:
        """Know of `folder` while the block runs."""
        self._folders[folder] = os.lstat(folder)
        try:
            yield folder
        finally:
            self._folders.pop(folder, None)

    def remove(self) -> None:
        """Delete the folders and the locks beside them; the job may still be writing there."""
        for folder, made in list(self._folders.items()):
            for _ in range(5):
                # once it has changed places with the result that it replaces, it is not ours
                if not (folder.exists() and os.path.samestat(os.lstat(folder), made)):
                    break
                shutil.rmtree(folder, ignore_errors=True)
                time.sleep(0.02)
            folder.with_suffix(".lock").unlink(missing_ok=True)


def run_stoppable(job: Callable[[Unfinished], _T]) -> _T:
    """Run `job` in a thread, return what it returns, raise what it raises.

    Raises
    ------
    StoppedError
        At the first SIGINT or SIGTERM. A second one ends the process at once.
    """
    unfinished = Unfinished()
    outcome: dict[str, Any] = {}
    done = threading.Event()
    signals: list[int] = []

    def work() -> None:
        try:
            outcome["value"] = job(unfinished)
        except BaseException as error:  # handed to the main thread
            outcome["error"] = error
        finally:
            done.set()

    def heard(number: int, frame: FrameType | None) -> None:
        del frame
        if signals:
            os._exit(128 + number)
        signals.append(number)

    thread = threading.Thread(target=work, name="meshreg job", daemon=True)
    with _handlers(heard):
        thread.start()
        while not done.wait(0.05):
            if signals:
                _stop(thread, done, unfinished, signals[0])
                break
        if signals:
            stopped = StoppedError(signals[0])
            if "value" in outcome:  # the job ended before it heard of it
                stopped.add_note("what was asked for was done already.")
            for note in getattr(outcome.get("error"), "__notes__", ()):
                stopped.add_note(note)
            raise stopped
    thread.join()
    if "error" in outcome:
        raise outcome["error"]
    value: _T = outcome["value"]
    return value


@contextmanager
def _handlers(heard: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's business; a caller there has its own handlers
        return
    before = {n: signal.signal(n, heard) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(
    thread: threading.Thread, done: threading.Event, unfinished: Unfinished, number: int
) -> None:
    """Ask the thread to end; where it does not, remove its folders and end the process."""
    before = sys.unraisablehook
    # CPython may hand it to a thread that the job is just starting, which would print it
    sys.unraisablehook = lambda what: (
        None if isinstance(what.exc_value, StoppedError) else before(what)
    )
    asked = ctypes.c_ulong(thread.ident or 0)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(asked, ctypes.py_object(StoppedError))
    if done.wait(PATIENCE):
        return
    unfinished.remove()
    show_cursor = b"\x1b[?25h" if os.isatty(2) else b""  # a progress bar had hidden it
    os.write(2, show_cursor + b"Stopped.\n")
    os._exit(128 + number)
