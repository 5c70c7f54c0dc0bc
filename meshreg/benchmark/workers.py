"""A few worker processes that take jobs one by one; they end with their parent, however it ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any

from meshreg.errors import MeshregError

_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_DEATHS = 5  # workers that may die before the run is given up


def run_all(
    task: Callable[..., Any], items: Sequence[Any], workers: int, *shared: Any
) -> Iterator[tuple[int, Any]]:
    """Call ``task(item, *shared)`` for every item; give (index, result) as they come.

    Parameters
    ----------
    task : callable
        Of a module's own level, since workers are spawned; it does not raise.
    items : sequence
    workers : int
        Processes; 0 works here, in this one.
    shared
        Further arguments.

    Raises
    ------
    MeshregError
        If workers keep dying (out of memory, most likely).
    """
    if workers == 0 or not items:
        for index, item in enumerate(items):
            yield index, task(item, *shared)
        return
    count = min(workers, len(items))
    threads = max(1, (os.cpu_count() or 1) // workers)
    with _limited(threads):
        crew = _Crew(task, shared, threads)
        try:
            yield from crew.work(items, count)
        finally:
            crew.dismiss()


class _Crew:
    """The processes, each at one end of a pipe."""

    def __init__(self, task: Callable[..., Any], shared: tuple[Any, ...], threads: int) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._about = (task, shared, threads)
        self._processes: dict[Connection, Any] = {}
        self._deaths = 0

    def hire(self) -> Connection:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(theirs, *self._about), daemon=True)
        process.start()
        theirs.close()
        self._processes[ours] = process
        return ours

    def work(self, items: Sequence[Any], count: int) -> Iterator[tuple[int, Any]]:
        left = list(enumerate(items))[::-1]
        busy: dict[Connection, int] = {}
        for _ in range(count):
            self._give(self.hire(), left, busy)
        while busy:
            for pipe in wait(list(busy), timeout=0.2):
                assert isinstance(pipe, Connection)
                index = busy.pop(pipe)
                try:
                    result = pipe.recv()
                except (EOFError, OSError):
                    left.append((index, items[index]))
                    self._give(self._replaced(pipe), left, busy)
                    continue
                self._give(pipe, left, busy)
                yield index, result

    def _give(self, pipe: Connection, left: list[Any], busy: dict[Connection, int]) -> None:
        if left:
            index, item = left.pop()
            with suppress(OSError):  # it died; the next wait tells
                pipe.send(item)
            busy[pipe] = index

    def _replaced(self, pipe: Connection) -> Connection:
        self._deaths += 1
        process = self._processes.pop(pipe)
        process.join(1.0)
        pipe.close()
        if self._deaths >= _DEATHS:
            raise MeshregError(
                f"Worker processes keep dying (the last with exit code {process.exitcode}).",
                remedy="There may be too little memory: try --workers 1, then --resume.",
            )
        return self.hire()

    def dismiss(self) -> None:
        for pipe, process in self._processes.items():
            pipe.close()
            process.terminate()
        for process in self._processes.values():
            process.join(5.0)


def _serve(
    pipe: Connection, task: Callable[..., Any], shared: tuple[Any, ...], threads: int
) -> None:
    """Work until the other end of the pipe is closed, which the parent's death does too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    import cv2

    from meshreg.offsets import correlate

    cv2.setNumThreads(threads)
    correlate.WORKERS = min(correlate.WORKERS, threads)
    with suppress(EOFError, OSError):
        while True:
            pipe.send(task(pipe.recv(), *shared))


@contextmanager
def _limited(threads: int) -> Iterator[None]:
    """Let processes that are started meanwhile use so many threads each."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
