"""Run the parts of the benchmark and print their tables.

A part is a module here with `bench() -> list of rows`; a row is a dict whose keys are the columns
of the part's table, in order, or a tuple (what, seconds, note). The first line of the module's
docstring is the table's title. What fails, a peer that is missing included, is a row with the key
"failed": the other parts still run, but the exit code is 1, and BENCHMARKS.md stays as it was.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
NOT_PARTS = {"run", "measure"}


def parts() -> list[str]:
    """Names of all parts."""
    found = (path.stem for path in sorted(HERE.glob("*.py")))
    return [name for name in found if name not in NOT_PARTS and not name.startswith("_")]


def text_of(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    return "" if value is None else str(value)


def rows_of(name: str) -> tuple[str, list[Mapping[str, Any]]]:
    """Run one part; return its title and its rows."""
    try:
        module = importlib.import_module(name)
        title = (module.__doc__ or name).strip().splitlines()[0]
        rows = module.bench()
    except Exception as error:
        return name, [{"failed": f"{type(error).__name__}: {error}".splitlines()[0]}]
    names = ("what", "seconds", "note")
    return title, [
        row if isinstance(row, Mapping) else dict(zip(names, row, strict=True)) for row in rows
    ]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as a Markdown table."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(text_of(row.get(c)) for c in columns) + " |" for row in rows]
    return "\n".join(lines)


def failure(part: str, row: Mapping[str, Any]) -> str:
    """Say in one line what failed in which part, and why."""
    what = next((str(value) for key, value in row.items() if key != "failed"), "")
    return ": ".join(text for text in (part, what, str(row["failed"])) if text)


def machine() -> str:
    name = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            name = line.partition(":")[2].strip()
            break
    load = os.getloadavg()[0]
    return (
        f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"{time.strftime('%Y-%m-%d')}, load before the run {load:.1f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(prog="scripts/bench", description=__doc__)
    parser.add_argument("part", nargs="*", help=f"of {', '.join(parts())}; default: all")
    parser.add_argument("--write", action="store_true", help="write BENCHMARKS.md")
    chosen = parser.parse_args()
    names = chosen.part or parts()
    if unknown := sorted(set(names) - set(parts())):
        parser.error(f"no part {unknown[0]!r}; there are {', '.join(parts())}")
    sys.path[:0] = [str(HERE), str(ROOT), str(ROOT / "tests" / "helpers")]
    on = machine()
    sections, failures = [], []
    for name in names:
        title, rows = rows_of(name)
        failures += [failure(name, row) for row in rows if row.get("failed")]
        section = f"## {name}\n\n{title}\n\n{table(rows)}\n"
        print(section, flush=True)
        sections.append(section)
    if failures:
        print("failed:", *failures, sep="\n  ", file=sys.stderr)
        return 1
    if chosen.write:
        command = " ".join(["scripts/bench", *chosen.part, "--write"])
        head = f"# Benchmarks\n\nMade by `{command}` on {on}.\n\n"
        (ROOT / "BENCHMARKS.md").write_text(head + "\n".join(sections), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
