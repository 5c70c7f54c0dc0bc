"""The report of a 25 m pair: kept, written, and opened in Chromium (median of 5, a new page each).

"Loaded" is until the load event's end; "answers" is until the swipe bar, moved by a key, is drawn.
"""

from __future__ import annotations

import importlib.util
import os
import statistics
import tempfile
from pathlib import Path
from typing import Any

from measure import ROOT, apart, timed

SIZE = 25.0
CHROMIUM = Path(os.environ.get("MESHREG_CHROMIUM", "/usr/bin/chromium"))


def job(folder: str) -> dict[str, Any]:
    """Register a made pair of maps and write its report; seconds of each, bytes of the page."""
    import meshreg
    from meshreg.benchmark import rasters
    from meshreg.benchmark.plan import Job
    from meshreg.cli.reporting import keep_evidence, write_report
    from meshreg.io.result.record import write_record_files

    def survey(name: str, dem: Any, ortho: Any) -> Any:
        height = dem.height + dem.datum
        maps = meshreg.Maps(height, dem.grid, ortho.color, ortho.color_valid, ortho.grid)
        return meshreg.Survey(name, maps, crs=dem.grid.crs)

    pairs, _ = rasters.make(Job("crossing", "abrolhos_12mo", 0, 1, SIZE))
    both = [
        survey(name, pairs["dem"][k], pairs["sift"][k])
        for k, name in enumerate(("reference", "moving"))
    ]
    registration = meshreg.register_pair(*both)
    out = Path(folder)
    write_record_files(registration, out)
    keeping = timed(keep_evidence, registration, out)
    writing = timed(write_report, out)
    size = (out / "report.html").stat().st_size
    return {"keep": keeping, "write": writing, "mb": size / 1e6, "verdict": registration.verdict}


def opened(folder: str) -> dict[str, float]:
    """Open the page in new windows of one browser: median seconds until loaded, until it answers.

    The browser itself is started before; its own start is no property of the page.
    """
    from playwright.sync_api import sync_playwright

    flags = _flags()
    loaded, answers, triangles = [], [], 0
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=flags)
        for _ in range(5):
            context = browser.new_context(viewport={"width": 1280, "height": 900})
            page = context.new_page()
            page.goto(Path(folder, "report.html").as_uri(), wait_until="load")
            loaded.append(
                page.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd")
            )
            page.locator("#mosaics .handle").press("End")
            answers.append(
                page.evaluate(
                    "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
                    ".then(() => performance.now())"
                )
            )
            page.locator(".stage.scene").scroll_into_view_if_needed()
            page.wait_for_selector(".stage.scene[data-triangles]")
            triangles = int(page.locator(".stage.scene").get_attribute("data-triangles") or 0)
            context.close()
        browser.close()
    seconds = [statistics.median(times) / 1000 for times in (loaded, answers)]
    return {"loaded": seconds[0], "answers": seconds[1], "triangles": triangles}


def _flags() -> list[str]:
    """Take the flags of the tests' browser: WebGL by software, nothing in the background."""
    path = ROOT / "tests" / "browser" / "conftest.py"
    spec = importlib.util.spec_from_file_location("browser_conftest", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return [*module.FLAGS, *(["--no-sandbox"] if os.geteuid() == 0 else [])]


def bench() -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        made = apart("report", "job", folder)
        rows = [
            {"step": "keep the evidence", "seconds": made["keep"]},
            {"step": "write report.html", "seconds": made["write"], "note": f"{made['mb']:.2f} MB"},
        ]
        if not CHROMIUM.exists():
            return [*rows, {"step": "open in Chromium", "note": f"no {CHROMIUM}"}]
        page = apart("report", "opened", folder)
        note = f"{page['triangles']:,} triangles in the 3-D view"
        return [
            *rows,
            {"step": "Chromium: loaded", "seconds": page["loaded"]},
            {"step": "Chromium: answers", "seconds": page["answers"], "note": note},
        ]
