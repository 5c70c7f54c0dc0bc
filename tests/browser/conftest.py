"""A real browser for the tests of pages: Debian's Chromium, driven by Playwright."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

CHROMIUM = Path(os.environ.get("MESHREG_CHROMIUM", "/usr/bin/chromium"))
FLAGS = [
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--disable-gpu-compositing",
    "--enable-unsafe-swiftshader",
]


def _lacking(why: str) -> None:
    """Skip with the reason, or fail where the environment asks for a browser."""
    wanted = os.environ.get("MESHREG_REQUIRE", "")
    if wanted == "all" or "chromium" in wanted.split(","):
        pytest.fail(f"MESHREG_REQUIRE asks for chromium, which fails: {why}", pytrace=False)
    pytest.skip(f"needs chromium: {why}")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Give a headless browser (`playwright.sync_api.Browser`)."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError as error:
        _lacking(str(error))
    if not CHROMIUM.exists():
        _lacking(f"no {CHROMIUM}; apt-get install chromium")
    # Chromium's own sandbox refuses to run as root.
    flags = FLAGS + (["--no-sandbox"] if os.geteuid() == 0 else [])
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=flags)
        except Error as error:
            _lacking(str(error).splitlines()[0])
        yield browser
        browser.close()


@pytest.fixture
def browser_page(chromium: Any) -> Iterator[Any]:
    """Give a page (`playwright.sync_api.Page`) that must stay quiet and at home.

    At the end of the test there may be no error on its console, and no request to anything but
    files, data and this machine.
    """
    context = chromium.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text) if _is_bad(message) else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    asked: list[str] = []
    context.on("request", lambda request: asked.append(request.url))
    yield page
    context.close()
    assert said == []
    assert [url for url in asked if not _is_home(url)] == []


def _is_bad(message: Any) -> bool:
    return message.type in ("error", "warning") and "GPU stall" not in message.text


def _is_home(url: str) -> bool:
    parts = urlsplit(url)
    here = parts.hostname in ("127.0.0.1", "localhost")
    return parts.scheme in ("file", "data", "blob", "about") or here
