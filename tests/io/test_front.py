"""The front door: which files a path stands for, blocks, rewriting, and what it refuses."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from PIL import Image

from meshreg.errors import InputError, OutputError, UnsafeReferenceError, UsageError
from meshreg.io import (
    FORMATS,
    READERS,
    ReadOptions,
    load,
    read_survey,
    rewrite_survey,
    same_files,
    unchanged,
    write_survey,
)
from meshreg.io.merging import merge
from meshreg.records import Mesh, PointCloud, Survey, Texture, Transform

DATA = Path(__file__).parent.parent / "data"
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0.25]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def ply(path, points=SQUARE, faces=FACES, shift=(0, 0, 0)):
    """A PLY mesh (or a cloud, with no faces) written by hand."""
    rows = [" ".join(map(repr, map(float, row))) for row in np.add(points, shift)]
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    head += [f"property double {name}" for name in "xyz"]
    if len(faces):
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    body = [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text("\n".join([*head, "end_header", *rows, *body]) + "\n")
    return path


def las(path, points=SQUARE, crs=None, colors=None):
    header = laspy.LasHeader(version="1.4", point_format=7 if colors is not None else 6)
    header.scales, header.offsets = [0.001] * 3, np.floor(np.min(points, axis=0))
    if crs is not None:
        import pyproj

        header.add_crs(pyproj.CRS(crs))
    data = laspy.LasData(header)
    data.x, data.y, data.z = np.asarray(points, float).T
    if colors is not None:
        data.red, data.green, data.blue = (np.asarray(colors).T * 257).astype(np.uint16)
    data.write(path)
    return path


def absolute(survey: Survey) -> np.ndarray:
    return survey.geometry.points + survey.origin


# --- tables


def test_importing_io_is_light():
    code = (
        "import sys, meshreg.io; print([m for m in ('pyproj', 'laspy', 'numba', 'scipy', 'cv2', "
        "'rasterio', 'PIL', 'trimesh') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "entry",
    sorted({e for f in FORMATS for e in (f.read, f.rewrite, f.write, f.require_writable) if e}),
)
def test_every_entry_of_the_tables_is_a_function(entry):
    assert callable(load(entry))


def test_every_format_that_is_read_is_rewritten():
    assert {"las", "xyz", "ply", "obj", "glb", "gltf", "stl", "off", "e57", "maps"} <= {
        key for known in FORMATS for key in known.keys
    }


def test_the_record_is_at_this_door_too():
    import meshreg.io

    assert callable(meshreg.io.write_registration)
    assert callable(meshreg.io.read_registration)
    with pytest.raises(AttributeError):
        meshreg.io.nonsense  # noqa: B018


# --- one file


def test_a_file_by_text_or_path_is_hashed_and_printed(tmp_path):
    import hashlib

    path = ply(tmp_path / "reef.ply")
    for given in (path, str(path)):
        survey = read_survey(given)
        assert survey.name == "reef"
        assert isinstance(survey.geometry, Mesh)
        (source,) = survey.source
        assert source.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
        assert source.fingerprint == (path.stat().st_size, path.stat().st_mtime_ns)


def test_options_by_record_and_by_name(tmp_path):
    path = ply(tmp_path / "reef.ply")
    by_record = read_survey(path, ReadOptions(shift=(10, 20, 30), axes="ned"))
    by_name = read_survey(path, shift=(10, 20, 30), axes="ned")
    mixed = read_survey(path, ReadOptions(shift=(1, 1, 1), axes="ned"), shift=(10, 20, 30))
    expected = np.add(SQUARE[:, [1, 0, 2]] * (1, 1, -1), (10, 20, 30))
    for survey in (by_record, by_name, mixed):
        assert absolute(survey) == pytest.approx(expected)
    with pytest.raises(UsageError, match="'shfit'"):
        read_survey(path, shfit=(1, 2, 3))


def test_options_for_colmap_are_refused_elsewhere(tmp_path):
    path = ply(tmp_path / "reef.ply")
    with pytest.raises(UsageError, match=r"scale is for COLMAP.*unit"):
        read_survey(path, scale=0.5)
    with pytest.raises(UsageError, match="positions"):
        read_survey(path, positions=path)
    assert absolute(read_survey(path, unit="0.5")) == pytest.approx(SQUARE * 0.5)


@pytest.mark.parametrize("name", ["reef.ply", "reef.las", "reef.xyz", "reef.tif", "reef.obj"])
def test_an_empty_file_is_refused(tmp_path, name):
    (tmp_path / name).touch()
    with pytest.raises(InputError, match=rf"{name}: is empty"):
        read_survey(tmp_path / name)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"none\.ply: does not exist"):
        read_survey(tmp_path / "none.ply")
    (tmp_path / "link.ply").symlink_to(tmp_path / "none.ply")
    with pytest.raises(InputError, match=r"link\.ply"):
        read_survey(tmp_path / "link.ply")


@pytest.mark.parametrize("name", ["reef.ply", "reef.las", "reef.xyz", "reef.e57", "reef.tif"])
def test_a_pipe_is_refused_without_waiting(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="not a file"):
        read_survey(tmp_path / name)


def test_a_device_is_refused(tmp_path):
    (tmp_path / "reef.ply").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="device"):
        read_survey(tmp_path / "reef.ply")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.zip", b"PK\x03\x04rest", "ZIP"),
        ("a.npz", b"PK\x03\x04rest", "ZIP"),
        ("a.obj", b"PK\x03\x04rest", "ZIP"),
        ("a.xyz", b"\x1f\x8b\x08rest", "gzip"),
        ("a.pkl", b"\x80\x04\x95rest", "pickle"),
        ("a.npy", b"\x93NUMPYrest", "NumPy"),
        ("a.dae", b'<?xml version="1.0"?><COLLADA/>', "XML"),
        ("a.x3d", b"\xef\xbb\xbf<?xml?><X3D/>", "XML"),
        ("a.tif", b"<VRTDataset></VRTDataset>", "XML"),
        ("a.xyz", b"<!DOCTYPE html>", "XML"),
        ("a.pdf", b"%PDF-1.7", "PDF"),
        ("a.obj", b"\xff\xd8\xff\xe0JFIF", "JPEG"),
        ("a.fbx", b"Kaydara FBX Binary", "FBX"),
        ("a.docx.bak", b"hello", r"suffix '\.bak' that is not known"),
        ("a", b"hello", "suffix '' that is not known"),
        ("a.obj", b"ply\nformat ascii 1.0\n", r"is PLY, but is called \.obj"),
        ("a", b"ply\nformat ascii 1.0\n", "is PLY, but has no suffix"),
        ("a.xyz", b"LASF\0\0\0\0", r"is LAS, but is called \.xyz.*Name it a\.las"),
        ("a.las", b"ASTM-E57\0", r"is E57, but is called \.las"),
        ("a.gltf", b"glTF\2\0\0\0", "is binary glTF"),
        ("a.laz", b"II*\0\0\0\0\0", "is TIFF"),
        ("a.ply", b"solid cube", "does not start as PLY does"),
        ("a.las", b"hello", "does not start as LAS does"),
        ("a.laz", b"hello", "does not start as LAS does"),
        ("a.e57", b"hello", "does not start as E57 does"),
        ("a.glb", b"hello", "does not start as binary glTF does"),
        ("a.tif", b"hello", "does not start as TIFF does"),
    ],
)
def test_a_name_that_does_not_fit_the_content_is_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as bad:
        read_survey(tmp_path / name)
    assert bad.value.file.endswith(name)
    assert bad.value.remedy
    assert bad.value.exit_code == 3


def test_the_suffix_may_be_in_capitals(tmp_path):
    assert len(read_survey(ply(tmp_path / "REEF.PLY")).geometry.points) == 4


# --- folders, globs, lists


def test_a_folder_of_blocks_is_one_survey(tmp_path):
    folder = tmp_path / "reef"
    folder.mkdir()
    ply(folder / "b_1.ply")
    ply(folder / "b_2.ply", shift=(10, 0, 0))
    ply(folder / "._b_1.ply")  # what a Mac leaves behind
    for name in ("notes.txt", "photo.jpg", "offset.xyz", "coords.txt"):
        (folder / name).write_text("1000 2000 3\n")
    survey = read_survey(folder)
    assert survey.name == "reef"
    assert [source.path.name for source in survey.source] == ["b_1.ply", "b_2.ply"]
    expected = np.add(np.concatenate([SQUARE, np.add(SQUARE, (10, 0, 0))]), (1000, 2000, 3))
    assert absolute(survey) == pytest.approx(expected)
    assert (survey.geometry.faces == np.concatenate([FACES, FACES + 4])).all()
    assert all(source.frame.shift == pytest.approx((1000, 2000, 3)) for source in survey.source)
    assert any(note.startswith("b_1.ply: The shift") for note in survey.notes)


def test_a_glob_and_a_list_say_the_same(tmp_path):
    paths = [las(tmp_path / f"reef_{k}.las", np.add(SQUARE, (10 * k, 0, 0))) for k in range(3)]
    las(tmp_path / "other.las", np.add(SQUARE, (500, 0, 0)))
    by_glob = read_survey(str(tmp_path / "reef_*.las"))
    by_list = read_survey(paths)
    assert by_glob.name == by_list.name == "reef"
    assert absolute(by_glob) == pytest.approx(absolute(by_list))
    assert len(by_glob.geometry.points) == 12
    assert absolute(by_glob)[:, 0].max() == pytest.approx(21)


def test_a_name_with_a_bracket_is_a_file_before_it_is_a_glob(tmp_path):
    assert read_survey(str(ply(tmp_path / "reef[1].ply"))).name == "reef[1]"


def test_las_and_laz_are_one_format(tmp_path):
    las(tmp_path / "a.las")
    las(tmp_path / "b.laz")
    assert len(read_survey(tmp_path).source) == 2


def test_a_mixture_of_formats_is_refused_by_name(tmp_path):
    las(tmp_path / "a.las")
    ply(tmp_path / "b.ply")
    for given in (tmp_path, str(tmp_path / "*")):
        with pytest.raises(InputError, match=r"several formats.*a\.las.*b\.ply"):
            read_survey(given)


def test_text_files_beside_a_mesh_are_not_surveys(tmp_path):
    ply(tmp_path / "b.ply")
    (tmp_path / "gcp.csv").write_text("x,y,z\n1,2,3\n")
    (tmp_path / "readme.txt").write_text("hello")
    assert len(read_survey(tmp_path).source) == 1


@pytest.mark.parametrize("pattern", ["", "*.las"])
def test_nothing_to_read_is_said(tmp_path, pattern):
    (tmp_path / "photo.jpg").touch()
    with pytest.raises(InputError, match=r"without a survey file|fits no survey file"):
        read_survey(str(tmp_path / pattern) if pattern else tmp_path)


def test_an_empty_list_is_misuse():
    with pytest.raises(UsageError):
        read_survey([])


def test_a_model_folder_goes_to_the_colmap_reader(tmp_path, monkeypatch):
    from meshreg.io import blocks

    (tmp_path / "images.bin").touch()
    (tmp_path / "points3D.bin").touch()
    (tmp_path / "cloud.ply").write_text("ply\n")
    (block,) = blocks.find_blocks(tmp_path)
    assert block.reader == READERS[""]
    (tmp_path / "project" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "project" / "sparse" / "0" / "cameras.txt").touch()
    (block,) = blocks.find_blocks(tmp_path / "project")
    assert block.reader == READERS[""]


def test_maps_are_pairs(tmp_path):
    from meshreg.io import blocks

    for name in ("dem.tif", "ortho.tif"):
        (tmp_path / name).write_bytes(b"II*\0rest")
    pair = f"{tmp_path}/dem.tif, {tmp_path}/ortho.tif"
    assert [block.reader for block in blocks.find_blocks(pair)] == [READERS[".tif"]]
    assert len(blocks.find_blocks(tmp_path)) == 1
    (tmp_path / "third.tif").write_bytes(b"II*\0rest")
    with pytest.raises(InputError, match="3 GeoTIFFs"):
        blocks.find_blocks(tmp_path)
    with pytest.raises(InputError, match=r"none\.tif"):
        blocks.find_blocks(f"{tmp_path}/dem.tif,{tmp_path}/none.tif")


# --- merging


def test_clouds_are_merged_in_the_first_ones_crs(tmp_path):
    import pyproj

    beach = np.add(SQUARE, (731_500, 5_705_400, 3))
    way = pyproj.Transformer.from_crs("EPSG:32754", "EPSG:32755", always_xy=True)
    east, north = way.transform(beach[:, 0], beach[:, 1])
    paths = [
        las(tmp_path / "a.las", beach, "EPSG:32754"),
        las(tmp_path / "b.las", np.stack([east, north, beach[:, 2]], axis=1), "EPSG:32755"),
    ]
    survey = read_survey(paths)
    assert survey.crs == "EPSG:32754"
    assert absolute(survey)[4:] == pytest.approx(beach, abs=2e-3)
    assert np.abs(survey.geometry.points).max() < 2
    assert survey.source[1].frame.file_crs == "EPSG:32755"
    assert survey.source[1].frame.crs == "EPSG:32754"


def test_blocks_that_do_not_fit_are_refused(tmp_path):
    here = las(tmp_path / "a.las", np.add(SQUARE, (731_500, 5_705_400, 3)), "EPSG:32754")
    local = las(tmp_path / "b.las")
    with pytest.raises(InputError, match=r"a\.las and b\.las.*crs"):
        read_survey([here, local])
    mesh = ply(tmp_path / "c.ply")
    with pytest.raises(InputError, match=r"PointCloud.*Mesh.*cannot be merged"):
        read_survey([local, mesh])


def test_colors_of_some_blocks_only_are_left_out_and_said(tmp_path):
    las(tmp_path / "a.las", colors=[[10, 20, 30]] * 4)
    beside = np.add(SQUARE, (5, 0, 0))
    las(tmp_path / "b.las", beside)
    survey = read_survey(tmp_path)
    assert survey.geometry.colors is None
    assert any("only 1 of 2 files" in note for note in survey.notes)
    las(tmp_path / "b.las", beside, colors=[[40, 50, 60]] * 4)
    assert read_survey(tmp_path).geometry.colors.tolist() == [[10, 20, 30]] * 4 + [[40, 50, 60]] * 4


def page(name: str) -> Texture:
    return Texture(name, (1, 1), lambda: np.zeros((1, 1, 3), np.uint8))


def textured(n_pages: int, first_page: list[int], name: str, origin=(0.0, 0, 0)) -> Survey:
    uv = np.full((2, 3, 2), 0.25, np.float32)
    pages = tuple(page(f"{name}_{k}") for k in range(n_pages))
    mesh = Mesh(SQUARE, FACES, None, uv, np.array(first_page), pages)
    return Survey(name, mesh, np.array(origin), date="2018-06-01")


def test_texture_pages_are_renumbered():
    plain = Survey("plain", Mesh(SQUARE, FACES))
    merged = merge([textured(2, [0, 1], "a"), plain, textured(1, [-1, 0], "b", (100.0, 0, 0))], "x")
    mesh = merged.geometry
    assert mesh.face_texture.tolist() == [0, 1, -1, -1, -1, 2]
    assert [texture.name for texture in mesh.textures] == ["a_0", "a_1", "b_0"]
    assert mesh.uv[:2].min() == 0.25
    assert not mesh.uv[2:4].any()
    assert (mesh.faces == np.concatenate([FACES, FACES + 4, FACES + 8])).all()
    expected = np.concatenate([SQUARE, SQUARE, np.add(SQUARE, (100, 0, 0))])
    assert absolute(merged) == pytest.approx(expected)
    assert merged.date is None  # one of them has none


# --- unchanged, same files


def test_a_file_that_changes_during_the_run_is_noticed(tmp_path):
    path = ply(tmp_path / "reef.ply")
    survey = read_survey(path)
    unchanged(survey)
    os.utime(path, ns=(1, 1))
    unchanged(survey)  # touched, but the same bytes
    ply(path, shift=(1, 0, 0))
    with pytest.raises(InputError, match=r"reef\.ply: has changed"):
        unchanged(survey)
    path.unlink()
    with pytest.raises(InputError, match=r"reef\.ply: has gone"):
        unchanged(survey)


def test_a_file_that_changes_while_it_is_read_is_noticed(tmp_path, monkeypatch):
    path = ply(tmp_path / "reef.ply")
    from meshreg.io import blocks

    real = load(READERS[".ply"])

    def meddle(here, options):
        survey = real(here, options)
        ply(path, shift=(100, 0, 0))
        return survey

    monkeypatch.setattr(blocks, "load", lambda entry: meddle)
    with pytest.raises(InputError, match="changed while it was read"):
        read_survey(path)


@pytest.mark.parametrize("kind", ["material", "page", "model", "orthomosaic", "block"])
def test_a_file_that_belongs_to_a_survey_is_noticed_too(tmp_path, kind):
    if kind in ("material", "page"):
        path = tmp_path / "reef.obj"
        vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n"
        path.write_text(f"mtllib a.mtl\nusemtl m\n{vertices}f 1/1 2/1 3/1\n")
        (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd a.png\n")
        Image.new("RGB", (4, 4), (1, 2, 3)).save(tmp_path / "a.png")
        other = tmp_path / ("a.mtl" if kind == "material" else "a.png")
    elif kind == "model":
        path = tmp_path / "model"
        shutil.copytree(DATA / "colmap", path)
        other = path / "images.bin"
    elif kind == "orthomosaic":
        for name in ("dsm", "ortho"):
            shutil.copy(DATA / f"beach/20180601_{name}.tif", tmp_path / f"{name}.tif")
        path, other = f"{tmp_path}/dsm.tif,{tmp_path}/ortho.tif", tmp_path / "ortho.tif"
    else:
        ply(tmp_path / "a.ply")
        other = ply(tmp_path / "b.ply", shift=(9, 0, 0))
        path = f"{tmp_path}/*.ply"
    survey = read_survey(path)
    unchanged(survey)
    content = other.read_bytes()
    other.write_bytes(content + b" ")
    with pytest.raises(InputError, match="changed since it was read"):
        unchanged(survey)
    other.unlink()
    with pytest.raises(InputError, match=rf"{re.escape(other.name)}: has gone"):
        unchanged(survey)


def test_a_survey_made_in_memory_never_changes():
    unchanged(Survey("made", PointCloud(SQUARE)))


def test_the_same_bytes_twice_are_said(tmp_path):
    one, copy = ply(tmp_path / "a.ply"), ply(tmp_path / "b.ply")
    other = ply(tmp_path / "c.ply", shift=(1, 0, 0))
    note = same_files(read_survey(one), read_survey(copy))
    assert "a.ply and b.ply are the same file" in note
    assert same_files(read_survey(one), read_survey(other)) is None


# --- writing and rewriting

TURN = Transform(
    np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]), offset=(13.4, -8.7, 1.25), pivot=(5, 5, 0)
)


@pytest.mark.parametrize("suffix", [".las", ".laz", ".xyz", ".csv", ".txt", ".ply"])
def test_a_cloud_in_memory_is_written_and_read_back(tmp_path, suffix):
    rng = np.random.default_rng(4)
    points = rng.uniform(-50, 50, (500, 3))
    colors = rng.integers(0, 256, (500, 3)).astype(np.uint8)
    survey = Survey("made", PointCloud(points, colors), (731_000, 5_705_000, 0), "EPSG:32754")
    files = write_survey(survey, tmp_path / f"new{suffix}")
    assert files[0] == tmp_path / f"new{suffix}"
    again = read_survey(files[0])
    assert absolute(again) == pytest.approx(absolute(survey), rel=0, abs=5.1e-5)
    assert (again.geometry.colors == colors).all()
    if suffix not in (".ply",):
        assert again.crs == "EPSG:32754"


def test_what_is_not_written_is_said(tmp_path):
    survey = Survey("made", PointCloud(SQUARE))
    with pytest.raises(UsageError, match=r"\.fbx"):
        write_survey(survey, tmp_path / "a.fbx")
    with pytest.raises(UsageError, match="COPC"):
        write_survey(survey, tmp_path / "a.copc.laz")
    mesh = Survey("made", Mesh(SQUARE, FACES))
    for name in ("a.las", "a.xyz"):
        with pytest.raises(UsageError, match="Mesh"):
            write_survey(mesh, tmp_path / name)
    with pytest.raises(OutputError):
        write_survey(survey, tmp_path / "missing" / "a.las")


@pytest.mark.parametrize("maker", [ply, las])
def test_every_block_is_rewritten_in_the_references_frame(tmp_path, maker):
    suffix = ".ply" if maker is ply else ".las"
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    paths = [
        maker(tmp_path / "one" / f"block{suffix}"),
        maker(tmp_path / "two" / f"block{suffix}", np.add(SQUARE, (10, 0, 0))),
    ]
    (tmp_path / "two" / "block_offset.xyz").write_text("0 5 0\n")
    moving = read_survey(paths)
    reference = read_survey(ply(tmp_path / "home.ply"), shift=(100, 200, 50), axes="ned")
    files = rewrite_survey(moving, TURN, tmp_path / "out", reference)
    names = [path.name for path in files]
    assert f"block_registered{suffix}" in names
    assert f"block_registered_2{suffix}" in names
    surveys = [path for path in files if path.suffix == suffix]
    again = read_survey(surveys)
    assert all((s.frame.axes == reference.source[0].frame.axes).all() for s in again.source)
    assert all(s.frame.shift == pytest.approx((100, 200, 50)) for s in again.source)
    assert absolute(again) == pytest.approx(TURN.apply(absolute(moving)), abs=6e-5)
    # And back again, onto the file it came from.
    inverse = rewrite_survey(again, TURN.inverse(), tmp_path / "back", moving, stem_suffix="_back")
    back = read_survey([path for path in inverse if path.suffix == suffix])
    assert absolute(back) == pytest.approx(absolute(moving), abs=1.3e-4)
    assert not back.source[0].frame.shift.any()


def test_without_a_reference_a_file_keeps_its_frame(tmp_path):
    path = ply(tmp_path / "reef.ply")
    moving = read_survey(path, axes="ned", shift=(7, 8, 9), unit="cm")
    files = rewrite_survey(moving, TURN, tmp_path / "out", stem_suffix="_moved")
    assert {file.name for file in files} == {"reef_moved.ply", "reef_moved.survey.toml"}
    again = read_survey(tmp_path / "out" / "reef_moved.ply")
    assert absolute(again) == pytest.approx(TURN.apply(absolute(moving)), abs=1e-9)
    assert again.source[0].frame.axes == pytest.approx(moving.source[0].frame.axes, rel=1e-12)
    assert again.source[0].frame.shift == pytest.approx((7, 8, 9))


def test_a_survey_made_in_memory_cannot_be_rewritten(tmp_path):
    with pytest.raises(UsageError, match="no files"):
        rewrite_survey(Survey("made", PointCloud(SQUARE)), TURN, tmp_path)


def test_a_source_that_changed_is_not_rewritten(tmp_path):
    path = las(tmp_path / "reef.las")
    survey = read_survey(path)
    las(path, np.add(SQUARE, (1, 0, 0)))
    os.utime(path, ns=(1, 1))
    with pytest.raises(InputError, match="has changed"):
        rewrite_survey(survey, TURN, tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.las"))


def test_a_folder_that_cannot_be_made_is_an_output_error(tmp_path):
    (tmp_path / "file").touch()
    survey = read_survey(ply(tmp_path / "reef.ply"))
    with pytest.raises(OutputError):
        rewrite_survey(survey, TURN, tmp_path / "file" / "out")


def test_errors_of_references_pass_through(tmp_path):
    path = tmp_path / "reef.obj"
    path.write_text("mtllib ../../secret.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(UnsafeReferenceError):
        read_survey(path)
