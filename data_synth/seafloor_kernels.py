"""Ground and features together, at any number of points."""

from __future__ import annotations

import numpy as np

from data_synth.feature_kernels import NOTHING, feature_at, ragged_radius
from data_synth.ground_kernels import ground_at, rock_color, sand_color
from data_synth.noise_kernels import octaves, smoothstep
from data_synth.types import SEDIMENT, TURF
from meshreg.jit import jit, prange


@jit(nogil=True)
def _laid(f, x, y, finest):
    """Share 0..1 by which a sediment or turf patch covers this point."""
    dx, dy = x - f.x, y - f.y
    if dx * dx + dy * dy > f.reach * f.reach:
        return 0.0
    return 1.0 - smoothstep(0.70, 1.0, ragged_radius(f, dx, dy, 0.16, finest))


@jit(nogil=True)
def surface_at(x, y, ground, features, starts, members, corner, bins, finest, with_color):
    """Height [m], reflectance and number of the feature on top (-1: ground) at one point.

    `starts` (cells + 1) and `members` list the features that may reach each cell of a lattice
    with lower left `corner` (2,) [m], `bins` = (columns, rows, cell).
    """
    z, sandy, crest, shade, cover = ground_at(x, y, ground, finest)
    col, row = int((x - corner[0]) / bins[2]), int((y - corner[1]) / bins[2])
    col, row = min(max(col, 0), int(bins[0]) - 1), min(max(row, 0), int(bins[1]) - 1)
    cell = row * int(bins[0]) + col
    turf, dust = 0.0, 0.0
    for k in range(starts[cell], starts[cell + 1]):
        f = features[members[k]]
        if f.kind == SEDIMENT:
            share = _laid(f, x, y, finest)
            z += f.height * share
            dust = max(dust, share)
        elif f.kind == TURF:
            share = _laid(f, x, y, finest)
            if share > 0.0:
                tuft = octaves(x, y, ground.seed + 80, 0.06, finest, 0.75, 4)
                z += f.height * share * (1.0 - sandy) * (1.0 + 0.25 * tuft)
            turf = max(turf, share)
    top, winner = z, -1
    red, green, blue, rocky = 0.0, 0.0, 0.0, True
    for k in range(starts[cell], starts[cell + 1]):
        f = features[members[k]]
        if f.kind == SEDIMENT or f.kind == TURF:
            continue
        up, r, g, b, wears = feature_at(f, x, y, z, finest)
        if up > top and up > NOTHING:
            top, winner = up, members[k]
            red, green, blue, rocky = r, g, b, wears
    if not with_color:
        return top, 0.0, 0.0, 0.0, winner
    if winner >= 0 and rocky:
        f = features[winner]
        r, g, b = rock_color(
            x - f.x + 37.0 * (f.seed % 97), y - f.y, ground, 0.5 + 0.5 * (top - f.z) / f.height, 0.0, finest
        )
        red, green, blue = r * red, g * green, b * blue
    elif winner < 0:
        red, green, blue = rock_color(x, y, ground, shade, cover, finest)
        if turf > 0.0:
            tuft = octaves(x, y, ground.seed + 80, 0.06, finest, 0.75, 4)
            clump = octaves(x, y, ground.seed + 81, 0.5, finest, 0.6, 2)
            light = (0.5 + 0.5 * shade) * (1.0 + 0.22 * tuft + 0.15 * clump)
            red += turf * ((0.085 + 0.012 * clump) * light - red)
            green += turf * (0.085 * light - green)
            blue += turf * (0.038 * light - blue)
        share = max(sandy, 0.92 * dust)
        if share > 0.0:
            r, g, b = sand_color(x, y, ground, crest if sandy > 0.5 else 0.5, finest)
            share = smoothstep(0.15, 0.6, share)
            red, green, blue = red + share * (r - red), green + share * (g - green), blue + share * (b - blue)
    return top, red, green, blue, winner


@jit(parallel=True, nogil=True)
def evaluate(x, y, ground, features, starts, members, corner, bins, finest):
    """Evaluate flat arrays of points: height (N,), reflectance (N, 3) f32, winner (N,) i32."""
    n = x.size
    height, color = np.empty(n), np.empty((n, 3), np.float32)
    winner = np.empty(n, np.int32)
    block = 4096
    for part in prange((n + block - 1) // block):
        for i in range(part * block, min(n, (part + 1) * block)):
            z, r, g, b, w = surface_at(
                x[i], y[i], ground, features, starts, members, corner, bins, finest, True
            )
            height[i], winner[i] = z, w
            color[i, 0], color[i, 1], color[i, 2] = r, g, b
    return height, color, winner


@jit(parallel=True, nogil=True)
def evaluate_height(x, y, ground, features, starts, members, corner, bins, finest):
    """Heights only, (N,) [m]."""
    n = x.size
    height = np.empty(n)
    block = 4096
    for part in prange((n + block - 1) // block):
        for i in range(part * block, min(n, (part + 1) * block)):
            height[i] = surface_at(
                x[i], y[i], ground, features, starts, members, corner, bins, finest, False
            )[0]
    return height


@jit(parallel=True, nogil=True)
def evaluate_ground(x, y, ground, finest):
    """Bare ground without features: height (N,) [m] and sandiness 0..1 (N,)."""
    n = x.size
    height, sandy = np.empty(n), np.empty(n)
    for i in prange(n):
        z, s, _, _, _ = ground_at(x[i], y[i], ground, finest)
        height[i], sandy[i] = z, s
    return height, sandy


@jit(parallel=True, nogil=True)
def evaluate_noise(x, y, seed, wavelength):
    """Plain noise of standard deviation about 1 at points (N,)."""
    n = x.size
    value = np.empty(n)
    for i in prange(n):
        value[i] = octaves(x[i], y[i], seed, wavelength, 0.0, 0.6, 3)
    return value
