"""Numba loops of the floater filter: connected pieces, their sizes, the ground's tops."""

from __future__ import annotations

import math

import numpy as np

from meshreg.jit import jit, prange
from meshreg.records import Bool, Float64, Int32

_CHUNK = 65536


@jit(nogil=True)
def _root(parent: Int32, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@jit(nogil=True)
def face_pieces(points: Float64, faces: Int32) -> tuple[Int32, int]:
    """Label each face by its connected piece (faces that share a vertex), in order of first face.

    Union-find with path halving; the lower vertex is the root, so labels do not depend on chance.
    """
    parent = np.arange(points.shape[0]).astype(np.int32)
    for f in range(faces.shape[0]):
        a = _root(parent, faces[f, 0])
        for k in range(1, 3):
            b = _root(parent, faces[f, k])
            if a < b:
                parent[b] = a
            elif b < a:
                parent[a] = b
                a = b
    number = np.full(points.shape[0], -1, np.int32)
    label = np.empty(faces.shape[0], np.int32)
    count = 0
    for f in range(faces.shape[0]):
        root = _root(parent, faces[f, 0])
        if number[root] < 0:
            number[root] = count
            count += 1
        label[f] = number[root]
    return label, count


@jit(nogil=True)
def corners_of(faces: Int32, chosen: Bool, n_points: int) -> Bool:
    """Say for each point whether a chosen face has it as a corner."""
    corner = np.zeros(n_points, np.bool_)
    for f in range(faces.shape[0]):
        if chosen[f]:
            for k in range(3):
                corner[faces[f, k]] = True
    return corner


@jit(nogil=True)
def piece_sizes(
    points: Float64, faces: Int32, label: Int32, count: int
) -> tuple[Float64, Float64, Float64]:
    """Area seen from above (P,), lowest and highest corner (P, 3) of each piece."""
    area = np.zeros(count)
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        piece = label[f]
        bx, by = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        cx, cy = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1]
        size = 0.5 * abs(bx * cy - cx * by)
        if not math.isfinite(size):
            continue
        area[piece] += size
        for k in range(3):
            p, q, r = points[a, k], points[b, k], points[c, k]
            low[piece, k] = min(low[piece, k], p, q, r)
            high[piece, k] = max(high[piece, k], p, q, r)
    return area, low, high


def joined(points: Float64, faces: Int32) -> Int32:
    """Return the faces with vertices at exactly the same place replaced by one of them."""
    order = np.lexsort(points.T)
    same = np.r_[False, (points[order[1:]] == points[order[:-1]]).all(axis=1)]
    first = np.maximum.accumulate(np.where(same, 0, np.arange(len(order))))
    one = np.empty(len(points), np.int32)
    one[order] = order[first]
    return one[faces]


@jit(parallel=True, nogil=True)
def plan_bounds(points: Float64) -> Float64:
    """Lowest and highest column 0 and 1 of the finite points, (2, 2); infinite without any."""
    n_chunks = (points.shape[0] + _CHUNK - 1) // _CHUNK
    part = np.empty((n_chunks, 4))
    for chunk in prange(n_chunks):
        x0, y0, x1, y1 = np.inf, np.inf, -np.inf, -np.inf
        for i in range(chunk * _CHUNK, min(points.shape[0], (chunk + 1) * _CHUNK)):
            x, y = points[i, 0], points[i, 1]
            if math.isfinite(x + y + points[i, 2]):
                x0, y0, x1, y1 = min(x0, x), min(y0, y), max(x1, x), max(y1, y)
        part[chunk, 0], part[chunk, 1], part[chunk, 2], part[chunk, 3] = x0, y0, x1, y1
    out = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])
    for chunk in range(n_chunks):
        for k in range(2):
            out[0, k] = min(out[0, k], part[chunk, k])
            out[1, k] = max(out[1, k], part[chunk, 2 + k])
    return out


@jit(parallel=True, nogil=True)
def squares_of(points: Float64, corner: Float64, square: float, shape: tuple[int, int]) -> Int32:
    """Index of each point's square in a raster of `shape` from `corner`; -1 outside or not finite.

    Rows count northward (column 1 of the points), columns eastward.
    """
    out = np.empty(points.shape[0], np.int32)
    rows, cols = shape
    for i in prange(points.shape[0]):
        x, y = (points[i, 0] - corner[0]) / square, (points[i, 1] - corner[1]) / square
        out[i] = -1
        if math.isfinite(x + y + points[i, 2]) and 0.0 <= x < cols and 0.0 <= y < rows:
            out[i] = int(y) * cols + int(x)
    return out


@jit(parallel=True, nogil=True)
def highest(points: Float64, squares: Int32, shape: tuple[int, int], workers: int) -> Float64:
    """Highest point in each square of `squares_of`'s raster; -inf where there is none.

    Each worker looks at all points and keeps its own stripe of squares: no two write to one.
    """
    top = np.full(shape[0] * shape[1], -np.inf)
    for worker in prange(workers):
        first = worker * len(top) // workers
        last = (worker + 1) * len(top) // workers
        for i in range(points.shape[0]):
            if first <= squares[i] < last:
                top[squares[i]] = max(top[squares[i]], points[i, 2])
    return top.reshape(shape)


@jit(nogil=True)
def sheets(top: Float64, most: float) -> tuple[Int32, int]:
    """Label the squares whose tops can be reached from each other by steps of at most `most`.

    Neighbours are the eight around; squares without a point get -1.
    """
    rows, cols = top.shape
    parent = np.arange(rows * cols).astype(np.int32)
    for row in range(rows):
        for col in range(cols):
            if top[row, col] == -np.inf:
                continue
            for i, j in ((row, col - 1), (row - 1, col - 1), (row - 1, col), (row - 1, col + 1)):
                if i < 0 or j < 0 or j >= cols or not abs(top[i, j] - top[row, col]) <= most:
                    continue
                a, b = _root(parent, i * cols + j), _root(parent, row * cols + col)
                parent[max(a, b)] = min(a, b)
    label = np.full((rows, cols), -1, np.int32)
    count = 0
    for row in range(rows):
        for col in range(cols):
            if top[row, col] > -np.inf:
                root = _root(parent, row * cols + col)  # the first square of its sheet
                if root == row * cols + col:
                    label[row, col] = count
                    count += 1
                else:
                    label[row, col] = label[root // cols, root % cols]
    return label, count


@jit(nogil=True)
def sheet_steps(top: Float64, label: Int32, count: int) -> tuple[Float64, Float64, Float64]:
    """Squares of each sheet, diagonal of its box in squares, least step down to those around it.

    The step is negative where a neighbour is higher, infinite where there is none.
    """
    rows, cols = top.shape
    size = np.zeros(count)
    step = np.full(count, np.inf)
    box = np.empty((count, 4))
    box[:, :2] = np.inf
    box[:, 2:] = -np.inf
    for row in range(rows):
        for col in range(cols):
            mine = label[row, col]
            if mine < 0:
                continue
            size[mine] += 1.0
            box[mine, 0], box[mine, 1] = min(box[mine, 0], row), min(box[mine, 1], col)
            box[mine, 2], box[mine, 3] = max(box[mine, 2], row), max(box[mine, 3], col)
            for i in range(max(row - 1, 0), min(row + 2, rows)):
                for j in range(max(col - 1, 0), min(col + 2, cols)):
                    if label[i, j] >= 0 and label[i, j] != mine:
                        step[mine] = min(step[mine], top[row, col] - top[i, j])
    return size, np.hypot(box[:, 2] - box[:, 0] + 1.0, box[:, 3] - box[:, 1] + 1.0), step
