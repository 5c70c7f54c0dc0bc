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
from meshreg.records import Bool, Float32, Float64, Int32, UInt8

UInt32 = NDArray[np.uint32]
SEEN = 0xFF000000


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
    texels that u = 0 to 1 spans, texels that v spans). A texel is red + 256 green + 65536 blue,
    and `SEEN` on top where it has a color.
    """

    table: Float64  # (P, 6)
    texels: UInt32


class BandPlace(NamedTuple):
    """First sample row of a band, samples to a cell, first cell row within the sums."""

    row0: int
    times: int
    first: int


class ColorSums(NamedTuple):
    """Per cell: sums of red, green, blue; count of samples, lowest and highest r + g + b."""

    totals: Float32  # (rows, cols, 3)
    tallies: NDArray[np.uint16]  # (rows, cols, 3)


class ColorArrays(NamedTuple):
    """The whole raster's colors; `still` where all samples of a cell have one and the same."""

    color: UInt8  # (H, W, 3)
    valid: Bool  # (H, W)
    still: Bool  # (H, W)


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
def _spread(texel: int) -> int:
    """Move the three colors of a texel 20 bits apart: room for 12 bits of weight each."""
    return (texel & 0xFF) | ((texel & 0xFF00) << 12) | ((texel & 0xFF0000) << 24)


@jit(nogil=True, inline="always")
def _bilinear(
    texels: UInt32, offset: int, size: tuple[int, int], wrap: bool, x: float, y: float
) -> int:
    """Color at (x, y) of the page that starts at texel `offset`, over the texels that are seen.

    The answer is 4096 times red, green and blue, 20 bits apart: one multiplication does for all
    three, and sums of whole numbers do not depend on order. -1 when the nearest texel is not seen.
    """
    width, height = size
    left, top = int(x), int(y)
    fx, fy = 4096.0 * (x - left), y - top
    right, bottom = left + 1, top + 1
    if wrap:
        left, right, top, bottom = left % width, right % width, top % height, bottom % height
    else:
        right, bottom = min(right, width - 1), min(bottom, height - 1)
    top, bottom = offset + top * width, offset + bottom * width
    nw, ne = int(texels[top + left]), int(texels[top + right])
    sw, se = int(texels[bottom + left]), int(texels[bottom + right])
    w_se = int(fx * fy + 0.5)
    w_sw = int(4096.0 * fy + 0.5) - w_se
    w_ne = int(fx + 0.5) - w_se
    if nw & ne & sw & se < SEEN:
        near = (sw if fx < 2048.0 else se) if fy >= 0.5 else (nw if fx < 2048.0 else ne)
        if near < SEEN:
            return -1
        w_nw = (4096 - w_se - w_sw - w_ne) * (nw // SEEN)
        w_ne, w_sw, w_se = w_ne * (ne // SEEN), w_sw * (sw // SEEN), w_se * (se // SEEN)
        scale = 4096.0 / (w_nw + w_ne + w_sw + w_se)
        w_ne, w_sw, w_se = int(w_ne * scale), int(w_sw * scale), int(w_se * scale)
        if nw < SEEN:  # what rounding leaves over goes to a texel that is seen
            rest = 4096 - w_ne - w_sw - w_se
            w_ne, w_sw, w_se = (
                (w_ne + rest, w_sw, w_se) if w_ne > 0
                else (w_ne, w_sw + rest, w_se) if w_sw > 0
                else (w_ne, w_sw, w_se + rest)
            )  # fmt: skip
    w_nw = 4096 - w_se - w_sw - w_ne
    return w_nw * _spread(nw) + w_ne * _spread(ne) + w_sw * _spread(sw) + w_se * _spread(se)


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
                rgb = _bilinear(pages.texels, offset, (width, height), wrap, u, v)
                if rgb >= 0:
                    r, g, b = rgb & 0xFFFFF, (rgb >> 20) & 0xFFFFF, rgb >> 40
                    red, green, blue = red + r, green + g, blue + b
                    grey = (r + g + b + 2048) >> 12
                    count, low, high = count + 1, min(low, grey), max(high, grey)
            if count > 0:
                totals[row, col, 0] += red / 4096
                totals[row, col, 1] += green / 4096
                totals[row, col, 2] += blue / 4096
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


@jit(nogil=True)
def no_sums(rows: int, cols: int) -> ColorSums:
    """Return sums of nothing."""
    tallies = np.zeros((rows, cols, 3), np.uint16)
    tallies[:, :, 1] = 65535
    return ColorSums(np.zeros((rows, cols, 3), np.float32), tallies)


@jit(nogil=True)
def row_means(sums: ColorSums, row: int, least: int, out: ColorArrays, out_row: int) -> None:
    """Turn a row of color sums into means where at least `least` samples were seen."""
    for col in range(out.color.shape[1]):
        count = sums.tallies[row, col, 0]
        if count >= least:
            out.valid[out_row, col] = True
            out.still[out_row, col] = sums.tallies[row, col, 1] == sums.tallies[row, col, 2]
            for k in range(3):
                out.color[out_row, col, k] = int(sums.totals[row, col, k] / count + 0.5)


@jit(parallel=True, nogil=True)
def color_means(sums: ColorSums, least: int, out: ColorArrays, first: int) -> None:
    """Turn color sums, whose first row is the raster's row `first`, into means."""
    for row in prange(sums.totals.shape[0]):
        row_means(sums, row, least, out, first + row)
