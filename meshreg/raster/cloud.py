"""Points to a raster: the mean of the top layer in each cell."""

from __future__ import annotations

import numpy as np

from meshreg.raster.finish import Layers, empty_layers
from meshreg.raster.floaters import floating_points
from meshreg.raster.placing import Placing
from meshreg.raster.spacing import Spacing
from meshreg.settings import RasterSettings
from meshreg.types import Grid, Int32, PointCloud

_LAYER_CELLS = 2.0  # thickness of the top layer: what a cell on a slope of 60 degrees spans
_SLAB_CELLS = 16_000_000  # cells whose sums are in memory together (32 B each)


def draw_cloud(
    cloud: PointCloud, placing: Placing, grid: Grid, spacing: Spacing, settings: RasterSettings
) -> Layers:
    """Bin points: a cell takes the mean height and color of its top layer.

    The top layer is what lies at most two cells below the cell's highest point, once floaters are
    gone: it holds a cell's whole relief on slopes up to 60 degrees and leaves out what lies under
    an overhang. A cell has a height where it has a point.
    """
    import numba

    from meshreg.raster import cloud_kernels, kernels

    points = kernels.placed(cloud.points, placing.linear, placing.shift)
    keep = (
        floating_points(points, spacing.points) if settings.remove_floaters else np.empty(0, bool)
    )
    cells, broken = cloud_kernels.cells_of(points, keep, grid.cell, grid.shape)
    layers = empty_layers(grid)
    layers.masked = {"floaters": int(np.count_nonzero(~keep)), "not finite": int(broken)}
    rows, cols = grid.shape
    colored = cloud.colors is not None
    colors = cloud.colors if cloud.colors is not None else np.empty((0, 3), np.uint8)
    height, samples = layers.height.reshape(-1), layers.samples.reshape(-1)
    color, color_valid = layers.color.reshape(-1, 3), layers.color_valid.reshape(-1)
    size = max(1, _SLAB_CELLS // cols) * cols
    for first in range(0, rows * cols, size):
        last = min(first + size, rows * cols)
        bounds = _shares(cells, first, last, numba.get_num_threads())
        sums = cloud_kernels.top_sums(
            cells, points, colors, _LAYER_CELLS * grid.cell, first, bounds
        )
        cloud_kernels.cell_means(
            sums,
            height[first:last],
            samples[first:last],
            color[first:last] if colored else color[:0],
            color_valid[first:last],
        )
    return layers


def _shares(cells: Int32, first: int, last: int, workers: int) -> Int32:
    """Split the cells `first` to `last` so that each worker has about as many points."""
    sample = cells[:: max(1, len(cells) // 50_000)]
    sample = np.sort(sample[(sample >= first) & (sample < last)]) - first
    bounds = np.zeros(workers + 1, np.int32)
    bounds[-1] = last - first
    if len(sample):
        bounds[1:-1] = sample[np.arange(1, workers) * len(sample) // workers]
    else:
        bounds[1:-1] = np.arange(1, workers) * (last - first) // workers
    return bounds
