"""OBJ: reading a textured mesh of 12 MB, best of 15 after a first read, each reader by itself.

Peak is how far the process's memory rose above where it stood; the texture page is not decoded.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import measure
import numpy as np

ROWS, COLS = 320, 316  # 101,120 vertices and 200,970 faces


def make(folder: Path, rows: int, cols: int, name: str) -> Path:
    """Write a rough sheet as photogrammetry exports it: v, vt and f lines, one texture page."""
    from PIL import Image

    rng = np.random.default_rng(0)
    north, east = np.divmod(np.arange(rows * cols), cols)
    up = rng.normal(size=rows * cols).cumsum() / 100
    first = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).reshape(-1) + 1
    corners = np.stack([first, first + 1, first + cols, first + 1, first + cols + 1, first + cols])
    path = folder / f"{name}.obj"
    with open(path, "w", encoding="ascii") as file:
        file.write(f"mtllib {name}.mtl\nusemtl page\n")
        points = np.stack([300 + east * 1.0025, 500 + north * 1.0025, up], axis=1)
        np.savetxt(file, points, "v %.3f %.3f %.3f")
        np.savetxt(file, np.stack([east / cols, north / rows], axis=1), "vt %.6f %.6f")
        faces = np.repeat(corners.T.reshape(-1, 3), 2, axis=1)
        np.savetxt(file, faces, "f %d/%d %d/%d %d/%d")
    Image.new("RGB", (64, 64)).save(folder / f"{name}.png")
    (folder / f"{name}.mtl").write_text(f"newmtl page\nmap_Kd {name}.png\n")
    return path


def _best(read: Callable[[str], Any], small: str, path: str) -> dict[str, Any]:
    """Read once to compile and import, once for the memory, then report the fastest of 15."""
    read(small)
    peak = measure.here(read, path)["peak_mb"]
    return {"seconds": min(measure.timed(read, path) for _ in range(15)), "peak_mb": peak}


def meshreg(small: str, path: str) -> dict[str, Any]:
    from meshreg.io.obj.read import read
    from meshreg.io.options import ReadOptions

    return _best(lambda name: read(Path(name), ReadOptions()), small, path)


def tinyobjloader(small: str, path: str) -> dict[str, Any]:
    import tinyobjloader as tiny

    def read(name: str) -> Any:
        reader = tiny.ObjReader()
        if not reader.ParseFromFile(name):
            raise RuntimeError(reader.Error())
        return reader

    return _best(read, small, path)


def trimesh(small: str, path: str) -> dict[str, Any]:
    import trimesh as peer

    return _best(lambda name: peer.load(name, process=False), small, path)


def open3d(small: str, path: str) -> dict[str, Any]:
    from meshreg.refine.open3d_loading import load_open3d

    return _best(load_open3d().io.read_triangle_mesh, small, path)


def bench() -> list[dict[str, Any]]:
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        small = make(folder, 20, 20, "small")
        path = make(folder, ROWS, COLS, "large")
        size = path.stat().st_size / 1e6
        for name in ("tinyobjloader", "meshreg", "trimesh", "open3d"):
            try:
                result = measure.apart("obj", name, str(small), str(path))
            except RuntimeError as error:
                rows.append({"reader": name, "failed": str(error).splitlines()[-1]})
                continue
            row = {
                "reader": name,
                "file MB": size,
                "seconds": result["seconds"],
                "MB/s": size / result["seconds"],
                "peak MB": result["peak_mb"],
                "peak / file": result["peak_mb"] / size,
            }
            first = rows[0].get("seconds", float("nan")) if rows else row["seconds"]
            rows.append({**row, "times tinyobjloader": first / row["seconds"]})
    return rows
