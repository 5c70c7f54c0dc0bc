"""Things that stand on the ground: boulders, colonies, sponges, urchins, kelp.

Each is a function of the position relative to its own centre, so that it carries its surface
with it when it moves, and keeps the size of its branches when it grows.
"""

from __future__ import annotations

import math

from data_synth.noise_kernels import hash01, lumps_at, octaves
from data_synth.types import (
    BOULDER,
    BRANCHING,
    KELP,
    MASSIVE,
    PLATE,
    SEDIMENT,
    SOFT,
    SPONGE,
    TURF,
    URCHIN,
)
from meshreg.jit import jit

NOTHING = -1e30


@jit(nogil=True, error_model="numpy")
def ragged_radius(f, dx, dy, rough, finest):
    """Distance from the centre over the outline's distance there: 1 on the outline.

    The outline strays by at most ``2 * rough``, so that ``reach`` bounds it.
    """
    c, s = math.cos(f.turn), math.sin(f.turn)
    root = math.sqrt(f.stretch)
    a, b = (c * dx + s * dy) / (f.radius * root), (c * dy - s * dx) * root / f.radius
    rho = math.sqrt(a * a + b * b)
    if rough > 0.0 and rho * (1.0 - 2.0 * rough) < 1.0:
        stray = octaves(dx, dy, f.seed, 1.1 * f.radius, finest, 0.6, 3)
        rho *= 1.0 + rough * min(2.0, max(-2.0, stray))
    return rho


@jit(nogil=True, error_model="numpy")
def _boulder(f, dx, dy, finest):
    rho = ragged_radius(f, dx, dy, 0.05, finest)
    if rho >= 1.0:
        return NOTHING
    px, py = dx / f.radius, dy / f.radius
    up = math.sqrt(1.0 - rho * rho)
    up = up * (1.25 - 0.25 * up)
    for k in range(6):
        angle = 2.0 * math.pi * (k + 0.8 * hash01(k, 1, f.seed)) / 6.0
        steep = 0.35 + 1.3 * hash01(k, 2, f.seed)
        reach = 0.55 + 0.5 * hash01(k, 3, f.seed)
        face = 0.35 + (reach - px * math.cos(angle) - py * math.sin(angle)) * steep
        up = min(up, face)
    flat = 0.70 + 0.30 * hash01(9, 4, f.seed)
    tilt = 0.35 * (hash01(9, 5, f.seed) - 0.5) * px + 0.35 * (hash01(9, 6, f.seed) - 0.5) * py
    up = min(up, flat + tilt)
    rough = 0.035 * f.radius * octaves(dx, dy, f.seed + 3, 0.8 * f.radius, finest, 0.55, 6)
    return f.z + f.height * up + rough


@jit(nogil=True, error_model="numpy")
def _massive(f, dx, dy, base, finest):
    rho = ragged_radius(f, dx, dy, 0.07, finest)
    if rho >= 1.0:
        return NOTHING, 0.0
    cell = 0.10 + 0.18 * f.radius
    up, _ = lumps_at(dx / cell, dy / cell, f.seed + 5, 1.0)
    swell = octaves(dx, dy, f.seed + 8, 0.9 * f.radius, finest, 0.5, 3)
    folds = 0.0  # meandering valleys, as brain corals have
    if f.seed % 3 == 0:
        folds = 1.0 - min(1.0, 2.5 * abs(octaves(dx, dy, f.seed + 9, 0.055, finest, 0.4, 2)))
    dome = math.sqrt(1.0 - rho * rho)
    z = base + f.height * dome * (1.15 - 0.15 * dome + 0.06 * swell) + 0.10 * cell * up * dome
    return z - 0.004 * folds, 0.50 + 0.10 * up + 0.08 * swell + 0.10 * dome - 0.28 * folds


@jit(nogil=True, error_model="numpy")
def _branching(f, dx, dy, base, finest):
    rho = ragged_radius(f, dx, dy, 0.13, finest)
    if rho >= 1.0:
        return NOTHING, 0.0
    cell = 0.030 + 0.045 * hash01(1, 1, f.seed)
    bend = 0.4 * cell * octaves(dx, dy, f.seed + 8, 5.0 * cell, finest, 0.5, 1)
    tip, _ = lumps_at((dx + bend) / cell, (dy - bend) / cell, f.seed + 5, 1.0)
    second, _ = lumps_at((dy + bend) / cell + 0.37, dx / cell + 0.71, f.seed + 6, 0.9)
    tip = max(tip, 0.85 * second)
    crown = (1.0 - rho * rho * rho) * (
        0.85 + 0.15 * octaves(dx, dy, f.seed + 9, 0.9 * f.radius, finest, 0.5, 2)
    )
    if 0.5 * cell < finest:
        tip = 0.55
    z = base + f.height * max(0.0, crown) * (0.45 + 0.55 * tip)
    return z, tip


@jit(nogil=True, error_model="numpy")
def _plate(f, dx, dy, finest):
    rho = ragged_radius(f, dx, dy, 0.12, finest)
    if rho >= 1.0:
        return NOTHING, 0.0
    cell = 0.022
    knob, _ = lumps_at(dx / cell, dy / cell, f.seed + 5, 1.0)
    if 0.5 * cell < finest:
        knob = 0.4
    wave = octaves(dx, dy, f.seed + 8, 0.8 * f.radius, finest, 0.5, 3)
    z = f.z + f.height * (1.0 - 0.12 * (1.0 - rho) + 0.07 * wave) + 0.012 * knob
    return z, rho * 0.75 + 0.25 * knob


@jit(nogil=True, error_model="numpy")
def _soft(f, dx, dy, base, finest):
    rho = ragged_radius(f, dx, dy, 0.14, finest)
    if rho >= 1.0:
        return NOTHING, 0.0
    cell = 0.07
    up, own = lumps_at(dx / cell, dy / cell, f.seed + 5, 1.0)
    z = base + f.height * (1.0 - rho * rho) * (0.6 + 0.4 * up)
    return z, 0.25 + 0.5 * up + 0.25 * own


@jit(nogil=True, error_model="numpy")
def _sponge(f, dx, dy, finest):
    rho = ragged_radius(f, dx, dy, 0.06, finest)
    if rho >= 1.0:
        return NOTHING, 0.0
    ring = 1.0 - ((rho - 0.65) / 0.35) ** 2 if rho > 0.65 else 1.0 - 0.7 * (1.0 - rho / 0.65)
    ridge = octaves(dx, dy, f.seed + 5, 0.08, finest, 0.6, 3)
    return f.z + f.height * max(0.0, ring) * (1.0 + 0.06 * ridge), 0.15 + 0.75 * max(0.0, ring)


@jit(nogil=True, error_model="numpy")
def _urchin(f, dx, dy, base):
    d = math.sqrt(dx * dx + dy * dy) / f.radius
    if d >= 1.0:
        return NOTHING
    spines = 0.5 + 0.5 * math.sin(23.0 * math.atan2(dy, dx) + f.seed % 7)
    if d > 0.45 + 0.5 * spines:
        return NOTHING
    return base + f.height * (1.0 - d)


@jit(nogil=True, error_model="numpy")
def _kelp(f, dx, dy, finest):
    """Blades from one holdfast: `turn` is where the swell lays them in this epoch."""
    best, mark = NOTHING, 0.0
    for k in range(7):
        angle = f.turn + 1.3 * (hash01(k, 1, f.seed) - 0.5)
        c, s = math.cos(angle), math.sin(angle)
        length = f.radius * (0.55 + 0.4 * hash01(k, 2, f.seed))
        along = (c * dx + s * dy) / length
        if along < 0.0 or along > 1.0:
            continue
        bend = 0.35 * (hash01(k, 3, f.seed) - 0.5) + 0.2 * math.sin(3.0 * f.turn)
        across = (c * dy - s * dx) - bend * along * along * length
        frill = 1.0 + 0.25 * octaves(along * length, 0.3 * k, f.seed + 10 + k, 0.12, finest, 0.6, 2)
        wide = 0.5 * (0.05 + 0.07 * hash01(k, 4, f.seed)) * frill
        wide *= math.sqrt(max(0.0, math.sin(math.pi * min(1.0, 0.12 + 0.88 * along))))
        if abs(across) >= wide:
            continue
        z = f.z + f.height * (0.35 + 0.65 * math.sin(1.9 * along)) + 0.02 * k
        if z > best:
            best = z
            mark = 0.55 + 0.35 * (across / wide) ** 2 + 0.2 * (hash01(k, 5, f.seed) - 0.5)
    return best, mark


@jit(nogil=True, error_model="numpy")
def _white(f, r, g, b, light):
    """Return the color after bleaching: white with a trace of its own tint."""
    share = f.bleached
    tone = 0.40 + 0.26 * light
    return (
        r + share * (tone * 1.02 - r),
        g + share * (tone * 0.96 - g),
        b + share * (tone * 0.80 - b),
    )


@jit(nogil=True, error_model="numpy")
def _living(f, dx, dy, mark, finest):
    """Color of a coral's living tissue: `mark` is 0 in the gaps, 1 at tips, lobes and rims."""
    fine = octaves(dx, dy, f.seed + 14, 0.05, finest, 0.6, 3)
    polyps = octaves(dx, dy, f.seed + 15, 0.011, finest, 0.7, 2)
    light = 0.55 + 0.7 * mark
    light *= 1.0 + 0.15 * fine + 0.08 * polyps
    r, g, b = f.red * light, f.green * light, f.blue * light
    if f.kind in (BRANCHING, PLATE):
        pale = max(0.0, mark - 0.72) / 0.28
        pale = pale * pale * 0.55
        r, g, b = r + pale * (0.55 - r), g + pale * (0.50 - g), b + pale * (0.42 - b)
    return _white(f, r, g, b, light)


@jit(nogil=True, error_model="numpy")
def _overgrown(f, dx, dy, mark, finest):
    fine = octaves(dx, dy, f.seed + 16, 0.06, finest, 0.7, 3)
    grain = octaves(dx, dy, f.seed + 17, 0.010, finest, 0.7, 2)
    light = (0.06 + 0.05 * mark) * (1.0 + 0.25 * fine + 0.18 * grain)
    return 1.12 * light, 1.05 * light, 0.68 * light


@jit(nogil=True, error_model="numpy")
def is_dead_here(f, dx, dy, finest):
    """Whether the surface is dead: whole patches, so that `dead` is the share of the area."""
    if f.dead <= 0.0:
        return False
    if f.dead >= 1.0:
        return True
    field = octaves(dx, dy, f.seed + 18, 0.9 * f.radius, finest, 0.5, 3)
    return field < 2.9 * (f.dead - 0.5)


@jit(nogil=True, error_model="numpy")
def feature_height(f, x, y, ground_z, finest):
    """Return the height of a feature at a point (or NOTHING) and the mark that its color needs."""
    dx, dy = x - f.x, y - f.y
    kind = f.kind
    if dx * dx + dy * dy > f.reach * f.reach or kind in (SEDIMENT, TURF):
        return NOTHING, 0.0
    base = f.z + 0.35 * (ground_z - f.z)
    if kind == BOULDER:
        return _boulder(f, dx, dy, finest), 0.5
    if kind == MASSIVE:
        return _massive(f, dx, dy, base, finest)
    if kind == BRANCHING:
        return _branching(f, dx, dy, base, finest)
    if kind == PLATE:
        return _plate(f, dx, dy, finest)
    if kind == SOFT:
        return _soft(f, dx, dy, base, finest)
    if kind == SPONGE:
        return _sponge(f, dx, dy, finest)
    if kind == URCHIN:
        return _urchin(f, dx, dy, ground_z), 0.5
    if kind == KELP:
        return _kelp(f, dx, dy, finest)
    rho = ragged_radius(f, dx, dy, 0.15, finest)  # encrusting
    if rho >= 1.0:
        return NOTHING, 0.0
    up, own = lumps_at(dx / 0.05, dy / 0.05, f.seed + 5, 0.9)
    return ground_z + f.height * (1.0 - rho * rho) * (0.7 + 0.3 * up), 0.4 + 0.4 * own


@jit(nogil=True, error_model="numpy")
def feature_color(f, dx, dy, mark, finest):
    """Return the reflectance of a feature (boulders excepted) at a point from its centre [m]."""
    if f.kind == URCHIN:
        return f.red, f.green, f.blue
    if f.kind == KELP:
        return f.red * mark, f.green * mark, f.blue * mark
    if is_dead_here(f, dx, dy, finest):
        return _overgrown(f, dx, dy, mark, finest)
    return _living(f, dx, dy, mark, finest)
