"""The seafloor as a function: height and reflectance at any point, for a site, a seed, an epoch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from data_synth import types as t
from data_synth.colonies import place, uniform
from data_synth.sites import Site

Float64 = NDArray[np.float64]
Bounds = tuple[float, float, float, float]  # west, south, east, north [m]
BIN = 0.25  # side of a cell of the feature index [m]


def bare_ground(site: Site, seed: int) -> t.Ground:
    """Return the numbers of the rock alone, without its sand."""
    return t.Ground(
        seed=seed,
        relief=site.relief,
        relief_wavelength=site.relief_wavelength,
        hurst=site.hurst,
        step=site.step,
        step_wavelength=site.step_wavelength,
        step_level=site.step_level,
        lump=site.lump,
        lump_cell=site.lump_cell,
        lump_gain=site.lump_gain,
        broken_least=site.broken_least,
        grit=site.grit,
        sand_level=-1e9,
        sand_relief=site.sand_relief,
        ripple=site.ripple,
        ripple_wavelength=site.ripple_wavelength,
        ripple_turn=float(uniform(np.array([0]), 90, seed)[0] * math.pi),
        ripple_wander=site.ripple_wander,
        ripple_phase=0.0,
        rubble=site.rubble,
        turf=site.turf,
        coralline=site.coralline,
        patch=site.patch,
        fine=site.fine,
        tone_red=site.tone[0],
        tone_green=site.tone[1],
        tone_blue=site.tone[2],
        sand_red=site.sand_tone[0],
        sand_green=site.sand_tone[1],
        sand_blue=site.sand_tone[2],
        drift=0.0,
        mix=0.0,
        mix_seed=0,
    )


@lru_cache(maxsize=64)
def ground_of(site: Site, seed: int) -> t.Ground:
    """Return the ground's numbers; the sand stands so high that it covers `site.sand` of 30 m."""
    from data_synth.seafloor_kernels import evaluate_ground

    ground = bare_ground(site, seed)
    if site.sand <= 0.0:
        return ground
    side = np.linspace(-15.0, 15.0, 61)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    rock, _ = evaluate_ground(x, y, ground, 0.05)
    level = np.quantile(rock, min(site.sand, 1.0)) + (0.5 if site.sand >= 1.0 else 0.0)
    return ground._replace(sand_level=float(level))


@dataclass(frozen=True, eq=False)
class Seafloor:
    """One epoch of a piece of the world: `bounds` says where its features are complete.

    Attributes
    ----------
    ground : Ground
    features : (N,) structured array of `data_synth.types.FEATURE`
    bounds : west, south, east, north [m]
    """

    ground: t.Ground
    features: NDArray[np.void]
    bounds: Bounds

    def __post_init__(self) -> None:
        object.__setattr__(self, "_index", _index(self.features, self.bounds))

    def evaluate(
        self, x: Float64, y: Float64, finest: float = 0.0
    ) -> tuple[Float64, NDArray[np.float32], NDArray[np.int32]]:
        """Return height [m], reflectance (..., 3) and the number of the feature on top.

        Parameters
        ----------
        x, y : float64 arrays of one shape
            World coordinates [m].
        finest : float
            Relief and texture shorter than this wavelength [m] are left out (they average to
            nothing over samples twice as dense).

        Returns
        -------
        height : float64, reflectance : float32, winner : int32
            `winner` indexes `features`; -1 is bare ground.
        """
        from data_synth.seafloor_kernels import evaluate

        height, color, winner = evaluate(*self._points(x, y), finest)
        return height.reshape(x.shape), color.reshape(*x.shape, 3), winner.reshape(x.shape)

    def height(self, x: Float64, y: Float64, finest: float = 0.0) -> Float64:
        """Return the height [m] at world coordinates `x`, `y` [m]."""
        from data_synth.seafloor_kernels import evaluate_height

        height: Float64 = evaluate_height(*self._points(x, y), finest).reshape(x.shape)
        return height

    def _points(self, x: Float64, y: Float64) -> tuple[object, ...]:
        x = np.ascontiguousarray(x, np.float64).ravel()
        y = np.ascontiguousarray(y, np.float64).ravel()
        return (x, y, self.ground, self.features, *self._index)  # type: ignore[attr-defined]


def _index(
    features: NDArray[np.void], bounds: Bounds
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64, Float64]:
    """List for each cell of a lattice the features that may reach it (compressed rows)."""
    west, south, east, north = bounds
    cols = max(1, math.ceil((east - west) / BIN))
    rows = max(1, math.ceil((north - south) / BIN))
    low_col = np.clip(np.floor((features["x"] - features["reach"] - west) / BIN), 0, cols)
    high_col = np.clip(np.floor((features["x"] + features["reach"] - west) / BIN) + 1, 0, cols)
    low_row = np.clip(np.floor((features["y"] - features["reach"] - south) / BIN), 0, rows)
    high_row = np.clip(np.floor((features["y"] + features["reach"] - south) / BIN) + 1, 0, rows)
    cells, members = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for k in range(len(features)):
        r = np.arange(low_row[k], high_row[k], dtype=np.int64)
        c = np.arange(low_col[k], high_col[k], dtype=np.int64)
        both = (r[:, None] * cols + c).ravel()
        cells.append(both)
        members.append(np.full(len(both), k, np.int64))
    cell, member = np.concatenate(cells), np.concatenate(members)
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(rows * cols + 1))
    corner, bins = np.array([west, south]), np.array([cols, rows, BIN])
    return starts.astype(np.int64), member[order], corner, bins


def features_of(site: Site, seed: int, bounds: Bounds) -> NDArray[np.void]:
    """Return what stands in `bounds` at the first epoch, sorted by id.

    Corals keep to stands (`site.cluster`) and off the sand; everything knows the height of the
    ground below it.
    """
    from data_synth.seafloor_kernels import evaluate_ground, evaluate_noise

    ground = ground_of(site, seed)
    kept = []
    for rows in place(site, seed, bounds):
        kind = int(rows["kind"][0]) if len(rows) else 0
        height, sandy = evaluate_ground(rows["x"].copy(), rows["y"].copy(), ground, 0.10)
        stand = evaluate_noise(rows["x"].copy(), rows["y"].copy(), seed + 70 + kind % 3, 3.5)
        chance = 1.0 - site.cluster * (0.5 - 0.5 * np.tanh(1.5 * stand))
        chance = np.where(sandy > 0.3, 0.35 if kind == t.BOULDER else 0.03, chance)
        rows["z"] = height
        alive = uniform(rows["id"], 11, seed) < chance
        kept.append(rows[alive])
    everything = np.concatenate(kept) if kept else np.zeros(0, t.FEATURE)
    west, south, east, north = bounds
    x, y, r = everything["x"], everything["y"], everything["reach"]
    near = (x + r > west) & (x - r < east) & (y + r > south) & (y - r < north)
    everything = everything[near]
    return everything[np.argsort(everything["id"], kind="stable")]


def make_seafloor(site: Site, seed: int, bounds: Bounds) -> Seafloor:
    """Return the first epoch of the world `seed` within `bounds`."""
    return Seafloor(ground_of(site, seed), features_of(site, seed, bounds), bounds)
