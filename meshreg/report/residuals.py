"""Figures of what is left after registration: residual arrows, height differences."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np

from meshreg.records import Registration
from meshreg.report import style

FAINT = 0.02  # share of the largest weight under which a tile counts for nothing


def draw_residuals(registration: Registration) -> Any:
    """Draw what the rigid move leaves in each tile, over the reference's relief, and its name.

    Arrows are the offsets that are left, outlined ones what the named model says there; beside
    them, where heights were compared, how far up each tile should go. Tiles that the fit set aside
    as outliers are crosses: their arrows would hide the others'.
    """
    field = registration.evidence.get("residuals")
    raster = registration.evidence.get("reference_dem")
    if not field or raster is None or len(np.atleast_1d(field["east"])) == 0:
        return None
    weight = np.asarray(field["weight"], float)
    used = weight > FAINT * weight.max()
    if not used.any():
        return None
    length = np.hypot(field["d_east"], field["d_north"])[used]
    rms = float(np.sqrt(np.average(length**2, weights=weight[used])))
    heights = "up" in field
    height, grid = style.reduced_height(raster)
    figure = style.new_figure(
        12.0 if heights else 7.6,
        style.panel_size(grid, 4.6 if heights else 6.0) + 1.7,
        "What is left after the rigid move, tile by tile",
        bars=True,
    )
    axes = np.atleast_1d(figure.subplots(1, 2 if heights else 1))
    place = style.Place(grid)
    shade = 0.55 + 0.45 * np.nan_to_num(style.hillshade(height, grid.cell), nan=1.0)
    for index, panel in enumerate(axes):
        look: dict[str, Any] = {"cmap": "gray", "vmin": 0, "vmax": 1}
        panel.imshow(shade, extent=place.extent(grid), interpolation="nearest", **look)
        panel.set_autoscale_on(False)
        place.label(panel, inner=index > 0)
    stretch = _draw_arrows(figure, axes[0], field, used, place)
    if heights:
        _draw_ups(figure, axes[1], field, place)
    said = textwrap.fill(str(field.get("said", "")), 110 if heights else 75)
    figure.supxlabel(
        f"{used.sum()} of {used.size} tiles, weighted rms {rms * 1000:.1f} mm; "
        f"arrows exaggerated {stretch:,.0f} times; crosses: outliers"
        + (f"\n{said}" if said else ""),
        fontsize=9,
        color="#555555",
    )
    return figure


def _draw_arrows(figure: Any, axes: Any, field: Any, used: Any, place: style.Place) -> float:
    """Draw measured and modelled offsets; return how many times too long they are."""
    places = np.column_stack([field["east"], field["north"]]) - [place.east, place.north]
    left = np.column_stack([field["d_east"], field["d_north"]])
    weight = np.asarray(field["weight"], float)
    typical = max(float(np.percentile(np.hypot(*left[used].T), 90)), 1e-9)
    west, right = axes.get_xlim()
    south, top = axes.get_ylim()
    spacing = np.sqrt((right - west) * (top - south) / len(places))
    stretch = 0.8 * spacing / typical
    scaled: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1 / stretch}
    if "model_east" in field:
        model = np.column_stack([field["model_east"], field["model_north"]])
        axes.quiver(
            *places.T, *model.T, **scaled, facecolor="none", edgecolor=style.REFERENCE,
            linewidth=0.9, width=0.013, zorder=2,
        )  # fmt: skip
    arrows = axes.quiver(
        *places[used].T, *left[used].T, weight[used] / weight.max(), **scaled,
        cmap="plasma_r", clim=(-0.3, 1), width=0.007, edgecolor="white", linewidth=0.5, zorder=3,
    )  # fmt: skip
    if not used.all():
        axes.scatter(*places[~used].T, marker="x", s=25, color="#777777", linewidths=1.0)
    bar = figure.colorbar(arrows, ax=axes, shrink=0.7, label="weight, relative")
    bar.ax.set_ylim(0, 1)
    key = _round_length(typical)
    axes.quiverkey(arrows, 0.04, 1.03, key, f"{key * 1000:g} mm", labelpos="E")
    return float(stretch)


def _draw_ups(figure: Any, axes: Any, field: Any, place: style.Place) -> None:
    """Draw how far up each tile should go, inside a ring of what the named model says."""
    places = np.asarray(field["up_east"]) - place.east, np.asarray(field["up_north"]) - place.north
    weight = np.asarray(field["up_weight"], float)
    used = weight > FAINT * weight.max()
    up, model = (1000 * np.asarray(field[name], float) for name in ("up", "model_up"))
    limit = max(float(np.abs(up[used]).max()), 1.0)
    look: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    axes.scatter(*places, c=model, s=260, marker="s", **look)
    shown = axes.scatter(
        *(p[used] for p in places), c=up[used], s=90, edgecolors="white", linewidths=0.8, **look
    )
    axes.scatter(*(p[~used] for p in places), marker="x", s=25, color="#777777", linewidths=1.0)
    axes.set_title("up [mm]: discs as measured, squares by the model", fontsize=9)
    figure.colorbar(shown, ax=axes, shrink=0.7, label="up to add to the moving survey [mm]")


def _round_length(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value))


def draw_height_difference(registration: Registration) -> Any:
    """Draw registered minus reference heights: the map and how they are spread."""
    evidence = registration.evidence
    reference, moving = evidence.get("reference_dem"), evidence.get("moving_dem")
    if reference is None or moving is None:
        return None
    height, grid = style.reduced_height(reference)
    difference = style.reduced_height(moving)[0] - height
    values = difference[np.isfinite(difference)]
    if values.size == 0:
        return None
    place = style.Place(grid)
    limit = max(float(np.percentile(np.abs(values), 98)), 1e-4)
    figure = style.new_figure(
        11.0,
        style.panel_size(grid, 5.6, 6.5) + 1.2,
        "Height of the registered survey above the reference",
        "blue: lower than the reference    red: higher",
        bars=True,
    )
    axes, side = figure.subplots(1, 2, width_ratios=(1.35, 1))
    look: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    picture = axes.imshow(difference, extent=place.extent(grid), interpolation="nearest", **look)
    axes.set_facecolor("#dddddd")
    place.label(axes)
    figure.colorbar(picture, ax=axes, shrink=0.8, label="height difference [m]", extend="both")
    side.hist(np.clip(values, -limit, limit), bins=81, color="#777777")
    statistics = registration.after
    for key, name, color, line in (
        ("height_median", "median", style.INK, "-"),
        ("height_nmad", "± NMAD", style.REFERENCE, "--"),
    ):
        value = statistics.get(key)
        if value is None or not np.isfinite(value):
            continue
        label = f"{name} {-value:+.3f} m" if key == "height_median" else f"{name} {value:.3f} m"
        middle = -(statistics.get("height_median") or 0.0)  # stated as reference less moving
        places = (middle,) if key == "height_median" else (middle - value, middle + value)
        for index, at in enumerate(places):
            named = {"label": label} if index == 0 else {}
            side.axvline(at, color=color, linestyle=line, linewidth=1.3, **named)
    side.set_xlabel("height difference [m]")
    side.set_ylabel("cells of the picture")
    if side.get_legend_handles_labels()[0]:
        side.legend(loc="upper center", bbox_to_anchor=(0.5, 1.1), ncols=2, frameon=False)
    return figure
