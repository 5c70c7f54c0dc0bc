"""Loops over polygons and points: ear clipping, welding."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.jit import jit


@jit(nogil=True)
def _turn(a: Any, b: Any, c: Any) -> Any:
    """Twice the signed area of the triangle a, b, c in the plane; positive to the left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


@jit(nogil=True)
def _flatten(points: Any, vertex: Any, first: int, size: int) -> Any:
    """Project a polygon along its normal's largest axis; return (size, 2) anticlockwise, bend.

    The normal is Newell's; bend is the largest distance from the mean plane over the size.
    """
    normal = np.zeros(3)
    mean = np.zeros(3)
    for k in range(size):
        p = points[vertex[first + k]]
        q = points[vertex[first + (k + 1) % size]]
        mean += p / size
        # Differences from the first corner keep the digits at UTM size.
        o = points[vertex[first]]
        for axis in range(3):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            normal[axis] += (p[i] - o[i]) * (q[j] - o[j]) - (p[j] - o[j]) * (q[i] - o[i])
    main: Any = np.argmax(np.abs(normal))
    i, j = (main + 1) % 3, (main + 2) % 3
    if normal[main] < 0:
        i, j = j, i
    flat = np.empty((size, 2))
    length = np.sqrt((normal * normal).sum())
    far = 0.0
    extent = 0.0
    for k in range(size):
        p = points[vertex[first + k]] - mean
        flat[k, 0], flat[k, 1] = p[i], p[j]
        if length > 0:
            far = max(far, abs((p * normal).sum()) / length)
        extent = max(extent, np.sqrt((p * p).sum()))
    return flat, (far / extent if extent > 0 else 0.0)


@jit(nogil=True)
def _is_convex(flat: Any) -> bool:
    size = len(flat)
    for k in range(size):
        if _turn(flat[k - 1], flat[k], flat[(k + 1) % size]) < 0:
            return False
    # Left turns only, but more than once around: a star is not convex.
    around = True
    for k in range(1, size - 1):
        around = around and _turn(flat[0], flat[k], flat[k + 1]) >= 0
    return around


@jit(nogil=True)
def _is_ear(flat: Any, left: Any, size: int, k: int) -> bool:
    """Whether corner k of the corners still `left` can be cut off."""
    before, here, after = left[(k - 1) % size], left[k], left[(k + 1) % size]
    a, b, c = flat[before], flat[here], flat[after]
    if _turn(a, b, c) <= 0:
        return False
    for n in range(size):
        other = left[n]
        if other in (before, here, after):
            continue
        p = flat[other]
        inside = _turn(a, b, p) >= 0 and _turn(b, c, p) >= 0 and _turn(c, a, p) >= 0
        same = (
            (p[0] == a[0] and p[1] == a[1])
            or (p[0] == b[0] and p[1] == b[1])
            or (p[0] == c[0] and p[1] == c[1])
        )
        if inside and not same:
            return False
    return True


@jit(nogil=True)
def _clip_ears(flat: Any, first: int, corners: Any, place: int) -> None:
    """Write the len(flat) - 2 triangles of one simple polygon into `corners` from `place` on."""
    size = len(flat)
    left = np.arange(size)
    k = 0
    idle = 0
    while size > 3:
        # A polygon that crosses itself has no ear in the end: cut anyway, so that this ends.
        if _is_ear(flat, left, size, k % size) or idle > size:
            k %= size
            corners[place, 0] = first + left[(k - 1) % size]
            corners[place, 1] = first + left[k]
            corners[place, 2] = first + left[(k + 1) % size]
            place += 1
            for n in range(k, size - 1):
                left[n] = left[n + 1]
            size -= 1
            idle = 0
            k = max(k - 1, 0)
        else:
            k += 1
            idle += 1
    for n in range(3):
        corners[place, n] = first + left[n]


@jit(nogil=True)
def cut_concave(
    points: Any, vertex: Any, polygons: Any, corners: Any, bent: float, largest: int
) -> tuple[int, int, int]:
    """Replace the fans of concave polygons in `corners` by ears.

    Parameters
    ----------
    points : (V, 3) float64
    vertex : (C,) int64
    polygons : (P, 3) int64
        First corner, size and first row in `corners` of each.
    corners : (F, 3) int64
        Changed in place.
    bent : float
        Above this bend a concave polygon is counted as not flat.
    largest : int
        Concave polygons of more corners stop the work.

    Returns
    -------
    concave, bent : int
        How many.
    large : int
        Row of `polygons` that is too large, or -1.
    """
    n_concave, n_bent = 0, 0
    for row in range(len(polygons)):
        first, size, place = polygons[row]
        flat, bend = _flatten(points, vertex, first, size)
        if _is_convex(flat):
            continue
        if size > largest:
            return n_concave, n_bent, row
        n_concave += 1
        if bend > bent:
            n_bent += 1
        _clip_ears(flat, first, corners, place)
    return n_concave, n_bent, -1


@jit(nogil=True)
def weld_points(points: Any, table: Any, new: Any, kept: Any) -> int:
    """Give equal points one number.

    Parameters
    ----------
    points : (N, 3) float64
    table : (2^k,) int32, all -1
        At least twice as long as `points`.
    new : (N,) int32
        Out: number of each point among the different ones.
    kept : (N,) int64
        Out: row of the first of each; as many as are returned.
    """
    mask = np.uint64(len(table) - 1)
    spread = np.uint64(0x9E3779B97F4A7C15)
    bits = points.view(np.uint64)
    minus_zero = np.uint64(1) << np.uint64(63)
    count = 0
    for row in range(len(points)):
        mixed = np.uint64(0)
        for axis in range(3):
            word = bits[row, axis]
            if word == minus_zero:  # equal to zero, in other bits
                word = np.uint64(0)
            mixed = (mixed ^ word) * spread
            mixed = mixed ^ (mixed >> np.uint64(32))
        slot = np.int64(mixed & mask)
        while table[slot] >= 0:
            other = kept[table[slot]]
            if (
                points[other, 0] == points[row, 0]
                and points[other, 1] == points[row, 1]
                and points[other, 2] == points[row, 2]
            ):
                break
            slot = (slot + 1) & np.int64(mask)
        if table[slot] < 0:
            table[slot] = count
            kept[count] = row
            count += 1
        new[row] = table[slot]
    return count
