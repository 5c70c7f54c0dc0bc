"""Photographs of a heightfield: one ray a pixel, marched until it meets the ground."""

# ruff: noqa: PLR0913, PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import math

import numpy as np

from data_synth.seeing_kernels import light_at, through_water
from meshreg.jit import jit, prange


@jit(nogil=True, error_model="numpy")
def march(z, step, west, north, centre, ray, top):
    """Return (row, col, found) where a ray from `centre` first meets the heightfield.

    The ray is followed from height `top` down in steps of one sample, then halved to a sixteenth.
    """
    rows, cols = z.shape
    if ray[2] >= -1e-6:
        return 0.0, 0.0, False
    flat = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1])
    t = max(0.0, (top - centre[2]) / ray[2])
    stride = step / max(flat, -0.5 * ray[2])
    low = t
    for _ in range(4000):
        x, y, h = centre[0] + t * ray[0], centre[1] + t * ray[1], centre[2] + t * ray[2]
        row, col = (north - y) / step, (x - west) / step
        if row < 0.0 or col < 0.0 or row > rows - 1 or col > cols - 1:
            return 0.0, 0.0, False
        if h <= z[int(row + 0.5), int(col + 0.5)]:
            high = t
            for _ in range(4):
                t = 0.5 * (low + high)
                x, y, h = centre[0] + t * ray[0], centre[1] + t * ray[1], centre[2] + t * ray[2]
                row, col = (north - y) / step, (x - west) / step
                if h <= z[int(row + 0.5), int(col + 0.5)]:
                    high = t
                else:
                    low = t
            return row, col, True
        low = t
        t += stride
    return 0.0, 0.0, False


@jit(parallel=True, nogil=True, error_model="numpy")
def photograph(z, soft, wide, albedo, step, west, north, centre, turn, focal, shape, image, plan):
    """Linear colour (h, w, 3) f32 seen by a pinhole camera; black where nothing was met.

    `centre` (3,) [m] and `turn` (3, 3), rows the camera's right, down and forward in the world;
    `image` a number pair that tells images apart.
    """
    tall, wide_px = shape
    out = np.zeros((tall, wide_px, 3), np.float32)
    top = z.max()
    lowest = z.mean()
    high = centre[2] - lowest
    for v in prange(tall):
        for u in range(wide_px):
            a, b = (u + 0.5 - 0.5 * wide_px) / focal, (v + 0.5 - 0.5 * tall) / focal
            rx = turn[0, 0] * a + turn[1, 0] * b + turn[2, 0]
            ry = turn[0, 1] * a + turn[1, 1] * b + turn[2, 1]
            rz = turn[0, 2] * a + turn[1, 2] * b + turn[2, 2]
            row, col, found = march(z, step, west, north, centre, (rx, ry, rz), top)
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
            through_water(color, light, view, high, image, plan, out[v, u])
    return out


@jit(parallel=True, nogil=True, error_model="numpy")
def visible(points, z, step, west, north, centre):
    """Whether each world point (N, 3) is in the camera's sight, the heightfield allowing."""
    seen = np.zeros(points.shape[0], np.bool_)
    top = z.max()
    for k in prange(points.shape[0]):
        ray = (points[k, 0] - centre[0], points[k, 1] - centre[1], points[k, 2] - centre[2])
        row, col, found = march(z, step, west, north, centre, ray, top)
        if found:
            dx = west + col * step - points[k, 0]
            dy = north - row * step - points[k, 1]
            seen[k] = dx * dx + dy * dy < (2.5 * step) ** 2
    return seen
