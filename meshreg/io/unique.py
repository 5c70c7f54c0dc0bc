"""Points that a cloud holds twice: left out of the estimation, kept in the registered file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from meshreg.records import Bool, Float64, PointCloud, Survey

_BITS = (22, 22, 20)  # of east, north, up in a voxel's 64-bit number
_FEW = 1_000_000  # points; of more, a sixteenth of the voxels is looked at first


def without_repeats(survey: Survey) -> Survey:
    """Return a cloud with one point to a voxel of a 4-millionth of its extent.

    Overlapping tiles and repeated exports hold the same point several times, which makes the
    ground look denser there, and the cells chosen finer, than it is. Voxels are finer than what
    32-bit numbers tell apart, so that different points stay. The file's own points are untouched:
    rewriting moves all of them.
    """
    cloud = survey.geometry
    if not isinstance(cloud, PointCloud) or len(cloud.points) < 2:
        return survey
    numbers = _voxels(cloud.points)
    if len(numbers) > _FEW and first_of_each(_sixteenth(numbers)) is None:
        return survey
    keep = first_of_each(numbers)
    if keep is None:
        return survey
    colors = None if cloud.colors is None else cloud.colors[keep]
    lost = len(keep) - int(np.count_nonzero(keep))
    note = f"{lost} points that repeat another's place were left out of the estimation."
    return replace(
        survey, geometry=PointCloud(cloud.points[keep], colors), notes=(*survey.notes, note)
    )


def _voxels(points: Float64) -> NDArray[np.uint64]:
    """Return the number of each point's voxel: (N, 3) to (N,), its bits the three steps."""
    numbers = np.zeros(len(points), np.uint64)
    for axis, bits in enumerate(_BITS):
        column = points[:, axis]
        low, high = float(column.min()), float(column.max())
        steps = np.zeros(len(points), np.uint64)
        if high > low:
            steps = ((column - low) * ((2**bits - 1) / (high - low))).astype(np.uint64)
        numbers = (numbers << np.uint64(bits)) | steps
    return numbers


def _sixteenth(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return a sixteenth of the voxels, all points in each: sorting them tells of repeats."""
    mixed = numbers * np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: spreads evenly
    chosen: NDArray[np.uint64] = numbers[(mixed >> np.uint64(60)) == 0]
    return chosen


def first_of_each(numbers: NDArray[np.uint64]) -> Bool | None:
    """Return which of the numbers (N,) come for the first time; None where all differ."""
    ordered = np.sort(numbers)
    if not (ordered[1:] == ordered[:-1]).any():
        return None
    order = np.argsort(numbers, kind="stable")
    keep = np.ones(len(numbers), np.bool_)
    keep[order[1:]] = numbers[order[1:]] != numbers[order[:-1]]
    return keep
