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
    r, kept = result.registration, result.kept
    parts, internal = [], ""
    # The record's median is reference less registered; the map and its histogram are the reverse.
    median, nmad = r.after.get("height_median"), r.after.get("height_nmad")
    median = None if median is None or not math.isfinite(median) else -median + 0.0
    nmad = None if nmad is None or not math.isfinite(nmad) else nmad
    if "difference" in kept:
        limit = float(kept["difference_edges"][-1])
        picture = f'<img alt="Map of height differences" src="{m.data_uri(kept["difference"])}">'
        parts.append(
            m.figure(
                f"<h3>Height of the registered survey above the reference</h3>{picture}",
                f"Blue: lower than the reference, red: higher; full colour from ±{limit:.3f} m.",
            )
        )
        drawn = charts.histogram(kept["difference_counts"], kept["difference_edges"], median, nmad)
        said = f"Median {number(median)} m (line), NMAD {number(nmad, '.3f')} m (dashes)."
        parts.append(m.figure(f"<h3>Height differences</h3>{drawn}", said))
    if "residuals" in kept and "dem" in kept["meta"]:
        small = kept.get("small_relief")
        drawn, said = charts.residuals(kept["residuals"], kept["meta"]["dem"]["bounds"], small)
        parts.append(m.figure(f"<h3>Residual field</h3>{drawn}" if drawn else "", say(said)))
    if "residual_ups" in kept and "dem" in kept["meta"]:
        small = kept.get("small_relief")
        drawn, said = charts.ups(kept["residual_ups"], kept["meta"]["dem"]["bounds"], small)
        parts.append(m.figure(f"<h3>Heights left</h3>{drawn}" if drawn else "", say(said)))
    if r.internal and r.internal.get("said"):
        said = str(r.internal["said"]).strip().rstrip(".")
        internal = f"<p>{say(said[:1].upper() + said[1:])}.</p>"
    title = "What is left" if r.after else "As delivered"
    said = _statistics(result) + _error(result) + internal
    return m.section("left", title, "", said, m.columns(*parts))


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
    drawn = charts.offsets(r)
    plots = [m.figure(f"<h3>Offsets with their 95 % ellipses</h3>{drawn}" if drawn else "",
                      "Hollow marks: the method itself calls its answer weak.")]  # fmt: skip
    for method, about in kept.get("meta", {}).get("surfaces", {}).items():
        if f"surface_{method}" in kept:
            name = style.method_name(method)
            plot = charts.scores(kept[f"surface_{method}"], about, name)
            better = "low" if about.get("lower_is_better") else "high"
            said = f"Bright is good; of this measure {better} values are."
            plots.append(m.figure(f"<h3>Score of each offset: {say(name)}</h3>{plot}", said))
    return m.section(
        "found", "How it was found", "", m.table(head, rows, (2, 3, 4, 5, 6)), m.columns(*plots),
        _matches(kept), _hypotheses(result),
    )  # fmt: skip


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
    drawn = charts.matches(kept["matches"], both, meta["ortho"]["bounds"])
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
