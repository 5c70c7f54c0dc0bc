"""The ground: rock, rubble and sand, as functions of position."""

from __future__ import annotations

import math

from data_synth.noise_kernels import hash01, lumps, octaves, smoothstep
from meshreg.jit import jit


@jit(nogil=True)
def _mixed(x, y, ground, salt, wavelength, finest, count):
    """Noise whose share `ground.mix` belongs to the epoch; its variance does not change."""
    value = octaves(x, y, ground.seed + salt, wavelength, finest, 0.7, count)
    if ground.mix > 0.0:
        own = octaves(x, y, ground.mix_seed + salt, wavelength, finest, 0.7, count)
        value = value * math.sqrt(1.0 - ground.mix * ground.mix) + own * ground.mix
    return value


@jit(nogil=True)
def sand_height(x, y, ground, finest):
    """Height of the sand sheet [m] and the ripple's phase, 0 in the trough to 1 on the crest."""
    z = ground.sand_level + ground.sand_relief * octaves(x, y, ground.seed + 11, 5.0, finest, 0.5, 3)
    crest = 0.5
    if ground.ripple > 0.0 and ground.ripple_wavelength > finest:
        c, s = math.cos(ground.ripple_turn), math.sin(ground.ripple_turn)
        long = ground.ripple_wavelength
        stray = octaves(x, y, ground.seed + 12, 14.0 * long, finest, 0.6, 3)
        phase = (c * x + s * y) / long + ground.ripple_wander * stray + ground.ripple_phase
        # steep lee sides, and crests that die out and start anew where two trains meet
        angle = 2.0 * math.pi * phase
        wave = math.sin(angle + 0.5 * math.sin(angle))
        if ground.ripple_wander > 0.2:
            other = 2.0 * math.pi * (1.13 * phase + 0.35 * (c * y - s * x) / long)
            blend = smoothstep(-0.3, 0.5, octaves(x, y, ground.seed + 13, 12.0 * long, finest, 0.5, 2))
            wave += blend * (math.sin(other + 0.5 * math.sin(other)) - wave)
        fade = min(1.0, (long - finest) / finest) if finest > 0 else 1.0
        patch = smoothstep(-1.2, 0.3, octaves(x, y, ground.seed + 14, 3.5, finest, 0.5, 2))
        z += 0.5 * ground.ripple * wave * fade * (0.25 + 0.75 * patch)
        crest = 0.5 + 0.4 * wave * fade
    return z, crest


@jit(nogil=True)
def rock_height(x, y, ground, finest):
    """Height of the rock [m], the shade of the lump here (0..1) and how much rubble covers it."""
    gain = 0.5**ground.hurst
    wx = x + 0.035 * octaves(x, y, ground.seed + 1, 0.9, finest, 0.45, 2)
    wy = y + 0.035 * octaves(x, y, ground.seed + 2, 0.9, finest, 0.45, 2)
    z = ground.relief * octaves(
        x, y, ground.seed + 3, ground.relief_wavelength, finest, gain, 5
    )
    if ground.step > 0.0:
        high = octaves(wx, wy, ground.seed + 4, ground.step_wavelength, finest, 0.42, 4)
        z += ground.step * (
            smoothstep(-0.05, 0.05, high - ground.step_level)
            + 0.6 * smoothstep(-0.05, 0.05, high - ground.step_level - 0.7)
        )
    shade = 0.5
    cell, tall = ground.lump_cell, ground.lump
    presence = 0.55
    rough = 1.0
    for k in range(5):
        if tall <= 0.0 or cell * 0.5 < finest:
            break
        turned = 1.7 * k + 0.4
        c, s = math.cos(turned), math.sin(turned)
        up, own = lumps(
            (c * wx - s * wy) / cell, (s * wx + c * wy) / cell, ground.seed + 20 + k, presence
        )
        z += tall * rough * up
        if up > 0.0 and k >= 1:
            shade = shade * 0.4 + own * 0.6
        if k == 1:  # some ground is smooth, some broken
            calm = octaves(x, y, ground.seed + 7, 1.6, finest, 0.6, 3)
            rough = ground.broken_least + (1.0 - ground.broken_least) * smoothstep(-1.2, 1.4, calm)
        cell *= 0.42
        tall *= ground.lump_gain
        presence = 0.85
    cover = 0.0
    if ground.rubble > 0.0:
        zone = octaves(x, y, ground.seed + 5, 3.0, finest, 0.6, 4)
        edge = 2.4 * (0.5 - ground.rubble)
        cover = smoothstep(edge - 0.25, edge + 0.35, zone)
        if cover > 0.0:
            for k in range(2):
                size = 0.11 if k == 0 else 0.05
                if size * 0.5 > finest:
                    up, own = lumps(
                        wx / size + 0.3 * k, wy / size, ground.seed + 40 + k, 0.95
                    )
                    z += cover * 0.28 * size * up
                    if up > 0.0:
                        shade = shade * (1.0 - cover) + own * cover
    z += ground.grit * rough * octaves(x, y, ground.seed + 6, 0.20, finest, gain, 5)
    return z, shade, cover


@jit(nogil=True)
def ground_at(x, y, ground, finest):
    """Return height [m], sandiness 0..1, ripple crest 0..1, shade 0..1 and rubble 0..1."""
    rock, shade, cover = rock_height(x, y, ground, finest)
    if ground.sand_level < -1e8:
        return rock, 0.0, 0.5, shade, cover
    sand, crest = sand_height(x, y, ground, finest)
    wet = smoothstep(-0.025, 0.035, sand - rock)
    return rock + (max(sand, rock - 0.02) - rock) * wet, wet, crest, shade, cover


@jit(nogil=True)
def rock_color(x, y, ground, shade, cover, finest):
    """Reflectance of rock, turf, coralline crust and rubble."""
    zone = octaves(x, y, ground.seed + 50, 1.3, finest, 0.6, 2)
    patch = _mixed(x, y, ground, 51, 0.35, finest, 3)
    fine = _mixed(x, y, ground, 52, 0.055, finest, 3)
    grain = _mixed(x, y, ground, 53, 0.010, finest, 2)
    # bare limestone or basalt
    light = 0.17 * (0.50 + 0.95 * shade) * (1.0 + 0.14 * patch + 0.16 * fine + 0.14 * grain)
    r, g, b = light * ground.tone_red, light * ground.tone_green, light * ground.tone_blue
    # turf: olive to brown, darker, in patches with ragged edges
    t = ground.turf * smoothstep(-1.3, 0.9, 0.7 * zone + patch + 0.35 * fine + 1.6 * ground.turf - 0.6)
    hue = 0.5 + 0.25 * patch
    low = 0.080 * (0.65 + 0.7 * shade) * (1.0 + 0.22 * fine + 0.20 * grain)
    r += t * (low * (1.05 + 0.25 * hue) - r)
    g += t * (low * (0.96 - 0.10 * hue) - g)
    b += t * (low * (0.50 - 0.12 * hue) - b)
    # coralline algae: mauve and pink crusts with sharp borders
    pink = ground.coralline * smoothstep(0.55, 0.8, 0.5 * zone - 0.55 * patch + 0.45 * fine + 0.4 * (shade - 0.5))
    low = 0.20 * (1.0 + 0.15 * fine + 0.12 * grain)
    r += pink * (low * 1.15 - r)
    g += pink * (low * 0.72 - g)
    b += pink * (low * 0.82 - b)
    if cover > 0.0:
        low = (0.10 + 0.20 * shade * shade) * (1.0 + 0.15 * fine + 0.18 * grain)
        r += 0.8 * cover * (low * 1.02 - r)
        g += 0.8 * cover * (low * 0.96 - g)
        b += 0.8 * cover * (low * 0.80 - b)
    return max(r, 0.004), max(g, 0.004), max(b, 0.004)


@jit(nogil=True)
def sand_color(x, y, ground, crest, finest):
    """Reflectance of sand: fines and dark debris in the troughs, shell grit scattered."""
    patch = _mixed(x, y, ground, 60, 0.9, finest, 3)
    fine = _mixed(x, y, ground, 61, 0.05, finest, 3)
    grain = _mixed(x, y, ground, 62, 0.008, finest, 2)
    light = 0.94 + 0.06 * patch + 0.05 * fine + 0.07 * grain + 0.22 * (crest - 0.5)
    r, g, b = light * ground.sand_red, light * ground.sand_green, light * ground.sand_blue
    if finest < 0.02:  # shells and pebbles
        ix, iy = math.floor(x / 0.03), math.floor(y / 0.03)
        chance = hash01(ix, iy, ground.mix_seed + 63 if ground.mix > 0.5 else ground.seed + 63)
        if chance < 0.03:
            cx = (ix + 0.3 + 0.4 * hash01(ix, iy, ground.seed + 64)) * 0.03
            cy = (iy + 0.3 + 0.4 * hash01(ix, iy, ground.seed + 65)) * 0.03
            near = math.hypot(x - cx, y - cy) / (0.004 + 0.004 * hash01(ix, iy, ground.seed + 66))
            if near < 1.0:
                tint = 1.6 if chance < 0.017 else 0.45
                r, g, b = r * tint, g * tint, b * tint
    return max(r, 0.004), max(g, 0.004), max(b, 0.004)
