"""Slow, readable twins of the raster kernels, and small scenes whose truth is a formula.

Nothing here uses `meshreg.raster`. A twin takes the same inputs as the code that it checks and
does the plain thing, sample by sample.
"""

from __future__ import annotations

import math

import numpy as np

from meshreg.records import Grid, Mesh, PointCloud, Survey, Texture

# -- scenes ---------------------------------------------------------------------------------------


def sheet(height, size=4.0, step=0.1, origin=(0.0, 0.0, 0.0), jitter=0.0, seed=0, **paint):
    """A square sheet of triangles, `size` m wide, z = height(x, y), corner (0, 0) in the SW."""
    count = round(size / step) + 1
    axis = np.linspace(0.0, size, count)
    x, y = np.meshgrid(axis, axis)
    if jitter:
        rng = np.random.default_rng(seed)
        inner = (slice(1, -1), slice(1, -1))
        x[inner] += rng.uniform(-jitter, jitter, x[inner].shape) * step
        y[inner] += rng.uniform(-jitter, jitter, y[inner].shape) * step
    vertices = np.stack([x, y, height(x, y) + 0.0 * x], axis=-1).reshape(-1, 3)
    return Survey("sheet", Mesh(vertices, grid_faces(count, count), **paint), np.array(origin))


def grid_faces(rows, cols):
    """Two triangles for each square of a (rows, cols) lattice of vertices, row major."""
    index = np.arange(rows * cols).reshape(rows, cols)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)


def page(image, name="page.png", clamp=False):
    """A texture page that is in memory already."""
    image = np.ascontiguousarray(image, np.uint8)
    return Texture(name, (image.shape[1], image.shape[0]), lambda: image, clamp)


def draped(image, width, height, up=0.0, origin=(0.0, 0.0, 0.0), n=1, clamp=False):
    """A flat sheet `width` × `height` m that shows the whole of `image`, north at its top."""
    x, y = np.meshgrid(np.linspace(0, width, n + 1), np.linspace(0, height, n + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, up)], axis=1)
    faces = grid_faces(n + 1, n + 1)
    uv = np.stack([x.ravel() / width, y.ravel() / height], axis=1).astype(np.float32)[faces]
    mesh = Mesh(
        vertices,
        faces,
        uv=uv,
        face_texture=np.zeros(len(faces), np.int32),
        textures=(page(image, clamp=clamp),),
    )
    return Survey("draped", mesh, np.array(origin))


def moved(survey, shift):
    """The same survey elsewhere, by its origin."""
    from dataclasses import replace

    return replace(survey, origin=survey.origin + np.array(shift, float))


def several(*meshes):
    """One mesh of several (without paint)."""
    start, vertices, faces = 0, [], []
    for mesh in meshes:
        vertices.append(mesh.vertices)
        faces.append(mesh.faces + start)
        start += len(mesh.vertices)
    return Mesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32))


# -- twins ----------------------------------------------------------------------------------------


def barycentric(triangle, x, y):
    """Weights of the corners of a triangle (3, 2+) at (x, y); None for one without area."""
    (ax, ay), (bx, by), (cx, cy) = triangle[:, :2]
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area == 0:
        return None
    second = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
    third = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
    return np.array([1 - second - third, second, third])


def top_surface(vertices, faces, x, y, slack=1e-9):
    """Highest face over the place (x, y): its height, index and weights, or None."""
    best = None
    for index, face in enumerate(faces):
        weights = barycentric(vertices[face], x, y)
        if weights is None or weights.min() < -slack:
            continue
        height = float(weights @ vertices[face][:, 2])
        if best is None or height > best[0] + 1e-9:
            best = (height, index, weights)
    return best


def texel_mean(image, u, v, wrap):
    """Bilinear color at (u, v); over texels with alpha from 128; None when the nearest has less."""
    height, width = image.shape[:2]
    x, y = u * width - 0.5, (1 - v) * height - 0.5
    total, weight = np.zeros(3), 0.0
    nearest = None
    for row in (math.floor(y), math.floor(y) + 1):
        for col in (math.floor(x), math.floor(x) + 1):
            share = (1 - abs(x - col)) * (1 - abs(y - row))
            if wrap:
                texel = image[row % height, col % width]
            else:
                texel = image[min(max(row, 0), height - 1), min(max(col, 0), width - 1)]
            seen = image.shape[2] == 3 or texel[3] >= 128
            if nearest is None or share > nearest[0]:
                nearest = (share, seen)
            if seen:
                total += share * texel[:3]
                weight += share
    return total / weight if nearest[1] else None


def mesh_raster(survey, grid, times, wrap=False):
    """Height, count of samples, color and where it is seen, by the plain definition."""
    mesh = survey.geometry
    rows, cols = grid.shape
    height = np.full(grid.shape, np.nan)
    count = np.zeros(grid.shape, int)
    color = np.zeros((rows, cols, 3))
    seen = np.zeros(grid.shape, bool)
    images = [texture.load() for texture in mesh.textures]
    fine = grid.divided(times)
    least = math.ceil(0.5 * times * times)
    for row in range(rows):
        for col in range(cols):
            heights, colors = [], []
            for i in range(row * times, (row + 1) * times):
                for j in range(col * times, (col + 1) * times):
                    east, north = fine.east_north(i, j)
                    x, y = east - survey.origin[0], north - survey.origin[1]
                    hit = top_surface(mesh.vertices, mesh.faces, x, y)
                    if hit is None:
                        continue
                    heights.append(hit[0])
                    rgb = _color_of(mesh, images, hit, wrap)
                    if rgb is not None:
                        colors.append(rgb)
            if len(heights) >= least:
                height[row, col] = np.mean(heights) + survey.origin[2]
                count[row, col] = len(heights)
                if len(colors) >= least:
                    color[row, col] = np.mean(colors, axis=0)
                    seen[row, col] = True
    return height, count, color, seen


def _color_of(mesh, images, hit, wrap):
    _, face, weights = hit
    if mesh.face_texture is not None and mesh.face_texture[face] >= 0:
        u, v = weights @ mesh.uv[face].astype(float)
        return texel_mean(images[mesh.face_texture[face]], u, v, wrap)
    if mesh.colors is not None:
        return weights @ mesh.colors[mesh.faces[face]].astype(float)
    return None


def cloud_raster(survey, grid, layer):
    """Mean height and color of the points within `layer` of each cell's highest; their number.

    The height is carried from the mean place of the points to the cell's centre along the slope
    between its neighbours, four times over.
    """
    cloud: PointCloud = survey.geometry
    members: dict[tuple[int, int], list[int]] = {}
    for index, point in enumerate(cloud.points + survey.origin):
        row = math.floor((grid.north - point[1]) / grid.cell)
        col = math.floor((point[0] - grid.west) / grid.cell)
        if 0 <= row < grid.shape[0] and 0 <= col < grid.shape[1]:
            members.setdefault((row, col), []).append(index)
    mean = np.full((*grid.shape, 3), np.nan)  # east and south of the centre in cells, height
    count = np.zeros(grid.shape, int)
    color = np.zeros((*grid.shape, 3))
    for (row, col), indices in members.items():
        z = cloud.points[indices, 2] + survey.origin[2]
        top = z >= z.max() - layer
        east, north = (cloud.points[indices, :2] + survey.origin[:2])[top].mean(axis=0)
        mean[row, col] = (
            (east - grid.west) / grid.cell - col - 0.5,
            (grid.north - north) / grid.cell - row - 0.5,
            z[top].mean(),
        )
        count[row, col] = top.sum()
        if cloud.colors is not None:
            color[row, col] = cloud.colors[indices][top].mean(axis=0)
    height = mean[:, :, 2].copy()
    for _ in range(4):
        before = height.copy()
        for row, col in members:
            rise = 0.0
            for axis, (down, right) in enumerate(((0, 1), (1, 0))):
                ends = [(row + k * down, col + k * right, k) for k in (-1, 0, 1)]
                ends = [end for end in ends if end[:2] in members]
                steps = ends[-1][2] - ends[0][2]
                if steps:
                    slope = (before[ends[-1][:2]] - before[ends[0][:2]]) / steps
                    rise += slope * mean[row, col, axis]
            height[row, col] = mean[row, col, 2] - rise
    return height, count, color


def block_mean(values, valid, times, share):
    """Mean over blocks of `times` × `times` valid values, where they are at least `share`."""
    rows, cols = -(-valid.shape[0] // times), -(-valid.shape[1] // times)
    out = np.full((rows, cols, *values.shape[2:]), np.nan)
    for row in range(rows):
        for col in range(cols):
            part = slice(row * times, (row + 1) * times), slice(col * times, (col + 1) * times)
            if valid[part].sum() >= share * times**2:
                out[row, col] = values[part][valid[part]].mean(axis=0)
    return out


def bilinear(values, valid, row, col):
    """Value at a fractional place, over the valid cells; None if they weigh half or less."""
    rows, cols = valid.shape
    if not (-0.5 <= row <= rows - 0.5 and -0.5 <= col <= cols - 0.5):
        return None
    row, col = min(max(row, 0), rows - 1), min(max(col, 0), cols - 1)
    total, weight = 0.0, 0.0
    for i in (math.floor(row), math.floor(row) + 1):
        for j in (math.floor(col), math.floor(col) + 1):
            share = (1 - abs(row - i)) * (1 - abs(col - j))
            if share > 0 and valid[min(i, rows - 1), min(j, cols - 1)]:
                total = total + share * values[min(i, rows - 1), min(j, cols - 1)]
                weight += share
    return total / weight if weight > 0.5 else None


def maps_raster(values, valid, source: Grid, grid: Grid, transform, times):
    """Mean of `times`² bilinear samples per cell of `grid`, taken before `transform`."""
    out = np.full((*grid.shape, *values.shape[2:]), np.nan)
    fine = grid.divided(times)
    back = transform.inverse()
    for row in range(grid.shape[0]):
        for col in range(grid.shape[1]):
            found = []
            for i in range(row * times, (row + 1) * times):
                for j in range(col * times, (col + 1) * times):
                    east, north, _ = back.apply([*fine.east_north(i, j), 0.0])
                    value = bilinear(values, valid, *source.row_col(east, north))
                    if value is not None:
                        found.append(value)
            if len(found) >= max(1, (times**2 + 1) // 2):
                out[row, col] = np.mean(found, axis=0)
    return out
