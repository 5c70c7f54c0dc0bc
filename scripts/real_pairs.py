"""Known motions put into real surveys: a beach's dates turned, scaled and shifted, in any format.

A DEM with its orthomosaic is moved exactly, by its geotransform alone, and can be laid out as a
cloud with a point in each cell or as a mesh through them. The functions are for other scripts; the
command registers pairs of dates so displaced and tells what was found of them::

    scripts/real_pairs.py --yaw 3 -5 8 --scale 0.97 1.02 --pairs 8
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

DATA = Path(__file__).parents[2] / "shared" / "data"
NODATA = -10000.0


def dates(data: Path = DATA) -> dict[str, tuple[Path, Path]]:
    """DEM and orthomosaic of each of the beach's dates, in their order."""
    found = {}
    for dem in sorted([*data.glob("beach/*_dsm.tif"), *data.glob("beach_dates/*_dsm.tif")]):
        found[dem.name[:8]] = dem, dem.with_name(dem.name.replace("_dsm", "_ortho"))
    return dict(sorted(found.items()))


def motion(
    shift: tuple[float, float], yaw: float, scale: float, pivot: tuple[float, float]
) -> Affine:
    """Return what moves a survey: turned by `yaw` degrees and scaled about `pivot`, shifted."""
    there = Affine.translation(pivot[0] + shift[0], pivot[1] + shift[1])
    return (
        there
        * Affine.rotation(yaw)
        * Affine.scale(scale)
        * Affine.translation(-pivot[0], -pivot[1])
    )


def pivot_of(dem: Path) -> tuple[float, float]:
    """Middle of the cells that have a height: east, north [m]."""
    with rasterio.open(dem) as source:
        rows, cols = np.nonzero(_known(source.read(1)))
        east, north = source.transform * (cols.mean() + 0.5, rows.mean() + 0.5)
    return float(east), float(north)


def displaced_maps(
    pair: tuple[Path, Path],
    folder: Path,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw: float = 0.0,
    scale: float = 1.0,
    *,
    sampled: bool = False,
) -> tuple[Path, Path]:
    """Write both maps displaced; heights are scaled too, and lifted by the shift's last number.

    Without `sampled` the geotransform alone is changed, which is exact. With it the maps are
    sampled anew on north-up grids of the same cells, as a survey would be exported.
    """
    matrix = motion(shift[:2], yaw, scale, pivot_of(pair[0]))
    written = []
    for path in pair:
        with rasterio.open(path) as source:
            values, profile = source.read(), source.profile
            bands = source.count
        transform = matrix * profile["transform"]
        if bands == 1:
            known = _known(values)
            values = np.where(known, values * scale + shift[2], NODATA).astype(np.float32)
        if sampled:
            values, transform = _north_up(values, transform, profile)
        profile.update(transform=transform, width=values.shape[2], height=values.shape[1])
        written.append(folder / path.name)
        with rasterio.open(written[-1], "w", **profile) as target:
            target.write(values)
    return written[0], written[1]


def displaced_points(
    pair: tuple[Path, Path],
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw: float = 0.0,
    scale: float = 1.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells of the maps as points that are displaced exactly.

    Returns
    -------
    points : (N, 3) float64
        East, north, up [m].
    colors : (N, 3) uint8
    index : (H, W) int
        Number of each cell's point; -1 where there is none.
    """
    matrix = motion(shift[:2], yaw, scale, pivot_of(pair[0]))
    with rasterio.open(pair[0]) as source:
        height, transform = source.read(1), source.transform
    with rasterio.open(pair[1]) as source:
        picture, there = source.read(), source.transform
    known = _known(height)
    rows, cols = np.nonzero(known)
    centre = transform * (cols + 0.5, rows + 0.5)
    col, row = (np.floor(v).astype(int) for v in ~there * centre)
    inside = (row >= 0) & (row < picture.shape[1]) & (col >= 0) & (col < picture.shape[2])
    colors = np.zeros((len(rows), 3), np.uint8)
    colors[inside] = picture[:3, row[inside], col[inside]].T
    east, north = matrix * centre
    points = np.stack([east, north, height[known].astype(float) * scale + shift[2]], axis=1)
    index = np.full(height.shape, -1)
    index[known] = np.arange(len(rows))
    return points, colors, index


def write_xyz(path: Path, points: np.ndarray, colors: np.ndarray) -> Path:
    """Write a cloud as text: x y z r g b."""
    np.savetxt(path, np.hstack([points, colors]), fmt="%.4f %.4f %.4f %d %d %d")
    return path


def write_obj(path: Path, points: np.ndarray, colors: np.ndarray, index: np.ndarray) -> Path:
    """Write the mesh through a grid of points, with colors at its vertices."""
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    upper = np.stack([a, c, b], -1).reshape(-1, 3)
    lower = np.stack([b, c, d], -1).reshape(-1, 3)
    faces = np.concatenate([upper, lower])
    faces = faces[(faces >= 0).all(axis=1)] + 1
    with path.open("w") as stream:
        np.savetxt(stream, np.hstack([points, colors / 255]), fmt="v %.4f %.4f %.4f %.4f %.4f %.4f")
        np.savetxt(stream, faces, fmt="f %d %d %d")
    return path


def _known(height: np.ndarray) -> np.ndarray:
    return np.isfinite(height) & (height > 0.5 * NODATA)


def _north_up(
    values: np.ndarray, transform: Affine, profile: dict[str, object]
) -> tuple[np.ndarray, Affine]:
    from rasterio.warp import Resampling, reproject

    count, rows, cols = values.shape
    cell = math.hypot(transform.a, transform.d)
    corners = [transform * corner for corner in itertools.product((0, cols), (0, rows))]
    east, north = zip(*corners, strict=True)
    where = Affine(cell, 0, min(east), 0, -cell, max(north))
    shape = math.ceil(np.ptp(north) / cell), math.ceil(np.ptp(east) / cell)
    nodata = NODATA if count == 1 else 0
    made = np.full((count, *shape), nodata, values.dtype)
    options = {"src_crs": profile["crs"], "dst_crs": profile["crs"], "src_nodata": nodata}
    reproject(
        values,
        made,
        src_transform=transform,
        dst_transform=where,
        dst_nodata=nodata,
        resampling=Resampling.bilinear,
        **options,
    )
    return made, where


def _cases(arguments: argparse.Namespace) -> Iterator[tuple[str, str, float, float]]:
    names = list(dates(arguments.data))
    pairs = list(itertools.combinations(names, 2))
    step = max(1, len(pairs) // arguments.pairs)
    for first, second in pairs[::step][: arguments.pairs]:
        for yaw in arguments.yaw:
            yield first, second, yaw, 1.0
        for scale in arguments.scale:
            yield first, second, 0.0, scale


def main() -> int:
    """Register each pair so displaced; say what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--yaw", type=float, nargs="*", default=[])
    parser.add_argument("--scale", type=float, nargs="*", default=[])
    parser.add_argument("--pairs", type=int, default=8)
    parser.add_argument("--shift", type=float, nargs=3, default=(3.3, -2.4, 0.7))
    parser.add_argument("--format", choices=("tif", "sampled", "xyz", "obj"), default="sampled")
    arguments = parser.parse_args()
    import meshreg

    known = dates(arguments.data)
    wrong = 0
    for first, second, yaw, scale in _cases(arguments):
        with tempfile.TemporaryDirectory() as name:
            folder, shift = Path(name), tuple(arguments.shift)
            if arguments.format in ("tif", "sampled"):
                sampled = arguments.format == "sampled"
                maps = displaced_maps(known[second], folder, shift, yaw, scale, sampled=sampled)
                files = [",".join(map(str, known[first])), ",".join(map(str, maps))]
            else:
                files = []
                for which, place in (("reference", ((0, 0, 0),)), ("moving", (shift, yaw, scale))):
                    date = first if which == "reference" else second
                    points, colors, index = displaced_points(known[date], *place)
                    path = folder / f"{which}.{arguments.format}"
                    if arguments.format == "xyz":
                        write_xyz(path, points, colors)
                    else:
                        write_obj(path, points, colors, index)
                    files.append(str(path))
            surveys = [meshreg.read_survey(file) for file in files]
            started = time.process_time()
            result = meshreg.register_pair(*surveys)
            spent = time.process_time() - started
        said = f"{first} {second} yaw {yaw:+.1f} scale {scale:.3f}: {result.verdict:8s}"
        if result.transform is not None:
            matrix = motion(shift[:2], yaw, scale, pivot_of(known[second][0]))
            found = result.transform
            pivot = np.array([*pivot_of(known[second][0]), found.pivot[2]])
            corners = pivot + [[dx, dy, 0] for dx in (-150, 150) for dy in (-200, 200)]
            moved = np.array([[*(matrix * tuple(c[:2])), c[2]] for c in corners])
            error = np.hypot(*(found.apply(moved) - corners)[:, :2].T).max()
            turn = math.degrees(found.yaw)
            said += f" yaw {turn:+.3f} scale {found.scale:.4f}, corners within {error:.2f} m"
            wrong += result.verdict == "accepted" and error > 3.0
        print(f"{said} ({spent:.1f} s): {result.reason}", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
