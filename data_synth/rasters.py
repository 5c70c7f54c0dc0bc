"""The short way: straight from the functions to rasters, for many trials a minute."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth.recipe import Recipe
from data_synth.scene import Scene, Take, make_scene
from data_synth.seeing import Lattice
from data_synth.truth import make_truth
from meshreg.records import Grid, SurveyRaster

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RasterPair:
    """Both surveys as delivered (not registered), each on its own whole-cell grid, and the truth.

    `reference_dem` and `moving_dem` have cells of `dem_cell`, the orthomosaics of `ortho_cell`;
    all grids are snapped to multiples of their cell, so that they differ by whole cells.
    """

    reference_dem: SurveyRaster
    moving_dem: SurveyRaster
    reference_ortho: SurveyRaster
    moving_ortho: SurveyRaster
    truth: dict[str, Any]
    scene: Scene


def make_rasters(
    recipe: Recipe,
    seed: int = 0,
    size: float | None = None,
    dem_cell: float = 0.10,
    ortho_cell: float = 0.05,
    step: float | None = None,
) -> RasterPair:
    """Return a pair as area-averaged rasters, without going through any file or mesh.

    Parameters
    ----------
    recipe : Recipe
    seed : int
    size : float, optional
        Side of the patch [m].
    dem_cell, ortho_cell : float
        [m]
    step : float, optional
        Spacing of the samples that are averaged [m]; by default half of `ortho_cell`.
    """
    scene = make_scene(recipe, seed, size)
    rasters = []
    for take in (scene.reference, scene.moving):
        rasters += _take_rasters(take, dem_cell, ortho_cell, step)
    truth = make_truth(scene)
    return RasterPair(rasters[0], rasters[2], rasters[1], rasters[3], truth, scene)


def _take_rasters(
    take: Take, dem_cell: float, ortho_cell: float, step: float | None
) -> list[SurveyRaster]:
    times = dem_cell / ortho_cell
    fine = ortho_cell / 2.0 if step is None else step
    per_cell = max(1, math.ceil(ortho_cell / fine - 1e-9))
    if abs(times - round(times)) > 1e-9 or times < 1:
        per_dem = max(1, math.ceil(dem_cell / fine - 1e-9))
        return [
            _average(take, _sampled(take, dem_cell, dem_cell / per_dem), per_dem, dem_cell),
            _average(take, _sampled(take, ortho_cell, ortho_cell / per_cell), per_cell, ortho_cell),
        ]
    sampled = _sampled(take, dem_cell, ortho_cell / per_cell)
    return [
        _average(take, sampled, per_cell * round(times), dem_cell),
        _average(take, sampled, per_cell, ortho_cell),
    ]


Sampled = tuple[Grid, NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_]]


def _sampled(take: Take, snap: float, step: float) -> Sampled:
    """Sample a take over its footprint on a lattice that fills whole cells of `snap`."""
    import cv2

    west, south, east, north = take.footprint
    start = take.distortion.start
    left, right = math.floor((start[0] + west) / snap), math.ceil((start[0] + east) / snap)
    low, high = math.floor((start[1] + south) / snap), math.ceil((start[1] + north) / snap)
    per_cell = round(snap / step)
    shape = ((high - low) * per_cell, (right - left) * per_cell)
    lattice = Lattice(
        left * snap - start[0] + step / 2, high * snap - start[1] - step / 2, step, shape
    )
    # a sample stands for the square around it: softened as the mean over that square would be
    seeing = replace(take.seeing, blur=math.hypot(take.seeing.blur, 0.6 * step))
    view = replace(take, seeing=seeing).sample(lattice)
    kept = take.margin_lattice(lattice) > 0
    up = view.up
    sigma = take.sfm.smoothing * take.sfm.mesh_spacing / step
    if sigma > 0.3:
        up = cv2.GaussianBlur(up, (0, 0), sigma)
    if take.sfm.vertex_noise > 0:
        up = up + take.height_noise(*np.meshgrid(lattice.east, lattice.norths)).astype(np.float32)
    grid = Grid(left * snap, high * snap, step, shape, None)
    return grid, up, view.color, kept


def _average(take: Take, sampled: Sampled, per_cell: int, cell: float) -> SurveyRaster:
    """Average blocks of samples; a cell is valid where at least half of its samples are."""
    grid, up, color, kept = sampled
    rows, cols = grid.shape[0] // per_cell, grid.shape[1] // per_cell
    block = (rows, per_cell, cols, per_cell)
    weight = kept.reshape(block).sum(axis=(1, 3))
    safe = np.maximum(weight, 1).astype(np.float32)
    height = np.where(kept, up, 0.0).reshape(block).sum(axis=(1, 3)) / safe
    valid = weight * 2 >= per_cell * per_cell
    paint = np.empty((rows, cols, 3), np.uint8)
    for k in range(3):
        total = np.where(kept, color[..., k], 0).reshape(block).sum(axis=(1, 3), dtype=np.float32)
        paint[..., k] = np.where(valid, np.rint(total / safe), 0).astype(np.uint8)
    return SurveyRaster(
        grid=Grid(grid.west, grid.north, cell, (rows, cols), None),
        height=np.where(valid, height, np.nan).astype(np.float32),
        color=paint,
        valid=valid,
        color_valid=valid,
        samples=np.minimum(weight, 65535).astype(np.uint16),
        datum=float(take.distortion.start[2]),
    )
