"""Run one job and write its record: one line of JSON, whole or not at all."""

from __future__ import annotations

import json
import math
import tempfile
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from data_synth.make import make_pair, write_pair
from data_synth.recipe import Recipe
from meshreg.benchmark import hand, maps, measure, rasters
from meshreg.benchmark.plan import Job, key_of, recipe_of, settings_of, site_job
from meshreg.io.files.atomic import atomic_file
from meshreg.records import Registration, Survey

Record = dict[str, Any]
WORK = ".work"  # in the folder of a run: what its processes are making
TRUTH = ("centroid", "offset", "yaw", "overlap", "same_ground", "mirrored", "severity")


def record_path(job: Job, folder: Path) -> Path:
    """Where a job's record is, in the folder of a run."""
    return folder / "pairs" / f"{job.name}.json"


def place_path(index: int, folder: Path) -> Path:
    """Where the rasters of a place are kept."""
    return folder / "sites" / f"site_{index:03d}.npz"


def read_record(job: Job, folder: Path) -> Record | None:
    """Return a job's record if it is there, whole, made with the same key, and no error."""
    try:
        record = json.loads(record_path(job, folder).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(record, dict) or record.get("key") != key_of(job) or record.get("error"):
        return None
    if not all((folder / "figures" / name).is_file() for name in record.get("figures", ())):
        return None
    if job.kind == "site" and rasters.place_key(place_path(job.index, folder)) != record["key"]:
        return None
    return record


def run_job(job: Job, folder: Path) -> Record:
    """Run a job and write its record; a failure of the program itself is recorded too."""
    started, busy = time.perf_counter(), time.process_time()
    record: Record = {"key": key_of(job), "job": plain(job), "rows": [], "figures": []}
    try:
        record |= _RUNNERS[job.kind](job, folder)
        record["error"] = None
    except Exception as error:
        record["error"] = f"{type(error).__name__}: {error}"
        record["traceback"] = traceback.format_exc()
    record["seconds"] = time.perf_counter() - started
    record["cpu_seconds"] = time.process_time() - busy
    record = _finite(record)
    path = record_path(job, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(record, allow_nan=False) + "\n", encoding="utf-8")
    return record


def plain(job: Job) -> dict[str, Any]:
    """Return a job as plain values, with its name."""
    return {**job.__dict__, "name": job.name}


def _pair(job: Job, folder: Path) -> Record:
    """Rasters straight from the generator; every preset looks at the same ones."""
    del folder
    started = time.perf_counter()
    pairs, made = rasters.make(job)
    making = time.perf_counter() - started
    clicked = hand.click(made.scene, job.seed)
    rows, seconds = [], {}
    for preset in job.presets:
        settings = settings_of(job, preset)
        decision = measure.register_rasters(pairs, settings)
        rows += measure.of_decision(decision, preset, made.truth, clicked)
        seconds[preset] = dict(decision.seconds)
    stages = {"make": making, **seconds["robust"]}
    return _about(made.scene.recipe, made.truth, clicked) | {"rows": rows, "stages": stages}


def _site(job: Job, folder: Path) -> Record:
    pairs, _ = rasters.make(job)
    rasters.save_place(pairs, key_of(job), place_path(job.index, folder))
    return {}


def _elsewhere(job: Job, folder: Path) -> Record:
    """Lay the moving survey of one place over the reference survey of another."""
    i, j = job.sites
    pairs = rasters.rehomed(
        rasters.load_place(place_path(i, folder), "reference"),
        rasters.load_place(place_path(j, folder), "moving"),
    )
    decision = measure.register_rasters(pairs, settings_of(job, "robust"))
    rows = measure.of_decision(decision, "robust", {}, None)
    names = [site_job(k, job.seed, job.size).scenario for k in (i, j)]
    return {"rows": rows, "stages": dict(decision.seconds), "places": names}


def _files(job: Job, folder: Path) -> Record:
    """Through real files: written as reconstruction software does, read, registered."""
    from meshreg.io import read_survey

    recipe = recipe_of(job)
    work = folder / WORK
    work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work) as temporary:
        started = time.perf_counter()
        place = Path(temporary) / job.name
        paths = write_pair(recipe, place, job.seed, job.size, job.format)
        writing = time.perf_counter() - started
        truth = json.loads((place / "truth.json").read_text(encoding="utf-8"))
        started = time.perf_counter()
        surveys = [read_survey(_survey_file(paths, name)) for name in ("reference", "moving")]
        reading = time.perf_counter() - started
        registration = _register(job, surveys[0], surveys[1], "robust")
    rows = measure.of_registration(registration, "robust", truth, None)
    stages = {"write": writing, "read": reading, **registration.seconds}
    return _about(recipe, truth, None) | {"rows": rows, "stages": stages}


def _survey_file(paths: tuple[Path, ...], name: str) -> Path:
    ends = (".obj", ".ply", ".laz", ".glb")
    return next(p for p in paths if p.stem == name and p.suffix in ends)


def _register(job: Job, reference: Survey, moving: Survey, preset: str) -> Registration:
    from meshreg.io.frames.place import common_crs
    from meshreg.pipeline import register_pair

    moving, _ = common_crs(reference, moving)
    return register_pair(reference, moving, settings_of(job, preset))


def _table(job: Job, folder: Path) -> Record:
    """One of the paper's sites in full, for Table I and Figures 3 to 5."""
    recipe = recipe_of(job)
    pair = make_pair(recipe, job.seed, job.size)
    clicked = hand.click(pair.scene, job.seed)
    found, rows = {}, []
    for preset in job.presets:
        found[preset] = _register(job, pair.reference, pair.moving, preset)
        rows += measure.of_registration(found[preset], preset, pair.truth, clicked)
    figures = maps.draw(job.scenario, found, pair.truth["offset"], folder / "figures")
    stages = dict(found["robust"].seconds)
    about = _about(recipe, pair.truth, clicked)
    return about | {"rows": rows, "stages": stages, "figures": figures}


def _about(recipe: Recipe, truth: Mapping[str, Any], clicked: hand.Hand | None) -> Record:
    return {
        "truth": {name: truth.get(name) for name in TRUTH}
        | {"residual": truth.get("residual_mean_horizontal")},
        "hand": None if clicked is None else clicked.as_dict(),
        "expect": {
            "verdicts": list(recipe.expect.verdicts),
            "max_error": recipe.expect.max_error,
        },
    }


def _finite(value: Any) -> Any:
    """Return plain JSON values; what is not a finite number becomes None."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


_RUNNERS = {
    "crossing": _pair,
    "ladder": _pair,
    "scenario": _pair,
    "table": _table,
    "files": _files,
    "site": _site,
    "elsewhere": _elsewhere,
}
