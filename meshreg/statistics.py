"""How well two rasters on one grid agree: the numbers that users know."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from meshreg.errors import UsageError
from meshreg.types import Float64, Grid, SurveyRaster

MAD_TO_SIGMA = 1.4826


def on_grid(raster: SurveyRaster, grid: Grid) -> SurveyRaster:
    """Copy a raster into a larger grid of the same lattice; nothing is resampled.

    Raises
    ------
    UsageError
        If the grid does not hold the raster, or is shifted by a part of a cell.
    """
    row, col = grid.row_col(*raster.grid.east_north(0, 0))
    top, left = round(float(row)), round(float(col))
    rows, cols = raster.grid.shape
    fits = 0 <= top <= grid.shape[0] - rows and 0 <= left <= grid.shape[1] - cols
    if not fits or max(abs(row - top), abs(col - left)) > 1e-3:
        raise UsageError(f"Grid {grid} does not hold {raster.grid} on one lattice.")
    part = (slice(top, top + rows), slice(left, left + cols))

    def placed(array: Any, empty: Any) -> Any:
        whole = np.full((*grid.shape, *array.shape[2:]), empty, array.dtype)
        whole[part] = array
        return whole

    return dataclasses.replace(
        raster,
        grid=grid,
        height=placed(raster.height, np.nan),
        color=placed(raster.color, 0),
        valid=placed(raster.valid, False),
        color_valid=placed(raster.color_valid, False),
        samples=placed(raster.samples, 0),
    )


def height_difference(reference: SurveyRaster, moving: SurveyRaster) -> Float64:
    """(H, W) float64: reference less moving height [m], NaN where either is missing."""
    difference = reference.height.astype(np.float64) - moving.height
    difference += reference.datum - moving.datum
    return np.where(reference.valid & moving.valid, difference, np.nan)


def height_offset(reference: SurveyRaster, moving: SurveyRaster) -> tuple[float, float]:
    """Up [m] to add to the moving survey, and its sigma.

    The median of the height differences: growth and loss move it only by the share of ground
    that they touch. Neighbouring cells err together, so the sigma comes from the scatter of the
    medians of 8 × 8 blocks of the overlap, not from the number of cells.
    """
    difference = height_difference(reference, moving)
    finite = np.isfinite(difference)
    if not finite.any():
        return 0.0, float("nan")
    up = float(np.median(difference[finite]))
    rows, cols = np.nonzero(finite)
    edges = [np.linspace(a.min(), a.max() + 1, 9).astype(int) for a in (rows, cols)]
    medians = []
    for r in range(8):
        for c in range(8):
            block = difference[edges[0][r] : edges[0][r + 1], edges[1][c] : edges[1][c + 1]]
            known = block[np.isfinite(block)]
            if known.size >= 4:
                medians.append(float(np.median(known)))
    if len(medians) < 4:
        return up, float(nmad(difference[finite]))
    return up, float(nmad(np.array(medians)) / np.sqrt(len(medians)) * np.sqrt(np.pi / 2))


def nmad(values: Float64) -> float:
    """Normalised median absolute deviation (Höhle and Höhle 2009, section 3.2)."""
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))


def compare(
    reference_dem: SurveyRaster,
    moving_dem: SurveyRaster,
    reference_ortho: SurveyRaster,
    moving_ortho: SurveyRaster,
) -> dict[str, Any]:
    """Overlap, height statistics [m] and image similarity (-1 to 1) of rasters on common grids.

    `overlap` is the share of the smaller survey's cells that both see; `image_similarity` the
    correlation coefficient of locally normalised grey (None where either has no color).
    """
    difference = height_difference(reference_dem, moving_dem)
    known = difference[np.isfinite(difference)]
    smaller = min(int(reference_dem.valid.sum()), int(moving_dem.valid.sum()))
    result: dict[str, Any] = {
        "overlap": known.size / smaller if smaller else 0.0,
        "cells": int(known.size),
        "height_median": None,
        "height_nmad": None,
        "height_rmse": None,
        "image_similarity": _image_similarity(reference_ortho, moving_ortho),
    }
    if known.size:
        result["height_median"] = float(np.median(known))
        result["height_nmad"] = nmad(known)
        result["height_rmse"] = float(np.sqrt(np.mean(known**2)))
    return result


def _image_similarity(reference: SurveyRaster, moving: SurveyRaster) -> float | None:
    from meshreg.offsets.channels import grey, local_normalised

    both = reference.color_valid & moving.color_valid
    if both.sum() < 100:
        return None
    a, b = (local_normalised(grey(r), r.color_valid, 10.0)[both] for r in (reference, moving))
    spread = float(np.std(a) * np.std(b))
    return float(np.mean((a - a.mean()) * (b - b.mean())) / spread) if spread > 0 else None
