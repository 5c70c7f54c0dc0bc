"""Figure 2 and what the paper has no figure for: severity, error, time, trust."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from meshreg.benchmark import tables
from meshreg.benchmark.plan import LADDER, PAPER_SITES
from meshreg.report import style

Row = tables.Row
FUSED = ("#222222", "P")
PRESETS = {"paper": "#999999", "robust": style.REFERENCE}
SITE_TITLES = {
    "tasmania_12h": "Tasmania, 12 hours",
    "abrolhos_12mo": "Abrolhos, 12 months",
    "scott_24mo": "Scott Reef, 24 months",
}
VERDICT_COLORS = {
    "accepted": style.GOOD,
    "review": "#E69F00",
    "rejected": "#BBBBBB",
    "accepted_but_wrong": style.MOVING,
}


def _look(method: str) -> tuple[str, str]:
    return FUSED if method == "fused" else style.METHOD_STYLES[method]


def _name(method: str) -> str:
    return "fused" if method == "fused" else style.method_name(method)


def draw_errors(rows: Sequence[Row], column: str = "error") -> Any:
    """Draw Figure 2: the error of each method at each site, both presets side by side."""
    some = tables.select(rows, kind=("crossing", "table"), scenario=PAPER_SITES)
    some = [row for row in some if row.get("success") is not None]
    if not some:
        return None
    against = "exact truth" if column == "error" else "the simulated hand"
    figure = style.new_figure(
        12.0,
        4.8,
        f"Registration error against {against}",
        "a dot a pair, a line the median of the answers    n/m: answers out of pairs    "
        "dashed: 0.25 m    largest shown: 10 m",
    )
    first = None
    for k, site in enumerate(PAPER_SITES):
        axes = figure.add_subplot(1, 3, k + 1, sharey=first)
        first = first or axes
        axes.set_title(SITE_TITLES[site], fontsize=10)
        for place, method in enumerate(tables.ANSWERS):
            for side, (preset, color) in enumerate(PRESETS.items()):
                group = tables.select(some, scenario=site, method=method, preset=preset)
                _strip(axes, place + (side - 0.5) * 0.4, group, column, color)
        axes.set_yscale("log")
        axes.set_ylim(5e-4, 40.0)
        axes.axhline(0.25, color="#666666", linestyle="--", linewidth=0.8)
        short = {"mutual_information": "mutual\ninformation", "terrain": "terrain\nscan"}
        ticks = [short.get(m, _name(m)) for m in tables.ANSWERS]
        axes.set_xticks(range(len(ticks)), ticks, fontsize=9)
        axes.grid(alpha=0.25, axis="y")
        if k == 0:
            axes.set_ylabel("error [m]")
            for preset, color in PRESETS.items():
                axes.scatter([], [], color=color, label=preset)
            axes.legend(loc="lower left", fontsize=8)
    return figure


def _strip(axes: Any, x: float, rows: Sequence[Row], column: str, color: str) -> None:
    errors = np.array([row[column] for row in rows if row.get(column) is not None], float)
    if not rows:
        return
    spread = np.linspace(-0.12, 0.12, errors.size) if errors.size > 1 else np.zeros(errors.size)
    shown = np.clip(errors, 1e-3, 10.0)
    axes.scatter(x + spread, shown, s=11, color=color, alpha=0.75, linewidths=0)
    if errors.size:
        middle = float(np.clip(np.median(errors), 1e-3, 10.0))
        axes.plot([x - 0.17, x + 0.17], [middle, middle], color=style.INK, linewidth=1.5)
    axes.text(x, 17.0, f"{errors.size}/{len(rows)}", ha="center", fontsize=7, rotation=90)


def draw_severity(rows: Sequence[Row]) -> Any:
    """Success of each method against the severity of change, with Clopper-Pearson bars."""
    some = tables.select(rows, kind="ladder", scenario=LADDER)
    if not some:
        return None
    figure = style.new_figure(
        11.0, 4.6, "Success against severity of change", "error under 0.25 m    bars: 95 % bounds"
    )
    first = None
    for k, preset in enumerate(PRESETS):
        axes = figure.add_subplot(1, 2, k + 1, sharey=first)
        first = first or axes
        pairs = 0
        for shift, method in enumerate(tables.ANSWERS):
            group = tables.select(some, preset=preset, method=method)
            rates = tables.successes(group, lambda row: row["severity"])
            if not rates:
                continue
            pairs = max(found["total"] for found in rates.values())
            x = np.array(sorted(rates))
            share = np.array([rates[s]["rate"] for s in x])
            low = np.array([rates[s]["low"] for s in x])
            high = np.array([rates[s]["high"] for s in x])
            color, marker = _look(method)
            axes.errorbar(
                x + 0.018 * (shift - 1.5), share, (share - low, high - share), color=color,
                marker=marker, markersize=4.5, linewidth=1.0, elinewidth=0.8, capsize=2, alpha=0.85,
                label=_name(method),
            )  # fmt: skip
        axes.set_title(f"{preset} ({pairs} pair{'s' if pairs != 1 else ''} a step)", fontsize=10)
        axes.set_xlabel("severity")
        axes.set_ylim(-0.04, 1.04)
        axes.grid(alpha=0.25)
        if k == 0:
            axes.set_ylabel("share of successes")
        else:
            axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def draw_error_cdf(rows: Sequence[Row]) -> Any:
    """Draw the share of pairs whose error is less than x; what has no answer never arrives."""
    some = tables.not_flat(rows)
    if not some:
        return None
    figure = style.new_figure(
        8.0,
        4.8,
        "Error of each method, all ground but flat sand",
        "full: robust    dotted: paper, at the three sites    dashed: 0.25 m",
    )
    axes = figure.add_subplot()
    for preset, line in (("paper", ":"), ("robust", "-")):
        for method in tables.ANSWERS:
            group = tables.select(some, preset=preset, method=method)
            if not group:
                continue
            errors = np.sort([r["error"] for r in group if r.get("error") is not None])
            steps = np.arange(1, errors.size + 1) / len(group)
            label = f"{_name(method)}, {preset} ({len(group)} pairs)"
            axes.step(
                np.append(errors, 1e3),
                np.append(steps, steps[-1] if steps.size else 0.0),
                where="post",
                color=_look(method)[0],
                linestyle=line,
                linewidth=1.5,
                label=label,
            )
    axes.axvline(0.25, color="#666666", linestyle="--", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_xlim(1e-3, 20.0)
    axes.set_ylim(0.0, 1.02)
    axes.set_xlabel("error [m]")
    axes.set_ylabel("share of all pairs")
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def draw_runtime(lines: Sequence[Mapping[str, Any]]) -> Any:
    """Draw the median seconds of each stage, with the 95th percentile as a bar."""
    groups = [(name, [x for x in lines if x["through"] == name]) for name in ("rasters", "files")]
    groups = [(name, some) for name, some in groups if some]
    if not groups:
        return None
    figure = style.new_figure(
        10.5, 3.8, "Seconds of each stage", "bar: median    whisker: 95th percentile"
    )
    titles = {"rasters": "pairs as rasters", "files": "pairs through files"}
    for k, (name, some) in enumerate(groups):
        axes = figure.add_subplot(1, len(groups), k + 1)
        y = np.arange(len(some))[::-1]
        middle = np.array([x["median"] for x in some])
        late = np.array([x["p95"] for x in some])
        axes.barh(y, middle, color=style.REFERENCE, alpha=0.8)
        axes.errorbar(
            middle, y, xerr=(0 * middle, late - middle), fmt="none", color=style.INK, capsize=2
        )
        axes.set_yticks(y, [_stage(x["stage"]) for x in some], fontsize=8)
        axes.set_title(f"{titles[name]} ({max(x['pairs'] for x in some)})", fontsize=10)
        axes.set_xlabel("seconds")
        axes.grid(alpha=0.25, axis="x")
    return figure


def _stage(name: str) -> str:
    return style.METHOD_NAMES.get(name, name.replace("_", " "))


def draw_verdicts(verdicts: Mapping[str, Mapping[str, Any]]) -> Any:
    """Draw the shares of verdicts over true pairs and over pairs of different places."""
    groups = [(name, found) for name, found in verdicts.items() if found["accepted"]["total"]]
    if not groups:
        return None
    figure = style.new_figure(9.5, 0.55 * len(groups) + 1.8, "Verdicts", "at the right: counts")
    axes = figure.add_subplot()
    shown = ("accepted", "review", "rejected")
    for place, (_, found) in enumerate(groups):
        left = 0.0
        for verdict in shown:
            part = found[verdict]
            axes.barh(
                -place, part["rate"], left=left, color=VERDICT_COLORS[verdict],
                label=verdict if place == 0 else None,
            )  # fmt: skip
            left += part["rate"]
        wrong, counts = found["accepted_but_wrong"], [str(found[v]["count"]) for v in shown]
        known = groups[place][0] != "different places"
        text = " / ".join(counts) + (f"    {wrong['count']} accepted but wrong" if known else "")
        color = VERDICT_COLORS["accepted_but_wrong"] if known and wrong["count"] else style.INK
        axes.text(1.02, -place, text, va="center", fontsize=8, color=color)
    axes.set_yticks([-k for k in range(len(groups))], [name for name, _ in groups], fontsize=9)
    axes.set_xlim(0, 1.4)
    axes.set_xticks(np.linspace(0, 1, 6))
    axes.set_xlabel("share of pairs")
    axes.legend(loc="upper center", bbox_to_anchor=(0.4, 1.16), ncols=3, frameon=False, fontsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure


def draw_reliability(rows: Sequence[Row]) -> Any:
    """Draw how far the stated chance of a false alarm and the stated 95 % region can be trusted."""
    robust = tables.fused(row for row in rows if row["preset"] == "robust")
    apart = [row for row in robust if row["kind"] == "elsewhere"]
    true = [row for row in robust if row.get("success") is not None]
    figure = style.new_figure(
        11.0,
        4.8,
        "How far the stated doubt can be trusted",
        "grey: as it should be for pairs of different places (left) and for all answers (right)",
    )
    axes = figure.add_subplot(1, 2, 1)
    _alarms(axes, apart, "different places", style.MOVING)
    _alarms(axes, true, "true pairs", style.REFERENCE)
    axes.plot([1e-12, 1], [1e-12, 1], color="#999999", linewidth=1.0)
    axes.axvline(1e-6, color="#666666", linestyle="--", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(1e-12, 1.5)
    axes.set_ylim(0.5 / max(len(apart), len(true), 10), 1.5)
    axes.set_xlabel("stated chance of a false alarm (dashed: most for accepting)")
    axes.set_ylabel("share of pairs with so little or less")
    axes.legend(fontsize=8, loc="lower right")
    axes.grid(alpha=0.25)
    _covered(figure.add_subplot(1, 2, 2), tables.not_flat(rows))
    return figure


def _alarms(axes: Any, rows: Sequence[Row], label: str, color: str) -> None:
    stated = np.sort(
        [max(r["false_alarm"], 1e-12) for r in rows if r.get("false_alarm") is not None]
    )
    if stated.size:
        share = np.arange(1, stated.size + 1) / stated.size
        name = f"{label} ({stated.size})"
        axes.step(stated, share, where="post", color=color, linewidth=1.5, label=name)


def _covered(axes: Any, rows: Sequence[Row]) -> None:
    """Draw the nominal level of regions against the share of pairs that they cover."""
    levels = np.linspace(0.0, 1.0, 201)
    robust = [row for row in rows if row["preset"] == "robust"]
    for method in tables.ANSWERS:
        some = tables.select(robust, method=method)
        distance2 = np.array([r["distance2"] for r in some if r.get("distance2") is not None])
        if not distance2.size:
            continue
        reached = 1.0 - np.exp(-distance2 / 2.0)  # chi-square, 2 degrees of freedom
        share = [float((reached <= level).mean()) for level in levels]
        found = tables.coverage(some)
        label = f"{_name(method)}: 95 % region covers {found['rate']:.0%}"
        axes.plot(levels, share, color=_look(method)[0], linewidth=1.5, label=label)
    axes.plot([0, 1], [0, 1], color="#999999", linewidth=1.0)
    axes.axvline(0.95, color="#666666", linestyle="--", linewidth=0.8)
    axes.set_xlabel("level of the stated region")
    axes.set_ylabel("share of pairs whose truth is inside")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, loc="upper left")
    axes.grid(alpha=0.25)


def figures(rows: Sequence[Row], summary: Mapping[str, Any]) -> dict[str, Callable[[], Any]]:
    """Return every figure of a whole run, by the name of its file, as a call that draws it."""
    return {
        "fig2_errors": lambda: draw_errors(rows),
        "fig2_errors_hand": lambda: draw_errors(rows, "error_hand"),
        "severity": lambda: draw_severity(rows),
        "error_cdf": lambda: draw_error_cdf(rows),
        "verdicts": lambda: draw_verdicts(summary["verdicts"]),
        "reliability": lambda: draw_reliability(rows),
        "runtime": lambda: draw_runtime(summary["stages"]),
    }
