"""The figures of a large pair are drawn by a second process while this one writes the result.

Matplotlib holds the interpreter for seconds, in which nothing else of ours could go on. The process
is started before the surveys are read, so that what it has to load, Matplotlib and VTK, is there
when they are registered. Once all else is written, this process draws what is left with it. A small
pair is not worth a second process.
"""

from __future__ import annotations

import gc
import logging
import logging.handlers
import multiprocessing
import queue
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from meshreg.cli.common import LOG
from meshreg.errors import MeshregError

if TYPE_CHECKING:
    from meshreg.records import Registration

Begin = Callable[["Registration", Path], Callable[[], object]]
LARGE = 30e6  # bytes of both surveys' files together


def _frozen(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


# records hold their mappings frozen, which pickle does not know
ForkingPickler.register(MappingProxyType, lambda frozen: (_frozen, (dict(frozen),)))


@contextmanager
def figure_worker(*surveys: str) -> Iterator[Begin]:
    """Give what draws the figures of a registration of these surveys' files.

    ``begin(registration, folder)`` may start on them elsewhere, and returns what is to be called
    for all to be there.
    """
    if sum(_size(path) for path in surveys) < LARGE:
        from meshreg.report import draw_figures

        yield lambda registration, folder: partial(draw_figures, registration, folder)
        return
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    following = context.Value("i", 0)
    process = context.Process(target=_serve, args=(theirs, following), daemon=True)
    process.start()
    theirs.close()
    try:
        yield partial(_begun_there, ours, partial(_claimed, following))
    finally:
        ours.close()
        process.terminate()
        process.join(5.0)


def _size(path: str) -> int:
    """Bytes of a survey's files; what is wrong with them is for the one who reads them to say."""
    from meshreg.io.blocks import find_blocks

    with suppress(MeshregError, OSError):
        blocks = find_blocks(path)
        files = [file for block in blocks for file in (block.maps or (block.path,))]
        inside = [f for path in files for f in (path.iterdir() if path.is_dir() else [path])]
        return sum(file.stat().st_size for file in inside)
    return 0


def _claimed(following: Any, number: int) -> bool:
    """Take the figure of this number, unless the other process, which goes in order too, has."""
    with following.get_lock():
        free = bool(number >= following.value)
        if free:
            following.value = number + 1
    return free


def _begun_there(
    pipe: Connection, claim: Callable[[int], bool], registration: Registration, folder: Path
) -> Callable[[], None]:
    """Hand the work over; what is returned helps with it, and logs what was said of it there."""
    from meshreg.report import draw_figures

    with suppress(OSError):  # told by `recv`
        pipe.send((registration, folder))

    def finish() -> None:
        draw_figures(registration, folder, scene_seconds=0, claim=claim)
        try:
            said = pipe.recv()
        except (EOFError, OSError) as error:
            LOG.debug("the process that draws has ended: %r", error)
            draw_figures(registration, folder)
            return
        if isinstance(said, BaseException):
            raise said
        for record in said:
            LOG.handle(record)

    return finish


def _serve(pipe: Connection, following: Any) -> None:
    """Wait for one registration, draw it, and send back what was logged, or the error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    gc.disable()  # it lives for one registration
    from meshreg.report import draw_figures, scene, style

    said: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    LOG.addHandler(logging.handlers.QueueHandler(said))
    LOG.setLevel(logging.INFO)
    with suppress(EOFError, OSError), scene.renderer() as ready:
        first = style.new_figure(2, 2, "loads fonts and much else")
        first.add_subplot().plot([0, 1], label="now, while there is time")
        first.canvas.draw()
        try:
            registration, folder = pipe.recv()
            claim = partial(_claimed, following)
            draw_figures(registration, folder, renderer=ready, claim=claim)
        except EOFError:
            raise
        except Exception as error:
            pipe.send(error)
        else:
            pipe.send([said.get() for _ in range(said.qsize())])
