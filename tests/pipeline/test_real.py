"""Real surveys, none of them made by this project's code: `tests/data/*/SOURCE.md`."""

from __future__ import annotations

import dataclasses
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from meshreg import PointCloud, Settings, read_survey, register_pair

DATA = Path(__file__).parents[1] / "data"
WIDE = Settings().changed({"search.radius": 30.0})


def demo(year: int) -> Path:
    return Path(str(resources.files("meshreg") / "demo_data" / f"beach_{year}.obj"))


def offset_of(registration):
    assert registration.transform is not None, registration.reason
    return registration.transform.offset


def test_beach_meshes_eight_months_apart():
    """Delivered (13.4, -8.7, 1.25) m off: found within 2 m, the bound of the sand's own change."""
    reference, moving = read_survey(demo(2018)), read_survey(demo(2019))
    there = register_pair(reference, moving, WIDE)
    assert there.verdict == "accepted", there.reason
    assert np.abs(offset_of(there) - (13.4, -8.7, 1.25)).max() < 1.0
    assert there.after["height_nmad"] < 0.7 * there.before["height_nmad"]
    back = register_pair(moving, reference, WIDE)
    assert back.verdict == "accepted", back.reason
    chained = back.transform.apply(there.transform.apply(moving.centre)) - moving.centre
    assert np.abs(chained).max() < 0.5  # half a DEM cell


def test_beach_maps():
    """The same beaches as DEM and orthomosaic, where they belong."""
    pairs = [f"{DATA}/beach/{d}_dsm.tif,{DATA}/beach/{d}_ortho.tif" for d in (20180601, 20190205)]
    reference, moving = (read_survey(pair) for pair in pairs)
    assert any("-10000" in note for note in reference.notes)
    registration = register_pair(reference, moving, WIDE)
    assert registration.verdict == "accepted", registration.reason
    assert np.abs(offset_of(registration)).max() < 1.0


def test_lidar_without_color():
    """Two flights eight years apart over flat, vegetated ground: terrain alone must do."""
    reference = read_survey(DATA / "lidar" / "TTP_15.laz")
    moving = read_survey(DATA / "lidar" / "TTP_23.laz")
    registration = register_pair(reference, moving)
    assert registration.verdict == "accepted", registration.reason
    assert np.abs(offset_of(registration)[:2]).max() < 1.0
    assert abs(offset_of(registration)[2]) < 1.0
    # both were levelled by satellites; what the plants did since must not look like a tilt
    assert registration.transform.rotation[2, 2] == 1.0
    assert np.sqrt(np.diag(registration.covariance)[3:5]).min() > np.deg2rad(0.02)
    status = {e.method: e.status for e in registration.estimates}
    assert status == {"sift": "failed", "terrain": "ok", "mutual_information": "failed"}


@pytest.mark.parametrize("shift", [(1.23, -2.34, 0.45), (-0.71, 0.38, -0.2)])
def test_two_halves_of_one_cloud(shift):
    """Disjoint random halves share no point; one is shifted by a known amount."""
    whole = read_survey(DATA / "brighton" / "model_third.laz")
    cloud = whole.geometry
    first = np.random.default_rng(0).random(len(cloud.points)) < 0.5
    halves = [
        dataclasses.replace(whole, geometry=PointCloud(cloud.points[k] - move, cloud.colors[k]))
        for k, move in ((first, 0.0), (~first, np.array(shift)))
    ]
    registration = register_pair(*halves, allow_same=True)
    assert registration.verdict == "accepted", registration.reason
    cell = registration.settings["raster"]["dem_cell"]
    error = np.abs(offset_of(registration) - shift)
    assert error[:2].max() < 0.05 * cell
    assert error[2] < 0.01


def test_other_half_of_the_beach_is_rejected():
    """Two neighbouring, disjoint pieces of beach laid on the same coordinates: not a pair."""
    whole = read_survey(demo(2018))
    low, high = whole.bounds
    middle = 0.5 * (low[1] + high[1])
    points = whole.geometry.vertices + whole.origin
    pieces = []
    for keep, shift in ((points[:, 1] >= middle, 0.0), (points[:, 1] < middle, middle - low[1])):
        faces = whole.geometry.faces
        used = keep[faces].all(axis=1)
        geometry = dataclasses.replace(
            whole.geometry,
            vertices=whole.geometry.vertices + np.array([0, shift, 0]),
            faces=faces[used],
            uv=whole.geometry.uv[used],
            face_texture=whole.geometry.face_texture[used],
        )
        pieces.append(dataclasses.replace(whole, geometry=geometry))
    registration = register_pair(*pieces, WIDE, allow_same=True)
    assert registration.verdict == "rejected", registration.reason
    assert registration.transform is None


def test_meshroom_table_opens_with_its_texture():
    """Not terrain, but a real export: its page is found, and its tilt can be seen."""
    survey = read_survey(DATA / "meshroom" / "texturedMesh.obj")
    mesh = survey.geometry
    assert len(mesh.faces) == 12_000
    assert [t.size for t in mesh.textures] == [(1024, 1024)]
    assert (mesh.face_texture == 0).all()
    assert mesh.textures[0].load().std() > 20
    assert mesh.uv.min() >= 0
    assert mesh.uv.max() <= 1
