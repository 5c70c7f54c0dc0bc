"""READ LAS, LAZ and COPC by laspy, in chunks; `cloud_write` writes and rewrites them."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError
from meshreg.io.assemble import Found, placed_survey
from meshreg.io.files.safe import open_regular
from meshreg.io.frames.place import place
from meshreg.io.frames.sidecar import find_sidecar
from meshreg.io.las.classes import BED, NOISE, OLD_WATER, RECLASS, WATER, class_notes, in_classes
from meshreg.io.las.extra import extra_directions
from meshreg.io.las.header import LasHead, check_header, file_crs
from meshreg.io.las.laz_chunks import las_errors
from meshreg.io.las.laz_points import LazBackend
from meshreg.io.options import ReadOptions
from meshreg.records import Bool, Float64, PointCloud, Survey, UInt8

_LOG = logging.getLogger("meshreg")
_CHUNK_BYTES = 64_000_000
_LOST = np.iinfo(np.int32).min  # what NaN becomes in a LAS file


def read(path: Path, options: ReadOptions) -> Survey:
    """Read a LAS, LAZ or COPC file as a point cloud.

    Points flagged withheld, classed as noise (7, 18) or water (41, 42, 45; see `classes`) or
    without coordinates are left out and counted. The bounds in the header are not believed but
    taken from the points.

    Parameters
    ----------
    path : Path
    options : ReadOptions

    Returns
    -------
    Survey
        With a PointCloud; colors as 8 bits, None where the file has none or all are zero.

    Raises
    ------
    InputError
        Cut off or damaged, counts that the file cannot hold, a scale of zero, no usable point,
        coordinates outside their CRS.
    """
    path = Path(path)
    head = check_header(path)
    notes: list[str] = []
    with las_errors(path), opened(path) as reader:
        crs, unit = file_crs(reader.header, notes)
        notes += extra_directions(reader.header.point_format).notes
        steps, colors, counts = _read_points(reader, path, head, options.geometry_only)
    notes += _drop_notes(counts)
    if not len(steps):
        remedy = RECLASS if counts["water"] else None
        raise InputError(f"holds no usable point ({' '.join(notes)}).", file=path, remedy=remedy)
    points = steps * np.array(head.step)
    points += np.array(head.offset)
    del steps
    keep = without_strays(points, notes)
    if keep is not None:
        points, colors = points[keep], None if colors is None else colors[keep]
    for note in notes:
        _LOG.warning("%s: %s", path.name, note)
    if unit is not None and options.unit is None and not _sidecar_says_unit(path):
        options = replace(options, unit=unit)  # type: ignore[arg-type]
    placed = place(path, points, options, crs, georeferenced=True)
    geometry = PointCloud(placed.points, None if colors is None else _eight_bit(colors, notes))
    found = Found("las", tuple(notes), counts={"points": head.count, "used": len(points)})
    return placed_survey(path, placed, geometry, found, path.name.split(".")[0])


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Give a laspy reader of a regular file whose header has been checked.

    A chunk of points is good until the next one is read.
    """
    import laspy

    with contextlib.ExitStack() as decoders, open_regular(path) as stream:
        backend = LazBackend(path, decoders)
        with laspy.open(stream, closefd=False, laz_backend=backend) as reader:
            yield reader


def chunk_points(record: int) -> int:
    """Return how many points of `record` bytes are read at once."""
    return max(1, min(1_000_000, _CHUNK_BYTES // record))


def _read_points(
    reader: Any, path: Path, head: LasHead, geometry_only: bool
) -> tuple[NDArray[np.int32], NDArray[np.uint16] | None, dict[str, int]]:
    """Return raw coordinates (N, 3), raw colors (N, 3) or None, and counts of what was dropped."""
    names = set(reader.header.point_format.dimension_names)
    colored = {"red", "green", "blue"} <= names and not geometry_only
    steps: list[NDArray[np.int32]] = []
    colors: list[NDArray[np.uint16]] = []
    counts = {"withheld": 0, "noise": 0, "water": 0, "without coordinates": 0}
    nines: list[Bool] = []
    has_bed = False
    seen = 0
    for chunk in reader.chunk_iterator(chunk_points(head.record)):
        seen += len(chunk)
        raw = np.stack([chunk["X"], chunk["Y"], chunk["Z"]], axis=1)
        lost = (raw == _LOST).any(axis=1)
        withheld = np.asarray(chunk["withheld"]).astype(bool) & ~lost
        classes = np.asarray(chunk["classification"])
        rest = ~(lost | withheld)
        noise, water, nine = (
            in_classes(classes, kind) & rest for kind in (NOISE, WATER, OLD_WATER)
        )
        has_bed = has_bed or bool((in_classes(classes, BED) & rest).any())
        for name, dropped in zip(counts, (withheld, noise, water, lost), strict=True):
            counts[name] += int(np.count_nonzero(dropped))
        keep = rest & ~(noise | water)
        nines.append(nine[keep])
        whole = bool(keep.all())
        steps.append(raw if whole else raw[keep])
        if colored:
            rgb = np.stack([chunk["red"], chunk["green"], chunk["blue"]], axis=1)
            colors.append(rgb if whole else rgb[keep])
    if seen != head.count:
        raise InputError(
            f"declares {head.count} points, but holds {seen}.",
            file=path,
            place="header",
            remedy="The file is cut off; copy or export it again.",
        )
    joined = np.concatenate(colors) if colored else None
    points, old_water = np.concatenate(steps), np.concatenate(nines)
    if has_bed and old_water.any():
        counts["water"] += int(np.count_nonzero(old_water))
        points, joined = points[~old_water], None if joined is None else joined[~old_water]
    if joined is not None and not joined.any():
        joined = None  # the fields are there, but nobody filled them
    return points, joined, counts


def without_strays(points: Float64, notes: list[str]) -> Bool | None:
    """Find points that lie far outside all others, such as (0, 0, 0) among eastings of 700000.

    Far is over 50 times the range of the middle 98 % (heights: of the larger of their own range
    and the horizontal one) from the median. They would blow up every raster.

    Returns
    -------
    (N,) bool or None
        Points to keep; None where all are.
    """
    sample = points[:: max(1, len(points) // 100_000)]
    low, middle, high = np.percentile(sample, [1, 50, 99], axis=0)
    reach = 50 * np.maximum(high - low, (high - low)[:2].max())
    if not reach.all():
        return None
    keep: Bool = np.ones(len(points), np.bool_)
    for axis in range(3):
        keep &= np.abs(points[:, axis] - middle[axis]) <= reach[axis]
    count = len(keep) - int(np.count_nonzero(keep))
    if not count:
        return None
    notes.append(f"{count} points far away from all others were left out.")
    return keep


def _drop_notes(counts: dict[str, int]) -> list[str]:
    notes = [f"{counts['withheld']} points flagged withheld were left out."] * bool(
        counts["withheld"]
    )
    notes += class_notes(counts["noise"], counts["water"])
    if lost := counts["without coordinates"]:
        notes.append(f"{lost} points without coordinates were left out.")
    return notes


def _sidecar_says_unit(path: Path) -> bool:
    sidecar = find_sidecar(path, shared=False, again=True)
    return sidecar is not None and sidecar.unit is not None


def _eight_bit(colors: NDArray[np.uint16], notes: list[str]) -> UInt8:
    """Turn 16-bit colors into 8 bits; values that never exceed 255 are 8-bit already."""
    if int(colors.max()) <= 255:
        notes.append("Colors have 8-bit values in 16-bit fields; they were taken as 0-255.")
        return colors.astype(np.uint8)
    return ((colors.astype(np.uint32) + 128) // 257).astype(np.uint8)
