"""`meshreg benchmark`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from meshreg.cli.console import Progress, Terminal, logging_to
from meshreg.cli.guard import Unfinished

SHOWN = 20  # expectations that do not hold, on the screen; the page has them all


@dataclass(frozen=True)
class BenchmarkRequest:
    """Everything that `meshreg benchmark` was asked; None is the default of `Options`."""

    out: Path
    scenarios: str | None = None
    repeats: int | None = None
    elsewhere: int | None = None
    size: float | None = None
    seed: int | None = None
    workers: int = 2
    resume: bool = False
    overwrite: bool = False


def benchmark(request: BenchmarkRequest, voice: Terminal, unfinished: Unfinished) -> dict[str, Any]:
    """Run the benchmark and return its summary; every pair that is done stays done."""
    from meshreg.benchmark import Options, run_benchmark

    del unfinished  # a pair's file is written whole, and the rest is made from those files
    said = {name: getattr(request, name) for name in ("repeats", "elsewhere", "size", "seed")}
    given = {name: value for name, value in said.items() if value is not None}
    if request.scenarios is not None:
        given["scenarios"] = tuple(n.strip() for n in request.scenarios.split(",") if n.strip())
    with logging_to(voice), Progress(voice) as progress:
        counter = _Counter(progress, voice)
        return run_benchmark(
            Options(**given),
            request.out,
            workers=request.workers,
            resume=request.resume,
            overwrite=request.overwrite,
            progress=counter,
        )


class _Counter:
    """Says how many pairs are done: on the bar, or a line a minute where nobody watches."""

    def __init__(self, progress: Progress, voice: Terminal, every: float = 60.0) -> None:
        self._progress, self._voice, self._every = progress, voice, every
        self._stage, self._began, self._said, self._first = "", 0.0, 0.0, 0

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if stage != self._stage:
            self._stage, self._began, self._said, self._first = stage, now, now, done
        self._progress(stage, done / max(total, 1))
        if not self._voice.err.is_terminal and now - self._said >= self._every:
            self._said = now
            each = (now - self._began) / max(done - self._first, 1)
            left = each * (total - done) / 60
            self._voice.err.print(f"  {done} of {total}, about {left:.0f} min left")


def show(summary: Mapping[str, Any], out: Path, voice: Terminal) -> None:
    """Print what was found, and what does not hold."""
    from meshreg.benchmark.summary import said

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("pairs", "accepted", "review", "rejected", "accepted but wrong"):
        table.add_column(name, justify="left" if name == "pairs" else "right")
    for name, found in summary["verdicts"].items():
        if found["accepted"]["total"]:
            keys = ("accepted", "review", "rejected", "accepted_but_wrong")
            counts = [str(found[key]["count"]) for key in keys]
            if name == "different places":
                counts[-1] = ""
            table.add_row(f"{name} ({found['accepted']['total']})", *counts)
    voice.out.print(table)
    for line in summary["success"]:
        if line["where"] == "all but flat sand" and line["preset"] == "robust":
            name = line["method"].replace("_", " ")
            voice.say(f"{name} right on all but flat sand: {said(line)}")
    covered = summary["coverage"]["not_flat"]["fused"]
    voice.say(f"stated 95 % region covers the truth: {said(covered)}")
    lines = summary["expectations"]
    unmet = [line for line in lines if not line["holds"]]
    color = "green" if not unmet else "red"
    voice.say(f"[{color}]{len(lines) - len(unmet)} of {len(lines)} expectations hold[/{color}]")
    for line in unmet[:SHOWN]:
        voice.say(f"  [red]not:[/red] {escape(line['what'])}: {escape(line['found'])}")
    if len(unmet) > SHOWN:
        voice.say(f"  and {len(unmet) - SHOWN} more")
    voice.say(f"page: {escape(str(out / 'index.html'))}")
