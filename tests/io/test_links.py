"""Files that are looked for, not named, are not opened where they are links out of the folder."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio

from meshreg.errors import InputError, UnsafeReferenceError
from meshreg.io import read_survey
from meshreg.io.frames.sidecar import find_sidecar, is_sidecar

DATA = Path(__file__).parents[1] / "data"
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
SIDE_FILES = {
    "reef.survey.toml": "shift = [731000, 5705000, 0]",
    "reef_offset.xyz": "731000 5705000 0",
    "offset.xyz": "731000 5705000 0",
    "reef.prj": "EPSG:32754",
    "reef_wkt.prj": "EPSG:32754",
    "reef.rcInfo": "<x/>",
    "SHIFT.txt": "EPSG:32754 731000 5705000 0",
    "coords.txt": "WGS84 UTM 54S\n731000 5705000",
    "odm_georeferencing/coords.txt": "WGS84 UTM 54S\n731000 5705000",
}


@pytest.mark.parametrize(("name", "text"), SIDE_FILES.items())
def test_a_side_file_that_leaves_the_folder_is_refused(tmp_path, name, text):
    """Inside the folder a link is followed, as any file there is read."""
    folder, outside = tmp_path / "survey", tmp_path / "outside.txt"
    (folder / name).parent.mkdir(parents=True)
    path = folder / "reef.obj"
    path.write_text(OBJ)
    outside.write_text(text)
    (folder / name).symlink_to(outside)
    with pytest.raises(
        UnsafeReferenceError, match="link that leaves the survey's folder"
    ) as caught:
        read_survey(path)
    assert caught.value.file == str(folder / name)
    assert caught.value.exit_code == 3

    (folder / name).unlink()
    outside.rename(folder / "elsewhere")
    (folder / name).symlink_to(folder / "elsewhere")
    assert find_sidecar(path) is not None


def test_a_linked_folder_of_odm_is_refused(tmp_path):
    """Beside odm_texturing/, and by a link of a folder on the way."""
    texturing = tmp_path / "project" / "odm_texturing"
    texturing.mkdir(parents=True)
    path = texturing / "odm_textured_model_geo.obj"
    path.write_text(OBJ)
    other = tmp_path / "other"
    other.mkdir()
    (other / "coords.txt").write_text("WGS84 UTM 54S\n731000 5705000")
    (texturing.parent / "odm_georeferencing").symlink_to(other)
    with pytest.raises(UnsafeReferenceError, match="leaves the survey's folder"):
        read_survey(path)
    (texturing.parent / "odm_georeferencing").unlink()
    other.rename(texturing.parent / "odm_georeferencing")
    assert read_survey(path).crs == "EPSG:32754"


def test_a_proj_txt_that_leaves_is_refused(tmp_path):
    folder = tmp_path / "survey"
    folder.mkdir()
    (folder / "reef.obj").write_text(OBJ)
    (folder / "coords.txt").write_text("WGS84 UTM 54S\n731000 5705000")
    (tmp_path / "proj.txt").write_text("EPSG:32754")
    (folder / "proj.txt").symlink_to(tmp_path / "proj.txt")
    with pytest.raises(UnsafeReferenceError, match="leaves the survey's folder"):
        read_survey(folder / "reef.obj")


def test_a_world_file_that_leaves_is_refused(tmp_path):
    folder = tmp_path / "survey"
    folder.mkdir()
    path = folder / "dem.tif"
    profile = {"driver": "GTiff", "width": 8, "height": 8, "count": 1, "dtype": "float32"}
    with (
        pytest.warns(rasterio.errors.NotGeoreferencedWarning),
        rasterio.open(path, "w", **profile) as dataset,
    ):
        dataset.write(np.ones((1, 8, 8), np.float32))
    (tmp_path / "dem.tfw").write_text("1\n0\n0\n-1\n1000\n2000\n")
    (folder / "dem.tfw").symlink_to(tmp_path / "dem.tfw")
    with pytest.raises(UnsafeReferenceError, match="leaves the survey's folder"):
        read_survey(path)
    (folder / "dem.tfw").unlink()
    shutil.copy(tmp_path / "dem.tfw", folder)
    assert read_survey(path).bounds[1, 1] == pytest.approx(2000.5)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_colmap_file_that_leaves_is_refused(tmp_path, name):
    folder = tmp_path / "model"
    shutil.copytree(DATA / "colmap", folder, ignore=lambda *_: [])
    (folder / name).rename(tmp_path / name)
    (folder / name).symlink_to(tmp_path / name)
    with pytest.raises(UnsafeReferenceError, match="leaves the survey's folder") as caught:
        read_survey(folder)
    assert caught.value.file == str(folder / name)


def test_a_block_that_leaves_is_refused_in_a_folder_and_read_where_it_is_named(tmp_path):
    folder = tmp_path / "blocks"
    folder.mkdir()
    (folder / "a.obj").write_text(OBJ)
    (tmp_path / "b.obj").write_text(OBJ)
    (folder / "b.obj").symlink_to(tmp_path / "b.obj")
    with pytest.raises(UnsafeReferenceError, match="leaves the survey's folder"):
        read_survey(folder)
    for named in (folder / "b.obj", f"{folder}/*.obj"):
        assert read_survey(named).source[-1].path == folder / "b.obj"


def test_a_link_is_no_offset_that_is_looked_into(tmp_path):
    folder = tmp_path / "survey"
    folder.mkdir()
    (tmp_path / "numbers").write_text("1 2 3")
    (folder / "offset.xyz").symlink_to(tmp_path / "numbers")
    assert not is_sidecar(folder / "offset.xyz")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("shift = " + "[" * 5000, "nested too deeply"),
        ("unit = " + "1" * 5000, "Exceeds the limit"),
        ("unit = 1e400", "unit"),
        ("unit = " + "0x" + "f" * 500, "unit"),
        ("shift = [1e400, 0, 0]", "shift"),
        ("shift = [" + "0x" + "f" * 500 + ", 0, 0]", "shift"),
        ("axes = [[1e308, 0, 0], [0, 1e308, 0], [0, 0, 1e308]]", "axes"),
        ("axes = [[1, 0, 0], [0, 1], [0, 0, 1]]", "axes"),
        ("axes = [1, 2, 3]", "axes"),
        ("#" * 70_000, "up to 65536"),
        ("date = 1", "date"),
        ("a" + ".a" * 20 + " = 1", "nested 21 deep"),
    ],
)
def test_a_hostile_survey_toml_is_bad_input(tmp_path, text, words):
    path = tmp_path / "reef.obj"
    path.write_text(OBJ)
    path.with_name("reef.survey.toml").write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_survey(path)
    assert caught.value.exit_code == 3
    assert caught.value.file == str(path.with_name("reef.survey.toml"))
