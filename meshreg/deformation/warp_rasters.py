"""What a warp has to do with rasters: how far up each tile must go, and bending a map."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import Any

import numpy as np

from meshreg.records import Float64, Grid, SurveyRaster, Warp
from meshreg.statistics import biweight, densest

LEAST_TILES = 6
_NODE = 16  # cells between the places where the inverse of a warp is solved


def height_tiles(
    reference: SurveyRaster,
    moving: SurveyRaster,
    warp: Warp | None,
    side: float,
    low: Float64,
    high: Float64,
) -> tuple[Float64, Float64] | None:
    """Places (M, 2) and up (M,) [m] to add to the moving survey, of each tile of a box.

    Heights are compared at the places to which the warp's horizontal part moves the moving cells:
    on a slope a horizontal misfit would pass for a vertical one. Of each tile the most common
    difference is taken (`common_value`), which growth on part of its ground leaves alone.
    """
    difference = _difference(reference, moving, warp)
    counts = np.maximum(np.floor((high - low) / side + 1e-6).astype(int), 1)
    row, col = np.nonzero(np.isfinite(difference))
    if not len(row):
        return None
    east, north = moving.grid.east_north(row, col)
    bins = np.floor((np.stack([east, north], axis=1) - low) / (high - low) * counts).astype(int)
    inside = ((bins >= 0) & (bins < counts)).all(axis=1)
    number = (bins[:, 1] * counts[0] + bins[:, 0])[inside]
    order = np.argsort(number, kind="stable")
    values = difference[row, col][inside][order]
    points = np.stack([east, north], axis=1)[inside][order]
    ends = np.searchsorted(number[order], np.arange(counts.prod() + 1))
    full = (side / moving.grid.cell) ** 2
    places, ups = [], []
    for start, end in pairwise(ends):
        if end - start >= 0.5 * full:
            places.append(points[start:end].mean(axis=0))
            ups.append(common_value(values[start:end]))
    if len(ups) < LEAST_TILES:
        return None
    return np.array(places), np.array(ups)


def _difference(reference: SurveyRaster, moving: SurveyRaster, warp: Warp | None) -> Float64:
    """Return the reference height where each moving cell belongs, less its own [m]; or NaN."""
    from scipy.ndimage import map_coordinates

    rows, cols = moving.grid.shape
    row, col = np.mgrid[:rows, :cols].astype(np.float64)
    if warp is not None:
        shift = _on_lattice(warp.displacement, moving.grid)
        row, col = row - shift[..., 1] / moving.grid.cell, col + shift[..., 0] / moving.grid.cell
    height = np.where(reference.valid, reference.height.astype(np.float64), np.nan)
    there = map_coordinates(height, [row, col], order=1, cval=np.nan)
    own = np.where(moving.valid, moving.height.astype(np.float64), np.nan)
    return np.asarray(there - own + (reference.datum - moving.datum))


def common_value(values: Float64) -> float:
    """Return the middle of the values where they are densest.

    The start is the shortest third of them (after Rousseeuw's shorth), which gain or loss on half
    of the ground does not enter; then Tukey's biweight at 2.5 of its deviations.
    """
    ordered = np.sort(values)
    third = len(ordered) // 3
    at, width = densest(ordered, third + 1)
    middle = float(ordered[at : at + third + 1].mean())
    spread = max(width / (2 * 0.4307), 1e-9)  # a third lies within 0.4307 deviations
    for _ in range(10):
        weight = biweight((ordered - middle) / (2.5 * spread))
        if not weight.any():
            break
        middle = float(np.average(ordered, weights=weight))
    return middle


def warped_raster(raster: SurveyRaster, warp: Warp) -> SurveyRaster:
    """Bend a raster that the transform has laid down: each cell takes what belongs there.

    Heights and colors are sampled bilinearly at the inverse of the warp; a cell is seen where the
    nearest old cell is.
    """
    from scipy.ndimage import map_coordinates

    grid = raster.grid
    rows, cols = grid.shape

    def back(places: Float64) -> Float64:
        points = np.column_stack([places, np.zeros(len(places))])
        return points - warp.inverse(points)  # the displacement of what arrives here

    shift = _on_lattice(back, grid)
    row, col = np.mgrid[:rows, :cols].astype(np.float64)
    row, col = row + shift[..., 1] / grid.cell, col - shift[..., 0] / grid.cell
    near = np.rint(row).astype(int), np.rint(col).astype(int)
    inside = (near[0] >= 0) & (near[0] < rows) & (near[1] >= 0) & (near[1] < cols)
    near = tuple(np.where(inside, n, 0) for n in near)  # type: ignore[assignment]

    def sampled(values: Any, known: Any) -> Float64:
        share = map_coordinates(known.astype(np.float64), [row, col], order=1, mode="nearest")
        filled = np.where(known, values, 0).astype(np.float64)
        total = map_coordinates(filled, [row, col], order=1, mode="nearest")
        return np.asarray(total / np.maximum(share, 1e-9))

    valid, seen = (known[near] & inside for known in (raster.valid, raster.color_valid))
    height = sampled(raster.height, raster.valid) + shift[..., 2]
    color = np.stack([sampled(raster.color[..., k], raster.color_valid) for k in range(3)], -1)
    return dataclasses.replace(
        raster,
        height=np.where(valid, height, np.nan).astype(np.float32),
        color=np.where(seen[..., None], np.clip(np.rint(color), 0, 255), 0).astype(np.uint8),
        valid=valid,
        color_valid=seen,
        samples=np.where(valid, raster.samples[near], 0).astype(np.uint16),
    )


def _on_lattice(displacement: Any, grid: Grid) -> Float64:
    """(H, W, 3) displacement [m] at the cells of a grid: solved at nodes, cubic between them."""
    from scipy.interpolate import RectBivariateSpline

    nodes = [np.linspace(0, n - 1, max(4, -(-n // _NODE) + 1)) for n in grid.shape]
    row, col = np.meshgrid(*nodes, indexing="ij")
    places = np.stack(grid.east_north(row.ravel(), col.ravel()), axis=1)
    solved = displacement(places).reshape(*row.shape, 3)
    every = [np.arange(n, dtype=float) for n in grid.shape]
    return np.stack(
        [RectBivariateSpline(*nodes, solved[..., k])(*every) for k in range(3)], axis=-1
    )
