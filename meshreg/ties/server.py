"""The page's server: Starlette behind `guard.Guard`, by uvicorn, on 127.0.0.1 alone."""

from __future__ import annotations

import asyncio
import re
import socket
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from meshreg.errors import MeshregError, OutputError
from meshreg.io.files.checked_json import parse_json
from meshreg.ties.guard import Guard
from meshreg.ties.session import StaleError
from meshreg.ties.state import PickState

ASSETS = Path(__file__).parent / "assets"
HOST = "127.0.0.1"
_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
}
_MAX_BODY = 16_384  # bytes; a change has some hundred
SLOWEST = 10.0  # seconds that a request may take to arrive
_WORKERS = 4  # threads that read tiles: each holds two open files


def _protocol() -> Any:
    """Return uvicorn's protocol, which closes a connection whose request does not come whole."""
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class Protocol(H11Protocol):
        _deadline: asyncio.TimerHandle | None = None

        def _is_waiting(self) -> bool:
            return self.cycle is None or self.cycle.response_complete

        def _watch(self) -> None:
            if self._deadline is not None and not self._is_waiting():
                self._deadline.cancel()
                self._deadline = None
            elif self._deadline is None and self._is_waiting():
                self._deadline = self.loop.call_later(SLOWEST, self._give_up)

        def _give_up(self) -> None:
            self._deadline = None
            if self._is_waiting() and not self.transport.is_closing():
                self.transport.close()

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._watch()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._watch()

        def connection_lost(self, exc: Exception | None) -> None:
            if self._deadline is not None:
                self._deadline.cancel()
            super().connection_lost(exc)

    return Protocol


class PickServer:
    """Serves one desk until it is told to stop.

    Parameters
    ----------
    desk : PickState
    port : int
        0 takes a free one.

    Attributes
    ----------
    url : str
        With the token, for one use.
    """

    def __init__(self, desk: PickState, port: int = 0) -> None:
        import uvicorn

        self.desk = desk
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind((HOST, port))
            self._socket.listen(64)  # who comes before `run` waits
        except OSError as error:
            self._socket.close()
            raise OutputError(
                f"Port {port} of {HOST} cannot be used: {error.strerror or error}.",
                remedy="Leave --port out, or choose another.",
            ) from error
        self.port = int(self._socket.getsockname()[1])
        self._pool = ThreadPoolExecutor(_WORKERS, thread_name_prefix="meshreg pick")
        guard = Guard(make_app(desk, self._pool), self.port)
        self.url = f"http://{HOST}:{self.port}/?token={guard.token}"
        config = uvicorn.Config(
            guard,
            log_config=None,
            access_log=False,
            server_header=False,
            lifespan="off",
            ws="none",
            http=_protocol(),
            h11_max_incomplete_event_size=_MAX_BODY,
            timeout_graceful_shutdown=2,
        )
        self._server = uvicorn.Server(config)

    def run(self) -> None:
        """Serve until Ctrl-C, SIGTERM or `stop`."""
        try:
            self._server.run(sockets=[self._socket])
        except KeyboardInterrupt:  # uvicorn ends in good order, then raises the signal again
            pass
        finally:
            self._pool.shutdown()
            self._socket.close()
            self.desk.reference.close()
            self.desk.moving.close()

    def stop(self) -> None:
        """Let `run` come back (from another thread)."""
        self._server.should_exit = True


def make_app(desk: PickState, pool: ThreadPoolExecutor) -> Any:
    """Return the ASGI application, without its guard.

    Parameters
    ----------
    desk : PickState
    pool : ThreadPoolExecutor
        For what reads files or computes.
    """
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import JSONResponse, Response
    from starlette.routing import Route

    async def run(work: Any, *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(pool, partial(work, *arguments))

    def answer(content: Any, status: int = 200) -> Response:
        return JSONResponse(content, status, headers={"cache-control": "no-store"})

    def file(name: str) -> Response:
        path = ASSETS / name
        headers = {"cache-control": "no-cache"}
        return Response(path.read_bytes(), headers=headers, media_type=_TYPES[path.suffix])

    async def page(request: Request) -> Response:
        return file("pick.html")

    async def asset(request: Request) -> Response:
        name = request.path_params["name"]
        known = {path.name for path in ASSETS.iterdir() if path.suffix in _TYPES}
        return file(name) if name in known else answer({"error": "There is no such file."}, 404)

    async def job(request: Request) -> Response:
        return answer(desk.job())

    async def state(request: Request) -> Response:
        if request.query_params.get("since") == str(desk.session.revision):
            return Response(status_code=204, headers={"cache-control": "no-store"})
        return answer(await run(desk.state))

    async def tile(request: Request) -> Response:
        at = request.path_params
        source = desk.reference if at["side"] == "reference" else desk.moving
        if at["side"] not in ("reference", "moving"):
            return answer({"error": "There is no such picture."}, 404)
        numbers = [at[name] for name in ("level", "column", "row")]
        if not all(re.fullmatch(r"[0-9]{1,9}", number) for number in numbers):
            return answer({"error": "There is no such tile."}, 404)
        png = await run(source.tile, *map(int, numbers))
        if png is None:
            return answer({"error": "There is no such tile."}, 404)
        headers = {"cache-control": "private, max-age=86400"}
        return Response(png, headers=headers, media_type="image/png")

    async def change(request: Request) -> Response:
        try:
            values = await asyncio.wait_for(_body(request), SLOWEST)
            revision, what = values.pop("revision"), values.pop("what")
        except TimeoutError:
            return answer({"error": "The change did not come in time."}, 408)
        except (MeshregError, ValueError, KeyError, TypeError, RecursionError):
            return answer({"error": "A change is a small JSON object with revision and what."}, 400)
        try:
            await run(desk.change, revision, str(what), values)
        except StaleError as error:
            return answer({"error": str(error), "state": await run(desk.state)}, 409)
        except MeshregError as error:
            return answer({"error": str(error)}, 500 if isinstance(error, OutputError) else 400)
        return answer(await run(desk.state))

    return Starlette(
        routes=[
            Route("/", page),
            Route("/assets/{name}", asset),
            Route("/api/job", job),
            Route("/api/state", state),
            Route("/api/change", change, methods=["POST"]),
            Route("/tiles/{side}/{level}/{column}/{row}.png", tile),
        ]
    )


async def _body(request: Any) -> dict[str, Any]:
    """Return a small JSON object; ValueError for anything else."""
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        raise ValueError("not JSON")
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > _MAX_BODY:
            raise ValueError("too large")
    values = parse_json(body, Path("the change"))
    if not isinstance(values, dict):
        raise ValueError("no object")
    return values
