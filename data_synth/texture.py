"""Reflectances (linear, 0 to 1) of what lives on a reef: names to choose from, by growth form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_synth.types import (
    BOULDER,
    BRANCHING,
    ENCRUSTING,
    KELP,
    MASSIVE,
    PLATE,
    SOFT,
    SPONGE,
    URCHIN,
)

# Judged by eye from reef photographs: mostly browns (the algae inside the coral), few bright ones.
PALETTE: dict[int, tuple[tuple[float, float, float], ...]] = {
    BOULDER: ((1.0, 1.0, 1.0), (0.80, 0.80, 0.82), (1.15, 1.10, 1.0), (0.9, 0.95, 0.85)),
    MASSIVE: (
        (0.30, 0.22, 0.10),
        (0.24, 0.17, 0.08),
        (0.22, 0.21, 0.08),
        (0.33, 0.27, 0.14),
        (0.17, 0.20, 0.10),
        (0.22, 0.17, 0.20),
    ),
    BRANCHING: (
        (0.30, 0.20, 0.09),
        (0.26, 0.19, 0.10),
        (0.36, 0.28, 0.14),
        (0.20, 0.19, 0.30),
        (0.34, 0.18, 0.19),
        (0.19, 0.22, 0.11),
    ),
    PLATE: ((0.24, 0.17, 0.08), (0.20, 0.17, 0.07), (0.28, 0.20, 0.12), (0.18, 0.19, 0.12)),
    ENCRUSTING: (
        (0.26, 0.17, 0.07),
        (0.34, 0.20, 0.06),
        (0.26, 0.14, 0.20),
        (0.40, 0.16, 0.04),
        (0.22, 0.24, 0.10),
    ),
    SOFT: ((0.40, 0.34, 0.20), (0.34, 0.28, 0.20), (0.30, 0.30, 0.18), (0.42, 0.36, 0.30)),
    SPONGE: ((0.35, 0.12, 0.05), (0.22, 0.12, 0.20), (0.38, 0.30, 0.08), (0.14, 0.13, 0.14)),
    URCHIN: ((0.010, 0.009, 0.012),),
    KELP: ((0.22, 0.14, 0.035), (0.19, 0.125, 0.04), (0.26, 0.17, 0.05)),
}


def choose_colors(
    kind: int, pick: NDArray[np.float64], shade: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (N, 3) reflectances of `kind`; `pick` and `shade` (N,) are uniform in 0..1."""
    table = np.array(PALETTE[kind])
    # early entries are the common ones
    index = np.minimum((pick**1.6 * len(table)).astype(int), len(table) - 1)
    light: NDArray[np.float64] = table[index] * (0.75 + 0.5 * shade)[:, None]
    return light
