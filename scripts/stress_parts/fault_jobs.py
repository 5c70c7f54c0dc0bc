"""What is disturbed: a tiny pair of surveys, and every command that writes something for a user."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent.parent
FORMATS = ("obj", "ply", "glb", "laz", "xyz", "e57", "stl", "off")
RADIUS = "0.5"


@dataclass(frozen=True)
class Job:
    """One command.

    Attributes
    ----------
    name : str
    arguments : tuple of str
        Of `meshreg`; {0} is the folder of the inputs, {1} the one that is written into.
    out : str
        What is written, in {1}: a folder, or a file.
    before : callable or None
        Puts what is there before into {1}, given both folders; None for nothing.
    """

    name: str
    arguments: tuple[str, ...]
    out: str = "out"
    before: Callable[[Path, Path], None] | None = None

    def command(self, inputs: Path, there: Path) -> list[str]:
        """The arguments with the folders' names in them."""
        return [text.format(inputs, there) for text in self.arguments]


def make_inputs(folder: Path) -> None:
    """Write the pair: bumps of sand and rock, 4 m wide, the second survey moved by 0.2 m."""
    sys.path.insert(0, str(ROOT / "tests" / "helpers"))
    from seafloor import Seafloor

    import meshreg

    floor = Seafloor.random(11, size=6.0)
    later = floor.changed(12, 0.1).moved(-0.2, 0.1)
    for name, ground, seed in (("reference", floor, 1), ("moving", later, 2)):
        survey = sheet(ground, seed, name)
        for kind in FORMATS if name == "moving" else ("obj",):
            meshreg.write_survey(_as_cloud(survey, kind), folder / f"{name}.{kind}")
        _write_maps(ground, seed, folder, name)
    lines = ["id,name,reference_east,reference_north,moving_east,moving_north,crs"]
    for i, (east, north) in enumerate(np.random.default_rng(0).uniform(-1.5, 1.5, (12, 2))):
        lines.append(f"{i + 1},t{i},{east:.4f},{north:.4f},{east - 0.2:.4f},{north + 0.1:.4f},")
    (folder / "ties.csv").write_text("\n".join(lines) + "\n")


def sheet(ground: Any, seed: int, name: str) -> Any:
    from meshreg.records import Mesh, Survey, Texture

    raster = ground.raster(0.05, 2.0, noise=0.002, seed=seed)
    page = ground.raster(0.02, 2.0, noise=0.0, seed=seed).color
    n = raster.grid.shape[0]
    row, col = np.mgrid[0:n, 0:n]
    east, north = raster.grid.east_north(row, col)
    points = np.stack([east, north, raster.height], axis=-1).reshape(-1, 3)
    uv = np.stack([(col + 0.5) / n, 1 - (row + 0.5) / n], axis=-1).reshape(-1, 2)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    mesh = Mesh(
        points,
        faces.astype(np.int32),
        uv=uv[faces].astype(np.float32),
        face_texture=np.zeros(len(faces), np.int32),
        textures=(Texture("page.png", page.shape[:2], lambda: page),),
    )
    return Survey(name, mesh)


def _as_cloud(survey: Any, kind: str) -> Any:
    """The survey's points alone where the format has no faces."""
    from meshreg.records import PointCloud

    if kind not in ("laz", "xyz", "e57"):
        return survey
    colors = np.full((len(survey.geometry.vertices), 3), 128, np.uint8)
    return replace(survey, geometry=PointCloud(survey.geometry.vertices, colors))


def _write_maps(ground: Any, seed: int, folder: Path, name: str) -> None:
    import rasterio

    raster = ground.raster(0.05, 2.0, noise=0.002, seed=seed)
    n = raster.grid.shape[0]
    place = rasterio.transform.from_origin(raster.grid.west, raster.grid.north, 0.05, 0.05)
    common = {"driver": "GTiff", "width": n, "height": n, "transform": place}
    with rasterio.open(folder / f"{name}_dem.tif", "w", count=1, dtype="float32", **common) as file:
        file.write(raster.height.astype(np.float32), 1)
    with rasterio.open(folder / f"{name}_ortho.tif", "w", count=3, dtype="uint8", **common) as file:
        file.write(np.moveaxis(raster.color, -1, 0))


def registered(inputs: Path, there: Path) -> None:
    """An older result, of another seed, so that old and new are told apart."""
    shutil.copytree(inputs / "older", there / "out")


def _older(name: str) -> Callable[[Path, Path], None]:
    return lambda inputs, there: shutil.copytree(inputs / f"older_{name}", there / "out")  # type: ignore[return-value]


def _register(*surveys: str) -> tuple[str, ...]:
    return ("register", *surveys, "-o", "{1}/out", "--search-radius", RADIUS)


PAIR = "{0}/reference.obj", "{0}/moving.obj"
MAPS = tuple(f"{{0}}/{name}_dem.tif,{{0}}/{name}_ortho.tif" for name in ("reference", "moving"))
# What makes the older results, in the folder of the inputs.
OLDER = {
    "older": ("register", *PAIR, "-o", "{0}/older", "--search-radius", RADIUS, "--seed", "7"),
    "older_maps": ("rasterize", "{0}/reference.obj", "-o", "{0}/older_maps", "--dem-cell", "0.1"),
    "older_moved": ("apply", "{0}/older", "{0}/moving.xyz", "-o", "{0}/older_moved"),
}
JOBS = (
    Job("register", _register(*PAIR)),
    Job("register over", (*_register(*PAIR), "--overwrite"), before=registered),
    Job("register maps over", (*_register(*MAPS), "--overwrite"), before=registered),
    Job("rasterize", ("rasterize", "{0}/moving.obj", "-o", "{1}/out")),
    Job(
        "rasterize over",
        ("rasterize", "{0}/moving.obj", "-o", "{1}/out", "--overwrite"),
        before=_older("maps"),
    ),
    *(
        Job(f"apply {kind}", ("apply", "{0}/older", f"{{0}}/moving.{kind}", "-o", "{1}/out"))
        for kind in FORMATS
    ),
    Job("apply maps", ("apply", "{0}/older", MAPS[1], "-o", "{1}/out")),
    Job(
        "apply over",
        ("apply", "{0}/older", "{0}/moving.ply", "-o", "{1}/out", "--overwrite"),
        before=_older("moved"),
    ),
    Job(
        "selftest",
        ("selftest", *PAIR, "-o", "{1}/out", "--shifts", "1", "--set", f"search.radius={RADIUS}"),
    ),
    Job("report", ("report", "{1}/out"), before=registered),
    Job("validate", ("validate", "{1}/out", "{0}/ties.csv"), before=registered),
)
