"""The loops over triangles, against slow twins."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from meshreg.io.files.faces_kernels import mark_used, place_uvs, use_faces


def used_by_kernel(points, faces):
    faces = np.asarray(faces, np.int32).reshape(-1, 3)
    table = np.full(1 << int(2 * len(faces) + 1).bit_length(), -1, np.int32)
    keep = np.ones(len(faces), np.bool_)
    counts = use_faces(np.asarray(points, np.float64), faces, table, keep)
    return keep, counts


def used_slowly(points, faces):
    """Sets of vertices in a Python set; areas by the cross product."""
    known, keep = set(), []
    lost = flat = copies = 0
    for face in faces:
        a, b, c = (np.asarray(points[k], float) for k in face)
        area = np.linalg.norm(np.cross(b - a, c - a))
        key = tuple(sorted(face))
        good = bool(np.isfinite(area) and area > 0)
        lost += not np.isfinite(area)
        flat += bool(np.isfinite(area) and area == 0)
        copies += good and key in known
        keep.append(good and key not in known)
        if good:
            known.add(key)
    return keep, (lost, flat, copies)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(0, 7)] * 3), min_size=1, max_size=60),
    st.lists(
        st.tuples(*[st.sampled_from([0.0, 1.0, 2.0, np.nan, np.inf])] * 3), min_size=8, max_size=8
    ),
)
def test_usable_faces_are_those_of_the_slow_twin(faces, points):
    with np.errstate(invalid="ignore"):
        expected = used_slowly(points, faces)
    keep, counts = used_by_kernel(points, faces)
    np.testing.assert_array_equal(keep, expected[0])
    assert tuple(counts) == expected[1]


def test_a_vertex_of_very_many_faces():
    angle = np.linspace(0, 6, 30_001)
    ring = np.stack([np.cos(angle), np.sin(angle), angle], axis=1)
    points = np.concatenate([np.zeros((1, 3)), ring])
    fan = np.stack([np.zeros(30_000), np.arange(1, 30_001), np.arange(2, 30_002)], axis=1)
    again = fan[::-1][:, [2, 0, 1]]
    keep, counts = used_by_kernel(points, np.concatenate([fan, again]))
    assert tuple(counts) == (0, 0, 30_000)
    assert keep[:30_000].all()
    assert not keep[30_000:].any()


def test_used_vertices_are_marked():
    used = np.zeros(6, np.bool_)
    mark_used(np.array([[0, 2, 5], [5, 2, 0]], np.int32), used)
    np.testing.assert_array_equal(used, [True, False, True, False, False, True])


def test_texture_coordinates_are_scaled_then_moved():
    uvs = np.array([[0.25, 0.5], [np.nan, 0], [1, 1]], np.float32)
    corners = np.array([[0, 2, 0], [0, 1, 2], [2, 2, -1], [2, 0, 2], [0, 1, 0]], np.int32)
    pages = np.array([0, 1, 0, -1, -1], np.int32)
    change = np.array([[2.0, 4.0, 0.5, -1.0], [1.0, 1.0, 0.0, 0.0]])
    out = np.empty((5, 3, 2), np.float32)
    assert place_uvs(uvs, corners, pages, change, out) == 2
    np.testing.assert_array_equal(out[0], [[1, 1], [2.5, 3], [1, 1]])
    np.testing.assert_array_equal(pages, [0, -1, -1, -1, -1])
    np.testing.assert_array_equal(out[[1, 2, 4]], 0)
    np.testing.assert_array_equal(out[3], [[1, 1], [0.25, 0.5], [1, 1]])
