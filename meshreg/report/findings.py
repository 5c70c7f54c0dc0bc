"""Sections on what was found: what is left over, and how each method came to its answer."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from meshreg.report import charts, style
from meshreg.report import markup as m
from meshreg.report.markup import number, say
from meshreg.report.result import Result


def left_over(result: Result) -> str:
    """Return what is left after registration: heights, offsets of tiles, statistics."""
    r = result.registration
    warped = bool(r.internal and r.internal.get("applied"))
    internal = ""
    if r.internal and r.internal.get("said"):
        said = str(r.internal["said"]).strip().rstrip(".")
        internal = f"<p>{say(said[:1].upper() + said[1:])}.</p>"
    if warped:
        internal += "<p>The registered survey is warped, so that this bending is taken away.</p>"
    title = "What is left" if r.after else "As delivered"
    said = _statistics(result) + _error(result) + internal
    parts = m.columns(*_differences(result), *_ground(result.kept), *_tiles(result.kept, warped))
    return m.section("left", title, "", said, parts)


def _differences(result: Result) -> list[str]:
    """Return the map of the height differences and how they are spread."""
    r, kept = result.registration, result.kept
    if "difference" not in kept:
        return []
    # The record's median is reference less registered; the map and its histogram are the reverse.
    median, nmad = r.after.get("height_median"), r.after.get("height_nmad")
    median = None if median is None or not math.isfinite(median) else -median + 0.0
    nmad = None if nmad is None or not math.isfinite(nmad) else nmad
    limit = float(kept["difference_edges"][-1])
    picture = f'<img alt="Map of height differences" src="{m.data_uri(kept["difference"])}">'
    drawn = charts.histogram(kept["difference_counts"], kept["difference_edges"], median, nmad)
    said = f"Median {number(median)} m (line), NMAD {number(nmad, '.3f')} m (dashes)."
    return [
        m.figure(
            f"<h3>Height of the registered survey above the reference</h3>{picture}",
            f"Blue: lower than the reference, red: higher; full color from ±{limit:.3f} m.",
        ),
        m.figure(f"<h3>Height differences</h3>{drawn}", said),
    ]


def _ground(kept: Mapping[str, Any]) -> list[str]:
    """Return the mask of the ground that told the height and the tilt."""
    meta = kept.get("meta", {})
    if "ground" not in kept or "dem" not in meta:
        return []
    about, bounds = meta["ground"], meta["dem"]["bounds"]
    drawn = charts.stable(kept["ground"], about, bounds, kept.get("small_relief"))
    said = "Shares of the ground that both surveys see and that was compared."
    return [m.figure(f"<h3>Stable ground</h3>{drawn}", said)]


def _tiles(kept: Mapping[str, Any], warped: bool) -> list[str]:
    """Return what is left in each tile: arrows of the offsets, discs of the heights."""
    if "dem" not in kept.get("meta", {}):
        return []
    bounds, small = kept["meta"]["dem"]["bounds"], kept.get("small_relief")
    figures = []
    for name, title, draw in (
        ("residuals", "Residual field", charts.residuals),
        ("residual_ups", "Heights left", charts.ups),
    ):
        if name in kept:
            drawn, said = draw(kept[name], bounds, small)
            said += " All of it after the rigid move and before the warp." if warped else ""
            figures.append(m.figure(f"<h3>{title}</h3>{drawn}" if drawn else "", say(said)))
    return figures


def _error(result: Result) -> str:
    """Return the registration's own error, as software that measures change asks for it."""
    error = result.registration.registration_error
    if not error:
        return ""
    x, y, z, largest = (number(error.get(key), ".4f") for key in ("x", "y", "z", "isotropic"))
    return (
        f"<p>Registration error at the centroid of the overlap, one sigma: {x} m east, {y} m "
        f"north, {z} m up; {largest} m in the worst direction.</p>"
    )


def _statistics(result: Result) -> str:
    r = result.registration
    if not r.before:
        return ""
    rows = (
        ("Overlap, share of the smaller survey", "overlap", ".1%"),
        ("Median height difference, reference less moving [m]", "height_median", "+.3f"),
        ("NMAD of height differences [m]", "height_nmad", ".3f"),
        ("RMSE of height differences [m]", "height_rmse", ".3f"),
        ("Similarity of the images, −1 to 1", "image_similarity", "+.3f"),
    )
    both = [("before", r.before), ("after", r.after)]
    both = both if r.after else [("as delivered", r.before)]
    lines = [(name, *(number(said.get(key), form) for _, said in both)) for name, key, form in rows]
    return m.table(("", *(name for name, _ in both)), lines, range(1, len(both) + 1))


def found(result: Result) -> str:
    """Every method's answer: offsets and ellipses, score surfaces, matches."""
    r, kept = result.registration, result.kept
    rows = [
        (
            style.method_name(e.method),
            m.chip(e.status),
            number(e.east),
            number(e.north),
            number(_sigma(e.sigma), ".3f"),
            number(e.gap, ".1f"),
            number(e.overlap, ".0%") if e.overlap else "–",
            e.reason or "",
        )
        for e in r.estimates
    ]
    head = ("method", "says", "east [m]", "north [m]", "sigma [m]", "gap", "overlap", "reason")
    meta = kept.get("meta", {})
    drawn = charts.offsets(r, meta.get("answer"))
    said = "Hollow marks: the method itself calls its answer weak."
    if "answer" in meta:
        said += (
            " The result is drawn as in the middle of the overlap, where the methods measure; the "
            "top of the page states it at the centre of the moving survey's bounding box."
        )
    plot = m.figure(f"<h3>Offsets with their 95 % ellipses</h3>{drawn}" if drawn else "", said)
    surfaces = [
        _scores(kept, method, about)
        for method, about in meta.get("surfaces", {}).items()
        if f"surface_{method}" in kept
    ]
    return m.section(
        "found", "How it was found", _turned(meta.get("turned")),
        m.table(head, rows, (2, 3, 4, 5, 6)), m.columns(plot), *surfaces, _matches(kept),
        _hypotheses(result),
    )  # fmt: skip


def _turned(turned: Mapping[str, Any] | None) -> str:
    """Say that the methods looked at a survey that had been turned first."""
    if turned is None:
        return ""
    scaled = f" and its lengths multiplied by {turned['scale']:.5f}"
    return (
        f"The moving survey was turned by {number(turned['yaw_degrees'], '+.2f')}° about its centre"
        f"{scaled if turned['scale'] != 1.0 else ''} before the methods looked at it: their "
        "offsets and scores are those of the turned survey, the rest of its yaw is the result's."
    )


def _scores(kept: Mapping[str, Any], method: str, about: Mapping[str, Any]) -> str:
    """Return the scores of all offsets, and beside them those around the chosen peak."""
    name = style.method_name(method)
    plot = charts.scores(kept[f"surface_{method}"], about, name)
    better = "low" if about.get("lower_is_better") else "high"
    said = f"Brighter is better: the {better}er the value, the better the fit."
    whole = m.figure(f"<h3>Score of each offset: {say(name)}</h3>{plot}", said)
    near = ""
    if f"near_{method}" in kept and about.get("near"):
        drawn = charts.scores(kept[f"near_{method}"], about, name, near=True)
        near = m.figure(f"<h3>Around its chosen peak</h3>{drawn}", "The same colors.")
    return m.columns(whole, near)


def _sigma(sigma: Any) -> float:
    """Return the longer axis of the one-sigma ellipse, so that no direction looks too sure."""
    if sigma is None or not np.isfinite(sigma).all():
        return math.nan
    return math.sqrt(max(float(np.linalg.eigvalsh(np.asarray(sigma, float))[-1]), 0.0))


def _matches(kept: Mapping[str, Any]) -> str:
    meta = kept.get("meta", {})
    if "matches" not in kept or "small_before" not in kept:
        return ""
    both = kept["small_reference"], kept["small_before"]
    bounds = meta["ortho"]["bounds"], meta.get("apart", meta["ortho"])["bounds"]
    drawn = charts.matches(kept["matches"], both, bounds)
    inliers, total = (int(meta["matches"][name]) for name in ("inliers", "total"))
    share = number(inliers / total if total else 0, ".1%")
    boxes = (
        '<div class="screen-only">'
        '<label><input type="checkbox" id="show-inliers" checked> inliers</label>'
        '<label><input type="checkbox" id="show-outliers" checked> outliers</label></div>'
    )
    caption = (
        f"{inliers} of {total} matches agree ({share}); inliers green, outliers red, at most 400 "
        "of each. Left: the reference. Right: the moving survey as delivered."
    )
    return m.figure(f"<h3>Matches of image features (SIFT)</h3>{boxes}{drawn}", caption, "matches")


def _hypotheses(result: Result) -> str:
    lines = [
        (
            place,
            number(h.get("east")),
            number(h.get("north")),
            number(h.get("score"), ".2f"),
            number(h.get("terrain_gap"), "+.1f"),
            number(h.get("image_gap"), "+.1f"),
            ", ".join(style.method_name(str(name)) for name in h.get("methods") or ()) or "–",
        )
        for place, h in enumerate(result.registration.hypotheses, 1)
    ]
    if not lines:
        return ""
    head = ("", "east [m]", "north [m]", "score", "terrain gap", "image gap", "proposed by")
    return "<h3>Hypotheses, ranked</h3>" + m.table(head, lines, (1, 2, 3, 4, 5))
