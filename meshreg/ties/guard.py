"""Who may speak to the page's server: this machine, at its own address, with the token's cookie.

Other users of the machine and pages from elsewhere can reach a port on 127.0.0.1 too. The token
in the printed address works once and buys a cookie that scripts cannot read and that no other
site's request carries; a request under another host name (DNS rebinding) or origin is refused.
"""

from __future__ import annotations

import secrets
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs

POLICY = (
    "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
_REFUSED = (
    b"Refused. Open the address that `meshreg pick` printed; it works once. "
    b"For another, start it again: nothing is lost.\n"
)


class Guard:
    """ASGI middleware that lets nobody else in, and adds the headers of every answer.

    Attributes
    ----------
    token : str
        For the first request, as ``/?token=...``.
    """

    def __init__(self, app: Any, port: int) -> None:
        self.app = app
        self.token = secrets.token_urlsafe(32)
        self._unused = True
        self._cookie_name = f"meshreg_pick_{port}"  # cookies are shared by all ports of a host
        self._cookie = secrets.token_urlsafe(32)
        self._hosts = {f"{name}:{port}".encode() for name in ("127.0.0.1", "localhost")}

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer a request, or refuse it with 403."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
        if scope["type"] != "http":
            return
        headers = dict(scope["headers"])
        extra = list(_HEADERS)
        origin = headers.get(b"origin")
        at_home = headers.get(b"host") in self._hosts and (
            origin is None or origin.removeprefix(b"http://") in self._hosts
        )
        known = at_home and self._knows(headers.get(b"cookie", b""))
        if at_home and not known and self._redeem(scope):
            known = True
            cookie = f"{self._cookie_name}={self._cookie}; Path=/; HttpOnly; SameSite=Strict"
            extra.append((b"set-cookie", cookie.encode()))

        async def send_more(message: Any) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        if known:
            await self.app(scope, receive, send_more)
            return
        plain = [(b"content-type", b"text/plain; charset=utf-8"), (b"cache-control", b"no-store")]
        await send_more({"type": "http.response.start", "status": 403, "headers": plain})
        await send_more({"type": "http.response.body", "body": _REFUSED})

    def _knows(self, header: bytes) -> bool:
        try:
            cookies = SimpleCookie(header.decode("latin-1"))
        except CookieError:
            return False
        morsel = cookies.get(self._cookie_name)
        return morsel is not None and secrets.compare_digest(
            morsel.value.encode(), self._cookie.encode()
        )

    def _redeem(self, scope: Any) -> bool:
        """Take the token, once, on the way to the page itself."""
        if scope["path"] != "/" or scope["method"] != "GET" or not self._unused:
            return False
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if not secrets.compare_digest(given.encode(), self.token.encode()):
            return False
        self._unused = False
        return True
