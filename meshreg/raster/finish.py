"""What every raster goes through at the end: unseen flat color, small gaps, the user's mask."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import UsageError
from meshreg.records import Bool, Float32, Grid, SurveyRaster, Transform, UInt8
from meshreg.settings import RasterSettings

_FLAT_SHARE = 0.005  # of the colored cells: less is not worth a mask
_FLAT_TEXELS = 12  # width of a flat piece: over one 8 × 8 block of JPEG, which may well be flat
_FLAT_STEP = 10  # grey levels by which flat fill differs from what lies around it
_ABRUPT = 0.7  # of the difference farther out (16 texels) is there at the border already
_FLAT_COLORS = 8  # colors looked at
_BLOCK_TEXELS = 16  # width of a block of JPEG with halved color
_ALIKE = 32  # grey levels to which such a block may have changed the fill


@dataclass
class Layers:
    """A raster in the making; its arrays are written in place.

    `still` is True where all samples of a cell have one color (None: not known).
    """

    height: Float32
    samples: NDArray[np.uint16]
    color: UInt8
    color_valid: Bool
    still: Bool | None = None
    masked: dict[str, int] = field(default_factory=dict)


def empty_layers(grid: Grid) -> Layers:
    """Return layers without data."""
    return Layers(
        height=np.full(grid.shape, np.nan, np.float32),
        samples=np.zeros(grid.shape, np.uint16),
        color=np.zeros((*grid.shape, 3), np.uint8),
        color_valid=np.zeros(grid.shape, np.bool_),
    )


def finished(
    layers: Layers,
    grid: Grid,
    settings: RasterSettings,
    texel: float,
    datum: float,
    mask: Any,
    transform: Transform | None,
) -> SurveyRaster:
    """Mask unseen color, close small gaps, apply the user's mask, and freeze the record."""
    valid = np.isfinite(layers.height)
    layers.color_valid &= valid
    if settings.mask_flat_color and layers.still is not None:
        unseen = flat_color(layers.color, layers.color_valid, layers.still, texel / grid.cell)
        if unseen is not None:
            layers.masked["flat color"] = int(np.count_nonzero(unseen & layers.color_valid))
            layers.color_valid &= ~unseen
    fill_gaps(layers, valid, settings.fill_cells)
    if mask is not None:
        use = _mask_on(grid, mask, transform, layers.height, datum)
        layers.masked["mask"] = int(np.count_nonzero((valid | layers.color_valid) & ~use))
        valid &= use
        layers.color_valid &= use
        layers.height[~use] = np.nan
        layers.samples[~use] = 0
    layers.color[~layers.color_valid] = 0
    return SurveyRaster(
        grid=grid,
        height=layers.height,
        color=layers.color,
        valid=valid,
        color_valid=layers.color_valid,
        samples=layers.samples,
        datum=datum,
        masked={name: count for name, count in layers.masked.items() if count},
    )


def fill_gaps(layers: Layers, valid: Bool, width: int) -> None:
    """Close enclosed gaps of up to `width` × `width` cells by the mean of their neighbours.

    A gap is a set of empty cells that touch by sides or corners. One that reaches the raster's
    edge, or is longer than `width` either way, stays as it is, so the survey never grows. Filled
    cells keep 0 samples. Writes into `layers` and `valid`.
    """
    if width < 1 or valid.all():
        return
    from meshreg.raster import finish_kernels

    gaps = finish_kernels.lone_gaps(valid) if width == 1 else _small_gaps(valid, width)
    places = np.argwhere(gaps)
    while len(places):
        heights, colors, colored = finish_kernels.neighbour_means(
            places, layers.height, valid, layers.color, layers.color_valid
        )
        known = np.isfinite(heights)
        row, col = places[known].T
        layers.height[row, col] = heights[known]
        valid[row, col] = True
        layers.color[row, col] = colors[known]
        layers.color_valid[row, col] = colored[known]
        places = places[~known]


def _small_gaps(valid: Bool, width: int) -> Bool:
    from scipy import ndimage

    labels, _ = ndimage.label(~valid, structure=np.ones((3, 3)))
    rows, cols = valid.shape
    gaps = np.zeros(valid.shape, np.bool_)
    for label, (down, across) in enumerate(ndimage.find_objects(labels), start=1):
        inside = down.start > 0 and across.start > 0 and down.stop < rows and across.stop < cols
        if inside and max(down.stop - down.start, across.stop - across.start) <= width:
            gaps[down, across] |= labels[down, across] == label
    return gaps


def flat_color(color: UInt8, seen: Bool, still: Bool, texel: float) -> Bool | None:
    """Find the areas of exactly one color that texturing programs give to unseen faces.

    Whatever the color (black, orange and white are usual), it is such fill if pieces at least 12
    texels wide in which nothing varies, neither between cells nor within one, cover 0.5 % of the
    seen cells, and their surroundings differ by 10 grey levels or more, at once. Noise keeps real
    ground from the first, however dark; a smooth gradient or an overexposed area, whose color
    goes over gently into what is around, fails the second.

    Parameters
    ----------
    color, seen, still : (H, W, 3) uint8, (H, W) bool, (H, W) bool
        Mean colors, where there are any, and where all samples of a cell are alike.
    texel : float
        Size of a texel in cells.

    Returns
    -------
    (H, W) bool or None
        The fill with a rim of two texels and a cell, in which it is mixed with what is beside it;
        None without fill.
    """
    from meshreg.raster import finish_kernels

    least = max(1.0, _FLAT_SHARE * np.count_nonzero(seen))
    calm = finish_kernels.calm_cells(color, still & seen)
    if np.count_nonzero(calm) < 0.5 * least:
        return None
    counts = finish_kernels.color_counts(color, calm)
    # Calm cells lack the rim of a piece: hence half of the share here, all of it below.
    candidates = np.flatnonzero(counts >= 0.5 * least)
    candidates = candidates[np.argsort(-counts[candidates], kind="stable")][:_FLAT_COLORS]
    found = None
    for value in candidates:
        rgb = np.array([value >> 16, value >> 8 & 255, value & 255], np.uint8)
        same = still & seen & (color == rgb).all(axis=2)
        box = _box_around(same, 4 * math.ceil(_BLOCK_TEXELS * texel) + 16)
        fill = _fill_of_color(color[box], seen[box], same[box], rgb, least, texel)
        if fill is not None:
            found = np.zeros(seen.shape, bool) if found is None else found
            found[box] |= fill
    return found


def _box_around(where: Bool, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns that hold all True cells, and `margin` more on each side."""
    sides = []
    for axis in (1, 0):
        there = np.flatnonzero(where.any(axis=axis))
        sides.append(slice(max(int(there[0]) - margin, 0), int(there[-1]) + margin + 1))
    return sides[0], sides[1]


def _fill_of_color(
    color: UInt8, seen: Bool, same: Bool, rgb: UInt8, least: float, texel: float
) -> Bool | None:
    """Return the fill among the cells that are `same` as `rgb` throughout, if it is fill."""
    from scipy import ndimage

    def cells(texels: float) -> int:
        return math.ceil(texels * texel - 0.01)

    def grown(where: Bool, by: int) -> Bool:
        return np.asarray(ndimage.maximum_filter(where, 2 * by + 1, mode="constant"))

    def like(within: Bool, levels: int) -> Bool:
        found = within & seen
        found[found] = _steps(color[found], rgb) <= levels
        return found

    width = max(5, cells(_FLAT_TEXELS)) | 1
    core = ndimage.minimum_filter(same, width, mode="constant")
    pieces = np.asarray(ndimage.maximum_filter(core, width, mode="constant"))
    if np.count_nonzero(pieces) < least:
        return None
    rim = 1 + cells(2)
    fringe = grown(pieces, 1 + cells(_BLOCK_TEXELS))
    base = pieces | like(fringe, _FLAT_STEP - 2)
    near, far = (
        grown(base, by + 1 + cells(2)) & ~grown(base, by) & seen
        for by in (rim, rim + 1 + cells(_BLOCK_TEXELS))
    )
    if not near.any():
        return None
    step = float(np.median(_steps(color[near], rgb)))
    beyond = float(np.median(_steps(color[far], rgb))) if far.any() else step
    if step < _FLAT_STEP or step < _ABRUPT * beyond:
        return None
    # JPEG mixes a block that lies across the border: take in what is there and much alike.
    return grown(pieces | like(fringe, _ALIKE), rim)


def _steps(colors: UInt8, rgb: UInt8) -> NDArray[np.int16]:
    """Largest difference among red, green and blue of colors (N, 3) to one."""
    return np.asarray(np.abs(colors.astype(np.int16) - rgb).max(axis=1))


def _mask_on(
    grid: Grid, mask: Any, transform: Transform | None, height: Float32, datum: float
) -> Bool:
    """Where cells may be used; the mask speaks of the survey as delivered, before `transform`."""
    if transform is None:
        use = np.asarray(mask(grid), bool)
    else:
        if not hasattr(mask, "at"):
            raise UsageError(
                "A mask of a survey that is moved must answer at(east, north), not only for grids.",
                remedy="Use meshreg.io.masks.read_mask.",
            )
        back = transform.inverse()
        use = np.empty(grid.shape, bool)
        cols = np.arange(grid.shape[1])
        for row in range(grid.shape[0]):  # row by row: the coordinates of all would be 24 B a cell
            east, north = grid.east_north(row, cols)
            up = np.nan_to_num(height[row].astype(float)) + datum
            places = back.apply(np.stack([east, np.broadcast_to(north, east.shape), up], axis=1))
            use[row] = mask.at(places[:, 0], places[:, 1])
    if use.shape != grid.shape:
        raise UsageError(f"The mask has shape {use.shape}; the grid has {grid.shape}.")
    return use
