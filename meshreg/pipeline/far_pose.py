"""A turn or a scale beyond what is searched: tried on coarse cells where nothing was found.

It is only named, never applied: each survey so turned or scaled is laid against the reference by
the neutral measure, and one is named where it stands out far beyond what so many trials do.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from meshreg.heading import near_offset
from meshreg.judge import channel_maps
from meshreg.offsets.correlate import Window
from meshreg.raster.grid import coarsened
from meshreg.records import Finding, Float32, Grid, SurveyRaster
from meshreg.settings import SearchSettings

log = logging.getLogger(__name__)
ACROSS = 60  # coarse cells across the moving survey
STEP, RATIO = 5, 1.04  # degrees, and from one scale to the next
FOOT = 0.3048
OVERWHELMING = 7.0  # deviations in one channel: on unrelated ground all trials reach about 3
MOST = 300_000  # cells of a transform, so that all trials take seconds


def far_pose(
    pairs: Mapping[str, tuple[SurveyRaster, SurveyRaster]], radius: float, search: SearchSettings
) -> Finding | None:
    """Name the turn or the scale at which the surveys would fit; None for none.

    Parameters
    ----------
    pairs : mapping
        "dem" to (reference, moving), with their colors.
    radius : float
        Half width of the search window [m].
    search : SearchSettings
        What was searched already: `max_yaw` [degrees] and `max_scale`.
    """
    reference, moving = pairs["dem"]
    reference = near_offset(reference, moving, (0.0, 0.0), radius)
    times = max(1, round(math.sqrt(max(int(moving.valid.sum()), 1)) / ACROSS))
    reference, moving = coarsened(reference, times), coarsened(moving, times)
    window = Window.around(_snapped(reference).grid, _snapped(moving).grid, radius)
    if window.empty:
        return None
    if math.prod(window.padded) > MOST:
        log.info("no far turn or scale was tried: the search window is too large")
        return None
    reference = _snapped(reference)
    tried = [(math.radians(yaw), 1.0) for yaw in range(-180, 180, STEP)]
    tried += [(0.0, RATIO**power) for power in range(-18, 19) if power]
    tried += [(0.0, FOOT), (0.0, 1 / FOOT)]
    best, found = 0.0, (0.0, 1.0)
    for yaw, scale in tried:
        there = posed(moving, yaw, scale)
        both = {"dem": (reference, there), "ortho": (reference, there)}
        maps = channel_maps(both, radius, chance=False)
        gaps = [one.peak.gap for one in maps.values() if one.peak is not None]
        if max(gaps, default=0.0) >= OVERWHELMING and sum(gaps) > best:
            best, found = sum(gaps), (yaw, scale)
    yaw, scale = found
    if abs(yaw) > math.radians(search.max_yaw + 0.5 * STEP):
        said = (
            f"the moving survey is turned by about {-math.degrees(yaw):+.0f}°, further than is "
            "searched: check its heading, or turn it back first"
        )
        return Finding("turned", said, values={"degrees": -math.degrees(yaw)})
    if abs(math.log(scale)) > math.log1p(search.max_scale) + 0.5 * math.log(RATIO):
        said = (
            f"the moving survey is about {1 / scale:.2f} times as large as the reference, further "
            "off than is searched: check the units (--unit) and the scale"
        )
        return Finding("resized", said, values={"times": 1 / scale})
    return None


def posed(raster: SurveyRaster, yaw: float, scale: float) -> SurveyRaster:
    """Return the raster turned by `yaw` [rad] anticlockwise, and scaled, about its middle."""
    from scipy.ndimage import affine_transform

    grid = raster.grid
    size = math.ceil(math.hypot(*grid.shape) * scale)
    c, s = math.cos(yaw), math.sin(yaw)
    back = np.array([[c, s], [-s, c]]) / scale  # rows grow southward
    middle, there = (np.array(grid.shape) - 1) / 2, np.full(2, (size - 1) / 2)

    def sampled(array: object) -> Float32:
        values = np.asarray(array, np.float32)
        start = middle - back @ there
        return np.asarray(affine_transform(values, back, start, (size, size), order=1), np.float32)

    valid, colored = sampled(raster.valid) > 0.99, sampled(raster.color_valid) > 0.99
    color = np.stack([sampled(raster.color[..., k]) for k in range(3)], axis=-1)
    row, col = middle - there
    moved = replace(
        raster,
        grid=Grid(
            grid.west + col * grid.cell,
            grid.north - row * grid.cell,
            grid.cell,
            (size, size),
            grid.crs,
        ),
        height=np.where(valid, scale * sampled(np.where(raster.valid, raster.height, 0)), 0).astype(
            np.float32
        ),
        color=np.clip(np.rint(color), 0, 255).astype(np.uint8),
        valid=valid,
        color_valid=colored,
        samples=valid.astype(np.uint16),
    )
    return _snapped(moved)


def _snapped(raster: SurveyRaster) -> SurveyRaster:
    """Shift a raster by less than a cell, onto the lattice of whole ones."""
    grid = raster.grid
    west, north = (round(value / grid.cell) * grid.cell for value in (grid.west, grid.north))
    return replace(raster, grid=replace(grid, west=west, north=north))
