"""The same ground as maps, as a gridded cloud and as a mesh: one cell and one answer, wherever."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
import rasterio
import trimesh
from seafloor import Seafloor

from meshreg import read_survey, register_pair
from meshreg.raster import choose_cells
from meshreg.settings import Settings

CELL = 1.0  # as of a beach: its maps have this cell, its cloud a point in the middle of each
HALF = 60.0
OFFSET = np.array([3.4, -2.3])
SHIFTS = ((0.0, 0.0), (0.31, 0.77), (-4.5, 2.25))
KINDS = ("maps", "cloud", "mesh")


@functools.cache
def ground(later: bool):
    """Heights and colors at cell centres, of bumps twenty times as large as those of a reef."""
    floor = Seafloor.random(41, size=8.0)
    if later:
        floor = floor.changed(42, 0.1).moved(*(-OFFSET / 20))
    raster = floor.raster(CELL / 20, HALF / 20, noise=0.002, seed=int(later))
    return 20 * raster.height, raster.color


def write(folder: Path, kind: str, later: bool, shift: tuple[float, float]) -> str:
    """Write one date as `kind`, delivered `shift` further; return its path."""
    height, color = ground(later)
    n = len(height)
    name = "later" if later else "first"
    west, north = -HALF + shift[0], HALF + shift[1]
    if kind == "maps":
        place = rasterio.Affine(CELL, 0, west, 0, -CELL, north)
        common = {"driver": "GTiff", "width": n, "height": n, "transform": place}
        dem, ortho = folder / f"{name}_dem.tif", folder / f"{name}_ortho.tif"
        with rasterio.open(dem, "w", count=1, dtype="float32", **common) as file:
            file.write(height.astype(np.float32), 1)
        with rasterio.open(ortho, "w", count=3, dtype="uint8", **common) as file:
            file.write(np.moveaxis(color, -1, 0))
        return f"{dem},{ortho}"
    row, col = np.mgrid[0:n, 0:n]
    east, up = west + (col + 0.5) * CELL, height
    points = np.stack([east, north - (row + 0.5) * CELL, up], -1).reshape(-1, 3)
    path = folder / f"{name}_{kind}.ply"
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (
        part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
    )
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    colors = np.column_stack([color.reshape(-1, 3), np.full(n * n, 255, np.uint8)])
    if kind == "cloud":
        trimesh.PointCloud(points, colors).export(path)
    else:
        trimesh.Trimesh(points, faces, vertex_colors=colors, process=False).export(path)
    return str(path)


@pytest.mark.parametrize("shift", SHIFTS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_cell_and_the_answer_are_those_of_the_data(tmp_path, kind, shift):
    reference = read_survey(write(tmp_path, kind, False, (0.0, 0.0)))
    moving = read_survey(write(tmp_path, kind, True, shift))
    assert choose_cells(reference, moving).dem == CELL
    found = register_pair(reference, moving, Settings().changed({"search.radius": 15.0}))
    assert found.verdict == "accepted", found.reason
    middle = np.array([*(-OFFSET + shift), 0.0])  # of the common ground, as delivered
    miss = found.transform.apply(middle[None])[0, :2] - (middle[:2] + OFFSET - shift)
    assert np.abs(miss).max() < 0.2 * CELL
    sigma = np.sqrt(np.diag(found.covariance)[:2])
    assert (np.abs(miss) < 4 * sigma).all()
