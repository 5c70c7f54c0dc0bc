"""How surveys lie, and which other axes would make them agree: tried, and only then told."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from surveys import QUICK, displaced, floors
from surveys import survey as ground

from meshreg import Mesh, PointCloud, Survey, register_pair
from meshreg.io.frames.axes import ENU, NED, Y_UP
from meshreg.pipeline.postures import AXES, in_degrees, level_axes, other_axes, posture
from meshreg.records import Frame, Grid, Maps, SourceFile

HOME = np.array([731_000.0, 5_705_000.0, -12.0])


def relief(east, north):
    return 0.3 * np.sin(1.7 * east + 0.4 * north) * np.cos(1.1 * north) + 0.1 * np.sin(5 * east)


def seafloor(size=(20.0, 20.0), dip=0.0, seed=0, count=6000):
    """Points (N, 3) of a rough patch, turned about the east axis."""
    rng = np.random.default_rng(seed)
    east, north = (rng.uniform(-0.5 * side, 0.5 * side, count) for side in size)
    points = np.column_stack([east, north, relief(east, north)])
    c, s = np.cos(np.deg2rad(dip)), np.sin(np.deg2rad(dip))
    return points @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T


def read(points, stored=ENU, taken=ENU, shift=(0.0, 0.0, 0.0), name="later"):
    """A file whose axes are `stored`, read as if they were `taken`."""
    in_file = points @ np.linalg.inv(stored).T
    frame = Frame(taken, shift)
    source = (SourceFile(Path(f"{name}.ply"), "ply", frame),)
    return Survey(name, PointCloud(in_file @ taken.T), frame.shift, source=source)


def test_axes_are_those_that_files_are_read_with():
    for name, axes in (('up = "z"', ENU), ('axes = "ned"', NED), ('up = "y"', Y_UP)):
        np.testing.assert_array_equal(AXES[name], axes)


@pytest.mark.parametrize("dip", [0.0, 8.0, 35.0, 80.0, 90.0])
@pytest.mark.parametrize("size", [(20.0, 20.0), (30.0, 1.2), (1.2, 30.0), (0.5, 0.5)])
def test_the_dip_is_that_of_the_ground_whatever_its_outline(dip, size):
    small = min(size) < 1
    points = seafloor(size, dip=0.0)
    points[:, 2] *= 0.1 if small else 1.0
    c, s = np.cos(np.deg2rad(dip)), np.sin(np.deg2rad(dip))
    points = points @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T
    points[:60] += 300.0  # floaters
    found = posture(Survey("a", PointCloud(points))).dip
    # relief itself tilts the mean plane of a strip as narrow as its waves
    assert found == pytest.approx(dip, abs=9.0 if min(size) < 2 else 1.5)


def test_a_dem_of_a_wall_dips():
    grid = Grid(0.0, 10.0, 0.1, (100, 100))
    north = grid.east_north(np.arange(100), 0)[1]
    wall = np.repeat((np.tan(np.deg2rad(75.0)) * north)[:, None], 100, axis=1)
    assert posture(Survey("dem", Maps(wall, grid))).dip == pytest.approx(75.0, abs=0.01)


@pytest.mark.parametrize("side", [150, 400, 640])
@pytest.mark.parametrize("rough", [0.0, 1e-4])
def test_a_flat_map_of_any_size_is_level(side, rough):
    """A few of many cells, were they every n-th, would lie in lines that have no plane."""
    height = np.random.default_rng(1).normal(-5.0, rough, (side, side)).astype(np.float32)
    grid = Grid(0.0, side * 0.05, 0.05, (side, side))
    assert posture(Survey("sheet", Maps(height, grid))).dip < 0.5


def test_points_on_one_line_have_no_dip():
    along = np.linspace(0, 30, 500)
    points = np.column_stack([along, 2 * along, np.zeros(500)])
    assert posture(read(points)).dip == 0.0


def test_a_file_on_its_side_is_told_with_the_axis_that_is_not_in_force():
    first, later = seafloor(seed=1), seafloor(seed=2)
    level = read(first, name="first")
    # glTF with z up, read as y up by its rule; the reference is z up, so the option holds for both
    said = other_axes(level, read(later, taken=Y_UP), 10.0)
    assert said.startswith("bounds and slopes would agree if the moving survey were read with --up")
    assert "--up z: try it" in said
    # y up, not said
    said = other_axes(level, read(later, stored=Y_UP), 10.0)
    assert 'moving survey were read with up = "y" in later.survey.toml beside it' in said
    said = other_axes(read(first, stored=Y_UP, name="first"), read(later), 10.0)
    assert 'reference survey were read with up = "y" in first.survey.toml' in said
    both = read(first, taken=Y_UP), read(later, taken=Y_UP)
    assert "both surveys would lie level" in other_axes(*both, 10.0)
    assert "--up z" in other_axes(*both, 10.0)
    for one, option in ((both[1], "--up z"), (read(later, stored=Y_UP), "--up y"), (level, "")):
        assert level_axes(one) == option


@pytest.mark.parametrize("shift", [(0.0, 0.0, -12.0), HOME])
@pytest.mark.parametrize(
    ("stored", "name"),
    [
        (NED, 'axes = "ned"'),
        (np.eye(3)[[1, 0, 2]], "axes = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]"),
        (np.diag([1.0, 1.0, -1.0]), "axes = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]"),
    ],
)
def test_exchanged_and_negated_axes_are_known_by_bounds(shift, stored, name):
    first = seafloor((24.0, 9.0), seed=1) + shift
    later = seafloor((24.0, 9.0), seed=2) + shift + [1.0, -2.0, 0.1]
    reference, moving = read(first, name="first"), read(later, stored=stored)
    said = other_axes(reference, moving, 10.0)
    assert f"the moving survey were read with {name} in later.survey.toml beside it" in said
    # the one that lies above the sea is the one that is wrong
    said = other_axes(moving, dataclasses.replace(reference, name="first"), 10.0)
    if stored[2, 2] < 0:
        assert f"the reference survey were read with {name}" in said
    else:
        assert name in said


def test_what_agrees_or_would_not_in_any_way_is_left_alone():
    level = read(seafloor(seed=1))
    for other in (
        read(seafloor(seed=2) + np.array([3.0, 1.0, 0.5])),
        read(seafloor((30.0, 1.2), seed=2)),  # narrow, and on no side
        read(seafloor(dip=10.0, seed=2)),
        read(seafloor(seed=2) + np.array([500.0, 0.0, 0.0])),  # another place
        read(seafloor(seed=2), stored=np.diag([3.28, 3.28, 3.28])),
    ):
        assert other_axes(level, other, 10.0) == ""
    wall = np.eye(3)[[2, 0, 1]]  # faces east: no option lays it down
    pair = [read(seafloor(seed=k) @ wall.T) for k in (1, 2)]
    assert posture(pair[0]).dip > 85
    assert other_axes(pair[0], pair[1], 10.0) == ""


def test_degrees_are_known_by_their_range():
    points = seafloor() * [1 / 90_000, 1 / 111_000, 1.0]
    degrees = Survey("later", PointCloud(points), np.array([151.921, -23.443, -9.0]))
    said = in_degrees(degrees)
    assert "look like degrees" in said
    assert 'crs = "EPSG:4326" into later.survey.toml' in said
    assert in_degrees(dataclasses.replace(degrees, crs="EPSG:32754")) == ""
    for points in (seafloor(), seafloor((0.5, 0.5)), seafloor((3.0, 0.3), dip=88.0)):
        assert in_degrees(Survey("a", PointCloud(points), np.array([0.0, 10.0, 0.0]))) == ""
    found = register_pair(degrees, dataclasses.replace(degrees, name="b"), QUICK)
    assert found.verdict == "rejected"
    assert found.reason.count("look like degrees") == 2


def turned(one, axes):
    """A survey whose file is read with other axes than it was written with."""
    mesh = one.geometry
    lying = dataclasses.replace(mesh, vertices=(mesh.vertices + one.origin) @ axes.T)
    source = (SourceFile(Path("later.glb"), "glb", Frame(axes)),)
    return dataclasses.replace(one, geometry=lying, origin=np.zeros(3), source=source)


def test_no_model_on_its_side_is_accepted_and_the_remedy_is_named():
    first, later = floors()
    reference, moving = ground(first, half=4.0, seed=1), displaced(ground(later, half=4.0))[0]
    found = register_pair(reference, turned(moving, Y_UP), QUICK)
    assert found.verdict != "accepted"
    assert [finding.code for finding in found.findings][:2] == ["axes", "lean"]
    assert "--up z" in found.reason
    assert "the moving survey stands upright (its surface dips by" in found.reason


def test_two_walls_are_reviewed_as_such():
    first, later = floors()
    turn = np.deg2rad(80.0)
    axes = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]])
    pair = [
        turned(ground(floor, half=4.0, step=0.05, seed=k), axes)
        for k, floor in enumerate((first, later))
    ]
    found = register_pair(*[dataclasses.replace(one, source=()) for one in pair], QUICK)
    assert found.verdict != "accepted"
    said = re.search(
        r"both surveys stand upright \(their surfaces dip by (\d+)° and (\d+)°\)", found.reason
    )
    assert said is not None
    assert all(
        abs(int(dip) - 80) <= 2 for dip in said.groups()
    )  # the relief has a slope of its own
    assert "leans" not in found.reason
    assert "tilted against" not in found.reason
    assert "both surveys would lie level and agree if they were read with --up y" in found.reason


@pytest.mark.parametrize(
    ("axes", "name", "rises"),
    [
        (np.diag([1.0, 1.0, -1.0]), "axes = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]", 12.0),
        (np.diag([1.0, 1.0, -1.0]), "axes = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]", 0.0),
        (NED, 'axes = "ned"', 0.0),
        (np.eye(3)[[1, 0, 2]], "axes = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]", 12.0),
    ],
)
def test_axes_that_bounds_cannot_tell_are_told_by_image_and_relief(axes, name, rises):
    """On a square plot around zero: what the image knows again may have its heights upside down."""
    first, later = floors()
    below = np.array([0.0, 0.0, -rises])
    reference = dataclasses.replace(ground(first, half=3.5, step=0.05, seed=1), origin=below)
    moving = displaced(ground(later, half=3.5, step=0.05, seed=2))[0]
    moving = dataclasses.replace(moving, origin=moving.origin + below)
    wrong = turned(moving, axes)
    wrong = dataclasses.replace(
        wrong, source=(SourceFile(Path("later.ply"), "ply", Frame(np.eye(3))),)
    )
    found = register_pair(reference, wrong, QUICK)
    assert found.verdict != "accepted"
    said = next(finding.text for finding in found.findings if finding.code == "axes")
    assert f"would agree if the moving survey were read with {name} in" in said


def test_a_narrow_strip_is_registered_and_nothing_else_is_said_of_it():
    """1.2 m wide and 16 m long: as narrow as its relief is high, and still no file on its side."""
    first, later = floors()

    def cut(floor, seed):
        whole = ground(floor, half=8.0, step=0.05, seed=seed).geometry
        kept = np.abs(whole.vertices[:, 0]) < 0.6
        number = np.cumsum(kept) - 1
        faces = number[whole.faces[kept[whole.faces].all(axis=1)]]
        return Survey("strip", Mesh(whole.vertices[kept], faces, whole.colors[kept]))

    reference = cut(first, 1)
    moving, truth = displaced(cut(later, 2))
    found = register_pair(reference, moving, QUICK)
    assert found.verdict == "accepted", found.reason
    assert not found.findings
    assert not any("up" in note.split() or "tilted" in note for note in found.notes)
    off = found.transform.apply(moving.centre) - truth.apply(moving.centre)
    assert np.abs(off[:2]).max() < 0.02
    assert abs(off[2]) < 0.05
