"""The whole job on the demonstration pair (two meshes of 14 k triangles), stage by stage, warm.

Peak memory is that of the whole second run above a process that has run once.
"""

from __future__ import annotations

import time
from typing import Any

from measure import ROOT, apart

PAIR = [str(ROOT / "meshreg" / "demo_data" / f"beach_{year}.obj") for year in (2018, 2019)]


def job() -> dict[str, Any]:
    """Register the pair twice in this process; the first run compiles or loads the kernels."""
    import tempfile
    from pathlib import Path

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
            seconds["write"] = time.perf_counter() - began
            began = time.perf_counter()
            draw_figures(result, out / "figures", scene_seconds=0)
            seconds["figures"] = time.perf_counter() - began

    first = here(whole)
    second = here(whole)
    return {"stages": seconds, "first": first, "second": second, "verdict": result.verdict}


def bench() -> list[dict[str, Any]]:
    done = apart("register", "job")
    rows = [{"stage": name, "seconds": value} for name, value in done["stages"].items()]
    total = {"stage": "all, warm", **done["second"]}
    cold = {"stage": "all, first run in a process", **done["first"]}
    last = {"stage": f"verdict: {done['verdict']}"}
    return [{**row, "peak_mb": row.get("peak_mb")} for row in (*rows, total, cold, last)]
