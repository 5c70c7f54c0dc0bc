"""What happens to the seafloor between two surveys, and the record of it.

Each class has a strength from 0 (nothing) to 1 (as much as a reef ever sees in years). What
befalls a colony is drawn from its own id, so that a stronger change includes the weaker one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth import types as t
from data_synth.colonies import candidates, make_features, set_reach, uniform
from data_synth.seafloor import Seafloor
from data_synth.sites import Site
from meshreg.errors import UsageError

Rows = NDArray[np.void]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Change:
    """Strength of each class of change, 0 to 1.

    `bleaching`, `mortality`, `partial_mortality`, `breakage`, `boulders`, `mobile` are shares of
    what could change; `growth` 1 is two years; `recruits` the share of new colonies; `turf` about
    the share of the ground that is newly covered, `sediment` half as much of it, and the sand that
    was there rises or falls and lies in other heaps; `ripples` and `kelp` how far from where they
    were; `texture` the part of the fine texture, of the grit and of the rubble that is new.
    """

    growth: float = 0.0
    bleaching: float = 0.0
    partial_mortality: float = 0.0
    mortality: float = 0.0
    breakage: float = 0.0
    recruits: float = 0.0
    turf: float = 0.0
    boulders: float = 0.0
    ripples: float = 0.0
    sediment: float = 0.0
    texture: float = 0.0
    kelp: float = 0.0
    mobile: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not 0.0 <= value <= 1.0:
                raise UsageError(f"change.{item.name} is {value}; it must be 0 to 1.")


# metres a year in radius and height (order of magnitude: tables of coral growth rates)
_GROWTH = {
    t.MASSIVE: (0.010, 0.010),
    t.BRANCHING: (0.045, 0.040),
    t.PLATE: (0.055, 0.010),
    t.ENCRUSTING: (0.020, 0.001),
    t.SOFT: (0.020, 0.015),
    t.SPONGE: (0.010, 0.015),
}


@dataclass(frozen=True, eq=False)
class Event:
    """One thing that changed: the classes, the thing, and where (centre and radius [m])."""

    classes: tuple[str, ...]
    kind: str
    id: int
    circles: tuple[tuple[float, float, float], ...]


def apply_change(
    before: Seafloor, site: Site, seed: int, change: Change
) -> tuple[Seafloor, tuple[Event, ...]]:
    """Return the second epoch of a seafloor and what happened, one event a changed thing."""
    old = before.features
    new = old.copy()
    marks: dict[str, Mask] = {}
    ids, coral = old["id"], np.isin(old["kind"], t.CORALS)
    _bleach_and_kill(new, coral, ids, seed, change, marks)
    _grow(new, ids, seed, change, marks)
    gone = coral & (uniform(ids, 30, seed) < change.breakage)
    _move(new, before, ids, seed, change, marks)
    set_reach(new)
    ground = _new_ground(before.ground, seed, change)
    added = _additions(before, site, seed, change)
    features = np.concatenate([new[~gone], added])
    features = features[np.argsort(features["id"], kind="stable")]
    marks = {name: mask & ~gone for name, mask in marks.items()}
    marks["breakage"] = gone
    events = _events(old, new, marks) + _added_events(added)
    return Seafloor(ground, features, before.bounds), events


def _bleach_and_kill(
    new: Rows, coral: Mask, ids: Any, seed: int, change: Change, marks: dict[str, Mask]
) -> None:
    killed = coral & (uniform(ids, 20, seed) < change.mortality) & (new["dead"] < 1.0)
    partly = coral & ~killed & (uniform(ids, 21, seed) < change.partial_mortality)
    partly &= new["dead"] < 1.0
    share = np.maximum(new["dead"], 0.2 + 0.6 * uniform(ids, 22, seed))
    partly &= share > new["dead"]
    white = coral & ~killed & (new["dead"] < 1.0) & (uniform(ids, 23, seed) < change.bleaching)
    new["dead"] = np.where(killed, 1.0, np.where(partly, share, new["dead"]))
    # what has died is worn down
    new["height"] = np.where(
        killed, new["height"] * (0.95 - 0.25 * uniform(ids, 24, seed)), new["height"]
    )
    new["bleached"] = np.where(white, 0.75 + 0.25 * uniform(ids, 25, seed), new["bleached"])
    marks.update(mortality=killed, partial_mortality=partly, bleaching=white)


def _grow(new: Rows, ids: Any, seed: int, change: Change, marks: dict[str, Mask]) -> None:
    alive = np.isin(new["kind"], list(_GROWTH)) & (new["dead"] < 1.0)
    years = 2.0 * change.growth * (0.4 + 1.2 * uniform(ids, 26, seed))
    for kind, (wide, tall) in _GROWTH.items():
        one = alive & (new["kind"] == kind)
        # white or half-dead colonies hardly grow; small ones cannot outgrow their kind's pace
        pace = years * (1.0 - 0.8 * new["bleached"]) * (1.0 - new["dead"])
        new["radius"] = np.where(one, new["radius"] + wide * pace, new["radius"])
        new["height"] = np.where(one, new["height"] + tall * pace, new["height"])
    marks["growth"] = alive & (years > 0)


def _move(
    new: Rows, before: Seafloor, ids: Any, seed: int, change: Change, marks: dict[str, Mask]
) -> None:
    """Roll boulders, let urchins walk, lay kelp another way."""
    boulder = (new["kind"] == t.BOULDER) & (uniform(ids, 27, seed) < change.boulders)
    walker = (new["kind"] == t.URCHIN) & (uniform(ids, 27, seed) < change.mobile)
    far = np.where(walker, 1.0, 0.4 + 1.6 * uniform(ids, 28, seed) * new["radius"])
    angle = 2.0 * math.pi * uniform(ids, 29, seed)
    moved = boulder | walker
    x = np.where(moved, new["x"] + far * np.cos(angle), new["x"])
    y = np.where(moved, new["y"] + far * np.sin(angle), new["y"])
    if moved.any():
        from data_synth.seafloor_kernels import evaluate_ground

        level, _ = evaluate_ground(x[moved], y[moved], before.ground, 0.10)
        z = new["z"].copy()
        z[moved] = level
        new["z"] = z
    new["x"], new["y"] = x, y
    kelp = (new["kind"] == t.KELP) & (change.kelp > 0)
    sway = np.where(kelp, change.kelp * (2.0 * uniform(ids, 31, seed) - 1.0) * math.pi, 0.0)
    sway += np.where(boulder, angle, 0.0)
    new["turn"] = new["turn"] + sway
    marks.update(boulders=boulder, mobile=walker, kelp=kelp)


def _new_ground(ground: t.Ground, seed: int, change: Change) -> t.Ground:
    draws = uniform(np.arange(4), 32, seed)
    # at 1 the sand rises or falls by up to a decimetre and lies in other heaps, so that its shores
    # move
    rise = math.copysign(0.05 + 0.05 * abs(2.0 * draws[3] - 1.0), draws[3] - 0.5)
    return ground._replace(
        sand_level=ground.sand_level + rise * change.sediment,
        drift=0.12 * change.sediment,
        ripple_phase=ground.ripple_phase
        + change.ripples * (0.35 + 0.3 * draws[0] + 3.0 * draws[1]),
        ripple_turn=ground.ripple_turn + change.ripples * 0.5 * (draws[2] - 0.5),
        mix=change.texture,
        mix_seed=int(seed + 5003),
    )


def _additions(before: Seafloor, site: Site, seed: int, change: Change) -> Rows:
    """Recruits, sediment and turf patches: things that were not there before."""
    from data_synth.seafloor_kernels import evaluate_ground

    rows = [np.zeros(0, t.FEATURE)]
    west, south, east, north = before.bounds
    wide = (west - 1.5, south - 1.5, east + 1.5, north + 1.5)
    for kind, density in site.densities().items():
        if kind in t.CORALS and density * change.recruits > 0:
            ids, x, y = candidates(kind, density * change.recruits, wide, seed, layer=1)
            some = make_features(kind, ids, x, y, seed)
            some["radius"] = np.minimum(some["radius"], 0.04 + 0.10 * uniform(ids, 33, seed))
            some["height"] = np.minimum(some["height"], 0.6 * some["radius"])
            some["dead"] = 0.0
            set_reach(some)
            some["z"], sandy = evaluate_ground(x, y, before.ground, 0.10)
            rows.append(some[sandy < 0.3])
    for kind, strength, tall in (
        (t.SEDIMENT, 0.5 * change.sediment, 0.03),
        (t.TURF, change.turf, 0.010),
    ):
        if strength > 0:
            ids, x, y = candidates(kind, 0.9 * strength, wide, seed, layer=1)
            some = np.zeros(len(ids), t.FEATURE)
            some["kind"], some["id"], some["x"], some["y"] = kind, ids, x, y
            some["seed"] = (uniform(ids, 4, seed) * 2**31).astype(np.int64)
            some["radius"] = 0.25 + 0.6 * uniform(ids, 34, seed)
            some["height"] = tall * (0.4 + 0.6 * uniform(ids, 35, seed))
            some["turn"], some["stretch"] = 6.28 * uniform(ids, 36, seed), 1.6
            set_reach(some)
            rows.append(some)
    added = np.concatenate(rows)
    near = (added["x"] + added["reach"] > west) & (added["x"] - added["reach"] < east)
    near &= (added["y"] + added["reach"] > south) & (added["y"] - added["reach"] < north)
    return added[near]


def _circle(row: Any) -> tuple[float, float, float]:
    return float(row["x"]), float(row["y"]), float(row["reach"])


def _events(old: Rows, new: Rows, marks: dict[str, Mask]) -> tuple[Event, ...]:
    any_mark = np.any(list(marks.values()), axis=0) if len(old) else np.zeros(0, bool)
    events = []
    for k in np.flatnonzero(any_mark):
        classes = tuple(name for name, mask in marks.items() if mask[k])
        here = {_circle(old[k]), _circle(new[k])} if classes != ("breakage",) else {_circle(old[k])}
        kind = t.KINDS[int(old["kind"][k])]
        events.append(Event(classes, kind, int(old["id"][k]), tuple(sorted(here))))
    return tuple(events)


def _added_events(added: Rows) -> tuple[Event, ...]:
    names = {t.SEDIMENT: "sediment", t.TURF: "turf"}
    return tuple(
        Event(
            (names.get(int(row["kind"]), "recruits"),),
            t.KINDS[int(row["kind"])],
            int(row["id"]),
            (_circle(row),),
        )
        for row in added
    )
