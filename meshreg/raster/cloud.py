"""Points to a raster: the mean of the top layer in each cell."""

from __future__ import annotations

import numpy as np

from meshreg.raster.finish import Layers, empty_layers
from meshreg.raster.floaters import floating_points
from meshreg.raster.placing import Placing
from meshreg.raster.spacing import Spacing
from meshreg.records import Grid, PointCloud
from meshreg.settings import RasterSettings

_LAYER_CELLS = 2.0  # thickness of the top layer: what a cell on a slope of 60 degrees spans
_PASSES = 4  # each takes at least half of what is left
_BLOCK_CELLS = 8192  # cells whose sums fit in a core's cache (44 B each)


def draw_cloud(
    cloud: PointCloud, placing: Placing, grid: Grid, spacing: Spacing, settings: RasterSettings
) -> Layers:
    """Bin points: a cell takes the mean height and color of its top layer.

    The height is that of the cell's centre, along the slope from where its points lie on average.

    The top layer is what lies at most two cells below the cell's highest point, once floaters are
    gone: it holds a cell's whole relief on slopes up to 60 degrees and leaves out what lies under
    an overhang. A cell has a height where it has a point.
    """
    from meshreg.raster import cloud_kernels, kernels

    points = kernels.placed(cloud.points, placing.linear, placing.shift)
    keep = (
        floating_points(points, spacing.points) if settings.remove_floaters else np.empty(0, bool)
    )
    cells, broken = cloud_kernels.cells_of(points, keep, grid.cell, grid.shape)
    layers = empty_layers(grid)
    layers.masked = {"floaters": int(np.count_nonzero(~keep)), "not finite": int(broken)}
    colors = cloud.colors
    if colors is None:
        colors = np.empty((0, 3), np.uint8)
        colors.flags.writeable = False  # as a record's array: another type is compiled anew
    size = (grid.cell, *grid.shape)
    found = cloud_kernels.sorted_points(cells, points, colors, size, _BLOCK_CELLS)
    lean = np.zeros((*grid.shape, 2), np.float32)
    arrays = cloud_kernels.CellArrays(
        layers.height.reshape(-1),
        lean.reshape(-1, 2),
        layers.samples.reshape(-1),
        layers.color.reshape(-1, 3),
        layers.color_valid.reshape(-1),
    )
    cloud_kernels.top_means(found, _LAYER_CELLS * grid.cell, _BLOCK_CELLS, arrays)
    mean, before = layers.height.copy(), np.empty_like(layers.height)
    for _ in range(_PASSES):
        before[:] = layers.height
        cloud_kernels.centred(mean, lean, before, layers.height)
    return layers
