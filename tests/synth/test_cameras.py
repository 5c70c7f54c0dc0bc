"""Photographs, navigation and COLMAP models against plain geometry."""

from __future__ import annotations

import numpy as np
import pytest
import reference_synth as slow

from data_synth import cameras as cams
from data_synth.camera_kernels import ceilings, march, photograph, visible
from data_synth.make import write_pair
from data_synth.recipe import load
from data_synth.scene import make_scene
from meshreg.io import read_survey
from meshreg.io.options import ReadOptions


def recipe(**changes: object):
    return load("severity_02", {"output.tracks": 1, "output.images": 2, **changes})


@pytest.fixture(scope="module")
def take():
    return make_scene(recipe(), 4, 3.0).reference


def test_march_meets_what_the_slow_twin_meets():
    rng = np.random.default_rng(3)
    step = 0.02
    z = rng.normal(size=(20, 20)).repeat(8, 0).repeat(8, 1).astype(np.float32) * 0.15
    west, north = 0.0, (z.shape[0] - 1) * step
    high = ceilings(z)
    misses = []
    for _ in range(200):
        centre = (rng.uniform(0.5, 2.5), rng.uniform(0.5, 2.5), 2.5)
        ray = (rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), -1.0)
        row, col, met = march(z, high, step, west, north, centre, ray)
        want = slow.nearest_surface(z, step, west, north, centre, ray)
        if not met or want is None:
            continue
        misses.append(np.hypot(west + col * step - want[0], north - row * step - want[1]))
    assert len(misses) > 100
    assert np.median(misses) < 0.25 * step
    assert np.quantile(misses, 0.9) < 1.5 * step  # a corner may be cut by less than a sample


def test_pixels_are_where_a_pinhole_puts_them(take):
    """A white dot on a flat, lit plane appears where the camera equation says."""
    step, side = 0.01, 500
    z = np.zeros((side, side), np.float32)
    albedo = np.full((side, side, 3), 0.05, np.float32)
    spot = np.array([0.53, -0.37, 0.0])
    west, north = -2.5, 2.5
    row, col = (north - spot[1]) / step, (spot[0] - west) / step
    albedo[round(row) - 1 : round(row) + 2, round(col) - 1 : round(col) + 2] = 1.0
    turn = cams._down(0.3, 0.05, -0.04)
    centre = np.array([0.2, 0.1, 2.0])
    image = photograph(
        z, z, z, albedo, step, west, north, centre, turn, 400.0, (300, 400), (0, 0), take.plan
    )
    bright = image[..., 1] > 0.5 * image[..., 1].max()
    found = np.argwhere(bright).mean(axis=0)[::-1] + 0.5
    local = turn @ (spot - centre)
    want = 400.0 * local[:2] / local[2] + [200, 150]
    np.testing.assert_allclose(found, want, atol=1.0)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    assert turn[2, 2] < -0.99  # looks down


def test_a_wall_hides_what_is_behind():
    z = np.zeros((200, 200), np.float32)
    z[:, 100:104] = 1.0
    points = np.array([[0.5, 1.0, 0.0], [1.2, 1.0, 0.0], [1.95, 1.0, 0.0]])
    seen = visible(points, z, 0.01, 0.0, 1.99, np.array([0.2, 1.0, 2.0]))
    assert seen.tolist() == [True, False, True]  # the last one over the wall's top


def test_navigation_is_off_by_its_noise_and_the_offset(take):
    scene = make_scene(recipe(**{"sfm.nav_noise": 0.05}), 4, 6.0)
    for one in (scene.reference, scene.moving):
        cameras = cams.lawn_mower(one, 10, 12)
        nav = cams.navigation(one, cameras)
        d = one.distortion
        miss = nav - d.moving_from_reference(cameras.centres + d.centre)
        assert miss.std() == pytest.approx(0.05, rel=0.15)
        offset = (cameras.centres + d.centre - nav).mean(axis=0)[:2]
        np.testing.assert_allclose(offset, (d.centre - d.start)[:2], atol=0.1)


def test_lawn_mower_covers_the_ground_twice(take):
    cameras = cams.lawn_mower(take, 4, 5)
    assert len(cameras.names) == len(set(cameras.names)) == 20
    rng = np.random.default_rng(0)
    spots = np.concatenate([rng.uniform(-1.5, 1.5, (500, 2)), np.zeros((500, 1))], axis=1)
    counts = np.zeros(500)
    for k in range(20):
        local = (spots - cameras.centres[k]) @ cameras.turns[k].T
        uv = cams.FOCAL * local[:, :2] / local[:, 2:] + [cams.WIDTH / 2, cams.HEIGHT / 2]
        counts += ((uv > 0) & (uv < [cams.WIDTH, cams.HEIGHT])).all(axis=1)
    assert np.quantile(counts, 0.05) >= 3


def test_photographs_are_written(tmp_path):
    from PIL import Image

    files = write_pair(recipe(), tmp_path / "pair", 4, 2.0, "images")
    images = [file for file in files if file.suffix == ".jpg"]
    assert len(images) == 4
    for file in images:
        pixels = np.asarray(Image.open(file), float)
        assert pixels.shape == (600, 800, 3)
        assert 60 < pixels.mean() < 180
        assert pixels.std() > 12
    table = (tmp_path / "pair" / "moving" / "positions.csv").read_text().splitlines()
    assert table[0] == "image,east,north,up"
    assert len(table) == 3


def test_colmap_model_reads_back_in_place(tmp_path):
    pair = tmp_path / "pair"
    shape = {"sfm.nav_noise": 0.002, "sfm.warp": 0.0, "sfm.doming": 0.0, "sfm.warp_up": 0.0}
    write_pair(recipe(**shape), pair, 4, 4.0, "colmap")
    scene = make_scene(recipe(**shape), 4, 4.0)
    for take in (scene.reference, scene.moving):
        survey = read_survey(
            pair / take.name, ReadOptions(positions=pair / take.name / "positions.csv")
        )
        assert survey.scale_known
        points = survey.geometry.points + survey.origin
        assert len(points) > 3000
        world = take.distortion.reference_from_moving(points) - take.distortion.centre
        miss = world[:, 2] - take.seafloor.height(world[:, 0].copy(), world[:, 1].copy())
        assert np.median(np.abs(miss)) < 0.03


def test_colmap_points_project_to_their_features(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    still = {"sfm.warp": 0.0, "sfm.warp_up": 0.0, "sfm.doming": 0.0, "sfm.scale_drift": 0.0}
    write_pair(recipe(**still), tmp_path / "pair", 4, 3.0, "colmap")
    model = pycolmap.Reconstruction(str(tmp_path / "pair" / "moving"))
    errors = []
    for image in model.images.values():
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        for point in image.points2D:
            if point.has_point3D():
                xyz = model.points3D[point.point3D_id].xyz
                local = pose * xyz
                uv = cams.FOCAL * local[:2] / local[2] + [cams.WIDTH / 2, cams.HEIGHT / 2]
                errors.append(np.hypot(*(uv - point.xy)))
    assert len(errors) > 3000
    assert 0.3 < np.median(errors) < 2.0  # 0.4 px noise of features, 4 mm of points
    assert all(len(p.track.elements) >= 3 for p in model.points3D.values())
