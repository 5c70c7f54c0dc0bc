"""A moved copy of a COLMAP model: numbers of poses and points change, no other byte does.

pycolmap cuts an image's name at its first blank when it reads text (as of 4.2), and writes
comments, digits and line ends anew; so the files are edited where the numbers stand.
https://colmap.github.io/format.html
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from meshreg.errors import OutputError
from meshreg.io.colmap.files import Model, ModelFiles, binary_places
from meshreg.io.files.atomic import copy_file
from meshreg.io.files.safe import file_bytes, open_regular
from meshreg.records import Float64

_POSE = re.compile(rb"(\s*\d+[ \t]+)((?:\S+[ \t]+){6}\S+)(.*)", re.DOTALL)  # of an image
_FRAME = re.compile(rb"(\s*\d+[ \t]+\d+[ \t]+)((?:\S+[ \t]+){6}\S+)(.*)", re.DOTALL)
_POINT = re.compile(rb"(\s*\d+[ \t]+)((?:\S+[ \t]+){2}\S+)(.*)", re.DOTALL)


@dataclass(frozen=True, eq=False)
class ModelMove:
    """``x' = scale * rotation @ x + shift`` of a model's world."""

    scale: float
    rotation: Float64
    shift: Float64

    def points(self, xyz: Float64) -> Float64:
        """Move points (N, 3)."""
        return np.asarray(xyz @ (self.scale * self.rotation).T + self.shift)

    def poses(self, poses: Float64) -> Float64:
        """Return the poses (N, 7) from the moved world: quaternion w, x, y, z, then translation.

        A camera sees scale times what it saw: R' = R Q', t' = scale t - R' shift.
        """
        from scipy.spatial.transform import Rotation

        turns = Rotation.from_quat(poses[:, :4], scalar_first=True)
        turns = turns * Rotation.from_matrix(self.rotation).inv()
        shifts = self.scale * poses[:, 4:] - turns.apply(self.shift)
        return np.hstack([turns.as_quat(canonical=True, scalar_first=True), shifts])

    def sensors(self, poses: Float64) -> Float64:
        """Return the poses (N, 7) of sensors in their rigs: their distances grow."""
        return np.hstack([poses[:, :4], self.scale * poses[:, 4:]])


def write_moved(files: ModelFiles, move: ModelMove, folder: Path) -> None:
    """Write a model's files with poses and points moved."""
    for path in files.paths:
        if path.stem == "cameras":
            copy_file(path, folder / path.name)
        elif files.suffix == ".bin":
            _write_binary(path, move, folder / path.name)
        else:
            _write_text(path, move, folder / path.name)


def _write_binary(path: Path, move: ModelMove, target: Path) -> None:
    data = np.array(file_bytes(path))
    places = np.array(binary_places(path), np.int64)
    moved = _of(path, move)
    each = 3 if path.stem == "points3D" else 7
    for start in range(0, len(places), 1 << 18):
        spans = places[start : start + (1 << 18), None] + np.arange(8 * each)
        values = data[spans].view("<f8")
        data[spans] = np.ascontiguousarray(moved(values), "<f8").view(np.uint8)
    with open(target, "wb") as stream:
        stream.write(data.data)


def _of(path: Path, move: ModelMove) -> Callable[[Float64], Float64]:
    """Return what becomes of the numbers that a file holds."""
    return {"points3D": move.points, "rigs": move.sensors}.get(path.stem, move.poses)


def _write_text(path: Path, move: ModelMove, target: Path) -> None:
    editor = {"images": _images, "frames": _frames, "points3D": _points, "rigs": _rigs}[path.stem]
    with open_regular(path) as stream, open(target, "wb") as out:
        out.writelines(editor(iter(stream), move))


def _is_data(line: bytes) -> bool:
    stripped = line.strip()
    return bool(stripped) and not stripped.startswith(b"#")


def _edited(form: re.Pattern[bytes], line: bytes, moved: Callable[[Float64], Float64]) -> bytes:
    """Return a line whose group 2 are numbers, these moved."""
    match = form.fullmatch(line)
    if match is None:  # pycolmap has read the file, so this is no number that it knows
        raise OutputError(f"has a line that cannot be moved: {line[:60]!r}.")
    values = np.array([[float(word) for word in match[2].split()]])
    return match[1] + _words(moved(values)[0]) + match[3]


def _words(values: Float64) -> bytes:
    return " ".join(f"{value:.17g}" for value in values.tolist()).encode()


def _images(lines: Iterator[bytes], move: ModelMove) -> Iterator[bytes]:
    """Of two lines an image: the first has its pose, the second (maybe empty) what it saw."""
    for line in lines:
        if not _is_data(line):
            yield line
            continue
        yield _edited(_POSE, line, move.poses)
        yield next(lines, b"")


def _frames(lines: Iterator[bytes], move: ModelMove) -> Iterator[bytes]:
    for line in lines:
        yield _edited(_FRAME, line, move.poses) if _is_data(line) else line


def _points(lines: Iterator[bytes], move: ModelMove) -> Iterator[bytes]:
    for line in lines:
        yield _edited(_POINT, line, move.points) if _is_data(line) else line


def _rigs(lines: Iterator[bytes], move: ModelMove) -> Iterator[bytes]:
    """Rig, number of sensors, the first sensor's type and number; then the others, some posed."""
    for line in lines:
        if not _is_data(line):
            yield line
            continue
        words = line.split()
        at = 4
        while at + 2 < len(words):
            if words[at + 2] == b"1":
                pose = np.array([[float(word) for word in words[at + 3 : at + 10]]])
                words[at + 3 : at + 10] = _words(move.sensors(pose)[0]).split()
                at += 7
            at += 3
        yield b" ".join(words) + line[len(line.rstrip()) :]


def text_kept(old: ModelFiles, new: ModelFiles) -> bool:
    """Whether two text models differ in the numbers of poses and points alone.

    Lines are taken apart by counting words, not by the patterns of the writer; an image's name is
    the rest of its line, blanks included.
    """
    moved = {"cameras": (0, 0), "images": (1, 8), "frames": (2, 9), "points3D": (1, 4)}
    for before, after in zip(old.paths, new.paths, strict=True):
        start, end = moved.get(before.stem, (0, 0))
        with open_regular(before) as first, open_regular(after) as second:
            pose_is_next = True
            for one, other in zip_longest(first, second, fillvalue=b""):
                bare = one.strip()
                if before.stem == "images" and not pose_is_next:
                    pose_is_next, same = True, one == other
                elif not bare or bare.startswith(b"#"):
                    same = one == other
                elif before.stem == "rigs":
                    same = len(bare.split()) == len(other.split())
                else:
                    pose_is_next = False
                    a, b = one.split(None, end), other.split(None, end)
                    del a[start:end], b[start:end]
                    same = a == b
                if not same:
                    return False
    return True


def check_moved(
    before: Model,
    after: Model,
    moved: Callable[[Float64], Float64],
    rotation: Float64,
    unit: float,
    path: Path,
) -> None:
    """Compare a model as pycolmap reads it with the moved old one.

    Parameters
    ----------
    before, after : Model
    moved : function
        What becomes of points (N, 3).
    rotation : (3, 3) float64
    unit : float
        Metres per unit of the new model.
    path : Path

    Raises
    ------
    OutputError
        A point or a camera is off by a millimetre, a view by a microradian, or a name differs.
    """
    off = turned = float("inf")
    if len(after.points) == len(before.points) and len(after.views) == len(before.views):
        places = np.abs(after.points - moved(before.points)).max(initial=0)
        cameras = np.abs(after.centres - moved(before.centres)).max(initial=0)
        off = float(max(places, cameras)) * unit
        turned = float(np.abs(after.views - before.views @ rotation.T).max(initial=0))
    if after.names != before.names or not (off < 1e-3 and turned < 1e-6):
        raise OutputError(
            f"is off by {off:.3g} m when read back (a model moves by a similarity only).",
            file=path,
        )
