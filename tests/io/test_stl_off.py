"""STL and OFF: read, refuse, write, move; truth is made by `struct` and `str`."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from meshreg.errors import InputError, UsageError
from meshreg.io.frames.place import make_mover
from meshreg.io.options import ReadOptions
from meshreg.io.other import off, stl
from meshreg.records import Mesh, PointCloud, Survey, Transform

POINTS = np.array([[0, 0, 0.5], [4, 0, 0.25], [4, 3, 0], [0, 3, 1.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
TURN = Transform(
    np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]), 1.25, (10.5, -20.25, 3), (1, 1, 0)
)


def binary_stl(path, triangles=POINTS[FACES], count=None, title=b"solid made by someone"):
    rows = [struct.pack("<12fH", 0, 0, 1, *t.ravel(), 7) for t in triangles]
    head = title.ljust(80) + struct.pack("<I", len(triangles) if count is None else count)
    path.write_bytes(head + b"".join(rows))
    return path


def text_stl(path, triangles=POINTS[FACES], newline="\n", title="solid reef"):
    lines = [title]
    for triangle in triangles.tolist():
        lines += ["  facet normal 0 0 1", "    outer loop"]
        lines += [f"      vertex {x!r} {y!r} {z!r}" for x, y, z in triangle]
        lines += ["    endloop", "  endfacet"]
    path.write_bytes(newline.join([*lines, "endsolid reef", ""]).encode())
    return path


def made_off(path, body=None, head="OFF\n4 2 0\n"):
    body = body or "0 0 0.5\n4 0 0.25\n4 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\n"
    path.write_text(head + body)
    return path


MAKERS = {
    "binary": (stl, binary_stl, "a.stl"),
    "text": (stl, text_stl, "a.stl"),
    "off": (off, made_off, "a.off"),
}


def absolute(survey):
    return survey.geometry.points + survey.origin


def mover(survey, transform=TURN):
    return make_mover(survey.source[0], transform, survey.source[0].frame)


@pytest.fixture(params=MAKERS)
def kind(request):
    return MAKERS[request.param]


def test_read(tmp_path, kind):
    module, make, name = kind
    survey = module.read(make(tmp_path / name), ReadOptions())
    np.testing.assert_allclose(absolute(survey), POINTS, atol=1e-12)
    np.testing.assert_array_equal(survey.geometry.faces, FACES)
    assert survey.notes == ()
    assert survey.source[0].format == name[2:]
    assert survey.source[0].counts["faces"] == 2


def test_move_there_back_and_by_nothing(tmp_path, kind):
    module, make, name = kind
    survey = module.read(make(tmp_path / name), ReadOptions())
    there = module.rewrite(survey.source[0], mover(survey), tmp_path / f"there_{name}")[0]
    moved = module.read(there, ReadOptions())
    atol = 5e-6 if make is binary_stl else 1e-12
    np.testing.assert_allclose(absolute(moved), TURN.apply(POINTS), atol=atol)
    back = module.rewrite(moved.source[0], mover(moved, TURN.inverse()), tmp_path / f"back_{name}")
    np.testing.assert_allclose(absolute(module.read(back[0], ReadOptions())), POINTS, atol=atol)
    same = module.rewrite(survey.source[0], mover(survey, Transform()), tmp_path / f"same_{name}")
    again = module.read(same[0], ReadOptions())
    np.testing.assert_array_equal(absolute(again), absolute(survey))
    if make is binary_stl:
        assert same[0].read_bytes() == (tmp_path / name).read_bytes()


def test_written_survey_reads_back(tmp_path, kind):
    module, _, name = kind
    origin = np.array([512345.25, 6012345.5, -20.0])
    survey = Survey("made", Mesh(POINTS, FACES), origin, crs="EPSG:32755")
    files = module.write(survey, tmp_path / name)
    again = module.read(files[0], ReadOptions())
    np.testing.assert_allclose(absolute(again), POINTS + origin, atol=1e-6)
    np.testing.assert_array_equal(again.geometry.faces, FACES)
    assert again.crs == "EPSG:32755"
    with pytest.raises(UsageError):
        module.write(Survey("cloud", PointCloud(POINTS)), tmp_path / name)


def test_agrees_with_trimesh(tmp_path, kind):
    trimesh = pytest.importorskip("trimesh")
    module, make, name = kind
    path = make(tmp_path / name)
    mine = module.read(path, ReadOptions())
    theirs = trimesh.load_mesh(path, process=False)
    np.testing.assert_allclose(
        absolute(mine)[mine.geometry.faces], theirs.vertices[theirs.faces], atol=1e-12
    )


def test_every_truncation_is_refused(tmp_path, kind):
    module, make, name = kind
    path = make(tmp_path / name)
    whole = path.read_bytes()
    enough = {text_stl: b"endsolid", made_off: b"3 0 2 3"}.get(make, whole)
    for size in range(whole.index(enough) + len(enough)):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError):
            module.read(path, ReadOptions())


@pytest.mark.parametrize("count", [0, 1, 3, 2**32 - 1])
def test_binary_stl_must_have_the_size_of_its_count(tmp_path, count):
    path = binary_stl(tmp_path / "a.stl", count=count)
    with pytest.raises(InputError, match=f"{84 + 50 * count} belong to its {count} triangles"):
        stl.read(path, ReadOptions())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.25", "0,25", "facet 1.*decimal comma"),
        ("0.25", "x", "facet 1.*'x'"),
        ("4.0 3.0 0.0\n    endloop", "4.0 3.0\n    endloop", "facet 1"),
        ("endloop", "endlop", "facet 1.*endlop"),
        ("  endfacet\nendsolid", "endsolid", "ends after 1 facets"),
        ("endsolid reef", "", "without 'endsolid'"),
    ],
)
def test_broken_text_stl(tmp_path, old, new, message):
    path = text_stl(tmp_path / "a.stl")
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        stl.read(path, ReadOptions())


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_moving_text_stl_keeps_its_words(tmp_path, newline):
    title = "solid reef vertex 1 2 3"
    path = text_stl(tmp_path / "a.stl", newline=newline, title=title)
    survey = stl.read(path, ReadOptions())
    out = stl.rewrite(survey.source[0], mover(survey), tmp_path / "b.stl")[0].read_bytes()
    old = path.read_bytes()
    assert out.count(newline.encode()) == old.count(newline.encode())
    assert out.startswith(f"{title}{newline}  facet normal 0 0 1{newline}".encode())


def test_far_binary_stl_is_told(tmp_path, caplog):
    survey = stl.read(binary_stl(tmp_path / "a.stl"), ReadOptions())
    assert survey.source[0].counts["single_precision"] == 1
    far = Transform(offset=(500000, 0, 0))
    stl.rewrite(survey.source[0], mover(survey, far), tmp_path / "b.stl")
    assert "steps by 0.03" in caplog.text


@pytest.mark.parametrize(
    ("head", "body", "message"),
    [
        ("OFG\n4 2 0\n", None, "does not start with OFF"),
        ("OFF\n4 -2 0\n", None, "-2 faces"),
        ("OFF\n4000000000 2 0\n", None, "4000000000 vertices"),
        ("OFF\n4 4000000000 0\n", None, "4000000000 faces"),
        ("OFF\n4 1 0\n", None, "line 8.*goes on"),
        ("OFF\n4 3 0\n", None, "2 of 3 faces"),
        ("OFF\n4 2 0\n", "0 0\n4 0 0.25\n4 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\n", "line 3.*2 numbers"),
        ("OFF\n4 2 0\n", "0 0 1\n4 0 1\n4 3 0 9\n0 3 1\n3 0 1 2\n3 0 2 3\n", "line 5.*4 numbers"),
        ("OFF\n4 2 0\n", "0 0 1\n4 0 1\n4 3 0\n0 3 1\n3 0 1 2\n4 0 2 3\n", "line 8.*4 numbers"),
        ("OFF\n4 2 0\n", "0 0 1\n4 0 1\n4 3 0\n0 3 1\n3 0 1 2\n3 0 2 4\n", "face 2.*vertex 4 of 4"),
        (
            "OFF\n4 2 0\n",
            "0 0 1\n4 0,5 1\n4 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\n",
            "line 4.*decimal comma",
        ),
    ],
)
def test_broken_off(tmp_path, head, body, message):
    with pytest.raises(InputError, match=message):
        off.read(made_off(tmp_path / "a.off", body, head), ReadOptions())


def test_off_with_comments_colors_quads_and_colored_faces(tmp_path):
    body = "# four corners\n0 0 0.5 9 0 0 255\n4 0 0.25 0 9 0 255 # east\n\n"
    body += "4 3 0 0 0 9 255\n0 3 1 255 255 255 255\n4 0 1 2 3 1 0 0\n2 0 1\n"
    path = made_off(tmp_path / "a.off", body, "COFF # colors\n4 2 5\n")
    survey = off.read(path, ReadOptions())
    assert survey.geometry.colors.tolist() == [[9, 0, 0], [0, 9, 0], [0, 0, 9], [255] * 3]
    np.testing.assert_array_equal(survey.geometry.faces, FACES)
    assert survey.notes == ("1 faces of fewer than three corners were dropped.",)
    moved = off.rewrite(survey.source[0], mover(survey), tmp_path / "b.off")[0]
    again = off.read(moved, ReadOptions())
    np.testing.assert_allclose(absolute(again), TURN.apply(POINTS), atol=1e-12)
    np.testing.assert_array_equal(again.geometry.colors, survey.geometry.colors)
    written = off.write(again, tmp_path / "c.off")[0]
    np.testing.assert_array_equal(
        off.read(written, ReadOptions()).geometry.colors, survey.geometry.colors
    )


def test_off_without_faces_is_a_cloud(tmp_path):
    survey = off.read(made_off(tmp_path / "a.off", "0 0 1\n2 0 1", "OFF\n2 0 0\n"), ReadOptions())
    assert isinstance(survey.geometry, PointCloud)
    np.testing.assert_array_equal(absolute(survey), [[0, 0, 1], [2, 0, 1]])


def test_no_mutation_brings_anything_but_an_error_or_a_mesh(tmp_path, kind):
    module, make, name = kind
    whole = make(tmp_path / name).read_bytes()
    rng = np.random.default_rng(5)
    path = tmp_path / f"mutated_{name}"
    for _ in range(200):
        content = bytearray(whole)
        for at in rng.integers(0, len(content), rng.integers(1, 4)):
            content[at] = rng.integers(0, 256)
        path.write_bytes(content)
        try:
            survey = module.read(path, ReadOptions())
        except InputError:
            continue
        assert np.isfinite(survey.bounds).all()
