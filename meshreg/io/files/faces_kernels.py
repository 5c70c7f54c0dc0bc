"""Loops over the triangles of a mesh: which to use, and where they lie on their texture pages."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.jit import jit


@jit(nogil=True)
def use_faces(points: Any, faces: Any, table: Any, keep: Any) -> tuple[int, int, int]:
    """Find the triangles that carry area once.

    Parameters
    ----------
    points : (V, 3) float64
    faces : (F, 3) int32
    table : (2^k,) int32, all -1
        At least a quarter longer than `faces`.
    keep : (F,) bool
        Out: neither touches a vertex that is not finite, nor has no area, nor repeats the
        vertices of an earlier one, in whatever order.

    Returns
    -------
    lost, flat, copies : int
        How many were left out for each reason.
    """
    mask = len(table) - 1
    lost, flat, copies = 0, 0, 0
    for face in range(len(faces)):
        i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
        ax, ay, az = points[i, 0], points[i, 1], points[i, 2]
        ux, uy, uz = points[j, 0] - ax, points[j, 1] - ay, points[j, 2] - az
        vx, vy, vz = points[k, 0] - ax, points[k, 1] - ay, points[k, 2] - az
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area = nx * nx + ny * ny + nz * nz
        if not 0.0 < area < np.inf:
            keep[face] = False
            flat += area == 0.0
            lost += area != 0.0
            continue
        low, high, mixed = min(i, j, k), max(i, j, k), i ^ j ^ k
        # Faces of neighbouring vertices lie close in the table, which keeps it in the cache.
        slot = (4 * np.int64(low) + (mixed & 3)) & mask
        tries = 0
        fresh = True
        while fresh and table[slot] >= 0:
            other = table[slot]
            a, b, c = faces[other, 0], faces[other, 1], faces[other, 2]
            if a ^ b ^ c == mixed and min(a, b, c) == low and max(a, b, c) == high:
                fresh = False
            tries += 1
            slot = (slot + 1) & mask
            if tries == 16:  # a vertex of many faces: go on elsewhere, spread over the table
                spread = (
                    np.uint64(low) * np.uint64(0x9E3779B97F4A7C15)
                    ^ np.uint64(mixed) * np.uint64(0xC2B2AE3D27D4EB4F)
                    ^ np.uint64(high) * np.uint64(0x165667B19E3779F9)
                )
                slot = np.int64((spread ^ (spread >> np.uint64(29))) & np.uint64(mask))
        keep[face] = fresh
        copies += not fresh
        if fresh:
            table[slot] = face
    return lost, flat, copies


@jit(nogil=True)
def mark_used(faces: Any, used: Any) -> None:
    """Set `used` (V,) bool, all False, at the vertices of `faces` (F, 3)."""
    for face in range(len(faces)):
        for k in range(3):
            used[faces[face, k]] = True


@jit(nogil=True)
def place_uvs(uvs: Any, corners: Any, pages: Any, change: Any, out: Any) -> int:
    """Give each triangle its texture coordinates.

    Parameters
    ----------
    uvs : (T, 2) float32
    corners : (F, 3) int32
        Into `uvs`, -1 for none.
    pages : (F,) int32
        Slot of each face, -1 for none. Set to -1 where a face has no usable coordinates.
    change : (M, 4) float64
        Per slot: scale of u and v, offset of u and v.
    out : (F, 3, 2) float32

    Returns
    -------
    int
        Faces of a page that had no usable coordinates.
    """
    without = 0
    for face in range(len(corners)):
        slot = pages[face]
        su = sv = 1.0
        ou = ov = 0.0
        if slot >= 0:
            su, sv, ou, ov = change[slot, 0], change[slot, 1], change[slot, 2], change[slot, 3]
        good = True
        for k in range(3):
            at = corners[face, k]
            u = v = np.nan
            if at >= 0:
                u, v = uvs[at, 0] * su + ou, uvs[at, 1] * sv + ov
            good = good and abs(u) < 1e6 and abs(v) < 1e6
            out[face, k, 0], out[face, k, 1] = u, v
        if not good:
            for k in range(3):
                out[face, k, 0] = out[face, k, 1] = 0.0
            without += slot >= 0
            pages[face] = -1
    return without
