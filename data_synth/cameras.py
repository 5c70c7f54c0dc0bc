"""Cameras on a lawn-mower track: photographs, navigation, and a COLMAP model of the seafloor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_synth.pages import encode_jpeg
from data_synth.scene import Take, View
from data_synth.seeing import Lattice, Seeing, local_mean

Float64 = NDArray[np.float64]
WIDTH, HEIGHT = 800, 600
FOCAL = 690.0  # px; about 60 degrees across


@dataclass(frozen=True, eq=False)
class Cameras:
    """Poses in the world frame (patch centre at 0).

    Attributes
    ----------
    centres : (N, 3) float64 [m]
    turns : (N, 3, 3) float64
        Rows are the camera's right, down and forward (OpenCV, COLMAP).
    names : tuple of str
    """

    centres: Float64
    turns: Float64
    names: tuple[str, ...]


def lawn_mower(take: Take, tracks: int, images: int, heading: float = 0.0) -> Cameras:
    """Fly `tracks` lines of `images` over a footprint, so high that neighbours overlap by 60 %."""
    west, south, east, north = take.footprint
    side = east - west
    middle = np.array([(west + east) / 2, (south + north) / 2, 0.0]) + take.distortion.start
    middle = take.distortion.reference_from_moving(middle)[0] - take.distortion.centre
    altitude = max(side / tracks / (WIDTH / FOCAL), side / images / (HEIGHT / FOCAL)) / 0.4
    rng = np.random.default_rng([take.seed, 20])
    centres, turns = [], []
    for k in range(tracks):
        back = k % 2 == 1
        for m in range(images):
            along = ((m + 0.5) / images - 0.5) * side * (-1.0 if back else 1.0)
            across = ((k + 0.5) / tracks - 0.5) * side
            along += 0.04 * side / images * rng.standard_normal()
            across += 0.04 * side / tracks * rng.standard_normal()
            yaw = heading + (math.pi if back else 0.0) + math.radians(2.0) * rng.standard_normal()
            roll, pitch = math.radians(2.5) * rng.standard_normal(2)
            c, s = math.cos(heading), math.sin(heading)
            rise = altitude * (1.0 + 0.03 * rng.standard_normal())
            centres.append(
                [middle[0] + c * across - s * along, middle[1] + s * across + c * along, rise]
            )
            turns.append(_down(yaw, roll, pitch))
    ground = float(take.seafloor.height(middle[:1], middle[1:2], 0.1)[0])
    place = np.array(centres) + np.array([0.0, 0.0, ground])
    names = tuple(f"{take.name[:3]}_{k:04d}.jpg" for k in range(len(place)))
    return Cameras(place, np.array(turns), names)


def _down(yaw: float, roll: float, pitch: float) -> Float64:
    """Rows right, down, forward of a camera that looks down, its top towards `yaw` from north."""
    c, s = math.cos(yaw), math.sin(yaw)
    level = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    lean = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]]) @ np.array(
        [[1, 0, 0], [0, cp, -sp], [0, sp, cp]]
    )
    turned: Float64 = lean @ level
    return turned


def navigation(take: Take, cameras: Cameras) -> Float64:
    """Camera positions as the survey's own navigation says them: absolute, noisy (N, 3) [m]."""
    d = take.distortion
    rng = np.random.default_rng([take.seed, 21])
    nav = d.moving_from_reference(cameras.centres + d.centre)
    nav += take.sfm.nav_noise * rng.standard_normal(nav.shape)
    return nav


def write_navigation(take: Take, cameras: Cameras, path: Path) -> Path:
    """Write `image,east,north,up`."""
    rows = zip(cameras.names, navigation(take, cameras), strict=True)
    lines = ["image,east,north,up", *(f"{n},{e:.4f},{y:.4f},{u:.4f}" for n, (e, y, u) in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return path


def photographs(
    take: Take,
    cameras: Cameras,
    folder: Path,
    step: float = 0.004,
    progress: Callable[[float], None] | None = None,
) -> tuple[Path, ...]:
    """Render every camera's image into `folder` as JPEG."""
    from data_synth.camera_kernels import photograph
    from data_synth.seeing_kernels import encode

    z, albedo, lattice = ground_lattice(take, cameras, step)
    soft, wide = local_mean(z, 0.04 / step), local_mean(z, 0.25 / step)
    seeing: Seeing = take.seeing
    files, scale = [], None
    for k, name in enumerate(cameras.names):
        linear = photograph(
            z, soft, wide, albedo, step, lattice.west, lattice.north, cameras.centres[k],
            cameras.turns[k], FOCAL, (HEIGHT, WIDTH), (k, 0), take.plan,
        )  # fmt: skip
        if scale is None:
            mean = linear[linear.any(axis=2)].mean(axis=0, dtype=np.float64)
            scale = seeing.exposure * np.array(seeing.cast) / (mean**0.6 * mean.mean() ** 0.4)
        pixels = encode(linear, scale, seeing.gamma, seeing.noise, take.seed + k, 0.0, 0.0, 1.0)
        files.append(folder / name)
        files[-1].write_bytes(encode_jpeg(pixels, 95))
        if progress is not None:
            progress((k + 1) / len(cameras.names))
    return tuple(files)


def ground_lattice(
    take: Take, cameras: Cameras, step: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], Lattice]:
    """Heights and reflectance, in the world frame, of all that the cameras may see."""
    reach = 0.75 * float(np.max(cameras.centres[:, 2])) * WIDTH / FOCAL + 0.5
    low, high = cameras.centres[:, :2].min(axis=0), cameras.centres[:, :2].max(axis=0)
    west, south, east, north = take.seafloor.bounds
    west, south = max(west, low[0] - reach), max(south, low[1] - reach)
    east, north = min(east, high[0] + reach), min(north, high[1] + reach)
    shape = (int((north - south) / step), int((east - west) / step))
    lattice = Lattice(west + step / 2, north - step / 2, step, shape)
    z, albedo = np.empty(shape, np.float32), np.empty((*shape, 3), np.float32)
    strip = max(1, 1_000_000 // shape[1])
    for top in range(0, shape[0], strip):
        part = slice(top, min(shape[0], top + strip))
        x, y = np.meshgrid(lattice.east, lattice.norths[part])
        z[part], albedo[part], _ = take.seafloor.evaluate(x, y, 1.5 * step)
    return z, albedo, lattice


def colmap_model(take: Take, view: View, folder: Path, count: int = 20_000) -> tuple[Path, ...]:
    """Write a COLMAP text model of points seen by simulated cameras, in a frame of its own.

    Scale, place, heading and tilt are arbitrary, as COLMAP leaves them; `positions.csv` beside
    the model holds the navigation that fixes them.
    """
    west, south, east, north = take.footprint
    tracks = max(3, math.ceil((east - west) / 1.5))
    cameras = lawn_mower(take, tracks, max(3, math.ceil((north - south) / 1.2)))
    rng = np.random.default_rng([take.seed, 22])
    points, colors = _model_points(take, view, count, rng)
    d = take.distortion
    world = d.reference_from_moving(points + d.start) - d.centre
    lattice = _sight_lattice(take, cameras)
    tracks_of: list[list[tuple[int, int]]] = [[] for _ in points]
    rows: list[list[tuple[float, float, int]]] = []
    for k in range(len(cameras.names)):
        seen = _sees(cameras, k, world, *lattice)
        rows.append([])
        for p, (u, v) in zip(
            seen[0], seen[1] + 0.4 * rng.standard_normal(seen[1].shape), strict=True
        ):
            tracks_of[p].append((k, len(rows[-1])))
            rows[-1].append((float(u), float(v), int(p)))
    to_model = _arbitrary_frame(rng)
    kept = {p: n for n, p in enumerate((p for p, t in enumerate(tracks_of) if len(t) >= 3), 1)}
    centres = d.moving_from_reference(cameras.centres + d.centre) - d.start
    scale = float(np.cbrt(abs(np.linalg.det(d.linear))))
    folder.mkdir(parents=True, exist_ok=True)
    return (
        _write_cameras(folder),
        _write_images(folder, cameras, centres, d.linear / scale, to_model, rows, kept),
        _write_points(folder, points, colors, to_model, tracks_of, kept, rng),
        write_navigation(take, cameras, folder / "positions.csv"),
    )


def _model_points(
    take: Take, view: View, count: int, rng: np.random.Generator
) -> tuple[Float64, NDArray[np.uint8]]:
    from data_synth.mesh import colors_at, sample_bilinear

    west, south, east, north = take.footprint
    e, n = rng.uniform(west, east, 2 * count), rng.uniform(south, north, 2 * count)
    keep = np.flatnonzero(take.covered(e, n))[:count]
    e, n = e[keep], n[keep]
    lattice = view.lattice
    row, col = (lattice.north - n) / lattice.step, (e - lattice.west) / lattice.step
    up = sample_bilinear(view.up, row, col) + take.sfm.vertex_noise * rng.standard_normal(len(e))
    points = np.stack([e, n, up], axis=1)
    return points, colors_at(view, points, 0.01)


def _sight_lattice(take: Take, cameras: Cameras) -> tuple[NDArray[np.float32], Lattice]:
    z, _, lattice = ground_lattice(take, cameras, 0.02)
    return z, lattice


def _sees(
    cameras: Cameras, k: int, world: Float64, z: NDArray[np.float32], lattice: Lattice
) -> tuple[NDArray[np.int64], Float64]:
    """Which world points camera `k` sees, and where in the image (N, 2) [px]."""
    from data_synth.camera_kernels import visible

    local = (world - cameras.centres[k]) @ cameras.turns[k].T
    ahead = local[:, 2] > 0.1
    uv = FOCAL * local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
    uv += np.array([WIDTH / 2, HEIGHT / 2])
    inside = ahead & (uv > 0).all(axis=1) & (uv[:, 0] < WIDTH) & (uv[:, 1] < HEIGHT)
    index = np.flatnonzero(inside)
    sight = visible(world[index], z, lattice.step, lattice.west, lattice.north, cameras.centres[k])
    return index[sight], uv[index[sight]]


def _arbitrary_frame(rng: np.random.Generator) -> tuple[Float64, float, Float64]:
    """Draw rotation, scale and shift from the survey's centred frame to the model's."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1
    return q, float(rng.uniform(0.2, 1.5)), rng.uniform(-3, 3, 3)


def _write_cameras(folder: Path) -> Path:
    path = folder / "cameras.txt"
    path.write_text(
        "# Camera list with one line of data per camera:\n"
        f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    )
    return path


def _write_images(
    folder: Path,
    cameras: Cameras,
    centres: Float64,
    linear: Float64,
    to_model: tuple[Float64, float, Float64],
    rows: list[list[tuple[float, float, int]]],
    kept: dict[int, int],
) -> Path:
    from scipy.spatial.transform import Rotation

    turn, scale, shift = to_model
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then X, Y, POINT3D_ID"]
    for k, name in enumerate(cameras.names):
        # world to survey is linear's inverse, survey to model is turn
        rotation = cameras.turns[k] @ linear @ turn.T
        centre = scale * turn @ centres[k] + shift
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        t = -rotation @ centre
        lines.append(
            f"{k + 1} {w:.17g} {x:.17g} {y:.17g} {z:.17g} "
            f"{t[0]:.17g} {t[1]:.17g} {t[2]:.17g} 1 {name}"
        )
        lines.append(" ".join(f"{u:.3f} {v:.3f} {kept.get(p, -1)}" for u, v, p in rows[k]))
    path = folder / "images.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def _write_points(
    folder: Path,
    points: Float64,
    colors: NDArray[np.uint8],
    to_model: tuple[Float64, float, Float64],
    tracks: list[list[tuple[int, int]]],
    kept: dict[int, int],
    rng: np.random.Generator,
) -> Path:
    turn, scale, shift = to_model
    placed = scale * points @ turn.T + shift
    error = rng.uniform(0.2, 0.9, len(points))
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for p, n in kept.items():
        track = " ".join(f"{k + 1} {m}" for k, m in tracks[p])
        x, y, z = placed[p]
        r, g, b = colors[p]
        lines.append(f"{n} {x:.10g} {y:.10g} {z:.10g} {r} {g} {b} {error[p]:.3f} {track}")
    path = folder / "points3D.txt"
    path.write_text("\n".join(lines) + "\n")
    return path
