"""The figures of a large pair are drawn by a second process.

Matplotlib holds the interpreter for seconds, in which nothing else of ours could go on. The process
is started while the surveys are registered, so that its imports cost no time. A small pair is not
worth one: there a thread does.
"""

from __future__ import annotations

import logging
import logging.handlers
import multiprocessing
import queue
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from meshreg.cli_parts.common import LOG
from meshreg.types import Maps

if TYPE_CHECKING:
    from meshreg.types import Registration, Survey

Draw = Callable[["Registration", Path], object]
LARGE = 500_000  # points or cells of both surveys together


def _frozen(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


# records hold their mappings frozen, which pickle does not know
ForkingPickler.register(MappingProxyType, lambda frozen: (_frozen, (dict(frozen),)))


@contextmanager
def draughtsman(*surveys: Survey) -> Iterator[Draw]:
    """Give what draws the figures of a registration of these surveys into a folder."""
    from meshreg.report import draw_figures

    if sum(_size(survey) for survey in surveys) < LARGE:
        yield draw_figures
        return
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs,), daemon=True)
    process.start()
    theirs.close()
    try:
        yield lambda registration, folder: _drawn_there(ours, registration, folder)
    finally:
        ours.close()
        process.terminate()
        process.join(5.0)


def _size(survey: Survey) -> int:
    geometry = survey.geometry
    return geometry.height.size if isinstance(geometry, Maps) else len(geometry.points)


def _drawn_there(pipe: Connection, registration: Registration, folder: Path) -> None:
    """Hand the work over and log what was said of it; draw here if the process is gone."""
    from meshreg.report import draw_figures

    try:
        pipe.send((registration, folder))
        said = pipe.recv()
    except (EOFError, OSError) as error:
        LOG.debug("the process that draws has ended: %r", error)
        draw_figures(registration, folder)
        return
    if isinstance(said, BaseException):
        raise said
    for record in said:
        LOG.handle(record)


def _serve(pipe: Connection) -> None:
    """Wait for one registration, draw it, and send back what was logged, or the error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    import matplotlib.backends.backend_agg  # noqa: F401 - now, while there is time

    from meshreg.report import draw_figures

    said: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    LOG.addHandler(logging.handlers.QueueHandler(said))
    LOG.setLevel(logging.INFO)
    with suppress(EOFError, OSError):
        try:
            draw_figures(*pipe.recv())
        except EOFError:
            raise
        except Exception as error:
            pipe.send(error)
        else:
            pipe.send([said.get() for _ in range(said.qsize())])
