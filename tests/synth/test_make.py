"""Files: what is written reads back, lies where the truth says, and is the same every time."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import reference_synth as slow

from data_synth.make import FORMATS, make_pair, make_rasters, write_pair
from data_synth.recipe import load
from meshreg.errors import UsageError
from meshreg.io import read_survey
from meshreg.records import Mesh, PointCloud

SMALL = {
    "output.texture": 0.02,
    "sfm.mesh_spacing": 0.05,
    "output.point_spacing": 0.05,
    "sfm.floaters": 0.0,
}
SIZE = 3.0


def recipe(**changes: object):
    return load("severity_05", {**SMALL, **changes})


@pytest.fixture(scope="module", params=["obj", "ply", "ply-cloud", "laz", "glb"])
def written(request, tmp_path_factory) -> tuple[str, Path]:
    folder = tmp_path_factory.mktemp(request.param) / "pair"
    write_pair(recipe(), folder, 5, SIZE, request.param)
    return request.param, folder


def test_reads_back_as_what_it_is(written):
    kind, folder = written
    end = FORMATS[kind]
    for name in ("reference", "moving"):
        survey = read_survey(folder / f"{name}{end}")
        assert survey.crs is not None
        assert "32755" in survey.crs or kind == "laz"
        if kind in ("laz", "ply-cloud"):
            assert isinstance(survey.geometry, PointCloud)
            assert 2000 < len(survey.geometry.points) < 4000
            assert np.ptp(survey.geometry.colors) > 60
        else:
            assert isinstance(survey.geometry, Mesh)
            assert len(survey.geometry.faces) > 5000
            assert len(survey.geometry.textures) == (4 if kind in ("obj", "glb") else 0)
        size = np.ptp(survey.bounds, axis=0)
        np.testing.assert_allclose(size[:2], SIZE, atol=0.5)


def test_lies_where_the_truth_says(written):
    """Moving points through truth.json alone fall on the second epoch's surface."""
    kind, folder = written
    truth = json.loads((folder / "truth.json").read_text())
    pair_scene = make_rasters(recipe(), 5, SIZE, 0.5, 0.5).scene
    for take, warped in ((pair_scene.reference, False), (pair_scene.moving, True)):
        survey = read_survey(folder / f"{take.name}{FORMATS[kind]}")
        points = survey.geometry.points + survey.origin
        if warped:
            points = slow.reference_from_moving(points, truth["warp"])
        world = points - np.array(truth["warp"]["centre"])
        height = take.seafloor.height(world[:, 0].copy(), world[:, 1].copy(), 0.0)
        miss = world[:, 2] - height
        # below are undersides and the ground beneath plates; steep walls are smoothed
        assert abs(np.median(miss)) < 0.004
        assert np.median(np.abs(miss)) < 0.02
        assert np.percentile(np.abs(miss), 75) < 0.05


def test_truth_is_complete(written):
    kind, folder = written
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["schema"] == "meshreg.truth/1"
    assert (truth["seed"], truth["size"], truth["scenario"]) == (5, SIZE, "severity_05")
    assert truth["format"] == kind
    assert np.array(truth["reference_from_moving"]).shape == (4, 4)
    assert np.shape(truth["centroid"]) == (3,)
    assert truth["change"]["regions"]
    assert truth["expect"]["max_error"] == 0.25
    assert 0.3 < truth["overlap"] <= 1.0


@pytest.mark.parametrize("kind", ["obj", "laz"])
def test_same_seed_same_bytes(kind, tmp_path):
    digests = []
    for name, seed in (("one", 5), ("two", 5), ("other", 6)):
        write_pair(recipe(), tmp_path / name, seed, 2.0, kind)
        files = sorted((tmp_path / name).iterdir())
        digests.append({f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in files})
    if kind == "laz":  # LAS states its day of making: nothing else may differ across midnight
        assert digests[0].keys() == digests[1].keys()
    assert digests[0] == digests[1]
    assert digests[0]["truth.json"] != digests[2]["truth.json"]
    assert digests[0][f"reference{FORMATS[kind]}"] != digests[2][f"reference{FORMATS[kind]}"]


def test_texture_shows_the_color_at_its_place():
    """Each face's texture, at its corners, is the vertex color of the other kind of mesh."""
    textured = make_pair(recipe(), 5, SIZE, "obj").moving.geometry
    colored = make_pair(recipe(), 5, SIZE, "ply").moving.geometry
    np.testing.assert_array_equal(textured.vertices, colored.vertices)
    np.testing.assert_array_equal(textured.faces, colored.faces)
    assert textured.uv.min() >= 0.0
    assert textured.uv.max() <= 1.0
    differences = []
    for page, texture in enumerate(textured.textures):
        pixels = texture.load().astype(float)
        mine = textured.face_texture == page
        u, v = textured.uv[mine, 0, 0], textured.uv[mine, 0, 1]
        col = np.clip((u * texture.size[0]).astype(int), 0, texture.size[0] - 1)
        row = np.clip(((1 - v) * texture.size[1]).astype(int), 0, texture.size[1] - 1)
        want = colored.colors[textured.faces[mine, 0]].astype(float)
        differences.append(np.abs(pixels[row, col] - want).mean(axis=1))
    assert np.median(np.concatenate(differences)) < 12.0  # means over other areas, and JPEG
    wrong = np.abs(want - want[::-1]).mean()
    assert np.median(np.concatenate(differences)) < 0.6 * wrong


def test_mesh_faces_look_up_and_plates_overhang():
    mesh = make_pair(load("severity_00", {**SMALL, "site.plate": 3.0}), 5, SIZE, "ply").reference
    corners = mesh.geometry.vertices[mesh.geometry.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    down = normal[:, 2] < 0
    assert 0.005 < down.mean() < 0.4  # the undersides
    # where something hangs over, a vertical line meets the mesh more than once
    middle = corners[:, :, :2].mean(axis=1)
    from scipy.spatial import cKDTree

    tree = cKDTree(middle[~down])
    heights = corners[:, :, 2].mean(axis=1)
    near = tree.query(middle[down])[1]
    above = heights[~down][near] - heights[down]
    assert np.median(above) > 0.02


def test_floaters_and_holes_are_those_asked_for():
    calm = make_pair(recipe(**{"sfm.holes": 0.0}), 5, SIZE, "ply").reference.geometry
    wild = make_pair(
        recipe(**{"sfm.holes": 0.1, "sfm.floaters": 80.0}), 5, SIZE, "ply"
    ).reference.geometry
    tops = [np.ptp(geometry.vertices[:, 2]) for geometry in (calm, wild)]
    assert tops[1] > tops[0] + 0.2
    areas = [top_area(geometry) for geometry in (calm, wild)]
    assert areas[1] / areas[0] == pytest.approx(0.9, abs=0.05)


def top_area(mesh: Mesh) -> float:
    """Area of 5 cm squares that hold a vertex near the ground."""
    low = mesh.vertices[:, 2] < np.median(mesh.vertices[:, 2]) + 1.0
    return len(np.unique(np.floor(mesh.vertices[low, :2] / 0.1), axis=0)) * 0.01


def test_origin_is_never_minus_zero():
    """Its height is 0 times a depth, and -0.0 is written as such into sidecars and records."""
    pair = make_pair(recipe(), 5, SIZE, "ply-cloud")
    assert pair.scene.reference.distortion.start[2] < 0
    for survey in (pair.reference, pair.moving):
        assert survey.origin[2] == 0.0
        assert not np.signbit(survey.origin[2])


def test_rasters_agree_with_the_mesh():
    """The short way and the files show one seafloor, in place to the centimetre."""
    pair = make_rasters(recipe(), 5, SIZE, 0.10, 0.05)
    survey = make_pair(recipe(), 5, SIZE, "ply-cloud").moving
    points = survey.geometry.points + survey.origin
    grid = pair.moving_dem.grid
    assert abs(round(grid.west / 0.1) - grid.west / 0.1) < 1e-6
    row, col = grid.row_col(points[:, 0], points[:, 1])
    row, col = np.rint(row).astype(int), np.rint(col).astype(int)
    inside = (row >= 0) & (row < grid.shape[0]) & (col >= 0) & (col < grid.shape[1])
    cell = (row * grid.shape[1] + col)[inside]
    total = np.bincount(cell, points[inside, 2], grid.shape[0] * grid.shape[1])
    count = np.bincount(cell, minlength=grid.shape[0] * grid.shape[1])
    mean = np.where(count >= 3, total / np.maximum(count, 1), np.nan).reshape(grid.shape)
    miss = mean - (pair.moving_dem.height + pair.moving_dem.datum)
    assert np.isfinite(miss).mean() > 0.4
    assert abs(np.nanmedian(miss)) < 0.004
    assert np.nanmedian(np.abs(miss)) < 0.02


def test_rasters_differ_by_whole_cells_and_are_repeatable():
    one, two = (make_rasters(recipe(), 7, SIZE, 0.10, 0.02) for _ in range(2))
    for name in ("reference_dem", "moving_dem", "reference_ortho", "moving_ortho"):
        a, b = getattr(one, name), getattr(two, name)
        np.testing.assert_array_equal(a.height, b.height)
        np.testing.assert_array_equal(a.color, b.color)
        assert a.valid.mean() > 0.6
        assert np.isfinite(a.height[a.valid]).all()
        assert np.isnan(a.height[~a.valid]).all()
    for a, b in ((one.reference_dem, one.moving_dem), (one.reference_ortho, one.moving_ortho)):
        step = (a.grid.west - b.grid.west) / a.grid.cell
        assert abs(step - round(step)) < 1e-6
    odd = make_rasters(recipe(), 7, SIZE, 0.10, 0.03)
    assert odd.reference_ortho.grid.cell == 0.03


def test_refuses_what_it_cannot_do(tmp_path):
    with pytest.raises(UsageError, match="cannot be 'colmap'"):
        make_pair(recipe(), 1, SIZE, "colmap")
    with pytest.raises(UsageError, match="Unknown format 'dwg'"):
        write_pair(recipe(), tmp_path / "x", 1, SIZE, "dwg")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    with pytest.raises(UsageError, match="exists already"):
        write_pair(recipe(), tmp_path / "full", 1, SIZE, "laz")
    assert (tmp_path / "full" / "mine.txt").read_text() == "mine"


def test_failure_leaves_nothing_behind(tmp_path, monkeypatch):
    import data_synth.make as make

    def broken(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(make, "describe_change", broken)
    from meshreg.errors import OutputError

    with pytest.raises(OutputError, match="disk full"):
        write_pair(recipe(), tmp_path / "pair", 1, 2.0, "laz")
    assert list(tmp_path.iterdir()) == []


def test_progress_is_told():
    told: list[tuple[str, float]] = []
    make_pair(recipe(), 1, 2.0, "ply", progress=lambda stage, share: told.append((stage, share)))
    stages = list(dict.fromkeys(stage for stage, _ in told))
    assert stages == [
        "reference seafloor",
        "reference geometry",
        "moving seafloor",
        "moving geometry",
        "truth",
    ]
    assert all(0 <= share <= 1 for _, share in told)
