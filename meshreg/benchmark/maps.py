"""Figures 3 to 5 of the paper, of one site each: matches, relief and section, score surfaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.io.files.atomic import atomic_file
from meshreg.records import OffsetEstimate, Registration, SurveyRaster
from meshreg.report import evidence, overlays, style

SECTION_EAST = 5.0  # m east of the map's south-west corner
SURFACES = ("terrain", "mutual_information")


def draw(
    site: str, found: Mapping[str, Registration], truth: Sequence[float], folder: Path
) -> list[str]:
    """Draw the figures of a site.

    Parameters
    ----------
    site : str
    found : mapping
        The registration by each preset; "robust" is the one whose rasters are shown.
    truth : (east, north, up)
        The true offset [m].
    folder : Path

    Returns
    -------
    list of str
        Names of the files written.
    """
    robust = found["robust"]
    figures = {
        **{f"fig3_{site}_{name}": evidence.draw_matches(found[name]) for name in found},
        f"fig4_{site}_relief": overlays.draw_relief(robust),
        f"fig4_{site}_section": draw_section(robust),
        f"fig5_{site}_scores": draw_surfaces(found, truth),
    }
    written = []
    for name, figure in figures.items():
        if figure is not None:
            save(figure, folder / f"{name}.png")
            written.append(f"{name}.png")
    return written


def save(figure: Any, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=style.DPI, metadata={"Software": "meshreg"})


def draw_section(registration: Registration, east: float = SECTION_EAST) -> Any:
    """Heights from south to north, `east` metres from the reference map's west edge (Figure 4)."""
    rasters = registration.evidence
    reference: SurveyRaster = rasters["reference_dem"]
    seen = np.flatnonzero(reference.valid.any(axis=0))
    rows = np.flatnonzero(reference.valid.any(axis=1))
    if not seen.size:
        return None
    grid = reference.grid
    column = min(int(seen[0] + round(east / grid.cell)), grid.shape[1] - 1)
    _, north = grid.east_north(np.arange(grid.shape[0]), column)
    origin = north[rows[-1]]
    figure = style.new_figure(
        10.0, 3.8, f"Cross section {east:g} m east of the map's origin", "south to the left"
    )
    axes = figure.add_subplot()
    looks: list[tuple[str, str, dict[str, Any]]] = [
        ("reference_dem", "reference", {"color": style.REFERENCE, "linewidth": 1.4}),
        ("moving_dem_before", "moving, before", {"color": "#999999", "linestyle": "--"}),
        ("moving_dem", "moving, after", {"color": style.MOVING, "linewidth": 1.1}),
    ]
    for key, label, look in looks:
        raster = rasters.get(key)
        if raster is not None:
            height = raster.height[:, column].astype(np.float64) + raster.datum
            axes.plot(north - origin, height, label=label, **look)
    axes.set_xlabel("north of the map's origin [m]")
    axes.set_ylabel("height [m]")
    axes.grid(alpha=0.25)
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.14), ncols=3, frameon=False, fontsize=9)
    return figure


def draw_surfaces(found: Mapping[str, Registration], truth: Sequence[float]) -> Any:
    """Score of every offset, a row a preset, a column a method (Figure 5)."""
    presets = [name for name in ("paper", "robust") if name in found]
    figure = style.new_figure(
        9.6,
        4.3 * len(presets) + 0.9,
        "Score of each offset",
        "bright: better    orange ring: the best    white dotted ring: the truth",
    )
    for row, preset in enumerate(presets):
        estimates = {e.method: e for e in found[preset].estimates}
        for col, method in enumerate(SURFACES):
            axes = figure.add_subplot(len(presets), len(SURFACES), row * len(SURFACES) + col + 1)
            axes.set_title(f"{preset}: {style.method_name(method)}", fontsize=10)
            _surface(figure, axes, estimates.get(method), truth)
    return figure


def _surface(
    figure: Any, axes: Any, estimate: OffsetEstimate | None, truth: Sequence[float]
) -> None:
    shown = {} if estimate is None else estimate.evidence
    if estimate is None or "surface" not in shown or not np.isfinite(shown["surface"]).any():
        axes.text(0.5, 0.5, "no score", ha="center", va="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    score = np.asarray(shown["surface"], float)
    east, north = np.asarray(shown["east"], float), np.asarray(shown["north"], float)
    best = tuple(float(v) for v in shown["best"]) if "best" in shown else None
    top = score if north[0] > north[-1] else score[::-1]
    half = abs(float(east[1] - east[0])) / 2
    extent = (east.min() - half, east.max() + half, north.min() - half, north.max() + half)
    low, high = np.nanpercentile(score, [1, 99])
    lowest, highest = np.nanmin(score), np.nanmax(score)
    if best is not None and _at(score, east, north, best) < np.nanmedian(score):
        look = {"cmap": "cividis_r", "vmin": lowest, "vmax": high}  # the paper's cost: low is good
    else:
        look = {"cmap": "cividis", "vmin": low, "vmax": highest}
    picture = axes.imshow(top, extent=extent, interpolation="nearest", **look)
    axes.set_facecolor("#dddddd")
    figure.colorbar(picture, ax=axes, shrink=0.8)
    if best is not None:
        axes.scatter([best[0]], [best[1]], s=110, facecolors="none", edgecolors=style.MOVING,
                     linewidths=1.6, zorder=4, clip_on=False)  # fmt: skip
        axes.set_xlabel(
            f"east [m]    {estimate.status}: ({best[0]:+.2f}, {best[1]:+.2f}) m", fontsize=9
        )
    axes.scatter([truth[0]], [truth[1]], s=260, facecolors="none", edgecolors="white",
                 linewidths=1.2, linestyles=":", zorder=3)  # fmt: skip
    scored = np.isfinite(score)
    seen_east, seen_north = east[scored.any(axis=0)], north[scored.any(axis=1)]
    axes.set_xlim(seen_east.min() - half, seen_east.max() + half)
    axes.set_ylim(seen_north.min() - half, seen_north.max() + half)
    axes.set_ylabel("north [m]", fontsize=9)
    axes.tick_params(labelsize=8)


def _at(score: Any, east: Any, north: Any, place: tuple[float, ...]) -> float:
    row = int(np.argmin(np.abs(north - place[1])))
    col = int(np.argmin(np.abs(east - place[0])))
    return float(score[row, col])
