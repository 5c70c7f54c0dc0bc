"""HTML as text: everything that comes from outside is escaped here."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any
from urllib.parse import quote


def say(value: Any) -> str:
    """Escape a value for text and for quoted attributes."""
    return escape(str(value), quote=True)


def section(name: str, title: str, lead: str, *parts: str) -> str:
    """Return a section of the page, or nothing where none of its parts has anything to show."""
    inside = "\n".join(part for part in parts if part)
    if not inside:
        return ""
    said = f'<p class="lead">{lead}</p>' if lead else ""
    return f'<section id="{name}"><h2>{say(title)}</h2>{said}\n{inside}\n</section>'


def figure(body: str, caption: str, classes: str = "") -> str:
    """Wrap a drawing; `caption` is HTML."""
    if not body:
        return ""
    named = f' class="{classes}"' if classes else ""
    return f"<figure{named}>{body}<figcaption>{caption}</figcaption></figure>"


def columns(*parts: str) -> str:
    """Put parts beside each other where the page is wide enough."""
    found = [part for part in parts if part]
    return f'<div class="columns">{"".join(found)}</div>' if found else ""


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[Any]],
    numeric: Iterable[int] = (),
    look: str = "",
) -> str:
    """Return a table; cells are escaped unless they are `Markup`."""
    named = f' class="{look}"' if look else ""
    right = set(numeric)
    side = [' class="n"' if k in right else "" for k in range(len(head))]
    names = "".join(f"<th{s}>{say(name)}</th>" for s, name in zip(side, head, strict=True))
    body = "".join(
        "<tr>"
        + "".join(f"<td{s}>{_cell(c)}</td>" for s, c in zip(side, row, strict=True))
        + "</tr>"
        for row in rows
    )
    return (
        f'<div class="scroll"><table{named}><thead><tr>{names}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def _cell(value: Any) -> str:
    return value if isinstance(value, Markup) else say(value)


def chip(status: str) -> Markup:
    """Return a method's status as a colored word."""
    return Markup(f'<span class="chip {say(status)}">{say(status)}</span>')


def data_uri(picture: Any) -> str:
    """Return WebP bytes as an address that is allowed by `img-src data:`."""
    return "data:image/webp;base64," + base64.b64encode(bytes(picture)).decode("ascii")


def packed(array: Any) -> str:
    """Return an array's bytes as base64."""
    return base64.b64encode(array.tobytes()).decode("ascii")


def link(name: str, text: str = "") -> Markup:
    """Return a link to a file beside the page."""
    return Markup(f'<a href="{say(quote(name))}">{say(text or name)}</a>')


def json_block(name: str, value: Any) -> str:
    """Return data for the page's scripts; no text in it can end the element."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'


def number(value: Any, form: str = "+.3f", missing: str = "–") -> str:
    """Format a number; what is none or not finite is a dash."""
    if value is None or not math.isfinite(value):
        return missing
    return format(value, form).replace("-", "\N{MINUS SIGN}")
