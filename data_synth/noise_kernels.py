"""Noise that can be asked for anywhere: hashed lattices, no table, no period.

Every function is a pure function of position and seed. Coordinates are in units of the lattice
(metres divided by the wavelength), float64, so that a survey at UTM coordinates loses nothing.

Gradient noise after Perlin, "Improving noise", SIGGRAPH 2002 (quintic fade), with gradients from
an integer hash instead of a permutation table; the hash is the finaliser of MurmurHash3.
"""

from __future__ import annotations

import numpy as np

from meshreg.jit import jit

_HALF = 1.0 / 32768.0
_UNIT = 1.0 / 4294967296.0
_NORM = 5.85  # makes each octave's standard deviation 1


@jit(nogil=True)
def hash2(ix, iy, seed):
    """Return 32 well-mixed bits for a lattice point and a seed."""
    h = (
        np.uint32(np.int64(ix)) * np.uint32(0x9E3779B1)
        ^ np.uint32(np.int64(iy)) * np.uint32(0x85EBCA77)
        ^ np.uint32(np.int64(seed)) * np.uint32(0xC2B2AE3D)
    )
    h = np.uint32(h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    h = np.uint32(h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    return np.uint32(h ^ (h >> np.uint32(16)))


@jit(nogil=True)
def hash01(ix, iy, seed):
    """Return a number in [0, 1) for a lattice point and a seed."""
    return np.float64(hash2(ix, iy, seed)) * _UNIT


@jit(nogil=True)
def _corner(ix, iy, seed, dx, dy):
    h = hash2(ix, iy, seed)
    gx = np.float64(h & np.uint32(0xFFFF)) * _HALF - 1.0
    gy = np.float64(h >> np.uint32(16)) * _HALF - 1.0
    return gx * dx + gy * dy


@jit(nogil=True)
def gradient_noise(x, y, seed):
    """Smooth noise of mean 0 and standard deviation about 0.17, wavelength about 2 units."""
    fx, fy = np.floor(x), np.floor(y)
    ix, iy = np.int64(fx), np.int64(fy)
    u, v = x - fx, y - fy
    su = u * u * u * (u * (u * 6.0 - 15.0) + 10.0)
    sv = v * v * v * (v * (v * 6.0 - 15.0) + 10.0)
    south = _corner(ix, iy, seed, u, v)
    south += su * (_corner(ix + 1, iy, seed, u - 1.0, v) - south)
    north = _corner(ix, iy + 1, seed, u, v - 1.0)
    north += su * (_corner(ix + 1, iy + 1, seed, u - 1.0, v - 1.0) - north)
    return south + sv * (north - south)


@jit(nogil=True)
def octaves(x, y, seed, wavelength, finest, gain, count):
    """Sum `count` octaves from `wavelength` [m] down, each `gain` times the one before.

    Octaves shorter than `finest` [m] are faded out: their area mean over a sample is near zero.
    Each octave is turned by an irrational angle, so that no lattice direction shows.
    """
    total, amplitude = 0.0, 1.0
    c, s = 1.0, 0.0
    for k in range(count):
        if wavelength < finest:
            break
        fade = min(1.0, (wavelength - finest) / finest) if finest > 0 else 1.0
        scale = 2.0 / wavelength
        total += (
            amplitude
            * fade
            * gradient_noise((c * x - s * y) * scale, (s * x + c * y) * scale, seed + 101 * k)
        )
        c, s = c * 0.7986355 - s * 0.6018150, s * 0.7986355 + c * 0.6018150
        amplitude *= gain
        wavelength *= 0.5
    return total * _NORM


@jit(nogil=True)
def lumps(x, y, seed, presence):
    """Rounded lumps, one or none a lattice cell: height 0..1, and the lump's own random number.

    A lump's radius is at most half a cell, so the four cells nearest the point are enough. The
    profile is that of a flattened dome with a steep foot, as coral rock has.
    """
    fx, fy = np.floor(x), np.floor(y)
    ix, iy = np.int64(fx), np.int64(fy)
    if x - fx < 0.5:
        ix -= 1
    if y - fy < 0.5:
        iy -= 1
    best, own = 0.0, 0.0
    for j in range(iy, iy + 2):
        for i in range(ix, ix + 2):
            h = hash2(i, j, seed)
            if np.float64(h & np.uint32(0xFF)) >= presence * 256.0:
                continue
            dx = x - i - np.float64(h >> np.uint32(20)) / 4096.0
            dy = y - j - np.float64((h >> np.uint32(8)) & np.uint32(0xFFF)) / 4096.0
            if dx * dx + dy * dy > 0.25:
                continue
            k = np.uint32(h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
            k = np.uint32(k ^ (k >> np.uint32(12))) * np.uint32(0x297A2D39)
            k = np.uint32(k ^ (k >> np.uint32(15)))
            small = 1.0 / (0.28 + 0.22 * np.float64(k & np.uint32(0xFF)) / 256.0)
            # elongated in a direction of its own; the longest axis stays within half a cell
            t = np.float64((k >> np.uint32(8)) & np.uint32(0xFF)) / 128.0 - 1.0
            scale = small / (1.0 + t * t)
            turn, side = (1.0 - t * t) * scale, 2.0 * t * scale
            a, b = turn * dx + side * dy, turn * dy - side * dx
            stretch = 1.0 + 0.5 * np.float64((k >> np.uint32(16)) & np.uint32(0xFF)) / 256.0
            d2 = a * a + b * b * stretch * stretch
            if d2 < 1.0:
                tall = 0.45 + 0.55 * np.float64(k >> np.uint32(24)) / 256.0
                rise = np.sqrt(1.0 - d2)
                value = tall * (0.35 * rise + 0.65 * np.sqrt(rise))
                if value > best:
                    best, own = value, np.float64(k & np.uint32(0xFFFF)) / 65536.0
    return best, own


@jit(nogil=True)
def smoothstep(low, high, value):
    """Return 0 below `low`, 1 above `high`, smooth between."""
    t = min(1.0, max(0.0, (value - low) / (high - low)))
    return t * t * (3.0 - 2.0 * t)
