"""Numba loops of the mesh rasterizer: bin faces to bands, draw the top surface, average, shade.

Coordinates are in samples of the fine lattice: column x to the east, row y to the south, whole
numbers at sample centres, height z in metres above the raster's datum. A cell is `times` by
`times` samples. Each band of cell rows belongs to one thread, and within it faces are drawn in
rising order, so nothing depends on scheduling or on the number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from meshreg.jit import jit, prange
from meshreg.types import Bool, Float32, Float64, Int32, UInt8

_CHUNK = 65536  # faces to a unit of work; fixed, so that sums do not depend on the thread count


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
            if low >= 0.0 and high <= bottom and west >= 0.0 and east <= right:
                sums[chunk, 1] += 0.5 * abs(area)
            first = math.ceil(max(low, 0.0))
            last = math.floor(min(high, float(bottom)))
            if first > last or math.ceil(max(west, 0.0)) > math.floor(min(east, float(right))):
                continue
            bands[f, 0] = first // band_rows
            bands[f, 1] = last // band_rows
    return bands, sums


@jit(parallel=True, nogil=True)
def band_members(bands: Int32, n_bands: int) -> tuple[np.ndarray, Int32]:
    """Return `starts` (n_bands + 1,) and `members`: the faces of each band, in rising order."""
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
    return starts, members


@jit(nogil=True)
def _crossing(ax: float, ay: float, bx: float, slope: float, y: float) -> float:
    x = ax + (y - ay) * slope
    return min(max(x, min(ax, bx)), max(ax, bx))


@jit(nogil=True)
def _draw_face(
    points: Float64, faces: Int32, face: int, row0: int, depth: Float32, owner: Int32
) -> None:
    """Draw one face into a band that starts at sample row `row0`; the higher surface wins.

    Watertight: the corners are sorted by (y, x), so two faces that share an edge compute where it
    crosses a row from the same numbers in the same order, and both include that point.
    """
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
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
                owner[row, col] = face


@jit(nogil=True)
def _average_heights(
    depth: Float32, owner: Int32, times: int, height: Float32, samples: np.ndarray
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


@jit(nogil=True)
def _texel_plane(
    points: Float64, faces: Int32, uv: Float32, face: int, sx: float, sy: float, plane: Float64
) -> None:
    """Set `plane` to texel x = p0 + p1 col + p2 row, y = p3 + p4 col + p5 row, and their limits."""
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    ax, ay = points[a, 0], points[a, 1]
    bx, by = points[b, 0] - ax, points[b, 1] - ay
    cx, cy = points[c, 0] - ax, points[c, 1] - ay
    scale = 1.0 / (bx * cy - cx * by)
    for k in range(2):
        if k == 0:
            p, q, r = uv[face, 0, 0] * sx, uv[face, 1, 0] * sx, uv[face, 2, 0] * sx
        else:
            p, q = (1.0 - uv[face, 0, 1]) * sy, (1.0 - uv[face, 1, 1]) * sy
            r = (1.0 - uv[face, 2, 1]) * sy
        along_x = ((q - p) * cy - (r - p) * by) * scale
        along_y = (bx * (r - p) - cx * (q - p)) * scale
        plane[3 * k] = p - along_x * ax - along_y * ay
        plane[3 * k + 1] = along_x
        plane[3 * k + 2] = along_y
        plane[6 + 2 * k] = min(p, q, r)
        plane[7 + 2 * k] = max(p, q, r)


@jit(nogil=True)
def _neighbours(x: float, size: int, wrap: bool) -> tuple[int, int, float]:
    """Return the two texels whose centres lie around `x` [texels], and the share of the second."""
    x -= 0.5  # texel 0 spans 0 to 1: its centre is at 0.5
    first = math.floor(x)
    share = x - first
    second = first + 1
    if wrap:
        return first % size, second % size, share
    return min(max(first, 0), size - 1), min(max(second, 0), size - 1), share


@jit(nogil=True)
def _texel_mean(
    pixels: UInt8, seen: UInt8, offset: int, width: int, height: int, wrap: bool, x: float, y: float
) -> tuple[int, int, int]:
    """Bilinear color times 65536 at texel coordinates (x, y) of one page, over the seen texels.

    Red is -1 when the nearest texel is not seen. The page starts at texel `offset` of `pixels`.
    Whole numbers: fast, and their sums do not depend on order.
    """
    left, right, fx = _neighbours(x, width, wrap)
    top, bottom, fy = _neighbours(y, height, wrap)
    nw, ne = offset + top * width + left, offset + top * width + right
    sw, se = offset + bottom * width + left, offset + bottom * width + right
    fx *= 65536.0
    w_se = int(fx * fy)
    w_sw = int(65536.0 * fy) - w_se
    w_ne = int(fx) - w_se
    if seen.size > 0:
        w_nw = 65536 - w_se - w_sw - w_ne
        near = (sw if fx < 32768.0 else se) if fy >= 0.5 else (nw if fx < 32768.0 else ne)
        if seen[near] == 0:
            return -1, 0, 0
        w_nw, w_ne, w_sw, w_se = w_nw * seen[nw], w_ne * seen[ne], w_sw * seen[sw], w_se * seen[se]
        scale = 65536.0 / (w_nw + w_ne + w_sw + w_se)
        w_ne, w_sw, w_se = int(w_ne * scale), int(w_sw * scale), int(w_se * scale)
    w_nw = 65536 - w_se - w_sw - w_ne
    nw, ne, sw, se = 3 * nw, 3 * ne, 3 * sw, 3 * se
    red = w_nw * pixels[nw] + w_ne * pixels[ne] + w_sw * pixels[sw] + w_se * pixels[se]
    nw, ne, sw, se = nw + 1, ne + 1, sw + 1, se + 1
    green = w_nw * pixels[nw] + w_ne * pixels[ne] + w_sw * pixels[sw] + w_se * pixels[se]
    nw, ne, sw, se = nw + 1, ne + 1, sw + 1, se + 1
    blue = w_nw * pixels[nw] + w_ne * pixels[ne] + w_sw * pixels[sw] + w_se * pixels[se]
    return red, green, blue


@jit(nogil=True)
def _add_colors(
    row: int, col: int, red: float, green: float, blue: float, count: int, low: int, high: int,
    totals: Float32, tallies: np.ndarray,
) -> None:  # fmt: skip
    """Add `count` samples to a cell: sums of the colors, lowest and highest r + g + b."""
    totals[row, col, 0] += red
    totals[row, col, 1] += green
    totals[row, col, 2] += blue
    tallies[row, col, 0] += count
    tallies[row, col, 1] = min(tallies[row, col, 1], low)
    tallies[row, col, 2] = max(tallies[row, col, 2], high)


@jit(nogil=True)
def _shade_textures(
    points: Float64, faces: Int32, uv: Float32, face_page: Int32, pages: Float64,
    pixels: UInt8, seen: UInt8, owner: Int32, row0: int, times: int, first_row: int,
    totals: Float32, tallies: np.ndarray,
) -> None:  # fmt: skip
    """Add the colors of a band's visible samples that lie on the pages in memory.

    A row of `pages` is (offset in texels or -1, width, height, wrap, scale x, scale y).
    """
    plane = np.empty(10, np.float64)
    offset = width = height = 0
    wrap = here = False
    for i in range(owner.shape[0]):
        last = -1
        y = float(i + row0)
        row = first_row + i // times
        for col in range(owner.shape[1] // times):
            red = green = blue = 0
            count, low, high = 0, 765, 0
            for j in range(col * times, (col + 1) * times):
                face = owner[i, j]
                if face < 0:
                    continue
                if face != last:
                    last = face
                    page = face_page[face]
                    here = page >= 0 and pages[page, 0] >= 0.0
                    if here:
                        offset, wrap = int(pages[page, 0]), pages[page, 3] > 0.0
                        width, height = int(pages[page, 1]), int(pages[page, 2])
                        sx, sy = pages[page, 4], pages[page, 5]
                        _texel_plane(points, faces, uv, face, sx, sy, plane)
                if not here:
                    continue
                u = min(max(plane[0] + plane[1] * j + plane[2] * y, plane[6]), plane[7])
                v = min(max(plane[3] + plane[4] * j + plane[5] * y, plane[8]), plane[9])
                r, g, b = _texel_mean(pixels, seen, offset, width, height, wrap, u, v)
                if r >= 0:
                    red, green, blue = red + r, green + g, blue + b
                    grey = (r + g + b + 32768) >> 16
                    count, low, high = count + 1, min(low, grey), max(high, grey)
            if count > 0:
                _add_colors(row, col, red / 65536, green / 65536, blue / 65536, count, low, high, totals, tallies)


@jit(nogil=True)
def _shade_vertices(
    points: Float64, faces: Int32, colors: UInt8, face_page: Int32,
    owner: Int32, row0: int, times: int, first_row: int, totals: Float32, tallies: np.ndarray,
) -> None:  # fmt: skip
    """Add the interpolated vertex colors of a band's visible samples that have no page."""
    rgb = np.empty(3, np.float64)
    for i in range(owner.shape[0]):
        for j in range(owner.shape[1]):
            face = owner[i, j]
            if face < 0 or (face_page.size > 0 and face_page[face] >= 0):
                continue
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            ax, ay = points[a, 0], points[a, 1]
            bx, by = points[b, 0] - ax, points[b, 1] - ay
            cx, cy = points[c, 0] - ax, points[c, 1] - ay
            x, y = j - ax, i + row0 - ay
            area = bx * cy - cx * by
            second = min(max((x * cy - cx * y) / area, 0.0), 1.0)
            third = min(max((bx * y - x * by) / area, 0.0), 1.0 - second)
            first = 1.0 - second - third
            for k in range(3):
                rgb[k] = first * colors[a, k] + second * colors[b, k] + third * colors[c, k]
            grey = int(rgb[0] + rgb[1] + rgb[2] + 0.5)
            row, col = first_row + i // times, j // times
            _add_colors(row, col, rgb[0], rgb[1], rgb[2], 1, grey, grey, totals, tallies)


@jit(parallel=True, nogil=True)
def render(
    points: Float64, faces: Int32, starts: np.ndarray, members: Int32,
    rows: tuple[int, int], band_rows: int, times: int,
    height: Float32, samples: np.ndarray,
    uv: Float32, face_page: Int32, pages: Float64, pixels: UInt8, seen: UInt8,
    colors: UInt8, totals: Float32, tallies: np.ndarray,
) -> None:  # fmt: skip
    """Draw cell rows `rows` = (first, past the last); `rows[0]` is a multiple of `band_rows`.

    `height` and `samples` are those of the whole raster, `totals` and `tallies` (color sums, and
    what `_add_colors` says) start at ``rows[0]``. Empty arrays switch a part off: `height` when
    the heights are known already, `pixels` without pages in memory, `colors` without vertex
    colors.
    """
    n_cols = samples.shape[1]
    n_bands = (rows[1] - rows[0] + band_rows - 1) // band_rows
    for k in prange(n_bands):
        top = rows[0] + k * band_rows
        bottom = min(top + band_rows, rows[1])
        row0 = top * times
        depth = np.full(((bottom - top) * times, n_cols * times), -np.inf, np.float32)
        owner = np.full(((bottom - top) * times, n_cols * times), -1, np.int32)
        band = top // band_rows
        for m in range(starts[band], starts[band + 1]):
            _draw_face(points, faces, members[m], row0, depth, owner)
        if height.size > 0:
            _average_heights(depth, owner, times, height[top:bottom], samples[top:bottom])
        if pixels.size > 0:
            _shade_textures(
                points, faces, uv, face_page, pages, pixels, seen, owner, row0, times,
                top - rows[0], totals, tallies,
            )  # fmt: skip
        if colors.size > 0:
            _shade_vertices(
                points, faces, colors, face_page, owner, row0, times, top - rows[0],
                totals, tallies,
            )  # fmt: skip


@jit(parallel=True, nogil=True)
def color_means(
    totals: Float32, tallies: np.ndarray, least: int, color: UInt8, valid: Bool, still: Bool
) -> None:
    """Turn color sums into means where at least `least` samples were seen.

    `still` is set where all samples of a cell have one and the same color.
    """
    for row in prange(totals.shape[0]):
        for col in range(totals.shape[1]):
            count = tallies[row, col, 0]
            if count > 0 and count >= least:
                valid[row, col] = True
                still[row, col] = tallies[row, col, 1] == tallies[row, col, 2]
                for k in range(3):
                    color[row, col, k] = int(totals[row, col, k] / count + 0.5)
