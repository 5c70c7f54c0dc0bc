#!/usr/bin/env python3
"""How often the stated 95 % regions hold the truth, over many pairs of one size: a table.

    scripts/error_bar.py pairs.jsonl [--size 25] [--pairs 110] [--seed 47]

Grounds, intervals and draws are those of `meshreg benchmark`. DEM cells of 0.10 m, orthomosaic
0.05 m, the methods terrain and mutual information: SIFT takes the most time, and only proposes an
offset, as they do. Every tenth pair is registered the other way round too. Each pair is a line of
the file; what is there already is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "scripts" / "bench_parts")]
METHODS = ("terrain", "mutual_information")
NEVER = "sand_24mo"  # nothing is left there to be known again, and no pair is accepted
BACK = 10  # each such pair is turned round


def one(job: Any) -> dict[str, Any]:
    """Register a pair; return what is asked of it, in metres and radians."""
    from accuracy import there_and_back

    from data_synth.rasters import make_rasters
    from meshreg.benchmark.measure import NORMAL_95, of_decision, register_rasters
    from meshreg.benchmark.plan import recipe_of, settings_of

    made = make_rasters(recipe_of(job), job.seed, job.size, 0.10, 0.05, 0.05)
    pairs = {
        "dem": (made.reference_dem, made.moving_dem),
        "ortho": (made.reference_ortho, made.moving_ortho),
    }
    settings = settings_of(job, "robust").changed({"methods": METHODS})
    decision = register_rasters(pairs, settings)
    rows = of_decision(decision, "robust", made.truth, None)
    fused = next(row for row in rows if row["method"] == "fused")
    wanted = ("verdict", "success", "error", "covered", "error_up", "sigma_up", "covered_up")
    found = {"name": job.name, "kind": job.scenario} | {key: fused.get(key) for key in wanted}
    if decision.refined is not None:
        found["error_yaw"] = float(decision.refined.yaw - made.truth["yaw"])
        found["sigma_yaw"] = float(decision.refined.covariance[2, 2] ** 0.5)
        found["covered_yaw"] = abs(found["error_yaw"]) <= NORMAL_95 * found["sigma_yaw"]
    if job.index % BACK == 2:
        turned = {name: (moving, reference) for name, (reference, moving) in pairs.items()}
        found["back"] = there_and_back(decision, register_rasters(turned, settings))
    return found


def crossed(size: float, pairs: int, seed: int) -> list[Any]:
    """All pairs, the first of each kind first."""
    from meshreg.benchmark.plan import CROSSING, Options, jobs

    kinds = tuple(kind for kind in CROSSING if kind != NEVER)
    first, _ = jobs(Options(kinds, pairs, elsewhere=0, size=size, seed=seed))
    return [job for job in first if job.kind == "crossing"]


def share(held: Iterable[bool]) -> str:
    """Count, share and its bounds."""
    from meshreg.benchmark.tables import rate

    found = rate(held)
    if not found["total"]:
        return "–"
    low, high = 100 * found["low"], 100 * found["high"]
    return f"{found['count']} of {found['total']}, {found['rate']:.1%} ({low:.1f} to {high:.1f})"


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the Markdown table of the accepted pairs, and what is told beside it."""
    import numpy as np

    accepted = [row for row in rows if row["verdict"] == "accepted"]
    yield "| ground and interval | offset | height | yaw |"
    yield "|---|---|---|---|"
    kinds = sorted({row["kind"] for row in accepted})
    groups = [(kind, [r for r in accepted if r["kind"] == kind]) for kind in kinds]
    for interval in ("12h", "12mo", "24mo"):
        those = [r for r in accepted if r["kind"].endswith("_" + interval)]
        groups.append((f"all after {interval}", those))
    for name, those in [*groups, ("all", accepted)]:
        held = [share(r[key] for r in those) for key in ("covered", "covered_up", "covered_yaw")]
        yield f"| {name} | {' | '.join(held)} |"
    error, up, yaw = (
        np.abs([r[key] for r in accepted]) for key in ("error", "error_up", "error_yaw")
    )
    yield ""
    wrong = sum(not row["success"] for row in accepted)
    yield f"{len(rows)} pairs, {len(accepted)} accepted, {wrong} of them wrong"
    for name, values in (("offset [mm]", 1e3 * error), ("height [mm]", 1e3 * up)):
        half, most = np.quantile(values, (0.5, 0.95))
        yield f"{name}: median {half:.2f}, 95 % {most:.2f}, largest {values.max():.1f}"
    yield f"yaw [degrees]: median {np.rad2deg(np.median(yaw)):.4f}"
    back = np.array([row["back"] for row in accepted if row.get("back") is not None])
    if back.size:
        yield f"{len(back)} there and back, at most {np.nanmax(back):.2f} sigmas"


def main() -> None:
    asked = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    asked.add_argument("file", type=Path)
    asked.add_argument("--size", type=float, default=25.0)
    asked.add_argument("--pairs", type=int, default=110, help="of each ground and interval")
    asked.add_argument("--seed", type=int, default=47)
    asked.add_argument("--workers", type=int, default=2)
    said = asked.parse_args()

    from meshreg.benchmark.workers import run_all

    file: Path = said.file
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    known = {row["name"] for row in rows}
    lot = [job for job in crossed(said.size, said.pairs, said.seed) if job.name not in known]
    with file.open("a") as out:
        for _, row in run_all(one, lot, said.workers):
            rows.append(row)
            out.write(json.dumps(row, default=float) + "\n")
            out.flush()
            print(f"\r{len(rows)} pairs", end="", file=sys.stderr)
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
