"""Figures of what each method found: matches, score surfaces, offsets beside each other."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from meshreg.records import OffsetEstimate, Registration
from meshreg.report import stated, style

MAX_MATCHES = 400  # lines drawn; more would only be a smear


def draw_matches(registration: Registration) -> Any:
    """Draw matches of image features: both orthomosaics side by side, a line per match."""
    found = [e for e in registration.estimates if "reference_points" in e.evidence]
    reference = registration.evidence.get("reference_ortho")
    kept = registration.evidence
    moving = kept.get("moving_ortho_before", kept.get("moving_ortho_apart"))
    if not found or reference is None or moving is None:
        return None
    matches = found[0].evidence
    inliers = np.asarray(matches["inliers"], bool)
    if inliers.size == 0:
        return None
    color, grid = style.reduced_color(reference)
    moved, own = style.reduced_color(moving)
    places = style.Place(grid), style.Place(own)
    tall = style.panel_size(grid, 5.0, 6.5)
    share = inliers.mean()
    figure = style.new_figure(
        11.0,
        tall + 1.5,
        f"SIFT: {inliers.sum()} of {inliers.size} matches agree ({share:.1%})",
        f"green: agree    red, thin: outliers    at most {MAX_MATCHES} of each drawn",
    )
    left, right = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    pairs = (("reference", left, color, grid), ("moving, as delivered", right, moved, own))
    for place, (name, axes, picture, shown) in zip(places, pairs, strict=True):
        faded = 0.45 + 0.55 * np.nan_to_num(picture, nan=1.0)
        axes.imshow(style.over_white(faded), extent=place.extent(shown), interpolation="nearest")
        axes.set_title(name, fontsize=10)
        place.label(axes, inner=axes is right and own == grid)
        axes.set_autoscale_on(False)
    right.tick_params(labelleft=False)  # the matches would cross them
    if own != grid:  # delivered elsewhere: its own north, on the other side
        right.yaxis.tick_right()
        right.yaxis.set_label_position("right")
    figure.draw_without_rendering()  # lines from axes to axes need both in their places
    figure.set_layout_engine("none")
    corners = [np.array([place.east, place.north]) for place in places]
    ends = (
        np.asarray(matches["reference_points"], float) - corners[0],
        stated.delivered(matches["moving_points"], kept.get("motion")) - corners[1],
    )
    _lines(figure, (left, right), ends, ~inliers, color=style.BAD, linewidth=0.3, alpha=0.35)
    _lines(figure, (left, right), ends, inliers, color=style.GOOD, linewidth=0.7, alpha=0.8)
    return figure


def _lines(figure: Any, axes: tuple[Any, Any], ends: Any, chosen: Any, **look: Any) -> None:
    from matplotlib.collections import LineCollection

    index = np.flatnonzero(chosen)
    if index.size > MAX_MATCHES:  # evenly, so that a picture is the same each time
        index = index[np.linspace(0, index.size - 1, MAX_MATCHES).astype(int)]
    at = [
        figure.transFigure.inverted().transform(side.transData.transform(points[index]))
        for side, points in zip(axes, ends, strict=True)
    ]
    lines = LineCollection(list(np.stack(at, axis=1)), capstyle="round", **look)
    lines.set_transform(figure.transFigure)
    figure.add_artist(lines)
    size = 3.0 * look["linewidth"] + 1
    for side, points in zip(axes, ends, strict=True):
        side.scatter(*points[index].T, s=size, color=look["color"], linewidths=0)


def draw_surface(estimate: OffsetEstimate) -> Any:
    """Score of every offset that was tried, with the chosen and the second peak."""
    evidence = estimate.evidence
    if "surface" not in evidence or not np.isfinite(evidence["surface"]).any():
        return None
    score = np.asarray(evidence["surface"], float)
    east, north = (np.asarray(evidence[key], float) for key in ("east", "north"))
    name = style.method_name(estimate.method)
    figure = style.new_figure(7.4, 6.6, f"Score of each offset: {name}", _said(estimate))
    axes = figure.add_subplot()
    half_e, half_n = (_half_step(axis) for axis in (east, north))
    ends = (east.min() - half_e, east.max() + half_e, north.min() - half_n, north.max() + half_n)
    # Rows of the surface run with `north`; the picture wants north at the top.
    if north[0] < north[-1]:
        score = score[::-1]
    if east[0] > east[-1]:
        score = score[:, ::-1]
    scale = _color_scale(estimate, score)
    picture = axes.imshow(score, extent=ends, interpolation="nearest", **scale)
    axes.set_facecolor("#dddddd")
    figure.colorbar(picture, ax=axes, shrink=0.85, label="score")
    _mark_peak(axes, evidence.get("second"), style.SECOND, "second peak", "X")
    _mark_peak(axes, evidence.get("best"), style.MOVING, "best", "P")
    axes.axhline(0, color="white", linewidth=0.4, alpha=0.6)
    axes.axvline(0, color="white", linewidth=0.4, alpha=0.6)
    axes.set_xlabel("east to add to the moving survey [m]")
    axes.set_ylabel("north to add to the moving survey [m]")
    axes.set_aspect("equal")
    if axes.get_legend_handles_labels()[0]:
        style.legend_below(axes)
    return figure


def _color_scale(estimate: OffsetEstimate, score: Any) -> dict[str, Any]:
    """Let the best score be bright, whether the measure is better high or low (the paper's c)."""
    lowest, low, middle, high, highest = np.nanpercentile(score, [0, 1, 50, 99, 100])
    better_low = math.isfinite(estimate.score) and estimate.score < middle
    if better_low:
        return {"cmap": "cividis_r", "vmin": lowest, "vmax": high}
    return {"cmap": "cividis", "vmin": low, "vmax": highest}


def _half_step(axis: Any) -> float:
    return float(abs(axis[-1] - axis[0]) / max(axis.size - 1, 1) / 2) or 0.5


def _mark_peak(axes: Any, peak: Any, color: str, label: str, marker: str) -> None:
    if peak is None or not np.isfinite(np.asarray(peak, float)).all():
        return
    east, north = (float(value) for value in peak)
    text = f"{label} ({east:+.3f}, {north:+.3f}) m"
    look: dict[str, Any] = {"s": 90, "edgecolors": "white", "linewidths": 1.0}
    axes.scatter([east], [north], color=color, marker=marker, label=text, zorder=3, **look)


def _said(estimate: OffsetEstimate) -> str:
    parts: list[str] = [estimate.status]
    if math.isfinite(estimate.gap):
        parts.append(f"gap {estimate.gap:.1f}")
    if estimate.reason:
        parts.append(estimate.reason)
    return _wrapped("    ".join(parts))


def _wrapped(text: str, width: int = 100) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, width, max_lines=3, placeholder=" …"))


def draw_offsets(registration: Registration) -> Any:
    """Each method's offset with its 95 % ellipse, and the result."""
    found = [e for e in registration.estimates if math.isfinite(e.east) and math.isfinite(e.north)]
    if not found and registration.transform is None:
        return None
    figure = style.new_figure(
        7.6,
        6.8,
        "Offset that each method asks for",
        _wrapped("ellipses hold 95 %    " + _absent(registration)),
    )
    axes = figure.add_subplot()
    for estimate in found:
        color, marker = style.METHOD_STYLES.get(estimate.method, ("#000000", "v"))
        name = style.method_name(estimate.method)
        _ellipse(axes, (estimate.east, estimate.north), estimate.sigma, color)
        fill = color if estimate.status == "ok" else "white"  # hollow: do not lean on it
        axes.scatter(
            [estimate.east], [estimate.north], marker=marker, s=55, edgecolors=color,
            facecolors=fill, zorder=3, label=f"{name} ({estimate.status})",
        )  # fmt: skip
    if (answer := stated.among_methods(registration)) is not None:
        (east, north), sigma = answer
        _ellipse(axes, (east, north), sigma, style.INK)
        label = f"result, {registration.verdict} ({east:+.3f}, {north:+.3f}) m"
        axes.scatter([east], [north], marker="+", s=160, color=style.INK, label=label, zorder=4)
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.margins(0.15)
    axes.set_aspect("equal", adjustable="datalim")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.locator_params(nbins=7)
    axes.grid(alpha=0.25)
    style.legend_below(axes, columns=2)
    return figure


def _absent(registration: Registration) -> str:
    absent = [style.method_name(e.method) for e in registration.estimates if e.status == "failed"]
    return f"no offset from {', '.join(absent)}" if absent else ""


def _ellipse(axes: Any, centre: tuple[float, float], sigma: Any, color: str) -> None:
    """Draw the 95 % ellipse of a 2-D normal distribution (chi-square of 2 degrees: 5.991)."""
    from matplotlib.patches import Ellipse

    if sigma is None or not np.isfinite(sigma).all():
        return
    values, vectors = np.linalg.eigh(np.asarray(sigma, float))
    width, height = 2 * np.sqrt(5.991 * np.clip(values, 0, None))
    angle = math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
    look: dict[str, Any] = {"edgecolor": color, "facecolor": color, "linewidth": 1.2}
    patch = Ellipse(centre, width, height, angle=angle, **look)
    patch.set_facecolor((*_rgb(color), 0.12))
    axes.add_patch(patch)


def _rgb(color: str) -> tuple[float, float, float]:
    red, green, blue = (int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue
