"""Random changes to files, and what comes of them; see scripts/fuzz."""

from __future__ import annotations

import argparse
import collections
import json
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "scripts" / "stress_parts")]
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import fuzz_changes  # noqa: E402
import fuzz_seeds  # noqa: E402

GIB = 1 << 30
MOST_MEMORY = GIB  # above what the worker held before the case
MOST_CPU = 10.0  # seconds, decoders beside it included
HANG_CPU = 60.0  # seconds of CPU from which a case hangs: others may use the machine, too
WALL = 900.0  # ... and by the clock, where it waits for something that does not come
HARD_MEMORY = 8 * GIB
FINE = {0, 2, 3, 4, 5, 6}


def case_files(seed: fuzz_seeds.Seed, rng: random.Random) -> tuple[str, dict[str, bytes]]:
    """Return the name of the file that was changed, and all files."""
    names = sorted(seed.files)
    weights = [seed.weights.get(name, 1.0) for name in names]
    name = rng.choices(names, weights)[0]
    others = [data for data in seed.files.values() if data]
    return name, seed.files | {name: fuzz_changes.change(name, seed.files[name], rng, others)}


def write_case(here: Path, files: dict[str, bytes]) -> None:
    """Write a case into an emptied folder."""
    shutil.rmtree(here, ignore_errors=True)
    for name, data in files.items():
        path = here / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def run_command(command: tuple[str, ...], main: str, here: Path) -> int:
    """Run one command in this process; return its exit code."""
    from meshreg.cli import app as cli

    folder = str(here / "in")
    words = [
        word.replace("{main}", f"{folder}/{main}").replace("{here}", folder)
        .replace("{out}", str(here / "out"))
        for word in command
    ]  # fmt: skip
    if words[0] == "@rewrite":
        return rewrite(words[1], here / "out")
    return cli.run(words)


def rewrite(name: str, out: Path) -> int:
    """Read a survey and write it moved and turned, as `register` does."""
    import numpy as np

    from meshreg.errors import MeshregError
    from meshreg.io import read_survey, rewrite_survey
    from meshreg.records import Transform

    turn = np.array([[np.cos(0.02), -np.sin(0.02), 0], [np.sin(0.02), np.cos(0.02), 0], [0, 0, 1]])
    options: dict[str, Any] = {}
    if name.endswith("/."):
        options = {"positions": Path(name) / "positions.csv"}
    try:
        survey = read_survey(name, **options)
        move = Transform(turn, 1.0, np.array([1.5, -0.5, 0.25]), survey.centre)
        rewrite_survey(survey, move, out)
    except MeshregError as error:
        print(type(error).__name__, error)
        return error.exit_code
    except Exception:
        traceback.print_exc()
        return 1
    return 0


def peak() -> int:
    """Return the peak of this process's resident memory [bytes] since `forget_peak`."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(item.split()[1]) for item in lines if item.startswith("VmHWM"))


def forget_peak() -> None:
    """Start the peak anew."""
    Path("/proc/self/clear_refs").write_text("5")


def cpu() -> float:
    """Return CPU seconds of this process and of decoders that have ended."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(item.ru_utime + item.ru_stime for item in both)


def worker(orders: int, answers: int, here: Path, seeds: dict[str, fuzz_seeds.Seed]) -> None:
    """Do cases as they are ordered, one JSON line each, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (HARD_MEMORY, HARD_MEMORY))
    resource.setrlimit(resource.RLIMIT_FSIZE, (2 * GIB, 2 * GIB))
    os.environ["TMPDIR"] = str(here.parent)
    log = here.parent / f"{here.name}.log"
    handle = os.open(log, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    with os.fdopen(orders) as lines, os.fdopen(answers, "w") as out:
        for order in lines:
            kind, number, which, drawn = json.loads(order)
            seed = seeds[kind]
            rng = random.Random(f"{drawn}/{kind}/{number}")
            name, files = case_files(seed, rng) if number >= 0 else ("", seed.files)
            command = seed.commands[which] if which >= 0 else rng.choice(seed.commands)
            write_case(here, files)
            os.ftruncate(handle, 0)
            os.lseek(handle, 0, os.SEEK_SET)
            forget_peak()
            before, start = peak(), cpu()
            code = run_command(command, seed.main, here)
            sys.stdout.flush()
            sys.stderr.flush()
            used, held = cpu() - start, peak() - before
            text = log.read_text(errors="replace")
            out.write(
                json.dumps(
                    {
                        "code": code,
                        "file": name,
                        "command": command[0],
                        "cpu": used,
                        "memory": held,
                        "traceback": "Traceback (most recent" in text or "internal error" in text,
                        "said": text[-600:],
                    }
                )
                + "\n"
            )
            out.flush()
    os._exit(0)


class Worker:
    """A forked process that does cases, and is made again where one ends it."""

    def __init__(self, here: Path, seeds: dict[str, fuzz_seeds.Seed]) -> None:
        self.here, self.seeds = here, seeds
        self.busy: tuple[Any, ...] | None = None
        self.since, self.done = 0.0, 0
        self.start()

    def start(self) -> None:
        """Fork."""
        orders, self.orders = os.pipe()
        self.answers, answers = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(self.orders)
            os.close(self.answers)
            try:
                worker(orders, answers, self.here, self.seeds)
            finally:
                os._exit(70)
        os.close(orders)
        os.close(answers)
        self.rest, self.done, self.before = b"", 0, 0.0

    def order(self, *what: Any) -> None:
        """Send a case."""
        self.busy, self.since = what, time.monotonic()
        self.before = 0.0
        self.before = self.cpu()
        os.write(self.orders, (json.dumps(what) + "\n").encode())

    def cpu(self) -> float:
        """Return CPU seconds of the process since the case began."""
        try:
            words = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0
        return sum(map(int, words[11:15])) / os.sysconf("SC_CLK_TCK") - self.before

    def end(self) -> str:
        """Kill the process; return how it had ended, or "hang"."""
        pid, status = os.waitpid(self.pid, os.WNOHANG)
        if pid == 0:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
            status = None
        os.close(self.orders)
        os.close(self.answers)
        if status is None:
            return "hang"
        return f"signal {status & 127}" if status & 127 else f"ended with {status >> 8}"

    def answer(self) -> dict[str, Any] | None:
        """Return the answer, or what ended the process; None where it works on."""
        if select.select([self.answers], [], [], 0)[0]:
            part = os.read(self.answers, 1 << 16)
            self.rest += part
            if self.rest.endswith(b"\n"):
                said: dict[str, Any] = json.loads(self.rest)
                self.rest = b""
                self.done += 1
                return said
            if part:
                return None
            time.sleep(0.05)
            return {"ended": self.end(), "said": _tail(self.here)}
        waited = time.monotonic() - self.since
        changed = self.busy is not None and self.busy[1] >= 0  # before, kernels are compiled
        if waited > WALL or (changed and waited > HANG_CPU and self.cpu() > HANG_CPU):
            return {"ended": self.end(), "said": _tail(self.here)}
        return None


def _tail(here: Path) -> str:
    return (here.parent / f"{here.name}.log").read_text(errors="replace")[-600:]


def outcome(said: dict[str, Any]) -> str:
    """Return what a case came to; those that are not fine are in capital letters."""
    if "ended" in said:
        return "HANG" if said["ended"] == "hang" else f"CRASH ({said['ended']})"
    if said["code"] not in FINE:
        return f"EXIT {said['code']}"
    if said["traceback"]:
        return "TRACEBACK"
    if said["memory"] > MOST_MEMORY:
        return "MEMORY"
    if said["cpu"] > MOST_CPU:
        return "TIME"
    return f"exit {said['code']}"


def keep(folder: Path, here: Path, case: tuple[Any, ...], said: dict[str, Any], what: str) -> None:
    """Keep a failing case: its files, and how it failed."""
    target = folder / f"{case[0]}_{case[3]}_{case[1]}"
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(here / "in", target)
    said = {"outcome": what, "case": case, **said}
    (target / "outcome.json").write_text(json.dumps(said, indent=1))


def main() -> int:
    """Do as the command line says; return 1 where a case failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=None, help="cases; 1000 unless --seconds")
    parser.add_argument("--seconds", type=float, default=None, help="stop after")
    parser.add_argument("--format", action="append", help="a kind, or how its name begins")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--workers", type=int, default=min(os.cpu_count() or 1, 8))
    parser.add_argument("--keep", type=Path, default=ROOT / "out" / "fuzz")
    parser.add_argument("--list", action="store_true")
    said = parser.parse_args()
    makers = fuzz_seeds.seeds()
    kinds = [k for k in makers if not said.format or any(k.startswith(f) for f in said.format)]
    if said.list:
        print("\n".join(kinds))
        return 0
    if not kinds:
        parser.error(f"--format: there are {', '.join(makers)}")
    count = said.count or (1000 if said.seconds is None else 1 << 60)
    said.keep.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="meshreg-fuzz-") as folder:
        return fuzz(said, _made(makers, kinds), kinds, count, Path(folder))


def _made(makers: Any, kinds: list[str]) -> dict[str, fuzz_seeds.Seed]:
    """Make the seeds in a process of its own: threads that it starts must not be forked."""
    import pickle

    source, target = os.pipe()
    if os.fork() == 0:
        try:
            sys.stdout = sys.stderr
            records: dict[str, Any] = {}
            with os.fdopen(target, "wb") as out:
                made = {}
                for kind in kinds:
                    if kind in ("ties", "record", "evidence"):
                        records.setdefault("files", fuzz_seeds.record())
                        fuzz_seeds.record = lambda: records["files"]  # type: ignore[assignment]
                    made[kind] = makers[kind]()
                pickle.dump(made, out)
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    os.close(target)
    with os.fdopen(source, "rb") as stream:
        seeds: dict[str, fuzz_seeds.Seed] = pickle.load(stream)
    os.wait()
    return seeds


def fuzz(
    said: Any, seeds: dict[str, fuzz_seeds.Seed], kinds: list[str], count: int, folder: Path
) -> int:
    """Run the cases and print the table."""
    import laspy  # noqa: F401  imported here once, not by each worker
    import pyproj  # noqa: F401
    import rasterio  # noqa: F401
    from PIL import Image  # noqa: F401

    from meshreg.cli import app as cli  # noqa: F401

    workers = [Worker(folder / f"w{k}", seeds) for k in range(said.workers)]
    plain = [(kind, -1, k, 0) for kind in kinds for k in range(len(seeds[kind].commands))]
    start = time.monotonic()
    table: dict[str, collections.Counter[str]] = {kind: collections.Counter() for kind in kinds}
    failed: list[str] = []
    todo = iter(plain)
    phase, number, running = "plain", said.first, True
    stopped: list[int] = []
    again: set[tuple[Any, ...]] = set()
    signal.signal(signal.SIGINT, lambda number, frame: stopped.append(number))
    while running or any(w.busy for w in workers):
        for one in workers:
            if one.busy is not None:
                answer = one.answer()
                if answer is None:
                    continue
                case, what = one.busy, outcome(answer)
                one.busy = None
                if what == "TIME" and case not in again:  # a kernel may have been compiled
                    again.add(case)
                    one.order(*case)
                    continue
                if case[1] < 0:  # what is not changed must be read: else nothing is tried
                    if answer.get("code") not in (0, 4):
                        failed.append(f"{case[0]} unchanged: {what}: {answer['said'][-300:]}")
                    start = time.monotonic()
                else:
                    table[case[0]][what] += 1
                    if what.isupper() or not what.startswith("exit"):
                        keep(said.keep, one.here, case, answer, what)
                        label = f"{case[0]} {answer.get('file', '?')} {answer.get('command', '?')}"
                        failed.append(f"{label} seed {case[3]} case {case[1]}: {what}")
                        print(f"{failed[-1]}: {answer['said'][-200:]!r}", flush=True)
                if "ended" in answer:
                    one.start()
                elif one.done >= 1500:
                    one.end()
                    one.start()
            if not running:
                continue
            if phase == "plain":
                following = next(todo, None)
                if following is not None and not stopped:
                    one.order(*following)
                    continue
                if any(w.busy for w in workers):
                    continue
                phase = "changed"
            late = said.seconds is not None and time.monotonic() - start > said.seconds
            if number >= said.first + count or late or stopped:
                running = False
                continue
            one.order(kinds[number % len(kinds)], number, -1, said.seed)
            number += 1
            if (number - said.first) % 500 == 0:
                taken = time.monotonic() - start
                print(f"{number - said.first} cases, {taken:.0f} s", file=sys.stderr, flush=True)
        time.sleep(0.002)
    for one in workers:
        one.end()
    show(table, failed, time.monotonic() - start)
    return 1 if failed else 0


def show(table: dict[str, collections.Counter[str]], failed: list[str], seconds: float) -> None:
    """Print how many cases of each kind came to what."""
    columns = sorted({what for counts in table.values() for what in counts})
    width = max(map(len, table)) + 2
    print("".ljust(width) + "".join(c.rjust(max(9, len(c) + 2)) for c in ["cases", *columns]))
    total: collections.Counter[str] = collections.Counter()
    for kind, counts in [*table.items(), ("all", total)]:
        row = [sum(counts.values()), *(counts[c] for c in columns)]
        heads = ["cases", *columns]
        cells = [str(n).rjust(max(9, len(c) + 2)) for n, c in zip(row, heads, strict=True)]
        print(kind.ljust(width) + "".join(cells))
        if counts is not total:
            total += counts
    print(f"{sum(total.values())} cases in {seconds:.0f} s; {len(failed)} failed")
    for text in failed[:40]:
        print("  " + text)


if __name__ == "__main__":
    sys.exit(main())
