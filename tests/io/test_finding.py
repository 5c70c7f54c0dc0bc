"""Which files a survey's path stands for: commas, blanks, brackets, accents, tiles in folders."""

from __future__ import annotations

import unicodedata

import numpy as np
import pytest
import rasterio
from rasterio import Affine

from meshreg.errors import InputError, UsageError
from meshreg.io import read_survey
from meshreg.io.finding import find_blocks, split_maps, split_pair

NAMES = [
    "Site 4, reef",
    "a,b,c.tif,d",
    "reef [1]",
    "Grötö*?",
    "100%20#2 'q\"",
    "-x",
    unicodedata.normalize("NFD", "Åland"),
]


def tile(path, east=0.0, north=0.0, z=0.0):
    """Write a triangle pair of 10 m at (east, north) as OBJ."""
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = [(0, 0), (10, 0), (10, 10), (0, 10)]
    lines = [f"v {east + x} {north + y} {z + x * y / 100}" for x, y in corners]
    path.write_text("\n".join([*lines, "f 1 2 3", "f 1 3 4"]) + "\n")
    return path


def maps(folder):
    """Write dem.tif and ortho.tif of 6 x 5 m."""
    folder.mkdir(parents=True, exist_ok=True)
    grid = {"transform": Affine(1, 0, 100, 0, -1, 200), "width": 6, "height": 5}
    with rasterio.open(
        folder / "dem.tif", "w", driver="GTiff", count=1, dtype="float32", **grid
    ) as dem:
        dem.write(np.arange(30, dtype=np.float32).reshape(1, 5, 6))
    with rasterio.open(
        folder / "ortho.tif", "w", driver="GTiff", count=3, dtype="uint8", **grid
    ) as ortho:
        ortho.write(np.arange(90, dtype=np.uint8).reshape(3, 5, 6))
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_of_any_name_holds_maps(tmp_path, name):
    folder = maps(tmp_path / name)
    dem, ortho = folder / "dem.tif", folder / "ortho.tif"
    for path in (folder, f"{dem},{ortho}", f"{ortho} , {dem}", [f"{dem},{ortho}"]):
        survey = read_survey(path)
        assert [source.path for source in survey.source] == [dem, ortho]
        assert survey.geometry.height[1, 2] == 8
        assert survey.geometry.color[1, 2].tolist() == [8, 38, 68]
    assert len(read_survey(dem).source) == 1


@pytest.mark.parametrize("name", NAMES)
def test_a_file_and_a_pattern_in_a_folder_of_any_name(tmp_path, name):
    one = tile(tmp_path / name / "one, two.obj")
    assert [block.path for block in find_blocks(one)] == [one]
    assert [block.path for block in find_blocks(one.parent)] == [one]
    assert [block.path for block in find_blocks(f"{one.parent}/*.obj")] == [one]


def test_a_name_typed_in_another_normal_form_is_found(tmp_path):
    there = tile(tmp_path / unicodedata.normalize("NFD", "Åland/rév.obj"))
    typed = tmp_path / unicodedata.normalize("NFC", "Åland/rév.obj")
    assert str(there) != str(typed)
    assert read_survey(typed).source[0].path == there


def test_maps_that_are_not_there_are_named(tmp_path):
    folder = maps(tmp_path / "a, b")
    with pytest.raises(InputError, match=r"none\.tif"):
        find_blocks(f"{folder}/dem.tif,{folder}/none.tif")
    with pytest.raises(UsageError, match="3 maps were given"):
        find_blocks("x.tif,y.tif,z.tif")
    assert split_maps("x.tif") == split_maps("x.tif,y.csv") == ()
    assert [str(part) for part in split_maps("s 4, r/x.tif , s 4, r/y.TIFF")] == [
        "s 4, r/x.tif",
        "s 4, r/y.TIFF",
    ]


def test_two_tables_in_a_folder_with_a_comma(tmp_path):
    folder = tmp_path / "site 4, reef"
    folder.mkdir()
    pair = folder / "one.csv", folder / "two, too.csv"
    for path in pair:
        path.write_text("x\n")
    assert split_pair(f"{pair[0]},{pair[1]}") == pair


@pytest.mark.parametrize("above", ["", "Data"])
def test_tiles_in_folders_are_blocks(tmp_path, above):
    """ContextCapture: Data/Tile_+000_+001/Tile_+000_+001.obj."""
    wanted = []
    for row in range(2):
        for col in range(2):
            name = f"Tile_+00{col}_+00{row}"
            # tiles of one survey lap over their edge
            wanted.append(tile(tmp_path / above / name / f"{name}.obj", 9.5 * col, 9.5 * row))
    survey = read_survey(tmp_path)
    assert sorted(source.path for source in survey.source) == sorted(wanted)
    assert survey.bounds[:, :2].tolist() == [[0, 0], [19.5, 19.5]]


def test_surveys_of_one_place_in_folders_are_not_blocks(tmp_path):
    tile(tmp_path / "2018" / "reef.obj")
    tile(tmp_path / "2019" / "reef.obj", 1.5, -2.0)
    with pytest.raises(InputError, match="same ground") as caught:
        read_survey(tmp_path)
    assert "2018" in caught.value.message
    assert "2019" in caught.value.message
    # said in so many words it is what the user wants
    assert len(read_survey(f"{tmp_path}/*/reef.obj").source) == 2


def test_files_further_down_are_named_by_a_pattern_that_fits_them(tmp_path):
    wanted = [
        tile(tmp_path / f"Productions/P1/Data/Tile_{n}/Tile_{n}.obj", 20.0 * n) for n in range(3)
    ]
    with pytest.raises(InputError, match="without a survey file") as caught:
        find_blocks(tmp_path)
    pattern = caught.value.remedy.split('"')[1]
    assert [block.path for block in find_blocks(pattern)] == wanted


def test_links_are_not_followed_down(tmp_path):
    tile(tmp_path / "elsewhere" / "deep" / "reef.obj")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "link").symlink_to(tmp_path / "elsewhere" / "deep")
    with pytest.raises(InputError, match="without a survey file"):
        find_blocks(tmp_path / "site")


def test_what_lies_beside_the_survey_and_is_left_out_is_said(tmp_path):
    tile(tmp_path / "reef.obj")
    maps(tmp_path)
    survey = read_survey(tmp_path)
    assert [source.path.name for source in survey.source] == ["reef.obj"]
    assert "dem.tif, ortho.tif" in survey.notes[0]
