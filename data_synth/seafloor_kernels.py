"""Ground and features together, at any number of points."""

# ruff: noqa: PLR0913, PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import numpy as np

from data_synth.feature_kernels import NOTHING, feature_color, feature_height, ragged_radius
from data_synth.ground_kernels import add_sand, add_turf, ground_block, rock_color
from data_synth.noise_kernels import octaves, octaves_into, smoothstep
from data_synth.types import BOULDER, SEDIMENT, TURF
from meshreg.jit import jit, prange

BLOCK = 1024  # points; all that a block needs fits the second cache


@jit(nogil=True, error_model="numpy")
def _laid(f, x, y, finest):
    """Share 0..1 by which a sediment or turf patch covers this point."""
    dx, dy = x - f.x, y - f.y
    if dx * dx + dy * dy > f.reach * f.reach:
        return 0.0
    return 1.0 - smoothstep(0.70, 1.0, ragged_radius(f, dx, dy, 0.16, finest))


@jit(nogil=True, error_model="numpy")
def _cell(x, y, corner, bins):
    col, row = int((x - corner[0]) / bins[2]), int((y - corner[1]) / bins[2])
    col, row = min(max(col, 0), int(bins[0]) - 1), min(max(row, 0), int(bins[1]) - 1)
    return row * int(bins[0]) + col


@jit(nogil=True, error_model="numpy")
def _lay(x, y, ground, index, finest, z, sandy):
    """Lay sediment and turf patches on `z`, in place; say how much lies where (N,)."""
    features, starts, members, corner, bins = index
    dust, turf = np.zeros(x.size), np.zeros(x.size)
    any_turf = False
    for i in range(x.size):
        cell = _cell(x[i], y[i], corner, bins)
        for k in range(starts[cell], starts[cell + 1]):
            f = features[members[k]]
            if f.kind not in (SEDIMENT, TURF):
                continue
            share = _laid(f, x[i], y[i], finest)
            if share <= 0.0:
                continue
            if f.kind == SEDIMENT:
                z[i] += f.height * share
                dust[i] = max(dust[i], share)
            else:
                tuft = octaves(x[i], y[i], ground.seed + 80, 0.06, finest, 0.75, 4)
                z[i] += f.height * share * (1.0 - sandy[i]) * (1.0 + 0.25 * tuft)
                turf[i] = max(turf[i], share)
                any_turf = True
    return dust, turf, any_turf


@jit(nogil=True, error_model="numpy")
def _stand(x, y, index, finest, z, height, mark, winner):
    """Put the highest of ground and features into `height`, with its mark and its number."""
    features, starts, members, corner, bins = index
    for i in range(x.size):
        cell = _cell(x[i], y[i], corner, bins)
        top, who = z[i], -1
        for k in range(starts[cell], starts[cell + 1]):
            f = features[members[k]]
            up, m = feature_height(f, x[i], y[i], z[i], finest)
            if up > top and up > NOTHING:
                top, who, mark[i] = up, members[k], m
        height[i], winner[i] = top, who


@jit(nogil=True, error_model="numpy")
def _paint(x, y, features, finest, mark, winner, color):
    """Color what stands on the ground, in place; boulders only tint the rock that is there."""
    for i in range(x.size):
        if winner[i] < 0:
            continue
        f = features[winner[i]]
        if f.kind == BOULDER:
            color[i, 0] *= f.red
            color[i, 1] *= f.green
            color[i, 2] *= f.blue
        else:
            r, g, b = feature_color(f, x[i] - f.x, y[i] - f.y, mark[i], finest)
            color[i, 0], color[i, 1], color[i, 2] = r, g, b


@jit(nogil=True, error_model="numpy")
def _block(x, y, ground, index, finest, with_color, height, color, winner):
    """Evaluate one block of points into `height`, `color` and `winner`."""
    features = index[0]
    z, sandy, crest, shade, cover = ground_block(x, y, ground, finest)
    dust, turf, any_turf = _lay(x, y, ground, index, finest, z, sandy)
    mark = np.zeros(x.size)
    _stand(x, y, index, finest, z, height, mark, winner)
    if not with_color:
        return
    skin_x, skin_y = x.copy(), y.copy()
    for i in range(x.size):
        if winner[i] >= 0 and features[winner[i]].kind == BOULDER:
            # a boulder carries its own skin with it
            f = features[winner[i]]
            skin_x[i], skin_y[i] = x[i] - f.x + 37.0 * (f.seed % 97), y[i] - f.y
            shade[i], cover[i] = 0.5 + 0.5 * (height[i] - f.z) / f.height, 0.0
    rock_color(skin_x, skin_y, ground, shade, cover, finest, color)
    if any_turf:
        add_turf(x, y, ground, shade, turf, finest, color)
    for i in range(x.size):
        if sandy[i] < dust[i]:
            crest[i] = 0.5
        covered = max(sandy[i], 0.92 * dust[i]) if winner[i] < 0 else 0.0
        sandy[i] = smoothstep(0.15, 0.6, covered)
    if sandy.max() > 0.0:
        add_sand(x, y, ground, sandy, crest, finest, color)
    _paint(x, y, features, finest, mark, winner, color)


@jit(parallel=True, nogil=True, error_model="numpy")
def evaluate(x, y, ground, features, starts, members, corner, bins, finest):
    """Evaluate flat arrays of points: height (N,), reflectance (N, 3) f32, winner (N,) i32.

    `starts` (cells + 1) and `members` list the features that may reach each cell of a lattice
    with lower left `corner` (2,) [m], `bins` = (columns, rows, cell). Winner -1 is the ground.
    """
    n = x.size
    height, color = np.empty(n), np.empty((n, 3), np.float32)
    winner = np.empty(n, np.int32)
    for part in prange((n + BLOCK - 1) // BLOCK):
        a, b = part * BLOCK, min(n, (part + 1) * BLOCK)
        index = (features, starts, members, corner, bins)
        _block(x[a:b], y[a:b], ground, index, finest, True, height[a:b], color[a:b], winner[a:b])
    return height, color, winner


@jit(parallel=True, nogil=True, error_model="numpy")
def evaluate_height(x, y, ground, features, starts, members, corner, bins, finest):
    """Heights only, (N,) [m]."""
    n = x.size
    height = np.empty(n)
    for part in prange((n + BLOCK - 1) // BLOCK):
        a, b = part * BLOCK, min(n, (part + 1) * BLOCK)
        index = (features, starts, members, corner, bins)
        color, winner = np.empty((1, 3), np.float32), np.empty(b - a, np.int32)
        _block(x[a:b], y[a:b], ground, index, finest, False, height[a:b], color, winner)
    return height


@jit(parallel=True, nogil=True, error_model="numpy")
def evaluate_ground(x, y, ground, finest):
    """Bare ground without features: height (N,) [m] and sandiness 0..1 (N,)."""
    n = x.size
    height, sandy = np.empty(n), np.empty(n)
    for part in prange((n + BLOCK - 1) // BLOCK):
        a, b = part * BLOCK, min(n, (part + 1) * BLOCK)
        height[a:b], sandy[a:b], _, _, _ = ground_block(x[a:b], y[a:b], ground, finest)
    return height, sandy


@jit(nogil=True, error_model="numpy")
def evaluate_noise(x, y, seed, wavelength):
    """Plain noise of standard deviation about 1 at points (N,)."""
    value = np.zeros(x.size)
    octaves_into(x, y, seed, wavelength, 0.0, 0.6, 3, 1.0, value)
    return value
