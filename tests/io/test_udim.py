"""One material over several tiles of texture coordinates: its pages are called by tile."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from meshreg.io import read_survey, rewrite_survey
from meshreg.io.obj.udim import first_tile, has_token, tile_pages
from meshreg.raster import rasterize
from meshreg.records import Grid, Transform

COLORS = {(0, 0): (250, 10, 20), (1, 0): (30, 240, 50), (3, 1): (60, 70, 230)}
NAMES = {
    "udim": ("skin.<UDIM>.png", lambda u, v: f"skin.{1001 + u + 10 * v}.png"),
    "first": ("skin.1001.png", lambda u, v: f"skin.{1001 + u + 10 * v}.png"),
    "underscore": ("maps\\skin_1001_c.png", lambda u, v: f"maps/skin_{1001 + u + 10 * v}_c.png"),
    "uvtile": ("skin_<UVTILE>.png", lambda u, v: f"skin_u{u + 1}_v{v + 1}.png"),
    "mudbox": ("skin_u1_v1.png", lambda u, v: f"skin_u{u + 1}_v{v + 1}.png"),
    "zbrush": ("skin_u0_v0.png", lambda u, v: f"skin_u{u}_v{v}.png"),
}


def model(folder, named, called, tiles=COLORS, extra="", east=0.0):
    """Write an OBJ of 10 m squares in a row, each on a tile of its own; whole tiles are shown."""
    folder.mkdir(parents=True, exist_ok=True)
    lines, faces = ["mtllib reef.mtl", "usemtl skin"], []
    for number, (u, v) in enumerate(tiles):
        lines += [
            f"v {east + 10 * number + x} {y} 0" for x, y in ((0, 0), (10, 0), (10, 10), (0, 10))
        ]
        lines += [f"vt {u + x} {v + y}" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
        a = 4 * number + 1
        faces += [f"f {a}/{a} {a + 1}/{a + 1} {a + 2}/{a + 2} {a + 3}/{a + 3}"]
        path = folder / called(u, v)
        path.parent.mkdir(exist_ok=True)
        # not of one color throughout, which counts as no texture
        rough = np.random.default_rng(1).integers(-5, 6, (64, 64, 3))
        Image.fromarray(np.clip(tiles[u, v] + rough, 0, 255).astype(np.uint8)).save(path)
    (folder / "reef.mtl").write_text(f"newmtl skin\nKd 1 1 1\nmap_Kd {named}\n{extra}")
    (folder / "reef.obj").write_text("\n".join([*lines, *faces]) + "\n")
    return folder / "reef.obj"


def colors_seen(survey, east=0.0):
    grid = Grid(east, 10.0, 1.0, (10, 30))
    raster = rasterize(survey, grid)
    return [raster.color[2:8, 10 * k + 2 : 10 * k + 8].reshape(-1, 3) for k in range(3)]


@pytest.mark.parametrize("kind", NAMES)
def test_each_tile_has_its_own_page(tmp_path, kind):
    path = model(tmp_path / "in", *NAMES[kind])
    survey = read_survey(path)
    assert len(survey.geometry.textures) == 3
    for seen, color in zip(colors_seen(survey), COLORS.values(), strict=True):
        assert np.abs(seen.astype(int) - color).max() <= 6
    files = rewrite_survey(survey, Transform(offset=np.array([100.0, 0, 0])), tmp_path / "out")
    assert {file.suffix for file in files} == {".obj", ".mtl", ".png"}
    assert len(files) == 5  # all pages are there, as many as were
    for seen, color in zip(colors_seen(read_survey(files[0]), 100), COLORS.values(), strict=True):
        assert np.abs(seen.astype(int) - color).max() <= 6


def test_tiles_of_folders_with_pages_of_the_same_names(tmp_path):
    """The second folder has a page more than the first, and all are renamed alike."""
    shades = {tile: tuple(255 - c for c in color) for tile, color in COLORS.items()}
    first = {tile: COLORS[tile] for tile in ((0, 0), (1, 0))}
    for named, called in (NAMES["udim"], NAMES["first"]):
        where = tmp_path / named.strip("<>").replace("<", "").replace(">", "")
        model(where / "a", named, called, first)
        model(where / "b", named, called, shades, east=100.0)
        files = rewrite_survey(read_survey(where), Transform(), where / "out")
        assert len(files) == len(set(files)) == 2 + 2 + 5
        again = read_survey([file for file in files if file.suffix == ".obj"])
        for seen, color in zip(colors_seen(again, 100), shades.values(), strict=True):
            assert np.abs(seen.astype(int) - color).max() <= 6


def test_a_page_that_is_not_there_leaves_its_tile_bare_and_is_said(tmp_path):
    path = model(tmp_path, *NAMES["udim"])
    (tmp_path / "skin.1002.png").unlink()
    survey = read_survey(path)
    assert survey.geometry.face_texture.tolist() == [0, 0, -1, -1, 1, 1]
    assert any("(1, 0)" in note and "NO TEXTURE" in note for note in survey.notes)


def test_pages_that_no_face_shows_and_other_maps_are_copied_too(tmp_path):
    path = model(tmp_path / "in", *NAMES["udim"], extra="map_Bump bump.<UDIM>.png\n")
    for name in ("skin.1009.png", "bump.1001.png", "bump.1002.png"):
        Image.new("RGB", (4, 4)).save(tmp_path / "in" / name)
    Image.new("RGB", (4, 4)).save(tmp_path / "in" / "skinx1003.png")  # of another name
    files = rewrite_survey(read_survey(path), Transform(), tmp_path / "out")
    assert sorted(file.name for file in files if file.suffix == ".png") == [
        "bump.1001.png",
        "bump.1002.png",
        "skin.1001.png",
        "skin.1002.png",
        "skin.1009.png",
        "skin.1014.png",
    ]


def test_one_page_that_happens_to_have_a_number_wraps_as_before(tmp_path):
    """Meshroom: texture_1001.png, its coordinates within 0-1; alone, or beside others' pages."""
    path = model(tmp_path, *NAMES["first"], tiles={(0, 0): (9, 8, 7)})
    Image.new("RGB", (4, 4)).save(tmp_path / "skin.1002.png")
    survey = read_survey(path)
    assert [texture.name for texture in survey.geometry.textures] == ["skin.1001.png"]
    assert [file.name for file in survey.source[0].companions] == ["reef.mtl", "skin.1001.png"]
    (tmp_path / "skin.1002.png").unlink()
    text = path.read_text().replace("vt 1.0", "vt 2.0").replace("vt 1 ", "vt 2 ")
    path.write_text(text)  # twice across the page: no tile (1, 0), so that it repeats
    survey = read_survey(path)
    assert survey.geometry.uv.max() == 2
    assert survey.geometry.face_texture.tolist() == [0, 0]


def test_materials_that_name_each_a_tile(tmp_path):
    """As Meshroom names several pages: material and page for every number, coordinates in 0-1."""
    path = model(tmp_path, *NAMES["first"], tiles={(0, 0): (9, 8, 7), (1, 0): (200, 100, 50)})
    lines = path.read_text().splitlines()
    faces = [line for line in lines if line.startswith("f ")]
    body = [line for line in lines if not line.startswith(("f ", "usemtl"))]
    (tmp_path / "reef.mtl").write_text(
        "newmtl one\nmap_Kd skin.1001.png\nnewmtl two\nmap_Kd skin.1002.png\n"
    )
    u = iter([0, 1, 1, 0] * 2)
    v = iter([0, 0, 1, 1] * 2)
    body = [f"vt {next(u)} {next(v)}" if line.startswith("vt ") else line for line in body]
    path.write_text("\n".join([*body, "usemtl one", faces[0], "usemtl two", faces[1]]) + "\n")
    raster = rasterize(read_survey(path), Grid(0.0, 10.0, 1.0, (10, 20)))
    assert raster.color[5, 5] == pytest.approx([9, 8, 7], abs=6)
    assert raster.color[5, 15] == pytest.approx([200, 100, 50], abs=6)


def test_names(tmp_path):
    assert has_token("a.<UDIM>.jpg")
    assert has_token("a_<uvtile>.jpg")
    assert has_token("a.%(UDIM)d.jpg")
    assert not has_token("a.1001.jpg")
    assert [first_tile(name) for name in ("a.1001.jpg", "a_1001_b.png", "1001/a.jpg")] == [
        True,
        True,
        False,
    ]
    assert not first_tile("a.1002.jpg")
    assert not first_tile("survey_21001.jpg")
    for name in ("a.1001.jpg", "a.1010.jpg", "a.1011.jpg", "a.1000.jpg", "a.1234.jpg"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "a.1999.jpg").symlink_to("/etc/passwd")
    found = tile_pages(tmp_path, "a.<UDIM>.jpg", tmp_path)
    assert {tile: path.name for tile, path in found.items()} == {
        (0, 0): "a.1001.jpg",
        (9, 0): "a.1010.jpg",
        (0, 1): "a.1011.jpg",
        (3, 23): "a.1234.jpg",
    }
