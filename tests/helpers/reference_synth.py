"""Slow, readable twins of the generator's compiled loops."""

from __future__ import annotations

import math

import numpy as np

MASK = 0xFFFFFFFF


def hash2(ix: int, iy: int, seed: int) -> int:
    """MurmurHash3's finaliser over a lattice point and a seed, as an unsigned 32-bit number."""
    h = (ix * 0x9E3779B1 ^ iy * 0x85EBCA77 ^ seed * 0xC2B2AE3D) & MASK
    h = (h ^ (h >> 16)) * 0x85EBCA6B & MASK
    h = (h ^ (h >> 13)) * 0xC2B2AE35 & MASK
    return h ^ (h >> 16)


def signed16(value: int) -> int:
    return value - 0x10000 if value & 0x8000 else value


def gradient_noise(x: float, y: float, seed: int) -> float:
    """Perlin's noise: gradients of four corners, blended by the quintic."""
    ix, iy = math.floor(x), math.floor(y)
    u, v = x - ix, y - iy
    total = 0.0
    for j in (0, 1):
        for i in (0, 1):
            h = hash2(ix + i, iy + j, seed)
            gradient = signed16(h >> 16) / 32768, signed16(h & 0xFFFF) / 32768
            ramp = gradient[0] * (u - i) + gradient[1] * (v - j)
            a, b = (u if i else 1 - u), (v if j else 1 - v)
            total += fade(a) * fade(b) * ramp
    return total


def fade(t: float) -> float:
    return t**3 * (t * (t * 6 - 15) + 10)


def octaves(x, y, seed, wavelength, finest, gain, count) -> float:
    total, angle = 0.0, math.atan2(0.6018150231520483, 0.7986355100472928)
    for k in range(count):
        length = wavelength / 2**k
        if length < finest:
            break
        weight = min(1.0, (length - finest) / finest) if finest > 0 else 1.0
        c, s = math.cos(k * angle), math.sin(k * angle)
        at = (c * x - s * y) * 2 / length, (s * x + c * y) * 2 / length
        total += 5.85 * gain**k * weight * gradient_noise(*at, seed + 101 * k)
    return total


def lump(x: float, y: float, ix: int, iy: int, seed: int, presence: float) -> float:
    """Height at (x, y) of the one lump that belongs to a lattice cell."""
    h = hash2(ix, iy, seed)
    if (h & 255) >= presence * 256:
        return 0.0
    dx, dy = x - ix - (h >> 20) / 4096, y - iy - (h >> 8 & 4095) / 4096
    k = (h ^ h >> 15) * 0x2C1B3C6D & MASK
    k = (k ^ k >> 12) * 0x297A2D39 & MASK
    k ^= k >> 15
    radius = 1 / (2 + 1.57 * (k & 255) / 256)
    t = (k >> 8 & 255) / 128 - 1
    turn, side = 1 - t * t * (1.2234 - 0.2234 * t * t), t * (1.5708 - 0.5708 * t * t)
    stretch = 1 + 0.5 * (k >> 16 & 255) / 256
    a, b = (turn * dx + side * dy) / radius, (turn * dy - side * dx) / radius * stretch
    w = max(0.0, 1 - a * a - b * b)
    return (0.45 + 0.55 * (k >> 24 & 127) / 128) * 1.12 * w / (w + 0.12)


def lumps(x: float, y: float, seed: int, presence: float) -> float:
    """The highest lump of all within two cells: more than enough."""
    ix, iy = math.floor(x), math.floor(y)
    cells = [(ix + i, iy + j) for i in range(-2, 3) for j in range(-2, 3)]
    return max(lump(x, y, *cell, seed, presence) for cell in cells)


def bend(q, truth_warp) -> np.ndarray:
    """The warp at points (N, 2), from the numbers in truth.json alone."""
    x, y = q[:, 0], q[:, 1]
    poly, waves = np.array(truth_warp["poly"]), np.array(truth_warp["waves"])
    d = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1) @ poly.T
    phase = q[:, :2] @ waves.T
    return (
        d
        + np.cos(phase) @ np.array(truth_warp["cosines"])
        + np.sin(phase) @ np.array(truth_warp["sines"])
    )


def reference_from_moving(points, truth_warp) -> np.ndarray:
    """The formula in truth.json, word for word."""
    q = (points - np.array(truth_warp["start"])) @ np.array(truth_warp["linear"]).T
    return np.array(truth_warp["centre"]) + q + bend(q, truth_warp)


def nearest_surface(z, step, west, north, centre, ray, fine=20_000):
    """Where a ray first meets a heightfield of flat cells: by very small steps."""
    t = np.linspace(0, 1.5 * (centre[2] - z.min()) / -ray[2], fine)
    x, y, h = (centre[k] + t * ray[k] for k in range(3))
    row, col = np.rint((north - y) / step).astype(int), np.rint((x - west) / step).astype(int)
    inside = (row >= 0) & (col >= 0) & (row < z.shape[0]) & (col < z.shape[1])
    met = np.flatnonzero(inside & (h <= z[row * inside, col * inside]))
    return None if len(met) == 0 else (x[met[0]], y[met[0]])
