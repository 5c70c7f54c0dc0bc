"""The distortion of a reconstruction, forward and back, at any number of points."""

# ruff: noqa: PLR0913, PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import math

import numpy as np

from meshreg.jit import jit, prange

_TURN = 1.0 / (2.0 * math.pi)
_BLOCK = 1024


@jit(nogil=True, inline="always", error_model="numpy")
def cos_sin(angle):
    """Cosine and sine to 1e-13, free of branches so that loops over it are vectorised.

    Taylor series of the half angle, which lies within a quarter turn, then doubled.
    """
    t = angle * _TURN
    x = math.pi * (t - np.floor(t + 0.5))
    z = x * x
    s = 1.0 - z / 342.0
    s = 1.0 - z / 272.0 * s
    s = 1.0 - z / 210.0 * s
    s = 1.0 - z / 156.0 * s
    s = 1.0 - z / 110.0 * s
    s = 1.0 - z / 72.0 * s
    s = 1.0 - z / 42.0 * s
    s = 1.0 - z / 20.0 * s
    s = x * (1.0 - z / 6.0 * s)
    c = 1.0 - z / 306.0
    c = 1.0 - z / 240.0 * c
    c = 1.0 - z / 182.0 * c
    c = 1.0 - z / 132.0 * c
    c = 1.0 - z / 90.0 * c
    c = 1.0 - z / 56.0 * c
    c = 1.0 - z / 30.0 * c
    c = 1.0 - z / 12.0 * c
    c = 1.0 - z / 2.0 * c
    return 1.0 - 2.0 * s * s, 2.0 * s * c


@jit(nogil=True, error_model="numpy")
def bend(x, y, poly, waves, cosines, sines, dx, dy, dz):
    """Put the warp's displacement (east, north, up) [m] at points (N,) into `dx`, `dy`, `dz`.

    `poly` (3, 6) goes with 1, x, y, xx, xy, yy; `waves` (M, 2) [rad/m] with `cosines` and `sines`
    (M, 3) [m].
    """
    for k in range(3):
        p = poly[k]
        out = dx if k == 0 else (dy if k == 1 else dz)
        for i in range(x.size):
            a, b = x[i], y[i]
            out[i] = p[0] + a * (p[1] + p[3] * a + p[4] * b) + b * (p[2] + p[5] * b)
    for k in range(waves.shape[0]):
        u, v = waves[k, 0], waves[k, 1]
        cx, cy, cz = cosines[k, 0], cosines[k, 1], cosines[k, 2]
        sx, sy, sz = sines[k, 0], sines[k, 1], sines[k, 2]
        for i in range(x.size):
            c, s = cos_sin(u * x[i] + v * y[i])
            dx[i] += cx * c + sx * s
            dy[i] += cy * c + sy * s
            dz[i] += cz * c + sz * s


@jit(parallel=True, nogil=True, error_model="numpy")
def bend_many(x, y, poly, waves, cosines, sines):
    """`bend` at points (N,): displacements (N, 3) [m]."""
    out = np.empty((3, x.size))
    for part in prange((x.size + _BLOCK - 1) // _BLOCK):
        a, b = part * _BLOCK, min(x.size, (part + 1) * _BLOCK)
        d = out[:, a:b]
        bend(x[a:b], y[a:b], poly, waves, cosines, sines, d[0], d[1], d[2])
    return out.T


@jit(parallel=True, nogil=True, error_model="numpy")
def from_world(x, y, poly, waves, cosines, sines):
    """Solve ``q + bend(q) = (x, y)`` by fixed point (the warp contracts); return bend(q) (N, 3)."""
    out = np.empty((3, x.size))
    for part in prange((x.size + _BLOCK - 1) // _BLOCK):
        a, b = part * _BLOCK, min(x.size, (part + 1) * _BLOCK)
        px, py = x[a:b], y[a:b]
        d = out[:, a:b]
        bend(px, py, poly, waves, cosines, sines, d[0], d[1], d[2])
        for _ in range(60):
            qx, qy = px - d[0], py - d[1]
            last = d[:2].copy()
            bend(qx, qy, poly, waves, cosines, sines, d[0], d[1], d[2])
            if np.abs(d[:2] - last).max() < 1e-13:
                break
    return out.T


@jit(parallel=True, nogil=True, error_model="numpy")
def lattice_to_world(east, north, guess, linear, poly, waves, cosines, sines):
    """World x, y of the surface above survey-centred `east` (W,), `north` (H,), and the warp's up.

    `guess` (H, W) is the surface's height in the survey's frame [m]; it matters by tilt alone.
    """
    shape = (north.size, east.size)
    x, y, lift = np.empty(shape), np.empty(shape), np.empty(shape)
    for i in prange(north.size):
        qx = linear[0, 0] * east + linear[0, 1] * north[i] + linear[0, 2] * guess[i]
        qy = linear[1, 0] * east + linear[1, 1] * north[i] + linear[1, 2] * guess[i]
        bend(qx, qy, poly, waves, cosines, sines, x[i], y[i], lift[i])
        x[i] += qx
        y[i] += qy
    return x, y, lift


@jit(parallel=True, nogil=True, error_model="numpy")
def lattice_height(height, lift, east, north, linear):
    """Height in the survey's frame (H, W) where the world surface stands at `height`.

    Solves ``linear[2] @ (east, north, up) + lift = height`` for ``up``.
    """
    up = np.empty(height.shape)
    for i in prange(north.size):
        for j in range(east.size):
            level = height[i, j] - lift[i, j] - linear[2, 0] * east[j] - linear[2, 1] * north[i]
            up[i, j] = level / linear[2, 2]
    return up
