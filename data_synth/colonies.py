"""Where boulders, colonies and plants stand: drawn per square of an endless chessboard.

Whatever part of the world is asked for, the same things stand in it, each with a number (`id`)
that stays its own through all epochs and from which its fate is drawn.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from data_synth import types as t
from data_synth.texture import choose_colors

if TYPE_CHECKING:
    from data_synth.sites import Site

Float64 = NDArray[np.float64]
SQUARE = 4.0  # side of a square of the chessboard [m]
_HALF = 1 << 19


def uniform(ids: NDArray[np.int64], salt: int, seed: int) -> Float64:
    """Return a number in [0, 1) for each id; `salt` tells the draws of one id apart.

    The mixer is SplitMix64 (Steele, Lea, Flood, OOPSLA 2014, figure 17).
    """
    mask = (1 << 64) - 1
    key = np.uint64((salt * 0x9E3779B97F4A7C15 + seed * 0xD1B54A32D192ED03) & mask)
    z = ids.astype(np.uint64) + key
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        z = (z ^ (z >> np.uint64(shift))) * np.uint64(factor)
    z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)).astype(np.float64) * 2.0**-53


def candidates(
    kind: int, density: float, bounds: tuple[float, float, float, float], seed: int, layer: int = 0
) -> tuple[NDArray[np.int64], Float64, Float64]:
    """Return ids and places (x, y) [m] at `density` per square metre on all squares in `bounds`."""
    west, south, east, north = (math.floor(v / SQUARE) for v in bounds)
    most = max(1, math.ceil(2.0 * density * SQUARE**2))
    ix, iy, j = np.meshgrid(
        np.arange(west, east + 1), np.arange(south, north + 1), np.arange(most), indexing="ij"
    )
    ix, iy, j = (a.ravel().astype(np.int64) for a in (ix, iy, j))
    ids = ((((layer * 16 + kind) << 20 | (ix + _HALF)) << 20) | (iy + _HALF)) << 12 | j
    kept = uniform(ids, 1, seed) < density * SQUARE**2 / most
    ids, ix, iy = ids[kept], ix[kept], iy[kept]
    x = (ix + uniform(ids, 2, seed)) * SQUARE
    y = (iy + uniform(ids, 3, seed)) * SQUARE
    return ids, x, y


def power_law(u: Float64, low: float, high: float, exponent: float) -> Float64:
    """Turn uniform numbers into sizes whose density falls as ``size ** -(exponent + 1)``."""
    if high <= low:
        return np.full_like(u, low)
    a, b = low**-exponent, high**-exponent
    size: Float64 = (a + u * (b - a)) ** (-1.0 / exponent)
    return size


# radius from, to [m], size exponent, height over radius from, to, most stretch, outline's reach
FORMS: dict[int, tuple[float, float, float, float, float, float, float]] = {
    t.BOULDER: (0.18, 1.30, 1.3, 0.55, 1.05, 2.2, 1.12),
    t.MASSIVE: (0.06, 1.00, 1.4, 0.55, 0.95, 1.5, 1.17),
    t.BRANCHING: (0.08, 0.60, 1.3, 0.45, 0.75, 1.5, 1.36),
    t.PLATE: (0.10, 0.80, 1.2, 0.25, 0.50, 1.4, 1.33),
    t.ENCRUSTING: (0.05, 0.35, 1.6, 0.05, 0.12, 2.2, 1.43),
    t.SOFT: (0.06, 0.35, 1.5, 0.30, 0.55, 1.6, 1.40),
    t.SPONGE: (0.05, 0.22, 1.5, 0.80, 1.60, 1.3, 1.15),
    t.URCHIN: (0.05, 0.09, 1.5, 0.70, 0.80, 1.0, 1.01),
    t.KELP: (0.45, 1.10, 1.0, 0.20, 0.35, 1.0, 1.30),
}


def make_features(
    kind: int, ids: NDArray[np.int64], x: Float64, y: Float64, seed: int, size: float = 1.0
) -> NDArray[np.void]:
    """Return rows for things of one kind at given places; `z` is left at 0."""
    low, high, exponent, flat, tall, stretch, reach = FORMS[kind]
    rows = np.zeros(len(ids), t.FEATURE)
    rows["kind"], rows["id"], rows["x"], rows["y"] = kind, ids, x, y
    rows["seed"] = (uniform(ids, 4, seed) * 2**31).astype(np.int64)
    rows["radius"] = power_law(uniform(ids, 5, seed), low, high * size, exponent)
    # large ones are flatter than small ones, as on reefs
    ratio = flat + (tall - flat) * uniform(ids, 6, seed) * (low / rows["radius"]) ** 0.15
    rows["height"] = rows["radius"] * ratio
    rows["turn"] = 2.0 * math.pi * uniform(ids, 7, seed)
    rows["stretch"] = 1.0 + (stretch - 1.0) * uniform(ids, 8, seed) ** 1.5
    color = choose_colors(kind, uniform(ids, 9, seed), uniform(ids, 10, seed))
    rows["red"], rows["green"], rows["blue"] = color.T
    set_reach(rows, reach)
    return rows


def set_reach(rows: NDArray[np.void], share: float | None = None) -> None:
    """Set `reach` from radius and stretch, in place; must follow each change of a radius."""
    by_kind = np.array([FORMS[k][6] if k in FORMS else 1.48 for k in range(len(t.KINDS))])
    outline = by_kind[rows["kind"]] if share is None else share
    rows["reach"] = outline * rows["radius"] * np.sqrt(rows["stretch"])


def place(
    site: Site, seed: int, bounds: tuple[float, float, float, float]
) -> list[NDArray[np.void]]:
    """Return candidate rows of every kind near `bounds`, before the ground thins them out."""
    west, south, east, north = bounds
    wide = (west - 2.5, south - 2.5, east + 2.5, north + 2.5)
    rows = []
    for kind, density in site.densities().items():
        if density > 0:
            ids, x, y = candidates(kind, density, wide, seed)
            size = site.boulder_size if kind == t.BOULDER else site.coral_size
            rows.append(make_features(kind, ids, x, y, seed, size))
    return rows
