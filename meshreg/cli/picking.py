"""`meshreg pick`: from two surveys or a result to the page on which tie points are picked."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from meshreg.cli import pairing
from meshreg.cli.common import LOG, SurveyRequest, read
from meshreg.cli.console import Progress, Terminal, logging_to
from meshreg.cli.guard import StoppedError, Unfinished, run_stoppable
from meshreg.errors import UsageError
from meshreg.settings import Settings

if TYPE_CHECKING:
    from meshreg.ties.state import PickState


@dataclass(frozen=True)
class PickRequest:
    """Everything that `meshreg pick` was asked; without `moving`, `reference` is a result."""

    reference: SurveyRequest
    moving: SurveyRequest | None
    ties: Path
    registration: Path | None = None
    cell: float | None = None
    port: int = 0
    browser: bool = False
    settings: Settings = field(default_factory=Settings)
    allow_same: bool = False


@contextmanager
def _removed_in_any_case(folder: str) -> Iterator[None]:
    """Let a process that waits for the end of this one, however it comes, remove `folder`."""
    code = "import shutil, sys; sys.stdin.read(); shutil.rmtree(sys.argv[1], ignore_errors=True)"
    waiting = subprocess.Popen(
        [sys.executable, "-I", "-c", code, folder],
        stdin=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is for the page alone
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        assert waiting.stdin is not None
        waiting.stdin.close()
        waiting.wait()


def pick(request: PickRequest, voice: Terminal) -> None:
    """Show the page until Ctrl-C; every pair is in the file before the page says so."""
    from meshreg.ties.server import PickServer
    from meshreg.ties.session import only_one

    if not request.ties.absolute().parent.is_dir():
        raise UsageError(
            "lies in a folder that does not exist.", file=request.ties, remedy="Make it first."
        )
    with (
        tempfile.TemporaryDirectory(prefix="meshreg-pick-", ignore_cleanup_errors=True) as folder,
        _removed_in_any_case(folder),
        only_one(request.ties),
    ):

        def job(unfinished: Unfinished) -> PickState:
            with unfinished.holding(Path(folder)):
                return _desk(request, Path(folder), voice)

        desk = run_stoppable(job)
        server = PickServer(desk, request.port)
        with _terminable(server.stop) as terminated:
            _announce(server.url, request, voice)
            if request.browser:
                webbrowser.open(server.url)
            server.run()
        _say_end(desk, voice)
    if terminated:
        stopped = StoppedError(signal.SIGTERM)
        stopped.add_note(f"all pairs are in {request.ties}.")
        raise stopped


def _desk(request: PickRequest, folder: Path, voice: Terminal) -> PickState:
    with logging_to(voice), Progress(voice) as progress:
        if request.moving is None:
            return _desk_of_result(request, folder)
        return _desk_of_surveys(request, request.moving, folder, progress)


def _desk_of_result(request: PickRequest, folder: Path) -> PickState:
    """Lay out a result's own pictures: the moving one is of the registered survey."""
    from meshreg.ties.pictures import write_relief
    from meshreg.ties.placing import read_placing
    from meshreg.ties.session import Session
    from meshreg.ties.state import PickState
    from meshreg.ties.tiles import TileSource

    out = Path(request.reference.path)
    if not (out / "registration.json").is_file():
        raise UsageError(
            "is one survey; pairs are picked in two.",
            file=out,
            remedy="Give meshreg pick REFERENCE MOVING, or the folder of a registration.",
        )
    placing = read_placing(out)
    sources = []
    for which in ("reference", "moving"):
        picture = out / f"{which}_ortho.tif"
        if not all((out / f"{w}_ortho.tif").is_file() for w in ("reference", "moving")):
            picture = folder / f"{which}.tif"
            write_relief(out / f"{which}_dem.tif", picture)
        sources.append(TileSource(picture))
    record = placing.registration
    names = (record.reference.get("name") or "reference", record.moving.get("name") or "moving")
    session = Session(request.ties, record.reference.get("crs"))
    settings = request.settings.sift
    return PickState(
        sources[0], sources[1], names, session, placing, registered=True, settings=settings
    )


def _desk_of_surveys(
    request: PickRequest, moving_request: SurveyRequest, folder: Path, progress: Progress
) -> PickState:
    from meshreg.io.frames.place import common_crs
    from meshreg.raster.grid import choose_cells
    from meshreg.ties.pictures import write_picture
    from meshreg.ties.placing import read_placing
    from meshreg.ties.session import Session
    from meshreg.ties.state import PickState
    from meshreg.ties.tiles import TileSource

    placing = None if request.registration is None else read_placing(request.registration)
    progress("read", 0.0)
    reference = read(request.reference, "reference")
    progress("read", 0.5)
    requests = (request.reference, moving_request)
    moving = read(moving_request, "moving")
    if not request.allow_same:
        from meshreg.pipeline import require_different

        require_different(reference, moving)
    radius = request.settings.search.radius or 10.0
    moving, notes = pairing.same_frame(requests, (reference, moving), radius)
    moving, more = common_crs(reference, moving)
    for note in (*notes, *more):
        LOG.warning("%s", note)
    session = Session(request.ties, reference.crs)
    cells = choose_cells(reference, moving, request.settings.raster)
    cell = request.cell or min(cells.sift or cells.ortho, cells.ortho)
    sources = []
    for done, (name, survey) in enumerate((("reference", reference), ("moving", moving))):
        progress("rasterize", done / 2)
        path = folder / f"{name}.tif"
        write_picture(survey, path, cell, request.settings.raster)
        sources.append(TileSource(path))
    progress("rasterize", 1.0)
    names = (reference.name, moving.name)
    return PickState(
        sources[0], sources[1], names, session, placing, settings=request.settings.sift
    )


def _announce(url: str, request: PickRequest, voice: Terminal) -> None:
    if voice.as_json:
        voice.document({"schema": "meshreg.pick/1", "url": url, "ties": str(request.ties)})
        return
    voice.say(f"Pick tie points at [bold]{escape(url)}[/]")
    voice.say(
        f"The address works once. Every pair is saved in {escape(str(request.ties))} at once."
    )
    voice.say("Ctrl-C ends it.")


def _say_end(desk: PickState, voice: Terminal) -> None:
    from meshreg.ties.hand import free_hand

    ties = desk.session.ties
    voice.say(f"\n{len(ties.complete)} pairs are in {escape(str(desk.session.path))}.")
    hand, _ = free_hand(ties, desk.settings)
    if hand is not None:
        voice.say(
            f"Hand registration: {hand.east:+.3f} m east, {hand.north:+.3f} m north; "
            f"{int(hand.inliers.sum())} pairs agree, mean residual {hand.residual:.3f} m."
        )


@contextmanager
def _terminable(stop: Callable[[], None]) -> Iterator[list[int]]:
    """Let SIGTERM end the server and then the block, instead of the process on the spot."""
    heard: list[int] = []

    def hear(number: int, frame: Any) -> None:
        del frame
        heard.append(number)
        stop()

    before = signal.signal(signal.SIGTERM, hear)
    try:
        yield heard
    finally:
        signal.signal(signal.SIGTERM, before)
