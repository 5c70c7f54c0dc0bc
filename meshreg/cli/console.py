"""What the program says: results on stdout, progress and warnings on stderr, or JSON alone."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from meshreg.errors import MeshregError

STAGES = {
    "read": "reading",
    "rasterize": "rasterizing",
    "coarse": "searching in coarse cells",
    "vote": "looking for a turn or a scale",
    "turn": "turning the moving survey",
    "internal": "measuring the deformation",
    "sift": "matching image features",
    "terrain": "scanning the terrain",
    "mutual_information": "scanning for mutual information",
    "judge": "judging",
    "refine": "refining",
    "trials": "recovering known shifts",
    "surfaces": "polishing on the surfaces",
    "apply": "checking the result",
    "write": "writing",
    "figures": "drawing figures",
}


class _Console(Console):
    """A console that falls silent when nobody listens any more, and lets the work go on."""

    def on_broken_pipe(self) -> None:
        """Say nothing further."""
        self.quiet = True


class Terminal:
    """Where a command speaks: tables or one JSON document on stdout, the rest on stderr."""

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json
        # Where nobody watches, lines may be wider than the 80 columns of an unknown terminal.
        wide = None if sys.stdout.isatty() or "COLUMNS" in os.environ else 120
        self.out = _Console(highlight=False, width=wide)
        self.err = _Console(stderr=True, highlight=False, soft_wrap=True, quiet=as_json)

    def document(self, document: Any) -> None:
        """Print a JSON document on stdout; nothing else may be there."""
        from meshreg.io.result.document import to_json

        text = to_json(document)
        try:
            text.encode(sys.stdout.encoding or "utf-8")
        except UnicodeEncodeError:  # JSON can say any letter in ASCII
            text = "".join(c if ord(c) < 128 else json.dumps(c)[1:-1] for c in text)
        sys.stdout.write(text)
        sys.stdout.flush()

    def say(self, text: str, **styles: Any) -> None:
        """Print a line of the result; `text` is rich markup, so names in it must be escaped."""
        if not self.as_json:
            self.out.print(text, soft_wrap=not self.out.is_terminal, **styles)

    def warn(self, text: str) -> None:
        """Print a warning on stderr."""
        self.err.print(f"[yellow]warning:[/yellow] {escape(text)}")

    def error(self, error: MeshregError) -> None:
        """Say what is wrong, where, and what to do about it."""
        if self.as_json:
            self.document(error_document(error))
            return
        where = ", ".join(part for part in (error.file, error.place) if part)
        head = f"[red]error:[/red] {escape(where)}: " if where else "[red]error:[/red] "
        self.err.print(head + escape(error.message))
        if error.remedy:
            self.err.print(f"       {escape(error.remedy)}")


def error_document(error: MeshregError) -> dict[str, Any]:
    """Return what `--json` prints instead of a result."""
    return {
        "schema": "meshreg.error/1",
        "error": {
            "code": error.exit_code,
            "kind": type(error).__name__,
            "file": error.file,
            "place": error.place,
            "cause": error.message,
            "remedy": error.remedy,
        },
    }


class Progress:
    """A bar per stage on a terminal, a line per stage elsewhere, nothing under `--json`."""

    def __init__(self, voice: Terminal) -> None:
        from rich import progress as rich_progress

        self._voice = voice
        self._stage = ""
        self._began = 0.0
        self._bars: Any = None
        self._task: Any = None
        if voice.err.is_terminal and not voice.as_json:
            self._bars = rich_progress.Progress(
                rich_progress.TextColumn("{task.description:<32}"),
                rich_progress.BarColumn(),
                rich_progress.TaskProgressColumn(),
                rich_progress.TimeElapsedColumn(),
                console=voice.err,
            )

    def __call__(self, stage: str, fraction: float) -> None:
        """Report that `stage` is done to `fraction` (0 to 1)."""
        if stage != self._stage:
            self._finish()
            self._stage, self._began = stage, time.perf_counter()
            name = STAGES.get(stage, stage.replace("_", " "))
            if self._bars is not None:
                self._task = self._bars.add_task(name, total=1.0)
            else:
                self._voice.err.print(name)
        if self._bars is not None:
            self._bars.update(self._task, completed=min(max(fraction, 0.0), 1.0))

    def _finish(self) -> None:
        if self._bars is not None and self._task is not None:
            self._bars.update(self._task, completed=1.0)
            self._bars.stop_task(self._task)

    def __enter__(self) -> Progress:
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(self, kind: object, *rest: object) -> None:
        if kind is None:
            self._finish()
        if self._bars is not None:
            self._bars.stop()


class _WarningHandler(logging.Handler):
    """Says the library's warnings on stderr, each once."""

    def __init__(self, voice: Terminal) -> None:
        super().__init__(logging.WARNING)
        self._voice = voice
        self._said: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if text not in self._said:
            self._said.add(text)
            self._voice.warn(text)


class _LogFile(logging.FileHandler):
    """Writes all to a file; `failed` is the first thing that could not be written."""

    failed: BaseException | None = None

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 (logging's name)
        del record
        self.failed = self.failed or sys.exception()


@contextmanager
def logging_to(voice: Terminal, path: Path | None = None) -> Iterator[None]:
    """Send warnings to the voice, and everything to the file `path` while the block runs.

    Raises
    ------
    OSError
        At the end, if the file could not be written.
    """
    logger = logging.getLogger("meshreg")
    handlers: list[logging.Handler] = [_WarningHandler(voice)]
    file = None
    if path is not None:
        file = _LogFile(path, encoding="utf-8", errors="backslashreplace")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
        handlers.append(file)
    level = logger.level
    logger.setLevel(logging.DEBUG)
    for handler in handlers:
        logger.addHandler(handler)
    try:
        yield
        if file is not None and file.failed is not None:
            raise file.failed
    finally:
        logger.setLevel(level)
        for handler in handlers:
            logger.removeHandler(handler)
            handler.close()
