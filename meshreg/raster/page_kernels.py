"""Numba loops on texture pages: which texels a mesh uses, packing, means of blocks of texels."""

from __future__ import annotations

import math

import numpy as np

from meshreg.jit import jit, prange
from meshreg.raster.shade_kernels import SEEN, UInt32
from meshreg.types import Float32, Float64, Int32, UInt8


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
