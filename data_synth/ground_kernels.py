"""The ground: rock, rubble and sand, as functions of position, a block of points at a time."""

from __future__ import annotations

import math

import numpy as np

from data_synth.noise_kernels import hash01, lumps_into, octaves_into, smoothstep
from meshreg.jit import jit


@jit(nogil=True, error_model="numpy")
def _noise(x, y, seed, wavelength, finest, gain, count):
    out = np.zeros(x.size)
    octaves_into(x, y, seed, wavelength, finest, gain, count, 1.0, out)
    return out


@jit(nogil=True, error_model="numpy")
def _mixed(x, y, ground, salt, wavelength, finest, gain, count):
    """Noise whose share `ground.mix` belongs to the epoch; its variance does not change."""
    out = np.zeros(x.size)
    old = math.sqrt(1.0 - ground.mix * ground.mix)
    if old > 0.0:
        octaves_into(x, y, ground.seed + salt, wavelength, finest, gain, count, old, out)
    if ground.mix > 0.0:
        own = ground.mix_seed + salt
        octaves_into(x, y, own, wavelength, finest, gain, count, ground.mix, out)
    return out


@jit(nogil=True, error_model="numpy")
def _spots(x, y, ground, salt, cell, presence):
    """Scattered blots -1 (dark) to 1 (light): those of the epoch replace a share `ground.mix`."""
    n = x.size
    out, up, own = np.zeros(n), np.empty(n), np.empty(n)
    for epoch in range(2):
        share = ground.mix if epoch == 1 else 1.0 - ground.mix
        if share > 0.0:
            seed = (ground.mix_seed if epoch == 1 else ground.seed) + salt
            lumps_into(x, y, cell, 0.9, seed, presence * share, up, own)
            for i in range(n):
                out[i] += up[i] * (2.4 * own[i] - 1.0)
    return out


@jit(nogil=True, inline="always", error_model="numpy")
def _epoch_number(own, ground):
    """Mix a lump's number 0..1 with another that is the epoch's own, of share `ground.mix`."""
    other = own * 7919.13 + 0.1234567 * ground.mix_seed
    return own + ground.mix * (other - np.floor(other) - own)


@jit(nogil=True, error_model="numpy")
def sand_height(x, y, ground, finest):
    """Height of the sand sheet [m] and the ripples' phase: 0 in the trough, 1 on the crest."""
    z = np.full(x.size, ground.sand_level)
    octaves_into(x, y, ground.seed + 11, 5.0, finest, 0.5, 3, ground.sand_relief, z)
    if ground.drift > 0.0:
        octaves_into(x, y, ground.mix_seed + 15, 1.6, finest, 0.5, 2, ground.drift, z)
    crest = np.full(x.size, 0.5)
    long = ground.ripple_wavelength
    if ground.ripple <= 0.0 or long <= finest:
        return z, crest
    c, s = math.cos(ground.ripple_turn), math.sin(ground.ripple_turn)
    stray = _noise(x, y, ground.seed + 12, 14.0 * long, finest, 0.6, 3)
    meet = _noise(x, y, ground.seed + 13, 12.0 * long, finest, 0.5, 2)
    calm = _noise(x, y, ground.seed + 14, 3.5, finest, 0.5, 2)
    fade = min(1.0, (long - finest) / finest) if finest > 0 else 1.0
    for i in range(x.size):
        phase = (c * x[i] + s * y[i]) / long + ground.ripple_wander * stray[i] + ground.ripple_phase
        # steep lee sides, and crests that die out and start anew where two trains meet
        angle = 2.0 * math.pi * phase
        wave = math.sin(angle + 0.5 * math.sin(angle))
        if ground.ripple_wander > 0.2:
            other = 2.0 * math.pi * (1.13 * phase + 0.35 * (c * y[i] - s * x[i]) / long)
            blend = smoothstep(-0.3, 0.5, meet[i])
            wave += blend * (math.sin(other + 0.5 * math.sin(other)) - wave)
        patch = 0.25 + 0.75 * smoothstep(-1.2, 0.3, calm[i])
        z[i] += 0.5 * ground.ripple * wave * fade * patch
        crest[i] += 0.4 * wave * fade
    return z, crest


@jit(nogil=True, error_model="numpy")
def rock_height(x, y, ground, finest):
    """Height of the rock [m], the shade of the lump here (0..1) and how much rubble covers it."""
    gain = 0.5**ground.hurst
    n = x.size
    wx, wy = x.copy(), y.copy()
    octaves_into(x, y, ground.seed + 1, 0.9, finest, 0.45, 2, 0.035, wx)
    octaves_into(x, y, ground.seed + 2, 0.9, finest, 0.45, 2, 0.035, wy)
    z = np.zeros(n)
    octaves_into(x, y, ground.seed + 3, ground.relief_wavelength, finest, gain, 5, ground.relief, z)
    if ground.step > 0.0:
        high = _noise(wx, wy, ground.seed + 4, ground.step_wavelength, finest, 0.42, 4)
        for i in range(n):
            over = high[i] - ground.step_level
            z[i] += ground.step * (
                smoothstep(-0.05, 0.05, over) + 0.6 * smoothstep(-0.05, 0.05, over - 0.7)
            )
    shade, rough = np.full(n, 0.5), np.ones(n)
    up, own = np.empty(n), np.empty(n)
    cell, tall, presence = ground.lump_cell, ground.lump, 0.55
    for k in range(5):
        if tall <= 0.0 or cell * 0.5 < finest:
            break
        lumps_into(wx, wy, cell, 1.7 * k + 0.4, ground.seed + 20 + k, presence, up, own)
        for i in range(n):
            z[i] += tall * rough[i] * up[i]
        if k >= 1:
            share = 0.6 if k == 1 else 0.6 * min(1.0, ground.fine)
            for i in range(n):
                there = share if up[i] > 0.0 else 0.0
                shade[i] += there * (_epoch_number(own[i], ground) - shade[i])
        if k == 1:  # some ground is smooth, some broken
            calm = _noise(x, y, ground.seed + 7, 1.6, finest, 0.6, 3)
            least = ground.broken_least
            for i in range(n):
                rough[i] = least + (1.0 - least) * smoothstep(-1.2, 1.4, calm[i])
        cell *= 0.42
        tall *= ground.lump_gain
        presence = 0.85
    cover = _rubble(x, y, wx, wy, ground, finest, z, shade)
    grit = _mixed(x, y, ground, 6, 0.20, finest, gain, 5)
    for i in range(n):
        z[i] += ground.grit * rough[i] * grit[i]
    return z, shade, cover


@jit(nogil=True, error_model="numpy")
def _rubble(x, y, wx, wy, ground, finest, z, shade):
    """Strew rubble on `z` and `shade`, in place; return how much covers each point (0..1)."""
    n = x.size
    cover = np.zeros(n)
    if ground.rubble <= 0.0:
        return cover
    zone = _noise(x, y, ground.seed + 5, 3.0, finest, 0.6, 4)
    edge = 2.4 * (0.5 - ground.rubble)
    most = 0.0
    for i in range(n):
        cover[i] = smoothstep(edge - 0.25, edge + 0.35, zone[i])
        most = max(most, cover[i])
    if most <= 0.0:
        return cover
    up, own = np.empty(n), np.empty(n)
    for k in range(2):
        size = 0.11 if k == 0 else 0.05
        if size * 0.5 > finest:
            for epoch in range(2):  # pieces that lay there before, and those that came since
                share = ground.mix if epoch == 1 else 1.0 - ground.mix
                if share <= 0.0:
                    continue
                seed = (ground.mix_seed if epoch == 1 else ground.seed) + 40 + k
                lumps_into(wx, wy, size, 0.3 * k, seed, 0.95 * share, up, own)
                for i in range(n):
                    z[i] += cover[i] * 0.28 * size * up[i]
                    there = min(1.0, ground.fine) * cover[i] if up[i] > 0.0 else 0.0
                    shade[i] += there * (own[i] - shade[i])
    return cover


@jit(nogil=True, error_model="numpy")
def ground_block(x, y, ground, finest):
    """Return height [m], sandiness 0..1, ripple crest 0..1, shade 0..1, rubble 0..1: (N,) each."""
    z, shade, cover = rock_height(x, y, ground, finest)
    sandy, crest = np.zeros(x.size), np.full(x.size, 0.5)
    if ground.sand_level < -1e8:
        return z, sandy, crest, shade, cover
    # no need to ask for the sand where all rock stands well above it
    highest = (
        ground.sand_level + 8.0 * ground.sand_relief + 6.0 * ground.drift + ground.ripple + 0.03
    )
    lowest = z[0]
    for i in range(x.size):
        lowest = min(lowest, z[i])
    if lowest > highest:
        return z, sandy, crest, shade, cover
    sand, crest = sand_height(x, y, ground, finest)
    for i in range(x.size):
        sandy[i] = smoothstep(-0.025, 0.035, sand[i] - z[i])
        z[i] += (max(sand[i], z[i] - 0.02) - z[i]) * sandy[i]
    return z, sandy, crest, shade, cover


@jit(nogil=True, error_model="numpy")
def rock_color(x, y, ground, shade, cover, finest, out):
    """Put the reflectance of rock, turf, coralline crust and rubble into `out` (N, 3)."""
    n = x.size
    zone = _noise(x, y, ground.seed + 50, 1.3, finest, 0.7, 2)
    patch = _mixed(x, y, ground, 51, 0.35, finest, 0.6, 4)
    fine = _mixed(x, y, ground, 52, 0.055, finest, 0.7, 3)
    grain = _mixed(x, y, ground, 53, 0.010, finest, 0.7, 2)
    # crusts of sponge, bryozoans, barnacles, holes
    blots = np.zeros(n)
    if finest < 0.06:
        blots += 0.8 * _spots(x, y, ground, 54, 0.15, 0.30)
    if finest < 0.03:
        blots += _spots(x, y, ground, 55, 0.055, 0.25)
    for i in range(n):
        f, p, g, h = fine[i], patch[i], grain[i], shade[i]
        spot = blots[i]
        f, g, spot = ground.fine * f, ground.fine * g, ground.fine * spot
        wide = ground.patch * zone[i]
        tone = max(0.25, 1.0 + 0.20 * wide + 0.16 * p + 0.20 * f + 0.09 * g + 0.55 * spot)
        # bare limestone or basalt
        low = 0.19 * (0.45 + 1.05 * h) * tone
        red, green = low * ground.tone_red, low * ground.tone_green
        blue = low * ground.tone_blue
        # turf: olive to brown, darker, in patches with ragged edges
        t = (0.7 + 0.8 * ground.patch) * zone[i] + p + 0.35 * f + 1.6 * ground.turf - 0.6
        t = ground.turf * smoothstep(-1.1, 0.6, t)
        hue = 0.5 + 0.25 * p
        low = 0.075 * (0.55 + 0.9 * h) * max(0.2, tone + 0.12 * f)
        red += t * (low * (1.05 + 0.25 * hue) - red)
        green += t * (low * (0.96 - 0.10 * hue) - green)
        blue += t * (low * (0.50 - 0.12 * hue) - blue)
        # coralline algae: mauve and pink crusts with sharp borders
        t = 0.5 * zone[i] - 0.55 * p + 0.45 * f + 0.4 * (h - 0.5)
        t = ground.coralline * smoothstep(0.45, 0.9, t)
        low = 0.15 * (1.0 + 0.18 * f + 0.08 * g)
        red += t * (low * 1.15 - red)
        green += t * (low * 0.72 - green)
        blue += t * (low * 0.82 - blue)
        t = 0.8 * cover[i]
        low = (0.08 + 0.26 * h * h) * (1.0 + 0.18 * f + 0.10 * g)
        red += t * (low * 1.02 - red)
        green += t * (low * 0.96 - green)
        blue += t * (low * 0.80 - blue)
        out[i, 0], out[i, 1], out[i, 2] = max(red, 0.004), max(green, 0.004), max(blue, 0.004)


@jit(nogil=True, error_model="numpy")
def add_turf(x, y, ground, shade, turf, finest, out):
    """Lay new turf over `out` (N, 3) where `turf` (0..1) says, in place."""
    tuft = _noise(x, y, ground.seed + 80, 0.06, finest, 0.75, 4)
    clump = _noise(x, y, ground.seed + 81, 0.5, finest, 0.6, 2)
    for i in range(x.size):
        light = (0.5 + 0.5 * shade[i]) * (1.0 + 0.22 * tuft[i] + 0.15 * clump[i])
        out[i, 0] += turf[i] * ((0.085 + 0.012 * clump[i]) * light - out[i, 0])
        out[i, 1] += turf[i] * (0.085 * light - out[i, 1])
        out[i, 2] += turf[i] * (0.038 * light - out[i, 2])


@jit(nogil=True, error_model="numpy")
def add_sand(x, y, ground, share, crest, finest, out):
    """Lay sand over `out` (N, 3) where `share` (0..1) says: debris in troughs, shell grit."""
    patch = _mixed(x, y, ground, 60, 0.9, finest, 0.7, 3)
    fine = _mixed(x, y, ground, 61, 0.05, finest, 0.7, 3)
    grain = _mixed(x, y, ground, 62, 0.008, finest, 0.7, 2)
    shells = ground.mix_seed + 63 if ground.mix > 0.5 else ground.seed + 63
    for i in range(x.size):
        if share[i] <= 0.0:
            continue
        light = 0.94 + 0.06 * patch[i] + 0.05 * fine[i] + 0.07 * grain[i]
        light = max(0.05, light + 0.22 * (crest[i] - 0.5))
        if finest < 0.02:
            light *= _shell(x[i], y[i], shells)
        out[i, 0] += share[i] * (light * ground.sand_red - out[i, 0])
        out[i, 1] += share[i] * (light * ground.sand_green - out[i, 1])
        out[i, 2] += share[i] * (light * ground.sand_blue - out[i, 2])


@jit(nogil=True, error_model="numpy")
def _shell(x, y, seed):
    """Brightness of a shell or pebble that lies here, 1 where there is none."""
    ix, iy = math.floor(x / 0.03), math.floor(y / 0.03)
    chance = hash01(ix, iy, seed)
    if chance >= 0.03:
        return 1.0
    cx = (ix + 0.3 + 0.4 * hash01(ix, iy, seed + 1)) * 0.03
    cy = (iy + 0.3 + 0.4 * hash01(ix, iy, seed + 2)) * 0.03
    near = math.hypot(x - cx, y - cy) / (0.004 + 0.004 * hash01(ix, iy, seed + 3))
    if near >= 1.0:
        return 1.0
    return 1.6 if chance < 0.017 else 0.45
