"""Photographs of a heightfield: one ray a pixel, marched until it meets the ground."""

# ruff: noqa: PLR0913, PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import math

import numpy as np

from data_synth.seeing_kernels import image_gains, light_at, through_water
from meshreg.jit import jit, prange

BLOCK = 16  # samples


@jit(nogil=True, error_model="numpy")
def ceilings(z):
    """Return the highest sample of each block of 16 x 16 and its eight neighbours."""
    rows, cols = z.shape
    tall, wide = (rows + BLOCK - 1) // BLOCK, (cols + BLOCK - 1) // BLOCK
    own = np.full((tall, wide), -np.inf, np.float32)
    for i in range(rows):
        for j in range(cols):
            own[i // BLOCK, j // BLOCK] = max(own[i // BLOCK, j // BLOCK], z[i, j])
    out = own.copy()
    for i in range(tall):
        for j in range(wide):
            for k in range(max(i - 1, 0), min(i + 2, tall)):
                for m in range(max(j - 1, 0), min(j + 2, wide)):
                    out[i, j] = max(out[i, j], own[k, m])
    return out


@jit(nogil=True, error_model="numpy")
def march(z, high, step, west, north, centre, ray):
    """Return (row, col, found) where a ray from `centre` first meets the heightfield.

    Above the `ceilings` it leaps, below it goes by half a sample, then halves to a thirty-second.
    """
    rows, cols = z.shape
    if ray[2] >= -1e-6:
        return 0.0, 0.0, False
    flat = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1]) + 1e-9
    stride = 0.5 * step / max(flat, -0.5 * ray[2])
    t = low = 0.0
    for _ in range(20_000):
        x, y, h = centre[0] + t * ray[0], centre[1] + t * ray[1], centre[2] + t * ray[2]
        row, col = (north - y) / step, (x - west) / step
        if row < 0.0 or col < 0.0 or row > rows - 1 or col > cols - 1:
            return 0.0, 0.0, False
        i, j = int(row + 0.5), int(col + 0.5)
        if h <= z[i, j]:
            end = t
            for _ in range(4):
                t = 0.5 * (low + end)
                x, y, h = centre[0] + t * ray[0], centre[1] + t * ray[1], centre[2] + t * ray[2]
                row, col = (north - y) / step, (x - west) / step
                if h <= z[int(row + 0.5), int(col + 0.5)]:
                    end = t
                else:
                    low = t
            return row, col, True
        low = t
        gap = h - high[i // BLOCK, j // BLOCK]
        t += max(stride, min(BLOCK * step / flat, -gap / ray[2]) - stride)
    return 0.0, 0.0, False


@jit(parallel=True, nogil=True, error_model="numpy")
def photograph(z, soft, wide, albedo, step, west, north, centre, turn, focal, shape, image, plan):
    """Linear color (h, w, 3) f32 seen by a pinhole camera; black where nothing was met.

    `centre` (3,) [m] and `turn` (3, 3), rows the camera's right, down and forward in the world;
    `image` a number pair that tells images apart.
    """
    tall, wide_px = shape
    out = np.zeros((tall, wide_px, 3), np.float32)
    ceiling, gains = ceilings(z), image_gains(image, plan)
    high = centre[2] - z.mean()
    for v in prange(tall):
        for u in range(wide_px):
            a, b = (u + 0.5 - 0.5 * wide_px) / focal, (v + 0.5 - 0.5 * tall) / focal
            rx = turn[0, 0] * a + turn[1, 0] * b + turn[2, 0]
            ry = turn[0, 1] * a + turn[1, 1] * b + turn[2, 1]
            rz = turn[0, 2] * a + turn[1, 2] * b + turn[2, 2]
            row, col, found = march(z, ceiling, step, west, north, centre, (rx, ry, rz))
            if not found:
                continue
            i, j = int(row), int(col)
            i, j = min(i, z.shape[0] - 2), min(j, z.shape[1] - 2)
            fr, fc = row - i, col - j
            x, y = west + col * step, north - row * step
            away = (x - centre[0], y - centre[1])
            near_i, near_j = int(row + 0.5), int(col + 0.5)
            light = light_at(
                z, soft, wide, near_i, near_j, step, x, y, 1.0, away, high, image, plan
            )
            drop = centre[2] - z[near_i, near_j]
            view = math.sqrt(away[0] * away[0] + away[1] * away[1] + drop * drop)
            p, q, r, t = (1 - fr) * (1 - fc), (1 - fr) * fc, fr * (1 - fc), fr * fc
            a0, a1, b0, b1 = albedo[i, j], albedo[i, j + 1], albedo[i + 1, j], albedo[i + 1, j + 1]
            color = (
                p * a0[0] + q * a1[0] + r * b0[0] + t * b1[0],
                p * a0[1] + q * a1[1] + r * b0[1] + t * b1[1],
                p * a0[2] + q * a1[2] + r * b0[2] + t * b1[2],
            )
            through_water(color, light, view, high, gains, plan, out[v, u])
    return out


@jit(parallel=True, nogil=True, error_model="numpy")
def visible(points, z, step, west, north, centre):
    """Whether each world point (N, 3) is in the camera's sight, the heightfield allowing."""
    seen = np.zeros(points.shape[0], np.bool_)
    ceiling = ceilings(z)
    for k in prange(points.shape[0]):
        ray = (points[k, 0] - centre[0], points[k, 1] - centre[1], points[k, 2] - centre[2])
        row, col, found = march(z, ceiling, step, west, north, centre, ray)
        if found:
            dx = west + col * step - points[k, 0]
            dy = north - row * step - points[k, 1]
            seen[k] = dx * dx + dy * dy < (2.5 * step) ** 2
    return seen
