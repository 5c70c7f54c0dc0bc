"""What is run: every pair is one job, known by a key that tells whether it must be run again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from data_synth.recipe import Recipe, load, scenarios
from data_synth.sites import SITES
from data_synth.truth import GENERATOR
from meshreg import __version__
from meshreg.errors import UsageError
from meshreg.settings import Settings

SCHEMA = 2  # of the files of a run; raised whenever the same job would give another record
DEM_CELL, ORTHO_CELL, SIFT_CELL = 0.10, 0.05, 0.025  # m
PAPER_SITES = ("tasmania_12h", "abrolhos_12mo", "scott_24mo")
INTERVALS = dict(zip(("12h", "12mo", "24mo"), PAPER_SITES, strict=True))
GROUNDS = ("boulders", "low_reef", "reef_and_sand", "reef", "sand")
_OWN_GROUND = dict(zip(PAPER_SITES, GROUNDS, strict=False))
# "reef_12mo" is a reef that went through what abrolhos_12mo goes through, seen in the same light;
# the paper's sites keep their own names.
CROSSING: dict[str, tuple[str, str]] = {
    (site if _OWN_GROUND[site] == ground else f"{ground}_{interval}"): (ground, interval)
    for ground in GROUNDS
    for interval, site in INTERVALS.items()
}
FLAT = "sand"  # the ground on which no method is bound to succeed
LADDER = tuple(f"severity_{step:02d}" for step in range(11))
# Drawn anew for each pair; the recipes' own are the paper's Table I.
DRAWN = {
    "sfm.offset_length": 0.0,
    "sfm.offset_east": [-5.0, 5.0],
    "sfm.offset_north": [-5.0, 5.0],
    "sfm.yaw": [-0.5, 0.5],
    "sfm.warp": [0.04, 0.25],
}
PAPER_RADIUS = 6.0  # m; the direct count takes its time, and offsets are within 5 m
PAPER_PAIRS = 10  # of each of the paper's sites go through the slow preset
PAPER_LADDER = 5  # of each step of the ladder
OTHERS = 4  # pairs of each further recipe, taken as it stands
OWN_SIZE = 1.25  # recipes as they stand have their own size, but at most so many times the run's
MOST_SITES = 60  # whose rasters are kept, to be crossed
FORMATS = ("obj", "ply", "laz", "glb")
Kind = Literal["crossing", "ladder", "scenario", "table", "files", "site", "elsewhere"]


@dataclass(frozen=True)
class Options:
    """What a run of the benchmark covers.

    Attributes
    ----------
    scenarios : tuple of str
        Names out of `names()`; empty is all.
    repeats : int
        Pairs of each ground and interval (15 of them); half as many at each step of the ladder.
    elsewhere : int
        Pairs that show different places.
    size : float
        Side of the patches [m]; recipes as they stand have their own, up to 1.25 times this.
    seed : int
    """

    scenarios: tuple[str, ...] = ()
    repeats: int = 21
    elsewhere: int = 1000
    size: float = 12.0
    seed: int = 0


@dataclass(frozen=True)
class Job:
    """One pair (or, of kind "site", one place whose rasters are kept).

    `sites` are the indices of the two places of an "elsewhere" pair; `format` that of files.
    """

    kind: Kind
    scenario: str
    index: int
    seed: int
    size: float
    presets: tuple[str, ...] = ("robust",)
    format: str = ""
    sites: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """Of its file, without the suffix."""
        return f"{self.kind}_{self.scenario}_{self.index:04d}"


def names() -> tuple[str, ...]:
    """Return what `Options.scenarios` may hold: "severity" is the whole ladder."""
    return tuple(dict.fromkeys([*CROSSING, *scenarios()]))


def recipe_of(job: Job) -> Recipe:
    """Return the recipe of a job's pair: as it stands, or crossed, with its own draws."""
    if job.kind not in ("crossing", "site"):
        return load(job.scenario)
    ground, interval = CROSSING[job.scenario]
    recipe = load(INTERVALS[interval], DRAWN)
    if job.scenario in PAPER_SITES:
        return recipe
    expect = load("flat_sand").expect if ground == FLAT else recipe.expect
    return dataclasses.replace(recipe, name=job.scenario, site=SITES[ground], expect=expect)


def settings_of(job: Job, preset: str) -> Settings:
    """Return the settings that a preset means for a job."""
    settings = Settings.from_preset(preset)
    if preset == "paper":
        settings = settings.changed({"search.radius": PAPER_RADIUS})
    if job.kind != "elsewhere":
        settings = settings.changed(recipe_of(job).settings)
    return settings


def key_of(job: Job) -> str:
    """Return a fingerprint of everything that a job's record depends on."""
    known: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "generator": GENERATOR,
        "job": dataclasses.asdict(job),
        "settings": [settings_of(job, preset).as_dict() for preset in job.presets],
        "cells": [DEM_CELL, ORTHO_CELL, SIFT_CELL],
        "recipes": [dataclasses.asdict(recipe_of(j)) for j in _recipes_behind(job)],
    }
    text = json.dumps(known, sort_keys=True, default=list)
    return hashlib.sha256(text.encode()).hexdigest()


def _recipes_behind(job: Job) -> list[Job]:
    if job.kind != "elsewhere":
        return [job]
    return [site_job(k, job.seed, job.size) for k in job.sites]


def site_job(index: int, seed: int, size: float) -> Job:
    """Return the job that makes and keeps the rasters of a place, the grounds taking turns."""
    scenario = tuple(CROSSING)[index % len(CROSSING)]
    return Job("site", scenario, index, _seed(seed, "site", scenario, index), size, presets=())


def jobs(options: Options) -> tuple[list[Job], list[Job]]:
    """Return the jobs in two lots; those of the second cross what the first has kept.

    Raises
    ------
    UsageError
        If a scenario is unknown or a number is out of range.
    """
    _check(options)
    chosen = options.scenarios or names()
    first = [
        *_table_jobs(options, chosen),
        *_file_jobs(options, chosen),
        *_crossing_jobs(options, chosen),
        *_other_jobs(options, chosen),
    ]
    count = site_count(options.elsewhere)
    first += [site_job(k, options.seed, options.size) for k in range(count)]
    second = [
        Job("elsewhere", "crossed", k, options.seed, options.size, sites=pair)
        for k, pair in enumerate(different_places(options.elsewhere, count, options.seed))
    ]
    return first, second


def _check(options: Options) -> None:
    for name in options.scenarios:
        if name not in names():
            raise UsageError(
                f"There is no scenario {name!r}.", remedy=f"Choose from {', '.join(names())}."
            )
    if options.repeats < 1 or options.elsewhere < 0:
        raise UsageError(
            f"repeats is {options.repeats}, elsewhere {options.elsewhere}.",
            remedy="Use at least 1 and 0.",
        )
    if not 6.0 <= options.size <= 30.0:
        raise UsageError(f"The patches' size is {options.size} m.", remedy="Use 6 to 30 m.")


def _seed(*parts: Any) -> int:
    text = "/".join(str(part) for part in parts)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") % 2**30


def _own_size(name: str, options: Options) -> float:
    return min(load(name).output.size, OWN_SIZE * options.size)


def _table_jobs(options: Options, chosen: tuple[str, ...]) -> Iterator[Job]:
    """Take the paper's sites with the paper's own offsets and residuals."""
    for name in PAPER_SITES:
        if name in chosen:
            seed = _seed(options.seed, "table", name, 0)
            yield Job("table", name, 0, seed, _own_size(name, options), ("robust", "paper"))


def _file_jobs(options: Options, chosen: tuple[str, ...]) -> Iterator[Job]:
    """Each recipe once through files of one of the formats."""
    whole = ["severity_05" if name == "severity" else name for name in scenarios()]
    for k, name in enumerate(whole):
        if name in chosen or (name == "severity_05" and "severity" in chosen):
            seed, size = _seed(options.seed, "files", name, 0), _own_size(name, options)
            yield Job("files", name, 0, seed, size, format=FORMATS[k % len(FORMATS)])


def _crossing_jobs(options: Options, chosen: tuple[str, ...]) -> Iterator[Job]:
    for k in range(options.repeats):
        for name in CROSSING:
            if name in chosen:
                slow = name in PAPER_SITES and k < PAPER_PAIRS
                presets = ("robust", "paper") if slow else ("robust",)
                seed = _seed(options.seed, "crossing", name, k)
                yield Job("crossing", name, k, seed, options.size, presets)


def _other_jobs(options: Options, chosen: tuple[str, ...]) -> Iterator[Job]:
    for k in range(max(1, options.repeats // 2) if "severity" in chosen else 0):
        for name in LADDER:
            presets = ("robust", "paper") if k < PAPER_LADDER else ("robust",)
            seed = _seed(options.seed, "ladder", name, k)
            yield Job("ladder", name, k, seed, options.size, presets)
    for name in scenarios():
        if name in chosen and name not in CROSSING and name != "severity":
            for k in range(min(options.repeats, OTHERS)):
                seed = _seed(options.seed, "scenario", name, k)
                yield Job("scenario", name, k, seed, _own_size(name, options))


def site_count(pairs: int) -> int:
    """Return how many places are kept so that `pairs` of different ones can be formed."""
    return 0 if pairs == 0 else int(np.clip(math.ceil(2 * math.sqrt(pairs)), 6, MOST_SITES))


def different_places(count: int, sites: int, seed: int) -> list[tuple[int, int]]:
    """Return `count` pairs of different places; up to three in five are of one kind of ground.

    Rock against rock and ripples against ripples are harder to tell apart than rock from sand.
    """
    rng = np.random.default_rng([seed, 60])
    kind = [tuple(CROSSING.values())[k % len(CROSSING)][0] for k in range(sites)]
    alike: list[tuple[int, int]] = []
    unlike: list[tuple[int, int]] = []
    for i in range(sites):
        for j in range(sites):
            if i != j:
                (alike if kind[i] == kind[j] else unlike).append((i, j))
    if count > len(alike) + len(unlike):
        raise UsageError(
            f"{sites} places make {len(alike) + len(unlike)} pairs, not {count}.",
            remedy="Ask for fewer with --elsewhere.",
        )
    first = min(len(alike), math.ceil(0.6 * count))
    first = max(first, count - len(unlike))
    chosen = [alike[k] for k in rng.permutation(len(alike))[:first]]
    return chosen + [unlike[k] for k in rng.permutation(len(unlike))[: count - first]]
