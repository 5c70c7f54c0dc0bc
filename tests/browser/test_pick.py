"""The page of `meshreg pick` in a real browser: clicks on a pair whose truth is known."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2 as httpx
import numpy as np
import pytest

from data_synth.rasters import RasterPair, make_rasters
from data_synth.recipe import load
from data_synth.truth import common_points
from meshreg.cli import app as cli
from meshreg.io.maps.pair import write_raster
from meshreg.io.result.document import registration_document, to_json
from meshreg.records import OffsetEstimate, Registration, Transform
from meshreg.settings import Settings
from meshreg.ties import read_ties

OFF = np.array([0.03, -0.04])  # how far the registration that is validated is wrong [m]


@pytest.fixture(scope="module")
def pair() -> RasterPair:
    """8 m of a boulder field, twice, apart by one offset: no warp, no turn."""
    still = {"sfm.warp": 0.0, "sfm.yaw": 0.0, "sfm.offset_length": 1.5}
    return make_rasters(load("tasmania_12h", still), 3, 8.0, 0.1, 0.02)


@pytest.fixture(scope="module")
def surveys(pair: RasterPair, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    folder = tmp_path_factory.mktemp("maps")
    names = []
    for which in ("reference", "moving"):
        files = [folder / f"{which}_{kind}.tif" for kind in ("dem", "ortho")]
        write_raster(getattr(pair, f"{which}_dem"), files[0], "height")
        write_raster(getattr(pair, f"{which}_ortho"), files[1], "color")
        names.append(",".join(map(str, files)))
    return names[0], names[1]


@dataclass(frozen=True)
class Running:
    """A `meshreg pick` that waits for clicks; `url` works once."""

    url: str
    ties: Path
    stop: Callable[[], int]

    @property
    def home(self) -> str:
        return self.url.partition("?")[0]


@contextlib.contextmanager
def picking(*arguments: str, ties: Path) -> Iterator[Running]:
    command = [sys.executable, "-m", "meshreg", "pick", *arguments, "-o", str(ties), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said = ""
        while not said.endswith("}\n"):
            line = process.stdout.readline()
            assert line, f"meshreg pick ended: {said}"
            said += line

        def stop() -> int:
            process.send_signal(signal.SIGINT)
            return process.wait(20)

        try:
            yield Running(json.loads(said)["url"], ties, stop)
        finally:
            process.terminate()


@pytest.fixture
def running(surveys: tuple[str, str], tmp_path: Path) -> Iterator[Running]:
    """A server for one test, asked for before the browser so that it outlives the page."""
    with picking(*surveys, ties=tmp_path / "ties.csv") as found:
        yield found


def opened(page: Any, url: str) -> Any:
    """Open the page, wide enough to show all of both pictures however they are laid together."""
    page.set_viewport_size({"width": 1600, "height": 1000})
    page.goto(url)
    page.wait_for_selector("html[data-ready]", state="attached")
    page.mouse.move(*middle(page, "reference"))
    page.mouse.wheel(0, 150)
    still(page)
    return page


def still(page: Any) -> None:
    """Wait until both pictures have stopped gliding."""
    view = "() => Object.values(meshregPick.pictures).flatMap((p) => [p.view.getResolution(), " \
        "...p.centre(), p.view.getAnimating() ? Math.random() : 0])"  # fmt: skip
    before, same = None, 0
    for _ in range(200):
        page.wait_for_timeout(50)
        now = page.evaluate(view)
        same = same + 1 if now == before else 0
        if same >= 4:
            return
        before = now
    raise AssertionError("the pictures never come to rest")


def middle(page: Any, side: str) -> tuple[float, float]:
    box = page.locator(f"#{side}").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def pixel_of_screen(page: Any) -> float:
    """Metres."""
    return float(page.evaluate("meshregPick.pictures.reference.view.getResolution()"))


def where(page: Any, side: str, place: Any) -> tuple[float, float]:
    """Where a place is on the screen, by what the page itself says of its view."""
    x, y = page.evaluate(
        "([side, place]) => meshregPick.pictures[side].pixel(place)",
        [side, [float(v) for v in place]],
    )
    return float(x), float(y)


def click(page: Any, side: str, place: Any) -> None:
    before = page.evaluate("meshregPick.state().revision")
    x, y = where(page, side, place)
    box = page.locator(f"#{side}").bounding_box()
    assert box["x"] < x < box["x"] + box["width"], "the place is not on the screen"
    assert box["y"] < y < box["y"] + box["height"], "the place is not on the screen"
    page.mouse.click(x, y)
    settled(page, before)


def settled(page: Any, before: int) -> None:
    """Wait until the server has taken the change, and the page shows it."""
    for _ in range(200):
        if page.evaluate("meshregPick.idle().then(() => meshregPick.state().revision)") > before:
            return
        page.wait_for_timeout(20)
    raise AssertionError(f"nothing happened: {page.locator('#alert').text_content()}")


def chosen_points(pair: RasterPair, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the ground that both surveys show, a hand's breadth apart at least."""
    moving, reference = common_points(pair.scene, 0.25)
    inner = np.ones(len(moving), bool)
    for points in (moving, reference):
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        inner &= ((points[:, :2] > low + 0.4) & (points[:, :2] < high - 0.4)).all(axis=1)
    places = np.flatnonzero(inner)
    rng = np.random.default_rng(5)
    found: list[int] = []
    for k in rng.permutation(places):
        if all(np.hypot(*(moving[k, :2] - moving[i, :2])) > 0.6 for i in found):
            found.append(int(k))
        if len(found) == count:
            return moving[found, :2], reference[found, :2]
    raise AssertionError("the patch is too small")


def write_result(pair: RasterPair, folder: Path) -> None:
    """A registration that is wrong by OFF, and one method that is right."""
    true = np.array(pair.truth["offset"])
    centre = np.array(pair.truth["centroid"])
    off = np.append(OFF, 0.0)
    entry = {"name": "boulders", "path": [], "sha256": [], "counts": {}, "shift": None, "crs": None}
    registration = Registration(
        "accepted", "made for a test", Transform(offset=true + off, pivot=centre), None,
        (OffsetEstimate("sift", "ok", "", true[0], true[1]),), (), {}, {},
        entry, entry, Settings().as_dict(), {}, {},
    )  # fmt: skip
    folder.mkdir()
    text = to_json(registration_document(registration))
    (folder / "registration.json").write_text(text, encoding="utf-8")


def test_25_pairs_clicked_give_the_true_offset(
    running: Running, browser_page: Any, pair: RasterPair, tmp_path: Path
) -> None:
    page = opened(browser_page, running.url)
    assert page.url == running.home, "the token stays in the address"
    pixel = pixel_of_screen(page)
    assert 0.01 < pixel < 0.03
    moving, reference = chosen_points(pair, 25)
    rng = np.random.default_rng(7)
    shaken = [points + rng.normal(0, 0.01, points.shape) for points in (reference, moving)]
    shaken[1][[4, 17]] += [[0.45, -0.2], [-0.3, 0.5]]  # clicked on the wrong thing
    for k in range(25):
        order = ("reference", "moving") if k % 2 else ("moving", "reference")
        for side in order:
            click(page, side, shaken[side == "moving"][k])
        # saved before the page says so
        assert len(read_ties(running.ties).complete) == k + 1

    assert page.locator("#hand-inliers").text_content() == "23 of 25"
    assert page.locator("#pairs tr.wrong").count() == 2
    state = page.evaluate("meshregPick.state()")
    page.goto("about:blank")
    assert [p["id"] for p in state["pairs"] if not p["inlier"]] == [5, 18]
    assert state["hand"]["inliers"] == 23
    assert running.stop() == 0
    # the file holds what was clicked, to half a pixel of the screen
    saved = read_ties(running.ties).arrays()
    for found, meant in zip(saved, shaken, strict=True):
        assert 0 < np.abs(found - meant).max() < 0.55 * pixel

    out = tmp_path / "OUT"
    write_result(pair, out)
    assert cli.run(["validate", str(out), str(running.ties)]) == 0
    document = json.loads((out / "validation.json").read_text())
    true = np.array(pair.truth["offset"])[:2]
    hand = np.array([document["hand"]["east"], document["hand"]["north"]])
    assert np.hypot(*(hand - true)) < 0.02
    assert document["methods"]["sift"]["error"] < 0.02
    assert document["fused"]["error"] == pytest.approx(0.05, abs=0.02)
    assert 0.005 < document["hand"]["residual_inliers"] < 0.03

    page.goto((out / "report.html").as_uri())  # where a user finds it
    assert "Confirmed by tie points" in page.locator("#verdict").text_content()
    page.locator("#verdict a", has_text="comparison").click()
    assert page.url == (out / "validation.html").as_uri()
    assert "Confirmed" in page.locator(".verdict").text_content()
    page.locator("a", has_text="Report").click()
    assert page.url == (out / "report.html").as_uri()


def test_reload_resumes_and_changes_can_be_taken_back(
    running: Running, browser_page: Any, pair: RasterPair
) -> None:
    page = opened(browser_page, running.url)
    moving, reference = chosen_points(pair, 4)
    for k in range(3):
        click(page, "reference", reference[k])
        click(page, "moving", moving[k])
    page.locator("#pairs tr[data-id='2'] input").fill("brain <b>coral</b>")
    before = page.evaluate("meshregPick.state().revision")
    page.keyboard.press("Enter")
    settled(page, before)
    click(page, "reference", reference[3])  # left open

    page.reload()
    page.wait_for_selector("html[data-ready]", state="attached")
    assert page.locator("#pairs tr").count() == 4
    assert page.locator("#pairs tr[data-id='2'] input").input_value() == "brain <b>coral</b>"
    assert page.locator("#pairs b").count() == 0
    assert "moving" in page.locator("#next").text_content()
    click(page, "moving", moving[3])
    assert len(read_ties(running.ties).complete) == 4

    for what, left in (("Control+z", 3), ("Control+Shift+z", 4)):
        before = page.evaluate("meshregPick.state().revision")
        page.keyboard.press(what)
        settled(page, before)
        assert len(read_ties(running.ties).complete) == left

    # dragging a point corrects it
    x, y = where(page, "moving", moving[3])
    before = page.evaluate("meshregPick.state().revision")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 30, y, steps=5)
    page.mouse.up()
    settled(page, before)
    moved = np.array(read_ties(running.ties).pairs[3].moving) - moving[3]
    assert 0.3 < moved[0] < 0.7
    assert abs(moved[1]) < 0.03


def test_keys_alone_can_pick(running: Running, browser_page: Any) -> None:
    page = opened(browser_page, running.url)
    for side in ("reference", "moving"):
        page.locator(f"#{side}").focus()
        page.keyboard.press("ArrowRight")
        still(page)
        before = page.evaluate("meshregPick.state().revision")
        place = page.evaluate(f"meshregPick.pictures.{side}.centre()")
        page.keyboard.press("Enter")
        settled(page, before)
        picked = getattr(read_ties(running.ties).pairs[0], side)
        assert np.allclose(picked, place, rtol=0, atol=1e-3)
    before = page.evaluate("meshregPick.state().revision")
    page.keyboard.press("n")
    page.keyboard.press("Delete")
    settled(page, before)
    assert read_ties(running.ties).pairs == ()


def test_the_magnifier_makes_way_and_the_focus_is_seen(running: Running, browser_page: Any) -> None:
    page = opened(browser_page, running.url)
    lens = page.locator("#reference .lens")
    box = page.locator("#reference").bounding_box()

    def left_edge(x: float, y: float) -> float:
        page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
        page.wait_for_timeout(50)
        return float(lens.bounding_box()["x"] - box["x"])

    assert left_edge(0.5, 0.3) > 0.5 * box["width"]
    assert left_edge(0.9, 0.95) < 0.2 * box["width"]  # it would hide what is pointed at
    assert left_edge(0.1, 0.95) > 0.5 * box["width"]
    page.keyboard.press("m")
    assert not lens.is_visible()

    # every control can be reached by Tab, has a name, and shows the focus
    page.locator("#undo").evaluate("(button) => { button.disabled = false; button.focus(); }")
    seen = []
    for _ in range(12):
        page.keyboard.press("Tab")
        seen.append(
            page.evaluate(
                """() => {
                const at = document.activeElement, style = getComputedStyle(at);
                const above = getComputedStyle(at, "::before");
                const name = at.getAttribute("aria-label") || at.title
                  || at.labels?.[0]?.textContent || at.textContent;
                return [at.id || at.className, name.trim(),
                  style.outlineStyle !== "none" || above.boxShadow !== "none"];
                }"""
            )
        )
    assert {"lens", "hint", "help-button", "reference", "moving"} <= {name for name, *_ in seen}
    assert all(name and marked for where_, name, marked in seen if where_)


def test_pictures_move_together(running: Running, browser_page: Any, pair: RasterPair) -> None:
    page = opened(browser_page, running.url)
    centres = "['reference', 'moving'].map((side) => meshregPick.pictures[side].centre())"
    first, second = np.array(page.evaluate(centres))
    assert np.allclose(first, second)  # as delivered: nothing is known yet
    moving, reference = chosen_points(pair, 3)
    for k in range(3):
        click(page, "reference", reference[k])
        click(page, "moving", moving[k])
    x, y = where(page, "reference", first)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 60, y + 25, steps=6)
    page.mouse.up()
    page.mouse.wheel(0, -300)
    still(page)
    panned, followed = np.array(page.evaluate(centres))
    assert np.abs(panned - first).max() > 0.3
    hand = page.evaluate("meshregPick.state().hand")
    assert np.allclose(panned - followed, [hand["east"], hand["north"]], rtol=0, atol=1e-6)
    true = np.array(pair.truth["offset"])[:2]
    assert np.abs(panned - followed - true).max() < 0.03
    sizes = page.evaluate(
        "['reference', 'moving'].map((side) => meshregPick.pictures[side].view.getResolution())"
    )
    assert sizes[0] == pytest.approx(sizes[1])


def test_two_windows_do_not_harm_the_file(
    running: Running, chromium: Any, pair: RasterPair
) -> None:
    context = chromium.new_context()  # a refused change is an error on the console, here meant
    first = opened(context.new_page(), running.url)
    second = opened(context.new_page(), running.home)
    for page in (first, second):
        page.select_option("#link", "none")  # so that nothing moves between look and click
    pixel = pixel_of_screen(first)
    moving, reference = chosen_points(pair, 6)
    # The second window knows nothing of this yet: its click comes too late, is refused, and told.
    second.route("**/api/state?since=*", lambda route: route.fulfill(status=204))
    click(first, "reference", reference[0])
    x, y = where(second, "reference", reference[1])
    second.mouse.click(x, y)
    second.wait_for_selector("#alert:not([hidden])")
    assert "Another window" in second.locator("#alert").text_content()
    assert second.locator("#pairs tr").count() == 1
    second.unroute("**/api/state?since=*")
    click(second, "moving", moving[0])
    # Both at once: every change is either in the file or told to be refused, none by halves.
    for k in range(1, 6):
        for page, side, points in ((first, "reference", reference), (second, "moving", moving)):
            x, y = where(page, side, points[k])
            page.mouse.click(x, y)
    for page in (first, second):
        page.evaluate("meshregPick.idle()")
        page.wait_for_timeout(2500)  # it looks for others' changes every two seconds
        page.evaluate("meshregPick.idle()")
    found = read_ties(running.ties)
    assert 1 <= len(found.pairs) <= 6
    known = {"reference": reference, "moving": moving}
    for pair_ in found.pairs:
        for side, points in known.items():
            point = getattr(pair_, side)
            if point is not None:
                assert np.abs(points - point).max(axis=1).min() < 0.55 * pixel
    for page in (first, second):  # each shows what is in the file
        shown = page.evaluate("meshregPick.state().pairs.map((pair) => pair.id)")
        assert shown == [pair_.id for pair_ in found.pairs]
    context.close()


def test_without_the_token_everything_is_refused(running: Running, browser_page: Any) -> None:
    paths = ("", "?token=wrong", "api/job", "assets/pick.js", "tiles/reference/0/0/0.png")
    for path in paths:
        assert httpx.get(running.home + path).status_code == 403, path
    page = opened(browser_page, running.url)
    assert page.evaluate("document.cookie") == "", "scripts can read the cookie"
    assert httpx.get(running.url).status_code == 403, "the address works twice"
    assert httpx.get(running.home + "api/state").status_code == 403
