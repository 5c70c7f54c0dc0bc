"""Figures of both surveys laid on each other: relief, cross section, orthomosaics."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.records import Grid, Registration, SurveyRaster
from meshreg.report import style


def draw_relief(registration: Registration) -> Any:
    """Draw the relief of both surveys on each other, before and after."""
    evidence = registration.evidence
    stages = _stages(registration, "moving_dem")
    if "reference_dem" not in evidence or not stages:
        return None
    height, grid = style.reduced_height(evidence["reference_dem"])
    shaded = style.hillshade(height, grid.cell)
    tall = style.panel_size(grid, 4.6)
    figure = style.new_figure(
        4.9 * len(stages) + 0.5,
        tall + 1.4,
        "Relief of both surveys, lit from the north-west",
        "grey: both agree   blue: reference alone   red: moving alone   pale: seen by one",
    )
    place = style.Place(grid)
    for index, (name, moving) in enumerate(stages):
        axes = figure.add_subplot(1, len(stages), index + 1)
        moved, _ = style.reduced_height(moving)
        overlay = style.two_tone(shaded, style.hillshade(moved, grid.cell))
        axes.imshow(overlay, extent=place.extent(grid), interpolation="nearest")
        axes.set_title(name, fontsize=10)
        place.label(axes, inner=index > 0)
    return figure


def draw_section(registration: Registration) -> Any:
    """Draw the heights of both surveys along a line from south to north through the overlap."""
    evidence = registration.evidence
    stages = _stages(registration, "moving_dem")
    if "reference_dem" not in evidence or not stages:
        return None
    reference: SurveyRaster = evidence["reference_dem"]
    column = _busiest_column(reference, stages[-1][1])
    if column is None:
        return None
    grid = reference.grid
    place = style.Place(grid)
    east, north = grid.east_north(np.arange(grid.shape[0]), column)
    figure = style.new_figure(
        9.5,
        4.2,
        f"Cross section at east {float(np.atleast_1d(east)[0]):.2f} m",
        "south to the left",
    )
    axes = figure.add_subplot()
    _profile(axes, north - place.north, reference, column, color=style.REFERENCE, label="reference")
    looks: dict[str, dict[str, Any]] = {
        "before": {"color": "#999999", "linestyle": "--", "linewidth": 1.0},
        "after": {"color": style.MOVING, "linewidth": 1.3},
    }
    for name, moving in stages:
        label = f"moving, {name}"
        _profile(axes, north - place.north, moving, column, label=label, **looks[name])
    axes.set_xlabel(style._axis("north", place.north))
    axes.set_ylabel("height [m]")
    axes.grid(alpha=0.25)
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.11), ncols=3, frameon=False, fontsize=9)
    return figure


def draw_orthos(registration: Registration) -> Any:
    """Draw the orthomosaics on each other before and after, and as a checkerboard."""
    evidence = registration.evidence
    stages = _stages(registration, "moving_ortho")
    reference: SurveyRaster | None = evidence.get("reference_ortho")
    if reference is None or not stages or not reference.color_valid.any():
        return None
    if not stages[-1][1].color_valid.any():
        return None
    color, grid = style.reduced_color(reference)
    grey = style.stretched(color)
    tall = style.panel_size(grid, 4.2, 6.0)
    columns = len(stages) + 1
    figure = style.new_figure(
        4.3 * columns + 0.5,
        tall + 1.4,
        "Orthomosaics of both surveys",
        "overlay: grey where both agree, blue reference alone, red moving alone",
    )
    place = style.Place(grid)
    for index, (name, moving) in enumerate(stages):
        axes = figure.add_subplot(1, columns, index + 1)
        moved, _ = style.reduced_color(moving)
        overlay = style.two_tone(grey, style.stretched(moved))
        axes.imshow(overlay, extent=place.extent(grid), interpolation="nearest")
        axes.set_title(f"overlay, {name}", fontsize=10)
        place.label(axes, inner=index > 0)
    axes = figure.add_subplot(1, columns, columns)
    moved, _ = style.reduced_color(stages[-1][1])
    board = _checkerboard(color, moved)
    axes.imshow(style.over_white(board), extent=place.extent(grid), interpolation="nearest")
    axes.set_title(f"checkerboard of both surveys, {stages[-1][0]}", fontsize=10)
    place.label(axes, inner=True)
    return figure


def draw_extents(registration: Registration) -> Any:
    """Draw where both surveys lie: their bounding boxes, as delivered and registered."""
    boxes: list[tuple[str, Any, dict[str, Any]]] = []
    looks: dict[str, dict[str, Any]] = {
        "reference": {"color": style.REFERENCE},
        "moving": {"color": style.MOVING},
    }
    for name, entry in (("reference", registration.reference), ("moving", registration.moving)):
        bounds = np.array(entry.get("bounds") or np.nan, float)
        if bounds.shape != (2, 3) or not np.isfinite(bounds).all():
            return None
        boxes.append((name, bounds, looks[name]))
    if registration.transform is not None:
        corners = np.stack(np.meshgrid(*boxes[1][1].T, indexing="ij"), axis=-1).reshape(-1, 3)
        moved = registration.transform.apply(corners)
        ends = np.stack([moved.min(axis=0), moved.max(axis=0)])
        boxes.append(("moving, registered", ends, {**looks["moving"], "linestyle": "--"}))
    low = np.min([ends[0, :2] for _, ends, _ in boxes], axis=0)
    high = np.max([ends[1, :2] for _, ends, _ in boxes], axis=0)
    cell = max(float((high - low).max()), 1e-6) / 100
    rows, cols = np.maximum(np.ceil((high - low)[::-1] / cell).astype(int), 1)
    place = style.Place(Grid(low[0], high[1], cell, (int(rows), int(cols))))
    title = "Where the surveys lie"
    figure = style.new_figure(6.8, 6.4, title, "bounding boxes, seen from above")
    axes = figure.add_subplot()
    for name, ends, look in boxes:
        (west, south), (east, north) = ends[:, :2] - [place.east, place.north]
        ring = np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])
        axes.plot(*ring.T, label=name, linewidth=1.8, **look)
    place.label(axes)
    axes.margins(0.08)
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.25)
    style.legend_below(axes)
    return figure


def _stages(registration: Registration, key: str) -> list[tuple[str, SurveyRaster]]:
    """Return the moving survey's rasters that there are: as delivered, then registered."""
    named = (("before", f"{key}_before"), ("after", key))
    evidence = registration.evidence
    return [(name, evidence[k]) for name, k in named if evidence.get(k) is not None]


def _busiest_column(reference: SurveyRaster, moving: SurveyRaster) -> int | None:
    """Column with the most cells seen by both; the one nearest the middle among equals."""
    shared = (reference.valid & moving.valid).sum(axis=0)
    seen = shared if shared.any() else reference.valid.sum(axis=0)
    if not seen.any():
        return None
    good = np.flatnonzero(seen >= 0.95 * seen.max())
    centre = np.average(np.arange(seen.size), weights=seen)
    return int(good[np.argmin(np.abs(good - centre))])


def _profile(axes: Any, north: Any, raster: SurveyRaster, column: int, **look: Any) -> None:
    height = raster.height[:, column].astype(np.float64) + raster.datum
    axes.plot(north, height, **look)


def _checkerboard(reference: Any, moving: Any, fields: int = 8) -> Any:
    rows, cols = reference.shape[:2]
    side = max(1, round(max(rows, cols) / fields))
    row, col = np.mgrid[:rows, :cols] // side
    take_moving = ((row + col) % 2 == 1)[..., None]
    # Outside the overlap the survey that saw the field is shown.
    unseen = np.where(take_moving, ~np.isfinite(moving), ~np.isfinite(reference))
    return np.where(take_moving ^ unseen, moving, reference)
