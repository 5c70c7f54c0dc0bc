"""Run the benchmark: jobs into records, records into tables, figures and a page."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from meshreg.benchmark import curves, maps, page, tables
from meshreg.benchmark.jobs import WORK, Record, place_path, read_record, record_path, run_job
from meshreg.benchmark.plan import SCHEMA, Job, Options, jobs
from meshreg.benchmark.summary import summarise
from meshreg.benchmark.workers import run_all
from meshreg.errors import UsageError
from meshreg.io.files.atomic import as_output_error, atomic_file
from meshreg.io.result import manifest
from meshreg.io.result.manifest import require_only_ours, require_ours, write_manifest

log = logging.getLogger(__name__)
Progress = Callable[[str, int, int], None]
MARKER = "benchmark.json"
PAGES = ("pairs.csv", "summary.json", "index.html")


def run_benchmark(
    options: Options,
    folder: str | Path,
    *,
    workers: int = 2,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run every pair, and write `pairs.csv`, `summary.json`, `figures/` and `index.html`.

    Parameters
    ----------
    options : Options
    folder : path
        Made if absent. Each pair is one file in its `pairs/`, written when it is done.
    workers : int
        Processes; each gets its share of the cores. 0 works in this process.
    resume : bool
        Go on with a run that is in the folder: pairs are not run again whose file is there, made
        by the same version with the same recipe, seed and settings.
    overwrite : bool
        Start afresh in a folder that holds a run, and nothing else.
    progress : callable, optional
        Called with the stage's name, how many jobs are done, and how many there are.

    Returns
    -------
    dict
        As in `summary.json`; "unmet" lists the expectations that do not hold.

    Raises
    ------
    UsageError
        If an option is out of range, or the folder is in use and neither resumed nor overwritten.
    OutputError
        If something cannot be written.
    """
    from meshreg.pipeline import versions

    folder = Path(folder)
    lots = jobs(options)
    if workers < 0:
        raise UsageError(f"workers is {workers}.", remedy="Use 0 or more.")
    _prepare(folder, resume, overwrite)
    started = time.perf_counter()
    with as_output_error(folder / MARKER), atomic_file(folder / MARKER) as path:
        about = {"schema": SCHEMA, "options": dataclasses.asdict(options)}
        path.write_text(json.dumps(about) + "\n", encoding="utf-8")
    tell = progress or (lambda stage, done, total: None)
    records: list[Record] = []
    for stage, lot in zip(("pairs", "different places"), lots, strict=True):
        records += _run(stage, lot, folder, workers, tell)
    tell("tables and figures", 0, 1)
    summary, rows = summarise(records)
    summary = {
        "schema": "meshreg.benchmark/1",
        "options": dataclasses.asdict(options),
        "versions": versions(),
        "wall_seconds": time.perf_counter() - started,
        "cpu_seconds": sum(record["cpu_seconds"] for record in records),
        **summary,
    }
    written = [MARKER, *_write(summary, rows, folder), *_kept(lots, records)]
    with as_output_error(folder):
        write_manifest(folder, "benchmark", [n for n in written if (folder / n).is_file()])
    tell("tables and figures", 1, 1)
    return summary


def _prepare(folder: Path, resume: bool, overwrite: bool) -> None:
    with as_output_error(folder):
        used = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
        if used and not (folder / MARKER).is_file():
            raise UsageError(
                "is not a folder of a benchmark.", file=folder, remedy="Choose another."
            )
        if used and not (resume or overwrite):
            raise UsageError(
                "holds a benchmark already.", file=folder, remedy="Use --resume or --overwrite."
            )
        if (folder / WORK).is_dir() and not (folder / WORK).is_symlink():
            shutil.rmtree(folder / WORK, ignore_errors=True)  # of a run that was killed
        if used and overwrite and not resume:
            for name in require_only_ours(folder, (MARKER,)):
                (folder / name).unlink()
        elif used:
            require_ours(folder, PAGES)
        folder.mkdir(parents=True, exist_ok=True)
        # written anew at the end; the files of a run that is stopped are known by their names
        (folder / manifest.NAME).unlink(missing_ok=True)


def _run(
    stage: str, lot: Sequence[Job], folder: Path, workers: int, tell: Progress
) -> list[Record]:
    records: list[Record | None] = [read_record(job, folder) for job in lot]
    left = [k for k, record in enumerate(records) if record is None]
    done = len(lot) - len(left)
    if done:
        log.info("%s: %d of %d are done already", stage, done, len(lot))
    if lot:
        tell(stage, done, len(lot))
    for index, record in run_all(run_job, [lot[k] for k in left], workers, folder):
        records[left[index]] = record
        done += 1
        if record["error"]:
            log.warning("%s: %s", record["job"]["name"], record["error"])
        tell(stage, done, len(lot))
    return [record for record in records if record is not None]


def _kept(lots: Sequence[Sequence[Job]], records: Sequence[Record]) -> list[str]:
    """Name the files of single jobs, in the folder of a run."""
    here = Path()
    names = [f"figures/{name}" for record in records for name in record.get("figures", ())]
    for job in (job for lot in lots for job in lot):
        names.append(record_path(job, here).as_posix())
        if job.kind == "site":
            names.append(place_path(job.index, here).as_posix())
    return names


def _write(summary: Mapping[str, Any], rows: Sequence[tables.Row], folder: Path) -> list[str]:
    """Write tables, figures and the page; return their names."""
    names = [*PAGES]
    with as_output_error(folder):
        tables.write_csv(rows, folder / "pairs.csv")
        with atomic_file(folder / "summary.json") as path:
            text = json.dumps(summary, indent=1, allow_nan=False)
            path.write_text(text + "\n", encoding="utf-8")
        for name, draw in curves.figures(rows, summary).items():
            target = folder / "figures" / f"{name}.png"
            figure = draw()
            if figure is None:
                target.unlink(missing_ok=True)
            else:
                maps.save(figure, target)
                names.append(f"figures/{name}.png")
        with atomic_file(folder / "index.html") as path:
            path.write_text(page.write_page(summary, folder), encoding="utf-8")
    return names
