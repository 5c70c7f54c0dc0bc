"""Rasters of a pair straight from the generator's functions, and a store of places' rasters."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.rasters import RasterPair, make_rasters
from meshreg.benchmark.plan import DEM_CELL, ORTHO_CELL, SIFT_CELL, Job, recipe_of
from meshreg.heading import Turn, turning
from meshreg.io.files.atomic import atomic_file
from meshreg.raster import rasterize
from meshreg.raster.grid import coarsened, survey_grid
from meshreg.records import Grid, Maps, Survey, SurveyRaster, Transform
from meshreg.settings import RasterSettings

Rasters = dict[str, SurveyRaster]  # "dem", "ortho", "sift"
Pairs = dict[str, tuple[SurveyRaster, SurveyRaster]]


def make(job: Job) -> tuple[Pairs, RasterPair]:
    """Make a job's pair; the orthomosaic is the exact mean of the finer one that SIFT looks at."""
    made = make_rasters(
        recipe_of(job),
        job.seed,
        job.size,
        dem_cell=DEM_CELL,
        ortho_cell=SIFT_CELL,
        step=SIFT_CELL,
    )
    reference = _three(made.reference_dem, made.reference_ortho)
    moving = _three(made.moving_dem, made.moving_ortho)
    return {name: (reference[name], moving[name]) for name in reference}, made


def _three(dem: SurveyRaster, fine: SurveyRaster) -> Rasters:
    return {"dem": dem, "ortho": coarsened(fine, round(ORTHO_CELL / SIFT_CELL)), "sift": fine}


def save_place(pairs: Pairs, key: str, path: Path) -> None:
    """Keep both surveys' rasters of a place (arrays only; the mosaics without heights)."""
    arrays: dict[str, Any] = {"key": np.array(key)}
    for which, side in (("reference", 0), ("moving", 1)):
        for name in ("dem", "sift"):
            raster = pairs[name][side]
            place = [raster.grid.west, raster.grid.north, raster.grid.cell, raster.datum]
            arrays[f"{which}_{name}_place"] = np.array(place, np.float64)
            arrays[f"{which}_{name}_color"] = raster.color
            arrays[f"{which}_{name}_color_valid"] = np.packbits(raster.color_valid)
            arrays[f"{which}_{name}_samples"] = raster.samples
            if name == "dem":
                arrays[f"{which}_dem_height"] = raster.height
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def place_key(path: Path) -> str:
    """Return the key under which a place was kept; empty where there is none or it is broken."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            return str(stored["key"])
    except (OSError, ValueError, KeyError, EOFError):
        return ""
    except Exception as error:  # zipfile's and zlib's own, which are no OSError
        if type(error).__module__.split(".")[0] in ("zipfile", "zlib"):
            return ""
        raise


@lru_cache(maxsize=2 * 64)
def load_place(path: Path, which: str) -> Rasters:
    """Return the rasters of one survey ("reference" or "moving") of a place."""
    with np.load(path, allow_pickle=False) as stored:
        dem = _raster(stored, f"{which}_dem")
        fine = _raster(stored, f"{which}_sift")
    return _three(dem, fine)


def _raster(stored: Any, prefix: str) -> SurveyRaster:
    west, north, cell, datum = (float(v) for v in stored[f"{prefix}_place"])
    color = stored[f"{prefix}_color"]
    shape = color.shape[:2]
    count = shape[0] * shape[1]
    color_valid = np.unpackbits(stored[f"{prefix}_color_valid"], count=count)
    seen = color_valid.reshape(shape).astype(bool)
    has_height = f"{prefix}_height" in stored
    height = stored[f"{prefix}_height"] if has_height else np.full(shape, np.nan, np.float32)
    return SurveyRaster(
        grid=Grid(west, north, cell, shape, None),
        height=height,
        color=color,
        valid=np.isfinite(height),
        color_valid=seen,
        samples=stored[f"{prefix}_samples"],
        datum=datum,
    )


def turned(pairs: Pairs, turn: Turn) -> tuple[Pairs, Transform]:
    """Resample the moving survey's rasters, turned about its centre (`meshreg.pipeline.Turned`)."""
    dem = pairs["dem"][1]
    motion = turning(turn, np.array([*_middle(dem.grid), dem.datum]))
    # the survey has been cleaned already: what is known stays known
    plain = RasterSettings(fill_cells=0, remove_floaters=False, mask_flat_color=False)
    done = {}
    for name, (still, raster) in pairs.items():
        grid, seen = raster.grid, raster.color_valid
        height = (raster.height + raster.datum).astype(np.float32)
        survey = Survey(name, Maps(height, grid, raster.color, seen, grid), crs=grid.crs)
        whole = survey_grid(survey, grid.cell, dem.grid.cell, transform=motion)
        done[name] = (still, rasterize(survey, whole, plain, transform=motion))
    return done, motion


def rehomed(reference: Rasters, moving: Rasters) -> Pairs:
    """Give the moving survey the reference's coordinates and depth: only the ground differs.

    It is moved by whole DEM cells, which are whole cells of the finer rasters too.
    """
    a, b = reference["dem"], moving["dem"]
    shift = [
        round(step / DEM_CELL) * DEM_CELL
        for step in np.subtract(_middle(a.grid), _middle(b.grid)).tolist()
    ]
    up = _depth(a) - _depth(b)
    placed = {
        name: dataclasses.replace(
            raster, grid=_moved(raster.grid, shift[0], shift[1]), datum=raster.datum + up
        )
        for name, raster in moving.items()
    }
    return {name: (reference[name], placed[name]) for name in reference}


def _moved(grid: Grid, east: float, north: float) -> Grid:
    return dataclasses.replace(
        grid, west=round(grid.west + east, 6), north=round(grid.north + north, 6)
    )


def _middle(grid: Grid) -> tuple[float, float]:
    west, south, east, north = grid.bounds
    return (west + east) / 2, (south + north) / 2


def _depth(dem: SurveyRaster) -> float:
    return float(np.median(dem.height[dem.valid])) + dem.datum
