"""Noise that can be asked for anywhere: hashed lattices, no table, no period.

Every function is a pure function of position and seed. Coordinates are in units of the lattice
(metres divided by the wavelength), float64, so that a survey at UTM coordinates loses nothing.

Gradient noise after Perlin, "Improving noise", SIGGRAPH 2002 (quintic fade), with gradients from
an integer hash instead of a permutation table; the hash is the finaliser of MurmurHash3.

The small ones are inlined before LLVM sees them, keep to 32-bit integers and do not test for
division by zero: only then are the loops of the `_into` functions vectorised, which makes them
four times as fast.
"""

# ruff: noqa: PLR0913, PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import numpy as np

from meshreg.jit import jit

_SHORT = 1.0 / 32768.0
_UNIT = 1.0 / 4294967296.0
_NORM = 5.85  # makes each octave's standard deviation 1
_COS, _SIN = 0.7986355100472928, 0.6018150231520483  # the turn from octave to octave
_EDGE = 0.12  # of a lump's foot: the smaller, the steeper


@jit(nogil=True, inline="always", error_model="numpy")
def hash2(ix, iy, seed):
    """Return 32 well-mixed bits, as int32, for a lattice point and a seed (all int32)."""
    h = np.int32(
        np.int32(np.int32(ix) * np.int32(-1640531535))
        ^ np.int32(np.int32(iy) * np.int32(-2048144777))
        ^ np.int32(np.int32(seed) * np.int32(-1028477379))
    )
    h = np.int32(np.int32(h ^ np.int32(np.uint32(h) >> np.uint32(16))) * np.int32(-2048144789))
    h = np.int32(np.int32(h ^ np.int32(np.uint32(h) >> np.uint32(13))) * np.int32(-1028477387))
    return np.int32(h ^ np.int32(np.uint32(h) >> np.uint32(16)))


@jit(nogil=True, error_model="numpy")
def hash01(ix, iy, seed):
    """Return a number in [0, 1) for a lattice point and a seed."""
    return np.float64(np.uint32(hash2(ix, iy, seed))) * _UNIT


@jit(nogil=True, inline="always", error_model="numpy")
def _corner(ix, iy, seed, dx, dy):
    h = hash2(ix, iy, seed)
    gx = np.float64(np.int32(h >> 16))
    gy = np.float64(np.int32(np.int32(h << 16) >> 16))
    return (gx * dx + gy * dy) * _SHORT


@jit(nogil=True, inline="always", error_model="numpy")
def gradient_noise(x, y, seed):
    """Smooth noise of mean 0 and standard deviation about 0.17, wavelength about 2 units."""
    fx, fy = np.floor(x), np.floor(y)
    ix, iy = np.int32(fx), np.int32(fy)
    jx, jy = np.int32(ix + 1), np.int32(iy + 1)
    u, v = x - fx, y - fy
    su = u * u * u * (u * (u * 6.0 - 15.0) + 10.0)
    sv = v * v * v * (v * (v * 6.0 - 15.0) + 10.0)
    sw = _corner(ix, iy, seed, u, v)
    se = _corner(jx, iy, seed, u - 1.0, v)
    nw = _corner(ix, jy, seed, u, v - 1.0)
    ne = _corner(jx, jy, seed, u - 1.0, v - 1.0)
    south = sw + su * (se - sw)
    north = nw + su * (ne - nw)
    return south + sv * (north - south)


@jit(nogil=True, error_model="numpy")
def octaves(x, y, seed, wavelength, finest, gain, count):
    """Sum `count` octaves from `wavelength` [m] down, each `gain` times the one before.

    Octaves shorter than `finest` [m] are faded out: their area mean over a sample is near zero.
    Each octave is turned by an irrational angle, so that no lattice direction shows. The first
    one's standard deviation is 1.
    """
    total, amplitude = 0.0, _NORM
    c, s = 1.0, 0.0
    for k in range(count):
        if wavelength < finest:
            break
        fade = min(1.0, (wavelength - finest) / finest) if finest > 0 else 1.0
        scale = 2.0 / wavelength
        u, v = (c * x - s * y) * scale, (s * x + c * y) * scale
        total += amplitude * fade * gradient_noise(u, v, np.int32(seed + 101 * k))
        c, s = c * _COS - s * _SIN, s * _COS + c * _SIN
        amplitude *= gain
        wavelength *= 0.5
    return total


@jit(nogil=True, error_model="numpy")
def octaves_into(x, y, seed, wavelength, finest, gain, count, times, out):
    """Add `times` the `octaves` at points (N,) to `out` (N,)."""
    amplitude = _NORM * times
    c, s = 1.0, 0.0
    for k in range(count):
        if wavelength < finest:
            break
        fade = min(1.0, (wavelength - finest) / finest) if finest > 0 else 1.0
        scale = 2.0 / wavelength
        cs, ss, tall, salt = c * scale, s * scale, amplitude * fade, np.int32(seed + 101 * k)
        for i in range(x.size):
            out[i] += tall * gradient_noise(cs * x[i] - ss * y[i], ss * x[i] + cs * y[i], salt)
        c, s = c * _COS - s * _SIN, s * _COS + c * _SIN
        amplitude *= gain
        wavelength *= 0.5


@jit(nogil=True, inline="always", error_model="numpy")
def _lump(x, y, ix, iy, seed, presence):
    """Height 0..1 of the lump of one lattice cell at (x, y) (0: none), and its own number 0..1."""
    h = hash2(ix, iy, seed)
    dx = x - np.float64(ix) - np.float64(np.int32((h >> 20) & 4095)) * (1.0 / 4096.0)
    dy = y - np.float64(iy) - np.float64(np.int32((h >> 8) & 4095)) * (1.0 / 4096.0)
    k = np.int32(np.int32(h ^ np.int32(np.uint32(h) >> np.uint32(15))) * np.int32(739982445))
    k = np.int32(np.int32(k ^ np.int32(np.uint32(k) >> np.uint32(12))) * np.int32(695872825))
    k = np.int32(k ^ np.int32(np.uint32(k) >> np.uint32(15)))
    # one over the radius, which is 0.28 to 0.5
    small = 2.0 + (1.57 / 256.0) * np.float64(np.int32(k & 255))
    # a direction of its own: cosine and sine of a quarter turn either way, to a thousandth
    t = np.float64(np.int32((k >> 8) & 255)) * (1.0 / 128.0) - 1.0
    t2 = t * t
    side = t * (1.5708 - 0.5708 * t2) * small
    turn = (1.0 - t2 * (1.2234 - 0.2234 * t2)) * small
    stretch = 1.0 + (0.5 / 256.0) * np.float64(np.int32((k >> 16) & 255))
    a, b = turn * dx + side * dy, (turn * dy - side * dx) * stretch
    w = max(0.0, 1.0 - a * a - b * b)
    tall = 0.45 + (0.55 / 128.0) * np.float64(np.int32((k >> 24) & 127))
    there = 1.0 if np.float64(np.int32(h & 255)) < presence * 256.0 else 0.0
    own = np.float64(np.int32(k & 65535)) * (1.0 / 65536.0)
    return there * tall * (1.0 + _EDGE) * w / (w + _EDGE), own


@jit(nogil=True, inline="always", error_model="numpy")
def lumps(x, y, seed, presence):
    """Return the height 0..1 of rounded lumps, one or none a cell, and the lump's own number.

    A lump's radius is at most half a cell, so the four cells nearest the point are enough. The
    profile is flat with a steep foot, as coral rock has.
    """
    ix, iy = np.int32(np.floor(x - 0.5)), np.int32(np.floor(y - 0.5))
    jx, jy = np.int32(ix + 1), np.int32(iy + 1)
    best, own = _lump(x, y, ix, iy, seed, presence)
    up, other = _lump(x, y, jx, iy, seed, presence)
    own, best = (other if up > best else own), max(best, up)
    up, other = _lump(x, y, ix, jy, seed, presence)
    own, best = (other if up > best else own), max(best, up)
    up, other = _lump(x, y, jx, jy, seed, presence)
    own, best = (other if up > best else own), max(best, up)
    return best, own


@jit(nogil=True, error_model="numpy")
def lumps_at(x, y, seed, presence):
    """`lumps`, not inlined: for code that asks at one point at a time."""
    return lumps(x, y, np.int32(seed), presence)


@jit(nogil=True, error_model="numpy")
def lumps_into(x, y, cell, angle, seed, presence, up, own):
    """Put the `lumps` of size `cell` [m] at points (N,) into `up` and `own` (N,)."""
    c, s, salt = np.cos(angle) / cell, np.sin(angle) / cell, np.int32(seed)
    for i in range(x.size):
        up[i], own[i] = lumps(c * x[i] - s * y[i], s * x[i] + c * y[i], salt, presence)


@jit(nogil=True, inline="always", error_model="numpy")
def smoothstep(low, high, value):
    """Return 0 below `low`, 1 above `high`, smooth between."""
    t = min(1.0, max(0.0, (value - low) / (high - low)))
    return t * t * (3.0 - 2.0 * t)
