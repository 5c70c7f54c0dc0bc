"""Time and peak memory of one call, in a process of its own so that nothing else counts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent.parent
_CHILD = """
import json, sys
sys.path[:0] = {paths!r}
from measure import here
module, function, arguments = json.loads(sys.argv[1])
value = here(getattr(__import__(module), function), *arguments)
print("\\n@" + json.dumps(value))
"""


def resident() -> float:
    """Resident memory of this process [MB]."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def timed(function: Any, *arguments: Any) -> float:
    """Call in this process and return the seconds; nothing watches, which would slow threads."""
    began = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - began


def here(function: Any, *arguments: Any) -> dict[str, float]:
    """Call in this process: seconds, and how far the memory rose above where it stood [MB]."""
    base, top, done = resident(), [0.0], threading.Event()

    def watch() -> None:
        while not done.wait(0.002):
            top[0] = max(top[0], resident())

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    began = time.perf_counter()
    value = function(*arguments)
    seconds = time.perf_counter() - began
    top[0] = max(top[0], resident())
    done.set()
    watcher.join()
    extra = value if isinstance(value, dict) else {}
    return {"seconds": seconds, "peak_mb": top[0] - base, **extra}


def apart(module: str, function: str, *arguments: Any) -> dict[str, Any]:
    """Call `module.function(*arguments)` in a new process; arguments and result as JSON.

    `module` is a file in scripts/bench_parts. A dict that the function returns is merged in.
    """
    code = _CHILD.format(
        paths=[str(Path(__file__).parent), str(ROOT), str(ROOT / "tests" / "helpers")]
    )
    said = json.dumps([module, function, arguments])
    command = [sys.executable, "-c", code, said]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("@")]
    if done.returncode != 0 or not lines:
        raise RuntimeError(f"{module}.{function} failed:\n{done.stderr[-2000:]}")
    result: dict[str, Any] = json.loads(lines[-1][1:])
    return result
