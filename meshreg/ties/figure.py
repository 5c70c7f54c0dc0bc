"""The figure of a validation: errors against the hand, all offsets, what is left where."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from meshreg.report import style
from meshreg.ties.validate import Validation

FUSED = "#222222"


def draw_validation(validation: Validation) -> dict[str, Any]:
    """Draw errors (the paper's Figure 2 for this pair), offsets and what is left where.

    Returns
    -------
    dict of matplotlib.figure.Figure
        By the name of the file.
    """
    panels = {
        "validation_errors": ("Error of each answer", _errors),
        "validation_offsets": ("Offsets of pairs and methods", _plane),
        "validation_residuals": ("What is left at each pair", _places),
    }
    figures = {}
    for name, (title, draw) in panels.items():
        figures[name] = style.new_figure(5.2, 4.8, title)
        draw(figures[name].add_subplot(), validation)
    return figures


def answers(validation: Validation) -> list[tuple[str, str, str, Any]]:
    """Name, color, marker and entry of each method and of the result."""
    rows = []
    for method, entry in validation.document["methods"].items():
        color, marker = style.METHOD_STYLES.get(method, ("#56B4E9", "^"))
        rows.append((style.method_name(method), color, marker, entry))
    return [*rows, ("result", FUSED, "P", validation.document["fused"])]


def _errors(axes: Any, validation: Validation) -> None:
    rows = answers(validation)
    hand = validation.document["hand"]
    largest = max([e["error"] for *_, e in rows if e["error"] is not None], default=0.0)
    largest = max(largest, hand["residual"], hand["radius"])
    for k, (_, color, _, entry) in enumerate(rows):
        if entry["error"] is None:
            why = "rejected" if entry.get("verdict") == "rejected" else "no answer"
            axes.text(0.01 * largest, k, why, va="center", fontsize=8, color="#777777")
            continue
        axes.barh(k, entry["error"], color=color, height=0.6)
        text = f" {entry['error']:.3f} m"
        axes.text(entry["error"], k, text, va="center", fontsize=8.5, color=style.INK)
    axes.axvline(hand["residual"], color="#777777", linestyle="--", linewidth=1)
    axes.text(hand["residual"], -0.62, " mean residual of the pairs", fontsize=7.5, color="#555555",
              va="center")  # fmt: skip
    axes.set_yticks(range(len(rows)), [name for name, *_ in rows], fontsize=9)
    axes.set_ylim(len(rows) - 0.4, -0.9)
    axes.set_xlim(0, 1.28 * largest)
    axes.set_xlabel("distance from the hand's offset [m]", fontsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _plane(axes: Any, validation: Validation) -> None:
    hand = validation.hand
    reference, _ = validation.ties.arrays()
    offsets = reference - validation.moving
    centre = np.array([hand.east, hand.north])
    agree = offsets[hand.inliers]
    answered = [e["offset"] for *_, e in answers(validation) if e["offset"] is not None]
    reach = np.abs(agree - centre).max(initial=0.0)
    near = [np.abs(np.array(o) - centre).max() for o in answered]
    reach = 1.25 * max([reach, hand.radius, *(d for d in near if d < 5 * hand.radius)])
    _circle(axes, centre, hand.radius)
    axes.scatter(*agree.T, s=14, color=style.GOOD, label="pairs that agree", zorder=2)
    wrong = offsets[~hand.inliers]
    if len(wrong):
        label = f"others ({len(wrong)})"
        axes.scatter(*wrong.T, s=20, color=style.MOVING, marker="x", label=label, zorder=2)
    for name, color, marker, entry in answers(validation):
        if entry["offset"] is not None:
            axes.scatter(*entry["offset"], s=64, color=color, marker=marker, label=name, zorder=4,
                         edgecolors="white", linewidths=0.8)  # fmt: skip
    axes.scatter(*centre, s=420, color=style.INK, marker="+", linewidths=1, label="hand", zorder=3)
    axes.set_xlim(centre[0] - reach, centre[0] + reach)
    axes.set_ylim(centre[1] - reach, centre[1] + reach)
    axes.set_aspect("equal")
    axes.set_xlabel("east [m]", fontsize=9)
    axes.set_ylabel("north [m]", fontsize=9)
    axes.grid(alpha=0.25)
    axes.locator_params(nbins=5)
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=8)
    style.legend_below(axes, columns=3)


def _circle(axes: Any, centre: Any, radius: float) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle(centre, radius, fill=False, edgecolor="#999999", linestyle=":"))


def _places(axes: Any, validation: Validation) -> None:
    """Draw each pair's residual as an arrow: after registration, or else from the hand's offset."""
    hand = validation.hand
    reference, _ = validation.ties.arrays()
    left, name = validation.after, "after registration"
    if left is None:
        left, name = (
            reference - validation.moving - [hand.east, hand.north],
            "from the hand's offset",
        )
    corner = np.floor(reference.min(axis=0))
    at = reference - corner
    # ten percent of the plot is a round length somewhat above the typical residual
    typical = float(np.median(np.hypot(*left[hand.inliers].T)))
    unit = 10 ** math.ceil(math.log10(max(typical, 1e-4)))
    span = float(np.ptp(at, axis=0).max()) or 1.0
    scale = 0.1 * span / unit
    colors = np.where(hand.inliers, style.GOOD, style.MOVING)
    drawn = np.clip(np.hypot(*left.T), 1e-12, None)
    short = np.minimum(drawn, 1.6 * unit) / drawn  # a wrong pair's arrow must not fill the plot
    arrows = scale * left * short[:, None]
    key = axes.quiver(*at.T, *arrows.T, color=colors, angles="xy", scale_units="xy", scale=1,
                      width=0.006)  # fmt: skip
    axes.scatter(*at.T, s=12, c=colors)
    axes.quiverkey(
        key, 0.86, 1.03, scale * unit, f"{unit:g} m", labelpos="W", fontproperties={"size": 8}
    )
    axes.set_aspect("equal")
    axes.margins(0.14)
    axes.set_xlabel(f"east − {corner[0]:.0f} [m]", fontsize=9)
    axes.set_ylabel(f"north − {corner[1]:.0f} [m]", fontsize=9)
    axes.set_title(name, fontsize=9, loc="left", color="#555555")
    axes.grid(alpha=0.25)
    axes.tick_params(labelsize=8)
