"""Records: transforms as algebra, grids with their half cell, arrays that cannot be changed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from meshreg.errors import UsageError
from meshreg.records import Grid, Mesh, Registration, Transform

number = st.floats(-1e3, 1e3)
vector = st.tuples(number, number, number)


@st.composite
def transforms(draw):
    rotation = Rotation.from_rotvec(np.array(draw(vector)) / 300).as_matrix()
    return Transform(rotation, draw(st.floats(0.2, 5.0)), draw(vector), draw(vector))


@given(transforms(), vector)
def test_inverse_takes_back(transform, point):
    there = transform.apply(point)
    np.testing.assert_allclose(transform.inverse().apply(there), point, atol=1e-7)


@given(transforms(), transforms(), vector)
def test_chain_is_first_then_second(second, first, point):
    expected = second.apply(first.apply(point))
    np.testing.assert_allclose((second @ first).apply(point), expected, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(
        second.matrix @ first.matrix, (second @ first).matrix, rtol=1e-8, atol=1e-6
    )


@given(transforms(), vector, vector)
def test_matrix_and_pivot_are_only_ways_to_write_it(transform, point, pivot):
    homogeneous = transform.matrix @ np.append(point, 1.0)
    np.testing.assert_allclose(homogeneous[:3], transform.apply(point), atol=1e-6)
    moved = transform.at(pivot)
    np.testing.assert_allclose(moved.apply(point), transform.apply(point), atol=1e-6)
    read = Transform.from_matrix(transform.matrix, pivot)
    np.testing.assert_allclose(read.apply(point), transform.apply(point), atol=1e-5)
    np.testing.assert_allclose(read.offset, transform.apply(pivot) - pivot, atol=1e-5)


def test_mirrors_are_no_transforms():
    with pytest.raises(UsageError, match="determinant -1"):
        Transform(np.diag([-1.0, 1, 1]))
    with pytest.raises(UsageError, match="mirrors"):
        Transform.from_matrix(np.diag([-1.0, 1, 1, 1]))
    with pytest.raises(UsageError, match="positive"):
        Transform(scale=0.0)


@given(st.floats(-500, 500), st.floats(-500, 500))
def test_grid_places_are_inverse(east, north):
    grid = Grid(west=100.0, north=200.0, cell=0.25, shape=(8, 12))
    back = grid.east_north(*grid.row_col(east, north))
    np.testing.assert_allclose(back, (east, north), atol=1e-9)


def test_the_half_cell():
    grid = Grid(west=100.0, north=200.0, cell=0.5, shape=(4, 6))
    assert grid.east_north(0, 0) == (100.25, 199.75)
    assert grid.bounds == (100.0, 198.0, 103.0, 200.0)
    assert grid.row_col(100.0, 200.0) == (-0.5, -0.5)
    assert grid.divided(5).bounds == grid.bounds
    assert grid.divided(5).shape == (20, 30)


def test_records_refuse_what_does_not_fit():
    with pytest.raises(UsageError, match="vertices 0 to 7 of a mesh of 3"):
        Mesh(np.zeros((3, 3)), [[0, 1, 7]])
    with pytest.raises(UsageError, match=r"shape \(3, 2\)"):
        Mesh(np.zeros((3, 2)), [[0, 1, 2]])
    with pytest.raises(UsageError, match="positive cell"):
        Grid(0, 0, -1.0, (2, 2))
    with pytest.raises(UsageError, match="needs a transform"):
        Registration("accepted", "", None, None, (), (), {}, {}, {}, {}, {}, {}, {})


def test_arrays_in_records_are_read_only():
    given_array = np.zeros((3, 3))
    mesh = Mesh(given_array, [[0, 1, 2]])
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0, 0] = 1.0
    given_array[0, 0] = 1.0  # the caller's own array stays its own
