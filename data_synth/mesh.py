"""From a view of a survey to the geometry that reconstruction software would export."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_synth import types as t
from data_synth.scene import Take, View
from data_synth.seafloor import Seafloor
from meshreg.records import Mesh, PointCloud, Texture

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]
PLATE_MIN = 0.15  # plates with a smaller radius stay without overhang [m]


@dataclass(frozen=True, eq=False)
class Nodes:
    """Vertices on a wandering lattice: (R, C) arrays, centred [m]; `kept` says what was seen."""

    east: Float64
    north: Float64
    up: Float64
    kept: Bool
    plate: Int32  # number of the plate colony on top, -1 elsewhere


def make_nodes(take: Take, view: View) -> Nodes:
    """Place vertices: unevenly dense, jittered, on the smoothed surface, with noise."""
    import cv2

    from data_synth.seeing_kernels import blotches

    sfm, lattice = take.sfm, view.lattice
    h = sfm.mesh_spacing
    west, south, east, north = take.footprint
    e, n = np.meshgrid(np.arange(west, east + h, h), np.arange(north, south - h, -h))
    rng = np.random.default_rng([take.seed, 10])
    ex, nx = e.ravel(), n.ravel()
    place = [e.copy(), n.copy()]
    for k, salt in enumerate((3, 4)):
        # a slow wander makes some ground dense and some sparse; gentle enough not to fold
        wander = np.clip(blotches(ex, nx, take.seed + salt, 1.2, 2), -2.0, 2.0).reshape(e.shape)
        place[k] += 0.04 * sfm.uneven * wander + 0.25 * h * (2.0 * rng.random(e.shape) - 1.0)
    e, n = place
    sigma = sfm.smoothing * h / lattice.step
    smooth = cv2.GaussianBlur(view.up, (0, 0), sigma) if sigma > 0.3 else view.up
    row, col = (lattice.north - n) / lattice.step, (e - lattice.west) / lattice.step
    up = sample_bilinear(smooth, row, col)
    up += take.height_noise(e, n) + 0.3 * sfm.vertex_noise * rng.standard_normal(e.shape)
    nearest = (
        np.clip(np.rint(row).astype(int), 0, lattice.shape[0] - 1),
        np.clip(np.rint(col).astype(int), 0, lattice.shape[1] - 1),
    )
    inside = (row > 0) & (row < lattice.shape[0] - 1) & (col > 0) & (col < lattice.shape[1] - 1)
    winner = view.winner[nearest]
    things = take.seafloor.features
    is_plate = (things["kind"] == t.PLATE) & (things["radius"] > PLATE_MIN)
    plate = np.where((winner >= 0) & np.append(is_plate, False)[winner], winner, -1)
    return Nodes(e, n, up, take.covered(e, n) & inside, plate.astype(np.int32))


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles in centred coordinates: vertices (V, 3) [m], faces (F, 3)."""

    vertices: Float64
    faces: Int32


def make_surface(take: Take, nodes: Nodes) -> Surface:
    """Join nodes to triangles; plates overhang, floaters hang in the water."""
    shape = nodes.east.shape
    number = np.arange(nodes.east.size, dtype=np.int32).reshape(shape)
    points = np.stack([nodes.east.ravel(), nodes.north.ravel(), nodes.up.ravel()], axis=1)
    whole = _quads(nodes.kept).all(axis=0)
    wall = _walls(nodes)
    pieces = [(points, _triangles(number, whole & ~wall, take.seed))]
    if (nodes.plate >= 0).any():
        pieces += _overhangs(take, nodes, number, whole, wall)
    pieces += _floaters(take, nodes, whole)
    start, vertices, faces = 0, [], []
    for corner, face in pieces:
        vertices.append(corner)
        faces.append(face + start)
        start += len(corner)
    used, again = np.unique(np.concatenate(faces), return_inverse=True)
    return Surface(np.concatenate(vertices)[used], again.reshape(-1, 3).astype(np.int32))


def _quads(nodes: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return the four corners (4, R-1, C-1) of each lattice square: NW, NE, SW, SE."""
    return np.stack([nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]])


def _triangles(number: Int32, chosen: Bool, seed: int, turned: bool = False) -> Int32:
    """Two triangles for each chosen square, counter-clockwise from above, either diagonal."""
    nw, ne, sw, se = (corner[chosen] for corner in _quads(number))
    flip = np.random.default_rng([seed, 11]).random(len(nw)) < 0.5
    one = np.where(flip[:, None], np.stack([nw, sw, se], 1), np.stack([nw, sw, ne], 1))
    two = np.where(flip[:, None], np.stack([nw, se, ne], 1), np.stack([ne, sw, se], 1))
    faces = np.concatenate([one, two]).astype(np.int32)
    return faces[:, ::-1] if turned else faces


def _walls(nodes: Nodes) -> Bool:
    """Squares between a plate's rim and something well below it."""
    plate, up = _quads(nodes.plate), _quads(nodes.up)
    mixed = (plate >= 0).any(axis=0) & (plate != plate[0]).any(axis=0)
    wall: Bool = mixed & (np.ptp(up, axis=0) > 0.08)
    return wall


def _overhangs(
    take: Take, nodes: Nodes, number: Int32, whole: Bool, wall: Bool
) -> list[tuple[Float64, Int32]]:
    """Return the ground below each plate's rim, and the plate's underside 3 cm below its top."""
    from scipy.ndimage import binary_dilation

    things = take.seafloor.features
    bare = Seafloor(take.seafloor.ground, things[things["kind"] != t.PLATE], take.seafloor.bounds)
    on = nodes.plate >= 0
    inner = _quads(on).all(axis=0)
    skirt = whole & (wall | (binary_dilation(wall, iterations=3) & inner))
    start = take.distortion.start
    top = np.stack([nodes.east[on], nodes.north[on], nodes.up[on]], axis=1)
    world = take.distortion.reference_from_moving(top + start) - take.distortion.centre
    ground = bare.height(world[:, 0].copy(), world[:, 1].copy(), 2.0 * take.sfm.mesh_spacing)
    below = nodes.up.copy()
    # the distortion is smooth: a drop in the world is a drop in the survey's frame
    below[on] -= np.maximum(0.0, world[:, 2] - ground)
    low = np.stack([nodes.east.ravel(), nodes.north.ravel(), below.ravel()], axis=1)
    under = np.stack([nodes.east.ravel(), nodes.north.ravel(), nodes.up.ravel() - 0.03], axis=1)
    return [
        (low, _triangles(number, skirt, take.seed + 1)),
        (under, _triangles(number, whole & inner & ~wall, take.seed + 2, turned=True)),
    ]


def _floaters(take: Take, nodes: Nodes, whole: Bool) -> list[tuple[Float64, Int32]]:
    """Scraps of surface that matching placed in the open water."""
    west, south, east, north = take.footprint
    rng = np.random.default_rng([take.seed, 12])
    count = rng.poisson(take.sfm.floaters * (east - west) * (north - south) / 100.0)
    rows, cols = nodes.east.shape
    pieces = []
    for _ in range(count):
        size = int(rng.integers(2, 6))
        i, j = int(rng.integers(0, rows - size)), int(rng.integers(0, cols - size))
        rise = rng.uniform(0.3, 1.2)
        part = (slice(i, i + size), slice(j, j + size))
        shape = nodes.east[part].shape
        up = nodes.up[part] + rise + 0.05 * rng.standard_normal(shape)
        corner = np.stack([nodes.east[part], nodes.north[part], up], axis=-1).reshape(-1, 3)
        number = np.arange(corner.shape[0], dtype=np.int32).reshape(shape)
        squares = whole[i : i + size - 1, j : j + size - 1]
        if squares.all():
            pieces.append((corner, _triangles(number, squares, take.seed + i)))
    return pieces


def sample_bilinear(raster: NDArray[np.float32], row: Float64, col: Float64) -> Float64:
    """Raster values between samples, float64; beyond the border the border's."""
    from data_synth.seeing_kernels import bilinear

    values: Float64 = bilinear(raster, row.ravel(), col.ravel())
    return values.reshape(row.shape)


def textured(take: Take, view: View, surface: Surface, pages: int, origin: Float64) -> Mesh:
    """Return the surface with `pages` x `pages` texture pages, each a map of its part.

    Pages overlap by a margin, so that a triangle across a border lies within one page.
    """
    from data_synth.pages import encode_page

    lattice = view.lattice
    rows, cols = lattice.shape
    margin = math.ceil(3.0 * take.sfm.mesh_spacing / lattice.step)
    row_edges = np.linspace(0, rows, pages + 1).astype(int)
    col_edges = np.linspace(0, cols, pages + 1).astype(int)
    centre = surface.vertices[surface.faces].mean(axis=1)
    row = (lattice.north - centre[:, 1]) / lattice.step + 0.5
    col = (centre[:, 0] - lattice.west) / lattice.step + 0.5
    page_row = np.clip(np.searchsorted(row_edges, row, "right") - 1, 0, pages - 1)
    page_col = np.clip(np.searchsorted(col_edges, col, "right") - 1, 0, pages - 1)
    textures: list[Texture] = []
    corner_x = surface.vertices[surface.faces, 0]
    corner_y = surface.vertices[surface.faces, 1]
    uv = np.empty((len(surface.faces), 3, 2))
    seen = take.margin_lattice(lattice) > -0.05
    for i in range(pages):
        for j in range(pages):
            top, bottom = max(0, row_edges[i] - margin), min(rows, row_edges[i + 1] + margin)
            left, right = max(0, col_edges[j] - margin), min(cols, col_edges[j + 1] + margin)
            part = (slice(top, bottom), slice(left, right))
            pixels = np.where(seen[part][..., None], view.color[part], 0).astype(np.uint8)
            textures.append(encode_page(pixels, f"{take.name}_{i * pages + j:03d}"))
            mine = (page_row == i) & (page_col == j)
            # outer edges of the page, half a sample beyond the first one's centre
            west = lattice.west + (left - 0.5) * lattice.step
            south = lattice.north - (bottom - 0.5) * lattice.step
            uv[mine, :, 0] = (corner_x[mine] - west) / ((right - left) * lattice.step)
            uv[mine, :, 1] = (corner_y[mine] - south) / ((bottom - top) * lattice.step)
    return Mesh(
        vertices=surface.vertices + (take.distortion.start - origin),
        faces=surface.faces,
        uv=uv.astype(np.float32),
        face_texture=(page_row * pages + page_col).astype(np.int32),
        textures=tuple(textures),
    )


def colored(take: Take, view: View, surface: Surface, origin: Float64) -> Mesh:
    """Return the surface with a color per vertex: the mosaic's mean over a mesh spacing."""
    colors = colors_at(view, surface.vertices, take.sfm.mesh_spacing)
    vertices = surface.vertices + (take.distortion.start - origin)
    return Mesh(vertices=vertices, faces=surface.faces, colors=colors)


def colors_at(view: View, points: Float64, width: float) -> UInt8:
    """Mean color (N, 3) of the mosaic in a square of side `width` [m] about centred points."""
    import cv2

    lattice = view.lattice
    size = max(1, round(width / lattice.step))
    mean = cv2.blur(view.color, (size, size)) if size > 1 else view.color
    row = np.rint((lattice.north - points[:, 1]) / lattice.step).astype(int)
    col = np.rint((points[:, 0] - lattice.west) / lattice.step).astype(int)
    picked: UInt8 = mean[
        np.clip(row, 0, lattice.shape[0] - 1), np.clip(col, 0, lattice.shape[1] - 1)
    ]
    return picked


def cloud(take: Take, view: View, spacing: float, origin: Float64) -> PointCloud:
    """Return a dense cloud: a point a square of `spacing`, thinned unevenly, noisy, with strays."""
    from data_synth.seeing_kernels import blotches

    west, south, east, north = take.footprint
    rng = np.random.default_rng([take.seed, 13])
    e, n = np.meshgrid(np.arange(west, east, spacing), np.arange(north, south, -spacing))
    e = (e + spacing * rng.random(e.shape)).ravel()
    n = (n - spacing * rng.random(n.shape)).ravel()
    density = blotches(e, n, take.seed + 5, 1.5, 3)
    kept = rng.random(e.size) > take.sfm.uneven * np.clip(0.5 + 0.5 * density, 0.0, 1.2)
    kept &= take.covered(e, n)
    e, n = e[kept], n[kept]
    lattice = view.lattice
    row, col = (lattice.north - n) / lattice.step, (e - lattice.west) / lattice.step
    up = sample_bilinear(view.up, row, col)
    up += take.height_noise(e, n) + take.sfm.vertex_noise * rng.standard_normal(e.size)
    stray = rng.random(e.size) < 2e-5 * take.sfm.floaters
    up[stray] += rng.uniform(0.2, 1.5, int(stray.sum()))
    points = np.stack([e, n, up], axis=1)
    colors = colors_at(view, points, min(spacing, 0.01))
    return PointCloud(points + (take.distortion.start - origin), colors)
