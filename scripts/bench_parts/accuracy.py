"""Accuracy: 25 m pairs with known truth, against the best rigid fit at the overlap's centroid.

Drawn anew for each pair: offset within 3 m east and north, yaw within half a degree, navigation
and light as in the recipe `severity`. DEM cells of 0.10 m, orthomosaic 0.05 m.
"""

from __future__ import annotations

from typing import Any

import numpy as np

PAIRS = 6
OFFSETS = {
    "sfm.offset_length": 0.0,
    "sfm.offset_east": [-3.0, 3.0],
    "sfm.offset_north": [-3.0, 3.0],
}
CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("severity 0.6, no warp", {"severity": 0.6, "sfm.warp": 0.0, "sfm.doming": 0.0}),
    ("severity 0.9, no warp", {"severity": 0.9, "sfm.warp": 0.0, "sfm.doming": 0.0}),
    ("severity 0.6, warp 4-10 cm", {"severity": 0.6, "sfm.warp": [0.04, 0.10]}),
    ("severity 0.9, warp 4-10 cm", {"severity": 0.9, "sfm.warp": [0.04, 0.10]}),
)


def one(case: str, changes: dict[str, Any], seed: int) -> dict[str, Any]:
    """Register one pair of rasters; return its errors."""
    from data_synth.rasters import make_rasters
    from data_synth.recipe import load
    from meshreg.benchmark.measure import of_decision, register_rasters
    from meshreg.settings import Settings

    made = make_rasters(load("severity", {**OFFSETS, **changes}), seed, 25.0, 0.10, 0.05, 0.05)
    pairs = {
        "dem": (made.reference_dem, made.moving_dem),
        "ortho": (made.reference_ortho, made.moving_ortho),
    }
    settings = Settings().changed({"methods": ("terrain", "mutual_information")})
    decision = register_rasters(pairs, settings)
    rows = of_decision(decision, "robust", made.truth, None)
    fused = next(row for row in rows if row["method"] == "fused")
    turn = float("nan") if decision.refined is None else decision.refined.yaw - made.truth["yaw"]
    return {
        "case": case,
        "error": fused.get("error", float("nan")),
        "covered": fused.get("covered", False),
        "yaw": abs(np.rad2deg(turn)),
        "verdict": fused["verdict"],
    }


def bench() -> list[dict[str, Any]]:
    rows = []
    for name, changes in CASES:
        done = [one(name, changes, seed) for seed in range(PAIRS)]
        error = np.array([d["error"] for d in done]) * 1e3
        rows.append(
            {
                "case": name,
                "pairs": PAIRS,
                "median mm": float(np.nanmedian(error)),
                "95 % mm": float(np.nanquantile(error, 0.95)),
                "yaw median °": float(np.nanmedian([d["yaw"] for d in done])),
                "accepted": sum(d["verdict"] == "accepted" for d in done),
                "95 % region covers": sum(bool(d["covered"]) for d in done),
            }
        )
    return rows + steps_on_a_real_reef()


def steps_on_a_real_reef() -> list[dict[str, Any]]:
    """11 × 11 shifts of tenths of a cell, by area means of a real reef DEM's own cells."""
    import rasterio
    from measure import ROOT

    from meshreg.refine import refine
    from meshreg.types import Grid, SurveyRaster

    with rasterio.open(ROOT / "tests" / "data" / "reef_dem" / "horseshoe_dem.tif") as file:
        fine = file.read(1).astype(np.float64)
    times = 10
    n_rows, n_cols = (side // times - 1 for side in fine.shape)

    def raster(row: int, col: int) -> SurveyRaster:
        part = fine[row : row + n_rows * times, col : col + n_cols * times]
        height = part.reshape(n_rows, times, n_cols, times).mean(axis=(1, 3)).astype(np.float32)
        valid = np.isfinite(height)
        color = np.zeros((*height.shape, 3), np.uint8)
        samples = np.full(height.shape, times**2, np.uint16)
        grid = Grid(0.0, 0.1 * n_rows, 0.1, height.shape, None)
        return SurveyRaster(grid, height, color, valid, np.zeros_like(valid), samples)

    reference, errors = raster(0, 0), []
    for row in range(11):
        for col in range(11):
            # the ground that starts `col` tenths further east lies as much too far west
            found = refine(
                [(reference, raster(row, col), "terrain")], (0.0, 0.0), np.eye(2) * 1e-4, 0.3
            )
            truth = 0.01 * np.array([col, -row])
            errors.append(float(np.hypot(*(found.offset - truth))) / 0.1)
    case = "real reef DEM, 11 × 11 shifts of tenths of a cell: cells"
    return [
        {
            "case": case,
            "pairs": 121,
            "median cells": float(np.median(errors)),
            "worst cells": max(errors),
        }
    ]


if __name__ == "__main__":
    for line in bench():
        print(line)
