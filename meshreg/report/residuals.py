"""Figures of what is left after registration: residual arrows, height differences."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.report import style
from meshreg.types import Registration

FAINT = 0.02  # share of the largest weight under which a tile counts for nothing


def draw_residuals(registration: Registration) -> Any:
    """Draw the offsets that are left in each tile, as arrows over the reference's relief.

    Tiles that the fit set aside as outliers are crosses: their arrows would hide the others'.
    """
    field = registration.evidence.get("residuals")
    raster = registration.evidence.get("reference_dem")
    if not field or raster is None or len(np.atleast_1d(field["east"])) == 0:
        return None
    places = np.column_stack([field["east"], field["north"]])
    left = np.column_stack([field["d_east"], field["d_north"]])
    weight = np.asarray(field["weight"], float)
    used = weight > FAINT * weight.max()
    if not used.any():
        return None
    height, grid = style.reduced_height(raster)
    place = style.Place(grid)
    places = places - [place.east, place.north]
    length = np.hypot(*left[used].T)
    rms = float(np.sqrt(np.average(length**2, weights=weight[used])))
    typical = max(float(np.percentile(length, 90)), 1e-9)
    west, south, right, top = grid.bounds
    spacing = np.sqrt((right - west) * (top - south) / len(places))
    stretch = 0.8 * spacing / typical
    key = _round_length(typical)
    figure = style.new_figure(
        7.6,
        style.panel_size(grid, 6.0) + 1.7,
        "What is left after registration, tile by tile",
        f"{used.sum()} of {used.size} tiles, weighted rms {rms * 1000:.1f} mm; "
        f"arrows drawn {stretch:,.0f}× too long; crosses: set aside as outliers",
    )
    axes = figure.add_subplot()
    shade = 0.55 + 0.45 * np.nan_to_num(style.hillshade(height, grid.cell), nan=1.0)
    look: dict[str, Any] = {"cmap": "gray", "vmin": 0, "vmax": 1}
    axes.imshow(shade, extent=place.extent(grid), interpolation="nearest", **look)
    axes.set_autoscale_on(False)
    arrows = axes.quiver(
        *places[used].T, *left[used].T, weight[used] / weight.max(), angles="xy",
        scale_units="xy", scale=1 / stretch, cmap="plasma_r", clim=(-0.3, 1), width=0.007,
        edgecolor="white", linewidth=0.5,
    )  # fmt: skip
    if not used.all():
        axes.scatter(*places[~used].T, marker="x", s=25, color="#777777", linewidths=1.0)
    bar = figure.colorbar(arrows, ax=axes, shrink=0.7, label="weight, relative")
    bar.ax.set_ylim(0, 1)
    axes.quiverkey(arrows, 0.04, 1.03, key, f"{key * 1000:g} mm", labelpos="E")
    place.label(axes)
    return figure


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
        label = f"{name} {value:+.3f} m" if key == "height_median" else f"{name} {value:.3f} m"
        middle = statistics.get("height_median") or 0.0
        places = (value,) if key == "height_median" else (middle - value, middle + value)
        for index, at in enumerate(places):
            named = {"label": label} if index == 0 else {}
            side.axvline(at, color=color, linestyle=line, linewidth=1.3, **named)
    side.set_xlabel("height difference [m]")
    side.set_ylabel("cells of the picture")
    if side.get_legend_handles_labels()[0]:
        side.legend(loc="upper center", bbox_to_anchor=(0.5, 1.1), ncols=2, frameon=False)
    return figure
