#!/usr/bin/env python3
"""Whether two states of the code give the same answers: thirty small registrations, compared.

    scripts/corpus.py run OUT [--inputs DIR]   makes the inputs in DIR (default: OUT/inputs) if none
                                               are there, and registers every case into OUT
    scripts/corpus.py compare BEFORE AFTER     names what differs; exit code 1 if any does

Every format, both presets, every verdict. Seconds, the log and versions are left out of the
comparison; all else is to be equal to the byte. `--tolerance 1e-6` compares transforms [m] and
verdicts alone, for a change of arithmetic.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "scripts" / "stress_parts"), str(ROOT), str(ROOT / "tests" / "helpers")]
RADIUS = ("--search-radius", "0.5")
PAIR = ("reference.obj", "moving.obj")
MAPS = ("reference_dem.tif,reference_ortho.tif", "moving_dem.tif,moving_ortho.tif")
FORMATS = ("ply", "glb", "laz", "xyz", "e57", "stl", "off")
CASES: dict[str, tuple[str, ...]] = {
    "obj": (*PAIR, *RADIUS),
    **{kind: ("reference.obj", f"moving.{kind}", *RADIUS) for kind in FORMATS},
    "maps": (*MAPS, *RADIUS),
    "maps and mesh": (MAPS[0], "moving.obj", *RADIUS),
    "colmap": ("colmap", "colmap", "--allow-same", "--scale", "1", "--scale", "1"),
    "paper": (*PAIR, *RADIUS, "--preset", "paper"),
    "paper maps": (*MAPS, *RADIUS, "--preset", "paper"),
    "warp auto": (*PAIR, *RADIUS, "--warp", "auto"),
    "warp spline": ("reference.obj", "bent.obj", *RADIUS, "--warp", "spline"),
    "warp maps": (*MAPS, *RADIUS, "--warp", "auto"),
    "gicp": (*PAIR, *RADIUS, "--set", "refine.surfaces=gicp"),
    "seed": (*PAIR, *RADIUS, "--seed", "7"),
    "backwards": (*PAIR[::-1], *RADIUS),
    "defaults": PAIR,
    "turned": ("reference.obj", "turned.obj"),
    "free scale": ("reference.obj", "small.obj", *RADIUS, "--set", "search.free_scale=true"),
    "scaled": ("reference.obj", "small.obj"),
    "heights": ("reference.obj", "high.obj", *RADIUS),
    "elsewhere": ("reference.obj", "other.obj"),
    "flat": ("flat.ply", "flat_too.ply"),
    "far": ("reference.obj", "moving.obj", "--moving-shift", "300,0,0"),
    "y up": ("reference.obj", "moving.obj", "--up", "y"),
    "same": ("reference.obj", "reference.obj", "--allow-same", *RADIUS),
    "layers": ("reference.obj", "layers.ply", *RADIUS),
    "ties": (*PAIR, *RADIUS, "--ties", "ties.csv"),
}
LEFT_OUT = {"log.txt", "manifest.json"}  # the manifest has the others' checksums


def make_inputs(folder: Path) -> None:
    """Write the surveys that the cases name."""
    import fault_jobs
    import fuzz_seeds
    from seafloor import Seafloor

    import meshreg

    folder.mkdir(parents=True)
    fault_jobs.make_inputs(folder)
    moving = meshreg.read_survey(folder / "moving.obj")
    changes: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "turned": lambda p: p @ _turn(5.0).T,
        "small": lambda p: p * 0.98,
        "high": lambda p: p * [1, 1, 1.5],
        "bent": lambda p: p + 0.03 * np.sin(p[:, [1, 0, 1]] * 1.2),
    }
    for name, change in changes.items():
        meshreg.write_survey(_with_points(moving, change, name), folder / f"{name}.obj")
    other = fault_jobs.sheet(Seafloor.random(99, size=6.0), 3, "other")
    meshreg.write_survey(other, folder / "other.obj")
    for name, seed in (("flat", 1), ("flat_too", 2)):
        noise = np.random.default_rng(seed)
        points = np.column_stack([noise.uniform(-2, 2, (6000, 2)), noise.normal(0, 1e-4, 6000)])
        _write_cloud(name, points, folder)
    points = moving.geometry.vertices + moving.origin
    copy = points[::2] + np.array([0.3, 0.1, 0.25])
    _write_cloud("layers", np.concatenate([points, copy]), folder)
    for name, data in fuzz_seeds.colmap(binary=False).items():
        path = folder / "colmap" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def _turn(degrees: float) -> np.ndarray:
    cos, sin = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def _with_points(survey: Any, change: Callable[[np.ndarray], np.ndarray], name: str) -> Any:
    from dataclasses import replace

    points = change(survey.geometry.vertices + survey.origin) - survey.origin
    return replace(survey, name=name, geometry=replace(survey.geometry, vertices=points))


def _write_cloud(name: str, points: np.ndarray, folder: Path) -> None:
    rows = "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in points)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    (folder / f"{name}.ply").write_text(head + rows)


def run(out: Path, inputs: Path) -> int:
    """Register every case into its own folder of `out`."""
    if not inputs.exists():
        make_inputs(inputs)
    for name, words in CASES.items():
        there = out / name.replace(" ", "_")
        command = [sys.executable, "-m", "meshreg", "register", *words, "-o", str(there)]
        done = subprocess.run(command, cwd=inputs, capture_output=True, text=True)
        said = out / f"{there.name}.txt"
        said.write_text(f"exit code {done.returncode}\n{done.stdout}\n{done.stderr}")
        print(f"{name}: exit code {done.returncode}", flush=True)
    return 0


def compare(before: Path, after: Path, tolerance: float | None) -> int:
    """Print what differs between two runs; return the exit code."""
    names = [folder.name for folder in sorted(before.iterdir()) if folder.name != "inputs"]
    missing = {f.name for f in after.iterdir()} - {"inputs"} ^ set(names)
    differ = [f"{name}: in one only" for name in sorted(missing)]
    for name in set(names) - missing:
        one, two = before / name, after / name
        if tolerance is not None:
            differ += _answers_differ(one, two, tolerance)
            continue
        files = {p.relative_to(r) for r in (one, two) for p in r.rglob("*") if p.is_file()}
        for file in sorted(files) if one.is_dir() else [Path()]:
            if file.name in LEFT_OUT:
                continue
            a, b = (_comparable(root / file) for root in (one, two))
            if a != b:
                differ.append(f"{name}/{file}")
    print("\n".join(differ) or f"{len(names)} files and folders: no difference")
    return 1 if differ else 0


def _answers_differ(one: Path, two: Path, tolerance: float) -> list[str]:
    if not (one / "registration.json").is_file():
        return []
    a, b = (json.loads((p / "registration.json").read_text()) for p in (one, two))
    if a["verdict"] != b["verdict"]:
        return [f"{one.name}: {a['verdict']}, {b['verdict']}"]
    moves = [r["transform"]["reference_from_moving"] for r in (a, b)]
    if moves[0] is None or moves[1] is None:
        return [] if moves[0] == moves[1] else [f"{one.name}: a transform in one only"]
    off = float(np.abs(np.subtract(*moves))[:3].max())
    return [f"{one.name}: transforms differ by {off:.2g}"] if off > tolerance else []


_ANOTHER_EACH_TIME = (
    (rb"/[\w.-]+(/[\w.-]+)*/", b""),  # where the result lies
    (rb"<pre>\d{4}-.*?</pre>", b""),  # the log, in the page
    (rb'<th class="n">seconds.*?</table>', b""),
    (rb'"seconds": [^,}]*', b""),
    (rb"\b\d+(\.\d+)? (s|seconds)\b", b""),
    (rb"(log.txt|manifest.json|registration.json|report.html)</td>.*?</tr>", b""),  # sizes
    (rb"\d+\.\d +\xe2\x94\x82\n", b"\n"),  # and in the terminal
)


def _comparable(path: Path) -> Any:
    """What a file holds, without what is another each time."""
    if not path.is_file():
        return None
    data = path.read_bytes()
    if path.suffix == ".json":
        return _without(json.loads(data))
    if path.suffix in (".html", ".txt"):
        for pattern, instead in _ANOTHER_EACH_TIME:
            data = re.sub(pattern, instead, data, flags=re.DOTALL)
    return data


def _without(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            k: _without(v) for k, v in value.items() if k not in ("seconds", "versions", "schema")
        }
    return [_without(v) for v in value] if isinstance(value, list) else value


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="scripts/corpus.py", description=(__doc__ or "").splitlines()[0]
    )
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run")
    runs.add_argument("out", type=Path)
    runs.add_argument("--inputs", type=Path)
    compares = commands.add_parser("compare")
    compares.add_argument("before", type=Path)
    compares.add_argument("after", type=Path)
    compares.add_argument("--tolerance", type=float, help="of transforms [m]; only answers")
    given = parser.parse_args()
    if given.command == "run":
        given.out.mkdir(parents=True, exist_ok=True)
        return run(given.out.resolve(), (given.inputs or given.out / "inputs").resolve())
    return compare(given.before, given.after, given.tolerance)


if __name__ == "__main__":
    sys.exit(main())
