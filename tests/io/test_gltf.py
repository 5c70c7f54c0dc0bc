"""glTF: read against trimesh, refuse what it takes silently, move by a node."""

from __future__ import annotations

import base64
import io
import json
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from meshreg.errors import (
    InputError,
    OutputError,
    ResourceLimitError,
    UnsafeReferenceError,
    UsageError,
)
from meshreg.io.files.images import open_texture_bytes, texture_from_array
from meshreg.io.frames.place import make_mover
from meshreg.io.gltf.read import read
from meshreg.io.gltf.rewrite import rewrite
from meshreg.io.gltf.write import write
from meshreg.io.options import ReadOptions
from meshreg.records import Frame, Grid, Maps, Mesh, PointCloud, Survey, Transform

# A slope of the seafloor, Y-up as the format wants it: x east, y up, z south.
POINTS = np.array([[0, 0.5, 0], [4, 0.25, 0], [4, 0, -3], [0, 1, -3]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0.25]], np.float32)  # v downward
CODES = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "f": 5126}


class Made:
    """A small glTF encoder: append arrays, edit `tree`, get bytes."""

    def __init__(self):
        self.blob = b""
        self.tree = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "buffers": [{"byteLength": 0}],
            "bufferViews": [],
            "accessors": [],
        }

    def view(self, data, **more):
        self.blob += bytes(-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)} | more
        self.tree["bufferViews"].append(view)
        self.blob += data
        self.tree["buffers"][0]["byteLength"] = len(self.blob)
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, values, code, stride=0, **more):
        rows = [np.atleast_1d(row).tolist() for row in values]
        packed = [struct.pack("<" + code * len(row), *row) for row in rows]
        extra = {"byteStride": stride} if stride else {}
        data = b"".join(p.ljust(stride, b"\xee") for p in packed)
        width = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[len(rows[0])]
        self.tree["accessors"].append(
            {"bufferView": self.view(data, **extra), "componentType": CODES[code]}
            | {"count": len(rows), "type": width}
            | more
        )
        return len(self.tree["accessors"]) - 1

    def primitive(
        self, points=POINTS, faces=FACES, index_code="H", mesh=0, mode=None, **attributes
    ):
        primitive = {"attributes": {"POSITION": self.accessor(points, "f")} | attributes}
        if faces is not None:
            primitive["indices"] = self.accessor(np.ravel(faces), index_code)
        if mode is not None:
            primitive["mode"] = mode
        self.tree["meshes"][mesh]["primitives"].append(primitive)
        return primitive

    def texture(self, color, **image):
        """Add image, texture and material of one page; return the material's number."""
        if not image:
            stream = io.BytesIO()
            Image.new("RGB", (4, 2), color).save(stream, "PNG")
            image = {"bufferView": self.view(stream.getvalue()), "mimeType": "image/png"}
        for kind, item in (
            ("images", image),
            ("textures", {"source": len(self.tree.get("images", []))}),
            (
                "materials",
                {
                    "pbrMetallicRoughness": {
                        "baseColorTexture": {"index": len(self.tree.get("textures", []))}
                    }
                },
            ),
        ):
            self.tree.setdefault(kind, []).append(item)
        return len(self.tree["materials"]) - 1

    def glb(self, path, binary=True):
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        blob = self.blob + bytes(-len(self.blob) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        if binary:
            chunks += struct.pack("<II", len(blob), 0x004E4942) + blob
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path

    def gltf(self, path, uri="scene.bin"):
        self.tree["buffers"][0]["uri"] = uri
        if uri.replace("%20", " ").replace(" ", "").isidentifier() or uri == "scene.bin":
            (path.parent / uri.replace("%20", " ")).write_bytes(self.blob)
        path.write_text(json.dumps(self.tree))
        return path


def made(**options):
    scene = Made()
    scene.primitive(**options)
    return scene


def enu(points):
    """The format's axes as east, north, up: (x, -z, y)."""
    return np.asarray(points, float)[:, [0, 2, 1]] * [1, -1, 1]


def absolute(survey):
    return survey.geometry.points + survey.origin


def corners(survey):
    return absolute(survey)[survey.geometry.faces]


# What is read ------------------------------------------------------------------------------------


@pytest.mark.parametrize("index_code", ["B", "H", "I"])
def test_y_up_becomes_east_north_up(tmp_path, index_code):
    survey = read(made(index_code=index_code).glb(tmp_path / "a.glb"), ReadOptions())
    np.testing.assert_allclose(absolute(survey), enu(POINTS), atol=1e-6)
    np.testing.assert_array_equal(survey.geometry.faces, FACES)
    assert survey.source[0].format == "glb"
    assert survey.notes == ()


def test_shift_is_added_after_the_axes(tmp_path):
    path = made().glb(tmp_path / "a.glb")
    survey = read(path, ReadOptions(shift=(500000.0, 6000000.0, -20.0)))
    np.testing.assert_allclose(absolute(survey), enu(POINTS) + np.array([5e5, 6e6, -20]), atol=1e-6)


def test_tree_of_nodes_matrix_trs_and_instances(tmp_path):
    scene = made()
    half = np.sqrt(0.5)
    scene.tree["nodes"] = [
        {"children": [1, 2], "translation": [500000.25, 0, -6000000.5]},
        {"mesh": 0, "rotation": [0, half, 0, half], "scale": [2, 2, 2], "translation": [1, 2, 3]},
        {"children": [3]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 10, 20, 30, 1]},
    ]
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    turned = 2 * POINTS[:, [2, 1, 0]].astype(float) * [1, 1, -1] + [1, 2, 3]  # 90° about y
    expected = np.concatenate([turned, POINTS + np.array([10.0, 20, 30])])
    expected += np.array([500000.25, 0, -6000000.5])
    np.testing.assert_allclose(absolute(survey), enu(expected), atol=1e-6)
    assert survey.geometry.faces.tolist() == [*FACES.tolist(), *(FACES + 4).tolist()]


def test_mirroring_node_turns_the_faces(tmp_path):
    scene = made()
    scene.tree["nodes"][0]["scale"] = [-1, 1, 1]
    mirrored = corners(read(scene.glb(tmp_path / "a.glb"), ReadOptions()))
    normal = np.cross(mirrored[:, 1] - mirrored[:, 0], mirrored[:, 2] - mirrored[:, 0])
    assert (normal[:, 2] > 0).all()


@pytest.mark.parametrize("mode", [4, 5, 6, None])
@pytest.mark.parametrize("indexed", [True, False])
def test_lists_strips_and_fans(tmp_path, mode, indexed):
    order = {5: [0, 1, 3, 2], 6: [0, 1, 2, 3]}.get(mode, [0, 1, 2, 0, 2, 3])
    if indexed:
        scene = made(faces=order, mode=mode)
    else:
        scene = made(points=POINTS[order], faces=None, mode=mode)
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    found = {frozenset(map(tuple, t)) for t in np.round(corners(survey), 6).tolist()}
    faces = FACES if mode != 5 else np.array([[0, 1, 3], [3, 1, 2]])
    expected = enu(POINTS)[faces]
    assert found == {frozenset(map(tuple, t)) for t in np.round(expected, 6).tolist()}
    normals = np.cross(*(corners(survey)[:, k] - corners(survey)[:, 0] for k in (1, 2)))
    assert (normals[:, 2] > 0).all()


def test_points_are_a_cloud_and_are_left_out_beside_triangles(tmp_path):
    scene = made(faces=None, mode=0)
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    assert isinstance(survey.geometry, PointCloud)
    np.testing.assert_allclose(absolute(survey), enu(POINTS), atol=1e-6)
    scene.primitive()
    scene.primitive(faces=[0, 1], mode=1)
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    assert len(survey.geometry.faces) == 2
    assert survey.notes == (
        "1 primitives of lines were left out.",
        "1 primitives of points beside triangles were left out.",
    )


@pytest.mark.parametrize(
    ("code", "values", "normalized"),
    [
        ("B", [10, 20, 255], True),
        ("H", [10 * 257, 20 * 257, 65535], True),
        ("f", [10 / 255, 20 / 255, 1.0], False),
    ],
)
@pytest.mark.parametrize("alpha", [True, False])
def test_colors_of_vertices(tmp_path, code, values, normalized, alpha):
    scene = Made()
    rows = [[*values, values[-1]] if alpha else values] * 4
    color = scene.accessor(
        rows, code, stride={"B": 4, "H": 8, "f": 16}[code], normalized=normalized
    )
    scene.primitive(COLOR_0=color)
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    assert survey.geometry.colors.tolist() == [[10, 20, 255]] * 4


@pytest.mark.parametrize("stride", [0, 12, 16, 252])
def test_strides(tmp_path, stride):
    scene = Made()
    position = scene.accessor(POINTS, "f", stride=stride)
    scene.tree["meshes"][0]["primitives"] = [{"attributes": {"POSITION": position}, "mode": 0}]
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    np.testing.assert_allclose(absolute(survey), enu(POINTS), atol=1e-6)


def test_vertices_repeated_for_texture_seams_become_one(tmp_path):
    scene = made(points=POINTS[FACES.ravel()], faces=np.arange(6))
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    np.testing.assert_array_equal(survey.geometry.faces, FACES)
    assert survey.source[0].counts == {"vertices": 6, "faces": 2}


def textured():
    """Two primitives, each with a page of its own."""
    scene = Made()
    uv = scene.accessor(UV, "f")
    for k, color in enumerate([(255, 0, 0), (0, 0, 255)]):
        material = scene.texture(color)
        scene.primitive(faces=FACES[k], TEXCOORD_0=uv)["material"] = material
    return scene


def test_pages_and_texture_coordinates(tmp_path):
    survey = read(textured().glb(tmp_path / "a.glb"), ReadOptions())
    mesh = survey.geometry
    assert mesh.face_texture.tolist() == [0, 1]
    assert [tuple(t.load()[0, 0]) for t in mesh.textures] == [(255, 0, 0), (0, 0, 255)]
    np.testing.assert_array_equal(mesh.uv, (UV * np.float32([1, -1]) + np.float32([0, 1]))[FACES])
    assert read(tmp_path / "a.glb", ReadOptions(geometry_only=True)).geometry.uv is None


@pytest.mark.parametrize(("code", "top"), [("B", 255), ("H", 65535)])
def test_normalized_texture_coordinates(tmp_path, code, top):
    scene = Made()
    uv = scene.accessor(np.rint(UV * top).astype(int), code, stride=4, normalized=True)
    scene.primitive(TEXCOORD_0=uv)["material"] = scene.texture((9, 9, 9))
    mesh = read(scene.glb(tmp_path / "a.glb"), ReadOptions()).geometry
    down = np.stack([mesh.uv[..., 0], 1 - mesh.uv[..., 1]], axis=-1)
    np.testing.assert_allclose(down, UV[FACES], atol=0.5 / top + 1e-6)


def test_second_set_transform_and_clamp(tmp_path):
    scene = Made()
    uv = scene.accessor(UV, "f")
    material = scene.texture((9, 9, 9))
    info = scene.tree["materials"][material]["pbrMetallicRoughness"]["baseColorTexture"]
    info["texCoord"] = 1
    info["extensions"] = {"KHR_texture_transform": {"offset": [0.25, 0.5], "scale": [0.5, 0.25]}}
    scene.tree["samplers"] = [{"wrapS": 33071, "wrapT": 33071}]
    scene.tree["textures"][0]["sampler"] = 0
    scene.primitive(TEXCOORD_1=uv)["material"] = material
    mesh = read(scene.glb(tmp_path / "a.glb"), ReadOptions()).geometry
    expected = UV * [0.5, 0.25] + [0.25, 0.5]
    expected[:, 1] = 1 - expected[:, 1]
    np.testing.assert_allclose(mesh.uv, expected[FACES], atol=1e-7)
    assert mesh.textures[0].clamp


@pytest.mark.parametrize(
    "material",
    [
        {"emissiveTexture": {"index": 0}},
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}}},
    ],
)
def test_other_places_of_the_color_texture(tmp_path, material):
    scene = Made()
    scene.primitive(TEXCOORD_0=scene.accessor(UV, "f"))["material"] = scene.texture((7, 8, 9))
    scene.tree["materials"] = [material]
    scene.tree["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    mesh = read(scene.glb(tmp_path / "a.glb"), ReadOptions()).geometry
    assert tuple(mesh.textures[0].load()[0, 0]) == (7, 8, 9)


def test_turned_texture_is_refused_but_not_for_geometry(tmp_path):
    scene = textured()
    info = scene.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {"KHR_texture_transform": {"rotation": 0.5}}
    path = scene.glb(tmp_path / "a.glb")
    refuse(path, "turns its texture")
    assert len(read(path, ReadOptions(geometry_only=True)).geometry.faces) == 2


@pytest.mark.parametrize(("code", "normalized"), [("h", True), ("H", False), ("b", True)])
def test_quantized_positions(tmp_path, code, normalized):
    top = {"h": 32767, "H": 1, "b": 127}[code]
    whole = np.rint(np.abs(POINTS) * (10 if code == "H" else top / 4)).astype(int)
    scene = Made()
    position = scene.accessor(whole, code, stride={"b": 4}.get(code, 8), normalized=normalized)
    primitive = {
        "attributes": {"POSITION": position},
        "indices": scene.accessor(FACES.ravel(), "B"),
    }
    scene.tree["meshes"][0]["primitives"] = [primitive]
    scene.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    scene.tree["nodes"][0]["scale"] = [2, 3, 4]
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions(up="z"))
    np.testing.assert_allclose(absolute(survey), whole / top * [2, 3, 4], atol=1e-9)


def test_textures_beside_the_file_and_in_data_uris(tmp_path):
    Image.new("RGB", (3, 3), (1, 2, 3)).save(tmp_path / "my page.png")
    inline = base64.b64encode((tmp_path / "my page.png").read_bytes()).decode()
    scene = Made()
    uv = scene.accessor(UV, "f")
    for k, uri in enumerate(["my%20page.png", "data:image/png;base64," + inline, "gone.png"]):
        material = scene.texture(None, uri=uri)
        scene.primitive(
            faces=FACES[k % 2], points=POINTS + np.float32(5 * (k // 2)), TEXCOORD_0=uv
        )["material"] = material
    survey = read(scene.gltf(tmp_path / "a.gltf"), ReadOptions())
    assert survey.geometry.face_texture.tolist() == [0, 1, -1]
    assert [tuple(t.load()[0, 0]) for t in survey.geometry.textures] == [(1, 2, 3)] * 2
    assert "gone.png" in " ".join(survey.notes)
    names = [path.name for path in survey.source[0].companions]
    assert names == ["scene.bin", "my page.png"]
    assert survey.source[0].format == "gltf"


def test_buffer_in_a_data_uri(tmp_path):
    scene = made()
    uri = "data:application/octet-stream;base64," + base64.b64encode(scene.blob).decode()
    survey = read(scene.gltf(tmp_path / "a.gltf", uri), ReadOptions())
    np.testing.assert_allclose(absolute(survey), enu(POINTS), atol=1e-6)
    scene.gltf(tmp_path / "a.gltf", uri[:-5] + "!!")
    with pytest.raises(InputError, match="not base64"):
        read(tmp_path / "a.gltf", ReadOptions())


def slope(up, bumps=0.0):
    """A field of 8 by 6, thin along its axis `up`, facing it."""
    x, y = np.meshgrid(np.arange(9.0), np.arange(7.0))
    z = 0.1 * x + bumps * np.sin(2 * x) * np.cos(3 * y)
    points = np.stack([x, y, z] if up == "z" else [x, z, -y], axis=-1).reshape(-1, 3)
    i = np.arange(63).reshape(7, 9)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def test_plainly_z_up_is_read_so_and_told(tmp_path):
    points, faces = slope("z", 0.3)
    path = made(points=points, faces=faces).glb(tmp_path / "a.glb")
    survey = read(path, ReadOptions())
    np.testing.assert_allclose(absolute(survey), points, atol=1e-6)
    assert "read as z up" in survey.notes[0]
    survey = read(path, ReadOptions(up="y"))
    np.testing.assert_allclose(absolute(survey), enu(points), atol=1e-6)
    assert survey.notes == ()
    (tmp_path / "a.survey.toml").write_text('up = "y"\n')
    np.testing.assert_allclose(absolute(read(path, ReadOptions())), enu(points), atol=1e-6)


@pytest.mark.parametrize("bumps", [0.0, 0.3, 1.5])
def test_y_up_is_not_taken_for_z_up(tmp_path, bumps):
    points, faces = slope("y", bumps)
    path = made(points=points, faces=faces).glb(tmp_path / "a.glb")
    survey = read(path, ReadOptions())
    np.testing.assert_allclose(absolute(survey), enu(points), atol=1e-6)
    assert survey.notes == ()
    survey = read(path, ReadOptions(up="z"))
    np.testing.assert_allclose(absolute(survey), points, atol=1e-6)


def test_agrees_with_trimesh_where_that_reads_right(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    scene = textured()
    scene.tree["nodes"] = [
        {"children": [1, 2]},
        {"mesh": 0, "rotation": [0.1, 0.2, 0.3, np.sqrt(0.86)], "scale": [2, 3, 4]},
        {"mesh": 0, "translation": [10, 20, 30], "scale": [-1, 1, 1]},
    ]
    path = scene.glb(tmp_path / "a.glb")
    mine = read(path, ReadOptions(up="y"))
    theirs = trimesh.load_scene(path)
    triangles = np.concatenate(
        [enu(t.reshape(-1, 3)).reshape(-1, 3, 3) for t in [theirs.triangles]]
    )

    def centres(t):
        found = t.mean(axis=1)
        return found[np.lexsort(np.round(found, 4).T)]

    np.testing.assert_allclose(centres(corners(mine)), centres(triangles), atol=1e-5)
    other = next(iter(theirs.geometry.values()))
    np.testing.assert_allclose(other.visual.uv, UV * [1, -1] + [0, 1], atol=1e-6)
    assert mine.geometry.uv[0].tolist() == (UV * [1, -1] + [0, 1])[FACES[0]].tolist()


# What is refused ---------------------------------------------------------------------------------


def refuse(path, message, error=InputError, **options):
    with pytest.raises(error, match=message) as raised:
        read(path, ReadOptions(**options))
    return raised.value


def test_every_truncation_of_a_glb_is_refused(tmp_path):
    whole = textured().glb(tmp_path / "a.glb").read_bytes()
    for size in range(0, len(whole), 7):
        (tmp_path / "b.glb").write_bytes(whole[:size])
        refuse(tmp_path / "b.glb", "empty|ends|length|JSON|glTF")


def test_lengths_must_be_exact(tmp_path):
    whole = bytearray(made().glb(tmp_path / "a.glb").read_bytes())
    path = tmp_path / "b.glb"
    path.write_bytes(whole + b"\0\0\0\0")
    assert refuse(path, "declares a length").place == "byte 8"
    for at, value, message in (
        (4, 1, "GLB version 1"),
        (8, len(whole) + 4, "declares a length"),
        (12, len(whole), "chunk of"),
        (12, 2**32 - 4, "chunk of"),
        (16, 0x004E4942, "does not start with a JSON chunk"),
    ):
        broken = whole.copy()
        broken[at : at + 4] = struct.pack("<I", value)
        path.write_bytes(broken)
        refuse(path, message)


def edit(*keys, **change):
    """Return a function that changes one object of the JSON."""

    def apply(tree):
        place = tree
        for key in keys:
            place = place[key]
        for key, value in change.items():
            if value is ...:
                del place[key]
            else:
                place[key] = value

    return apply


BROKEN = [
    (edit("asset", version="1.0"), "glTF version 1.0"),
    (edit("asset", version="3.0"), "glTF version 3.0"),
    (edit("asset", minVersion="2.1"), "glTF version"),
    (edit(asset=...), "glTF version none"),
    (edit(scenes=[{"nodes": [7]}]), r"nodes\[7\] of 1"),
    (edit(scene=3), r"scenes\[3\] of 1"),
    (edit(scenes=[{"nodes": []}]), "shows no triangles"),
    (edit(nodes=[{"mesh": 5}]), r"meshes\[5\]"),
    (edit(nodes=[{"mesh": True}]), r"meshes\[True\]"),
    (edit(nodes="x"), "not a list of objects"),
    (edit(nodes=[{"mesh": 0, "children": [0]}]), "reached twice"),
    (edit(nodes=[{"children": [1, 2]}, {"children": [2]}, {"mesh": 0}]), "reached twice"),
    (edit(nodes=[{"mesh": 0, "children": "no"}]), "children"),
    (edit("nodes", 0, matrix=[1] * 15), "not 16 numbers"),
    (edit("nodes", 0, matrix=[1.0] * 16), "not affine"),
    (edit("nodes", 0, matrix=[1e305] + [0] * 15), "not 16 numbers"),
    (edit("nodes", 0, matrix=[1e400] + [0] * 15), "Infinity is not a JSON number"),
    (edit("nodes", 0, rotation=[0, 0, 0, 0]), "rotation of length 0"),
    (edit("nodes", 0, translation=["a", 0, 0]), "not 3 numbers"),
    (edit("nodes", 0, skin=0), "skinned"),
    (edit("meshes", 0, primitives=[{"attributes": {}}]), "no POSITION"),
    (edit("meshes", 0, "primitives", 0, mode=9), "mode 9"),
    (edit("meshes", 0, "primitives", 0, indices=9), r"accessors\[9\] of 2"),
    (edit("accessors", 0, count=5), "declares 5 elements of 12 bytes"),
    (edit("accessors", 0, count=-4), "not a count"),
    (edit("accessors", 0, count=4.0), "not a count"),
    (edit("accessors", 0, count=2**40), "declares 1099511627776 elements|repeating"),
    (edit("accessors", 0, byteOffset=4), "from byte 4"),
    (edit("accessors", 0, componentType=5124), "component type 5124"),
    (edit("accessors", 0, type="MAT4"), "holds MAT4"),
    (edit("accessors", 0, type="VEC2"), "holds VEC2"),
    (edit("accessors", 0, bufferView=...), "no bufferView"),
    (edit("accessors", 0, sparse={"count": 1}), "sparse"),
    (edit("accessors", 0, bufferView=7), r"bufferViews\[7\]"),
    (edit("accessors", 0, componentType=5123, type="VEC3"), "positions of type uint16"),
    (edit("accessors", 1, componentType=5126, count=3), "indices of type float32"),
    (edit("accessors", 1, count=5), "no whole triangles"),
    (edit("bufferViews", 0, byteLength=1 << 40), "ends at byte"),
    (edit("bufferViews", 0, byteOffset=1 << 40), "ends at byte"),
    (edit("bufferViews", 0, byteStride=1), "byteStride 1"),
    (edit("bufferViews", 0, byteStride=8), "every 8"),
    (edit("bufferViews", 0, byteStride=256), "byteStride 256"),
    (edit("bufferViews", 0, buffer=1), r"buffers\[1\]"),
    (edit("buffers", 0, byteLength=1 << 40), "declares 1099511627776 bytes"),
    (edit("buffers", 0, byteLength="10"), "not a count"),
    (edit(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco.*without compression"),
    (edit(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt"),
    (edit(extensionsRequired=["VENDOR_secret"]), "VENDOR_secret"),
    (edit(extensionsRequired="KHR_x"), "not a list"),
    (
        edit("meshes", 0, "primitives", 0, extensions={"KHR_draco_mesh_compression": {}}),
        "Draco|draco",
    ),
]


@pytest.mark.parametrize(("change", "message"), BROKEN)
def test_broken_trees_are_refused_by_name(tmp_path, change, message):
    scene = made()
    change(scene.tree)
    error = refuse(scene.glb(tmp_path / "a.glb"), message, (InputError, ResourceLimitError))
    assert error.file == str(tmp_path / "a.glb")
    assert error.remedy


@pytest.mark.parametrize("index_code", ["B", "H", "I"])
def test_indices_out_of_range_are_refused_with_the_face(tmp_path, index_code):
    bad = {"B": 77, "H": 7777, "I": 77777}[index_code]
    scene = made(faces=[0, 1, 2, 0, bad, 3], index_code=index_code)
    error = refuse(scene.glb(tmp_path / "a.glb"), f"vertex {bad} of 4")
    assert "face 2" in error.place


def test_accessor_bomb_asks_for_no_memory(tmp_path):
    import tracemalloc

    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "count": 2_000_000_000, "type": "VEC3"}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A)
    path = tmp_path / "bomb.glb"
    path.write_bytes(head + text)
    assert path.stat().st_size < 700
    tracemalloc.start()
    refuse(path, "no bufferView|repeating", (InputError, ResourceLimitError))
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


def test_instance_bomb_is_a_resource_limit(tmp_path):
    points, faces = slope("y")
    scene = made(points=points, faces=faces)
    scene.tree["nodes"] = [{"mesh": 0} for _ in range(20_000)]
    scene.tree["scenes"] = [{"nodes": list(range(20_000))}]
    refuse(scene.glb(tmp_path / "a.glb"), "by repeating", ResourceLimitError)


@pytest.mark.parametrize("depth", [64, 65])
def test_depth_of_the_tree_is_capped(tmp_path, depth):
    scene = made()
    scene.tree["nodes"] = [{"children": [k + 1]} for k in range(depth - 1)] + [{"mesh": 0}]
    path = scene.glb(tmp_path / "a.glb")
    if depth == 64:
        assert len(read(path, ReadOptions()).geometry.faces) == 2
    else:
        refuse(path, "64 levels")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"[" * 200_000 + b"]" * 200_000, "nested too deeply"),
        (b'{"asset": NaN}', "NaN"),
        (b'{"asset": ', "cannot be read"),
        (b"[]", "not an object"),
        (b"\xff\xfe{\0}\0", "cannot be read"),
        (b'{"a": ' + b"9" * 5000 + b"}", "cannot be read"),
    ],
)
def test_json_that_is_none(tmp_path, text, message):
    (tmp_path / "a.gltf").write_bytes(text)
    refuse(tmp_path / "a.gltf", message)


@pytest.mark.parametrize(
    "uri",
    [
        "http://x.y/scene.bin",
        "file:///etc/hostname",
        "../scene.bin",
        "/etc/hostname",
        "%2e%2e/scene.bin",
    ],
)
def test_uris_outside_the_folder_are_refused(tmp_path, uri):
    folder = tmp_path / "survey"
    folder.mkdir()
    scene = made()
    (tmp_path / "scene.bin").write_bytes(scene.blob)
    refuse(scene.gltf(folder / "a.gltf", uri), "reference", UnsafeReferenceError)
    scene = Made()
    scene.primitive(TEXCOORD_0=scene.accessor(UV, "f"))["material"] = scene.texture(None, uri=uri)
    path = scene.glb(folder / "a.glb")
    refuse(path, "reference", UnsafeReferenceError)
    assert read(path, ReadOptions(geometry_only=True)).geometry.uv is None


def test_missing_buffer_is_refused(tmp_path):
    path = made().gltf(tmp_path / "a.gltf")
    (tmp_path / "scene.bin").unlink()
    refuse(path, "scene.bin.*not there")


def test_broken_and_huge_images(tmp_path):
    scene = Made()
    uv = scene.accessor(UV, "f")
    material = scene.texture(None, bufferView=scene.view(b"no picture"), mimeType="image/png")
    scene.primitive(TEXCOORD_0=uv)["material"] = material
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    assert survey.geometry.uv is None
    assert "gives no color" in survey.notes[0]
    refuse(textured().glb(tmp_path / "b.glb"), "pixels", ResourceLimitError, max_pixels=7)
    scene.tree["images"][0]["bufferView"] = 99
    refuse(scene.glb(tmp_path / "c.glb"), r"bufferViews\[99\]")


def test_texture_without_its_coordinates_is_refused(tmp_path):
    scene = Made()
    scene.primitive()["material"] = scene.texture((1, 1, 1))
    refuse(scene.glb(tmp_path / "a.glb"), "no TEXCOORD_0")
    scene = Made()
    short = scene.accessor(UV[:3], "f")
    scene.primitive(TEXCOORD_0=short)["material"] = scene.texture((1, 1, 1))
    refuse(scene.glb(tmp_path / "a.glb"), "4 positions, but 3 of TEXCOORD_0")


def test_vertices_that_are_not_finite(tmp_path):
    points, faces = slope("y")
    points = np.concatenate([*(points + k for k in range(4)), [[np.nan, 0, 0]]])
    faces = np.concatenate([faces, [[0, 1, len(points) - 1]]])
    survey = read(made(points=points, faces=faces).glb(tmp_path / "a.glb"), ReadOptions())
    assert len(survey.geometry.faces) == len(faces) - 1
    assert np.isfinite(survey.bounds).all()
    bad = POINTS.copy()
    bad[0, 0] = np.inf
    refuse(made(points=bad).glb(tmp_path / "b.glb"), "not finite")


def places(value):
    """All containers in a JSON tree, with their keys."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, below in list(items):
        yield value, key
        if isinstance(below, (dict, list)):
            yield from places(below)


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_no_odd_value_brings_anything_but_an_error_or_a_mesh(tmp_path_factory, data):
    scene = textured()
    scene.tree["nodes"] = [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0}]
    scene.tree["samplers"] = [{"wrapS": 33071}]
    scene.tree["textures"][0]["sampler"] = 0
    odd = st.sampled_from(
        [None, True, -1, 0, 1, 2, 99, 2**40, 1.5, "x", [], {}, [1], [[]], {"a": 1}]
    )
    for _ in range(data.draw(st.integers(1, 2))):
        owner, key = data.draw(st.sampled_from(list(places(scene.tree))))
        owner[key] = data.draw(odd)
    path = scene.glb(tmp_path_factory.mktemp("odd") / "a.glb")
    try:
        survey = read(path, ReadOptions())
        assert np.isfinite(survey.bounds).all()
        rewrite(survey.source[0], mover(survey), path.with_name("b.glb"))
    except (InputError, ResourceLimitError):
        pass


def test_no_mutation_brings_anything_but_an_error_or_a_mesh(tmp_path):
    rng = np.random.default_rng(2)
    whole = textured().glb(tmp_path / "a.glb").read_bytes()
    path = tmp_path / "b.glb"
    for _ in range(400):
        content = bytearray(whole)
        for at in rng.integers(20, len(content), rng.integers(1, 4)):
            content[at] = rng.integers(0, 256)
        path.write_bytes(content)
        try:
            survey = read(path, ReadOptions())
        except (InputError, ResourceLimitError):
            continue
        assert np.isfinite(survey.bounds).all()


# What is written ---------------------------------------------------------------------------------

TURN = Transform(
    np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]), 1.25, (10.5, -20.25, 3), (1, 1, 0)
)


def mover(survey, transform=TURN, target=None):
    source = survey.source[0]
    return make_mover(source, transform, target or source.frame)


def parse(path):
    content = path.read_bytes()
    length = struct.unpack("<I", content[12:16])[0]
    return json.loads(content[20 : 20 + length]), content[20 + length :]


def test_rewrite_adds_one_node_and_keeps_all_bytes(tmp_path):
    scene = textured()
    scene.tree["nodes"] = [{"mesh": 0, "name": "reef", "translation": [1, 2, 3]}]
    scene.tree["extras"] = {"station": 7}
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    (written,) = rewrite(survey.source[0], mover(survey), tmp_path / "b.glb")
    old, old_rest = parse(tmp_path / "a.glb")
    new, new_rest = parse(written)
    assert new_rest == old_rest
    assert new["nodes"][0] == old["nodes"][0]
    assert len(new["nodes"]) == 2
    assert new["scenes"] == [{"nodes": [1]}]
    assert new["nodes"][1]["children"] == [0]
    for key in ("extras", "materials", "images", "accessors", "bufferViews", "meshes", "asset"):
        assert new[key] == old[key]
    again = read(written, ReadOptions())
    np.testing.assert_allclose(absolute(again), TURN.apply(absolute(survey)), atol=1e-9)
    np.testing.assert_array_equal(again.geometry.uv, survey.geometry.uv)
    np.testing.assert_array_equal(
        again.geometry.textures[1].load(), survey.geometry.textures[1].load()
    )


def test_rewritten_file_is_where_trimesh_expects_it(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    survey = read(textured().glb(tmp_path / "a.glb"), ReadOptions())
    written = rewrite(survey.source[0], mover(survey), tmp_path / "b.glb")[0]
    theirs = enu(trimesh.load_scene(written).triangles.reshape(-1, 3)).reshape(-1, 3, 3)
    mine = TURN.apply(absolute(survey))[survey.geometry.faces]
    np.testing.assert_allclose(
        np.sort(theirs.mean(axis=1), axis=0), np.sort(mine.mean(axis=1), axis=0), atol=1e-5
    )


@pytest.mark.parametrize("up", ["y", "z"])
def test_there_and_back_and_by_nothing(tmp_path, up):
    """The registered file keeps its own axes, whichever they were."""
    points, faces = slope(up, 0.2)
    scene = made(points=points, faces=faces)
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions(up=up))
    there = rewrite(survey.source[0], mover(survey), tmp_path / "there.glb")[0]
    moved = read(there, ReadOptions(up=up))
    np.testing.assert_allclose(absolute(moved), TURN.apply(absolute(survey)), atol=1e-9)
    back = rewrite(moved.source[0], mover(moved, TURN.inverse()), tmp_path / "back.glb")[0]
    again = read(back, ReadOptions(up=up))
    np.testing.assert_allclose(absolute(again), absolute(survey), atol=1e-9)
    same = rewrite(survey.source[0], mover(survey, Transform()), tmp_path / "same.glb")[0]
    np.testing.assert_array_equal(absolute(read(same, ReadOptions(up=up))), absolute(survey))


def test_utm_offset_stays_exact_in_the_node(tmp_path):
    survey = read(made().glb(tmp_path / "a.glb"), ReadOptions())
    far = Transform(offset=(512345.6789, 6012345.6789, -20.125))
    written = rewrite(survey.source[0], mover(survey, far), tmp_path / "b.glb")[0]
    again = read(written, ReadOptions())
    np.testing.assert_allclose(absolute(again), far.apply(absolute(survey)), atol=2e-9)


def test_rewrite_of_a_gltf_copies_what_it_names(tmp_path):
    Image.new("RGB", (3, 3), (1, 2, 3)).save(tmp_path / "page.png")
    scene = Made()
    uv = scene.accessor(UV, "f")
    scene.primitive(TEXCOORD_0=uv)["material"] = scene.texture(None, uri="page.png")
    scene.tree["scenes"] = [{"nodes": [0]}, {"nodes": [0], "name": "same again"}]
    survey = read(scene.gltf(tmp_path / "a.gltf"), ReadOptions())
    (tmp_path / "out").mkdir()
    files = rewrite(survey.source[0], mover(survey), tmp_path / "out" / "b.gltf")
    assert [file.name for file in files] == ["b.gltf", "scene.bin", "page.png"]
    tree = json.loads(files[0].read_text())
    assert [s["nodes"] for s in tree["scenes"]] == [[1], [1]]
    again = read(files[0], ReadOptions())
    np.testing.assert_allclose(absolute(again), TURN.apply(absolute(survey)), atol=1e-9)
    assert tuple(again.geometry.textures[0].load()[0, 0]) == (1, 2, 3)


def test_scenes_may_be_missing(tmp_path):
    scene = made()
    del scene.tree["scenes"], scene.tree["scene"]
    scene.tree["nodes"] = [{"mesh": 0}, {"children": [0]}, {"children": []}]
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    assert len(survey.geometry.faces) == 2
    written = rewrite(survey.source[0], mover(survey), tmp_path / "b.glb")[0]
    again = read(written, ReadOptions())
    np.testing.assert_allclose(absolute(again), TURN.apply(absolute(survey)), atol=1e-9)


def test_what_one_matrix_cannot_do_is_refused(tmp_path):
    points, faces = slope("y")
    scene = made(points=points * 5000, faces=faces)
    path = scene.glb(tmp_path / "a.glb")
    survey = read(path, ReadOptions(shift=(500000.0, 6000000.0, 0.0), crs="EPSG:32755"))
    source = survey.source[0]
    target = Frame(source.frame.axes, np.zeros(3), "EPSG:32754", "EPSG:32755")
    move = make_mover(source, Transform(), target, centre=points.mean(axis=0) * 5000)
    with pytest.raises(InputError, match=r"bent by .* m on its way") as raised:
        rewrite(source, move, tmp_path / "b.glb")
    assert ".ply" in raised.value.remedy
    assert not (tmp_path / "b.glb").exists()


def test_rewrite_refuses_itself_and_a_changed_source(tmp_path):
    path = made().glb(tmp_path / "a.glb")
    survey = read(path, ReadOptions())
    with pytest.raises(UsageError, match="itself"):
        rewrite(survey.source[0], mover(survey), path)
    path.write_bytes(path.read_bytes() + b"\0\0\0\0")
    with pytest.raises(InputError, match="changed"):
        rewrite(survey.source[0], mover(survey), tmp_path / "b.glb")


@given(st.integers(0, 2**32 - 1), st.booleans(), st.integers(0, 3))
@settings(max_examples=25, deadline=None)
def test_what_is_written_reads_back_the_same(tmp_path_factory, seed, colored, n_pages):
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("gltf")
    n = int(rng.integers(5, 30))
    points = np.unique(rng.normal(0, 20, (n, 3)), axis=0)
    colors = rng.integers(0, 256, (n, 3), np.uint8) if colored else None
    faces = np.array([[k, (k + 1) % n, (k + 2) % n] for k in range(n)], np.int32)
    textures = [
        texture_from_array(rng.integers(0, 256, (5, 7, 3 + k % 2), np.uint8), clamp=k == 1)
        for k in range(n_pages)
    ]
    uv = rng.random((n, 3, 2)).astype(np.float32) if n_pages else None
    pages = rng.integers(-1, n_pages, n).astype(np.int32) if n_pages else None
    origin = np.array([512345.25, 6012345.5, -20.0])
    survey = Survey("made", Mesh(points, faces, colors, uv, pages, tuple(textures)), origin)
    (written,) = write(survey, folder / "a.glb")
    again = read(written, ReadOptions())
    order = np.argsort(pages, kind="stable") if n_pages else np.arange(n)
    np.testing.assert_allclose(corners(again), (points + origin)[faces[order]], atol=2e-5)
    if colored:
        np.testing.assert_array_equal(
            again.geometry.colors[again.geometry.faces], colors[faces[order]]
        )
    if n_pages and (pages >= 0).any():
        np.testing.assert_allclose(
            again.geometry.uv[pages[order] >= 0], uv[order][pages[order] >= 0], atol=1e-7
        )
        for face, page in zip(again.geometry.face_texture, pages[order], strict=True):
            assert (face < 0) == (page < 0)
            if face >= 0:
                mine, theirs = again.geometry.textures[face], textures[page]
                np.testing.assert_array_equal(mine.load(), theirs.load())
                assert mine.clamp == theirs.clamp
    cloud = Survey("made", PointCloud(points, colors), origin, crs="EPSG:32755")
    files = write(cloud, folder / "cloud.glb")
    again = read(files[0], ReadOptions())
    assert again.crs == "EPSG:32755"
    np.testing.assert_allclose(absolute(again), points + origin, atol=2e-5)
    np.testing.assert_array_equal(again.geometry.colors, colors)


def test_written_file_is_valid_for_trimesh_and_keeps_a_jpeg(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    stream = io.BytesIO()
    Image.new("RGB", (8, 8), (200, 100, 50)).save(stream, "JPEG")
    texture = open_texture_bytes(stream.getvalue(), "page.jpg", 10**6)
    points, faces = slope("z", 0.3)
    uv = (points[faces][..., :2] / 8).astype(np.float32)
    mesh = Mesh(points, faces, None, uv, np.zeros(len(faces), np.int32), (texture,))
    written = write(Survey("made", mesh, np.array([100.0, 200.0, 5.0])), tmp_path / "a.glb")[0]
    scene = trimesh.load_scene(written)
    np.testing.assert_allclose(
        np.sort(enu(scene.triangles.mean(axis=1)), axis=0),
        np.sort(points[faces].mean(axis=1) + np.array([100, 200, 5]), axis=0),
        atol=1e-4,
    )
    assert stream.getvalue() in written.read_bytes()
    tree, _ = parse(written)
    assert tree["images"][0]["mimeType"] == "image/jpeg"
    for item in tree["accessors"]:
        assert tree["bufferViews"][item["bufferView"]]["byteOffset"] % 4 == 0
    np.testing.assert_array_equal(tree["nodes"][0]["translation"], [100, 5, -200])


def test_maps_are_not_written_and_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    maps = Maps(np.zeros((2, 2), np.float32), Grid(0, 2, 1, (2, 2)))
    with pytest.raises(UsageError):
        write(Survey("dem", maps), tmp_path / "a.glb")
    target = tmp_path / "b.glb"
    target.write_text("before")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("meshreg.io.gltf.write._write_glb", full)
    with pytest.raises(OutputError, match="No space"):
        write(Survey("cloud", PointCloud(POINTS)), target)
    assert target.read_text() == "before"
    assert [item.name for item in tmp_path.iterdir()] == ["b.glb"]


def test_a_copy_that_does_not_read_back_is_not_kept(tmp_path, monkeypatch):
    from meshreg.io.gltf.parts import read_geometry

    calls = []

    def shifted(document):
        calls.append(1)
        return read_geometry(document) + (0.01 if len(calls) > 1 else 0.0)

    survey = read(made().glb(tmp_path / "a.glb"), ReadOptions())
    monkeypatch.setattr("meshreg.io.gltf.rewrite.read_geometry", shifted)
    with pytest.raises(OutputError, match=r"does not read back.*off by up to 0.01"):
        rewrite(survey.source[0], mover(survey), tmp_path / "b.glb")
    assert [item.name for item in tmp_path.iterdir()] == ["a.glb"]


def test_glb_without_its_binary_chunk_is_refused(tmp_path):
    refuse(made().glb(tmp_path / "a.glb", binary=False), "no uri and no BIN chunk")


def test_primitives_with_and_without_colors(tmp_path):
    scene = Made()
    color = scene.accessor([[9, 8, 7, 255]] * 4, "B", normalized=True)
    scene.primitive(faces=FACES[0], COLOR_0=color)
    scene.primitive(faces=FACES[1])
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    found = survey.geometry.colors[survey.geometry.faces]
    assert found.tolist() == [[[9, 8, 7]] * 3, [[255] * 3] * 3]
    assert survey.notes[0] == "1 of 2 primitives have no colors; left white."


def test_mirrored_repetition_is_told(tmp_path):
    scene = textured()
    scene.tree["samplers"] = [{"wrapS": 33648}]
    scene.tree["textures"][1]["sampler"] = 0
    survey = read(scene.glb(tmp_path / "a.glb"), ReadOptions())
    assert "repeats mirrored" in survey.notes[0]
