"""Accuracy: 25 m pairs with known truth, against the best rigid fit at the overlap's centroid.

Drawn anew for each pair: offset within 3 m east and north, yaw within half a degree, navigation
and light as in the recipe `severity`. DEM cells of 0.10 m, orthomosaic 0.05 m.

Where the models bend, `--warp auto` is measured too: what is left between where it puts each place
of the overlap, on a lattice of 0.25 m, and where that belongs. All of the overlap counts, changed
ground included, since the truth is where the rock went and not what grew on it.

Each pair is registered the other way round too: there and back should be nothing, within three
sigmas of east, north, up, both tilts and yaw.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.records import Grid, SurveyRaster, Transform

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
    from data_synth.truth import common_points
    from meshreg.benchmark.measure import of_decision, register_rasters
    from meshreg.settings import Settings

    made = make_rasters(load("severity", {**OFFSETS, **changes}), seed, 25.0, 0.10, 0.05, 0.05)
    pairs = {
        "dem": (made.reference_dem, made.moving_dem),
        "ortho": (made.reference_ortho, made.moving_ortho),
    }
    settings = Settings().changed({"methods": ("terrain", "mutual_information")})
    decision = register_rasters(pairs, settings)
    back = register_rasters({name: (b, a) for name, (a, b) in pairs.items()}, settings)
    rows = of_decision(decision, "robust", made.truth, None)
    fused = next(row for row in rows if row["method"] == "fused")
    turn = float("nan") if decision.refined is None else decision.refined.yaw - made.truth["yaw"]
    return {
        "case": case,
        "error": fused.get("error", float("nan")),
        "covered": fused.get("covered", False),
        "yaw": abs(np.rad2deg(turn)),
        "verdict": fused["verdict"],
        "error up": fused.get("error_up", float("nan")),
        "covered up": fused.get("covered_up", False),
        "back": there_and_back(decision, back),
        "warped": warped(decision, pairs["dem"], common_points(made.scene, 0.25))
        if changes["sfm.warp"]
        else None,
    }


def there_and_back(there: Any, back: Any) -> float:
    """Largest deviation of the six parameters from nothing, in sigmas of both answers together."""
    from meshreg import statistics
    from meshreg.pipeline.decision import covariance_of

    if there.transform is None or back.transform is None:
        return float("nan")
    place = there.heights.place
    home = there.transform.apply(place)
    covariance = np.zeros((7, 7))
    for answer, at in ((there, place), (back, home)):
        transform = answer.transform
        lever = statistics.lever(transform.apply(at) - (transform.pivot + transform.offset))
        covariance += lever @ covariance_of(answer, transform) @ lever.T
    turn = back.transform.rotation @ there.transform.rotation
    axes = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    miss = np.append(back.transform.apply(home) - place, 0.5 * np.array(axes))
    return float(np.abs(miss / np.sqrt(np.diag(covariance)[:6])).max())


def warped(
    decision: Any, dems: tuple[SurveyRaster, SurveyRaster], points: tuple[Any, Any]
) -> dict[str, Any] | None:
    """Bend a registered pair as `--warp auto` does; residuals at (moving, reference) points [m]."""
    from meshreg.deformation.internal import measure
    from meshreg.raster.grid import common_grid, on_grid
    from meshreg.settings import WarpSettings

    transform, refined = decision.transform, decision.refined
    if transform is None:
        return None
    grid = common_grid(dems[0].grid, dems[1].grid)
    reference, moving = on_grid(dems[0], grid), laid_down(dems[1], grid, transform)
    found = measure(refined.tiles, transform, reference, moving, WarpSettings("auto"))
    there = transform.apply(points[0])
    after = there if found.warp is None else found.warp.apply(there)
    parts = [found.record.get(name) or {} for name in ("horizontal", "vertical")]
    return {
        "before": apart(there, points[1]),
        "after": apart(after, points[1]),
        "models": "/".join(part.get("allowed", "none") for part in parts),
        "strain": max(part.get("strain", 0.0) for part in parts),
        "refused": any(part and part["allowed"] != part["model"] for part in parts),
    }


def laid_down(dem: SurveyRaster, grid: Grid, transform: Transform) -> SurveyRaster:
    """Lay a DEM down as a surface: a raster alone cannot be tilted."""
    from meshreg.raster import rasterize
    from meshreg.records import Mesh, Survey
    from meshreg.settings import RasterSettings

    row, col = np.indices(dem.grid.shape)
    height = np.where(dem.valid, dem.height + dem.datum, 0.0)
    places = np.stack([*dem.grid.east_north(row.ravel(), col.ravel()), height.ravel()], axis=1)
    number = row * dem.grid.shape[1] + col
    corners = [np.s_[:-1, :-1], np.s_[1:, :-1], np.s_[:-1, 1:], np.s_[1:, 1:]]
    whole = np.logical_and.reduce([dem.valid[c] for c in corners])
    a, b, c, d = (number[corner][whole] for corner in corners)
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    plain = RasterSettings(remove_floaters=False)
    return rasterize(Survey("moving", Mesh(places, faces)), grid, plain, transform=transform)


def apart(found: NDArray[np.float64], true: NDArray[np.float64]) -> tuple[float, float]:
    """Root mean square residual, horizontal and vertical [mm]."""
    left = 1e3 * (found - true)
    flat, up = (left[:, :2] ** 2).sum(axis=1), left[:, 2] ** 2
    return float(np.sqrt(flat.mean())), float(np.sqrt(up.mean()))


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
                "up median mm": float(1e3 * np.nanmedian(np.abs([d["error up"] for d in done]))),
                "up covers": sum(bool(d["covered up"]) for d in done),
                "there and back, sigmas": float(np.nanmax([d["back"] for d in done])),
            }
        )
        rows[-1] |= residuals([d["warped"] for d in done if d["warped"]])
    return rows + steps_on_a_real_reef()


def residuals(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what is left before and after the warp, as more columns of a case."""
    if not found:
        return {}
    before, after = (np.array([f[when] for f in found]) for when in ("before", "after"))
    models = [f["models"] for f in found]
    strains = [100 * f["strain"] for f in found]
    largest = after.max(axis=0)
    return {
        "rigid leaves mm (flat / up, median)": "{:.0f} / {:.0f}".format(*np.median(before, axis=0)),
        "warp leaves mm (median)": "{:.1f} / {:.1f}".format(*np.median(after, axis=0)),
        "warp leaves mm (largest)": f"{largest[0]:.1f} / {largest[1]:.1f}",
        "models": ", ".join(f"{models.count(m)} {m}" for m in dict.fromkeys(models)),
        "strain % (median, largest)": f"{np.median(strains):.2f}, {max(strains):.2f}",
        "refused": f"{sum(f['refused'] for f in found)} of {len(found)}",
    }


def steps_on_a_real_reef() -> list[dict[str, Any]]:
    """11 × 11 shifts of tenths of a cell, by area means of a real reef DEM's own cells."""
    import rasterio
    from measure import ROOT

    from meshreg.records import Grid, SurveyRaster
    from meshreg.refine.rigid import refine

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
