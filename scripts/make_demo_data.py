"""Cut the pair of surveys that `meshreg demo` ships out of the beach meshes.

    python scripts/make_demo_data.py FOLDER

FOLDER holds 20180601.obj and 20190205_shifted.obj with their textures (npucino/sandpyper, MIT).
Both meshes are regular lattices with holes; a window of each is kept, coarsened to every STEP-th
lattice point, and written as a small textured OBJ with the part of the texture that it uses.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
from PIL import Image

TARGET = Path(__file__).parent.parent / "meshreg" / "demo_data"
MOVED = np.array([13.4, -8.7])  # the later survey was moved by minus this, and by -1.25 m up
# West, south, east, north on the ground [m]. They differ, so that the cut edges give nothing away.
EARLIER = (457.0, 362.0, 543.0, 448.0)
LATER = (448.0, 374.0, 535.0, 460.0)
STEP = 1


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and texture coordinates (V, 2), which go together in these files."""
    rows: dict[str, list[list[str]]] = {"v": [], "vt": []}
    for line in path.read_text().splitlines():
        word, *rest = line.split()
        if word in rows:
            rows[word].append(rest)
    return np.array(rows["v"], float), np.array(rows["vt"], float)


def lattice(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Whole lattice numbers of coordinates, and the lattice's step."""
    step = float(np.median(np.diff(np.unique(values.round(3)))))
    return np.rint((values - values.min()) / step).astype(int), step


def cut(source: Path, texture: Path, target: Path, window: tuple[float, ...]) -> None:
    points, uv = read(source)
    col, _ = lattice(points[:, 0])
    row, _ = lattice(points[:, 1])
    west, south, east, north = window
    inside = (points[:, 0] >= west) & (points[:, 0] <= east)
    inside &= (points[:, 1] >= south) & (points[:, 1] <= north)
    kept = np.flatnonzero(inside & (col % STEP == 0) & (row % STEP == 0))
    number = {(col[k] // STEP, row[k] // STEP): n + 1 for n, k in enumerate(kept)}
    faces = []
    for (i, j), a in number.items():
        b, c, d = (number.get(place) for place in ((i + 1, j), (i + 1, j + 1), (i, j + 1)))
        faces += [(a, b, c)] if b and c else []
        faces += [(a, c, d)] if c and d else []
    image = Image.open(texture)
    u, v = uv[kept].T
    # The part of the page that is used, widened to whole pixels; v runs upward.
    left, right = int(u.min() * image.width), int(np.ceil(u.max() * image.width))
    top, bottom = int((1 - v.max()) * image.height), int(np.ceil((1 - v.min()) * image.height))
    u = (u * image.width - left) / (right - left)
    v = (v * image.height - (image.height - bottom)) / (bottom - top)
    name = target.stem
    lines = [f"mtllib {name}.mtl", "usemtl ortho"]
    lines += [f"v {x:.2f} {y:.2f} {z:.2f}" for x, y, z in points[kept]]
    lines += [f"vt {a:.4f} {b:.4f}" for a, b in zip(u, v, strict=True)]
    lines += ["f " + " ".join(f"{k}/{k}" for k in face) for face in faces]
    target.write_text("\n".join(lines) + "\n")
    target.with_suffix(".mtl").write_text(f"newmtl ortho\nKd 1 1 1\nmap_Kd {name}.jpg\n")
    image.crop((left, top, right, bottom)).save(target.with_suffix(".jpg"), quality=92)
    print(f"{target.name}: {len(kept)} vertices, {len(faces)} faces, {target.stat().st_size} bytes")


def main(folder: Path) -> None:
    TARGET.mkdir(exist_ok=True)
    east, north = MOVED
    later = (LATER[0] - east, LATER[1] - north, LATER[2] - east, LATER[3] - north)
    cut(folder / "20180601.obj", folder / "20180601.jpg", TARGET / "beach_2018.obj", EARLIER)
    name = "20190205_shifted"
    cut(folder / f"{name}.obj", folder / f"{name}.jpg", TARGET / "beach_2019.obj", later)
    shutil.copyfile(folder / "LICENSE", TARGET / "LICENSE")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
