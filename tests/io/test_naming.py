"""Names of what is written: tiles whose files are called alike, long names, names of a result."""

from __future__ import annotations

import json
import os
from types import SimpleNamespace
from urllib.parse import unquote

import numpy as np
import pytest
import trimesh
from PIL import Image

from meshreg.errors import InputError
from meshreg.io import read_survey, require_writable, rewrite_survey
from meshreg.io.files.naming import planned
from meshreg.records import SourceFile, Survey, Transform

COLORS = [(250, 10, 20), (30, 240, 50), (60, 70, 230)]
MOVE = Transform(offset=np.array([1.0, 2.0, 0.5]))


def obj_tile(folder, number, page="texture.jpg", library="model.mtl", options=""):
    """Write model.obj, its MTL and page, all of one color, 10 m on from the last."""
    folder.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8), COLORS[number]).save(folder / page, quality=100)
    (folder / library).write_text(f"newmtl skin\nKd 1 1 1\nmap_Kd {options}{page}\n")
    east = 10 * number
    corners = [(0, 0, 0), (10, 0, 1), (10, 10, 0.5), (0, 10, 2)]
    lines = [f"mtllib {library}", *(f"v {east + x} {y} {z}" for x, y, z in corners)]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "usemtl skin"]
    lines += ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
    (folder / "model.obj").write_text("\n".join(lines) + "\n")
    return folder / "model.obj"


def color_at_centre(path):
    """Mean color of a file's one page, as trimesh finds it, and where the middle of it lies."""
    mesh = trimesh.load(path, process=False, force="mesh")
    material = mesh.visual.material
    image = getattr(material, "image", None) or material.baseColorTexture
    color = np.asarray(image.convert("RGB"), float).mean(axis=(0, 1))
    return color, mesh.bounds.mean(axis=0)


@pytest.mark.parametrize("page", ["texture.jpg", "the page.jpg", "Å/seite.jpg"])
@pytest.mark.parametrize("options", ["", "-s 1 1 1 "])
def test_tiles_whose_files_are_called_alike(tmp_path, page, options):
    for number in range(3):
        (tmp_path / f"tile_{number}" / page).parent.mkdir(parents=True)
        obj_tile(tmp_path / f"tile_{number}", number, page, options=options)
    survey = read_survey(tmp_path)
    files = rewrite_survey(survey, MOVE, tmp_path / "out")
    objs = [path for path in files if path.suffix == ".obj"]
    assert [path.name for path in objs] == [
        "model_registered.obj",
        "model_registered_2.obj",
        "model_registered_3.obj",
    ]
    # nothing is lost and nothing written over another: three of each kind, all there
    for suffix in (".obj", ".mtl", ".jpg"):
        same = {path for path in files if path.suffix == suffix}
        assert len(same) == 3
        assert all(path.is_file() for path in same)
    moved = read_survey(objs)
    for number, path in enumerate(objs):
        pages = [texture.load().mean(axis=(0, 1)) for texture in moved.geometry.textures]
        assert pages[number] == pytest.approx(COLORS[number], abs=2)
        if " " not in page and not options:  # trimesh takes a name to end at the first blank
            color, centre = color_at_centre(path)
            assert color == pytest.approx(COLORS[number], abs=2)
            assert centre == pytest.approx([10 * number + 6, 7, 1.5])
    # the bytes of what is not named differently stay
    first = (tmp_path / "tile_0" / "model.obj").read_text().splitlines()
    third = objs[2].read_text().splitlines()
    assert first[5:] == third[5:]
    assert third[0] != first[0]
    assert third[0].startswith("mtllib model_registered_3")


def test_a_page_that_all_tiles_share_is_written_once(tmp_path):
    for number in range(2):
        obj_tile(tmp_path / f"tile_{number}", number)
        Image.new("RGB", (8, 8), COLORS[0]).save(tmp_path / f"tile_{number}" / "texture.jpg")
    files = rewrite_survey(read_survey(tmp_path), MOVE, tmp_path / "out")
    assert sorted(path.name for path in files) == [
        "model.mtl",
        "model_registered.obj",
        "model_registered_2.obj",
        "texture.jpg",
    ]


def test_tiles_in_one_folder_that_share_a_material_file(tmp_path):
    """The page has the name of a file of a result, so that it is renamed, for both alike."""
    obj_tile(tmp_path, 1, page="moving_ortho.tif")
    (tmp_path / "model.obj").rename(tmp_path / "a.obj")
    obj_tile(tmp_path, 2, page="moving_ortho.tif")
    (tmp_path / "model.obj").rename(tmp_path / "b.obj")
    files = rewrite_survey(read_survey(tmp_path), MOVE, tmp_path / "out")
    assert len(files) == 4
    assert not (tmp_path / "out" / "moving_ortho.tif").exists()
    for name in ("a_registered.obj", "b_registered.obj"):
        assert color_at_centre(tmp_path / "out" / name)[0] == pytest.approx(COLORS[2], abs=2)


def test_plys_and_their_pages(tmp_path):
    for number in range(2):
        folder = tmp_path / f"tile {number}"
        folder.mkdir()
        Image.new("RGB", (8, 8), COLORS[number]).save(folder / "page one.png")
        rows = [f"{10 * number + x} {y} 0" for x, y in ((0, 0), (10, 0), (10, 10))]
        head = ["ply", "format ascii 1.0", "comment TextureFile page one.png", "comment page one"]
        head += ["element vertex 3", *(f"property double {axis}" for axis in "xyz")]
        head += ["element face 1", "property list uchar int vertex_indices"]
        head += ["property list uchar float texcoord", "end_header"]
        (folder / "tile.ply").write_text("\n".join([*head, *rows, "3 0 1 2 6 0 0 1 0 1 1"]) + "\n")
    files = rewrite_survey(read_survey(tmp_path), MOVE, tmp_path / "out")
    assert len(files) == 4
    plys = [path for path in files if path.suffix == ".ply"]
    for number, path in enumerate(plys):
        head = path.read_text().split("end_header")[0].splitlines()
        name = head[2].removeprefix("comment TextureFile ")
        assert head[3] == "comment page one"
        with Image.open(path.parent / name) as image:
            assert image.convert("RGB").getpixel((3, 3)) == COLORS[number]


def test_gltfs_and_their_files(tmp_path):
    for number in range(2):
        folder = tmp_path / f"tile_{number}"
        folder.mkdir()
        east = 10.0 * number
        points = np.array([[east, 0, 0], [east + 10, 0, 0], [east, 1, -10]], np.float32)
        data = points.astype("<f4").tobytes() + np.array([[0, 0], [1, 0], [0, 1]], "<f4").tobytes()
        (folder / "a b.bin").write_bytes(data)
        Image.new("RGB", (8, 8), COLORS[number]).save(folder / "page#1.png")
        views = [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
        ]
        accessors = [
            {"bufferView": k, "componentType": 5126, "count": 3, "type": f"VEC{3 - k}"}
            for k in range(2)
        ]
        accessors[0] |= {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}
        tree = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
            "buffers": [{"uri": "a%20b.bin", "byteLength": 60}],
            "bufferViews": views,
            "accessors": accessors,
            "images": [{"uri": "page%231.png"}],
            "textures": [{"source": 0}],
            "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        }
        (folder / "scene.gltf").write_text(json.dumps(tree))
    files = rewrite_survey(read_survey(tmp_path), MOVE, tmp_path / "out")
    scenes = [path for path in files if path.suffix == ".gltf"]
    for number, path in enumerate(scenes):
        tree = json.loads(path.read_text())
        page = path.parent / unquote(tree["images"][0]["uri"])
        assert page in files
        with Image.open(page) as image:
            assert image.getpixel((0, 0)) == COLORS[number]
        data = (path.parent / unquote(tree["buffers"][0]["uri"])).read_bytes()
        assert np.frombuffer(data[:4], "<f4")[0] == 10 * number


def test_blocks_of_one_stem_do_not_share_a_side_file(tmp_path):
    names = ["a/reef.las", "b/reef.laz", "c/REEF.las", "c/other.las"]
    sources = tuple(SourceFile(tmp_path / name, "las") for name in names)
    survey = SimpleNamespace(source=sources)
    assert [plan.name for plan in planned(survey, "_registered")] == [
        "reef_registered.las",
        "reef_registered_2.laz",
        "REEF_registered_3.las",
        "other_registered.las",
    ]


@pytest.mark.parametrize("letter", ["x", "é", "海"])
def test_the_longest_names_are_written(tmp_path, letter):
    stem = letter * (251 // len(letter.encode()))
    path = tmp_path / f"{stem}.obj"
    path.write_text("v 0 0 0\nv 10 0 0\nv 0 10 1\nf 1 2 3\n")
    (tmp_path / "SHIFT.txt").write_text("EPSG:32754 731000 5705000 0\n")
    survey = read_survey(path)
    files = rewrite_survey(survey, MOVE, tmp_path / "out")
    assert len(files) == 3  # with the shift, twice
    assert all(len(os.fsencode(file.name)) <= 255 for file in files)
    assert read_survey(files[0]).bounds[0] == pytest.approx([731001, 5705002, 0.5])


# --- what cannot be written is known before


def glb(path, extent, crs):
    from meshreg.io import write_survey
    from meshreg.records import Mesh

    points = np.array([[0, 0, 0], [extent, 0, 1], [extent, extent, 0], [0, extent, 2]], float)
    mesh = Mesh(points - [extent / 2, extent / 2, 0], np.array([[0, 1, 2], [0, 2, 3]]))
    survey = Survey("reef", mesh, np.array([731000.0, 5705000.0, 0.0]), crs=crs)
    return write_survey(survey, path)[0]


def test_a_gltf_that_a_change_of_crs_would_bend_is_refused_before_the_work(tmp_path):
    from meshreg.io.frames.place import common_crs

    near = read_survey(glb(tmp_path / "near.glb", 100.0, "EPSG:32754"))
    far = read_survey(glb(tmp_path / "far.glb", 20_000.0, "EPSG:32754"))
    (tmp_path / "other").mkdir()
    for survey, name in ((near, "near"), (far, "far")):
        cloud = tmp_path / "other" / f"{name}.xyz"
        cloud.write_text("211000 5701000 0\n211100 5701000 1\n211000 5701100 0\n")
        reference = read_survey(cloud, crs="EPSG:32755")
        moving, _ = common_crs(reference, survey)
        if name == "near":
            require_writable(moving, reference)
            assert rewrite_survey(moving, MOVE, tmp_path / "out", reference)
        else:
            with pytest.raises(InputError, match="would be bent"):
                require_writable(moving, reference)
            with pytest.raises(InputError, match="would be bent"):
                rewrite_survey(moving, MOVE, tmp_path / "out", reference)
