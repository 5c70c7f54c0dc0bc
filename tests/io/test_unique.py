"""Points that repeat another's place: out of the estimation, kept in the registered file."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshreg.io import read_survey, rewrite_survey, unique, write_survey
from meshreg.raster.grid import choose_cells
from meshreg.records import Mesh, PointCloud, Survey, Transform

UTM = np.array([731_000.0, 5_705_000.0, -12.0])


def scattered(count=4000, seed=0):
    return np.random.default_rng(seed).uniform((0, 0, 0), (20, 20, 1), (count, 3)).round(3)


def rows(path, points):
    path.write_text("".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in points + UTM))
    return path


@given(st.lists(st.integers(0, 5), min_size=2, max_size=40))
def test_the_first_of_each_stays(numbers):
    keep = unique.first_of_each(np.array(numbers, np.uint64))
    seen, expected = set(), []
    for number in numbers:
        expected.append(number not in seen)
        seen.add(number)
    if all(expected):
        assert keep is None
    else:
        assert keep.tolist() == expected


def test_a_file_given_three_times_over_is_one_cloud(tmp_path):
    points = scattered()
    colors = np.random.default_rng(1).integers(0, 256, (len(points), 3))
    once = Survey("a", PointCloud(points, colors), UTM)
    again = np.concatenate([np.arange(len(points)), *np.random.default_rng(2).permutation(
        np.tile(np.arange(len(points)), 2)
    ).reshape(2, -1)])  # fmt: skip
    thrice = unique.without_repeats(Survey("b", PointCloud(points[again], colors[again]), UTM))
    np.testing.assert_array_equal(thrice.geometry.points, once.geometry.points)
    np.testing.assert_array_equal(thrice.geometry.colors, once.geometry.colors)
    assert thrice.notes == (
        "8000 points that repeat another's place were left out of the estimation.",
    )


def test_repeats_bias_neither_density_nor_cells_and_all_points_are_moved(tmp_path):
    """Overlapping tiles: half of the ground is there twelve times."""
    points = scattered()
    west = points[points[:, 0] < 10]
    plain = read_survey(rows(tmp_path / "plain.xyz", points))
    path = rows(tmp_path / "tiles.xyz", np.concatenate([points, *[west] * 11]))
    tiles = read_survey(path)
    assert f"{11 * len(west)} points that repeat" in tiles.notes[-1]
    np.testing.assert_allclose(
        tiles.geometry.points + tiles.origin, plain.geometry.points + plain.origin, atol=1e-9
    )
    cells, expected = choose_cells(tiles, tiles), choose_cells(plain, plain)
    assert (cells.dem, cells.ortho, cells.sift) == (expected.dem, expected.ortho, expected.sift)
    # what the estimation leaves out is moved all the same
    move = Transform(offset=np.array([1.0, -2.0, 0.5]))
    (moved, *_) = rewrite_survey(tiles, move, tmp_path / "out")
    before, after = np.loadtxt(path), np.loadtxt(moved)
    assert len(after) == len(points) + 11 * len(west)
    np.testing.assert_allclose(after - before, np.tile(move.offset, (len(after), 1)), atol=1e-3)


def test_tiles_that_overlap_are_counted_once(tmp_path):
    points = scattered()
    rows(tmp_path / "1.xyz", points[points[:, 0] < 12])
    rows(tmp_path / "2.xyz", points[points[:, 0] > 8])
    survey = read_survey(tmp_path / "*.xyz")
    assert len(survey.geometry.points) == len(points)
    assert sum(source.counts["points"] for source in survey.source) > len(points)


def test_different_points_all_stay():
    """Down to what 32-bit numbers tell apart; a flat and a single-column cloud too."""
    for points in (scattered(), scattered() * (1, 1, 0), scattered() * (0, 0, 1)):
        points = np.unique(points, axis=0)
        survey = Survey("a", PointCloud(points))
        assert unique.without_repeats(survey) is survey
    close = np.array([[0.0, 0, 0], [100, 100, 10], [50, 50, 5], [50.0001, 50, 5]])
    assert len(unique.without_repeats(Survey("a", PointCloud(close))).geometry.points) == 4


@pytest.mark.parametrize("repeats", [0, 60_000])
def test_large_clouds_are_looked_at_by_a_part(monkeypatch, repeats):
    monkeypatch.setattr(unique, "_FEW", 1000)
    points = np.random.default_rng(3).uniform(0, 100, (60_000, 3))
    survey = Survey("a", PointCloud(np.concatenate([points, points[:repeats]])))
    found = unique.without_repeats(survey)
    assert (found is survey) == (repeats == 0)
    np.testing.assert_array_equal(found.geometry.points, points)


def test_meshes_are_left_as_they_are(tmp_path):
    mesh = Mesh(
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]]), np.array([[0, 1, 2], [3, 1, 2]])
    )
    survey = Survey("a", mesh)
    assert unique.without_repeats(survey) is survey
    write_survey(Survey("a", PointCloud(np.zeros((1, 3)))), tmp_path / "one.ply")
    assert len(read_survey(tmp_path / "one.ply").geometry.points) == 1
