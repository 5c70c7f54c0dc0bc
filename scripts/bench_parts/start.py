"""Start-up: how long until the program answers, median of 7."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from typing import Any


def _median(command: list[str]) -> float:
    times = []
    for _ in range(7):
        began = time.perf_counter()
        subprocess.run(command, capture_output=True, check=True)
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def bench() -> list[dict[str, Any]]:
    python = sys.executable
    rows = (
        ("python -c pass", [python, "-c", "pass"]),
        ("python -c 'import numpy'", [python, "-c", "import numpy"]),
        ("import meshreg", [python, "-c", "import meshreg"]),
        ("meshreg --help", [python, "-m", "meshreg", "--help"]),
    )
    return [{"command": name, "seconds": _median(command)} for name, command in rows]
