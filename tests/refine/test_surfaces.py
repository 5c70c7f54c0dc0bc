"""Generalized ICP on a seafloor with overhangs, moved by what is known exactly."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import seafloor
from seafloor import Seafloor

from meshreg import Maps, Mesh, PointCloud, Survey, apply_transform
from meshreg.errors import UsageError
from meshreg.judge.verdict import Found, findings
from meshreg.records import Grid, Transform
from meshreg.refine.surfaces import check_surfaces, polish, sampled

ROOT = Path(__file__).parents[2]
SIGMA = {"x": 0.004, "y": 0.004, "z": 0.004}


def everywhere(east=0.0, north=0.0, half=3.0):
    """Stable ground all round a place."""
    grid = Grid(east - half, north + half, 0.1, (round(20 * half), round(20 * half)))
    return np.ones(grid.shape, bool), grid


def ball(centre, radius, n=24):
    """Return vertices and faces of a sphere; its lower half no DEM can see."""
    polar, around = np.linspace(0, np.pi, n), np.linspace(0, 2 * np.pi, 2 * n, endpoint=False)
    p, a = (m.ravel() for m in np.meshgrid(polar, around, indexing="ij"))
    unit = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=1)
    row, col = (m.ravel() for m in np.meshgrid(np.arange(n - 1), np.arange(2 * n), indexing="ij"))
    one, two = row * 2 * n + col, row * 2 * n + (col + 1) % (2 * n)
    faces = np.concatenate(
        [np.stack([one, one + 2 * n, two], 1), np.stack([two, one + 2 * n, two + 2 * n], 1)]
    )
    return centre + radius * unit, faces


def reef(seed=0, half=1.2, step=0.04, place=0, kind="mesh"):
    """Floor of bumps with balls that float over it; `seed` is of the noise, `place` of the reef."""
    floor = seafloor.Seafloor.random(100 + place, size=2 * half + 4).raster(step, half, noise=0.0)
    n = floor.grid.shape[0]
    row, col = np.mgrid[0:n, 0:n]
    east, north = floor.grid.east_north(row, col)
    vertices = [np.stack([east, north, floor.height.astype(float)], axis=-1).reshape(-1, 3)]
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = [np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)]
    rng = np.random.default_rng(place)
    for _ in range(8):
        centre = np.append(rng.uniform(-0.8 * half, 0.8 * half, 2), rng.uniform(0.3, 0.6))
        points, triangles = ball(centre, rng.uniform(0.12, 0.3))
        faces.append(triangles + sum(len(v) for v in vertices))
        vertices.append(points)
    noise = np.random.default_rng(seed)
    points = np.concatenate(vertices)
    points = points + noise.normal(0, 0.001, points.shape)
    mesh = Mesh(points, np.concatenate(faces))
    if kind == "cloud":
        drawn = sampled(Survey("drawn", mesh), 25_000, noise)
        return Survey("reef", PointCloud(drawn))
    return Survey("reef", mesh)


def small_motion():
    """A registration that is off by a centimetre, a tenth of a degree of yaw and of tilt."""
    t = np.deg2rad(0.1)
    yaw = np.array([[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, np.cos(t), -np.sin(t)], [0, np.sin(t), np.cos(t)]])
    return Transform(yaw @ tilt, 1.0, (0.007, -0.005, 0.006))


ALIGNERS = ["gicp", pytest.param("icp", marks=pytest.mark.needs("open3d"))]


@pytest.mark.parametrize("aligner", ALIGNERS)
@pytest.mark.parametrize("kind", ["mesh", "cloud"])
def test_a_small_motion_is_taken_back(kind, aligner):
    truth = small_motion()
    far = Transform(offset=(731_000.0, 5_705_000.0, -12.0))  # at UTM size, where float32 is blind
    reference = apply_transform(reef(seed=1, kind=kind), far)
    moving = apply_transform(reef(seed=2, kind=kind), far @ truth.inverse())
    stable = everywhere(*far.offset[:2])
    found = polish(
        reference, moving, Transform(), far.offset, SIGMA, stable, max_points=25_000, kind=aligner
    )
    assert found.accepted, found.note
    assert found.after < found.before
    assert found.moved == pytest.approx(np.linalg.norm(truth.offset), abs=0.002)
    corners = far.offset + np.array([[x, y, 0.3] for x in (-1, 1) for y in (-1, 1)])
    want = far.apply(truth.apply(corners - far.offset))
    error = np.linalg.norm(found.transform.apply(corners) - want, axis=1)
    assert error.max() < 0.002
    assert np.linalg.norm(corners - want, axis=1).max() > 0.009
    # the step is what was taken back, and counts as doubt: never surer than before
    before = np.diag([*3 * [0.004**2], *3 * [1e-6], 0.0])
    after = found.widened(before)
    np.testing.assert_allclose(found.step[:3], truth.offset, atol=0.002)
    np.testing.assert_allclose(found.step[3:], np.deg2rad([0.1, 0.0, 0.1]), atol=3e-4)
    assert np.linalg.eigvalsh(after - before).min() > -1e-15
    assert np.sqrt(np.diag(after - before)[:3]) == pytest.approx(np.abs(found.step[:3]), abs=0.001)
    assert 0 < np.sqrt(found.scatter[:3, :3].diagonal()).max() < 0.001


@pytest.mark.parametrize("off", [0.0, 0.045])
def test_a_move_further_than_the_answer_may_err_is_a_doubt(off):
    """Four and a half centimetres at a stated four millimetres: not taken, and said."""
    start = Transform(offset=(off, 0.0, 0.0))
    found = polish(reef(1), reef(2), start, np.zeros(3), SIGMA, everywhere(), max_points=25_000)
    assert bool(found.doubt) is (off > 0)
    if off:
        assert found.transform is start
        assert "fit better 0.045 m away" in found.doubt
        against = findings(Found(surfaces=found.doubt))
        assert [finding.code for finding in against] == ["surfaces"]


def test_surfaces_that_lie_right_already_stay():
    stable = everywhere()
    found = polish(reef(1), reef(2), Transform(), np.zeros(3), SIGMA, stable, max_points=25_000)
    assert np.linalg.norm(found.transform.apply(np.zeros(3))) < 0.001


def test_ground_that_changed_is_not_looked_at():
    """Half of the moving reef slid by 2 cm: told so, the polish stays with the other half."""
    reference, moving = reef(1), reef(2)
    points = moving.geometry.vertices.copy()
    points[points[:, 0] > 0] += (0.0, 0.02, 0.01)
    slid = Survey("slid", Mesh(points, moving.geometry.faces))
    known, grid = everywhere()
    _, east = np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij")
    half = known & (grid.west + (east + 0.5) * grid.cell < -0.05)
    told, untold = (
        polish(reference, slid, Transform(), np.zeros(3), SIGMA, (stable, grid), max_points=25_000)
        for stable in (half, known)
    )
    place = np.array([[-0.6, 0.0, 0.0]])
    errors = [np.linalg.norm(f.transform.apply(place) - place) for f in (told, untold)]
    assert errors[0] < 0.0015
    assert errors[1] > 3 * errors[0]


def test_without_stable_ground_nothing_is_polished():
    start = Transform(offset=(0.01, 0.0, 0.0))
    none = np.zeros_like(everywhere()[0]), everywhere()[1]
    for stable, why in ((None, "too little stable ground"), (none, "too few points")):
        found = polish(reef(1), reef(2), start, np.zeros(3), SIGMA, stable, max_points=25_000)
        assert found.transform is start
        assert why in found.note


def test_another_reef_is_left_alone():
    start = Transform(offset=(0.01, 0.02, 0.0))
    pair, stable = (reef(place=0), reef(place=7)), everywhere()
    found = polish(*pair, start, np.zeros(3), SIGMA, stable, max_points=25_000)
    assert not found.accepted
    assert (found.widened(np.eye(7)) == np.eye(7)).all()
    assert found.transform is start
    assert found.note


def test_surveys_without_points_in_common_are_left_alone():
    start = Transform(offset=(50.0, 0.0, 0.0))
    found = polish(reef(), reef(seed=1), start, np.zeros(3), SIGMA, everywhere(50.0))
    assert found.transform is start
    assert "too few points" in found.note


def test_maps_have_no_surface():
    height = np.zeros((4, 4), np.float32)
    maps = Survey("maps", Maps(height, Grid(0.0, 4.0, 1.0, (4, 4))))
    found = polish(maps, maps, Transform(), np.zeros(3), SIGMA, None)
    assert not found.accepted
    assert "maps" in found.note


@pytest.mark.parametrize(("kind", "library"), [("gicp", "small_gicp"), ("icp", "open3d")])
def test_without_the_library_the_remedy_is_named(monkeypatch, kind, library):
    monkeypatch.setitem(sys.modules, library, None)
    cloud = Survey("cloud", PointCloud(np.random.default_rng(0).random((10, 3))))
    with pytest.raises(UsageError, match="meshreg doctor"):
        polish(cloud, cloud, Transform(), np.zeros(3), SIGMA, None, kind=kind)


def test_unknown_surfaces_are_a_misuse():
    check_surfaces("none")
    with pytest.raises(UsageError, match="'ndt'"):
        check_surfaces("ndt")


def test_points_are_uniform_over_the_area():
    """Two squares, one of four times the area, in triangles of very different number."""
    big = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], float)
    n = 20
    row, col = np.mgrid[0:n, 0:n]
    grid = np.stack([5 + col / (n - 1), row / (n - 1), 0 * row], -1).reshape(-1, 3)
    index = 4 + np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate(
        [[[0, 1, 2], [0, 2, 3]]] + [np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (b, d, c))]
    )
    survey = Survey(
        "squares", Mesh(np.concatenate([big, grid]), faces), origin=np.array([9, 9, 9.0])
    )
    points = sampled(survey, 1000, np.random.default_rng(0)) - 9
    in_big = points[:, 0] <= 2
    assert in_big.mean() == pytest.approx(0.8, abs=0.05)
    assert points[in_big, :2].mean(axis=0) == pytest.approx([1, 1], abs=0.1)
    assert np.abs(points[:, 2]).max() < 1e-9


@pytest.mark.needs("small_gicp")
def test_the_command_polishes_on_surfaces_in_a_process_of_its_own(tmp_path):
    """`refine.surfaces=gicp` as a user runs it; what it is worth is asserted above."""
    floor = Seafloor.random(11, size=12.0)
    files = []
    for name, ground, seed in (("old", floor, 1), ("new", floor.moved(0.337, -0.412), 2)):
        raster = ground.raster(0.04, 2.5, noise=0.001, seed=seed)
        east, north = raster.grid.east_north(*np.indices(raster.grid.shape))
        points = np.stack([east, north, raster.height], axis=-1).reshape(-1, 3)
        rows = np.hstack([points, raster.color.reshape(-1, 3)])
        files.append(tmp_path / f"{name}.csv")
        head, form = "x,y,z,r,g,b", "%.4f,%.4f,%.4f,%d,%d,%d"
        np.savetxt(files[-1], rows, form, header=head, comments="")
    command = [
        sys.executable, "-m", "meshreg", "register", *files, "-o", tmp_path / "out", "--json",
        "--search-radius", "2", "--set", "refine.surfaces=gicp",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    document = json.loads(done.stdout)
    offset = [document["offset"][axis] for axis in ("east", "north")]
    assert offset == pytest.approx([-0.337, 0.412], abs=0.004)
    (note,) = [note for note in document["notes"] if note.startswith("polish")]
    millimetres = re.search(r"([\d.]+) mm to ([\d.]+) mm rms", note)
    assert millimetres or "does not bring them closer" in note  # both say that it was tried
