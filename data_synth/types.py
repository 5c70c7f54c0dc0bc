"""The generator's own records: what a site is made of, and one row per thing on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# What a feature is. Sediment and turf lie on the ground, the others stand on it.
(BOULDER, MASSIVE, BRANCHING, PLATE, ENCRUSTING, SOFT, SPONGE, URCHIN, KELP, SEDIMENT, TURF) = (
    range(11)
)
KINDS = (
    "boulder",
    "massive",
    "branching",
    "plate",
    "encrusting",
    "soft",
    "sponge",
    "urchin",
    "kelp",
    "sediment",
    "turf",
)
CORALS = (MASSIVE, BRANCHING, PLATE, ENCRUSTING, SOFT)

FEATURE = np.dtype(
    [
        ("kind", np.int64),
        ("id", np.int64),  # the same in both epochs
        ("seed", np.int64),
        ("x", np.float64),  # centre [m]
        ("y", np.float64),
        ("z", np.float64),  # height of the ground that it stands on [m]
        ("radius", np.float64),
        ("height", np.float64),
        ("turn", np.float64),  # direction of the long axis [rad]
        ("stretch", np.float64),  # long over short axis, >= 1
        ("red", np.float64),  # reflectance 0..1
        ("green", np.float64),
        ("blue", np.float64),
        ("bleached", np.float64),  # 0 its own color .. 1 white
        ("dead", np.float64),  # share of the surface that is dead and overgrown
        ("reach", np.float64),  # nothing of it is further from the centre [m]
    ]
)


class Ground(NamedTuple):
    """Numbers of the ground, in metres where they are lengths. One flat tuple for the kernel."""

    seed: int
    relief: float  # standard deviation of the largest octave
    relief_wavelength: float
    hurst: float  # how fast amplitude falls with wavelength
    step: float  # height of rock platforms above the lows
    step_wavelength: float
    step_level: float  # standard deviations above which there is a platform
    lump: float  # height of the largest rock lumps
    lump_cell: float
    lump_gain: float  # height ratio of each halving of the lumps' size
    broken_least: float  # roughness of the smoothest ground against the most broken
    grit: float  # standard deviation of the finest relief at 0.10 m
    sand_level: float  # height of the sand; -1e9 is none
    sand_relief: float
    ripple: float  # height of ripples
    ripple_wavelength: float
    ripple_turn: float  # direction that ripples travel [rad]
    ripple_wander: float  # how far crests stray, in wavelengths
    ripple_phase: float  # [wavelengths]
    rubble: float  # 0 none .. 1 everywhere outside the sand
    turf: float  # 0 bare .. 1 turf everywhere
    coralline: float  # 0..1 pink crusts
    patch: float  # contrast of bare and turfed patches of half a metre to two
    fine: float  # contrast of all that is smaller than a hand
    tone_red: float  # tint of the rock
    tone_green: float
    tone_blue: float
    sand_red: float
    sand_green: float
    sand_blue: float
    drift: float  # standard deviation of the height of sand that came or went [m]
    mix: float  # share of the texture that is the epoch's own, 0..1
    mix_seed: int
