"""The second reader passes what is right, and finds what a writer and its own reader agree on."""

from __future__ import annotations

import math

import laspy
import numpy as np
import pytest
import reference_ply as twin

from meshreg.errors import OutputError
from meshreg.io import read_survey, rewrite_survey, second_reader, write_survey
from meshreg.io.frames.mover import make_mover
from meshreg.io.las.write import _LOST
from meshreg.io.obj import write as obj_write
from meshreg.records import Mesh, PointCloud, Survey, Transform

C, S = math.cos(0.4), math.sin(0.4)
MOVE = Transform(np.array([[C, -S, 0], [S, C, 0], [0, 0, 1]]), offset=(3, -2, 1))
ROWS = 2000  # some of them are looked at


def moved_file(path, folder):
    """The survey's file, its moved copy, and what moved it."""
    survey = read_survey(path)
    source = survey.source[0]
    return rewrite_survey(survey, MOVE, folder)[0], make_mover(source, MOVE, source.frame)


def changed(path, old, new, at=0):
    data = path.read_bytes()
    assert old in data[at:]
    path.write_bytes(data[:at] + data[at:].replace(old, new, 1))


def obj_text():
    lines = ["# made by hand", "mtllib none.mtl", "o Reef one"]
    rng = np.random.default_rng(1)
    lines += ["v " + " ".join(f"{v:.4f}" for v in row) for row in rng.uniform(1, 9, (ROWS, 3))]
    lines += ["vn 1 0 0", "usemtl rock wall"]
    lines += [f"f {k} {k + 1} {k + 2}" for k in range(1, ROWS - 2)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"v 1", b"v 2"),  # a number
        (b"vn 0.92", b"vn 0.93"),
        (b"# made by hand", b"# made by"),
        (b"rock wall", b"rock"),  # a name that is cut at a blank
        (b"\nf 1 2 3\n", b"\nf 1 2 4\n"),
        (b"\nf 1 2 3\n", b"\n"),  # a line less
        (b"v ", b"v 1 "),
    ],
)
def test_lines_of_an_obj(tmp_path, old, new):
    (tmp_path / "a.obj").write_text(obj_text())
    path, move = moved_file(tmp_path / "a.obj", tmp_path / "out")
    rule = obj_write._line_rule(read_survey(tmp_path / "a.obj").source[0], move)
    second_reader._LINES, before = ROWS * 3, second_reader._LINES  # all of them
    try:
        second_reader.require_lines(tmp_path / "a.obj", path, rule, path)
        changed(path, old, new)
        with pytest.raises(OutputError, match="second reader"):
            second_reader.require_lines(tmp_path / "a.obj", path, rule, path)
    finally:
        second_reader._LINES = before


def test_the_beginning_the_middle_and_the_end_are_looked_at(tmp_path):
    for end in (b"\n", b"\r\n"):
        lines = [b"%d x" % k for k in range(5000)]
        (tmp_path / "a").write_bytes(end.join(lines) + end)
        for number in (0, 99, 2500, 4900, 4999):
            other = lines.copy()
            other[number] += b" y"
            (tmp_path / "b").write_bytes(end.join(other) + end)
            with pytest.raises(OutputError, match=rf"line {number + 1} differs"):
                second_reader.require_lines(
                    tmp_path / "a", tmp_path / "b", lambda words, number: None, tmp_path / "b"
                )


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_vertices_of_a_ply(tmp_path, order):
    rng = np.random.default_rng(2)
    properties = [("id", "int"), *((name, "float") for name in ("y", "x", "nx", "ny", "nz"))]
    properties += [("z", "double")]
    rows = [[k, *row] for k, row in enumerate(rng.uniform(1, 2, (ROWS, 6)).astype("f4").tolist())]
    elements = [("head", [("a", "short")], [[1], [2]]), ("vertex", properties, rows)]
    (tmp_path / "a.ply").write_bytes(twin.encode(elements, order))
    path, _ = moved_file(tmp_path / "a.ply", tmp_path / "out")

    def turned(values):
        """Move one vertex by hand."""
        x, y, z = (values[name] for name in "xyz")
        nx, ny, nz = (values[name] for name in ("nx", "ny", "nz"))
        return {
            "x": C * x - S * y + 3, "y": S * x + C * y - 2, "z": z + 1,
            "nx": C * nx - S * ny, "ny": S * nx + C * ny, "nz": nz,
        }  # fmt: skip

    second_reader.require_ply(tmp_path / "a.ply", path, turned, path)
    table = twin.decode(path.read_bytes())["vertex"][1]
    for column in range(7):
        table[ROWS // 2][column] += 1
        (tmp_path / "b.ply").write_bytes(
            twin.encode([elements[0], ("vertex", properties, table)], order)
        )
        with pytest.raises(OutputError, match="second reader"):
            second_reader.require_ply(tmp_path / "a.ply", tmp_path / "b.ply", turned, path)
        table[ROWS // 2][column] -= 1


def test_points_of_a_las(tmp_path):
    points = np.random.default_rng(3).uniform(0, 30, (ROWS, 3))
    survey = Survey("reef", PointCloud(points), (731_000, 5_705_000, 0))
    path = write_survey(survey, tmp_path / "a.las")[0]
    written, move = moved_file(path, tmp_path / "out")
    second_reader.require_las(path, written, move.points, _LOST, written)
    data = laspy.read(written)
    data.Y[ROWS - 1] += 2  # two tenths of a millimetre
    data.write(tmp_path / "b.las")
    with pytest.raises(OutputError, match=f"row {ROWS} differs"):
        second_reader.require_las(path, tmp_path / "b.las", move.points, _LOST, written)


def test_nodes_of_a_glb(tmp_path):
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 3, 1], [0, 3, 0]], float)
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    path = write_survey(Survey("reef", mesh), tmp_path / "a.glb")[0]
    written, move = moved_file(path, tmp_path / "out")
    second_reader.require_glb(path, written, move.matrix, written)
    wrong = move.matrix.copy()
    wrong[0, 3] += 1e-6
    with pytest.raises(OutputError, match="a node differs"):
        second_reader.require_glb(path, written, wrong, written)


def test_laszip_agrees_with_lazrs(tmp_path, monkeypatch):
    from meshreg.io.las import write as cloud_write

    if not laspy.LazBackend.Laszip.is_available():
        pytest.skip("laszip is not there")
    points = np.random.default_rng(3).uniform(0, 30, (ROWS, 3))
    survey = Survey("reef", PointCloud(points), (731_000, 5_705_000, 0))
    path = write_survey(survey, tmp_path / "a.laz")[0]
    data = laspy.read(path, laz_backend=laspy.LazBackend.Laszip)
    assert data.xyz == pytest.approx(points + survey.origin, abs=5.1e-5)
    monkeypatch.setattr(cloud_write, "_check", lambda *args: None)
    with pytest.raises(OutputError, match="LASzip"):
        cloud_write._look_by_laszip(path, path, (ROWS, 12345))


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".off", ".glb", ".xyz", ".las"])
def test_every_format_is_looked_at_by_a_second_reader(tmp_path, suffix, monkeypatch):

    rng = np.random.default_rng(5)
    points = rng.uniform(0, 9, (60, 3))
    faces = np.array([[k, k + 1, k + 2] for k in range(58)])
    cloud = suffix in (".xyz", ".las")
    survey = Survey("reef", PointCloud(points) if cloud else Mesh(points, faces))
    path = write_survey(survey, tmp_path / f"a{suffix}")[0]
    names = [name for name in dir(second_reader) if name.startswith("require_")]
    called = []
    for module in (
        "obj.write",
        "ply.write",
        "other.stl",
        "gltf.rewrite",
        "text.write",
        "las.write",
    ):
        loaded = __import__(f"meshreg.io.{module}", fromlist=["x"])
        for name in names:
            if hasattr(loaded, name):
                kept = getattr(loaded, name)
                monkeypatch.setattr(
                    loaded, name, lambda *a, kept=kept, **k: (called.append(1), kept(*a, **k))
                )
    if suffix == ".off":
        import trimesh.exchange.off as off

        kept_off = off.load_off
        monkeypatch.setattr(off, "load_off", lambda *a: (called.append(1), kept_off(*a))[1])
    moved_file(path, tmp_path / "out")
    assert called
