"""Polygons to triangles, faces kept, numbers parsed: each against its slow twin."""

from __future__ import annotations

import math

import numpy as np
import pytest
import reference_ply as twin
from hypothesis import example, given, settings
from hypothesis import strategies as st

from meshreg.errors import InputError
from meshreg.io.assemble import eight_bit_colors
from meshreg.io.files.numbers_kernels import parse_number
from meshreg.io.masks.polygons import triangulate, usable_faces, weld


def star(radii, turn=(0, 1, 2), at=(0.0, 0.0, 0.0)):
    """Polygon around a centre with the given radii: any is simple, most are concave."""
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = np.stack([radii * np.cos(angles), radii * np.sin(angles), 0 * angles], axis=1)
    return flat[:, list(turn)] + at


@given(
    st.lists(st.floats(0.05, 1.0), min_size=3, max_size=12),
    st.permutations(range(3)),
    st.booleans(),
    st.sampled_from([0.0, 5e6]),
)
@settings(max_examples=150, deadline=None)
def test_triangles_tile_the_polygon(radii, turn, backwards, shift):
    points = star(np.array(radii), turn, shift)
    if backwards:
        points = points[::-1]
    cut = triangulate(points, [len(points)], np.arange(len(points)))
    assert cut.corners.shape == (len(points) - 2, 3)
    axes = [turn.index(0), turn.index(1)]
    flat = (points - shift)[:, axes]
    whole = twin.area(flat.tolist())
    parts = [twin.area(flat[row].tolist()) for row in cut.corners]
    # Pieces that all turn the polygon's way and add up to its area tile it.
    assert sum(parts) == pytest.approx(whole, rel=1e-6)
    assert all(part * whole > -1e-7 * whole**2 for part in parts)
    assert sorted(set(cut.corners.ravel().tolist())) == list(range(len(points)))


def test_corners_count_through_mixed_faces():
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 1.0]])
    vertex = np.array([0, 1, 2, 3, 4, 1, 0, 1, 4, 2, 3, 1])
    cut = triangulate(points, [4, 0, 3, 2, 3], vertex)
    assert vertex[cut.corners].tolist() == [[0, 1, 2], [0, 2, 3], [4, 1, 0], [2, 3, 1]]
    assert cut.polygon.tolist() == [0, 0, 2, 4]
    assert cut.counts == {"empty": 2, "polygons": 1, "concave": 0, "bent": 0}
    assert cut.notes() == ("2 faces of fewer than three corners were dropped.",)
    assert cut.pick_faces(np.arange(5)).tolist() == [0, 0, 2, 4]


def test_all_triangles_are_passed_through():
    cut = triangulate(np.zeros((4, 3)), [3, 3], [0, 1, 2, 2, 1, 3])
    assert cut.cut is None
    assert cut.corners.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert cut.polygon.tolist() == [0, 1]
    assert cut.pick_corners(np.arange(6)).tolist() == [[0, 1, 2], [3, 4, 5]]


def test_dart_is_cut_through_its_notch_and_a_bent_one_is_told():
    dart = np.array([[0, 0, 0], [2, 1, 0], [0, 2, 0], [0.5, 1, 0.0]])
    cut = triangulate(dart, [4], np.arange(4))
    assert cut.counts["concave"] == 1
    assert cut.notes() == ()
    assert all(3 in row for row in cut.corners.tolist())
    dart[3, 2] = 0.8
    assert triangulate(dart, [4], np.arange(4)).notes() == (
        "1 concave faces are not flat; how they were cut into triangles is a choice.",
    )


def test_polygon_that_crosses_itself_ends():
    crossed = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0], [0.5, 3, 0.0]])
    assert triangulate(crossed, [5], np.arange(5)).corners.shape == (3, 3)


def test_huge_concave_polygon_is_refused():
    radii = np.where(np.arange(6000) % 2, 1.0, 0.5)
    with pytest.raises(InputError, match=r"face 1.*6000 corners"):
        triangulate(star(radii), [6000], np.arange(6000))
    assert len(triangulate(star(np.ones(6000)), [6000], np.arange(6000)).corners) == 5998


@given(st.lists(st.tuples(*[st.integers(0, 6)] * 3), min_size=1, max_size=40))
@settings(max_examples=60, deadline=None)
def test_usable_faces_equal_their_twin(faces):
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 1], [3, 1, 2], [np.nan, 0, 0]]
    )
    faces = np.array(faces, np.int32)
    keep, notes = usable_faces(points, faces)
    rows = np.arange(len(faces)) if keep is None else np.flatnonzero(keep)
    assert rows.tolist() == twin.kept_faces(points.tolist(), faces.tolist())
    told = sum(int(note.split()[0]) for note in notes)
    assert told == len(faces) - len(rows)


@given(st.lists(st.tuples(*[st.sampled_from([0.0, -0.0, 1.5, -2.0, 1e-300])] * 3), max_size=40))
@settings(max_examples=60, deadline=None)
def test_weld_numbers_equal_points_alike(rows):
    points = np.array(rows, np.float64).reshape(-1, 3)
    new, kept = weld(points)
    different = list(dict.fromkeys(tuple(row) for row in points.tolist()))  # 0.0 == -0.0
    assert [tuple(row) for row in points[kept].tolist()] == different
    assert [different[k] for k in new] == [tuple(row) for row in points.tolist()]


def parse(text):
    data = np.frombuffer(b"#" + text.encode() + b"#", np.uint8)
    return parse_number(data, 1, len(data) - 1)


@given(st.floats(allow_nan=False, allow_infinity=False))
@settings(deadline=None)
def test_shortest_form_reads_back_exactly(value):
    found, known = parse(repr(value))
    if 1e-40 < abs(value) < 1e40:
        assert known
    assert not known or (found == value and math.copysign(1, found) == math.copysign(1, value))


@given(st.integers(0, 2**64), st.integers(-70, 70), st.sampled_from(["", "+", "-"]))
@example(9007199254740993, 0, "")
@example(9007199254740993, -10, "-")
@example(45035996273704975, -1, "")
@example(45035996273704985, -1, "")
@example(2251799813685248125, -3, "")
@settings(deadline=None)
def test_digits_and_exponent_round_as_python_does(digits, power, sign):
    text = f"{sign}{digits}e{power}"
    found, known = parse(text)
    assert not known or found == float(text)
    assert known or digits >= 10**19 or abs(power) > 60


@given(st.integers(2**53, 2**54 - 1), st.integers(-23, 8), st.integers(-1, 1))
@settings(deadline=None)
def test_halves_and_their_neighbours_round_to_even(whole, exponent, more):
    """Numbers exactly between two float64, and a little beside, in at most 19 digits."""
    exact = (2 * whole + 1) * 2 ** (exponent + 23)  # an odd 55-bit integer times 2^k
    digits = str(exact)
    if len(digits.rstrip("0")) > 19:
        digits = str(int(digits[:19]) + more) + "0" * (len(digits) - 19)
    text = f"{digits.rstrip('0') or '0'}e{len(digits) - len(digits.rstrip('0'))}"
    found, known = parse(text)
    assert not known or found == float(text)


@pytest.mark.parametrize(
    "text", ["", "-", ".", "e5", "1e", "1e+", "1,5", "1.2.3", "0x10", "nan", "1 2", "1_0", "--1"]
)
def test_what_is_no_number_is_left_to_the_caller(text):
    assert not parse(text)[1]


@pytest.mark.parametrize("text", ["1.", ".5", "+3", "-0", "007", "0.000", "1E5", "1e-07"])
def test_plain_spellings(text):
    found, known = parse(text)
    assert known
    assert math.copysign(1, found) == math.copysign(1, float(text))
    assert found == float(text)


@pytest.mark.parametrize(
    ("values", "expected", "told"),
    [
        (np.array([[0, 127, 255]], np.uint8), [0, 127, 255], ""),
        (np.array([[0, 32896, 65535]], np.uint16), [0, 128, 255], ""),
        (np.array([[0, 7, 255]], np.uint16), [0, 7, 255], "8-bit values in 16-bit fields"),
        (np.array([[0, 0.5, 1]], np.float32), [0, 128, 255], ""),
        (np.array([[0, 100.4, 255]], np.float64), [0, 100, 255], "taken as 0-255"),
        (np.array([[0, -3, 300]], np.int32), [0, 0, 255], "1 colors outside"),
        (np.array([[0, np.nan, 1]], np.float32), [0, 0, 255], "1 colors that are not finite"),
    ],
)
def test_colors_of_any_type(values, expected, told):
    colors, notes = eight_bit_colors(values)
    assert colors.tolist() == [expected]
    assert (told in " ".join(notes)) if told else notes == ()
