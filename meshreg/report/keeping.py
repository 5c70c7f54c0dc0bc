"""What the page shows of a registration's evidence, reduced to a few MB that can be saved.

The rasters and score surfaces live in memory only. What is kept of them here is a flat mapping of
arrays: pictures as encoded bytes, heights as int16, points as they are, and one JSON text, "meta".
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from meshreg.records import (
    Float64,
    Grid,
    OffsetEstimate,
    Registration,
    SurveyRaster,
    Transform,
)
from meshreg.report import pictures, stated, style

SCHEMA = "meshreg.evidence/1"
STAGES = ("reference", "before", "after")
HEIGHT_SIDE = 350  # cells a side of the heights that the page draws sections and 3-D from
NO_HEIGHT = -32768
MATCH_SIDE = 720
MATCHES = 400  # lines of each kind
BINS = 81
_MODELLED = ("model_east", "model_north")
# Bytes; with a third more for base64 they leave a page of 8 MB its text.
ORTHO, RELIEF, TONE, DIFFERENCE, SMALL = 900_000, 280_000, 170_000, 200_000, 70_000
# What a cell of ground was, in the numbers of `height`, and its color in the picture.
GROUNDS = {"changed": (1, "#E69F00"), "set_aside": (2, "#CC79A7"), "stable": (3, "#009E73")}
NEAR = 0.1  # share of the search window that the picture around a peak shows
_KEYS = {
    "reference": "reference_{}",
    "before": "moving_{}_before",
    "after": "moving_{}",
}
Kept = dict[str, Any]


def keep(registration: Registration) -> Kept:
    """Reduce the evidence to what the page shows.

    Parameters
    ----------
    registration : Registration
        As `register_pair` returns it, with its evidence.

    Returns
    -------
    dict
        Arrays by name, and "meta", a JSON text. Empty where there is no evidence.
    """
    kept: Kept = {}
    meta: dict[str, Any] = {"schema": SCHEMA}
    _keep_orthos(registration.evidence, kept, meta)
    _keep_relief(registration.evidence, kept, meta)
    _keep_difference(registration.evidence, kept, meta)
    _keep_residuals(registration.evidence.get("residuals"), kept)
    _keep_ground(registration.evidence, kept, meta)
    for estimate in registration.estimates:
        _keep_surface(estimate, kept, meta)
        _keep_matches(estimate, registration.evidence.get("motion"), kept, meta)
    if kept:
        _keep_answer(registration, meta)
    if not kept and len(meta) == 1:
        return {}
    kept["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    return kept


def stages(evidence: Mapping[str, Any], kind: str) -> dict[str, SurveyRaster]:
    """Return the rasters ("dem" or "ortho") that there are, by stage."""
    named = {stage: evidence.get(key.format(kind)) for stage, key in _KEYS.items()}
    return {stage: raster for stage, raster in named.items() if raster is not None}


def _map(grid: Grid) -> dict[str, Any]:
    return {"bounds": list(grid.bounds), "cell": grid.cell}


def _keep_orthos(evidence: Mapping[str, Any], kept: Kept, meta: dict[str, Any]) -> None:
    rasters = stages(evidence, "ortho")
    if not any(raster.color_valid.any() for raster in rasters.values()):
        return
    for stage, raster in rasters.items():
        meta["ortho"] = _map(raster.grid)
        picture = pictures.shrunk(raster)
        kept[f"ortho_{stage}"] = pictures.encoded(picture, ORTHO)
        if stage != "after":  # the ground under the lines of the matches
            small = pictures.shrunk(raster, MATCH_SIDE)
            kept[f"small_{stage}"] = pictures.encoded(small, SMALL)
    if (apart := evidence.get("moving_ortho_apart")) is not None:
        meta["apart"] = _map(apart.grid)
        kept["small_before"] = pictures.encoded(pictures.shrunk(apart, MATCH_SIDE), SMALL)


def _keep_relief(evidence: Mapping[str, Any], kept: Kept, meta: dict[str, Any]) -> None:
    rasters = stages(evidence, "dem")
    if "reference" not in rasters:
        return
    heights: dict[str, Float64] = {}
    for stage, raster in rasters.items():
        heights[stage], grid = style.reduced_height(raster, pictures.SIDE)
        meta["dem"] = _map(grid) | {"full_cell": raster.grid.cell}
    shades = {stage: style.hillshade(height, grid.cell) for stage, height in heights.items()}
    for stage, shade in shades.items():
        kept[f"relief_{stage}"] = pictures.encoded(pictures.grey(shade), RELIEF)
        if stage != "reference":
            tone = style.two_tone(shades["reference"], shade)
            seen = np.isfinite(shades["reference"]) | np.isfinite(shade)
            tone = np.dstack([tone, seen.astype(np.uint8) * np.uint8(255)])
            kept[f"tone_{stage}"] = pictures.encoded(tone, TONE)
    height, grid = style.reduced_height(rasters["reference"], MATCH_SIDE)
    small_relief = pictures.grey(style.hillshade(height, grid.cell))
    kept["small_relief"] = pictures.encoded(small_relief, SMALL)
    small = {stage: style.reduced_height(raster, HEIGHT_SIDE) for stage, raster in rasters.items()}
    _keep_heights(small, kept, meta)


def _keep_heights(small: Mapping[str, Any], kept: Kept, meta: dict[str, Any]) -> None:
    """Keep heights as int16 on one scale; a rare spike is cut rather than given all the digits."""
    known = np.concatenate([height[np.isfinite(height)] for height, _ in small.values()])
    if known.size == 0:
        return
    low, high = np.percentile(known, [0.02, 99.98])
    middle, half = (low + high) / 2, max(0.75 * (high - low), 1e-3)
    step = float(half / 32_000)
    for stage, (height, grid) in small.items():
        level = np.clip(np.round((height - middle) / step), -32_000, 32_000)
        seen = np.isfinite(height)
        kept[f"height_{stage}"] = np.where(seen, level, NO_HEIGHT).astype("<i2")
        meta["height"] = _map(grid) | {"step": step, "middle": float(middle)}


def _keep_difference(evidence: Mapping[str, Any], kept: Kept, meta: dict[str, Any]) -> None:
    """Map and histogram of registered less reference height."""
    rasters = stages(evidence, "dem")
    if "reference" not in rasters or "after" not in rasters:
        return
    reference, after = rasters["reference"], rasters["after"]
    both = reference.valid & after.valid
    values = (after.height[both] - reference.height[both]).astype(np.float64)
    values += after.datum - reference.datum
    if values.size == 0:
        return
    limit = max(float(np.percentile(np.abs(values), 98)), 1e-4)
    counts, edges = np.histogram(np.clip(values, -limit, limit), BINS, (-limit, limit))
    height, grid = style.reduced_height(reference, pictures.SIDE // 2)
    difference = style.reduced_height(after, pictures.SIDE // 2)[0] - height
    picture = pictures.colored(difference, -limit, limit, "RdBu_r")
    kept["difference"] = pictures.encoded(picture, DIFFERENCE)
    kept["difference_counts"], kept["difference_edges"] = counts, edges
    meta["difference"] = _map(grid)


def _keep_residuals(field: Any, kept: Kept) -> None:
    """Keep what each tile says, and what the named model of the bending says there."""
    for name, measured, model in (
        ("residuals", ("east", "north", "d_east", "d_north", "weight"), _MODELLED),
        ("residual_ups", ("up_east", "up_north", "up", "up_weight"), ("model_up",)),
    ):
        if field and len(np.atleast_1d(field.get(measured[0], ()))):
            columns = measured + (model if model[0] in field else ())
            kept[name] = np.column_stack([np.asarray(field[key], float) for key in columns])


def _keep_ground(evidence: Mapping[str, Any], kept: Kept, meta: dict[str, Any]) -> None:
    """Keep which ground told the height and the tilt, as a picture on the DEM's grid."""
    ground, reference = evidence.get("stable"), evidence.get("reference_dem")
    if ground is None or reference is None:
        return
    ground = np.asarray(ground)
    counts = {name: int((ground == value).sum()) for name, (value, _) in GROUNDS.items()}
    if not (total := sum(counts.values())):
        return
    step = -(-max(ground.shape) // pictures.SIDE)
    table = np.zeros((256, 4), np.uint8)
    for value, color in GROUNDS.values():
        table[value] = [*bytes.fromhex(color[1:]), 255]
    picture = table[ground[::step, ::step]]
    kept["ground"] = pictures.encoded(picture, SMALL, exact=True)
    meta["ground"] = {name: count / total for name, count in counts.items()}
    meta["ground"]["bounds"] = list(reference.grid.bounds)


def _keep_answer(registration: Registration, meta: dict[str, Any]) -> None:
    """Keep the result as the methods would say it, and by how much the search turned a survey."""
    answer = stated.among_methods(registration)
    if answer is not None:
        (east, north), sigma = answer
        meta["answer"] = {"offset": [east, north]}
        meta["answer"]["sigma"] = None if sigma is None else sigma.tolist()
    motion = registration.evidence.get("motion")
    if motion is not None:
        yaw = math.degrees(motion.yaw)
        meta["turned"] = {"yaw_degrees": yaw, "scale": motion.scale}


def _keep_surface(estimate: OffsetEstimate, kept: Kept, meta: dict[str, Any]) -> None:
    evidence = estimate.evidence
    if "surface" not in evidence or not np.isfinite(evidence["surface"]).any():
        return
    score = np.asarray(evidence["surface"], float)
    east, north = (np.asarray(evidence[key], float) for key in ("east", "north"))
    # Rows of the surface run with `north`; the picture has north at the top.
    score = score[::-1] if north[0] < north[-1] else score
    score = score[:, ::-1] if east[0] > east[-1] else score
    lowest, low, middle, high, highest = np.nanpercentile(score, [0, 1, 50, 99, 100])
    lower = bool(math.isfinite(estimate.score) and estimate.score < middle)
    small = pictures.block_peak(score, 320, lowest=lower)
    ends, colors = ((lowest, high), "cividis_r") if lower else ((low, highest), "cividis")
    kept[f"surface_{estimate.method}"] = pictures.encoded(
        pictures.colored(small, *ends, colors), SMALL, exact=True
    )
    bounds = [value for axis in (east, north) for value in _ends(axis)]
    peaks = {name: _peak(evidence.get(name)) for name in ("best", "second")}
    about = {"bounds": [bounds[0], bounds[2], bounds[1], bounds[3]], "lower_is_better": lower}
    about |= {"low": float(ends[0]), "high": float(ends[1])}
    near, window = _around(score, bounds, peaks["best"])
    if near is not None:
        picture = pictures.colored(near, *ends, colors)
        kept[f"near_{estimate.method}"] = pictures.encoded(picture, SMALL // 2, exact=True)
        about["near"] = window
    meta.setdefault("surfaces", {})[estimate.method] = about | peaks


def _around(
    score: Float64, ends: list[float], best: list[float] | None
) -> tuple[Float64 | None, list[float]]:
    """Cut a window about the best offset from a score, north at the top; its bounds in metres."""
    rows, cols = score.shape
    if best is None or min(rows, cols) < 60:
        return None, []
    west, east, south, north = ends
    size = (east - west) / cols, (north - south) / rows
    half = max(12, round(0.5 * NEAR * max(rows, cols)))
    row, col = int((north - best[1]) / size[1]), int((best[0] - west) / size[0])
    top, left = max(row - half, 0), max(col - half, 0)
    bottom, right = min(row + half + 1, rows), min(col + half + 1, cols)
    if top >= bottom or left >= right:
        return None, []
    window = [west + left * size[0], north - bottom * size[1]]
    window += [west + right * size[0], north - top * size[1]]
    return score[top:bottom, left:right], window


def _ends(axis: Float64) -> tuple[float, float]:
    half = float(abs(axis[-1] - axis[0]) / max(axis.size - 1, 1) / 2) or 0.5
    return float(axis.min()) - half, float(axis.max()) + half


def _peak(peak: Any) -> list[float] | None:
    if peak is None or not np.isfinite(np.asarray(peak, float)).all():
        return None
    return [float(value) for value in peak]


def _keep_matches(
    estimate: OffsetEstimate, motion: Transform | None, kept: Kept, meta: dict[str, Any]
) -> None:
    """Keep some of the matches, evenly, so that a picture is the same each time."""
    evidence = estimate.evidence
    if "reference_points" not in evidence or len(evidence["inliers"]) == 0 or "matches" in kept:
        return
    inliers = np.asarray(evidence["inliers"], bool)
    chosen = []
    for index in (np.flatnonzero(~inliers), np.flatnonzero(inliers)):
        count = min(MATCHES, index.size)
        chosen.append(index[np.linspace(0, index.size - 1, count).astype(int)] if count else index)
    some = np.concatenate(chosen)
    there = np.asarray(evidence["reference_points"], float)[some]
    here = stated.delivered(np.asarray(evidence["moving_points"], float)[some], motion)
    kept["matches"] = np.column_stack([there, here, inliers[some]])
    meta["matches"] = {"inliers": int(inliers.sum()), "total": int(inliers.size)}
