"""Wavefront OBJ: what is read, against a slow parser and trimesh; what must be refused."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest
import reference_obj as twin
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from meshreg.errors import InputError, ResourceLimitError, UnsafeReferenceError
from meshreg.io.files import line_blocks
from meshreg.io.obj.read import read
from meshreg.io.obj.scan import scan
from meshreg.io.options import ReadOptions
from meshreg.records import Mesh, PointCloud

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0.5\nv 0 1 0\n"
CORNERS = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FILE_CASES = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture
def file(tmp_path):
    """Return a function that writes an OBJ file (text or bytes) and gives its path."""

    def write(content, name="reef.obj"):
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


@pytest.fixture
def pages(tmp_path):
    """Return a function that makes texture pages of one color each."""

    def make(*names):
        for number, name in enumerate(names):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (4, 2), (10 * number + 10, 0, 0)).save(tmp_path / name)

    return make


def opened(path, **options):
    return read(path, ReadOptions(**options))


def absolute(survey):
    return survey.geometry.points + survey.origin


def refusal(path, error=InputError, **options):
    with pytest.raises(error) as caught:
        opened(path, **options)
    assert path.name in str(caught.value)
    assert caught.value.exit_code == (5 if error is ResourceLimitError else 3)
    return str(caught.value)


def notes_of(survey):
    return " ".join(survey.notes)


# Geometry.


def test_a_textured_square(file, pages):
    pages("a.png")
    (file("newmtl rock\nKd 1 1 1\nmap_Kd a.png\n", "reef.mtl"))
    path = file("mtllib reef.mtl\n" + SQUARE + CORNERS + "usemtl rock\nf 1/1 2/2 3/3 4/4\n")
    survey = opened(path)
    mesh = survey.geometry
    np.testing.assert_array_equal(absolute(survey), [[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(mesh.uv, [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    np.testing.assert_array_equal(mesh.face_texture, [0, 0])
    assert [texture.size for texture in mesh.textures] == [(4, 2)]
    assert (mesh.textures[0].load() == [10, 0, 0]).all()
    assert mesh.colors is None
    assert survey.notes == ()
    (source,) = survey.source
    assert source.path == path
    assert source.format == "obj"
    assert [companion.name for companion in source.companions] == ["reef.mtl", "a.png"]
    assert source.counts["faces"] == 1
    assert source.counts["triangles"] == 2
    assert survey.name == "reef"


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("start", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("last", [True, False])
def test_line_ends_and_byte_order_mark(file, end, start, last):
    text = (SQUARE + "# a comment\n\n  \nf 1 2 3\nf\t1  3 4 ").replace("\n", end)
    survey = opened(file(start + (text + end * last).encode()))
    assert len(survey.geometry.points) == 4
    np.testing.assert_array_equal(survey.geometry.faces, [[0, 1, 2], [0, 2, 3]])
    assert ("no line end" in notes_of(survey)) is not last


def test_negative_indices_count_from_where_they_stand(file):
    text = (
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\nf 1 -1 2\n"
    )
    mesh = opened(file(text)).geometry
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [3, 4, 5], [0, 5, 1]])


def test_statements_of_many_kinds(file):
    text = (
        "o first\n" + SQUARE + "vn 0 0 1\ns off\ng a b\nusemtl x\nf 1//1 2//1 3//1\n"
        "o second\ng\nl 1 2 3\np 1\nf 1 3 4 # behind\ncurv 0 1 1 2\nvp 0.5\n"
    )
    survey = opened(file(text))
    np.testing.assert_array_equal(survey.geometry.faces, [[0, 1, 2], [0, 2, 3]])
    assert survey.source[0].counts["objects"] == 2
    assert survey.source[0].counts["groups"] == 2
    assert survey.source[0].counts["normals"] == 1
    assert "2 lines and points" in notes_of(survey)
    assert "2 lines are statements of other kinds" in notes_of(survey)


def test_backslashes_continue_geometry_and_nothing_else(file):
    text = "# C:\\folder\\\nv 0 0 0\nv 1 \\\n 0\\\r\n 0\nv 1 1 0\n"
    text += "g name\\\nv 0 1 0\nf 1 2 \\\n 3 \\\n4\n"
    survey = opened(file(text))
    np.testing.assert_array_equal(absolute(survey), [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    assert len(survey.geometry.faces) == 2


def test_a_concave_polygon_is_cut_inside(file):
    # An L of area 3 around a square hole in its corner; a fan would cover 4 or overlap itself.
    text = "v 2 1 0\nv 1 1 0\nv 1 2 0\nv 0 2 0\nv 0 0 0\nv 2 0 0\nf 1 2 3 4 5 6\n"
    survey = opened(file(text))
    points = absolute(survey)[survey.geometry.faces]
    one, two = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    areas = (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]) / 2
    assert len(areas) == 4
    assert (np.sign(areas) == np.sign(areas[0])).all()
    assert abs(areas.sum()) == pytest.approx(3)


def test_the_corners_of_polygons_keep_their_texture(file, pages):
    pages("a.png")
    file("newmtl m\nmap_Kd a.png\n", "a.mtl")
    ring = [(math.cos(a), math.sin(a)) for a in np.arange(7) * 2 * math.pi / 7]
    text = "mtllib a.mtl\nusemtl m\n"
    text += "".join(f"v {x} {y} 0\nvt {x / 4 + 0.5} {y / 4 + 0.5}\n" for x, y in ring)
    text += "f " + " ".join(f"{k}/{k}" for k in range(1, 8)) + "\n"
    survey = opened(file(text))
    mesh = survey.geometry
    assert len(mesh.faces) == 5
    plan = absolute(survey)[mesh.faces][..., :2]
    np.testing.assert_allclose(mesh.uv, plan / 4 + 0.5, atol=1e-6)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (
            "v 0 0 0 0 0.5 1\nv 1 0 0 1 1 1\nv 0 1 0 0.2 0.2 0.2\n",
            [[0, 128, 255], [255] * 3, [51] * 3],
        ),
        ("v 0 0 0 0 128 255\nv 1 0 0 1 1 1\nv 0 1 0 7 8 9\n", [[0, 128, 255], [1] * 3, [7, 8, 9]]),
        (
            "v 0 0 0 0 0 1 1\nv 1 0 0 1 0 0 0.5\nv 0 1 0 0 1 0 0\n",
            [[0, 0, 255], [255, 0, 0], [0, 255, 0]],
        ),
    ],
)
def test_colors_of_vertices(file, lines, expected):
    np.testing.assert_array_equal(opened(file(lines + "f 1 2 3\n")).geometry.colors, expected)


def test_colors_of_some_vertices_are_not_completed(file):
    survey = opened(file("v 0 0 0 1 1 1\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"))
    assert survey.geometry.colors is None
    assert "Only 1 of 3 vertices have a color" in notes_of(survey)


def test_weights_are_left_out(file):
    survey = opened(file("v 0 0 0 1.0\nv 1 0 0 2\nv 0 1 0 1\nf 1 2 3\n"))
    np.testing.assert_array_equal(absolute(survey), [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert "fourth number of 1 vertices" in notes_of(survey)


def test_vertices_without_faces_are_a_cloud(file):
    survey = opened(file("v 1 2 3 255 0 0\nv 4 5 6 0 255 7\n"))
    assert isinstance(survey.geometry, PointCloud)
    np.testing.assert_array_equal(absolute(survey), [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(survey.geometry.colors, [[255, 0, 0], [0, 255, 7]])
    assert "cut off" in notes_of(opened(file(SQUARE + CORNERS)))


def test_degenerate_and_repeated_faces_are_counted(file):
    text = SQUARE + "v 2 0 0\nf 1 2 3\nf 1 2 2\nf 1 2 5\nf 3 1 2\nf 3 2 1\nf 1 3 4\n"
    survey = opened(file(text))
    np.testing.assert_array_equal(survey.geometry.faces, [[0, 1, 2], [0, 2, 3]])
    assert "2 faces without area were dropped" in notes_of(survey)
    assert "2 faces that repeat" in notes_of(survey)


@pytest.mark.parametrize("word", ["nan", "NaN", "inf", "-inf", "-nan(ind)", "1.#QNAN", "Infinity"])
def test_vertices_that_are_no_numbers_take_their_faces_along(file, word):
    grid = [f"v {k % 20} {k // 20} {k % 3}" for k in range(400)]
    faces = [f"f {k + 1} {k + 2} {k + 21}" for k in range(379) if k % 20 < 19]
    whole = opened(file("\n".join([*grid, *faces, ""])))
    grid[37] = f"v 17 1 {word}"
    survey = opened(file("\n".join([*grid, *faces, ""])))
    assert len(survey.geometry.faces) == len(whole.geometry.faces) - 3
    assert np.isfinite(survey.geometry.points).all()
    assert "1 points" in notes_of(survey)
    assert "3 faces" in notes_of(survey)
    grid[:8] = [f"v {word} 0 0"] * 8
    assert "9 points of 400" in refusal(file("\n".join([*grid, *faces, ""])))


def test_large_coordinates_keep_their_digits(file):
    base = np.array([731000.1234567, 5705000.7654321, -12.5])
    points = base + np.arange(12).reshape(4, 3) / 7
    text = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in points) + "f 1 2 3\nf 2 4 3\n"
    survey = opened(file(text))
    assert np.abs(survey.geometry.points).max() < 3
    assert np.abs(absolute(survey) - points).max() < 2e-9


# Numbers.


@pytest.mark.parametrize(
    "word",
    [
        *("0", "-0", "+1", "1.", ".5", "-.5", "00012", "1e3", "1E+3", "-2.5e-7", "1e-400", "1e300"),
        *("473.71700000000004", "0.1", "9007199254740993", "123456789012345678", "1e22", "1e23"),
        *(
            "0.000000000000000000000001234",
            "123456789012345678901234567890",
            "2.2250738585072014e-308",
        ),
        *("8.5e-10000000000", "473.71699999999998454313725233", "4.9e-324", "0e99999"),
        *("5708990.770823839524", "9007199254740992.5", "1" + "0" * 40 + "e-40"),
    ],
)
def test_numbers_are_read_as_python_reads_them(file, word):
    found = scan(file(f"v 1 {word} 2\nv 1\t2 {word} # 3\nv {word} 1 1 \n"))
    expected = float(word)
    for value in (found.points[0, 1], found.points[1, 2], found.points[2, 0]):
        assert value == expected
        assert math.copysign(1, value) == math.copysign(1, expected)


@FILE_CASES
@given(
    st.lists(
        st.one_of(
            st.floats(allow_nan=False, allow_infinity=False).map(repr),
            st.floats(-1e7, 1e7).map(lambda x: f"{x:.6f}"),
            st.decimals(allow_nan=False, allow_infinity=False).map(str),
            st.integers(-(10**25), 10**25).map(str),
            st.floats(-1e4, 1e4).map(lambda x: f"{x:.20f}"),
        ),
        min_size=3,
        max_size=30,
    )
)
def test_any_number_is_read_as_python_reads_it(tmp_path, words):
    words = words[: len(words) // 3 * 3]
    path = tmp_path / "numbers.obj"
    path.write_text(
        "".join("v " + " ".join(words[k : k + 3]) + "\n" for k in range(0, len(words), 3))
    )
    expected = np.array([float(word) for word in words])
    expected[np.isinf(expected)] = np.nan
    read_back = scan(path).points.reshape(-1)
    read_back[np.isinf(read_back)] = np.nan
    np.testing.assert_array_equal(read_back, expected)


# Against the slow parser.

blanks = st.sampled_from([" ", "  ", "\t", " \t ", " \\\n "])
number = st.one_of(
    st.integers(-99, 99).map(str),
    st.floats(-1e6, 1e6).map(repr),
    st.floats(-100, 100).map(lambda x: f"{x:.3f}"),
    st.sampled_from(["1e-3", "+2", ".25", "7."]),
)


@st.composite
def obj_texts(draw):
    """OBJ text with every statement, every spelling of indices and odd blanks."""
    lines = []
    n_v = n_vt = n_vn = 0

    def index(count):
        if count == 0:
            return "1"
        k = draw(st.integers(1, count))
        return str(k) if draw(st.booleans()) else str(k - count - 1)

    for _ in range(draw(st.integers(1, 25))):
        kind = draw(st.sampled_from(["v", "v", "v", "vt", "vn", "f", "f", "n", "o", "#", "", "m"]))
        blank = draw(blanks)
        if kind == "v":
            count = draw(st.sampled_from([3, 3, 3, 4, 6, 7]))
            lines.append(blank.join(["v", *(draw(number) for _ in range(count))]))
            n_v += 1
        elif kind == "vt":
            count = draw(st.integers(1, 3))
            lines.append(" ".join(["vt", *(draw(number) for _ in range(count))]))
            n_vt += 1
        elif kind == "vn":
            lines.append("vn 0 0 1")
            n_vn += 1
        elif kind == "f" and n_v:
            parts = draw(st.sampled_from([(0, 0), (1, 0), (0, 1), (1, 1)]))
            words = []
            for _ in range(draw(st.sampled_from([3, 3, 4, 6]))):
                word = index(n_v)
                if parts[0] and n_vt:
                    word += "/" + index(n_vt)
                    word += "/" + index(n_vn) if parts[1] and n_vn else ""
                elif parts[1] and n_vn:
                    word += "//" + index(n_vn)
                words.append(word)
            lines.append(blank.join(["f", *words]) + draw(st.sampled_from(["", " ", " # x"])))
        elif kind == "m":
            lines.append(draw(st.sampled_from(["usemtl a", "usemtl  b c ", "mtllib x.mtl y.mtl"])))
        elif kind == "o":
            lines.append(draw(st.sampled_from(["o reef", "g a b", "s 1", "g", "  ", "xyz 1"])))
        elif kind == "#":
            lines.append(draw(st.sampled_from(["# v 1 2", "#", " # \\"])))
    return "\n".join([*lines, ""])


def same_as_twin(found, text):
    plain = twin.parse_plain(text)
    np.testing.assert_array_equal(found.points, np.array(plain.vertices).reshape(-1, 3))
    np.testing.assert_array_equal(found.uvs, np.array(plain.uvs, np.float32).reshape(-1, 2))
    sizes = [len(face) for face in plain.faces]
    corners = [corner for face in plain.faces for corner in face]
    np.testing.assert_array_equal(found.vertex, [vertex for vertex, _ in corners])
    uv = found.uv if found.uv is not None else np.full(len(corners), -1)
    np.testing.assert_array_equal(uv, [-1 if uv is None else uv for _, uv in corners])
    np.testing.assert_array_equal(
        found.sizes if found.sizes is not None else [3] * len(sizes), sizes
    )
    names = [None] * len(sizes)
    for at, name in found.materials:
        names[at:] = [name] * (len(sizes) - at)
    assert names == plain.materials
    assert found.libraries == list(dict.fromkeys(plain.libraries))
    assert found.counts["normals"] == plain.normals
    if plain.vertices and all(color is not None for color in plain.colors):
        np.testing.assert_array_equal(found.colors, np.array(plain.colors, np.float32))
    else:
        assert found.colors is None


@FILE_CASES
@given(obj_texts(), st.sampled_from(["\n", "\r\n", "\r"]))
def test_files_are_read_as_the_slow_parser_reads_them(tmp_path, text, end):
    path = tmp_path / "twin.obj"
    path.write_bytes(text.replace("\n", end).encode() or b"\n")
    same_as_twin(scan(path), text)


@FILE_CASES
@given(obj_texts(), st.sampled_from(["\n", "\r\n", "\r"]), st.sampled_from([7, 64, 700]))
def test_where_a_block_of_lines_ends_does_not_matter(tmp_path, text, end, size):
    path = tmp_path / "twin.obj"
    path.write_bytes(text.replace("\n", end).encode() or b"\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(line_blocks, "BLOCK", size)
        same_as_twin(scan(path), text)


def test_a_file_of_many_blocks_equals_its_own_copy_in_one(file, monkeypatch):
    rng = np.random.default_rng(5)
    lines = []
    for k in range(3000):
        x, y, z = rng.normal(size=3) * 100
        lines.append(f"v {x:.4f} {y:.4f} {z:.4f}\nvt {abs(x) % 1:.5f} {abs(y) % 1:.5f}")
        if k > 4:
            lines.append(f"f {k}/{k} -3/-1 -{k % 5 + 1}/{k - 1}")
        if k % 7 == 0:
            lines.append(f"usemtl m{k % 3}\ng part {k}")
    text = "\n".join([*lines, ""])
    path = file(text)
    one = scan(path)
    same_as_twin(one, text)
    for size in (50, 1111, 30_000):
        monkeypatch.setattr(line_blocks, "BLOCK", size)
        same_as_twin(scan(path), text)
        assert scan(path).sha256 == one.sha256


def test_the_order_of_lines_and_the_sign_of_indices_do_not_matter(file):
    rng = np.random.default_rng(6)
    points = rng.normal(size=(50, 3)).round(4)
    faces = np.array([rng.choice(50, 3, replace=False) for _ in range(40)])
    vertices = [f"v {x} {y} {z}" for x, y, z in points]
    first = opened(
        file("\n".join([*vertices, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces), ""]))
    )
    signed = [f"f {a - 50} {b + 1} {c - 50}" for a, b, c in faces]
    second = opened(file("\n".join([*vertices, *signed, ""])))
    np.testing.assert_array_equal(first.geometry.points, second.geometry.points)
    np.testing.assert_array_equal(first.geometry.faces, second.geometry.faces)
    # The faces may come first, where their indices count from 1.
    early = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    third = opened(file("\n".join([*early, *vertices, ""])))
    np.testing.assert_array_equal(first.geometry.faces, third.geometry.faces)


@FILE_CASES
@given(st.integers(3, 40), st.integers(0, 2**31))
def test_trimesh_reads_the_same_triangles(tmp_path, count, seed):
    trimesh = pytest.importorskip("trimesh")
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)).round(6)
    faces = np.array([rng.choice(count, 3, replace=False) for _ in range(count)])
    path = tmp_path / "oracle.obj"
    path.write_text(
        "".join(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in points)
        + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces)
    )
    oracle = trimesh.load(path, process=False, maintain_order=True)
    found = scan(path)
    np.testing.assert_array_equal(found.points, points)
    np.testing.assert_allclose(
        found.points[found.vertex.reshape(-1, 3)], oracle.vertices[oracle.faces], atol=1e-9
    )


# Materials and pages.


def textured(extra="", faces="usemtl m\nf 1/1 2/2 3/3\n", library="mtllib reef.mtl\n"):
    return library + SQUARE + CORNERS + extra + faces


def test_many_pages_and_materials_switched_back_and_forth(file, pages):
    pages("a.png", "b.tif", "c.jpg", "d.webp")
    file("newmtl a\nmap_Kd a.png\nnewmtl bare\nKd 0.5 0 0\nnewmtl b\nmap_Kd b.tif\n", "one.mtl")
    file("newmtl c d\nmap_Kd c.jpg\nnewmtl d\nmap_Kd d.webp\n", "two.mtl")
    text = "mtllib one.mtl\nmtllib two.mtl\n" + "".join(
        f"v {k} 0 0\nv {k} 1 0\nv {k + 1} 0 0\n" for k in range(8)
    )
    text += CORNERS
    names = [None, "a", "b", "bare", "a", "c d", "d", "unknown"]
    for k, name in enumerate(names):
        text += f"usemtl {name}\n" if name else ""
        text += f"f {3 * k + 1}/1 {3 * k + 2}/2 {3 * k + 3}/3\n"
    survey = opened(file(text))
    mesh = survey.geometry
    shown = [None if page < 0 else mesh.textures[page].name for page in mesh.face_texture.tolist()]
    assert shown == [None, "a.png", "b.tif", None, "a.png", "c.jpg", "d.webp", None]
    assert "'unknown'" in notes_of(survey)
    assert {path.name for path in survey.source[0].companions} == {
        *("one.mtl", "two.mtl", "a.png", "b.tif", "c.jpg", "d.webp")
    }


def test_one_page_of_several_materials_is_one_texture(file, pages):
    pages("a.png")
    file(
        "newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd -s 2 2 1 a.png\n"
        "newmtl c\nmap_Kd -clamp on a.png\n",
        "reef.mtl",
    )
    text = textured(
        faces="usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/1 3/3 4/4\nusemtl c\nf 2/2 3/3 4/4\n"
    )
    mesh = opened(file(text)).geometry
    assert [texture.clamp for texture in mesh.textures] == [False, True]
    np.testing.assert_array_equal(mesh.face_texture, [0, 0, 1])
    np.testing.assert_array_equal(mesh.uv[1], [[0, 0], [2, 2], [0, 2]])


@pytest.mark.parametrize(
    ("options", "scale", "offset", "clamp"),
    [
        ("", (1, 1), (0, 0), False),
        ("-s 2 3 1", (2, 3), (0, 0), False),
        ("-s 0.5", (0.5, 1), (0, 0), False),
        ("-o 0.25 -0.5", (1, 1), (0.25, -0.5), False),
        ("-clamp on", (1, 1), (0, 0), True),
        ("-clamp off -o 0.5 0.5 0 -s 2 2 1", (2, 2), (0.5, 0.5), False),
    ],
)
def test_options_of_map_kd(file, pages, options, scale, offset, clamp):
    pages("my page.png")
    file(f"newmtl m\nmap_Kd {options} my page.png\n", "reef.mtl")
    mesh = opened(file(textured())).geometry
    expected = np.array([[0, 0], [1, 0], [1, 1]]) * scale + offset
    np.testing.assert_allclose(mesh.uv[0], expected)
    assert mesh.textures[0].clamp is clamp


@pytest.mark.parametrize(
    "options", ["-mm 0 1", "-blendu on", "-bm 1", "-s x", "-clamp maybe", "-texres 5", "-o"]
)
def test_other_options_are_refused(file, pages, options):
    pages("a.png")
    mtl = file(f"newmtl m\n\nmap_Kd {options} a.png\n", "reef.mtl")
    path = file(textured())
    with pytest.raises(InputError) as caught:
        opened(path)
    assert caught.value.file == str(mtl)
    assert caught.value.place == "line 3"
    assert repr(options.split()[0]) in str(caught.value)
    assert opened(path, geometry_only=True).geometry.uv is None


def test_a_missing_material_file_leaves_the_geometry_and_says_so(file, caplog):
    path = file(textured())
    with caplog.at_level(logging.WARNING, logger="meshreg"):
        survey = opened(path)
    assert survey.geometry.uv is None
    assert len(survey.geometry.faces) == 1
    assert "'reef.mtl'" in notes_of(survey)
    assert "NO TEXTURE" in notes_of(survey)
    assert "NO TEXTURE" in caplog.text
    assert survey.source[0].companions == ()


def test_a_missing_page_is_named_and_its_faces_have_none(file, pages):
    pages("b.png")
    file("newmtl a\nmap_Kd gone.png\nnewmtl b\nmap_Kd b.png\n", "reef.mtl")
    survey = opened(file(textured(faces="usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/1 3/3 4/4\n")))
    np.testing.assert_array_equal(survey.geometry.face_texture, [-1, 0])
    assert "'gone.png'" in notes_of(survey)
    assert "NO TEXTURE" in notes_of(survey)


def test_a_page_that_is_no_image_counts_as_missing(file, tmp_path):
    (tmp_path / "a.png").write_text("no image")
    file("newmtl m\nmap_Kd a.png\n", "reef.mtl")
    survey = opened(file(textured()))
    assert survey.geometry.uv is None
    assert "'a.png'" in notes_of(survey)


def test_colors_stay_where_the_texture_is_missing(file):
    text = SQUARE.replace("\n", " 1 0 0\n") + "usemtl m\nf 1 2 3\n"
    survey = opened(file("mtllib gone.mtl\n" + text))
    assert (survey.geometry.colors == [255, 0, 0]).all()
    assert "NO TEXTURE" in notes_of(survey)


@pytest.mark.parametrize(
    ("library", "page", "on_disk"),
    [
        ("REEF.MTL", "PAGE.png", "page.PNG"),
        ("reef.mtl", "tex\\page one.png", "tex/page one.png"),
        (".\\reef.mtl", "./tex/page.png", "tex/page.png"),
        ("reef.mtl", "Höhle.png", "Höhle.png"),
        ("my reef.mtl", "page.png", "page.png"),
    ],
)
def test_names_are_found_however_they_are_spelt(file, pages, library, page, on_disk):
    pages(on_disk)
    on_disk_library = "my reef.mtl" if "my" in library else "reef.mtl"
    file(f"newmtl m\nmap_Kd {page}\n", on_disk_library)
    survey = opened(file(textured(library=f"mtllib {library}\n")))
    np.testing.assert_array_equal(survey.geometry.face_texture, [0])
    spelt = "found as" in notes_of(survey)
    assert spelt is (page == "PAGE.png")


def test_names_in_latin_1(file, pages):
    pages("Höhle.png")
    file("newmtl Höhle\nmap_Kd Höhle.png\n".encode("latin-1"), "reef.mtl")
    text = textured(faces="usemtl Höhle\nf 1/1 2/2 3/3\n")
    for encoding in ("latin-1", "utf-8"):
        np.testing.assert_array_equal(
            opened(file(text.encode(encoding))).geometry.face_texture, [0]
        )


def test_several_libraries_on_one_line(file, pages):
    pages("a.png")
    file("newmtl other\n", "one.mtl")
    file("newmtl m\nmap_Kd a.png\n", "two.mtl")
    survey = opened(file(textured(library="mtllib one.mtl two.mtl\n")))
    np.testing.assert_array_equal(survey.geometry.face_texture, [0])
    assert len(survey.source[0].companions) == 3


@pytest.mark.parametrize(
    "name", ["../x.mtl", "/etc/passwd", "C:\\x.mtl", "http://h/x.mtl", "\\\\host\\x.mtl"]
)
def test_references_out_of_the_folder_are_refused(file, name):
    text = refusal_of_reference(file(textured(library=f"mtllib {name}\n")))
    assert repr(name) in text
    assert "reef.obj" in text
    file(f"newmtl m\nmap_Kd {name}\n", "reef.mtl")
    text = refusal_of_reference(file(textured()))
    assert repr(name) in text
    assert "reef.mtl, line 2" in text


def refusal_of_reference(path):
    with pytest.raises(UnsafeReferenceError) as caught:
        opened(path)
    assert caught.value.exit_code == 3
    return str(caught.value)


def test_a_linked_page_outside_is_refused(file, tmp_path):
    folder = tmp_path / "survey"
    folder.mkdir()
    Image.new("RGB", (2, 2)).save(tmp_path / "outside.png")
    (folder / "a.png").symlink_to(tmp_path / "outside.png")
    (folder / "reef.mtl").write_text("newmtl m\nmap_Kd a.png\n")
    path = folder / "reef.obj"
    path.write_text(textured())
    refusal_of_reference(path)


def test_a_bomb_of_a_page_is_refused_by_its_header(file, tmp_path):
    Image.new("RGB", (100, 100)).save(tmp_path / "a.png")
    file("newmtl m\nmap_Kd a.png\n", "reef.mtl")
    path = file(textured())
    with pytest.raises(ResourceLimitError, match="100 x 100"):
        opened(path, max_pixels=9999)
    assert opened(path, max_pixels=10000).geometry.uv is not None


@pytest.mark.parametrize(("far", "noted"), [(0.02, True), (0.0, False)])
def test_texture_coordinates_outside_the_page(file, pages, far, noted):
    pages("a.png")
    file("newmtl m\nmap_Kd a.png\n", "reef.mtl")
    text = textured(extra=f"vt {1 + far} 0.5\n", faces="usemtl m\nf 1/1 2/5 3/3\n")
    survey = opened(file(text))
    np.testing.assert_allclose(survey.geometry.uv[0, 1], [1 + far, 0.5], atol=1e-6)
    assert ("outside 0-1" in notes_of(survey)) is noted


@pytest.mark.parametrize("word", ["nan", "inf"])
def test_faces_without_usable_texture_coordinates(file, pages, word):
    pages("a.png")
    file("newmtl m\nmap_Kd a.png\n", "reef.mtl")
    faces = "usemtl m\nf 1/1 2/2 3/3\nf 1 3 4\nf 2/2 3/3 4/5\n"
    survey = opened(file(textured(extra=f"vt {word} 0\n", faces=faces)))
    np.testing.assert_array_equal(survey.geometry.face_texture, [0, -1, -1])
    assert np.isfinite(survey.geometry.uv).all()
    assert "2 faces of a textured material" in notes_of(survey)


def test_many_materials_and_pages_take_linear_time(file, pages):
    pages("a.png")
    count = 20_000
    file("".join(f"newmtl m{k}\nmap_Kd A{k % 2}.png\n" for k in range(count)), "reef.mtl")
    faces = "".join(f"usemtl m{k}\nf 1/1 2/2 {k % 2 + 3}/3\n" for k in range(count))
    survey = opened(file(textured(faces=faces)))
    assert survey.geometry.uv is None
    assert len(survey.geometry.faces) == 2
    assert len(survey.notes) < 30
    assert "more notes on materials" in notes_of(survey)


# What must be refused.


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", ["is empty"]),
        (b"\n# nothing\n", ["holds no vertices"]),
        (b"hello world\n", ["holds no vertices"]),
        ((SQUARE + "f 1 2 3\nf 1 2").encode(), ["line 6", "face 2", "fewer than three"]),
        ((SQUARE + "f 1 2\nf 1 2 3\n").encode(), ["line 5", "face 1"]),
        ((SQUARE + "f\n").encode(), ["line 5", "face 1"]),
        ((SQUARE + CORNERS + "f 1/1 2/2 3\n").encode(), ["line 9", "'3'", "cut off"]),
        ((SQUARE + CORNERS + "f 1/1 2/2 3/\n").encode(), ["line 9", "'3/'", "cut off"]),
        ((SQUARE + CORNERS + "f 1/1/1 2/2/2 3/3\n").encode(), ["line 9", "'3/3'"]),
        ((SQUARE + "f 1 2 x\n").encode(), ["line 5", "'x'"]),
        ((SQUARE + "f 1 2 3.0\n").encode(), ["line 5", "'3.0'"]),
        ((SQUARE + "f 1 2 3/1/1/1\n").encode(), ["line 5", "'3/1/1/1'"]),
        ((SQUARE + "f 1 2 --3\n").encode(), ["line 5", "'--3'"]),
        ((SQUARE + "f 0 1 2\n").encode(), ["line 5", "face 1", "'0'", "count from 1"]),
        ((SQUARE + CORNERS + "f 1/0 2/1 3/1\n").encode(), ["line 9", "'1/0'", "count from 1"]),
        ((SQUARE + "f 1 2 3\n\nf 1 2 5\n").encode(), ["line 7", "face 2", "vertex 5", "has 4"]),
        ((SQUARE + "f 1 2 -5\n").encode(), ["line 5", "face 1", "before the first"]),
        ((SQUARE + "f 1 2 99999999999\n").encode(), ["line 5", "'99999999999'", "out of range"]),
        ((SQUARE + "f 1 2 2147483648\n").encode(), ["line 5", "out of range"]),
        ((SQUARE + "f 1 2 -99999999999999999999\n").encode(), ["line 5", "out of range"]),
        (b"v 0 0 0\nv 1,5 2,5 3,5\n", ["line 2", "'1,5'", "decimal comma", "decimal point"]),
        (b"v 1 2 3\nv 1 2, 3\n", ["line 2", "'2,'", "decimal comma"]),
        (b"v 0 0 0\r\nv 1 2\r\n", ["line 2", "too few numbers"]),
        (b"v\n", ["line 1", "too few numbers"]),
        (b"v 1 2 3 4 5\n", ["line 1", "more numbers"]),
        (b"v 1 2 3 4 5 6 7 8\n", ["line 1", "more numbers"]),
        (b"v 1 2 abc\n", ["line 1", "'abc'"]),
        (b"v 1 2 1_000\n", ["line 1", "'1_000'"]),
        (b"v 1 2 3e\n", ["line 1", "'3e'"]),
        (b"v 1 2 -\n", ["line 1", "'-'"]),
        (b"v 1 2 0x10\n", ["line 1", "'0x10'"]),
        (b"v 1.5-2.5 3 4\n", ["line 1", "'1.5-2.5'"]),
        (b"v 1 2 3\\x\n", ["line 1"]),
        (b"vt\nv 1 2 3\n", ["line 1", "too few"]),
        (b"vt 1 2 3 4\nv 1 2 3\n", ["line 1", "more numbers"]),
        (b"v 0 0 0\nv 0 \0 0\n", ["byte 12", "NUL"]),
        ("v 0 0 0\n".encode("utf-16"), ["UTF-16"]),
        ("v 0 0 0\n".encode("utf-16-be"), ["NUL"]),
        (b"\xfe\xff" + "v 0 0 0\n".encode("utf-16-be"), ["UTF-16"]),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 1 1\n", ["no usable face"]),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", ["NUL"]),
    ],
)  # fmt: skip
def test_malformed_files_are_refused_with_their_place(file, content, said):
    text = refusal(file(content))
    for part in said:
        assert part in text


def test_a_texture_coordinate_out_of_range_is_refused_or_left_out(file, pages):
    pages("a.png")
    file("newmtl m\nmap_Kd a.png\n", "reef.mtl")
    path = file(textured(faces="usemtl m\nf 1/1 2/2 3/3\nf 1/1 3/9 4/4\n"))
    text = refusal(path)
    assert "texture coordinate 9" in text
    assert "face 2" in text
    assert "line 12" in text
    assert "geometry only" in text
    mesh = opened(path, geometry_only=True).geometry
    assert mesh.uv is None
    assert mesh.textures == ()
    assert len(mesh.faces) == 2


def test_the_line_of_an_error_is_right_in_every_block(file, monkeypatch):
    monkeypatch.setattr(line_blocks, "BLOCK", 400)
    good = "".join(f"v {k} 1 2\r\n" for k in range(200)) + "f 1 2 3\r\n" * 100
    assert "line 301 (face 101)" in refusal(file(good + "f 1 2\r\n" + "f 1 2 3\r\n" * 50))
    assert "line 401" in refusal(file(good + "f 2 3 4\r\n" * 100 + "v 1 2 x\r\n"))
    assert "line 311 (face 111)" in refusal(file(good + "f 1 2 3\r\n" * 10 + "f 1 2 201\r\n" * 5))
    assert "byte 2590" in refusal(file((good + "f 1 2 3\r\n" * 10).encode()[:2590] + b"\0"))


def test_a_line_without_end_is_refused(file):
    for filler in ("#", "v 1 2 3", "g ", "f " + "1 " * 10):
        text = SQUARE + filler + " " * ((1 << 20) + 10)
        for end in ("", "\nf 1 2 3\n", "\nf 1 2 3\n" * 200_000):
            assert "longer than 1048576" in refusal(file(text + end), ResourceLimitError)
    continued = file(SQUARE + "f 1 2 3 " + "4 \\\n" * 300_000)
    assert "longer than 1048576" in refusal(continued, ResourceLimitError)
    file("newmtl " + "m" * (3 << 20), "reef.mtl")
    with pytest.raises(ResourceLimitError, match=r"reef\.mtl"):
        opened(file(textured()))
    opened(file(SQUARE + "#" * ((1 << 20) - 10) + "\nf 1 2 3\n"))


def test_a_folder_or_a_pipe_is_no_file(tmp_path):
    (tmp_path / "folder.obj").mkdir()
    assert "a folder" in refusal(tmp_path / "folder.obj")
    assert "No such file" in refusal(tmp_path / "none.obj")


def test_mutated_files_raise_nothing_unexpected(file, pages):
    pages("a.png")
    file("newmtl m\nmap_Kd a.png\n", "reef.mtl")
    whole = np.frombuffer(
        textured(faces="usemtl m\n" + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n" * 3).encode(), np.uint8
    )
    rng = np.random.default_rng(7)
    for _ in range(400):
        damaged = whole.copy()
        places = rng.integers(0, len(damaged), 3)
        damaged[places] = rng.choice(list(b"0123456789 .-/\\\n\rvtfne#,\xff"), 3)
        cut = rng.integers(1, len(damaged) + 1) if rng.random() < 0.3 else len(damaged)
        path = file(damaged[:cut].tobytes())
        try:
            survey = opened(path)
        except (InputError, ResourceLimitError):
            continue
        assert np.isfinite(survey.geometry.points).all()
        if isinstance(survey.geometry, Mesh):
            assert survey.geometry.faces.max() < len(survey.geometry.points)


def test_coordinates_that_were_float32_are_noted_or_refused(file):
    rng = np.random.default_rng(8)
    base = np.array([731000, 5705000, 0])
    faces = "".join(f"f {k} {k + 1} {k + 2}\n" for k in range(1, 899))

    def stored(size):
        points = rng.uniform(0, size, (900, 3)) + base
        rows = points.astype(np.float32).astype(float)
        return file("".join(f"v {x} {y} {z}\n" for x, y, z in rows) + faces)

    survey = opened(stored(3000))
    assert "32-bit numbers that step by 0.5 m" in notes_of(survey)
    assert "32-bit numbers" in refusal(stored(3))
