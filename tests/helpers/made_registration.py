"""A registration made by hand: every field filled, the truth written down, no estimator used."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from meshreg.records import Grid, OffsetEstimate, Registration, SurveyRaster, Transform
from meshreg.settings import Settings

EAST, NORTH = 731_500.0, 5_705_200.0  # UTM size on purpose
OFFSET = np.array([1.3, -0.7, 0.25])
YAW = math.radians(0.2)


def relief(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Height [m] of the made seafloor at absolute points."""
    x, y = east - EAST, north - NORTH
    bumps = 0.35 * np.sin(0.9 * x + 0.3 * y) * np.cos(0.7 * y) + 0.12 * np.sin(2.9 * x - 1.7 * y)
    return -12.0 + 0.04 * x + 0.02 * y + bumps


def shade(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Color (…, 3) uint8 of the made seafloor."""
    x, y = east - EAST, north - NORTH
    grey = 0.5 + 0.3 * np.sin(2.1 * x + 0.4 * y) * np.sin(1.7 * y) + 0.2 * np.sin(5 * x - 4 * y)
    return (255 * np.clip(np.stack([0.9 * grey, grey, 0.8 * grey + 0.1], -1), 0, 1)).astype("u1")


def raster(grid: Grid, moved: tuple[float, float, float] = (0, 0, 0), rim: int = 12) -> Any:
    """The seafloor laid `moved` metres away, with an empty rim on its north and west."""
    rows, cols = grid.shape
    row, col = np.mgrid[:rows, :cols]
    east, north = grid.east_north(row, col)
    valid = (row >= rim) & (col >= rim // 2)
    height = np.where(valid, relief(east - moved[0], north - moved[1]) + moved[2] + 12.0, np.nan)
    color = np.where(valid[..., None], shade(east - moved[0], north - moved[1]), 0)
    samples = np.where(valid, 9, 0)
    return SurveyRaster(grid, height, color, valid, valid, samples, datum=-12.0)


def surface(rng: np.random.Generator, sign: float) -> dict[str, Any]:
    """A score surface with its peak at the truth and a second one elsewhere."""
    east, north = np.arange(-3, 3.01, 0.1), np.arange(-3, 3.01, 0.1)
    x, y = np.meshgrid(east, north)
    peak = np.exp(-((x - OFFSET[0]) ** 2 + (y - OFFSET[1]) ** 2) / 0.18)
    second = 0.45 * np.exp(-((x + 1.5) ** 2 + (y - 1.1) ** 2) / 0.3)
    score = sign * (peak + second + rng.normal(0, 0.03, x.shape))
    score[:4, :9] = np.nan
    return {
        "surface": score,
        "east": east,
        "north": north,
        "best": (OFFSET[0], OFFSET[1]),
        "second": (-1.5, 1.1),
    }


def matches(rng: np.random.Generator) -> dict[str, Any]:
    """180 matches, 70 of them at the true offset within a few centimetres."""
    moving = np.array([EAST, NORTH]) + rng.uniform(2, 22, (180, 2))
    reference = moving + OFFSET[:2] + rng.normal(0, 0.04, (180, 2))
    reference[70:] = np.array([EAST, NORTH]) + rng.uniform(2, 22, (110, 2))
    return {
        "reference_points": reference,
        "moving_points": moving,
        "inliers": np.arange(180) < 70,
    }


def estimates(rng: np.random.Generator) -> tuple[OffsetEstimate, ...]:
    """Three methods: one ok, one weak, one failed and without an offset."""
    sift = OffsetEstimate(
        "sift", "ok", "", 1.31, -0.69, np.array([[4e-4, 1e-4], [1e-4, 9e-4]]), 70 / 180, 9.5,
        0.82, 1.234, matches(rng),
    )  # fmt: skip
    terrain = OffsetEstimate(
        "terrain", "weak", "The second peak is close.", 1.27, -0.72, np.diag([2.5e-3, 1.6e-3]),
        0.91, 3.2, 0.83, 0.4, surface(rng, 1),
    )  # fmt: skip
    failed = OffsetEstimate(
        "mutual_information", "failed", "search border", seconds=0.1, evidence=surface(rng, 1)
    )
    return sift, terrain, failed


def evidence(verdict: str) -> dict[str, Any]:
    """Rasters before and after on common grids, and residuals of tiles."""
    dem = Grid(EAST, NORTH + 26, 0.1, (260, 240))
    ortho = Grid(EAST, NORTH + 26, 0.05, (520, 480))
    back = (-OFFSET[0], -OFFSET[1], -OFFSET[2])
    arrays: dict[str, Any] = {
        "reference_dem": raster(dem),
        "reference_ortho": raster(ortho),
        "moving_dem_before": raster(dem, back, 3),
        "moving_ortho_before": raster(ortho, back, 3),
    }
    if verdict != "rejected":
        arrays["moving_dem"] = raster(dem, (0.01, -0.02, 0.03), 20)
        arrays["moving_ortho"] = raster(ortho, (0.01, -0.02, 0.03), 20)
        east, north = np.meshgrid(EAST + np.arange(3, 23, 4.0), NORTH + np.arange(3, 25, 4.0))
        x, y = east.ravel() - EAST - 12, north.ravel() - NORTH - 12
        arrays["residuals"] = {
            "east": east.ravel(),
            "north": north.ravel(),
            "d_east": -0.003 * y + 0.004,
            "d_north": 0.003 * x - 0.002,
            "weight": np.linspace(0.3, 1, x.size),
        }
        arrays["stable"] = ground()
    return arrays


def ground() -> np.ndarray:
    """Which cells told the height: 3 those of a field, 2 a block in it, 1 a stripe, 0 the rest."""
    state = np.zeros((260, 240), np.uint8)
    state[30:230, 40:220] = 3
    state[60:100, 80:120] = 2
    state[150:160, 60:200] = 1
    return state


def survey_entry(name: str) -> dict[str, Any]:
    """What a registration says about one of its surveys."""
    return {
        "name": name,
        "path": [f"{name}.obj"],
        "sha256": ["ab" * 32],
        "counts": {"vertices": 1234, "faces": 2345},
        "shift": [731_000.0, 5_705_000.0, 0.0],
        "crs": "EPSG:32754",
        "bounds": [[EAST, NORTH, -14.0], [EAST + 24, NORTH + 26, -11.0]],
        "notes": [],
    }


def made_registration(verdict: str = "accepted") -> Registration:
    """The whole record; `verdict` "rejected" comes without transform and without "after"."""
    rng = np.random.default_rng(5)
    cos, sin = math.cos(YAW), math.sin(YAW)
    transform = Transform(
        np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]),
        1.0,
        OFFSET,
        np.array([EAST + 12, NORTH + 13, -12.5]),
    )
    covariance = np.diag([4e-4, 9e-4, 1e-4, 2e-8, 3e-8, 1e-8, 0.0])
    covariance[:6, :6] += 1e-9
    rejected = verdict == "rejected"
    before = {
        "overlap": 0.95, "cells": 50_000, "height_median": 0.26, "height_nmad": 0.31,
        "height_rmse": 0.42, "image_similarity": 0.02,
    }  # fmt: skip
    after = {
        "overlap": 0.88, "cells": 48_000, "height_median": -0.03, "height_nmad": 0.011,
        "height_rmse": 0.02, "image_similarity": 0.91,
    }  # fmt: skip
    return Registration(
        verdict=verdict,  # type: ignore[arg-type]
        reason={
            "accepted": "sift and terrain agree within 0.05 m.",
            "review": "Only the image channel found a peak.",
            "rejected": "No offset stands out in any channel.",
        }[verdict],
        transform=None if rejected else transform,
        covariance=None if rejected else covariance,
        estimates=estimates(rng),
        hypotheses=(
            {
                "east": 1.3, "north": -0.7, "channels": ["image", "terrain"], "terrain_gap": 7.1,
                "image_gap": 9.2, "score": 0.93, "methods": ["sift", "terrain"],
            },
            {
                "east": -1.5, "north": 1.1, "channels": [], "terrain_gap": 1.2, "image_gap": 0.9,
                "score": 0.31, "methods": [],
            },
        ),
        before=before,
        after={} if rejected else after,
        reference=survey_entry("2018"),
        moving=survey_entry("2019"),
        settings=Settings().as_dict(),
        versions={"meshreg": "0.1.0", "numpy": np.__version__},
        seconds={"rasterize": 2.5, "sift": 1.2},
        notes=("Made by hand.",),
        registration_error=None
        if rejected
        else {"x": 0.02, "y": 0.03, "z": 0.01, "isotropic": 0.031, "at": [EAST, NORTH, -12.0]},
        evidence=evidence(verdict),
    )  # fmt: skip
