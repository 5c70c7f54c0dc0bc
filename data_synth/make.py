"""Pairs of surveys with known truth: in memory, or as files that reconstruction software writes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_synth import cameras as cams
from data_synth.mesh import cloud, colored, make_nodes, make_surface, textured
from data_synth.rasters import RasterPair, make_rasters
from data_synth.recipe import Recipe
from data_synth.regions import describe_change
from data_synth.scene import Scene, Take, View, make_scene
from data_synth.seeing import Lattice
from data_synth.truth import make_truth
from meshreg.errors import UsageError
from meshreg.io.files.atomic import as_output_error
from meshreg.io.result.folders import atomic_folder
from meshreg.records import Survey

Progress = Callable[[str, float], None]
FORMATS = {
    "obj": ".obj",  # several texture pages, local shift
    "ply": ".ply",  # vertex colors
    "ply-cloud": ".ply",
    "laz": ".laz",
    "glb": ".glb",
    "colmap": "",  # text model in a frame of its own, with camera positions
    "images": "",  # photographs with navigation
}


@dataclass(frozen=True, eq=False)
class Pair:
    """Two surveys and the truth about them (the contents of `truth.json`)."""

    reference: Survey
    moving: Survey
    truth: dict[str, Any]
    scene: Scene


def make_pair(
    recipe: Recipe,
    seed: int = 0,
    size: float | None = None,
    format: str = "obj",
    progress: Progress | None = None,
) -> Pair:
    """Make a pair in memory.

    Parameters
    ----------
    recipe : Recipe
    seed : int
        The same recipe, seed and size give the same pair to the last bit.
    size : float, optional
        Side of the patch [m]; by default the recipe's.
    format : str
        "obj" or "glb" (textured mesh), "ply" (mesh with vertex colors), "ply-cloud", "laz".
    progress : callable, optional
        Called with the stage's name and the fraction done of it.

    Raises
    ------
    UsageError
        An unknown format, or one that has no form in memory ("colmap", "images").
    """
    if format not in FORMATS or not FORMATS[format]:
        raise UsageError(
            f"A pair in memory cannot be {format!r}.",
            remedy=f"Use one of {', '.join(name for name, end in FORMATS.items() if end)}.",
        )
    tell = progress or _silent
    scene = make_scene(recipe, seed, size)
    surveys = [_survey(take, scene, format, tell) for take in (scene.reference, scene.moving)]
    return Pair(surveys[0], surveys[1], _whole_truth(scene, tell), scene)


def write_pair(
    recipe: Recipe,
    folder: str | Path,
    seed: int = 0,
    size: float | None = None,
    format: str | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write `reference.*`, `moving.*` and `truth.json` to a folder, whole or not at all.

    Returns
    -------
    tuple of Path
        Every file written. A COLMAP model or a set of photographs is a folder `reference/` with
        its `positions.csv`.

    Raises
    ------
    UsageError
        An unknown format, or the folder exists and `overwrite` is not set, or it holds anything
        but a pair that was made before.
    OutputError
        Something could not be written; what was there before is intact.
    """
    folder, kind = Path(folder), format or recipe.output.format
    if kind not in FORMATS:
        raise UsageError(f"Unknown format {kind!r}.", remedy=f"Use one of {', '.join(FORMATS)}.")
    with as_output_error(folder):
        folder.absolute().parent.mkdir(parents=True, exist_ok=True)
    with atomic_folder(folder, overwrite, ("truth.json",), "synth") as work:
        files = _write_all(recipe, work, seed, size, kind, progress or _silent)
    return tuple(folder / file.relative_to(work) for file in files)


def _silent(stage: str, fraction: float) -> None:
    del stage, fraction


def _write_all(
    recipe: Recipe, folder: Path, seed: int, size: float | None, kind: str, tell: Progress
) -> list[Path]:
    from meshreg.io import write_survey

    if kind == "images":  # real software will bend them; only the navigation is off
        still = replace(recipe.sfm, warp=0.0, warp_up=0.0, doming=0.0, scale_drift=0.0, scale=0.0)
        recipe = replace(recipe, sfm=still)
    scene = make_scene(recipe, seed, size)
    files: list[Path] = []
    for take in (scene.reference, scene.moving):
        if kind == "images":
            place = folder / take.name
            place.mkdir()
            cameras = cams.lawn_mower(take, recipe.output.tracks, recipe.output.images)
            files += cams.photographs(
                take, cameras, place, progress=lambda f, n=take.name: tell(f"{n} images", f)
            )
            files.append(cams.write_navigation(take, cameras, place / "positions.csv"))
        elif kind == "colmap":
            view = _view(take, max(scene.recipe.output.texture, 0.01), tell)
            files += cams.colmap_model(take, view, folder / take.name)
        else:
            survey = _survey(take, scene, kind, tell)
            tell(f"{take.name} write", 0.0)
            files += write_survey(survey, folder / f"{take.name}{FORMATS[kind]}")
            tell(f"{take.name} write", 1.0)
    truth = _whole_truth(scene, tell)
    truth["format"] = kind
    path = folder / "truth.json"
    parts = (f"{json.dumps(key)}: {json.dumps(truth[key], allow_nan=False)}" for key in truth)
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")
    return [*files, path]


def _whole_truth(scene: Scene, tell: Progress) -> dict[str, Any]:
    tell("truth", 0.0)
    truth = make_truth(scene)
    truth["change"] = describe_change(scene)
    truth["expect"] = {
        "verdicts": list(scene.recipe.expect.verdicts),
        "max_error": scene.recipe.expect.max_error,
        "settings": dict(scene.recipe.settings),
    }
    tell("truth", 1.0)
    return truth


def _view(take: Take, step: float, tell: Progress) -> View:
    """Render a take over its footprint and a margin."""
    west, south, east, north = take.footprint
    margin = 4 * take.sfm.mesh_spacing + 2 * step
    shape = (
        int(np.ceil((north - south + 2 * margin) / step)),
        int(np.ceil((east - west + 2 * margin) / step)),
    )
    lattice = Lattice(west - margin + step / 2, north + margin - step / 2, step, shape)
    stage = f"{take.name} seafloor"
    tell(stage, 0.0)
    return take.sample(lattice, lambda fraction: tell(stage, fraction))


def _survey(take: Take, scene: Scene, kind: str, tell: Progress) -> Survey:
    output, place = scene.recipe.output, scene.recipe.place
    view = _view(take, output.texture, tell)
    tell(f"{take.name} geometry", 0.0)
    # a local frame near the patch, as software that calculates in float32 asks for
    origin = np.array([100.0, 100.0, 0.0]) * np.floor(take.distortion.start / [100.0, 100.0, 1.0])
    origin += 0.0  # so that no -0.0 is left of 0 times a depth
    geometry: Any
    if kind in ("ply-cloud", "laz"):
        geometry = cloud(take, view, output.point_spacing, origin)
    else:
        surface = make_surface(take, make_nodes(take, view))
        if kind == "ply":
            geometry = colored(take, view, surface, origin)
        else:
            geometry = textured(take, view, surface, output.pages, origin)
    tell(f"{take.name} geometry", 1.0)
    return Survey(
        name=take.name,
        geometry=geometry,
        origin=origin,
        crs=place.crs,
        date=place.date if take.name == "reference" else place.date_moving,
    )


__all__ = [
    "FORMATS",
    "Pair",
    "RasterPair",
    "make_pair",
    "make_rasters",
    "write_pair",
]
