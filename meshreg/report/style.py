"""What all figures share: colors, axes in metres from a stated corner, reduced rasters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from meshreg.records import Float64, Grid, SurveyRaster, UInt8

# Okabe and Ito's palette: told apart with every common color vision, and in grey.
REFERENCE = "#0072B2"  # blue
MOVING = "#D55E00"  # vermilion
GOOD, BAD = "#009E73", "#CC1F1F"  # bluish green; red, as thin lines
SECOND = "#CC79A7"  # reddish purple
INK = "#222222"
METHOD_STYLES = {
    "sift": ("#E69F00", "o"),
    "terrain": ("#0072B2", "s"),
    "mutual_information": ("#CC79A7", "D"),
    "ties": ("#56B4E9", "^"),
}
METHOD_NAMES = {
    "sift": "SIFT",
    "terrain": "terrain scan",
    "mutual_information": "mutual information",
    "ties": "tie points (by hand)",
}
DPI = 130
MAX_PIXELS = 2000  # longest side of a picture
MAX_SIDE = 700  # longest side of a raster inside a picture


def method_name(method: str) -> str:
    """How a method is called in print."""
    return METHOD_NAMES.get(method, method.replace("_", " "))


def new_figure(
    width: float, height: float, title: str, subtitle: str = "", *, bars: bool = False
) -> Any:
    """Return a figure of `width` × `height` inches that needs no screen, with its title.

    `bars`: it has color bars between its panels; only the slower layout keeps them apart.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import TightLayoutEngine

    scale = min(1.0, MAX_PIXELS / DPI / max(width, height))
    figure = Figure(
        figsize=(width * scale, height * scale),
        dpi=DPI,
        # without a rectangle it measures all labels once, not twice, and comes to the same
        layout="constrained" if bars else TightLayoutEngine(rect=None),  # type: ignore[arg-type]
    )
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12, fontweight="bold", color=INK)
    if subtitle:
        figure.supxlabel(subtitle, fontsize=9, color="#555555")
    return figure


def panel_size(grid: Grid, width: float, tallest: float = 7.0) -> float:
    """Height [inch] of an axes `width` wide that shows the grid undistorted."""
    rows, cols = grid.shape
    return float(np.clip(width * rows / cols, 1.6, tallest))


class Place:
    """A round corner near the data, from which the axes count metres."""

    def __init__(self, grid: Grid) -> None:
        west, south, east, north = grid.bounds
        step = 10.0 ** max(1, math.ceil(math.log10(max(east - west, north - south))))
        self.east = math.floor(west / step) * step if abs(west) > 10 * step else 0.0
        self.north = math.floor(south / step) * step if abs(south) > 10 * step else 0.0

    def label(self, axes: Any, *, inner: bool = False) -> None:
        """Name the axes of a map; `inner` leaves the north label to a neighbour."""
        axes.set_xlabel(_axis("east", self.east))
        if not inner:
            axes.set_ylabel(_axis("north", self.north))
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8)
        axes.locator_params(nbins=5)
        axes.ticklabel_format(useOffset=False, style="plain")

    def extent(self, grid: Grid) -> tuple[float, float, float, float]:
        """Return `imshow`'s extent: west, east, south, north from the corner."""
        west, south, east, north = grid.bounds
        return west - self.east, east - self.east, south - self.north, north - self.north


def _axis(name: str, corner: float) -> str:
    return f"{name} [m]" if corner == 0 else f"{name} − {corner:,.0f} [m]".replace(",", "\u2009")


def reduced_height(raster: SurveyRaster, side: int = MAX_SIDE) -> tuple[Float64, Grid]:
    """Return absolute heights [m] in cells coarse enough for a picture, NaN where none."""
    step = _step(raster.grid, side)
    height, grid = _blocks(raster.height.astype(np.float64), raster.grid, step)
    return height + raster.datum, grid


def reduced_color(raster: SurveyRaster, side: int = MAX_SIDE) -> tuple[Float64, Grid]:
    """Return (h, w, 3) colors 0-1 in cells coarse enough for a picture, NaN where unseen."""
    step = _step(raster.grid, side)
    channels = []
    for band in range(3):
        values = np.where(raster.color_valid, raster.color[..., band], np.nan)
        mean, grid = _blocks(values, raster.grid, step)
        channels.append(mean / 255.0)
    return np.stack(channels, axis=-1), grid


def _step(grid: Grid, side: int) -> int:
    return max(1, math.ceil(max(grid.shape) / side))


def _blocks(values: Any, grid: Grid, step: int) -> tuple[Float64, Grid]:
    """Mean of each step × step block that has a value; the last incomplete blocks fall away."""
    if step == 1:
        return np.asarray(values, np.float64), grid
    rows, cols = (max(1, n // step) for n in grid.shape)
    cut = np.asarray(values, np.float64)[: rows * step, : cols * step]
    blocks = cut.reshape(rows, min(step, cut.shape[0]), cols, min(step, cut.shape[1]))
    seen = np.isfinite(blocks)
    count = seen.sum(axis=(1, 3))
    total = np.where(seen, blocks, 0.0).sum(axis=(1, 3))
    mean = np.full(count.shape, np.nan)
    np.divide(total, count, out=mean, where=count > 0)
    return mean, Grid(grid.west, grid.north, grid.cell * step, (rows, cols), grid.crs)


def hillshade(height: Float64, cell: float) -> Float64:
    """Light from the north-west at 45°, 0-1; NaN where a neighbour is missing."""
    south, east = np.gradient(height, cell) if min(height.shape) > 1 else (height * 0, height * 0)
    north = -south
    spread = np.nanpercentile(np.hypot(east, north), 90) if np.isfinite(east).any() else 1.0
    steep = 1.0 / max(float(spread), 1e-9)  # so that flat ground shows its relief too
    east, north = east * steep, north * steep
    normal = np.sqrt(1 + east**2 + north**2)
    light = np.array([-1, 1, np.sqrt(2)]) / 2
    return np.asarray((-east * light[0] - north * light[1] + light[2]) / normal)


def two_tone(reference: Float64, moving: Float64) -> UInt8:
    """Overlay two grey pictures (0-1, NaN = none): blue is reference alone, red moving alone.

    Where both are equally bright the picture is grey; a shift shows as colored rims.
    """
    alone_r, alone_m = np.isfinite(reference), np.isfinite(moving)
    ref, mov = np.nan_to_num(reference), np.nan_to_num(moving)
    both = alone_r & alone_m
    picture = np.ones((*reference.shape, 3))
    picture[both] = np.stack([mov, np.minimum(ref, mov), ref], axis=-1)[both]
    pale = np.array([0.78, 0.88, 0.97]), np.array([0.98, 0.86, 0.78])
    picture[alone_r & ~both] = (pale[0] * (0.6 + 0.4 * ref[..., None]))[alone_r & ~both]
    picture[alone_m & ~both] = (pale[1] * (0.6 + 0.4 * mov[..., None]))[alone_m & ~both]
    return np.asarray(np.round(255 * np.clip(picture, 0, 1)), np.uint8)


def stretched(color: Float64) -> Float64:
    """Grey 0-1 of a color picture, its middle 96 % spread over the whole scale."""
    grey = color @ np.array([0.299, 0.587, 0.114])
    if not np.isfinite(grey).any():
        return np.asarray(grey)
    low, high = np.nanpercentile(grey, [2, 98])
    return np.asarray(np.clip((grey - low) / max(high - low, 1e-6), 0, 1))


def over_white(color: Float64) -> UInt8:
    """(h, w, 3) uint8 of a color picture, white where nothing was seen."""
    return np.asarray(np.round(255 * np.nan_to_num(np.clip(color, 0, 1), nan=1.0)), np.uint8)


def legend_below(axes: Any, handles: Sequence[Any] | None = None, columns: int = 3) -> None:
    """Put the legend under the axes, where it hides nothing."""
    options = {"handles": handles} if handles is not None else {}
    axes.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, -0.11),
        ncols=columns,
        frameon=False,
        fontsize=8,
        **options,
    )
