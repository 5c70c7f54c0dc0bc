"""`report.html`: one file that holds everything it shows; nothing in it is fetched.

Made from the finished record and what `keep` kept of its evidence. The page's policy lists the
hashes of its own style and scripts and allows nothing else.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable
from importlib import resources

from meshreg.records import Registration
from meshreg.report import answer, comparing, findings, provenance
from meshreg.report.markup import say
from meshreg.report.result import Result, name_of

_SCRIPTS = ("viewer.js", "section.js", "scene.js")
# Name, title in the list of contents, and the function that writes it, or nothing.
SECTIONS: tuple[tuple[str, str, Callable[[Result], str]], ...] = (
    ("verdict", "Verdict", answer.verdict),
    ("mosaics", "Mosaics", comparing.mosaics),
    ("relief", "Relief", comparing.relief),
    ("section", "Section", comparing.section),
    ("left", "What is left", findings.left_over),
    ("found", "How it was found", findings.found),
    ("scene", "3-D", comparing.scene),
    ("methods", "Methods", provenance.methods),
    ("surveys", "Surveys", provenance.surveys),
    ("record", "Record", provenance.record),
)


def report_page(result: Result) -> str:
    """Return the page as HTML text."""
    r = result.registration
    reference, moving = (name_of(entry) for entry in (r.reference, r.moving))
    style, scripts = _asset("report.css"), [_asset(name) for name in _SCRIPTS]
    policy = (
        "default-src 'none'; img-src data:; base-uri 'none'; form-action 'none'; "
        f"style-src {_digest(style)}; script-src {' '.join(_digest(s) for s in scripts)}; "
        "require-trusted-types-for 'script'; trusted-types 'none'"
    )
    parts = [(name, title, make(result)) for name, title, make in SECTIONS]
    links = "".join(
        f'<li><a href="#{name}">{title}</a></li>' for name, title, html in parts if html
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="referrer" content="no-referrer">\n'
        f"<title>{say(f'{moving} on {reference}: {r.verdict}')}</title>\n"
        f"<style>{style}</style>\n</head>\n<body>\n"
        f'<header class="top"><div><div class="brand">meshreg registration report</div>'
        f"<h1>{say(moving)} <small>laid on</small> {say(reference)}</h1></div>"
        '<button id="theme" class="js-only" type="button">Dark</button></header>\n'
        f'<nav class="toc" aria-label="Contents"><ul>{links}</ul></nav>\n<main>\n'
        + "\n".join(html for _, _, html in parts if html)
        + f"\n</main>\n<footer>{_foot(r)}</footer>\n"
        + "".join(f"<script>{script}</script>\n" for script in scripts)
        + "</body>\n</html>\n"
    )


def _foot(r: Registration) -> str:
    version = r.versions.get("meshreg", "")
    return say(f"Made by meshreg {version} from registration.json. Nothing here was fetched.")


def _asset(name: str) -> str:
    return resources.files("meshreg.report").joinpath("assets", name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
