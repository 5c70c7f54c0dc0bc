"""Sections that the reader plays with: swipe and flicker, cross-section, 3-D."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from meshreg.report import markup as m
from meshreg.report import pictures
from meshreg.report.markup import say
from meshreg.report.result import Result, name_of

_STILL = 160_000  # bytes


def mosaics(result: Result) -> str:
    """Return both orthomosaics over each other."""
    lead = (
        "The reference is on the left of the bar, the moving survey on its right."
        '<span class="js-only screen-only"> Drag it.</span>'
    )
    return _viewer(result, "ortho", "mosaics", "Orthomosaics", lead)


def relief(result: Result) -> str:
    """Return both hillshaded DEMs over each other."""
    lead = "Both elevation models, lit from the north-west."
    return _viewer(result, "relief", "relief", "Relief", lead)


def _viewer(result: Result, kind: str, name: str, title: str, lead: str) -> str:
    kept = result.kept
    about = kept.get("meta", {}).get("ortho" if kind == "ortho" else "dem")
    found = [s for s in ("reference", "before", "after") if f"{kind}_{s}" in kept]
    if not about or "reference" not in found or len(found) < 2:
        return ""
    west, south, east, north = (float(value) for value in about["bounds"])
    names = {stage: _stage_name(result, stage) for stage in found}
    size = f'width="1000" height="{max(1, round(1000 * (north - south) / (east - west)))}"'
    images = "".join(
        f'<img data-stage="{stage}" {size} decoding="async" draggable="false" '
        f'alt="{say(names[stage])}" src="{m.data_uri(kept[f"{kind}_{stage}"])}">'
        for stage in found
    )
    box = (
        f'data-viewer data-west="{west!r}" data-north="{north!r}" data-width="{east - west!r}" '
        f'data-height="{north - south!r}" data-before="{say(names.get("before", ""))}" '
        f'data-after="{say(names.get("after", ""))}"'
    )
    stage = (
        f'<div class="stage viewer" tabindex="0" role="group" aria-label="{say(title)}, compared">'
        f'<div class="world">{images}</div>'
        '<div class="handle js-only" role="slider" tabindex="0" aria-label="Swipe" '
        'aria-valuemin="0" aria-valuemax="100" aria-valuenow="50"></div>'
        f'<span class="tag left js-only">{say(names["reference"])}</span>'
        '<span class="tag right js-only"></span>'
        '<div class="scale js-only"><i></i>m</div></div>'
    )
    hint = (
        '<span class="screen-only js-only keys">Drag to pan, double-click or <kbd>+</kbd> '
        "<kbd>−</kbd> to zoom, <kbd>F</kbd> flickers, <kbd>Space</kbd> changes over</span>"
    )
    under = f'<div class="under">{hint}<output></output></div>'
    body = f"<div {box}>{_tools(kind, found)}{stage}{under}</div>"
    return m.section(name, title, lead, body, _full_size(result, kind))


def _stage_name(result: Result, stage: str) -> str:
    r = result.registration
    if stage == "reference":
        return f"reference: {name_of(r.reference)}"
    if stage == "before":
        return f"as delivered: {name_of(r.moving)}"
    word = "registered" if r.verdict == "accepted" else "best hypothesis"
    return f"{word}: {name_of(r.moving)}"


def _tools(kind: str, found: list[str]) -> str:
    switch = ""
    if "after" in found and "before" in found:
        switch = _choice(
            f"{kind}-stage", "Moving survey", (("before", "Before"), ("after", "After")), 1
        )
    bright = '<button type="button" data-bright aria-pressed="false">Brighten</button>'
    return (
        f'<div class="tools js-only">{switch}'
        '<button type="button" data-flicker aria-pressed="false">Flicker</button>'
        f"{bright if kind == 'ortho' else ''}"
        '<span class="end"><button type="button" data-act="out" aria-label="Zoom out">−</button>'
        '<button type="button" data-act="in" aria-label="Zoom in">+</button>'
        '<button type="button" data-act="reset">Reset</button></span></div>'
    )


def _choice(name: str, label: str, options: tuple[tuple[str, str], ...], chosen: int) -> str:
    parts = "".join(
        f'<input type="radio" name="{name}" id="{name}-{value}" value="{value}"'
        f'{" checked" if k == chosen else ""}><label for="{name}-{value}">{text}</label>'
        for k, (value, text) in enumerate(options)
    )
    return f'<span class="seg" role="radiogroup" aria-label="{label}">{parts}</span>'


def _full_size(result: Result, kind: str) -> str:
    ending = "ortho" if kind == "ortho" else "dem"
    there = {name for name, _ in result.files}
    found = [f"{which}_{ending}.tif" for which in ("reference", "moving")]
    links = [m.link(name) for name in found if name in there]
    return f'<p class="soft">Full resolution: {", ".join(links)}</p>' if links else ""


def section(result: Result) -> str:
    """Both DEMs laid on each other in two colors, and the section that the reader drags."""
    kept = result.kept
    stages = [stage for stage in ("before", "after") if f"tone_{stage}" in kept]
    if not stages or "height" not in kept.get("meta", {}):
        return ""
    panels = [
        f'<figure><h3>{_panel(result, stage)}</h3><div class="overlay" data-section>'
        f'<img alt="Relief of both surveys, {stage} registration" '
        f'src="{m.data_uri(kept[f"tone_{stage}"])}"></div></figure>'
        for stage in stages
    ]
    lines = [(stage, _line(result, stage)) for stage in ("reference", *stages)]
    legend = "".join(
        f'<li><svg viewBox="0 0 18 18" aria-hidden="true"><path class="line {kind}" d="M0 9H18"/>'
        f"</svg>{say(text)}</li>"
        for kind, text in lines
    )
    profile = (
        '<figure class="js-only"><svg id="profile" role="img" aria-label="Heights along the line">'
        f'</svg><div class="under"><ul class="key">{legend}</ul>'
        '<output id="profile-value"></output></div></figure>'
    )
    still = '<p class="no-js">Without scripts: figures/section.png shows a section.</p>'
    lead = (
        "Where both surveys agree the relief is grey; blue is the reference alone, red the "
        'moving survey alone. <span class="js-only screen-only">Drag the line or its ends.</span>'
    )
    title = "Relief overlaid and cross-section"
    return m.section("section", title, lead, m.columns(*panels), profile, still, _heights(kept))


def _panel(result: Result, stage: str) -> str:
    if stage == "before":
        return "Before registration"
    accepted = result.registration.verdict == "accepted"
    return "After registration" if accepted else "At the best hypothesis"


def _line(result: Result, stage: str) -> str:
    """How a line of the section is called."""
    which = "reference" if stage == "reference" else "moving"
    name = name_of(getattr(result.registration, which))
    return name if stage == "reference" else f"{name}, {_panel(result, stage).lower()}"


def _heights(kept: Mapping[str, Any]) -> str:
    meta = kept["meta"]
    about = meta["height"]
    found = {
        s: kept[f"height_{s}"] for s in ("reference", "before", "after") if f"height_{s}" in kept
    }
    rows, cols = found["reference"].shape
    west, _, _, north = about["bounds"]
    data: dict[str, Any] = {
        "rows": rows, "cols": cols, "west": west, "north": north, "cell": about["cell"],
        "step": about["step"], "middle": about["middle"],
        "grids": {stage: m.packed(grid) for stage, grid in found.items()},
    }  # fmt: skip
    if "ortho" in meta:
        data["texture"] = meta["ortho"]["bounds"]
    return m.json_block("heights", data)


def scene(result: Result) -> str:
    """Return both surfaces to turn about, and the still picture where one was rendered."""
    kept = result.kept
    viewer = ""
    if "height" in kept.get("meta", {}) and any(f"height_{s}" in kept for s in ("before", "after")):
        stages = [s for s in ("before", "after") if f"height_{s}" in kept]
        both = tuple((s, s.capitalize()) for s in stages)
        switch = _choice("scene-stage", "Moving survey", both, 1) if len(stages) > 1 else ""
        show = (("both", "Both"), ("reference", "Reference"), ("moving", "Moving"))
        looks: tuple[tuple[str, str], ...] = (("relief", "Relief"),)
        if "ortho_reference" in kept:
            looks = (*looks, ("photo", "Photo"))
        viewer = (
            f'<div class="js-only"><div class="tools" data-scene-tools>'
            f"{_choice('scene-show', 'Surfaces', show, 0)}{switch}"
            f"{_choice('scene-look', 'Look', looks, 1) if len(looks) > 1 else ''}"
            '<label class="range">Height × <input type="range" id="stretch" min="1" max="8" '
            'step="0.5" value="1"><output>1</output></label>'
            '<span class="end"><button type="button" data-scene-home>Reset</button></span></div>'
            '<div class="stage scene" tabindex="0" role="application" aria-label="Both surfaces in '
            '3-D; arrow keys turn, plus and minus zoom"><canvas></canvas>'
            "<p hidden>This browser has no WebGL; the sections above show the same ground.</p>"
            "</div>"
            '<div class="under"><span class="screen-only">Drag to turn, Shift-drag to shift, '
            "click and scroll or <kbd>+</kbd> <kbd>−</kbd> to zoom. Relief: blue is the "
            'reference, orange the moving survey.</span><output id="scene-count"></output></div>'
            "</div>"
        )
    return m.section("scene", "In 3-D", "", viewer, _still(result.still))


def _still(png: bytes) -> str:
    if not png:
        return ""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(png)) as image:
            image.thumbnail((1400, 1400))
            picture = np.asarray(image.convert("RGBA"))
    except (OSError, UnidentifiedImageError, ValueError, Image.DecompressionBombError):
        return ""
    data = m.data_uri(pictures.encoded(picture, _STILL))
    image = f'<img alt="Reference and registered survey in 3-D" src="{data}">'
    return m.figure(
        image, "Rendered: the reference on the left, the registered survey on the right."
    )
