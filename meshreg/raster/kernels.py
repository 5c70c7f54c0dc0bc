"""Numba loops of the mesh rasterizer: bin faces to bands, draw the top surface, average.

Coordinates are in samples of the fine lattice: column x to the east, row y to the south, whole
numbers at sample centres, height z in metres above the raster's datum. A cell is `times` by
`times` samples. Each band of cell rows belongs to one thread, and within it faces are drawn in
rising order, so nothing depends on scheduling or on the number of threads.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from meshreg.jit import jit, prange
from meshreg.raster.shade_kernels import (
    BandPlace,
    ColorArrays,
    ColorSums,
    MeshArrays,
    Pages,
    no_sums,
    row_means,
    shade_textures,
    shade_vertices,
)
from meshreg.records import Bool, Float32, Float64, Int32

UInt16 = NDArray[np.uint16]
Int64 = NDArray[np.int64]
_CHUNK = 65536  # faces to a unit of work; fixed, so that sums do not depend on the thread count


class BandFaces(NamedTuple):
    """The faces of band b, in rising order: ``members[starts[b]:starts[b + 1]]``."""

    starts: Int64
    members: Int32


class Lattice(NamedTuple):
    """Cell rows `first` up to `last`, in bands of `band_rows` (a divisor of `first`)."""

    first: int
    last: int
    band_rows: int
    times: int
    least: int  # samples of a cell that must have a color


@jit(parallel=True, nogil=True)
def placed(points: Float64, matrix: Float64, shift: Float64) -> Float64:
    """Return ``matrix @ point + shift`` for each point (N, 3)."""
    out = np.empty((points.shape[0], 3), np.float64)
    for i in prange(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(3):
            out[i, k] = matrix[k, 0] * x + matrix[k, 1] * y + matrix[k, 2] * z + shift[k]
    return out


@jit(parallel=True, nogil=True)
def face_bands(
    points: Float64, faces: Int32, keep: Bool, size: tuple[int, int], band_rows: int
) -> tuple[Int32, Float64]:
    """Find the first and last band (F, 2) that each face can touch; -1 where it touches none.

    `size` is the lattice's (rows, columns) in samples, `band_rows` the rows of a band. `keep` is
    empty (all faces) or False where a face is left out. Also returns, per chunk of faces, the
    count of faces with a corner that is not finite and the area [samples] of those wholly inside.
    """
    n_faces = faces.shape[0]
    n_chunks = (n_faces + _CHUNK - 1) // _CHUNK
    bands = np.empty((n_faces, 2), np.int32)
    sums = np.zeros((n_chunks, 2), np.float64)
    bottom, right = size[0] - 1, size[1] - 1
    for chunk in prange(n_chunks):
        for f in range(chunk * _CHUNK, min(n_faces, (chunk + 1) * _CHUNK)):
            bands[f, 0] = -1
            bands[f, 1] = -1
            if keep.size > 0 and not keep[f]:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, bx, cx = points[a, 0], points[b, 0], points[c, 0]
            ay, by, cy = points[a, 1], points[b, 1], points[c, 1]
            area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
            if not math.isfinite(area + points[a, 2] + points[b, 2] + points[c, 2]):
                sums[chunk, 0] += 1.0
                continue
            if area == 0.0:
                continue
            low, high = min(ay, by, cy), max(ay, by, cy)
            west, east = min(ax, bx, cx), max(ax, bx, cx)
            # Whole numbers are centres: the lattice's edges lie half a sample further out.
            inside_rows = low >= -0.5 - 1e-6 and high <= bottom + 0.5 + 1e-6
            if inside_rows and west >= -0.5 - 1e-6 and east <= right + 0.5 + 1e-6:
                sums[chunk, 1] += 0.5 * abs(area)
            first = math.ceil(max(low, 0.0))
            last = math.floor(min(high, float(bottom)))
            if first > last or math.ceil(max(west, 0.0)) > math.floor(min(east, float(right))):
                continue
            bands[f, 0] = first // band_rows
            bands[f, 1] = last // band_rows
    return bands, sums


@jit(parallel=True, nogil=True)
def band_members(bands: Int32, n_bands: int) -> BandFaces:
    """Sort the faces to the bands that they touch (a stable counting sort, in parallel)."""
    n_faces = bands.shape[0]
    n_chunks = (n_faces + _CHUNK - 1) // _CHUNK
    places = np.zeros((n_chunks, n_bands), np.int64)
    for chunk in prange(n_chunks):
        for f in range(chunk * _CHUNK, min(n_faces, (chunk + 1) * _CHUNK)):
            if bands[f, 0] >= 0:
                for band in range(bands[f, 0], bands[f, 1] + 1):
                    places[chunk, band] += 1
    starts = np.zeros(n_bands + 1, np.int64)
    total = 0
    for band in range(n_bands):
        starts[band] = total
        for chunk in range(n_chunks):
            count = places[chunk, band]
            places[chunk, band] = total
            total += count
    starts[n_bands] = total
    members = np.empty(total, np.int32)
    for chunk in prange(n_chunks):
        for f in range(chunk * _CHUNK, min(n_faces, (chunk + 1) * _CHUNK)):
            if bands[f, 0] >= 0:
                for band in range(bands[f, 0], bands[f, 1] + 1):
                    members[places[chunk, band]] = f
                    places[chunk, band] += 1
    return BandFaces(starts, members)


@jit(nogil=True)
def _crossing(ax: float, ay: float, bx: float, slope: float, y: float) -> float:
    x = ax + (y - ay) * slope
    return min(max(x, min(ax, bx)), max(ax, bx))


@jit(nogil=True)
def _draw_face(
    points: Float64, corners: Int32, mark: int, row0: int, depth: Float32, owner: Int32
) -> None:
    """Draw one face into a band that starts at sample row `row0`; the higher surface wins.

    `owner` gets `mark` where it does.

    Watertight: the corners are sorted by (y, x), so two faces that share an edge compute where it
    crosses a row from the same numbers in the same order, and both include that point.
    """
    a, b, c = corners[0], corners[1], corners[2]
    if (points[b, 1], points[b, 0]) < (points[a, 1], points[a, 0]):
        a, b = b, a
    if (points[c, 1], points[c, 0]) < (points[a, 1], points[a, 0]):
        a, c = c, a
    if (points[c, 1], points[c, 0]) < (points[b, 1], points[b, 0]):
        b, c = c, b
    ax, ay, az = points[a, 0], points[a, 1], points[a, 2]
    bx, by, bz = points[b, 0], points[b, 1], points[b, 2]
    cx, cy, cz = points[c, 0], points[c, 1], points[c, 2]
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area == 0.0:
        return
    dzdx = ((bz - az) * (cy - ay) - (cz - az) * (by - ay)) / area
    dzdy = ((bx - ax) * (cz - az) - (cx - ax) * (bz - az)) / area
    lowest, highest = min(az, bz, cz), max(az, bz, cz)
    long_slope = (cx - ax) / (cy - ay)  # cy > ay, else the area were zero
    upper_slope = (bx - ax) / (by - ay) if by > ay else 0.0
    lower_slope = (cx - bx) / (cy - by) if cy > by else 0.0
    n_rows, n_cols = depth.shape
    for row in range(max(math.ceil(ay) - row0, 0), min(math.floor(cy) - row0, n_rows - 1) + 1):
        y = float(row + row0)
        one = _crossing(ax, ay, cx, long_slope, y) if y < cy else cx
        if y < by:
            two = _crossing(ax, ay, bx, upper_slope, y)
        elif y == by:
            two = bx
        else:
            two = _crossing(bx, by, cx, lower_slope, y) if y < cy else cx
        first = math.ceil(max(min(one, two), 0.0))
        last = math.floor(min(max(one, two), n_cols - 1.0))
        base = az + (y - ay) * dzdy - ax * dzdx
        for col in range(first, last + 1):
            # Slivers have gradients without meaning: stay between the corners' heights.
            z = np.float32(min(max(base + col * dzdx, lowest), highest))
            if z > depth[row, col]:
                depth[row, col] = z
                owner[row, col] = mark


@jit(nogil=True)
def _average_heights(
    depth: Float32, owner: Int32, times: int, height: Float32, samples: UInt16
) -> None:
    """Write the mean height and the count of samples of each cell of a band."""
    for row in range(height.shape[0]):
        for col in range(height.shape[1]):
            total, count = 0.0, 0
            for i in range(row * times, (row + 1) * times):
                for j in range(col * times, (col + 1) * times):
                    if owner[i, j] >= 0:
                        total += depth[i, j]
                        count += 1
            samples[row, col] = count
            height[row, col] = total / count if count else np.nan


@jit(parallel=True, nogil=True)
def render(
    mesh: MeshArrays, faces_of: BandFaces, lattice: Lattice,
    height: Float32, samples: UInt16, pages: Pages, sums: ColorSums, out: ColorArrays,
) -> None:  # fmt: skip
    """Draw the cell rows of `lattice`: mean heights, counts of samples, and colors.

    `height`, `samples` and `out` are those of the whole raster. Empty arrays switch a part off:
    `height` when the heights are known already, `pages.texels` without pages in memory,
    `mesh.colors` without vertex colors. Color sums are added to `sums`, which starts at the first
    row; where that is empty they become means in `out` at once.
    """
    times, n_cols = lattice.times, samples.shape[1]
    n_bands = (lattice.last - lattice.first + lattice.band_rows - 1) // lattice.band_rows
    textured, painted = pages.texels.size > 0, mesh.colors.size > 0
    at_once = sums.totals.shape[0] == 0
    for k in prange(n_bands):
        top = lattice.first + k * lattice.band_rows
        bottom = min(top + lattice.band_rows, lattice.last)
        depth = np.full(((bottom - top) * times, n_cols * times), -np.inf, np.float32)
        owner = np.full(((bottom - top) * times, n_cols * times), -1, np.int32)
        band = top // lattice.band_rows
        members = faces_of.members[faces_of.starts[band] : faces_of.starts[band + 1]]
        for m in range(members.shape[0]):
            _draw_face(mesh.points, mesh.faces[members[m]], m, top * times, depth, owner)
        if height.size > 0:
            _average_heights(depth, owner, times, height[top:bottom], samples[top:bottom])
        if not (textured or painted):
            continue
        place, mine = BandPlace(top * times, times, top - lattice.first), sums
        if at_once:
            place, mine = BandPlace(top * times, times, 0), no_sums(bottom - top, n_cols)
        if textured:
            shade_textures(mesh, members, pages, owner, place, mine)
        if painted:
            shade_vertices(mesh, members, owner, place, mine)
        if at_once:
            for row in range(bottom - top):
                row_means(mine, row, lattice.least, out, top + row)
