"""The distortion of a reconstruction, forward and back, at any number of points."""

from __future__ import annotations

import math

import numpy as np

from meshreg.jit import jit, prange


@jit(nogil=True)
def bend(x, y, poly, waves, cosines, sines):
    """Displacement (east, north, up) [m] of the smooth warp at a point (x, y) [m].

    `poly` (3, 6) goes with 1, x, y, xx, xy, yy; `waves` (M, 2) [rad/m] with `cosines` and `sines`
    (M, 3) [m].
    """
    a, b, c = poly[0], poly[1], poly[2]
    xx, xy, yy = x * x, x * y, y * y
    dx = a[0] + a[1] * x + a[2] * y + a[3] * xx + a[4] * xy + a[5] * yy
    dy = b[0] + b[1] * x + b[2] * y + b[3] * xx + b[4] * xy + b[5] * yy
    dz = c[0] + c[1] * x + c[2] * y + c[3] * xx + c[4] * xy + c[5] * yy
    for k in range(waves.shape[0]):
        angle = waves[k, 0] * x + waves[k, 1] * y
        co, si = math.cos(angle), math.sin(angle)
        dx += cosines[k, 0] * co + sines[k, 0] * si
        dy += cosines[k, 1] * co + sines[k, 1] * si
        dz += cosines[k, 2] * co + sines[k, 2] * si
    return dx, dy, dz


@jit(parallel=True, nogil=True)
def bend_many(x, y, poly, waves, cosines, sines):
    """`bend` at points (N,): displacements (N, 3) [m]."""
    out = np.empty((x.size, 3))
    for i in prange(x.size):
        out[i, 0], out[i, 1], out[i, 2] = bend(x[i], y[i], poly, waves, cosines, sines)
    return out


@jit(parallel=True, nogil=True)
def to_world(points, linear, poly, waves, cosines, sines):
    """Survey-centred points (N, 3) to world points: ``q = linear @ p``, then ``q + bend(q)``."""
    out = np.empty((points.shape[0], 3))
    for i in prange(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = linear[0, 0] * px + linear[0, 1] * py + linear[0, 2] * pz
        y = linear[1, 0] * px + linear[1, 1] * py + linear[1, 2] * pz
        z = linear[2, 0] * px + linear[2, 1] * py + linear[2, 2] * pz
        dx, dy, dz = bend(x, y, poly, waves, cosines, sines)
        out[i, 0], out[i, 1], out[i, 2] = x + dx, y + dy, z + dz
    return out


@jit(parallel=True, nogil=True)
def from_world(points, inverse, poly, waves, cosines, sines):
    """Inverse of `to_world`: ``q = p - bend(q)`` by fixed point (the warp contracts)."""
    out = np.empty((points.shape[0], 3))
    for i in prange(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        dx, dy, dz = bend(x, y, poly, waves, cosines, sines)
        for _ in range(60):
            last_x, last_y = dx, dy
            dx, dy, dz = bend(x - dx, y - dy, poly, waves, cosines, sines)
            if abs(dx - last_x) + abs(dy - last_y) < 1e-13:
                break
        qx, qy, qz = x - dx, y - dy, z - dz
        for j in range(3):
            out[i, j] = inverse[j, 0] * qx + inverse[j, 1] * qy + inverse[j, 2] * qz
    return out


@jit(parallel=True, nogil=True)
def lattice_to_world(east, north, guess, linear, poly, waves, cosines, sines):
    """World x, y of the surface above survey-centred `east` (W,), `north` (H,), and the warp's up.

    `guess` (H, W) is the surface's height in the survey's frame [m]; it matters by tilt alone.
    """
    x = np.empty((north.size, east.size))
    y = np.empty((north.size, east.size))
    lift = np.empty((north.size, east.size))
    for i in prange(north.size):
        for j in range(east.size):
            px, py, pz = east[j], north[i], guess[i, j]
            qx = linear[0, 0] * px + linear[0, 1] * py + linear[0, 2] * pz
            qy = linear[1, 0] * px + linear[1, 1] * py + linear[1, 2] * pz
            dx, dy, dz = bend(qx, qy, poly, waves, cosines, sines)
            x[i, j], y[i, j], lift[i, j] = qx + dx, qy + dy, dz
    return x, y, lift


@jit(parallel=True, nogil=True)
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
