"""The whole job, stage by stage [s]: `meshreg demo`'s pair, and a made pair of 25 m.

The demonstration's two meshes have 14 k triangles; it is run twice in one process, and the second
run counts. The made pair has 2 M triangles and texels of 5 mm each; there it is the command that
counts, with its start, its checks and all files written, and `beyond reading` is all but `read`;
of five runs the one that is the median beyond reading. Its files are made once (minutes) and kept
in the folder for temporary files.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from measure import ROOT, apart

PAIR = [str(ROOT / "meshreg" / "demo_data" / f"beach_{year}.obj") for year in (2018, 2019)]
MADE = {"sfm.mesh_spacing": 0.025, "output.texture": 0.005}
SIDE = 25.0


def job() -> dict[str, Any]:
    """Register the pair twice in this process; the first run compiles or loads the kernels."""
    from measure import here

    import meshreg
    from meshreg.report import draw_figures

    settings = meshreg.Settings().changed({"search.radius": 20.0})
    seconds: dict[str, float] = {}
    result: Any = None

    def whole() -> None:
        nonlocal result
        seconds.clear()
        began = time.perf_counter()
        reference, moving = (meshreg.read_survey(path) for path in PAIR)
        seconds["read"] = time.perf_counter() - began
        result = meshreg.register_pair(reference, moving, settings)
        seconds.update(result.seconds)
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            out = Path(folder, "out")
            meshreg.write_registration(result, out, reference=reference, moving=moving)
            draw_figures(result, out / "figures", scene_seconds=0)
            seconds["start, checks, files, figures"] = time.perf_counter() - began

    first = here(whole)
    second = here(whole)
    return {"stages": seconds, "first": first, "second": second, "verdict": result.verdict}


def made_pair() -> Path:
    """Return the folder of the made pair; make it if it is not there yet."""
    from data_synth.make import write_pair
    from data_synth.recipe import load

    folder = Path(tempfile.gettempdir(), "meshreg-bench", "reef_25m_2M")
    if not (folder / "truth.json").is_file():
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_pair(load("abrolhos_12mo", MADE), folder, seed=0, size=SIDE)
    return folder


def command(folder: str) -> dict[str, Any]:
    """Run `meshreg register` on the made pair: seconds in all and by stage, peak memory.

    From a small process, since a command inherits the peak of the one that starts it.
    """
    pair = Path(folder)
    with tempfile.TemporaryDirectory(dir=pair.parent) as place:
        out = Path(place, "out")
        files = [str(pair / f"{name}.obj") for name in ("reference", "moving")]
        words = [sys.executable, "-m", "meshreg", "register", *files, "-o", str(out)]
        began = time.perf_counter()
        with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as child:
            assert child.stderr is not None
            said = child.stderr.read()
            _, code, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(code)
        total = time.perf_counter() - began
        if child.returncode not in (0, 4):
            raise RuntimeError(said.decode(errors="replace")[-2000:])
        record = json.loads((out / "registration.json").read_text())
    stages = record["seconds"]
    stages["start, checks, files, figures"] = total - sum(stages.values())
    return {
        "stages": stages,
        "seconds": total,
        "peak_mb": usage.ru_maxrss / 1e3,
        "verdict": record["verdict"],
    }


def bench() -> list[dict[str, Any]]:
    small, folder = apart("register", "job"), str(made_pair())
    runs = [apart("register", "command", folder) for _ in range(5)]
    large = sorted(runs, key=lambda run: run["seconds"] - run["stages"]["read"])[2]
    names = ("demo", "25 m, 2 M faces")
    columns = [small["stages"], large["stages"]]

    def row(stage: str, *values: Any) -> dict[str, Any]:
        return {"stage": stage} | dict(zip(names, values, strict=True))

    stages = dict.fromkeys(name for column in columns for name in column)
    rows = [row(name, *(column.get(name) for column in columns)) for name in stages]
    totals = [small["second"]["seconds"], large["seconds"]]
    beyond = [total - of["read"] for total, of in zip(totals, columns, strict=True)]
    return [
        *rows,
        row("beyond reading", *beyond),
        row("all", *totals),
        row("all, first run in a process", small["first"]["seconds"], None),
        row("peak MB (demo: above a process that ran once)", small["second"]["peak_mb"],
            large["peak_mb"]),
        row("verdict", small["verdict"], large["verdict"]),
    ]  # fmt: skip
