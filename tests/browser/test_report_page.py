"""The report in a real browser: swipe, flicker, zoom, section, 3-D, light and dark, phones."""

from __future__ import annotations

import dataclasses
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_registration import EAST, NORTH, OFFSET, made_registration, relief
from PIL import Image

from meshreg.cli.reporting import keep_evidence, write_report
from meshreg.io.result.record import write_registration
from meshreg.report import keeping

HOSTILE = "</script><img src=x onerror=document.title='owned'>[red]"
MOSAICS, RELIEF = "#mosaics .stage", "#relief .stage"


def made(folder: Path, registration: Any) -> str:
    write_registration(registration, folder)
    keep_evidence(registration, folder)
    return write_report(folder).as_uri()


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Address of a page of each verdict."""
    root = tmp_path_factory.mktemp("pages")
    verdicts = ("accepted", "review", "rejected")
    return {verdict: made(root / verdict, made_registration(verdict)) for verdict in verdicts}


def pixels(page: Any, selector: str) -> Any:
    part = page.locator(selector).first
    part.scroll_into_view_if_needed()
    with Image.open(io.BytesIO(part.screenshot(timeout=60_000))) as image:
        return np.asarray(image.convert("RGB"), float)


def changed(a: Any, b: Any) -> float:
    """Share of the pixels that differ visibly."""
    return float((np.abs(a - b).max(axis=-1) > 24).mean())


def until(page: Any, expression: str) -> None:
    """Wait until an expression holds; the page's policy forbids Playwright's own way, eval."""
    for _ in range(200):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"never: {expression}")


def drag(page: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*((s + e) / 2 for s, e in zip(start, end, strict=True)))
    page.mouse.move(*end)
    page.mouse.up()


def middle(page: Any, selector: str) -> tuple[float, float, float, float]:
    box = page.locator(selector).first.bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, box["width"], box["height"]


# ---- comparing --------------------------------------------------------------------------------


@pytest.mark.parametrize("stage", [MOSAICS, RELIEF])
def test_swipe_uncovers_the_other_survey(
    browser_page: Any, pages: dict[str, str], stage: str
) -> None:
    browser_page.goto(pages["accepted"])
    name = stage.split(maxsplit=1)[0]
    browser_page.locator(f"{name} label", has_text="Before").click()
    first = pixels(browser_page, stage)
    x, y, wide, _ = middle(browser_page, f"{name} .handle")
    left = middle(browser_page, stage)[0] - 0.2 * middle(browser_page, stage)[2]
    drag(browser_page, (x, y + 60), (left, y + 60))
    assert middle(browser_page, f"{name} .handle")[0] == pytest.approx(left, abs=2)
    second = pixels(browser_page, stage)
    at, size = first.shape[1] // 2, first.shape[1]
    # What lies between both places of the bar changed; what lies right of both did not.
    assert (
        changed(first[100:, int(0.35 * size) : at - 40], second[100:, int(0.35 * size) : at - 40])
        > 0.2
    )
    assert changed(first[60:, at + 40 :], second[60:, at + 40 :]) < 0.01
    assert wide < 60


def test_swipe_answers_the_keyboard(browser_page: Any, pages: dict[str, str]) -> None:
    browser_page.goto(pages["accepted"])
    handle = browser_page.locator("#mosaics .handle")
    handle.focus()
    for key, value in (("Home", "0"), ("ArrowRight", "2"), ("End", "100"), ("ArrowLeft", "98")):
        browser_page.keyboard.press(key)
        assert handle.get_attribute("aria-valuenow") == value


def test_flicker_shows_one_after_the_other(browser_page: Any, pages: dict[str, str]) -> None:
    browser_page.goto(pages["accepted"])
    browser_page.locator("#mosaics label", has_text="Before").click()
    stage, button = browser_page.locator(MOSAICS), browser_page.locator("#mosaics [data-flicker]")
    assert stage.get_attribute("data-shown") == "swipe"
    button.click()
    assert button.get_attribute("aria-pressed") == "true"
    seen: dict[str, Any] = {}
    for wanted in ("reference", "moving", "reference"):
        browser_page.wait_for_selector(f"{MOSAICS}[data-shown={wanted}]")
        assert browser_page.locator("#mosaics .handle").is_hidden()
    button.click()
    assert stage.get_attribute("data-shown") == "swipe"
    # By hand, so that the picture holds still.
    stage.focus()
    for _ in range(2):
        browser_page.keyboard.press("Space")
        seen[stage.get_attribute("data-shown")] = pixels(browser_page, MOSAICS)
    assert set(seen) == {"reference", "moving"}
    assert changed(*seen.values()) > 0.2
    browser_page.keyboard.press("Escape")
    assert stage.get_attribute("data-shown") == "swipe"


def test_dark_mosaics_can_be_brightened(browser_page: Any, pages: dict[str, str]) -> None:
    browser_page.goto(pages["accepted"])
    button = browser_page.locator("#mosaics [data-bright]")
    means = []
    for pressed in ("false", "true", "false"):
        assert button.get_attribute("aria-pressed") == pressed
        means.append(pixels(browser_page, MOSAICS)[80:, 100:-100].mean())
        button.click()
    assert means[1] > 1.15 * means[0]
    assert means[2] == pytest.approx(means[0], rel=0.01)
    assert browser_page.locator("#relief [data-bright]").count() == 0


def test_after_registration_both_pictures_agree(browser_page: Any, pages: dict[str, str]) -> None:
    browser_page.goto(pages["accepted"])
    stage = browser_page.locator(MOSAICS)
    share = {}
    for name in ("Before", "After"):
        browser_page.locator("#mosaics label", has_text=name).click()
        stage.focus()
        shown = []
        for _ in range(2):
            browser_page.keyboard.press("Space")
            inner = pixels(browser_page, MOSAICS)
            rows, cols = inner.shape[:2]
            shown.append(inner[rows // 3 : -rows // 6, cols // 2 - 150 : cols // 2 + 150])
        share[name] = changed(*shown)
    assert share["After"] < 0.1 < 0.5 < share["Before"]


def test_zoom_and_pan_by_keys_buttons_wheel_and_drag(
    browser_page: Any, pages: dict[str, str]
) -> None:
    browser_page.goto(pages["accepted"])
    stage = browser_page.locator(MOSAICS)

    def place() -> list[float]:
        text = browser_page.locator("#mosaics .world").evaluate(
            "e => getComputedStyle(e).transform"
        )
        scale, _, _, _, x, y = (float(v) for v in re.findall(r"-?[\d.]+(?:e-?\d+)?", text))
        return [scale, x, y]

    assert place()[0] == 1
    browser_page.locator("#mosaics [data-act=in]").click()
    assert place()[0] == pytest.approx(1.5, abs=0.01)
    stage.focus()
    browser_page.keyboard.press("+")
    browser_page.keyboard.press("+")
    scale, x, y = place()
    assert scale == pytest.approx(1.5**3, abs=0.01)
    browser_page.keyboard.press("ArrowDown")
    browser_page.keyboard.press("ArrowRight")
    assert place() == pytest.approx([scale, x - 60, y - 60], abs=0.1)
    stage.scroll_into_view_if_needed()
    browser_page.wait_for_timeout(100)
    cx, cy, _, _ = middle(browser_page, MOSAICS)
    drag(browser_page, (cx + 80, cy + 80), (cx + 110, cy + 100))
    assert place() == pytest.approx([scale, x - 30, y - 40], abs=0.1)
    browser_page.mouse.wheel(0, -200)  # the stage has the focus
    browser_page.wait_for_timeout(100)
    assert place()[0] > scale
    browser_page.keyboard.press("0")
    assert place()[0] == 1
    browser_page.locator("h1").click()
    browser_page.evaluate("document.activeElement.blur(); scrollTo(0, 300)")
    browser_page.wait_for_timeout(600)  # the page scrolls smoothly
    at = browser_page.evaluate("scrollY")
    cx, cy, _, _ = middle(browser_page, MOSAICS)
    browser_page.mouse.move(cx, cy)
    browser_page.mouse.wheel(0, 200)  # without it the wheel scrolls the page
    until(browser_page, f"scrollY > {at} + 50")
    assert place()[0] == 1


def test_pointer_says_where_it_is(browser_page: Any, pages: dict[str, str]) -> None:
    browser_page.goto(pages["accepted"])
    browser_page.locator(MOSAICS).scroll_into_view_if_needed()
    browser_page.wait_for_timeout(100)
    x, y, _, tall = middle(browser_page, MOSAICS)
    browser_page.mouse.move(x + 100, y)
    said = browser_page.locator("#mosaics output").inner_text()
    east, north = (float(v) for v in re.findall(r"[\d.]+(?= m)", said))
    metre = tall / 26.0  # the made mosaics are 24 m × 26 m
    assert east == pytest.approx(EAST + 12 + 100 / metre, abs=0.1)
    assert north == pytest.approx(NORTH + 13, abs=0.1)


# ---- section and 3-D --------------------------------------------------------------------------


def test_section_tells_the_heights_under_the_line(browser_page: Any, pages: dict[str, str]) -> None:
    browser_page.goto(pages["accepted"])
    profile = browser_page.locator("#profile")
    first = profile.locator("path.reference").get_attribute("d")
    panel = browser_page.locator("[data-section]").first
    panel.scroll_into_view_if_needed()
    box = panel.bounding_box()

    def at(east: float, north: float) -> tuple[float, float]:
        return box["x"] + east / 24 * box["width"], box["y"] + (26 - north) / 26 * box["height"]

    for k, end in enumerate(((4.0, 6.0), (20.0, 18.0))):
        grip = panel.locator(".grip").nth(k).bounding_box()
        start = grip["x"] + grip["width"] / 2, grip["y"] + grip["height"] / 2
        drag(browser_page, start, at(*end))
    assert profile.locator("path.reference").get_attribute("d") != first
    # both panels show the same line
    ends = [
        [panel.locator("line").nth(1).get_attribute(key) for key in ("x1", "y1", "x2", "y2")]
        for panel in browser_page.locator("[data-section]").all()
    ]
    assert ends[0] == ends[1]
    x1, y1, x2, y2 = (float(value) for value in ends[0])
    assert (x1, 26 - y1, x2, 26 - y2) == pytest.approx((4, 6, 20, 18), abs=0.1)
    profile.scroll_into_view_if_needed()
    place = profile.bounding_box()
    browser_page.mouse.move(place["x"] + 0.6 * place["width"], place["y"] + 80)
    said = browser_page.locator("#profile-value").inner_text()
    numbers = re.findall(r"(-?[\d.]+) m", said)
    along, reference, before, after = (float(value) for value in numbers)
    share = along / np.hypot(16, 12)
    assert 0.5 < share < 0.62
    east, north = EAST + x1 + share * (x2 - x1), NORTH + 26 - (y1 + share * (y2 - y1))
    assert reference == pytest.approx(relief(east, north), abs=0.01)
    moved = relief(east - 0.01, north + 0.02) + 0.03  # as made_registration lays it down
    assert after == pytest.approx(moved, abs=0.01)
    delivered = relief(east + OFFSET[0], north + OFFSET[1]) - OFFSET[2]
    assert before == pytest.approx(delivered, abs=0.01)


def test_section_answers_the_keyboard(browser_page: Any, pages: dict[str, str]) -> None:
    browser_page.goto(pages["accepted"])
    grip = browser_page.locator("[data-section] .grip").first
    line = browser_page.locator("[data-section] line").nth(1)
    x, y = (float(line.get_attribute(key)) for key in ("x1", "y1"))
    grip.focus()
    browser_page.keyboard.press("ArrowRight")
    browser_page.keyboard.press("Shift+ArrowUp")
    assert float(line.get_attribute("x1")) == pytest.approx(x + 0.1)
    assert float(line.get_attribute("y1")) == pytest.approx(y - 1.0)


def test_both_surfaces_are_drawn_in_3d(browser_page: Any, pages: dict[str, str]) -> None:
    browser_page.goto(pages["accepted"])
    stage = browser_page.locator(".stage.scene")
    stage.scroll_into_view_if_needed()
    browser_page.wait_for_selector(".stage.scene[data-triangles]")
    both = pixels(browser_page, ".stage.scene")
    assert both.std() > 20  # not blank
    count = int(stage.get_attribute("data-triangles"))
    assert 10_000 < count <= 100_000
    browser_page.locator("[data-scene-tools] label", has_text="Reference").click()
    until(
        browser_page,
        f"Number(document.querySelector('.stage.scene').dataset.triangles) < {count}",
    )
    browser_page.locator("[data-scene-tools] label", has_text="Relief").click()
    browser_page.wait_for_timeout(200)
    alone = pixels(browser_page, ".stage.scene")
    assert changed(both, alone) > 0.1
    x, y, _, _ = middle(browser_page, ".stage.scene")
    drag(browser_page, (x, y), (x + 120, y + 20))
    browser_page.wait_for_timeout(200)
    assert changed(alone, pixels(browser_page, ".stage.scene")) > 0.05


def test_the_largest_surfaces_stay_under_100_000_triangles() -> None:
    side = keeping.HEIGHT_SIDE
    every = int(np.ceil(np.sqrt(side * side / 25_000)))  # as the page's script reduces them
    quads = (side // every - 1) ** 2
    assert 2 * 2 * quads <= 100_000


def test_without_webgl_the_page_says_so(chromium: Any, pages: dict[str, str]) -> None:
    page = chromium.new_page()
    said: list[str] = []
    page.on("pageerror", lambda error: said.append(str(error)))
    page.add_init_script(
        "const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {"
        " return kind.startsWith('webgl') ? null : get.call(this, kind, ...rest); };"
    )
    page.goto(pages["accepted"])
    assert page.locator(".stage.scene p").is_visible()
    assert page.locator("[data-scene-tools]").is_hidden()
    assert said == []
    page.close()


# ---- looks ------------------------------------------------------------------------------------


def test_light_and_dark_follow_the_system_and_the_button(
    chromium: Any, pages: dict[str, str]
) -> None:
    ground = "getComputedStyle(document.body).backgroundColor"
    found = {}
    for scheme in ("light", "dark"):
        page = chromium.new_page(color_scheme=scheme)
        page.goto(pages["accepted"])
        found[scheme] = page.evaluate(ground)
        page.locator("#theme").click()
        found[f"{scheme}, other"] = page.evaluate(ground)
        page.locator("#theme").click()
        assert page.evaluate(ground) == found[scheme]
        page.close()
    assert found["light"] == found["dark, other"] != found["dark"] == found["light, other"]


@pytest.mark.parametrize("width", [320, 390, 768])
@pytest.mark.parametrize("verdict", ["accepted", "rejected"])
def test_narrow_screens_scroll_down_only(
    chromium: Any, pages: dict[str, str], width: int, verdict: str
) -> None:
    page = chromium.new_page(viewport={"width": width, "height": 800})
    page.goto(pages[verdict])
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.close()


def test_without_scripts_the_pictures_are_there(chromium: Any, pages: dict[str, str]) -> None:
    context = chromium.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(pages["accepted"])
    for name in ("#mosaics img", "#relief img", "#section img", "#left img"):
        assert all(image.is_visible() for image in page.locator(name).all())
    assert page.locator(".tools").first.is_hidden()
    assert page.locator("#profile").is_hidden()
    context.close()


def test_printing_leaves_the_controls_out(chromium: Any, pages: dict[str, str]) -> None:
    page = chromium.new_page(color_scheme="dark")
    page.goto(pages["review"])
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    for name in ("nav", "#theme", ".tools"):
        assert page.locator(name).first.is_hidden()
    assert page.locator("#verdict strong").is_visible()
    page.close()


@pytest.mark.parametrize("verdict", ["review", "rejected"])
def test_every_verdict_opens_quietly(
    browser_page: Any, pages: dict[str, str], verdict: str
) -> None:
    browser_page.goto(pages[verdict])
    assert browser_page.locator("#verdict strong").inner_text() == verdict.capitalize()
    for section in browser_page.locator("main > section").all():
        section.scroll_into_view_if_needed()
    assert browser_page.locator("#mosaics label", has_text="After").count() == (verdict == "review")


def test_hostile_names_stay_text(browser_page: Any, tmp_path: Path) -> None:
    registration = made_registration("review")
    moving = {**registration.moving, "name": HOSTILE, "path": [HOSTILE]}
    hostile = dataclasses.replace(registration, moving=moving, reason=HOSTILE, notes=(HOSTILE,))
    browser_page.goto(made(tmp_path / "r", hostile))
    browser_page.wait_for_timeout(200)
    assert HOSTILE in browser_page.locator("h1").inner_text()
    assert HOSTILE in browser_page.locator("#mosaics .tag.right").inner_text()
    assert "owned" not in browser_page.title().replace(HOSTILE, "")
    assert browser_page.locator("img[src=x]").count() == 0
