"""How well two rasters on one grid agree: the numbers that users know."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.offsets.channels import grey, local_normalised
from meshreg.records import Float64, SurveyRaster
from meshreg.statistics import nmad

APART: dict[str, Any] = {  # of surveys that lie beside each other
    "overlap": 0.0,
    "cells": 0,
    "height_median": None,
    "height_nmad": None,
    "height_rmse": None,
    "image_similarity": None,
}


def height_difference(reference: SurveyRaster, moving: SurveyRaster) -> Float64:
    """(H, W) float64: reference less moving height [m], NaN where either is missing."""
    difference = reference.height.astype(np.float64) - moving.height
    difference += reference.datum - moving.datum
    return np.where(reference.valid & moving.valid, difference, np.nan)


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
    both = reference.color_valid & moving.color_valid
    if both.sum() < 100:
        return None
    a, b = (local_normalised(grey(r), r.color_valid, 10.0)[both] for r in (reference, moving))
    spread = float(np.std(a) * np.std(b))
    return float(np.mean((a - a.mean()) * (b - b.mean())) / spread) if spread > 0 else None
