"""The fuzzer itself: the same seed is the same case, and it notices what it looks for."""

from __future__ import annotations

import binascii
import io
import random
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PARTS = ROOT / "scripts" / "stress_parts"
NOTICE = """
import os, signal, sys, time
import fuzz, fuzz_seeds
from pathlib import Path

def run(command, main, here):
    what = command[0]
    if what == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    while what == "hang":
        pass
    if what == "wait":
        time.sleep(600)
    if what == "memory":
        bytearray(fuzz.MOST_MEMORY + (1 << 22))
    if what == "trace":
        print("Traceback (most recent call last)")
    return 1 if what == "bug" else 3

fuzz.run_command, fuzz.MOST_MEMORY = run, 1 << 26
words = ("crash", "hang", "wait", "memory", "trace", "bug", "fine")
seeds = {"a": fuzz_seeds.Seed({"a.txt": b"1 2 3"}, "a.txt", tuple((word,) for word in words))}
one = fuzz.Worker(Path(sys.argv[1]) / "w", seeds)
for k, word in enumerate(words):
    fuzz.WALL = 1.0 if word == "wait" else 600.0
    fuzz.HANG_CPU = 0.5 if word == "hang" else 60.0
    one.order("a", 7, k, 0)
    while (said := one.answer()) is None:
        time.sleep(0.01)
    print(word, fuzz.outcome(said), sep=": ")
    if "ended" in said:
        one.start()
one.end()
"""


@pytest.fixture
def changes(monkeypatch):
    monkeypatch.syspath_prepend(str(PARTS))
    import fuzz_changes

    return fuzz_changes


def test_it_notices_crashes_hangs_memory_tracebacks_and_bugs(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", NOTICE, tmp_path],
        env={"PYTHONPATH": f"{PARTS}:{ROOT}", "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.splitlines() == [
        "crash: CRASH (signal 11)",
        "hang: HANG",
        "wait: HANG",
        "memory: MEMORY",
        "trace: TRACEBACK",
        "bug: EXIT 1",
        "fine: exit 3",
    ], done.stderr


@pytest.mark.parametrize(
    "name", ["a.obj", "a.json", "a.glb", "a.npz", "a.png", "a.e57", "a.tif", "a.laz", "a.ply"]
)
def test_the_same_seed_is_the_same_case_and_another_is_not(changes, name):
    data = np.random.default_rng(1).integers(0, 255, 3000, np.uint8).tobytes()
    cases = [changes.change(name, data, random.Random(k), [data]) for k in range(40)]
    again = [changes.change(name, data, random.Random(k), [data]) for k in range(40)]
    assert cases == again
    assert len(set(cases)) > 15


def test_a_changed_png_header_keeps_its_checksum(changes):
    from PIL import Image

    out = io.BytesIO()
    Image.new("RGB", (31, 32)).save(out, "PNG")
    heads = [changes.png(out.getvalue(), random.Random(k), [])[12:33] for k in range(60)]
    for head in heads:
        assert struct.unpack(">I", head[17:])[0] == binascii.crc32(head[:17])
    assert len({head[4:12] for head in heads}) > 4
