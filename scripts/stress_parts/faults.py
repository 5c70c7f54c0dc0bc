"""Fail each write that meshreg makes, and look at what it said and what it left.

A process that has done every job once, so that nothing is left to import or compile, and that knows
what was found then, so that no child searches or renders again, forks a child for each fault; a
small library that is loaded before libc counts the calls that write into the folder of the result
and lets one of them fail (faults.c). After each child:

- the old result is there byte for byte, or the new one is complete (what is written into a result
  that stays, as by `report`, is file by file the old or the new one);
- nothing is beside it, no temporary file and no lock; after SIGKILL the next run sees to that;
- the exit code is 6, 5, 130 or 143, or the usual one with the new result complete; never 1;
- no traceback; and what is said of the old result, or of nothing having been written, is true.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import ctypes
import errno
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
sys.path[:0] = [str(HERE), str(ROOT)]
from fault_jobs import JOBS, OLDER, Job, make_inputs  # noqa: E402

LIBRARY = "MESHREG_FAULTS"
HANG = 300.0  # seconds
ONCE, FROM_THEN_ON, SIGNAL = range(3)
ERRNOS = {
    "ENOSPC from then on": (FROM_THEN_ON, errno.ENOSPC),
    "ENOSPC": (ONCE, errno.ENOSPC),
    "EIO": (ONCE, errno.EIO),
    "EACCES": (ONCE, errno.EACCES),
    "SIGINT": (SIGNAL, signal.SIGINT),
    "SIGTERM": (SIGNAL, signal.SIGTERM),
    "SIGKILL": (SIGNAL, signal.SIGKILL),
}
MEMORY = "MemoryError"
FULL = "full disk"
LARGE = "file too large"
# What is said where there is not enough memory for a page, and what is not there then.
PAGES = {
    "report.html was not made: ": "not new: out/report.html",
    "evidence.npz and report.html were not made: ": "not new: out/evidence.npz out/report.html",
}
SIZES = 24  # of full disks, and of files' limits, for each job
Snapshot = dict[str, str]


@dataclass(frozen=True)
class Ended:
    """How a child ended; `code` is negative for a signal, None for a hang."""

    code: int | None
    said: str
    calls: int
    failed: str


@dataclass(frozen=True)
class Usual:
    """A job without a fault: its code, what it leaves, and which files are the same each time."""

    code: int
    left: Snapshot
    same: frozenset[str]
    calls: int
    events: int
    size: int
    before: int
    seconds: float  # of CPU


def snapshot(folder: Path) -> Snapshot:
    """Relative names to SHA-256; folders end with a slash."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink() or path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[name + "/"] = ""
    return found


class Bench:
    """The forks, and the library that makes calls fail in them."""

    def __init__(self, work: Path, library: Path) -> None:
        self.work = work
        self.inputs = work / "inputs"
        self.there = work / "there"
        self._shim = ctypes.CDLL(str(library))
        self._shim.faults_arm.argtypes = (
            ctypes.c_char_p, ctypes.c_long, ctypes.c_int, ctypes.c_int,
        )  # fmt: skip
        self._shim.faults_count.restype = ctypes.c_long
        self._shim.faults_what.restype = ctypes.c_char_p

    def lay(self, job: Job) -> Snapshot:
        """Make the folder anew with what is there before the job."""
        self.clear()
        if job.before is not None:
            job.before(self.inputs, self.there)
        return snapshot(self.there)

    def clear(self) -> None:
        """Empty the folder, which may be a mount of its own."""
        self.there.mkdir(exist_ok=True)
        for path in self.there.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def run(
        self,
        command: list[str],
        at: int = 0,
        mode: int = ONCE,
        code: int = 0,
        prepare: Callable[[], None] | None = None,
    ) -> Ended:
        """Run one command in a fork in which the call number `at` fails."""
        said = self.work / "said"
        pid = os.fork()
        if pid == 0:
            self._child(command, said, (at, mode, code), prepare)
        ended, status = 0, 0
        limit = time.monotonic() + HANG
        while not ended:
            ended, status = os.waitpid(pid, os.WNOHANG)
            if not ended and time.monotonic() > limit:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                return Ended(None, said.read_text(errors="replace"), 0, "")
            if not ended:
                time.sleep(0.005)
        return Ended(
            os.waitstatus_to_exitcode(status),
            said.read_text(errors="replace"),
            self._shim.faults_count(),
            self._shim.faults_what().decode(),
        )

    def _child(
        self,
        command: list[str],
        said: Path,
        fault: tuple[int, int, int],
        prepare: Callable[[], None] | None,
    ) -> None:
        status = 99
        try:
            handle = os.open(said, os.O_CREAT | os.O_TRUNC | os.O_WRONLY, 0o600)
            for stream in (1, 2):
                os.dup2(handle, stream)
            from meshreg.cli import app as cli

            if prepare is not None:
                prepare()
            Painted.paint_for(command)
            self._shim.faults_arm(os.fsencode(self.there), *fault)
            status = cli.run(command)
            self._shim.faults_disarm()
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(status)


def know_what_is_found() -> None:
    """Register each job's pair once: forks take over what was found, and write it."""
    import meshreg.pipeline

    search = meshreg.pipeline.register_pair
    found: dict[tuple[Any, ...], Any] = {}

    def known(reference: Any, moving: Any, settings: Any, **more: Any) -> Any:
        sums = (source.sha256 for survey in (reference, moving) for source in survey.source)
        key = (*sums, repr(settings))
        if key not in found:
            found[key] = search(reference, moving, settings, **more)
        elif more.get("settled") is not None and found[key].transform is not None:
            more["settled"](found[key].transform)
        return found[key]

    meshreg.pipeline.register_pair = known


class Painted:
    """Stands in for the process that renders, which writes nothing into a result."""

    returncode = 0
    words: tuple[str, ...] = ()  # of the command for which pictures are made

    @staticmethod
    def paint_for(command: list[str]) -> None:
        """Say whose pictures come next."""
        Painted.words = tuple(word for word in command if word != "--overwrite")

    def communicate(self, asked: str, timeout: float) -> tuple[str, str]:
        """Write a picture of the size that is asked for."""
        import numpy as np

        picture = np.full((1000, 2000, 3), 255, np.uint8)
        picture[300:700, 400:1600] = 90
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)  # of another process
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit[1], limit[1]))
        np.save(json.loads(asked)[1], picture)
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        return "", ""


def paint_quickly() -> None:
    """Render nothing, and draw each figure once: pictures would take nearly all of the time.

    What a command draws is known by its words, `Painted.words`; forks save what was drawn.
    """
    from meshreg.report import figures, scene

    scene.renderer = lambda: contextlib.nullcontext(Painted())  # type: ignore[assignment]
    save, picture = figures._drawn, figures._picture
    known: dict[tuple[str, ...], Any] = {}

    def drawn_once(words: tuple[str, ...], draw: Callable[[], Any]) -> Any:
        if words not in known:
            figure = draw()
            known[words] = None if figure is None else picture(figure)
        return known[words]

    def drawn(jobs: dict[str, Callable[[], Any]], folder: Path, claim: Any) -> list[Path]:
        quick = {
            name: partial(drawn_once, (*Painted.words, name), draw) for name, draw in jobs.items()
        }
        return save(quick, folder, claim)

    figures._drawn = drawn  # type: ignore[assignment]
    figures._picture = lambda drawn: drawn


def usual(bench: Bench, job: Job) -> Usual:
    """Do a job without a fault, four times: once here, so that the forks are warm."""
    from meshreg.cli import app as cli

    command = job.command(bench.inputs, bench.there)
    bench.lay(job)
    Painted.paint_for(command)
    warm = cli.run(command)
    lefts, ended = [], None
    for _ in range(2):
        bench.lay(job)
        begun = cpu_of_children()
        ended = bench.run(command)
        seconds = cpu_of_children() - begun
        lefts.append(snapshot(bench.there))
    assert ended is not None
    if ended.code != warm or warm not in (0, 4) or lefts[0].keys() != lefts[1].keys():
        raise SystemExit(f"{job.name} does not even work: {warm}, {ended.code}\n{ended.said}")
    # a manifest that says what is coming is neither the old nor the new one
    same = frozenset(
        name
        for name in lefts[0]
        if lefts[0][name] == lefts[1][name] and Path(name).name != "manifest.json"
    )
    counting = Events(bench.there, 0)
    bench.lay(job)
    sink = bench.work / "events"
    bench.run(command, prepare=lambda: counting.start(sink))
    size = room(bench.there)
    bench.lay(job)
    before = room(bench.there)
    events = len(sink.read_bytes())
    return Usual(warm, lefts[0], same, ended.calls, events, size, before, seconds)


def cpu_of_children() -> float:
    """CPU seconds of the forks that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def room(folder: Path) -> int:
    """Bytes that the files and folders in a folder take on a disk of 4 KiB pages."""
    sizes = [path.stat().st_size if path.is_file() else 0 for path in folder.rglob("*")]
    return sum(-(-size // 4096) * 4096 + 4096 for size in sizes)


class Events:
    """Raises MemoryError at the k-th event at which Python itself is about to write somewhere."""

    def __init__(self, folder: Path, at: int) -> None:
        self.folder = os.fspath(folder)
        self.at = at
        self.seen = 0
        self.sink = -1

    def start(self, sink: Path | None = None) -> None:
        """Begin; for the rest of this process. Each event is a byte in the file `sink`."""
        if sink is not None:
            self.sink = os.open(sink, os.O_CREAT | os.O_TRUNC | os.O_WRONLY | os.O_APPEND, 0o600)
        sys.addaudithook(self)

    def __call__(self, event: str, values: tuple[Any, ...]) -> None:
        if event not in ("open", "os.rename", "os.mkdir"):
            return
        if not isinstance(values[0], str | bytes) or not os.fsdecode(values[0]).startswith(
            self.folder
        ):
            return
        if event == "open" and not (values[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            return
        self.seen += 1
        if self.sink >= 0:
            os.write(self.sink, b".")
        if self.seen == self.at:
            raise MemoryError


def is_whole(path: Path) -> bool:
    """Whether a file whose bytes are never twice the same is not cut off."""
    data = path.read_bytes()
    if path.suffix == ".json":
        try:
            json.loads(data)
        except ValueError:
            return False
        return True
    if path.suffix == ".html":
        return data.rstrip().endswith(b"</html>")
    return len(data) > 0


def state_of(there: Path, before: Snapshot, usual: Usual, *, in_place: bool) -> tuple[str, str]:
    """Return "old", "new", "between" (file by file old or new) or "lost", and what lies beside."""
    after = snapshot(there)
    if after == before:
        return "old", ""
    strange = sorted(set(after) - set(before) - set(usual.left))
    kept = {name: digest for name, digest in after.items() if name not in strange}

    def is_new(name: str) -> bool:
        if name in usual.same:
            return kept[name] == usual.left[name]
        return name in usual.left and is_whole(there / name)

    beside = " ".join(strange)
    if kept == before:
        return "old", beside
    if kept.keys() == usual.left.keys() and all(map(is_new, kept)):
        return "new", beside
    whole = all(kept[name] == before.get(name) or is_new(name) for name in kept)
    if in_place and whole and set(before) <= set(kept):
        return "between", beside
    changed = [name for name in usual.left if name not in kept or not is_new(name)]
    return "lost", " ".join([beside, "not new:", *changed])


def faults_of(usual: Usual) -> Iterator[tuple[str, int]]:
    """Every fault of a job, with its number."""
    for name in ERRNOS:
        yield from ((name, k) for k in range(1, usual.calls + 1))
    yield from ((MEMORY, k) for k in range(1, usual.events + 1))
    yield from ((LARGE, k) for k in range(SIZES))
    if os.geteuid() == 0:
        yield from ((FULL, k) for k in range(SIZES))


def disturb(bench: Bench, job: Job, usual: Usual, fault: str, k: int) -> tuple[Ended, str]:
    """Run a job with one fault; return how it ended and what is wrong with that, or ""."""
    command = job.command(bench.inputs, bench.there)
    in_place = command[0] in ("report", "validate")
    part = (k + 1) / (SIZES + 1)
    disk = fault == FULL
    if disk:
        bench.clear()
        # room for what is there before, and for a part of what is written
        options = f"size={usual.before + 16384 + int(usual.size * part)}"
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", options, "meshreg", str(bench.there)], check=True
        )
    try:
        before = bench.lay(job)
        ended = _faulty(bench, command, fault, k, int(usual.size * part**3))
        state, beside = state_of(bench.there, before, usual, in_place=in_place)
        wrong = _wrong(ended, fault, usual, state, beside, in_place=in_place)
        if fault == "SIGKILL" and not wrong:
            wrong = _after_kill(bench, job, command, usual)
        return ended, wrong
    finally:
        if disk:
            subprocess.run(["umount", str(bench.there)], check=True)


def _faulty(bench: Bench, command: list[str], fault: str, k: int, limit: int) -> Ended:
    if fault in ERRNOS:
        mode, code = ERRNOS[fault]
        return bench.run(command, k, mode, int(code))
    if fault == MEMORY:
        return bench.run(command, prepare=Events(bench.there, k).start)
    if fault == LARGE:
        return bench.run(
            command,
            prepare=lambda: resource.setrlimit(
                resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY)
            ),
        )
    return bench.run(command, prepare=_no_look_at_the_disk)


def _no_look_at_the_disk() -> None:
    """So that the disk is full in the middle, not found full at the start."""
    from meshreg.cli import common

    common._ROOM = -1e18


def _wrong(
    ended: Ended, fault: str, usual: Usual, state: str, beside: str, *, in_place: bool
) -> str:
    """What is wrong with an end, or ""."""
    said = ended.said
    if ended.code is None:
        return "hangs"
    if "Traceback" in said or "internal error" in said:
        return "traceback"
    if fault == "SIGKILL":
        # between two renames the old result lies beside; `_after_kill` sees it come back
        return "" if ended.code in (-9, usual.code) else "lived on"
    allowed = {usual.code, 6}
    allowed |= {"SIGINT": {130}, "SIGTERM": {143}, MEMORY: {5}}.get(fault, set())
    # the limit holds for the decoder's memory too, and for the file that what is said goes into
    if fault == LARGE and ("memory for its decoder" in said or not said.endswith("\n")):
        allowed.add(5)
    if ended.code not in allowed:
        return f"exit code {ended.code}"
    for what, missing in PAGES.items():  # a page is no reason to lose a result
        named = fault == MEMORY and ended.code == usual.code and what in said
        if named and state == "lost" and beside.endswith(missing):
            beside = beside.removesuffix(missing).strip()
            return f"left beside: {beside}" if beside else ""
    if state == "lost":
        return f"neither the old result nor the new one: {beside}"
    if beside:
        return f"left beside: {beside}"
    same_page = fault == MEMORY and in_place and "report.html was not made again" in said
    if ended.code == usual.code and state != "new" and not same_page:
        return f"exit code {ended.code}, but the result is {state}"
    # in place, what is said to be intact is the one file that is named
    untrue = "nothing was written" in said or ("intact" in said and not in_place)
    if ended.code != usual.code and state == "new" and untrue:
        return "the result is new, and is said not to be"
    if ended.code != usual.code and state == "between" and "nothing was written" in said:
        return "some files are new, and nothing is said to be"
    return ""


def _after_kill(bench: Bench, job: Job, command: list[str], usual: Usual) -> str:
    again = command if command[0] in ("report", "validate") else [*command, "--overwrite"]
    ended = bench.run(list(dict.fromkeys(again)))
    if ended.code != usual.code:
        return f"the next run ends with {ended.code}"
    # a page that is made again in another state of its folder need not be the same to the byte
    pages = frozenset(name for name in usual.same if name.endswith(".html"))
    usual = replace(usual, same=usual.same - pages)
    state, beside = state_of(bench.there, {}, usual, in_place=False)
    if state != "new":
        return f"the next run's result is {state}: {beside}"
    return f"the next run leaves beside: {beside}" if beside else ""


def main() -> int:
    parser = argparse.ArgumentParser(prog="scripts/faults", description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, help="a sample, for so long after the warm-up")
    parser.add_argument("--every", type=int, default=1, help="only every N-th fault")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--job", action="append", help="only these jobs")
    parser.add_argument("--fault", action="append", help="only these faults")
    parser.add_argument("--list", action="store_true", help="name the jobs and end")
    parser.add_argument("--keep", type=Path, help="folder for what failing runs said")
    asked = parser.parse_args()
    jobs = [job for job in JOBS if asked.job is None or job.name in asked.job]
    if asked.list:
        print(*(job.name for job in JOBS), sep="\n")
        return 0
    if not jobs:
        parser.error(f"no job {asked.job}; see --list")
    if LIBRARY not in os.environ:
        return _with_library()
    with tempfile.TemporaryDirectory(prefix="meshreg-faults-") as folder:
        bench = Bench(Path(folder), Path(os.environ[LIBRARY]))
        return _all(bench, jobs, asked)


def _all(bench: Bench, jobs: list[Job], asked: argparse.Namespace) -> int:
    from meshreg.cli import app as cli

    bench.inputs.mkdir()
    make_inputs(bench.inputs)
    know_what_is_found()
    paint_quickly()
    hush = open(os.devnull, "w")  # noqa: SIM115 (to the end)
    stdout, stderr, sys.stdout, sys.stderr = sys.stdout, sys.stderr, hush, hush
    try:
        for command in OLDER.values():
            words = [text.format(bench.inputs, bench.there) for text in command]
            if cli.run(words) not in (0, 4):
                raise SystemExit(f"{' '.join(words)} does not even work")
        known = {}
        for number, job in enumerate(jobs, 1):
            known[job.name] = usual(bench, job)
            made = known[job.name]
            stderr.write(
                f"{number} of {len(jobs)} {job.name}: {made.calls} calls, exit code {made.code}, "
                f"{made.seconds:.1f} s of CPU\n"
            )
            stderr.flush()
    finally:
        sys.stdout, sys.stderr = stdout, stderr
    plan = [
        (job, fault, k)
        for job in jobs
        for fault, k in list(faults_of(known[job.name]))[:: asked.every]
        if asked.fault is None or fault in asked.fault
    ]
    cost = sum(known[job.name].seconds for job, _, _ in plan)
    print(f"{len(plan)} faults, about {cost / 60:.0f} minutes of CPU", flush=True)
    random.Random(asked.seed).shuffle(plan)
    done: collections.Counter[str] = collections.Counter()
    codes: collections.Counter[str] = collections.Counter()
    bad = 0
    until = None if asked.seconds is None else time.monotonic() + asked.seconds
    for job, fault, k in plan:
        if until is not None and time.monotonic() > until:
            break
        ended, wrong = disturb(bench, job, known[job.name], fault, k)
        done[fault] += 1
        codes[str(ended.code)] += 1
        if wrong:
            bad += 1
            print(f"BAD {job.name}, {fault} {k} ({ended.failed}): {wrong}", flush=True)
            if asked.keep is not None:
                asked.keep.mkdir(parents=True, exist_ok=True)
                (asked.keep / f"{job.name}-{fault}-{k}.txt".replace(" ", "_")).write_text(
                    ended.said
                )
    for fault, count in sorted(done.items()):
        print(f"{fault}: {count}")
    print("exit codes:", ", ".join(f"{code}: {count}" for code, count in sorted(codes.items())))
    print(f"{done.total()} of {len(plan)} faults, {bad} bad")
    return 1 if bad else 0


def _with_library() -> int:
    """Compile the library and run this again with it, where root may mount unseen by others."""
    with tempfile.TemporaryDirectory(prefix="meshreg-faults-") as folder:
        library = Path(folder, "faults.so")
        compiler = os.environ.get("CC", "cc")
        command = [compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(HERE / "faults.c")]
        subprocess.run(command, check=True)
        # One thread each: a fork has only the one that forked.
        single = {
            f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "NUMBA", "MKL", "GDAL")
        }
        environment = {
            **os.environ,
            **single,
            "NUMBA_THREADING_LAYER": "workqueue",
            "MPLBACKEND": "Agg",
            LIBRARY: str(library),
            "LD_PRELOAD": str(library),
        }
        apart = ["unshare", "--mount", "--propagation", "private"] if os.geteuid() == 0 else []
        words = [*apart, sys.executable, str(HERE / "faults.py"), *sys.argv[1:]]
        return subprocess.run(words, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
