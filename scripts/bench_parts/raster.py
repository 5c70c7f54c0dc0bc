"""Rasterizing: a textured mesh against Open3D's rays with a NumPy texture look-up, and clouds.

Both sides get the same mesh and texture in memory and answer on the same grid: the peer with one
ray and one bilinear look-up a cell, meshreg with the mean of four or more. To compare heights
meshreg takes one sample at the cell's centre too (not timed).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import measure
import numpy as np

from meshreg.raster import rasterize
from meshreg.raster.mesh import draw_mesh
from meshreg.raster.placing import place
from meshreg.raster.spacing import measure_spacing
from meshreg.records import Grid, Mesh, PointCloud, Survey, Texture
from meshreg.refine.open3d_loading import load_open3d
from meshreg.settings import RasterSettings


def textured_reef(faces: int, page: int, size: float) -> Survey:
    """A sheet of `faces` irregular triangles, `size` m wide, under one page of `page`² texels."""
    count = int(np.sqrt(faces / 2)) + 1
    rng = np.random.default_rng(0)
    axis = np.linspace(0.0, size, count)
    x, y = np.meshgrid(axis, axis)
    step = size / (count - 1)
    x[1:-1, 1:-1] += rng.uniform(-0.35, 0.35, (count - 2, count - 2)) * step
    y[1:-1, 1:-1] += rng.uniform(-0.35, 0.35, (count - 2, count - 2)) * step
    z = 0.3 * np.sin(1.3 * x) * np.cos(0.9 * y) + 0.05 * np.sin(11 * x + 7 * y)
    z += rng.normal(0, 0.2 * step, z.shape)
    index = np.arange(count * count).reshape(count, count)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    corners = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], axis=1).reshape(-1, 3)
    image = rng.integers(0, 256, (page, page, 3), dtype=np.uint8)
    uv = np.stack([x.ravel() / size, y.ravel() / size], axis=1).astype(np.float32)
    mesh = Mesh(
        np.stack([x, y, z], axis=-1).reshape(-1, 3),
        corners.astype(np.int32),
        uv=uv[corners],
        face_texture=np.zeros(len(corners), np.int32),
        textures=(Texture("page", (page, page), lambda: image),),
    )
    return Survey("reef", mesh)


def by_open3d(mesh: Mesh, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Height and color of the first hit under each cell's centre: the peer's route."""
    open3d = load_open3d()
    scene = open3d.t.geometry.RaycastingScene()
    vertices = open3d.core.Tensor(mesh.vertices.astype(np.float32))
    scene.add_triangles(vertices, open3d.core.Tensor(mesh.faces.astype(np.uint32)))
    rows, cols = np.indices(grid.shape)
    east, north = grid.east_north(rows, cols)
    top = float(mesh.vertices[:, 2].max()) + 1.0
    rays = np.zeros((east.size, 6), np.float32)
    rays[:, 0], rays[:, 1], rays[:, 2], rays[:, 5] = east.ravel(), north.ravel(), top, -1.0
    hits = scene.cast_rays(open3d.core.Tensor(rays))
    distance = hits["t_hit"].numpy()
    hit = np.isfinite(distance)
    face, weights = hits["primitive_ids"].numpy()[hit], hits["primitive_uvs"].numpy()[hit]
    assert mesh.uv is not None
    corners = mesh.uv[face]
    weights = np.column_stack([1 - weights.sum(axis=1), weights])
    u, v = np.einsum("nk,nkc->cn", weights, corners)
    height = np.full(east.size, np.nan, np.float32)
    color = np.zeros((east.size, 3), np.uint8)
    height[hit] = top - distance[hit]
    color[hit] = looked_up(mesh.textures[0].load(), u, v)
    return height.reshape(grid.shape), color.reshape(*grid.shape, 3)


def looked_up(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear colors of a square page, as meshreg samples it."""
    size = image.shape[0]
    x = np.clip(u * size - 0.5, 0, size - 1).astype(np.float32)
    y = np.clip((1 - v) * size - 0.5, 0, size - 1).astype(np.float32)
    left, top = x.astype(np.int32), y.astype(np.int32)
    right, bottom = np.minimum(left + 1, size - 1), np.minimum(top + 1, size - 1)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    upper = image[top, left] * (1 - fx) + image[top, right] * fx
    lower = image[bottom, left] * (1 - fx) + image[bottom, right] * fx
    return (upper * (1 - fy) + lower * fy + 0.5).astype(np.uint8)


def row(work: str, tool: str, call: Callable[[], Any], times: int = 5) -> tuple[dict, Any]:
    """Least wall time [s] and highest rise of memory [MB] of a few runs, and the last result."""
    results: list[Any] = []

    def once() -> None:
        results[:] = [call()]

    found = {
        "work": work,
        "tool": tool,
        "peak MB": measure.here(once)["peak_mb"],
        "seconds": min(measure.timed(once) for _ in range(times)),
        "note": "",
    }
    return found, results[0]


def bench(
    faces: int = 4_000_000, page: int = 8192, cells: int = 4000, points: int = 20_000_000
) -> list[dict[str, Any]]:
    """Return the rows of the table."""
    size = 40.0
    survey = textured_reef(faces, page, size)
    mesh = survey.geometry
    assert isinstance(mesh, Mesh)
    grid = Grid(0.0, size, size / cells, (cells, cells))
    placing = place(survey, grid, None, np.zeros(1))
    plain = RasterSettings(fill_cells=0, remove_floaters=False, mask_flat_color=False)
    spacing = measure_spacing(survey)
    rasterize(survey, Grid(0.0, 4.0, 0.04, (100, 100)))  # compile
    work = f"{faces / 1e6:g} M triangles, {page}² texels, {cells * cells / 1e6:.0f} M cells"
    default, raster = row(work, "meshreg rasterize", partial(rasterize, survey, grid))
    default["note"] = f"{int(raster.samples.max())} samples a cell, floaters, masks, gaps"
    peer, (height, _) = row(
        work,
        "Open3D RaycastingScene + NumPy",
        partial(by_open3d, mesh, grid),
        times=3,
    )
    layers = draw_mesh(mesh, placing, grid, spacing, plain, times=1)
    off = np.abs(height - layers.height - placing.datum)
    off = off[np.isfinite(off)]
    peer["note"] = (
        f"1 ray a cell; {peer['seconds'] / default['seconds']:.1f} times as long; "
        f"{np.count_nonzero(off > 1e-4)} of {off.size:,} heights differ by over 1e-4 m"
    )
    return [default, peer, *bench_clouds(points, size)]


def bench_clouds(points: int, size: float) -> list[dict[str, Any]]:
    """Colored points, in lines as scanners and most exports have them, and in random order."""
    rng = np.random.default_rng(1)
    rows = []
    for order in ("random order", "in lines"):
        places = rng.uniform(0, size, (points, 2))
        if order == "in lines":
            places = places[np.argsort(np.floor(places[:, 1] / 0.05), kind="stable")]
        height = 0.3 * np.sin(1.3 * places[:, 0]) + rng.normal(0, 0.004, points)
        colors = rng.integers(0, 256, (points, 3), dtype=np.uint8)
        survey = Survey("cloud", PointCloud(np.column_stack([places, height]), colors))
        grid = Grid(0.0, size, size / 2000, (2000, 2000))
        rasterize(survey, Grid(0, 1, 0.5, (2, 2)))
        work = f"{points / 1e6:.0f} M points to {grid.shape[0] ** 2 / 1e6:.0f} M cells, {order}"
        found, _ = row(work, "meshreg rasterize", partial(rasterize, survey, grid))
        found["note"] = f"{points / found['seconds'] / 1e6:.0f} M points/s"
        rows.append(found)
    return rows


if __name__ == "__main__":
    for line in bench():
        print(*line.values(), sep=" | ")
