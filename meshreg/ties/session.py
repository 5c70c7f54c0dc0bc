"""What is being picked: the pairs, every change to them, and the file that follows each change.

All windows talk to one session. A change names the revision that it was made on; if another
window was faster it is refused, and that window shows the new state first. The file is written
whole after every change, before the change counts.
"""

from __future__ import annotations

import dataclasses
import os
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from meshreg.errors import MeshregError, OutputError, UsageError
from meshreg.ties.records import MAX_NAME, MAX_PAIRS, Point, TiePair, TiePoints
from meshreg.ties.table import read_ties, write_ties

if TYPE_CHECKING:
    from collections.abc import Iterator

SIDES = ("reference", "moving")
UNDO = 500  # changes that can be taken back
Pairs = tuple[TiePair, ...]


class StaleError(MeshregError):
    """A change made on a state that is no longer the present one."""


class Session:
    """The pairs of one `ties.csv`, changed by one thread at a time.

    Parameters
    ----------
    path : Path
        Read if it exists; written after every change.
    crs : str or None
        Of the surveys; a file that states another is refused.

    Attributes
    ----------
    revision : int
        Raised by every change.
    saved : float
        Time of the last writing (Unix seconds), or 0.
    """

    def __init__(self, path: Path, crs: str | None = None) -> None:
        self.path = Path(path)
        self.crs = crs
        self.revision = 0
        self.saved = 0.0
        self._lock = threading.Lock()
        self._pairs: Pairs = ()
        self._undo: list[Pairs] = []
        self._redo: list[Pairs] = []
        self._seen: tuple[int, int] | None = None
        self._load()

    @property
    def ties(self) -> TiePoints:
        """The pairs as they stand."""
        return TiePoints(self._pairs, self.crs)

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to take back."""
        return bool(self._undo)

    @property
    def can_redo(self) -> bool:
        """Whether a change was taken back."""
        return bool(self._redo)

    def change(self, revision: int, what: str, values: Mapping[str, Any]) -> None:
        """Make one change and write the file.

        Parameters
        ----------
        revision : int
            The one that the change was made on.
        what : str
            "point" (side, x, y: the open pair's, or a new one), "move" (id, side, x, y),
            "name" (id, name), "delete" (id), "undo" or "redo".
        values : mapping

        Raises
        ------
        StaleError
            Another window, or another program, changed the pairs meanwhile.
        UsageError
            A change that cannot be meant.
        OutputError
            The file could not be written; the pairs are as before.
        """
        with self._lock:
            if self._changed_outside():
                self._load()
                self._undo, self._redo, self.revision = [], [], self.revision + 1
                raise StaleError(f"{self.path.name} was changed by another program.")
            if revision != self.revision:
                raise StaleError("Another window changed the pairs.")
            undo, redo = [*self._undo], [*self._redo]
            if what in ("undo", "redo"):
                come, go = (undo, redo) if what == "undo" else (redo, undo)
                if not come:
                    raise UsageError(f"There is nothing to {what}.")
                go.append(self._pairs)
                pairs = come.pop()
            else:
                if what not in _CHANGES:
                    raise UsageError(f"Unknown change {what!r}.")
                pairs = _CHANGES[what](self._pairs, values)
                undo, redo = [*undo, self._pairs][-UNDO:], []
            write_ties(TiePoints(pairs, self.crs), self.path)
            self._pairs, self._undo, self._redo = pairs, undo, redo
            self.revision += 1
            self._written()

    def _load(self) -> None:
        seen = _fingerprint(self.path)
        if seen is None:
            return
        found = read_ties(self.path)
        if found.pairs and found.crs != self.crs:
            raise UsageError(
                f"is in {found.crs or 'a local frame'}, the surveys in "
                f"{self.crs or 'a local frame'}.",
                file=self.path,
                remedy="Choose another file with -o.",
            )
        self._pairs, self._seen = found.pairs, seen

    def _written(self) -> None:
        self._seen = _fingerprint(self.path)
        self.saved = time.time()

    def _changed_outside(self) -> bool:
        found = _fingerprint(self.path)
        return found is not None and found != self._seen  # one that is gone is written again


def _fingerprint(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_size, status.st_mtime_ns


@contextmanager
def only_one(path: Path) -> Iterator[None]:
    """Keep a second `meshreg pick` out of the same file while the block runs.

    Raises
    ------
    OutputError
        Another process has it, or no file can be written there.
    """
    import fcntl  # POSIX only

    from meshreg.io.files.atomic import as_output_error

    lock = path.with_name(f".{path.name}.lock")
    with as_output_error(path):
        handle = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                "is open in another `meshreg pick`.",
                file=path,
                remedy="Use its page, or choose another file with -o.",
            ) from None
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _point(pairs: Pairs, values: Mapping[str, Any]) -> Pairs:
    """Give the open pair its point of one side; without an open pair, open a new one."""
    side, point = _side(values), as_place(values)
    for pair in pairs:
        if not pair.complete:
            return _replaced(pairs, _with_point(pair, side, point))
    if len(pairs) >= MAX_PAIRS:
        raise UsageError(f"There are {MAX_PAIRS} pairs; more are not taken.")
    number = max((pair.id for pair in pairs), default=0) + 1
    return (*pairs, _with_point(TiePair(number), side, point))


def _with_point(pair: TiePair, side: str, point: Point) -> TiePair:
    if side == "reference":
        return dataclasses.replace(pair, reference=point)
    return dataclasses.replace(pair, moving=point)


def _move(pairs: Pairs, values: Mapping[str, Any]) -> Pairs:
    pair, side = _find(pairs, values), _side(values)
    if getattr(pair, side) is None:
        raise UsageError(f"Pair {pair.id} has no {side} point to move.")
    return _replaced(pairs, _with_point(pair, side, as_place(values)))


def _name(pairs: Pairs, values: Mapping[str, Any]) -> Pairs:
    name = values.get("name")
    if not isinstance(name, str):
        raise UsageError("A name is a text.")
    plain = " ".join("".join(c if c.isprintable() else " " for c in name).split())
    return _replaced(pairs, dataclasses.replace(_find(pairs, values), name=plain[:MAX_NAME]))


def _delete(pairs: Pairs, values: Mapping[str, Any]) -> Pairs:
    gone = _find(pairs, values)
    return tuple(pair for pair in pairs if pair is not gone)


_CHANGES: dict[str, Callable[[Pairs, Mapping[str, Any]], Pairs]] = {
    "point": _point,
    "move": _move,
    "name": _name,
    "delete": _delete,
}


def _replaced(pairs: Pairs, new: TiePair) -> Pairs:
    return tuple(new if pair.id == new.id else pair for pair in pairs)


def _find(pairs: Pairs, values: Mapping[str, Any]) -> TiePair:
    for pair in pairs:
        if pair.id == values.get("id"):
            return pair
    raise UsageError(f"There is no pair {values.get('id')!r}.")


def _side(values: Mapping[str, Any]) -> str:
    side = values.get("side")
    if side not in SIDES:
        raise UsageError(f"A point's side is reference or moving, not {side!r}.")
    return str(side)


def as_place(values: Mapping[str, Any]) -> Point:
    """Return a change's x and y [m], to a tenth of a millimetre.

    Raises
    ------
    UsageError
        They are no two numbers, or no place on earth.
    """
    point = values.get("x"), values.get("y")
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in point):
        raise UsageError(f"A point is two numbers, not {point}.")
    if not all(abs(v) < 1e9 for v in point):  # type: ignore[arg-type]
        raise UsageError("A point so far out is not a place on earth.")
    east, north = (round(float(v), 4) for v in point)  # type: ignore[arg-type]
    return east, north
