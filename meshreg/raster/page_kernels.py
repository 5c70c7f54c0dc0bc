"""Numba loops on texture pages: which texels a mesh uses, packing, means of blocks of texels."""

from __future__ import annotations

import math

import numpy as np

from meshreg.jit import jit, prange
from meshreg.raster.shade_kernels import SEEN, UInt32
from meshreg.records import Float32, Float64, Int32, UInt8


@jit(parallel=True, nogil=True)
def page_spans(uv: Float32, face_page: Int32, n_pages: int) -> Float64:
    """Return the lowest and highest (u, v) on each page, (P, 2, 2); infinite where unused."""
    n_faces, n_parts = face_page.shape[0], 16
    parts = np.empty((n_parts, n_pages, 2, 2), np.float64)
    parts[:, :, 0] = np.inf
    parts[:, :, 1] = -np.inf
    for part in prange(n_parts):
        for f in range(part * n_faces // n_parts, (part + 1) * n_faces // n_parts):
            page = face_page[f]
            if page >= 0:
                for corner in range(3):
                    for k in range(2):
                        value = uv[f, corner, k]
                        parts[part, page, 0, k] = min(parts[part, page, 0, k], value)
                        parts[part, page, 1, k] = max(parts[part, page, 1, k], value)
    spans: Float64 = parts[0].copy()
    for part in range(1, n_parts):
        spans[:, 0] = np.minimum(spans[:, 0], parts[part, :, 0])
        spans[:, 1] = np.maximum(spans[:, 1], parts[part, :, 1])
    return spans


@jit(parallel=True, nogil=True, error_model="numpy")
def covered(uv: Float32, face_page: Int32, page: int, size: tuple[int, int], workers: int) -> UInt8:
    """Set to 1 the texels of a page of `size` (height, width) that its faces touch.

    Two workers may set one texel; both set it to the same.
    """
    height, width = size
    used = np.zeros((height, width), np.uint8)
    n_faces = face_page.shape[0]
    for worker in prange(workers):
        for f in range(worker * n_faces // workers, (worker + 1) * n_faces // workers):
            if face_page[f] != page:
                continue
            x0, x1, x2 = uv[f, 0, 0] * width, uv[f, 1, 0] * width, uv[f, 2, 0] * width
            y0 = (1.0 - uv[f, 0, 1]) * height
            y1 = (1.0 - uv[f, 1, 1]) * height
            y2 = (1.0 - uv[f, 2, 1]) * height
            if y0 > y1:
                x0, y0, x1, y1 = x1, y1, x0, y0
            if y1 > y2:
                x1, y1, x2, y2 = x2, y2, x1, y1
            if y0 > y1:
                x0, y0, x1, y1 = x1, y1, x0, y0
            whole = (x2 - x0) / (y2 - y0) if y2 > y0 else 0.0
            upper = (x1 - x0) / (y1 - y0) if y1 > y0 else 0.0
            lower = (x2 - x1) / (y2 - y1) if y2 > y1 else 0.0
            for row in range(max(math.floor(y0), 0), min(math.floor(y2), height - 1) + 1):
                top, bottom = max(y0, float(row)), min(y2, row + 1.0)
                a, b = x0 + (top - y0) * whole, x0 + (bottom - y0) * whole
                c = x0 + (top - y0) * upper if top < y1 else x1 + (top - y1) * lower
                d = x0 + (bottom - y0) * upper if bottom < y1 else x1 + (bottom - y1) * lower
                west, east = min(a, b, c, d), max(a, b, c, d)
                if top <= y1 <= bottom:
                    west, east = min(west, x1), max(east, x1)
                if y2 == y0:  # level: the others do not reach its third corner
                    west, east = min(west, x2), max(east, x2)
                for col in range(max(math.floor(west), 0), min(math.floor(east), width - 1) + 1):
                    used[row, col] = 1
    return used


@jit(parallel=True, nogil=True)
def packed(image: UInt8, out: UInt32) -> None:
    """Write a page (h, w, 3 or 4) as texels; those with alpha under 128 are not seen."""
    height, width, channels = image.shape
    for row in prange(height):
        for col in range(width):
            texel = image[row, col, 0] | image[row, col, 1] << 8 | image[row, col, 2] << 16
            if channels == 3 or image[row, col, 3] >= 128:
                texel |= SEEN
            out[row * width + col] = texel


@jit(parallel=True, nogil=True)
def shrunk(image: UInt8, used: UInt8, times: int, out: UInt32) -> None:
    """Write the means of blocks of `times` × `times` texels over those that are used and seen.

    A block is seen where at least half of its used texels are.
    """
    height, width, channels = image.shape
    rows, cols = (height + times - 1) // times, (width + times - 1) // times
    for row in prange(rows):
        for col in range(cols):
            red, green, blue, count, mine = 0, 0, 0, 0, 0
            for i in range(row * times, min((row + 1) * times, height)):
                for j in range(col * times, min((col + 1) * times, width)):
                    mine += used[i, j]
                    if used[i, j] and (channels == 3 or image[i, j, 3] >= 128):
                        red += image[i, j, 0]
                        green += image[i, j, 1]
                        blue += image[i, j, 2]
                        count += 1
            out[row * cols + col] = 0
            if count > 0 and 2 * count >= mine:
                half = count // 2
                red, green, blue = (
                    (red + half) // count,
                    (green + half) // count,
                    (blue + half) // count,
                )
                out[row * cols + col] = red | green << 8 | blue << 16 | SEEN
