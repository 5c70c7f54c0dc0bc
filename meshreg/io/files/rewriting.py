"""What every rewriter of a survey file does around its own format."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.files.atomic import copy_file
from meshreg.io.files.safe import fingerprint
from meshreg.io.frames.mover import Mover
from meshreg.records import Float64, SourceFile, ends

_LOG = logging.getLogger("meshreg")
FINEST = 1e-4  # coarsest step of stored coordinates [m] that counts as lossless


def require_unchanged(source: SourceFile, path: Path) -> None:
    """Refuse to rewrite a file onto itself, or one that has changed since it was read.

    Raises
    ------
    UsageError
        `path` is the source.
    InputError
        Size or time of the source, or of a file that it refers to, differ from those when it was
        read.
    """
    if path.exists() and path.samefile(source.path):
        raise UsageError("would be overwritten by itself.", file=path, remedy="Choose another.")
    if source.fingerprint not in ((0, 0), fingerprint(source.path, source.companions)):
        raise InputError(
            "has changed since it was read.", file=source.path, remedy="Start the run again."
        )


def copy_companions(source: SourceFile, path: Path, *, but: str = "") -> tuple[Path, ...]:
    """Copy the files that a survey file refers to, to the same place beside the new one.

    Those in `source.copies` get the name that stands there. With `but`, files of that suffix are
    left to the caller (their names are returned all the same).

    Returns
    -------
    tuple of Path
        The copies.
    """
    copies = []
    for companion in source.companions:
        target = path.parent / copy_name(source, companion)
        if not but or companion.suffix.lower() != but:
            copy_file(companion, target)
        copies.append(target)
    return tuple(copies)


def copy_name(source: SourceFile, companion: Path) -> Path:
    """Return where a companion's copy goes, from the moved file's folder."""
    name = source.copies.get(companion)
    return companion.relative_to(source.path.parent) if name is None else Path(name)


def metres_per_file_unit(move: Mover) -> float:
    """Return the length [m] of one unit of the file that a mover leads to."""
    return float(np.cbrt(abs(np.linalg.det(move.frame.axes))))


def moved_points(move: Mover, points: NDArray[Any]) -> Float64:
    """Move points (N, 3); those that are not finite stay as they are."""
    points = np.asarray(points, np.float64)
    finite = np.isfinite(points).all(axis=1)
    if finite.all():
        return move.points(points)
    moved = points.copy()
    moved[finite] = move.points(points[finite])
    return moved


def float32_step(move: Mover, points: NDArray[Any]) -> float:
    """Return by how much float32 would step at the moved points [m].

    The corners of the bounding box stand for all.
    """
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        return 0.0
    ends = np.array([finite.min(axis=0), finite.max(axis=0)], np.float64)
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)
    largest = np.abs(move.points(corners)).max()
    return float(np.spacing(np.float32(largest))) * metres_per_file_unit(move)


class Extent:
    """Count, lowest and highest of points written, to compare with what is read back."""

    def __init__(self) -> None:
        self.count = 0
        self.low = np.full(3, np.inf)
        self.high = np.full(3, -np.inf)

    def add(self, points: NDArray[Any]) -> None:
        """Take in points (N, 3)."""
        self.count += len(points)
        finite = np.asarray(points, np.float64)
        if not np.isfinite(finite).all():
            finite = finite[np.isfinite(finite).all(axis=1)]
        if len(finite):
            low, high = ends(finite)
            self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)

    def require_equal(self, points: NDArray[Any], path: Path, tolerance: float = 0.0) -> None:
        """Check points read back from `path`.

        Raises
        ------
        OutputError
            Their number or bounds differ from those written by more than `tolerance`.
        """
        again = Extent()
        again.add(points)
        off = max(np.abs(again.low - self.low).max(), np.abs(again.high - self.high).max())
        if again.count != self.count or (np.isfinite(self.low).all() and not off <= tolerance):
            raise OutputError(
                f"does not read back as written: {again.count} points of {self.count}, "
                f"bounds off by {off:.3g}.",
                file=path,
                remedy="Check the disk and run again.",
            )


def require_close(
    found: NDArray[Any], expected: NDArray[Any], tolerance: float, path: Path
) -> None:
    """Check points read back from `path` one by one; those that are not finite are left out.

    Raises
    ------
    OutputError
        Their number differs, or one of them is off by more than `tolerance`.
    """
    off = float("inf")
    if found.shape == expected.shape:
        with np.errstate(invalid="ignore"):  # infinity less infinity
            away = np.abs(found - expected)
        away[~np.isfinite(expected).all(axis=1)] = 0
        off = float(away.max(initial=0))
    if not off <= tolerance:
        raise OutputError(
            f"does not read back as written: {len(found)} points of {len(expected)}, "
            f"off by up to {off:.3g}.",
            file=path,
            remedy="Check the disk and run again.",
        )


def warn(path: Path, note: str) -> None:
    """Log what a rewriter changed beside coordinates."""
    _LOG.warning("%s: %s", path.name, note)
