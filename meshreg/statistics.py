"""How well two rasters on one grid agree: the numbers that users know."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from meshreg.errors import UsageError
from meshreg.types import Float64, Grid, Registration, SurveyRaster, Transform

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


def lever(arm: Float64) -> Float64:
    """(..., 7, 7) Jacobian that carries a covariance of a transform over an arm (..., 3) [m].

    For parameters in the order of `Registration.covariance`, a place at `arm` from the pivot (both
    after the move) is displaced by ``t + w × arm + s arm``; angles and scale stay as they are.
    """
    arm = np.asarray(arm, np.float64)
    east, north, up = arm[..., 0], arm[..., 1], arm[..., 2]
    carry = np.zeros((*arm.shape[:-1], 7, 7))
    carry[...] = np.eye(7)
    carry[..., 0, 4], carry[..., 0, 5] = up, -north
    carry[..., 1, 3], carry[..., 1, 5] = -up, east
    carry[..., 2, 3], carry[..., 2, 4] = north, -east
    carry[..., :3, 6] = arm
    return carry


def registration_sigma(
    registration: Registration, east: Any, north: Any, up: Any = None
) -> Float64:
    """Return the registration's standard deviation at any place: it grows with the lever arm.

    Parameters
    ----------
    registration : Registration
        Not rejected.
    east, north : float or arrays of one shape
        Absolute coordinates in the reference [m].
    up : float or array, optional
        Height [m]; it matters only where the tilt is uncertain. Default: the pivot's.

    Returns
    -------
    (..., 3) float64
        Of east, north and up [m], by the first-order law ``J C J'`` (`lever`). The internal
        bending of the models is not in it: that is in the residuals.

    Raises
    ------
    UsageError
        If the registration has no covariance.
    """
    transform, covariance = registration.transform, registration.covariance
    if transform is None or covariance is None:
        raise UsageError(
            f"The registration is {registration.verdict} and states no covariance.",
            remedy="Only a registration that is accepted or in review has one.",
        )
    home = transform.pivot + transform.offset
    place = np.stack(np.broadcast_arrays(east, north, home[2] if up is None else up), axis=-1)
    carry = lever(place.astype(np.float64) - home)
    carried = carry @ covariance @ np.swapaxes(carry, -1, -2)
    return np.sqrt(np.clip(np.diagonal(carried, axis1=-2, axis2=-1)[..., :3], 0.0, None))


def registration_error(
    covariance: Float64, transform: Transform, place: Float64
) -> dict[str, Any] | None:
    """x, y, z and the largest standard deviation [m] at `place`, absolute in the reference.

    `isotropic` is what to give software that takes one number for all directions (the
    `registration_error` of M3C2 in py4dgeo and CloudCompare, Lague et al. 2013, equation 1): the
    square root of the largest eigenvalue, never too small in any direction. None where a part of
    the covariance is not known.
    """
    carry = lever(place - (transform.pivot + transform.offset))
    whole = (carry @ covariance @ carry.T)[:3, :3]
    if not np.isfinite(whole).all():
        return None
    x, y, z = (float(value) for value in np.sqrt(np.clip(np.diag(whole), 0.0, None)))
    largest = float(np.sqrt(max(np.linalg.eigvalsh(whole)[-1], 0.0)))
    return {"x": x, "y": y, "z": z, "isotropic": largest, "at": [float(v) for v in place]}


def nmad(values: Float64) -> float:
    """Normalised median absolute deviation (Höhle and Höhle 2009, section 3.2)."""
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))


APART: dict[str, Any] = {  # of surveys that lie beside each other
    "overlap": 0.0,
    "cells": 0,
    "height_median": None,
    "height_nmad": None,
    "height_rmse": None,
    "image_similarity": None,
}


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
    result: dict[str, Any] = APART | {
        "overlap": known.size / smaller if smaller else 0.0,
        "cells": int(known.size),
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
