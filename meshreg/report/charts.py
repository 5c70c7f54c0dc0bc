"""Charts of the page as SVG, whose colors follow the page's own (light, dark, print)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from meshreg.records import Grid, Registration
from meshreg.report import style
from meshreg.report.frame import SHAPES, Frame, key, line, mark
from meshreg.report.markup import data_uri, number, say

FAINT = 0.02  # share of the largest weight under which a tile counts for nothing
ELLIPSE_95 = math.sqrt(5.991)  # chi-square with 2 degrees of freedom


def _ellipse(kind: str, frame: Frame, centre: Sequence[float], sigma: Any) -> str:
    """Draw the 95 % ellipse of a 2-D normal distribution."""
    if sigma is None or not np.isfinite(sigma).all():
        return ""
    values, vectors = np.linalg.eigh(np.asarray(sigma, float))
    half = ELLIPSE_95 * np.sqrt(np.clip(values, 0, None)) * frame.scale
    angle = -math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
    x, y = frame.at(*centre)
    name = kind if kind in SHAPES else "other"
    turn = f'transform="translate({x:.2f} {y:.2f}) rotate({angle:.2f})"'
    return f'<ellipse class="ellipse {name}" {turn} rx="{half[0]:.2f}" ry="{half[1]:.2f}"/>'


def offsets(registration: Registration, answer: Mapping[str, Any] | None = None) -> str:
    """Each method's offset with its 95 % ellipse, and the result.

    `answer` is the result's offset and sigma where the methods measured; without it the record's.
    """
    answers: list[tuple[str, str, tuple[float, float], Any, bool]] = [
        (e.method, f"{style.method_name(e.method)} ({e.status})", (e.east, e.north), e.sigma,
         e.status != "ok")
        for e in registration.estimates
        if math.isfinite(e.east) and math.isfinite(e.north)
    ]  # fmt: skip
    if registration.transform is not None:
        east, north = (float(value) for value in registration.transform.offset[:2])
        sigma = None if registration.covariance is None else registration.covariance[:2, :2]
        if answer is not None:
            (east, north), sigma = answer["offset"], answer["sigma"]
        answers.append(("result", f"result ({registration.verdict})", (east, north), sigma, False))
    if not answers:
        return ""
    reach = [_reach(sigma) for *_, sigma, _ in answers]
    places = [place for _, _, place, _, _ in answers]
    spread = []
    for axis in (0, 1):
        low = min(p[axis] - r[axis] for p, r in zip(places, reach, strict=True))
        high = max(p[axis] + r[axis] for p, r in zip(places, reach, strict=True))
        spread.append((low, high))
    half = max(0.5 * (high - low) for low, high in spread) * 1.12 or 0.1
    x, y = ((0.5 * (low + high) - half, 0.5 * (low + high) + half) for low, high in spread)
    frame = Frame.equal(x, y)
    body = frame.drawn("east [m]", "north [m]")
    for kind, _, place, sigma, _ in answers:
        body += _ellipse(kind, frame, place, sigma)
    for kind, _, place, _, hollow in answers:
        body += mark(kind, *frame.at(*place), hollow=hollow)
    named = [(kind, f"{text} {_said(place)}", hollow) for kind, text, place, _, hollow in answers]
    return frame.picture(body, "Offset that each method asks for") + key(named)


def _reach(sigma: Any) -> tuple[float, float]:
    if sigma is None or not np.isfinite(sigma).all():
        return 0.0, 0.0
    east, north = (ELLIPSE_95 * math.sqrt(max(float(sigma[k][k]), 0.0)) for k in (0, 1))
    return east, north


def _said(place: Sequence[float]) -> str:
    return f"{number(place[0])}, {number(place[1])} m"


def scores(picture: Any, about: Mapping[str, Any], name: str, *, near: bool = False) -> str:
    """Score of every offset that was tried, with the chosen and the second peak.

    `near` are those around the chosen peak alone.
    """
    west, south, east, north = about["near" if near else "bounds"]
    frame = Frame.equal((west, east), (south, north))
    x, y = frame.at(west, north)
    wide, tall = (east - west) * frame.scale, (north - south) * frame.scale
    body = (
        f'<rect class="ground" x="{x:.2f}" y="{y:.2f}" width="{wide:.2f}" height="{tall:.2f}"/>'
        f'<image href="{data_uri(picture)}" x="{x:.2f}" y="{y:.2f}" width="{wide:.2f}" '
        f'height="{tall:.2f}" preserveAspectRatio="none" image-rendering="pixelated"/>'
    )
    body += frame.drawn("east to add to the moving survey [m]", "north to add [m]", grid=False)
    named = []
    for kind, text in (("second", "second peak"), ("best", "chosen peak")):
        peak = about.get(kind)
        if peak and west <= peak[0] <= east and south <= peak[1] <= north:
            px, py = frame.at(*peak)
            halo = f'<circle class="halo" cx="{px:.2f}" cy="{py:.2f}" r="13"/>'
            spot = halo + mark(kind, px, py)
            body += f'<g class="peaks shadow">{spot}</g><g class="peaks">{spot}</g>'
            named.append((kind, f"{text} {_said(peak)}", False))
    title = f"Score of each offset: {name}{', around the chosen peak' if near else ''}"
    return frame.picture(body, title) + ("" if near else key(reversed(named)))


def histogram(counts: Any, edges: Any, median: float | None, nmad: float | None) -> str:
    """How the height differences are spread, with their median and NMAD."""
    counts, edges = np.asarray(counts, float), np.asarray(edges, float)
    if counts.size == 0 or counts.max() <= 0:
        return ""
    share = counts / counts.sum() * 100
    frame = Frame((float(edges[0]), float(edges[-1])), (0.0, 1.06 * float(share.max())), tall=270.0)
    body = frame.drawn("registered less reference height [m]", "cells [%]")
    for low, high, value in zip(edges[:-1], edges[1:], share, strict=True):
        x, y = frame.at(float(low), float(value))
        bottom, right = frame.at(float(high), 0.0)[1], frame.at(float(high), 0.0)[0]
        body += (
            f'<rect class="bar" x="{x:.2f}" y="{y:.2f}" width="{max(right - x - 0.4, 0.4):.2f}" '
            f'height="{bottom - y:.2f}"/>'
        )
    marks = [] if median is None else [("median", median)]
    if median is not None and nmad is not None:
        marks += [("nmad", median - nmad), ("nmad", median + nmad)]
    for name, value in marks:
        if frame.x[0] <= value <= frame.x[1]:
            x, y = frame.at(value, 0.0)
            body += line(name, x, frame.top, x, y)
    return frame.picture(body, "Histogram of the height differences")


def matches(
    ends: Any, pictures: tuple[Any, Any], bounds: tuple[Sequence[float], Sequence[float]]
) -> str:
    """Both orthomosaics side by side, a line per match: inliers green, outliers red."""
    west, south, east, north = np.array(bounds, float).T
    wide, gap = 450.0, 20.0
    scale = wide / float((east - west).max())  # one for both
    across, down = (east - west) * scale, (north - south) * scale
    tall = float(down.max())
    body = ""
    for k, picture in enumerate(pictures):
        body += (
            f'<image class="shade" href="{data_uri(picture)}" x="{k * (wide + gap):.1f}" y="0" '
            f'width="{across[k]:.1f}" height="{down[k]:.2f}" preserveAspectRatio="none"/>'
        )
    ends = np.asarray(ends, float)
    x = (ends[:, [0, 2]] - west) * scale + [0.0, wide + gap]
    y = (north - ends[:, [1, 3]]) * scale
    for inlier, look, dots, group in (
        (False, "outlier", "dots out", "out"),
        (True, "inlier", "dots", "in"),
    ):
        chosen = np.flatnonzero((ends[:, 4] > 0.5) == inlier)
        path = "".join(f"M{x[k, 0]:.1f} {y[k, 0]:.1f}L{x[k, 1]:.1f} {y[k, 1]:.1f}" for k in chosen)
        spots = "".join(
            f'<circle cx="{x[k, s]:.1f}" cy="{y[k, s]:.1f}" r="2"/>' for k in chosen for s in (0, 1)
        )
        if path:
            body += f'<g class="{group}"><path class="{look}" d="{path}"/>'
            body += f'<g class="{dots}">{spots}</g></g>'
    return (
        f'<svg viewBox="0 0 {2 * wide + gap:.0f} {tall:.0f}" role="img" '
        f'aria-label="Matches of image features">{body}</svg>'
    )


def residuals(field: Any, bounds: Sequence[float], relief: Any) -> tuple[str, str]:
    """Arrows of what is left in each tile, and a caption; crosses are tiles set aside."""
    field = np.asarray(field, float)
    weight = field[:, 4]
    used = weight > FAINT * weight.max()
    if not used.any():
        return "", ""
    frame, corner, body = _ground(bounds, relief)
    length = np.hypot(field[used, 2], field[used, 3])
    rms = float(np.sqrt(np.average(length**2, weights=weight[used])))
    typical = max(float(np.percentile(length, 90)), 1e-9)
    area = (frame.x[1] - frame.x[0]) * (frame.y[1] - frame.y[0])
    stretch = 0.8 * math.sqrt(area / len(field)) / typical
    k = stretch * frame.scale
    modelled, measured = "", ""
    for tile, keep in zip(field, used, strict=True):
        px, py = frame.at(tile[0] - corner[0], tile[1] - corner[1])
        if field.shape[1] > 6:
            modelled += _arrow(px, py, k * tile[5], -k * tile[6], "arrow model")
        shade = 0.3 + 0.7 * float(tile[4] / weight.max())
        arrow = _arrow(px, py, k * tile[2], -k * tile[3], shade=shade)
        measured += arrow if keep else _cross(px, py)
    caption = (
        f"Offsets left in {int(used.sum())} of {used.size} tiles, weighted rms "
        f"{1000 * rms:.1f} mm; arrows are exaggerated {stretch:,.0f} times, paler with less "
        "weight. Crosses: outliers."
    )
    if modelled:
        caption += " Broad and pale: what the named model says there."
    title = "What is left after registration, tile by tile"
    return frame.picture(body + modelled + measured, title), caption


def ups(field: Any, bounds: Sequence[float], relief: Any) -> tuple[str, str]:
    """Discs of how far up each tile should still go, and a caption."""
    field = np.asarray(field, float)
    used = field[:, 3] > FAINT * field[:, 3].max()
    if not used.any():
        return "", ""
    frame, corner, body = _ground(bounds, relief)
    limit = max(float(np.abs(field[used, 2]).max()), 1e-3)
    area = (frame.x[1] - frame.x[0]) * (frame.y[1] - frame.y[0])
    largest = 0.42 * math.sqrt(area / len(field)) * frame.scale
    for tile, keep in zip(field, used, strict=True):
        px, py = frame.at(tile[0] - corner[0], tile[1] - corner[1])
        if not keep:
            body += _cross(px, py)
            continue
        size = max(largest * math.sqrt(abs(tile[2]) / limit), 0.8)
        look = "up" if tile[2] >= 0 else "down"
        body += f'<circle class="{look}" cx="{px:.1f}" cy="{py:.1f}" r="{size:.1f}"/>'
    caption = (
        "How far each tile should still go up (red) or down (blue); the area of a disc is the "
        f"height, the largest {1000 * limit:.0f} mm."
    )
    return frame.picture(body, "Heights left, tile by tile"), caption


def stable(picture: Any, about: Mapping[str, Any], bounds: Sequence[float], relief: Any) -> str:
    """Draw which ground told the height and the tilt, over the relief, with its legend."""
    frame, corner, body = _ground(bounds, relief)
    west, south, east, north = (float(value) for value in about["bounds"])
    x, y = frame.at(west - corner[0], north - corner[1])
    wide, tall = (east - west) * frame.scale, (north - south) * frame.scale
    body += (
        f'<image class="veil" href="{data_uri(picture)}" x="{x:.2f}" y="{y:.2f}" '
        f'width="{wide:.2f}" height="{tall:.2f}" preserveAspectRatio="none"/>'
    )
    names = (
        ("stable", "stable, used for height and tilt"),
        ("changed", "changed, or without detail that recurs"),
        ("set_aside", "changed as a whole block, told by its neighbours"),
    )
    legend = "".join(
        f'<li><svg viewBox="0 0 18 18" aria-hidden="true"><rect class="{name}" width="18" '
        f'height="18"/></svg>{text}: {number(about[name], ".0%")}</li>'
        for name, text in names
    )
    return f'{frame.picture(body, "Stable ground")}<ul class="key">{legend}</ul>'


def _ground(bounds: Sequence[float], relief: Any) -> tuple[Frame, tuple[float, float], str]:
    """Axes over the survey's relief; the corner from which they count; what is drawn so far."""
    west, south, east, north = (float(value) for value in bounds)
    cell = max(east - west, north - south) / 1000
    shape = max(1, round((north - south) / cell)), max(1, round((east - west) / cell))
    place = style.Place(Grid(west, north, cell, shape))
    frame = Frame.equal(
        (west - place.east, east - place.east), (south - place.north, north - place.north)
    )
    x, y = frame.at(west - place.east, north - place.north)
    wide, tall = (east - west) * frame.scale, (north - south) * frame.scale
    body = f'<rect class="ground" x="{x:.1f}" y="{y:.1f}" width="{wide:.1f}" height="{tall:.1f}"/>'
    if relief is not None:
        body += (
            f'<image class="shade" href="{data_uri(relief)}" x="{x:.2f}" y="{y:.2f}" '
            f'width="{wide:.2f}" height="{tall:.2f}" preserveAspectRatio="none"/>'
        )
    names = (style._axis("east", place.east), style._axis("north", place.north))
    return frame, (place.east, place.north), body + frame.drawn(*names, grid=False)


def _cross(x: float, y: float) -> str:
    return f'<path class="aside" d="M{x - 4:.1f} {y - 4:.1f}l8 8m0 -8l-8 8"/>'


def _arrow(
    x: float, y: float, dx: float, dy: float, look: str = "arrow", shade: float = 1.0
) -> str:
    length = math.hypot(dx, dy)
    pale = f' opacity="{shade:.2f}"' if shade < 0.995 else ""
    if length < 0.5:
        return f'<circle class="{look}" cx="{x:.1f}" cy="{y:.1f}" r="1"{pale}/>'
    ux, uy = dx / length, dy / length
    head = min(6.0, 0.45 * length)
    ex, ey = x + dx, y + dy
    left = f"L{ex - head * (ux + 0.5 * uy):.1f} {ey - head * (uy - 0.5 * ux):.1f}"
    right = f"L{ex - head * (ux - 0.5 * uy):.1f} {ey - head * (uy + 0.5 * ux):.1f}"
    tip = f"M{ex:.1f} {ey:.1f}"
    return f'<path class="{look}" d="M{x:.1f} {y:.1f}L{ex:.1f} {ey:.1f}{left}{tip}{right}"{pale}/>'


def extents(boxes: Sequence[tuple[str, str, Any]]) -> str:
    """Where both surveys lie: bounding boxes seen from above, as (name, class, (2, 3) ends)."""
    ends = np.array([box for _, _, box in boxes], float)
    low, high = ends[:, 0, :2].min(axis=0), ends[:, 1, :2].max(axis=0)
    cell = max(float((high - low).max()), 1e-6) / 100
    rows, cols = (max(1, math.ceil(float(size) / cell)) for size in (high - low)[::-1])
    place = style.Place(Grid(float(low[0]), float(high[1]), cell, (rows, cols)))
    corner = np.array([place.east, place.north])
    pad = 0.06 * max(float((high - low).max()), 1e-6)
    x, y = ((float(low[k] - corner[k] - pad), float(high[k] - corner[k] + pad)) for k in (0, 1))
    frame = Frame.equal(x, y)
    body = frame.drawn(style._axis("east", place.east), style._axis("north", place.north))
    for name, look, box in boxes:
        west, north = frame.at(*(float(v) for v in (box[0, 0] - corner[0], box[1, 1] - corner[1])))
        east, south = frame.at(*(float(v) for v in (box[1, 0] - corner[0], box[0, 1] - corner[1])))
        body += (
            f'<rect class="line {look}" x="{west:.2f}" y="{north:.2f}" '
            f'width="{max(east - west, 1):.2f}" height="{max(south - north, 1):.2f}">'
            f"<title>{say(name)}</title></rect>"
        )
    return frame.picture(body, "Where the surveys lie")
