"""PLY: every kind of file that should be read, every broken one that must be refused."""

from __future__ import annotations

import os
import struct

import numpy as np
import pytest
import reference_ply as twin
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from meshreg.errors import InputError, UnsafeReferenceError, UsageError
from meshreg.io.frames.place import make_mover
from meshreg.io.options import ReadOptions
from meshreg.io.ply.read import read
from meshreg.io.ply.write import rewrite, write
from meshreg.records import Frame, Maps, Mesh, PointCloud, Survey, Transform

XYZ = [("x", "double"), ("y", "double"), ("z", "double")]
INDICES = ("vertex_indices", ("uchar", "int"))
SQUARE = [[0.0, 0.0, 0.5], [2.0, 0.0, 0.25], [2.0, 3.0, 0.0], [0.0, 3.0, 1.0]]


def ply(path, elements, **options):
    path.write_bytes(twin.encode(elements, **options))
    return path


def mesh_elements(points=SQUARE, faces=((0, 1, 2), (0, 2, 3)), properties=XYZ):
    return [("vertex", properties, points), ("face", [INDICES], [[list(f)] for f in faces])]


def absolute(survey):
    return survey.geometry.points + survey.origin


def page(path, color):
    Image.new("RGB", (4, 4), color).save(path)
    return path


# What is read ------------------------------------------------------------------------------------

FLOATS = st.floats(-1e6, 1e6, allow_nan=False, width=32)
COUNTS = st.sampled_from(["uchar", "ushort", "int", "uint8", "int16", "uint32", "char"])
INTS = st.sampled_from(["int", "uint", "int32", "uint32", "short", "uchar", "uint8"])
SCALARS = st.sampled_from(["float", "double", "float32", "float64"])
ORDERS = st.sampled_from(["", "<", ">"])


@st.composite
def files(draw):
    """A PLY with faces of 3 to 6 corners between other elements and properties of all types."""
    kind = draw(SCALARS)
    n = draw(st.integers(4, 9))
    points = draw(st.lists(st.tuples(FLOATS, FLOATS, FLOATS), min_size=n, max_size=n))
    corner = st.integers(0, n - 1)
    faces = draw(st.lists(st.lists(corner, min_size=3, max_size=6), min_size=1, max_size=6))
    extra = draw(st.lists(st.integers(-9, 9), max_size=3))
    vertex = [
        ("x", kind),
        ("quality", "short"),
        ("y", kind),
        ("z", kind),
        ("flags", ("char", "short")),
    ]
    rows = [[x, k, y, z, extra[: k % 4]] for k, (x, y, z) in enumerate(points)]
    face = [("flags", "uchar"), ("vertex_indices", (draw(COUNTS), draw(INTS))), ("area", "float")]
    return [
        ("camera", [("view", ("int", "double")), ("id", "int")], [[[1.5, 2.5], 7]]),
        ("vertex", vertex, rows),
        ("edge", [("a", "int")], [[1], [2]]),
        ("face", face, [[1, item, 0.5] for item in faces]),
        ("tail", [("w", ("ushort", "uchar"))], [[[1, 2]], [[]]]),
    ]


@given(files(), ORDERS, st.sampled_from(["\n", "\r\n"]))
@settings(max_examples=120, deadline=None)
def test_any_types_orders_and_elements(tmp_path_factory, elements, order, newline):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    ply(path, elements, order=order, newline=newline)
    names, rows = twin.decode(twin.encode(elements, order))["vertex"]
    points = np.array([[row[names.index(axis)] for axis in "xyz"] for row in rows])
    faces = [row[1] for row in elements[3][2]]
    usable = []
    for face in faces:
        if len(face) == 3 and twin.kept_faces(points.tolist(), [face]):
            usable.append(sorted(map(tuple, points[face].tolist())))
    try:
        survey = read(path, ReadOptions())
    except InputError as error:
        assert "no usable face" in error.message  # noqa: PT017
        assert not usable
        return
    found = absolute(survey)[survey.geometry.faces]
    # Reading moves the numbers into a local origin and back: equal to the last digits only.
    scale = np.abs(points).max() + 1
    for triangle in usable:
        distance = np.abs(np.sort(found, axis=1) - np.sort(np.array(triangle), axis=0)).max(
            axis=(1, 2)
        )
        assert distance.min() <= 1e-15 * scale * 4


@given(files(), ORDERS)
@settings(max_examples=60, deadline=None)
def test_faces_equal_the_slow_decoder(tmp_path_factory, elements, order):
    """Before any cleaning: the columns as they are in the file."""
    from meshreg.io.ply.body import read_tables
    from meshreg.io.ply.header import read_header

    path = ply(tmp_path_factory.mktemp("ply") / "a.ply", elements, order=order)
    header = read_header(path)
    wanted = tuple(name for name, _, _ in elements)
    tables = read_tables(header, np.fromfile(path, np.uint8), path, wanted)
    slow = twin.decode(path.read_bytes())
    for name, properties, _ in elements:
        names, rows = slow[name]
        assert [item.name for item in header.element(name).properties] == names
        for number, (_, kind) in enumerate(properties):
            counts, values = tables[name].column(number)
            expected = [row[number] for row in rows]
            if isinstance(kind, str):
                assert counts is None
                assert values.tolist() == expected
            else:
                assert counts.tolist() == [len(item) for item in expected]
                assert values.tolist() == [value for item in expected for value in item]


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_mixed_triangles_quads_and_ngons(tmp_path, order):
    points = [*SQUARE, [5.0, 1.5, 0.0], [-2.0, 1.0, 0.3], [-2.0, 2.0, 0.6]]
    faces = [(0, 1, 2, 3), (1, 4, 2), (0, 3, 6, 5), (0, 1, 4, 2, 3)]
    survey = read(ply(tmp_path / "a.ply", mesh_elements(points, faces), order=order), ReadOptions())
    expected = [[0, 1, 2], [0, 2, 3], [1, 4, 2], [0, 3, 6], [0, 6, 5], [0, 1, 4], [0, 4, 2]]
    np.testing.assert_allclose(absolute(survey), points, atol=1e-15)
    assert survey.geometry.faces.tolist() == expected
    assert survey.notes == ("1 faces that repeat another face's vertices were dropped.",)
    assert survey.source[0].counts == {"vertices": 7, "faces": 4}


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_faces_without_vertices_are_dropped_and_counted(tmp_path, order):
    elements = mesh_elements(faces=[(), (0, 1, 2), (), (0, 2), (0, 2, 3)])
    survey = read(ply(tmp_path / "a.ply", elements, order=order), ReadOptions())
    assert survey.geometry.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert survey.notes == ("3 faces of fewer than three corners were dropped.",)


def test_concave_faces_are_cut_through_the_notch(tmp_path):
    points = [[0, 0, 0.0], [2, 1, 0.0], [0, 2, 0.0], [0.5, 1, 0.0]]
    survey = read(ply(tmp_path / "a.ply", mesh_elements(points, [(0, 1, 2, 3)])), ReadOptions())
    corners = survey.geometry.vertices[survey.geometry.faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert areas.sum() == pytest.approx(twin.area([p[:2] for p in points]))
    assert (areas > 0).all()


@pytest.mark.parametrize(
    ("names", "kind", "values", "expected"),
    [
        (("red", "green", "blue"), "uchar", (10, 20, 255), (10, 20, 255)),
        (("diffuse_red", "diffuse_green", "diffuse_blue"), "uint8", (1, 2, 3), (1, 2, 3)),
        (("red", "green", "blue"), "ushort", (257, 32896, 65535), (1, 128, 255)),
        (("red", "green", "blue"), "float", (0.0, 0.5, 1.0), (0, 128, 255)),
    ],
)
@pytest.mark.parametrize("order", ["", ">"])
def test_colors(tmp_path, names, kind, values, expected, order):
    properties = [*XYZ, *((name, kind) for name in names), ("alpha", "uchar")]
    points = [[*point, *values, 9] for point in SQUARE]
    path = ply(tmp_path / "a.ply", mesh_elements(points, properties=properties), order=order)
    survey = read(path, ReadOptions())
    assert survey.geometry.colors.tolist() == [list(expected)] * 4
    assert survey.notes == ()


@pytest.mark.parametrize("faces", [None, []])
def test_without_faces_it_is_a_cloud(tmp_path, faces):
    elements = mesh_elements()[: 1 if faces is None else 2]
    if faces is not None:
        elements[1] = ("face", [INDICES], [])
    survey = read(ply(tmp_path / "reef.ply", elements), ReadOptions())
    assert isinstance(survey.geometry, PointCloud)
    assert survey.name == "reef"
    np.testing.assert_allclose(absolute(survey), SQUARE, atol=1e-15)
    np.testing.assert_array_equal(survey.origin, np.round(survey.bounds.mean(axis=0)))


def textured(n_pages, numbers, uv=((0, 0, 1, 0, 1, 1), (0, 0, 1, 1, 0, 1))):
    face = [INDICES, ("texcoord", ("uchar", "float")), ("texnumber", "int")]
    rows = [[[0, 1, 2], list(uv[0]), numbers[0]], [[0, 2, 3], list(uv[1]), numbers[1]]]
    comments = [f"TextureFile page {k}.png" for k in range(n_pages)]
    return [("vertex", XYZ, SQUARE), ("face", face, rows)], comments


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_several_pages_by_texnumber(tmp_path, order):
    elements, comments = textured(3, (2, 1))
    colors = [(255, 0, 0), (0, 255, 0), (0, 0, 255)]
    pages = [page(tmp_path / f"page {k}.png", colors[k]) for k in range(3)]
    path = ply(tmp_path / "a.ply", elements, order=order, comments=comments)
    survey = read(path, ReadOptions())
    mesh = survey.geometry
    assert mesh.face_texture.tolist() == [2, 1]
    assert [tuple(t.load()[0, 0]) for t in mesh.textures] == colors
    assert mesh.uv.reshape(2, 6).tolist() == [[0, 0, 1, 0, 1, 1], [0, 0, 1, 1, 0, 1]]
    assert survey.source[0].companions == tuple(pages)
    bare = read(path, ReadOptions(geometry_only=True)).geometry
    assert bare.uv is None
    assert bare.textures == ()


def test_quads_keep_their_texture_corners(tmp_path):
    page(tmp_path / "p.png", (9, 9, 9))
    uv = [0, 0, 1, 0, 1, 1, 0, 1]
    elements = [
        ("vertex", XYZ, [*SQUARE, [5.0, 0, 0]]),
        (
            "face",
            [INDICES, ("texcoord", ("uchar", "float"))],
            [[[0, 1, 2, 3], uv], [[1, 4, 2], []]],
        ),
    ]
    survey = read(ply(tmp_path / "a.ply", elements, comments=["TextureFile p.png"]), ReadOptions())
    assert survey.geometry.uv[:2].reshape(2, 6).tolist() == [[0, 0, 1, 0, 1, 1], [0, 0, 1, 1, 0, 1]]
    assert survey.geometry.face_texture.tolist() == [0, 0, -1]


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_texture_coordinates_per_vertex(tmp_path, names):
    page(tmp_path / "p.png", (1, 2, 3))
    properties = [*XYZ, *((name, "float") for name in names)]
    uv = [[0.0, 0.0], [1.0, 0.0], [1.0, 0.75], [0.0, 0.75]]
    points = [point + item for point, item in zip(SQUARE, uv, strict=True)]
    path = ply(
        tmp_path / "a.ply",
        mesh_elements(points, properties=properties),
        comments=["TextureFile p.png"],
    )
    mesh = read(path, ReadOptions()).geometry
    assert mesh.uv.tolist() == [[uv[k] for k in face] for face in mesh.faces.tolist()]
    assert mesh.face_texture.tolist() == [0, 0]


def test_missing_and_broken_pages_take_the_color_of_their_faces(tmp_path):
    elements, comments = textured(3, (0, 2))
    (tmp_path / "page 1.png").write_bytes(b"no picture")
    page(tmp_path / "PAGE 2.png", (5, 5, 5))
    survey = read(ply(tmp_path / "a.ply", elements, comments=comments), ReadOptions())
    assert survey.geometry.face_texture.tolist() == [-1, 0]
    assert len(survey.geometry.textures) == 1
    told = " ".join(survey.notes)
    assert "'page 0.png' was not found" in told
    assert "'page 1.png' is cut off" in told or "'page 1.png' is not an image" in told
    assert "'page 2.png' was found as 'PAGE 2.png'" in told


def test_uv_without_a_page_and_a_page_without_uv_are_told(tmp_path):
    elements, _ = textured(1, (0, 0))
    survey = read(ply(tmp_path / "a.ply", elements), ReadOptions())
    assert survey.geometry.uv is None
    assert "no texture page is named" in survey.notes[0]
    survey = read(
        ply(tmp_path / "b.ply", mesh_elements(), comments=["TextureFile x.png"]), ReadOptions()
    )
    assert "no texture coordinates" in survey.notes[0]


def test_uv_outside_the_page_is_told(tmp_path):
    page(tmp_path / "page 0.png", (1, 2, 3))
    elements, comments = textured(1, (0, 0), uv=((0, 0, 1.5, 0, 1, 1), (0, 0, np.nan, 1, 0, 1)))
    survey = read(ply(tmp_path / "a.ply", elements, comments=comments), ReadOptions())
    assert "33.3% of the texture coordinates" in " ".join(survey.notes)
    assert "1 faces have texture coordinates that are not finite or far off" in " ".join(
        survey.notes
    )
    assert survey.geometry.face_texture.tolist() == [0, -1]


def test_few_lost_vertices_go_with_their_faces_many_are_refused(tmp_path):
    n = 300
    points = [[float(k), float(k * k % 11), 0.0] for k in range(n)]
    faces = [(k, k + 1, k + 2) for k in range(n - 2)]
    points[100][2] = float("nan")
    points[200][0] = float("inf")
    survey = read(ply(tmp_path / "a.ply", mesh_elements(points, faces), order="<"), ReadOptions())
    assert len(survey.geometry.vertices) == n - 2
    assert len(survey.geometry.faces) == n - 2 - 6
    assert np.isfinite(survey.bounds).all()
    assert "2 points that are not finite numbers were dropped, with 6 faces" in survey.notes[0]
    points[0:2] = [[float("nan")] * 3] * 2
    with pytest.raises(InputError, match=r"vertex 1.*4 points of 300"):
        read(ply(tmp_path / "a.ply", mesh_elements(points, faces), order=""), ReadOptions())


def test_large_coordinates_keep_their_millimetres(tmp_path):
    points = np.array(SQUARE) + np.array([512345.678, 8412345.123, -12.5])
    for order in ("", "<"):
        elements = mesh_elements(points.tolist())
        survey = read(ply(tmp_path / "a.ply", elements, order=order), ReadOptions())
        assert np.abs(absolute(survey) - points).max() < 2e-9
        assert np.abs(survey.geometry.vertices).max() < 4
        assert survey.notes == ()


def test_large_single_precision_is_told_or_refused(tmp_path):
    rng = np.random.default_rng(0)
    floats = [(axis, "float") for axis in "xyz"]
    near = rng.uniform(0, 20, (900, 3)) + np.array([512345, 4000000, 0])
    survey = read(ply(tmp_path / "a.ply", [("vertex", floats, near.tolist())]), ReadOptions())
    assert "32-bit numbers that step by 0.25 m" in " ".join(survey.notes)
    dense = rng.uniform(0, 20, (9000, 3)) + np.array([512345, 8412345, 0])
    with pytest.raises(InputError, match="step by 1 m"):
        read(ply(tmp_path / "b.ply", [("vertex", floats, dense.tolist())]), ReadOptions())


def test_options_and_sidecar_place_the_survey(tmp_path):
    path = ply(tmp_path / "a.ply", mesh_elements())
    survey = read(path, ReadOptions(axes="ned", shift=(100.0, 200.0, 300.0)))
    ned = np.array(SQUARE)[:, [1, 0, 2]] * [1, 1, -1] + np.array([100, 200, 300])
    np.testing.assert_allclose(absolute(survey), ned, atol=1e-12)
    (tmp_path / "a_offset.xyz").write_text("500 600 700\n")
    survey = read(path, ReadOptions())
    np.testing.assert_allclose(
        absolute(survey), np.array(SQUARE) + np.array([500, 600, 700]), atol=1e-12
    )
    assert survey.source[0].sidecar == tmp_path / "a_offset.xyz"


def test_agrees_with_trimesh_where_that_reads_right(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    properties = [*XYZ, *((name, "uchar") for name in ("red", "green", "blue"))]
    points = [[*p, 10 * k, 20, 30] for k, p in enumerate(SQUARE)]
    for order in ("", "<", ">"):
        path = ply(tmp_path / "a.ply", mesh_elements(points, properties=properties), order=order)
        mine, theirs = read(path, ReadOptions()), trimesh.load_mesh(path, process=False)
        np.testing.assert_allclose(absolute(mine), theirs.vertices, atol=1e-15)
        np.testing.assert_array_equal(mine.geometry.faces, theirs.faces)
        np.testing.assert_array_equal(mine.geometry.colors, theirs.visual.vertex_colors[:, :3])


# What is refused ---------------------------------------------------------------------------------


HEADERS = [
    (b"", "is empty"),
    (b"plx\n", "does not start with 'ply'"),
    (b"ply\nformat ascii 1.0\nelement vertex 1\n", "no 'end_header'"),
    (b"ply\nelement vertex 0\nend_header\n", "states no format"),
    (b"ply\nformat binary_middle_endian 1.0\nend_header\n", "binary_middle_endian"),
    (b"ply\nformat ascii 2.0\nend_header\n", "'ascii 2.0'"),
    (b"ply\nformat ascii 1.0\nwhatever\nend_header\n", "line 3.*means nothing"),
    (b"ply\nformat ascii 1.0\nelement vertex -3\nend_header\n", "line 3.*-3"),
    (b"ply\nformat ascii 1.0\nelement vertex 1e3\nend_header\n", "1e3"),
    (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "means nothing"),
    (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n1\n", "'half'"),
    (b"ply\nformat ascii 1.0\nelement a 1\nproperty list float int x\nend_header\n1 1\n", "counts"),
    (
        b"ply\nformat ascii 1.0\nelement a 1\nproperty int x\nproperty int x\nend_header\n1 1\n",
        "twice",
    ),
    (b"ply\nformat ascii 1.0\nelement a 0\nelement a 0\nend_header\n", "twice"),
    (b"ply\nformat ascii 1.0\n" + b"element a 0\n" * 80_000 + b"end_header\n", "declares 80000"),
    (b"ply\nformat ascii 1.0\nelement a 1\nend_header\n\n", "without a property"),
    (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "x, y and z"),
    (
        b"ply\nformat ascii 1.0\nelement face 0\nproperty float x\nend_header\n",
        "no element 'vertex'",
    ),
]


@pytest.mark.parametrize(("content", "message"), HEADERS)
def test_broken_headers_are_refused(tmp_path, content, message):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match=message) as raised:
        read(tmp_path / "a.ply", ReadOptions())
    assert raised.value.file == str(tmp_path / "a.ply")
    assert raised.value.remedy


@pytest.mark.parametrize(
    "count", ["4000000000", "300", "99999999999999999", "18446744073709551616"]
)
@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize("element", ["vertex", "face"])
def test_counts_are_checked_before_memory_is_asked_for(tmp_path, count, order, element):
    import tracemalloc

    elements = mesh_elements()
    path = ply(tmp_path / "a.ply", elements, order=order, counts={element: count})
    tracemalloc.start()
    with pytest.raises(InputError, match=r"declares|no count|ends"):
        read(path, ReadOptions())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6


@pytest.mark.parametrize("order", ["<", ">"])
def test_every_truncation_of_a_binary_file_is_refused(tmp_path, order):
    whole = twin.encode(mesh_elements(faces=[(0, 1, 2), (0, 2, 3, 1)]), order)
    path = tmp_path / "a.ply"
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError):
            read(path, ReadOptions())
    # The byte at which it ends is told.
    path.write_bytes(whole[:-3])
    with pytest.raises(InputError, match=f"ends at byte {len(whole) - 3}, in row 2 of 2 of 'face'"):
        read(path, ReadOptions())


def test_every_truncation_of_a_text_file_is_refused_or_loses_only_the_line_end(tmp_path):
    whole = twin.encode(mesh_elements(), "")
    path = tmp_path / "a.ply"
    for size in range(len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError):
            read(path, ReadOptions())
    path.write_bytes(whole[:-1])
    assert len(read(path, ReadOptions()).geometry.faces) == 2


TEXTS = [
    ("0 0 0.5\n2 0 0.25\n2 3 0\n3 0 1 2\n3 0 2 3\n", "line 13"),  # a row less
    ("0 0 0.5\n2 0 0.25\n2 3 0\n0 3 1\n9 9 9\n3 0 1 2\n3 0 2 3\n", "line 14|line 15"),  # a row more
    ("0 0 0.5\n2 0 0.25 7\n2 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\n", "line 11.*words"),
    ("0 0 0.5\n2 0\n2 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\n", "line 11.*words"),
    ("0 0 0.5\n2 0 0,25\n2 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\n", "line 11.*decimal comma"),
    ("0 0 0.5\n2 0 x\n2 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\n", "line 11.*'x'"),
    ("0 0 0.5\n2 0 1_0\n2 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\n", "line 11.*'1_0'"),
    ("0 0 0.5\n2 0 1\0\n2 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\n", "line 11.*byte"),
    ("0 0 0.5\n2 0 1\n2 3 0\n0 3 1\n3 0 1 2\n3 0 2\n", "line 15.*words"),
    ("0 0 0.5\n2 0 1\n2 3 0\n0 3 1\n-3 0 1 2\n3 0 2 3\n", "line 14.*length"),
    ("0 0 0.5\n2 0 1\n2 3 0\n0 3 1\n3 0 1 2.5\n3 0 2 3\n", "2.5.*vertex_indices"),
    ("0 0 0.5\n2 0 1\n2 3 0\n0 3 1\n3 0 1 2\n3 0 2 4\n", "face 2.*vertex 4 of 4"),
    ("0 0 0.5\n2 0 1\n2 3 0\n0 3 1\n3 0 -1 2\n3 0 2 3\n", "face 1.*vertex -1 of 4"),
    ("0 0 0.5\n2 0 1\n2 3 0\n0 3 1\n3 0 1 2\n3 0 2 3\nmore\n", "line 16.*after the last"),
]


@pytest.mark.parametrize(("text", "message"), TEXTS)
def test_broken_text_is_refused_with_its_line(tmp_path, text, message):
    path = tmp_path / "a.ply"
    path.write_bytes(twin.header(mesh_elements(), "") + text.encode())
    with pytest.raises(InputError, match=message):
        read(path, ReadOptions())


def test_text_may_have_blank_lines_and_any_line_end(tmp_path):
    path = tmp_path / "a.ply"
    for newline in ("\n", "\r\n", "\r"):
        body = twin.body(mesh_elements(), "", newline) + (newline * 2).encode()
        path.write_bytes(twin.header(mesh_elements(), "", newline=newline) + body)
        survey = read(path, ReadOptions())
        np.testing.assert_allclose(absolute(survey), SQUARE, atol=1e-15)
        assert survey.geometry.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_binary_body_that_starts_with_a_line_end_byte(tmp_path):
    """The header ends at its own line end, whatever the first byte of the body is."""
    for newline in ("\n", "\r"):
        x = struct.unpack("<d", b"\n\r\n\r\n\r\n\x40")[0]
        points = [[x, 0.0, 0.0], [x + 1, 0.0, 0.0], [x, 2.0, 0.0]]
        elements = mesh_elements(points, [(0, 1, 2)])
        path = ply(tmp_path / "a.ply", elements, order="<", newline=newline)
        np.testing.assert_allclose(absolute(read(path, ReadOptions())), points, atol=1e-12)


@pytest.mark.parametrize("index", [-1, 4, 2**31 - 1, -(2**31)])
def test_indices_out_of_range_are_refused_with_the_face(tmp_path, index):
    elements = mesh_elements(faces=[(0, 1, 2), (0, index, 3)])
    with pytest.raises(InputError, match=f"face 2.*vertex {index} of 4"):
        read(ply(tmp_path / "a.ply", elements), ReadOptions())


def test_bytes_after_the_last_element_are_refused(tmp_path):
    path = ply(tmp_path / "a.ply", mesh_elements())
    content = path.read_bytes()
    path.write_bytes(content + b"\n")
    read(path, ReadOptions())
    path.write_bytes(content + b"\0" * 13)
    with pytest.raises(InputError, match="13 bytes after the last"):
        read(path, ReadOptions())


def test_negative_list_length_in_binary(tmp_path):
    elements = [
        ("vertex", XYZ, SQUARE),
        ("face", [("vertex_indices", ("char", "int"))], [[[0, 1, 2]]]),
    ]
    content = bytearray(twin.encode(elements))
    content[-13] = 0xFD
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match="negative"):
        read(tmp_path / "a.ply", ReadOptions())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"numbers": (0, 3)}, "face 2.*texnumber 3 with 3"),
        ({"numbers": (-2, 0)}, "face 1.*texnumber -2"),
        ({"uv": ((0, 0, 1, 0, 1, 1), (0, 0, 1, 1))}, "face 2.*4 texture coordinates"),
    ],
)
def test_broken_texture_columns_are_refused_but_not_for_geometry(tmp_path, change, message):
    for k in range(3):
        page(tmp_path / f"page {k}.png", (k, k, k))
    elements, comments = textured(3, **({"numbers": (0, 1)} | change))
    path = ply(tmp_path / "a.ply", elements, comments=comments)
    with pytest.raises(InputError, match=message) as raised:
        read(path, ReadOptions())
    assert "geometry_only" in raised.value.remedy
    assert len(read(path, ReadOptions(geometry_only=True)).geometry.faces) == 2


def test_several_pages_without_texnumber_are_refused(tmp_path):
    (_, (name, face, rows)), comments = textured(2, (0, 1))
    elements = [("vertex", XYZ, SQUARE), (name, face[:2], [row[:2] for row in rows])]
    with pytest.raises(InputError, match=r"2 texture pages.*no 'texnumber'"):
        read(ply(tmp_path / "a.ply", elements, comments=comments), ReadOptions())


@pytest.mark.parametrize(
    "name", ["../page.png", "/etc/hostname", "file:///etc/hostname", "C:\\page.png", "link.png"]
)
def test_pages_outside_the_folder_are_refused(tmp_path, name):
    folder = tmp_path / "survey"
    folder.mkdir()
    page(tmp_path / "page.png", (1, 1, 1))
    (folder / "link.png").symlink_to(tmp_path / "page.png")
    elements, _ = textured(1, (0, 0))
    path = ply(folder / "a.ply", elements, comments=[f"TextureFile {name}"])
    with pytest.raises(UnsafeReferenceError):
        read(path, ReadOptions())
    assert read(path, ReadOptions(geometry_only=True)).geometry.uv is None


def test_folder_pipe_and_missing_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    for path in (tmp_path, tmp_path / "none.ply", tmp_path / "pipe.ply"):
        with pytest.raises(InputError):
            read(path, ReadOptions())


def test_triangle_strips_and_lists_for_coordinates_are_refused(tmp_path):
    strips = ("tristrips", [("vertex_indices", ("int", "int"))], [[[0, 1, 2, 3]]])
    with pytest.raises(InputError, match="triangle strips"):
        read(ply(tmp_path / "a.ply", [("vertex", XYZ, SQUARE), strips]), ReadOptions())
    listed = [("x", ("uchar", "float")), *XYZ[1:]]
    elements = [("vertex", listed, [[[1.0], 2.0, 3.0]])]
    with pytest.raises(InputError, match="'x' as a list"):
        read(ply(tmp_path / "a.ply", elements), ReadOptions())


def test_no_mutation_brings_anything_but_an_error_or_a_mesh(tmp_path):
    """Row 5's cousins: bytes changed at random never crash, hang or ask for much memory."""
    rng = np.random.default_rng(1)
    path = tmp_path / "a.ply"
    for order in ("", "<", ">"):
        whole = twin.encode(mesh_elements(faces=[(0, 1, 2), (0, 2, 3, 1)]), order)
        for _ in range(150):
            content = bytearray(whole)
            for at in rng.integers(0, len(content), rng.integers(1, 4)):
                content[at] = rng.integers(0, 256)
            path.write_bytes(content)
            try:
                survey = read(path, ReadOptions())
            except InputError:
                continue
            assert np.isfinite(survey.bounds).all()


# What is written ---------------------------------------------------------------------------------

TURN = Transform(
    np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]), 1.25, (10, -20, 3), (1, 1, 0)
)


def mover(survey, transform=TURN, target=None):
    source = survey.source[0]
    return make_mover(source, transform, target or source.frame)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_rewrite_keeps_everything_but_positions_and_normals(tmp_path, order):
    properties = [
        ("nx", "float"), ("x", "double"), ("id", "int64"), ("y", "double"), ("ny", "float"),
        ("nz", "float"), ("z", "double"), ("quality", "float"), ("tags", ("uchar", "short")),
    ]  # fmt: skip
    rows = [[1.0, p[0], 2**53 + k, p[1], 0.0, 0.0, p[2], 0.1, [1, k]] for k, p in enumerate(SQUARE)]
    elements = [
        ("camera", [("view", ("int", "double"))], [[[1.5, 2.5]], [[]]]),
        ("vertex", properties, rows),
        ("face", [INDICES, ("weight", "float")], [[[0, 1, 2], 0.5], [[0, 2, 3], 0.25]]),
    ]
    if not order:  # numbers of text pass through float64 only where they are needed
        rows[0][2] = 2**53 + 1
    comments = ["made by someone", "a  b"]
    source = ply(tmp_path / "a.ply", elements, order=order, comments=comments)
    survey = read(source, ReadOptions())
    (written,) = rewrite(survey.source[0], mover(survey), tmp_path / "b.ply")
    old, new = twin.decode(source.read_bytes()), twin.decode(written.read_bytes())
    assert (
        written.read_bytes().partition(b"end_header")[0]
        == (source.read_bytes().partition(b"end_header")[0])
    )
    assert new["camera"] == old["camera"]
    assert new["face"] == old["face"]
    names = new["vertex"][0]
    for name in ("id", "quality", "tags"):
        at = names.index(name)
        assert [row[at] for row in new["vertex"][1]] == [row[at] for row in old["vertex"][1]]
    at = [names.index(name) for name in ("x", "y", "z", "nx", "ny", "nz")]
    values = np.array([[row[k] for k in at] for row in new["vertex"][1]])
    np.testing.assert_allclose(values[:, :3], TURN.apply(SQUARE), atol=1e-12)
    np.testing.assert_allclose(values[:, 3:], [[0.8, 0.6, 0.0]] * 4, atol=1e-7)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_rewrite_by_nothing_and_there_and_back(tmp_path, order):
    rng = np.random.default_rng(3)
    points = np.round(rng.uniform(-50, 50, (40, 3)) + np.array([500000, 6000000, -20]), 6)
    faces = [(k, k + 1, k + 2, k + 3) for k in range(37)]
    elements = mesh_elements(points.tolist(), faces)
    source = ply(tmp_path / "a.ply", elements, order=order)
    survey = read(source, ReadOptions())
    same = rewrite(survey.source[0], mover(survey, Transform()), tmp_path / "same.ply")[0]
    if order:
        assert same.read_bytes() == source.read_bytes()
    assert twin.decode(same.read_bytes()) == twin.decode(source.read_bytes())
    pivoted = Transform(TURN.rotation, TURN.scale, TURN.offset, survey.centre)
    there = rewrite(survey.source[0], mover(survey, pivoted), tmp_path / "there.ply")[0]
    moved = read(there, ReadOptions())
    np.testing.assert_allclose(absolute(moved), pivoted.apply(points), atol=1e-8)
    back = rewrite(moved.source[0], mover(moved, pivoted.inverse()), tmp_path / "back.ply")[0]
    np.testing.assert_allclose(absolute(read(back, ReadOptions())), points, atol=1e-8)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_rewrite_into_the_references_frame(tmp_path, order):
    """North, east, down in, a shifted east, north, up frame out."""
    source = ply(tmp_path / "a.ply", mesh_elements(), order=order)
    survey = read(source, ReadOptions(axes="ned", shift=(5000.0, 6000.0, 0.0)))
    target = Frame(shift=np.array([5010.0, 6000.0, -1.0]))
    written = rewrite(survey.source[0], mover(survey, TURN, target), tmp_path / "b.ply")[0]
    again = read(written, ReadOptions(shift=(5010.0, 6000.0, -1.0)))
    np.testing.assert_allclose(absolute(again), TURN.apply(absolute(survey)), atol=1e-9)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_single_precision_is_widened_only_where_it_would_lose_digits(tmp_path, order, caplog):
    floats = [(axis, "float") for axis in "xyz"]
    source = ply(tmp_path / "a.ply", mesh_elements(properties=floats), order=order)
    survey = read(source, ReadOptions())
    near = rewrite(survey.source[0], mover(survey), tmp_path / "near.ply")[0]
    assert b"property float x" in near.read_bytes()
    np.testing.assert_allclose(absolute(read(near, ReadOptions())), TURN.apply(SQUARE), atol=2e-6)
    assert not caplog.records
    far = Transform(offset=(500000.123, 6000000.456, 0.0))
    wide = rewrite(survey.source[0], mover(survey, far), tmp_path / "far.ply")[0]
    assert b"property double x" in wide.read_bytes()
    assert "they are double" in caplog.text
    np.testing.assert_allclose(absolute(read(wide, ReadOptions())), far.apply(SQUARE), atol=2e-9)


def test_rewrite_copies_the_pages_and_keeps_lost_vertices(tmp_path):
    elements, comments = textured(2, (1, 0))
    for k in range(2):
        page(tmp_path / f"page {k}.png", (k, 9, 9))
    points = [*SQUARE, *([[4.0, 4.0, 0.0]] * 200), [float("nan")] * 3]
    elements[0] = ("vertex", XYZ, points)
    survey = read(ply(tmp_path / "a.ply", elements, comments=comments), ReadOptions())
    (tmp_path / "out").mkdir()
    files = rewrite(survey.source[0], mover(survey), tmp_path / "out" / "b.ply")
    assert [file.name for file in files] == ["b.ply", "page 0.png", "page 1.png"]
    for k in range(2):
        name = f"page {k}.png"
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / name).read_bytes()
    again = read(files[0], ReadOptions()).geometry
    np.testing.assert_array_equal(again.uv, survey.geometry.uv)
    np.testing.assert_array_equal(again.face_texture, survey.geometry.face_texture)
    rows = twin.decode(files[0].read_bytes())["vertex"][1]
    assert np.isnan(rows[-1]).all()
    assert len(rows) == len(points)


def test_rewrite_refuses_itself_and_a_changed_source(tmp_path):
    source = ply(tmp_path / "a.ply", mesh_elements())
    survey = read(source, ReadOptions())
    with pytest.raises(UsageError, match="itself"):
        rewrite(survey.source[0], mover(survey), source)
    source.write_bytes(source.read_bytes() + b"\n")
    with pytest.raises(InputError, match="changed"):
        rewrite(survey.source[0], mover(survey), tmp_path / "b.ply")
    assert not (tmp_path / "b.ply").exists()
    assert sorted(item.name for item in tmp_path.iterdir()) == ["a.ply"]


@given(files(), ORDERS, st.booleans())
@settings(max_examples=40, deadline=None)
def test_rewrite_keeps_lists_of_any_length(tmp_path_factory, elements, order, far):
    """Vertices whose lists differ in length keep them; wider coordinates make room."""
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    vertex, face = elements[1], elements[3]
    face[1].extend([("nx", "float"), ("ny", "float"), ("nz", "double")])
    for row in face[2]:
        row += [0.6, -0.8, 0.0]
    source = ply(path, elements, order=order)
    try:
        survey = read(source, ReadOptions())
    except InputError as error:
        assert "no usable face" in error.message  # noqa: PT017
        return
    offset = (500000.25, 6000000.5, 0.0) if far else (10, -20, 3)
    move = Transform(TURN.rotation, 1.25, offset)
    (written,) = rewrite(survey.source[0], mover(survey, move), path.with_name("b.ply"))
    old, new = twin.decode(source.read_bytes()), twin.decode(written.read_bytes())
    assert old.keys() == new.keys()
    for name in ("camera", "edge", "tail"):
        assert new[name] == old[name]
    names = [name for name, _ in vertex[1]]
    columns = [names.index(axis) for axis in "xyz"]
    for before, after in zip(old["vertex"][1], new["vertex"][1], strict=True):
        kept = [k for k in range(len(names)) if k not in columns]
        assert [after[k] for k in kept] == [before[k] for k in kept]
        expected = move.apply([[before[k] for k in columns]])[0]
        step = 1e-4 if far else 1e-6 * (1 + np.abs(expected).max())
        assert [after[k] for k in columns] == pytest.approx(expected, abs=step)
    for before, after in zip(old["face"][1], new["face"][1], strict=True):
        assert after[:-3] == before[:-3]
        assert after[-3:] == pytest.approx([0.96, -0.28, 0.0], abs=1e-6)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_rewrite_turns_splats(tmp_path, order):
    """Orientation, size and color of 3D Gaussian splats; their harmonics are in test_directions."""
    rng = np.random.default_rng(4)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{k}" for k in range(45)] + ["opacity", "scale_0", "scale_1", "scale_2"]
    names += [f"rot_{k}" for k in range(4)]
    rows = rng.normal(size=(30, len(names))).astype("f4").astype(float)
    elements = [("vertex", [(name, "float") for name in names], rows.tolist())]
    survey = read(ply(tmp_path / "a.ply", elements, order=order), ReadOptions())
    assert not any("not turned" in note for note in survey.notes)
    files = rewrite(survey.source[0], mover(survey), tmp_path / "b.ply")
    new = np.array(twin.decode(files[0].read_bytes())["vertex"][1])

    def column(table, *wanted):
        return np.stack([table[:, names.index(name)] for name in wanted], axis=1)

    same = ("f_dc_0", "f_dc_1", "f_dc_2", "opacity")
    assert (column(new, *same) == column(rows, *same)).all()
    size = ("scale_0", "scale_1", "scale_2")
    np.testing.assert_allclose(column(new, *size), column(rows, *size) + np.log(1.25), atol=1e-6)
    normal = ("nx", "ny", "nz")
    np.testing.assert_allclose(
        column(new, *normal), column(rows, *normal) @ TURN.rotation.T, atol=1e-6
    )
    turn = tuple(f"rot_{k}" for k in range(4))
    before, after = (
        Rotation.from_quat(column(table, *turn), scalar_first=True) for table in (rows, new)
    )
    np.testing.assert_allclose(after.as_matrix(), TURN.rotation @ before.as_matrix(), atol=1e-5)
    # Degree 1 is a vector: (y, z, x) up to signs, the same for all colors.
    for channel in range(3):
        first = [f"f_rest_{15 * channel + k}" for k in (2, 0, 1)]
        signs = np.array([-1, -1, 1])
        np.testing.assert_allclose(
            signs * column(new, *first), (signs * column(rows, *first)) @ TURN.rotation.T, atol=1e-6
        )


def test_what_a_copy_cannot_turn_is_named(tmp_path):
    properties = [
        *XYZ,
        ("Dip_direction", "float"),
        ("nx", "uchar"),
        ("ny", "uchar"),
        ("nz", "uchar"),
    ]
    rows = [[*point, 90.0, 1, 2, 3] for point in SQUARE]
    elements = [
        ("vertex", properties, rows),
        ("camera", [("view_px", "float"), ("x_axisx", "float"), ("x_axisy", "float"),
                    ("x_axisz", "float")], [[1.0, 1.0, 0.0, 0.0]]),
    ]  # fmt: skip
    survey = read(ply(tmp_path / "a.ply", elements), ReadOptions())
    assert "not turned with it: 'Dip_direction', 'nx', 'ny', 'nz'." in survey.notes[0]
    assert survey.notes[1] == "Element 'camera' holds places or directions; it is not moved."
    files = rewrite(survey.source[0], mover(survey), tmp_path / "b.ply")
    old, new = (twin.decode(path.read_bytes()) for path in (tmp_path / "a.ply", files[0]))
    assert new["camera"] == old["camera"]
    assert [row[3:] for row in new["vertex"][1]] == [row[3:] for row in old["vertex"][1]]


def test_signed_integers_hold_a_normal(tmp_path):
    properties = [*XYZ, *((name, "char") for name in ("nx", "ny", "nz"))]
    rows = [[*point, 127, 0, 0] for point in SQUARE]
    survey = read(ply(tmp_path / "a.ply", [("vertex", properties, rows)]), ReadOptions())
    files = rewrite(survey.source[0], mover(survey), tmp_path / "b.ply")
    new = twin.decode(files[0].read_bytes())["vertex"][1]
    assert [row[3:] for row in new] == [[102, 76, 0]] * 4  # 127 times 0.8 and 0.6


def test_classes_of_noise_and_water_are_left_out_of_a_cloud(tmp_path):
    properties = [*XYZ, ("red", "uchar"), ("green", "uchar"), ("blue", "uchar")]
    properties += [("classification", "uchar")]
    classes = [1, 41, 40, 7, 9, 45]
    rows = [[k, k * k, -k, k, k, k, c] for k, c in enumerate(classes)]
    survey = read(ply(tmp_path / "a.ply", [("vertex", properties, rows)]), ReadOptions())
    assert absolute(survey)[:, 0].tolist() == [0, 2]
    assert survey.geometry.colors.tolist() == [[0] * 3, [2] * 3]
    assert survey.notes[0].startswith("1 points classed as noise")
    assert survey.notes[1].startswith("3 points classed as water")


@given(st.integers(0, 2**32 - 1), st.booleans(), st.integers(0, 3))
@settings(max_examples=25, deadline=None)
def test_what_is_written_reads_back_the_same(tmp_path_factory, seed, colored, n_pages):
    from meshreg.io.files.images import texture_from_array

    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("ply")
    n = int(rng.integers(5, 30))
    points = rng.normal(0, 20, (n, 3))
    colors = rng.integers(0, 256, (n, 3), np.uint8) if colored else None
    faces = np.array([[k, (k + 1) % n, (k + 2) % n] for k in range(n)], np.int32)
    textures = [
        texture_from_array(rng.integers(0, 256, (5, 7, 3 + k % 2), np.uint8))
        for k in range(n_pages)
    ]
    uv = rng.random((n, 3, 2)).astype(np.float32) if n_pages else None
    pages = rng.integers(-1, n_pages, n).astype(np.int32) if n_pages else None
    mesh = Mesh(points, faces, colors, uv, pages, tuple(textures))
    origin = np.array([512345.25, 6012345.5, -20.0])
    survey = Survey("made", mesh, origin, crs="EPSG:32755")
    files = write(survey, folder / "a b.ply")
    assert len(files) == 2 + n_pages
    again = read(files[0], ReadOptions())
    assert again.crs == "EPSG:32755"
    np.testing.assert_allclose(absolute(again), points + origin, atol=1e-9)
    np.testing.assert_array_equal(again.geometry.faces, faces)
    for name in ("colors", "uv", "face_texture"):
        np.testing.assert_array_equal(getattr(again.geometry, name), getattr(mesh, name))
    for mine, theirs in zip(again.geometry.textures, textures, strict=True):
        np.testing.assert_array_equal(mine.load(), theirs.load())
    cloud = Survey("made", PointCloud(points, colors), origin)
    again = read(write(cloud, folder / "cloud.ply")[0], ReadOptions())
    np.testing.assert_allclose(absolute(again), points + origin, atol=1e-9)
    np.testing.assert_array_equal(again.geometry.colors, colors)
    slow = twin.decode((folder / "cloud.ply").read_bytes())["vertex"][1]
    np.testing.assert_allclose([row[:3] for row in slow], points + origin, atol=1e-9)


def test_maps_are_not_written_as_ply(tmp_path):
    from meshreg.records import Grid

    maps = Maps(np.zeros((2, 2), np.float32), Grid(0, 2, 1, (2, 2)))
    with pytest.raises(UsageError):
        write(Survey("dem", maps), tmp_path / "a.ply")


def test_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    from meshreg.errors import OutputError

    target = tmp_path / "b.ply"
    target.write_text("before")
    survey = read(ply(tmp_path / "a.ply", mesh_elements()), ReadOptions())
    monkeypatch.setattr("meshreg.io.ply.write._CHUNK", 2)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("meshreg.io.ply.write._copy", full)
    with pytest.raises(OutputError, match="No space left"):
        rewrite(survey.source[0], mover(survey), target)
    assert target.read_text() == "before"
    assert sorted(item.name for item in tmp_path.iterdir()) == ["a.ply", "b.ply"]


@pytest.mark.parametrize(
    ("face", "row"),
    [
        ([("area", "float")], [1.0]),
        ([("vertex_indices", "int")], [1]),
        ([("vertex_indices", ("uchar", "float"))], [[0.0, 1.0, 2.0]]),
    ],
)
def test_faces_without_a_list_of_vertices_are_refused(tmp_path, face, row):
    elements = [("vertex", XYZ, SQUARE), ("face", face, [row])]
    with pytest.raises(InputError, match="without a list 'vertex_indices' of integers"):
        read(ply(tmp_path / "a.ply", elements), ReadOptions())


def test_texcoord_that_is_no_list_and_colors_of_faces(tmp_path):
    page(tmp_path / "p.png", (1, 1, 1))
    face = [INDICES, ("texcoord", "float"), ("red", "uchar")]
    elements = [("vertex", XYZ, SQUARE), ("face", face, [[[0, 1, 2], 0.5, 9]])]
    path = ply(tmp_path / "a.ply", elements, comments=["TextureFile p.png"])
    with pytest.raises(InputError, match="'texcoord' that is not a list"):
        read(path, ReadOptions())
    survey = read(path, ReadOptions(geometry_only=True))
    assert "Colors of faces are not used" in survey.notes[0]


@pytest.mark.parametrize("order", ["", "<"])
def test_a_copy_that_does_not_read_back_is_not_kept(tmp_path, monkeypatch, order):
    """A disk that loses what is written must not leave a wrong survey behind."""
    from meshreg.errors import OutputError

    survey = read(ply(tmp_path / "a.ply", mesh_elements(), order=order), ReadOptions())
    monkeypatch.setattr("meshreg.io.ply.write.scalar_columns", _shifted_on_second_reading())
    with pytest.raises(OutputError, match="does not read back"):
        rewrite(survey.source[0], mover(survey), tmp_path / "b.ply")
    assert [item.name for item in tmp_path.iterdir()] == ["a.ply"]


def _shifted_on_second_reading():
    from meshreg.io.ply.body import scalar_columns

    calls = []

    def columns(table, names, dtype=None):
        calls.append(names)
        return scalar_columns(table, names, dtype) + (0.01 if len(calls) > 1 else 0.0)

    return columns
