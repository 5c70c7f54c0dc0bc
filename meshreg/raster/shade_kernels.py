"""Numba loops that give visible samples their color: texture pages and vertex colors.

Coordinates are in samples of the fine lattice, as in `meshreg.raster.kernels`. Texture
coordinates have u = 0 at the left edge of texel 0 (its centre is half a texel further) and v
upward from the page's lower edge. Colors are averaged as the numbers that the file holds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from meshreg.jit import jit, prange
from meshreg.types import Bool, Float32, Float64, Int32, UInt8


class MeshArrays(NamedTuple):
    """A mesh on the fine lattice; `uv`, `face_page` and `colors` may be empty."""

    points: Float64  # (V, 3): column, row, height
    faces: Int32  # (F, 3)
    uv: Float32  # (F, 3, 2)
    face_page: Int32  # (F,), -1 for no page
    colors: UInt8  # (V, 3)


class Pages(NamedTuple):
    """Decoded texture pages, one after the other.

    A row of `table` is (offset in texels or -1 when not in memory, width, height, 1 to wrap,
    texels that u = 0 to 1 spans, texels that v spans). `seen` is empty or 0 where a texel has no
    color.
    """

    table: Float64  # (P, 6)
    pixels: UInt8  # (3 times the texels,)
    seen: UInt8  # (texels,)


class BandPlace(NamedTuple):
    """First sample row of a band, samples to a cell, first cell row within the sums."""

    row0: int
    times: int
    first: int


class ColorSums(NamedTuple):
    """Per cell: sums of red, green, blue; count of samples, lowest and highest r + g + b."""

    totals: Float32  # (rows, cols, 3)
    tallies: NDArray[np.uint16]  # (rows, cols, 3)


@jit(nogil=True)
def _texel_plane(mesh: MeshArrays, face: int, page: Float64, plane: Float64) -> None:
    """Set `plane` to texel x = p0 + p1 col + p2 row, y = p3 + p4 col + p5 row, and their limits.

    Whole numbers are texel centres (texel 0 spans 0 to 1 of the page, its centre is at 0.5). The
    limits are those of the face's corners, and of the page unless it wraps; a page that wraps is
    shifted by whole widths, so that all numbers are positive.
    """
    a, b, c = mesh.faces[face, 0], mesh.faces[face, 1], mesh.faces[face, 2]
    points, uv = mesh.points, mesh.uv
    ax, ay = points[a, 0], points[a, 1]
    bx, by = points[b, 0] - ax, points[b, 1] - ay
    cx, cy = points[c, 0] - ax, points[c, 1] - ay
    scale = 1.0 / (bx * cy - cx * by)
    for k in range(2):
        size, times = page[1 + k], page[4 + k]
        p, q, r = uv[face, 0, k], uv[face, 1, k], uv[face, 2, k]
        if k == 1:
            p, q, r = 1.0 - p, 1.0 - q, 1.0 - r
        p, q, r = p * times - 0.5, q * times - 0.5, r * times - 0.5
        low, high = min(p, q, r), max(p, q, r)
        if page[3] > 0.0:
            shift = -size * math.floor(low / size)
            p, q, r, low, high = p + shift, q + shift, r + shift, low + shift, high + shift
        else:
            low = min(max(low, 0.0), size - 1.0)
            high = min(max(high, 0.0), size - 1.0)
        along_x = ((q - p) * cy - (r - p) * by) * scale
        along_y = (bx * (r - p) - cx * (q - p)) * scale
        plane[3 * k] = p - along_x * ax - along_y * ay
        plane[3 * k + 1] = along_x
        plane[3 * k + 2] = along_y
        plane[6 + 2 * k] = low
        plane[7 + 2 * k] = high


@jit(nogil=True, inline="always")
def _bilinear(
    pixels: UInt8, seen: UInt8, offset: int, size: tuple[int, int], wrap: bool, x: float, y: float
) -> tuple[int, int, int]:
    """Color times 65536 at (x, y) of the page that starts at texel `offset`, over its seen texels.

    Red is -1 when the nearest texel is not seen. Whole numbers: their sums do not depend on order.
    """
    width, height = size
    left, top = int(x), int(y)
    fx, fy = 65536.0 * (x - left), y - top
    right, bottom = left + 1, top + 1
    if wrap:
        left, right, top, bottom = left % width, right % width, top % height, bottom % height
    else:
        right, bottom = min(right, width - 1), min(bottom, height - 1)
    nw, ne = offset + top * width + left, offset + top * width + right
    sw, se = offset + bottom * width + left, offset + bottom * width + right
    w_se = int(fx * fy)
    w_sw = int(65536.0 * fy) - w_se
    w_ne = int(fx) - w_se
    w_nw = 65536 - w_se - w_sw - w_ne
    if seen.size > 0:
        near = (sw if fx < 32768.0 else se) if fy >= 0.5 else (nw if fx < 32768.0 else ne)
        if seen[near] == 0:
            return -1, 0, 0
        w_nw, w_ne, w_sw, w_se = w_nw * seen[nw], w_ne * seen[ne], w_sw * seen[sw], w_se * seen[se]
        scale = 65536.0 / (w_nw + w_ne + w_sw + w_se)
        w_ne, w_sw, w_se = int(w_ne * scale), int(w_sw * scale), int(w_se * scale)
        w_nw = 65536 - w_se - w_sw - w_ne
    nw, ne, sw, se = 3 * nw, 3 * ne, 3 * sw, 3 * se
    return (
        w_nw * pixels[nw] + w_ne * pixels[ne] + w_sw * pixels[sw] + w_se * pixels[se],
        w_nw * pixels[nw + 1] + w_ne * pixels[ne + 1]
        + w_sw * pixels[sw + 1] + w_se * pixels[se + 1],
        w_nw * pixels[nw + 2] + w_ne * pixels[ne + 2]
        + w_sw * pixels[sw + 2] + w_se * pixels[se + 2],
    )  # fmt: skip


@jit(nogil=True)
def shade_textures(
    mesh: MeshArrays, members: Int32, pages: Pages, owner: Int32, place: BandPlace, sums: ColorSums
) -> None:
    """Add the colors of a band's visible samples that lie on the pages in memory.

    `owner` counts within `members`, the band's faces.
    """
    times, totals, tallies = place.times, sums.totals, sums.tallies
    planes = np.empty((members.shape[0], 10), np.float64)  # of a face when it is first seen
    page_of = np.full(members.shape[0], -2, np.int32)  # -2: not seen yet, -1: not in memory
    page = -1
    offset = width = height = 0
    wrap = False
    u0 = u_col = u_row = v0 = v_col = v_row = u_low = u_high = v_low = v_high = 0.0
    for i in range(owner.shape[0]):
        last = -1
        y = float(i + place.row0)
        row = place.first + i // times
        for col in range(owner.shape[1] // times):
            red = green = blue = 0
            count, low, high = 0, 765, 0
            for j in range(col * times, (col + 1) * times):
                mine = owner[i, j]
                if mine < 0:
                    continue
                if mine != last:
                    last = mine
                    page = page_of[mine]
                    if page == -2:
                        page = mesh.face_page[members[mine]]
                        if page >= 0 and pages.table[page, 0] < 0.0:
                            page = -1
                        page_of[mine] = page
                        if page >= 0:
                            _texel_plane(mesh, members[mine], pages.table[page], planes[mine])
                    if page >= 0:
                        offset, wrap = int(pages.table[page, 0]), pages.table[page, 3] > 0.0
                        width, height = int(pages.table[page, 1]), int(pages.table[page, 2])
                        u0, u_col, u_row = planes[mine, 0], planes[mine, 1], planes[mine, 2]
                        v0, v_col, v_row = planes[mine, 3], planes[mine, 4], planes[mine, 5]
                        u_low, u_high = planes[mine, 6], planes[mine, 7]
                        v_low, v_high = planes[mine, 8], planes[mine, 9]
                if page < 0:
                    continue
                u = min(max(u0 + u_col * j + u_row * y, u_low), u_high)
                v = min(max(v0 + v_col * j + v_row * y, v_low), v_high)
                r, g, b = _bilinear(pages.pixels, pages.seen, offset, (width, height), wrap, u, v)
                if r >= 0:
                    red, green, blue = red + r, green + g, blue + b
                    grey = (r + g + b + 32768) >> 16
                    count, low, high = count + 1, min(low, grey), max(high, grey)
            if count > 0:
                totals[row, col, 0] += red / 65536
                totals[row, col, 1] += green / 65536
                totals[row, col, 2] += blue / 65536
                tallies[row, col, 0] += count
                tallies[row, col, 1] = min(tallies[row, col, 1], low)
                tallies[row, col, 2] = max(tallies[row, col, 2], high)


@jit(nogil=True)
def shade_vertices(
    mesh: MeshArrays, members: Int32, owner: Int32, place: BandPlace, sums: ColorSums
) -> None:
    """Add the interpolated vertex colors of a band's visible samples that have no page."""
    points, totals, tallies = mesh.points, sums.totals, sums.tallies
    for i in range(owner.shape[0]):
        for j in range(owner.shape[1]):
            if owner[i, j] < 0:
                continue
            face = members[owner[i, j]]
            if mesh.face_page.size > 0 and mesh.face_page[face] >= 0:
                continue
            a, b, c = mesh.faces[face, 0], mesh.faces[face, 1], mesh.faces[face, 2]
            ax, ay = points[a, 0], points[a, 1]
            bx, by = points[b, 0] - ax, points[b, 1] - ay
            cx, cy = points[c, 0] - ax, points[c, 1] - ay
            x, y = j - ax, i + place.row0 - ay
            area = bx * cy - cx * by
            second = min(max((x * cy - cx * y) / area, 0.0), 1.0)
            third = min(max((bx * y - x * by) / area, 0.0), 1.0 - second)
            first = 1.0 - second - third
            row, col = place.first + i // place.times, j // place.times
            sum_rgb = 0.0
            for k in range(3):
                value = (
                    first * mesh.colors[a, k]
                    + second * mesh.colors[b, k]
                    + third * mesh.colors[c, k]
                )
                totals[row, col, k] += value
                sum_rgb += value
            grey = int(sum_rgb + 0.5)
            tallies[row, col, 0] += 1
            tallies[row, col, 1] = min(tallies[row, col, 1], grey)
            tallies[row, col, 2] = max(tallies[row, col, 2], grey)


@jit(parallel=True, nogil=True)
def color_means(sums: ColorSums, least: int, color: UInt8, valid: Bool, still: Bool) -> None:
    """Turn color sums into means where at least `least` samples were seen.

    `still` is set where all samples of a cell have one and the same color.
    """
    for row in prange(color.shape[0]):
        for col in range(color.shape[1]):
            count = sums.tallies[row, col, 0]
            if count >= least:
                valid[row, col] = True
                still[row, col] = sums.tallies[row, col, 1] == sums.tallies[row, col, 2]
                for k in range(3):
                    color[row, col, k] = int(sums.totals[row, col, k] / count + 0.5)


@jit(nogil=True)
def page_spans(uv: Float32, face_page: Int32, n_pages: int) -> Float64:
    """Return the lowest and highest (u, v) on each page, (P, 2, 2); infinite where unused."""
    spans = np.empty((n_pages, 2, 2), np.float64)
    spans[:, 0] = np.inf
    spans[:, 1] = -np.inf
    for f in range(face_page.shape[0]):
        page = face_page[f]
        if page >= 0:
            for corner in range(3):
                for k in range(2):
                    value = uv[f, corner, k]
                    spans[page, 0, k] = min(spans[page, 0, k], value)
                    spans[page, 1, k] = max(spans[page, 1, k], value)
    return spans


@jit(parallel=True, nogil=True)
def covered(uv: Float32, face_page: Int32, page: int, size: tuple[int, int], workers: int) -> UInt8:
    """Set to 1 the texels of a page of `size` (height, width) that its faces touch.

    Each worker looks at all faces and keeps to its own stripe of rows.
    """
    height, width = size
    used = np.zeros((height, width), np.uint8)
    for worker in prange(workers):
        top_row, end_row = worker * height // workers, (worker + 1) * height // workers
        x = np.empty(3, np.float64)
        y = np.empty(3, np.float64)
        for f in range(face_page.shape[0]):
            if face_page[f] != page:
                continue
            for k in range(3):
                y[k] = (1.0 - uv[f, k, 1]) * height
            first = max(math.floor(min(y[0], y[1], y[2])), top_row)
            last = min(math.floor(max(y[0], y[1], y[2])), end_row - 1)
            if first > last:
                continue
            for k in range(3):
                x[k] = uv[f, k, 0] * width
            for row in range(first, last + 1):
                west, east = _span_in_row(x, y, float(row))
                for col in range(max(math.floor(west), 0), min(math.floor(east), width - 1) + 1):
                    used[row, col] = 1
    return used


@jit(nogil=True)
def _span_in_row(x: Float64, y: Float64, row: float) -> tuple[float, float]:
    """From where to where a triangle reaches between y = row and row + 1; infinite: nowhere."""
    west, east = np.inf, -np.inf
    for k in range(3):
        m = (k + 1) % 3
        ax, ay, bx, by = x[k], y[k], x[m], y[m]
        if ay > by:
            ax, ay, bx, by = bx, by, ax, ay
        top, bottom = max(ay, row), min(by, row + 1.0)
        if top <= bottom:  # this edge passes here
            slope = (bx - ax) / (by - ay) if by > ay else 0.0
            one = ax + (top - ay) * slope
            two = ax + (bottom - ay) * slope if by > ay else bx
            west, east = min(west, one, two), max(east, one, two)
    return west, east


@jit(parallel=True, nogil=True)
def shrunk(image: UInt8, used: UInt8, seen: UInt8, times: int) -> tuple[UInt8, UInt8]:
    """Average `times` × `times` texels over those that are seen.

    The second result is 1 where at least half of the block's used texels are seen.
    """
    height, width = seen.shape
    rows, cols = (height + times - 1) // times, (width + times - 1) // times
    out = np.zeros((rows, cols, 3), np.uint8)
    out_seen = np.zeros((rows, cols), np.uint8)
    for row in prange(rows):
        for col in range(cols):
            red, green, blue, count, mine = 0, 0, 0, 0, 0
            for i in range(row * times, min((row + 1) * times, height)):
                for j in range(col * times, min((col + 1) * times, width)):
                    mine += used[i, j]
                    if seen[i, j]:
                        red += image[i, j, 0]
                        green += image[i, j, 1]
                        blue += image[i, j, 2]
                        count += 1
            if count > 0 and 2 * count >= mine:
                half = count // 2
                out[row, col, 0] = (red + half) // count
                out[row, col, 1] = (green + half) // count
                out[row, col, 2] = (blue + half) // count
                out_seen[row, col] = 1
    return out, out_seen
