"""A ready DEM and orthomosaic onto another grid."""

from __future__ import annotations

import math

import numpy as np

from meshreg.errors import UsageError
from meshreg.raster.finish import Layers, empty_layers
from meshreg.raster.placing import Placing
from meshreg.records import Float64, Grid, Maps


def draw_maps(maps: Maps, placing: Placing, grid: Grid) -> Layers:
    """Resample heights and colors: bilinear, averaged over the cell where it is the coarser one.

    Samples lie one source cell apart or closer, so a coarser cell gets the area mean of the cells
    under it (exactly, when shifted only) and a cell that is left in place keeps its very value.
    Missing cells spread no further than themselves: a sample with half of its weight or more on
    them is missing, and so is a cell with under half of its samples.

    Raises
    ------
    UsageError
        If the placing tilts: maps can be shifted, turned about the vertical and scaled.
    """
    from meshreg.raster import maps_kernels as kernels

    if np.abs(placing.linear[[0, 1, 2, 2], [2, 2, 0, 1]]).max() > 1e-9:
        raise UsageError(
            "A DEM with its orthomosaic cannot be tilted.",
            remedy="Register the mesh or the point cloud that they were made from.",
        )
    layers = empty_layers(grid)
    times, back = _back(placing, grid, maps.height_grid)
    height = np.empty(grid.shape)
    kernels.resampled_heights(maps.height, back, times, height)
    layers.height[:] = placing.linear[2, 2] * height + placing.shift[2]
    layers.samples[np.isfinite(height)] = min(times * times, 65535)
    if maps.color is not None and maps.color_valid is not None and maps.color_grid is not None:
        times, back = _back(placing, grid, maps.color_grid)
        kernels.resampled_colors(
            maps.color, maps.color_valid, back, times, layers.color, layers.color_valid
        )
    return layers


def _back(placing: Placing, grid: Grid, source: Grid) -> tuple[int, Float64]:
    """Count the samples along a cell's side; find (2, 3) from their places to the source's."""
    ratio = grid.cell / (source.cell * placing.scale)
    times = max(1, math.ceil(ratio - 1e-6))
    linear = placing.linear[:2, :2]
    # Metres from the grid's corner to metres from the source's corner.
    turn = np.linalg.inv(linear)
    corner = np.array([source.west, source.north])
    start = -turn @ (linear @ corner + placing.shift[:2])
    step = grid.cell / times
    flip = np.diag([1.0, -1.0])
    scaled = flip @ turn @ flip * (step / source.cell)
    shift = flip @ start / source.cell + scaled @ np.array([0.5, 0.5]) - 0.5
    return times, np.column_stack([scaled, shift])
