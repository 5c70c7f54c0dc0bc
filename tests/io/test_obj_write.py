"""Wavefront OBJ: surveys written and read back, and moved copies that keep every other byte."""

from __future__ import annotations

import os
import re
import resource
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from PIL import Image

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.files import line_blocks
from meshreg.io.files.images import open_texture, texture_from_array
from meshreg.io.frames.mover import make_mover
from meshreg.io.obj import write as obj_write
from meshreg.io.obj import write_kernels as obj_write_kernels
from meshreg.io.obj.read import read
from meshreg.io.obj.write import rewrite, write
from meshreg.io.options import ReadOptions
from meshreg.records import Frame, Grid, Maps, Mesh, PointCloud, Survey, Transform

FILE_CASES = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
TURN = Transform(
    rotation=np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]),
    scale=1.25,
    offset=np.array([13.4, -8.7, 1.25]),
    pivot=np.array([2.0, 3.0, 0.0]),
)


def opened(path):
    return read(path, ReadOptions())


def absolute(survey):
    return survey.geometry.points + survey.origin


def grid_mesh(rows, cols, seed=0, **parts):
    """A rough sheet in which every vertex is used and no face repeats."""
    rng = np.random.default_rng(seed)
    north, east = np.mgrid[0:rows, 0:cols]
    points = np.dstack([east, north, rng.normal(size=(rows, cols))]).reshape(-1, 3) / 7
    first = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).reshape(-1, 1)
    faces = np.concatenate([first + np.array([0, 1, cols]), first + np.array([1, cols + 1, cols])])
    return Mesh(points, faces, **parts)


# Writing from memory.


@FILE_CASES
@given(
    rows=st.integers(2, 9),
    seed=st.integers(0, 2**31),
    pages=st.integers(0, 3),
    colored=st.booleans(),
    size=st.sampled_from([1e-3, 1.0, 300.0, 1e5]),
    origin=st.sampled_from([(0, 0, 0), (731000, 5705000, -12), (-3.5, 0, 0)]),
)
def test_what_is_written_is_read_back(tmp_path, rows, seed, pages, colored, size, origin):
    rng = np.random.default_rng(seed)
    sheet = grid_mesh(rows, 4, seed)
    n_faces = len(sheet.faces)
    shades = [rng.integers(0, 256, (3, 5, 3 + k % 2), np.uint8) for k in range(pages)]
    face_texture = np.append(0, rng.integers(-1, pages, n_faces - 1)) if pages else None
    uv = rng.random((n_faces, 3, 2)).astype(np.float32) if pages else None
    if pages:
        uv[1] = uv[0]
        uv[face_texture < 0] = 0
    mesh = Mesh(
        sheet.vertices * size,
        sheet.faces,
        rng.integers(0, 256, (len(sheet.vertices), 3), np.uint8) if colored else None,
        uv,
        face_texture,
        tuple(texture_from_array(shade) for shade in shades),
    )
    survey = Survey("reef", mesh, np.array(origin, float))
    path = tmp_path / f"out_{seed}_{rows}" / "a reef.obj"
    path.parent.mkdir(exist_ok=True)
    for old in path.parent.iterdir():
        old.unlink()
    written = write(survey, path)
    assert set(written) == set(path.parent.iterdir())
    again = opened(path)
    # A hundred-millionth of the extent, or a micrometre where that is finer; both are halved.
    step = min(1e-6, 1e-8 * np.ptp(mesh.vertices, axis=0).max() * 10)
    assert np.abs(absolute(again) - absolute(survey)).max() <= step / 2 + 1e-9 * (origin[1] > 1e6)
    np.testing.assert_array_equal(again.geometry.faces, mesh.faces)
    if colored:
        np.testing.assert_array_equal(again.geometry.colors, mesh.colors)
    else:
        assert again.geometry.colors is None
    if pages:
        textures = again.geometry.textures
        np.testing.assert_allclose(again.geometry.uv, uv, rtol=0, atol=1e-9)
        back = again.geometry.face_texture
        np.testing.assert_array_equal(back < 0, face_texture < 0)
        for page, other in zip(face_texture, back, strict=True):
            if page >= 0:
                assert textures[other].size == (5, 3)
                np.testing.assert_array_equal(textures[other].load(), shades[page])
    else:
        assert again.geometry.uv is None


def test_a_cloud_is_read_back(tmp_path):
    rng = np.random.default_rng(1)
    cloud = PointCloud(rng.normal(size=(50, 3)) * 30, rng.integers(0, 256, (50, 3), np.uint8))
    survey = Survey("cloud", cloud, np.array([10.0, 20.0, 30.0]))
    path = tmp_path / "cloud.obj"
    assert write(survey, path) == (path, tmp_path / "cloud_offset.xyz")
    again = opened(path)
    assert isinstance(again.geometry, PointCloud)
    np.testing.assert_allclose(absolute(again), absolute(survey), rtol=0, atol=6e-7)
    np.testing.assert_array_equal(again.geometry.colors, cloud.colors)


def test_more_rows_than_are_written_at_once(tmp_path, monkeypatch):
    mesh = grid_mesh(30, 40)
    pages = np.arange(len(mesh.faces)) % 3 - 1
    uv = np.random.default_rng(2).random((len(mesh.faces), 3, 2)).astype(np.float32)
    uv[pages < 0] = 0
    textures = tuple(texture_from_array(np.full((2, 2, 3), k, np.uint8)) for k in (1, 2))
    mesh = Mesh(mesh.vertices, mesh.faces, None, uv, pages, textures)
    write(Survey("reef", mesh), tmp_path / "one.obj")
    monkeypatch.setattr(obj_write, "_ROWS", 100)
    write(Survey("reef", mesh), tmp_path / "many.obj")
    one, many = (tmp_path / f"{name}.obj" for name in ("one", "many"))
    assert one.read_bytes() == many.read_bytes().replace(b"many.mtl", b"one.mtl")
    again = opened(many)
    np.testing.assert_array_equal(again.geometry.faces, mesh.faces)
    np.testing.assert_array_equal(again.geometry.face_texture, pages)


def test_trimesh_reads_what_is_written(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = grid_mesh(5, 6)
    path = tmp_path / "reef.obj"
    write(Survey("reef", mesh), path)
    oracle = trimesh.load(path, process=False, maintain_order=True)
    np.testing.assert_allclose(oracle.vertices[oracle.faces], mesh.vertices[mesh.faces], atol=6e-7)


def test_pages_from_files_are_copied_byte_for_byte(tmp_path):
    page = tmp_path / "source.jpg"
    Image.new("RGB", (8, 8), (200, 100, 50)).save(page)
    sheet = grid_mesh(3, 3)
    uv = np.zeros((len(sheet.faces), 3, 2), np.float32)
    texture = open_texture(page, 1000, clamp=True)
    mesh = Mesh(sheet.vertices, sheet.faces, None, uv, np.zeros(len(uv)), (texture,))
    path = tmp_path / "out" / "Rïff 1.obj"
    path.parent.mkdir()
    write(Survey("reef", mesh), path)
    assert sorted(os.listdir(path.parent)) == ["R_ff_1.mtl", "R_ff_1_0.jpg", "Rïff 1.obj"]
    assert (path.parent / "R_ff_1_0.jpg").read_bytes() == page.read_bytes()
    assert opened(path).geometry.textures[0].clamp


def test_equal_texture_coordinates_are_written_once(tmp_path):
    sheet = grid_mesh(4, 4)
    uv = (sheet.vertices[sheet.faces][..., :2] * 2).astype(np.float32)
    texture = texture_from_array(np.zeros((2, 2, 3), np.uint8))
    mesh = Mesh(sheet.vertices, sheet.faces, None, uv, np.zeros(len(uv)), (texture,))
    path = tmp_path / "reef.obj"
    write(Survey("reef", mesh), path)
    assert path.read_text().count("\nvt ") == 16
    assert path.read_text().count("usemtl") == 1


@pytest.mark.parametrize(
    "geometry",
    [
        Maps(np.zeros((2, 2), np.float32), Grid(0, 0, 1, (2, 2))),
        PointCloud(np.zeros((0, 3))),
        PointCloud(np.array([[0, 0, np.nan]])),
        PointCloud(np.array([[0, 0, 2e9]])),
    ],
)
def test_what_cannot_be_written_is_said(tmp_path, geometry):
    with pytest.raises(UsageError):
        write(Survey("x", geometry), tmp_path / "x.obj")
    assert os.listdir(tmp_path) == []


def test_a_missing_folder_is_an_output_error(tmp_path):
    cloud = PointCloud(np.eye(3))
    with pytest.raises(OutputError, match="No such file"):
        write(Survey("x", cloud), tmp_path / "none" / "x.obj")


@settings(max_examples=300, deadline=None)
@given(
    st.one_of(st.floats(-1e9, 1e9), st.floats(-1, 1), st.integers(-(10**9), 10**9).map(float)),
    st.integers(0, 15),
)
@example(0.9999999, 6)
@example(-0.0000001, 6)
@example(999999.9999999, 3)
def test_numbers_are_written_to_the_last_decimal(value, decimals):
    from meshreg.io.obj.write_kernels import MAX_NUMBER, put_rows

    out = np.zeros(100, np.uint8)
    word, none = np.frombuffer(b"v", np.uint8), np.empty((0, 3))
    size = put_rows(word, np.array([[value]]), decimals, none, out)
    text = out[:size].tobytes().decode()
    written = re.fullmatch(r"v (-?\d+(?:\.(\d+))?)\n", text)
    assert written
    assert size <= MAX_NUMBER + 3
    places = len(written[2] or "")
    assert places == decimals or abs(value) * 10.0 ** (places + 1) >= 9e15
    error = abs(Decimal(written[1]) - Decimal(value))
    assert (
        error <= Decimal("0.5") * Decimal(10) ** -places + Decimal(abs(value)) * Decimal(2) ** -53
    )
    assert not written[1].startswith("-0.0") or Decimal(written[1]) != 0


# Moving a file.

ODD = (
    "# a file\r\nmtllib reef.mtl\r\no one\r\n"
    "v 1 2 3\r\nv  1.5\t-2.25 3.123456789  0.1 0.2 0.3\r\n  v 0 0 1e1 1.0 # weight\r\n"
    "v 1.25e-1 \\\r\n  7 \\\r\n 8\r\nvt 0.5 0.5\r\nvn 1 0 0\r\nvn 0.6 0.0 0.8\r\n\r\n"
    "g v 1 2 3\r\nusemtl v\r\nf 1/1/1 2/1/1 3/1/2\r\nf -1 -2 -3\r\ns off\r\n#v 1 2 3\r\n"
    "v nan 1 2\r\n"
)


def source_of(path):
    return opened(path).source[0]


def numbers_replaced(old: bytes, transform: Transform) -> bytes:
    """Do by regular expressions what `rewrite` does, for files without continued lines."""

    def fixed(word, value):
        mantissa, _, exponent = word.lower().partition("e")
        places = len(mantissa.partition(".")[2]) - int(exponent or 0)
        return f"{value:.{max(places, 6)}f}"

    def moved(match):
        start, words, gaps = match[1], match.group(2, 4, 6), match.group(3, 5)
        values = np.array([float(word) for word in words])
        if not np.isfinite(values).all():
            return match[0]
        turned = transform.rotation @ values
        new = transform.apply(values) if start.strip() == b"v" else turned
        texts = [fixed(w.decode(), v).encode() for w, v in zip(words, new, strict=True)]
        return start + texts[0] + gaps[0] + texts[1] + gaps[1] + texts[2]

    pattern = rb"(?m)(^[ \t]*vn?[ \t]+)(\S+)([ \t]+)(\S+)([ \t]+)(\S+)"
    return re.sub(pattern, moved, old.replace(b"\r\n", b"\n")).replace(b"\n", b"\r\n")


def test_every_byte_but_the_numbers_is_kept(tmp_path):
    path = tmp_path / "reef.obj"
    text = (
        ODD.replace("1.25e-1 \\\r\n  7 \\\r\n 8", "1.25e-1  7 8") + "v 0 1 2\r\nf 1 2 6\r\n" * 200
    )
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    target = tmp_path / "out" / "reef_moved.obj"
    target.parent.mkdir()
    source = source_of(path)
    assert rewrite(source, make_mover(source, TURN, Frame()), target) == (target,)
    expected = numbers_replaced(path.read_bytes().removeprefix(b"\xef\xbb\xbf"), TURN)
    assert target.read_bytes() == b"\xef\xbb\xbf" + expected


def test_continued_lines_are_moved(tmp_path):
    path = tmp_path / "reef.obj"
    path.write_bytes(ODD.replace("v nan 1 2\r\n", "").encode())
    target = tmp_path / "moved.obj"
    source = source_of(path)
    rewrite(source, make_mover(source, TURN, Frame()), target)
    np.testing.assert_allclose(
        absolute(opened(target)), TURN.apply(absolute(opened(path))), rtol=0, atol=6e-7
    )
    assert target.read_bytes().count(b" \\\r\n") == 2
    old, new = path.read_bytes().splitlines(), target.read_bytes().splitlines()
    assert [a for a, b in zip(old, new, strict=True) if a != b] == [
        line for line in old if re.match(rb"\s*(vn? |7 | 8)|  7", line)
    ]


def test_moving_by_nothing_changes_no_byte(tmp_path):
    rng = np.random.default_rng(3)
    lines = [f"v {x:.7f} {y:.9f}  {z:.6f}" for x, y, z in rng.normal(size=(500, 3)) * 1000]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in rng.normal(size=(500, 3))]
    lines += ["f 1 2 3", "f 4//1 5//2 6//3", ""]
    path = tmp_path / "reef.obj"
    path.write_text("\n".join(lines))
    source = source_of(path)
    rewrite(source, make_mover(source, Transform(), source.frame), tmp_path / "same.obj")
    assert (tmp_path / "same.obj").read_bytes() == path.read_bytes()


@FILE_CASES
@given(
    st.lists(
        st.tuples(*[st.floats(-1e5, 1e5, allow_subnormal=False)] * 3), min_size=3, max_size=20
    ),
    st.integers(0, 2**31),
)
def test_moving_there_and_back(tmp_path, points, seed):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-3, 3)
    c, s = np.cos(angle), np.sin(angle)
    transform = Transform(
        np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), 1.0, rng.normal(size=3) * 100
    )
    path, there, back = (tmp_path / f"{name}.obj" for name in ("a", "b", "c"))
    for stale in (there, back):
        stale.unlink(missing_ok=True)
    path.write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in points))
    source = source_of(path)
    rewrite(source, make_mover(source, transform, source.frame), there)
    second = source_of(there)
    rewrite(second, make_mover(second, transform.inverse(), second.frame), back)
    np.testing.assert_allclose(absolute(opened(back)), points, rtol=0, atol=2e-6)


def test_blocks_of_lines_do_not_matter(tmp_path, monkeypatch):
    rng = np.random.default_rng(4)
    path = tmp_path / "reef.obj"
    path.write_text(
        "".join(f"v {x} {y} {z}\nvn 0 0 1\n" for x, y, z in rng.normal(size=(400, 3)))
        + "f 1 2 3\n" * 3
    )
    source = source_of(path)
    mover = make_mover(source, TURN, Frame())
    rewrite(source, mover, tmp_path / "one.obj")
    monkeypatch.setattr(line_blocks, "BLOCK", 333)
    rewrite(source, mover, tmp_path / "many.obj")
    assert (tmp_path / "one.obj").read_bytes() == (tmp_path / "many.obj").read_bytes()


def test_numbers_of_many_digits_are_moved(tmp_path):
    path = tmp_path / "reef.obj"
    path.write_text("v 473.71699999999998454313725233 1 2\nv 1 1 1e-80\nv 0 0 0\n")
    source = source_of(path)
    shift = Transform(offset=np.array([1.0, 2.0, 3.0]))
    rewrite(source, make_mover(source, shift, Frame()), tmp_path / "moved.obj")
    expected = [[474.717, 3, 5], [2, 3, 3], [1, 2, 3]]
    np.testing.assert_allclose(absolute(opened(tmp_path / "moved.obj")), expected, atol=1e-12)


def test_the_frame_of_the_target_is_written(tmp_path):
    """North, east, down in the source; local coordinates of another shift in the target."""
    path = tmp_path / "ned.obj"
    path.write_text("v 1 2 3\nv 4 6 5\nv 0 0 1\nvn 1 0 0\nf 1//1 2//1 3//1\n")
    survey = read(path, ReadOptions(axes="ned", shift=(100.0, 200.0, 0.0)))
    np.testing.assert_allclose(absolute(survey)[0], [102, 201, -3])
    target = Frame(shift=np.array([90.0, 190.0, -10.0]))
    shift = Transform(offset=np.array([1.0, 0.0, 0.5]))
    out = tmp_path / "enu.obj"
    rewrite(survey.source[0], make_mover(survey.source[0], shift, target), out)
    lines = out.read_text().splitlines()
    assert lines[0] == "v 13.000000 11.000000 7.500000"
    assert lines[3] == "vn 0.000000 1.000000 0.000000"


def test_materials_and_pages_go_along(tmp_path):
    folder = tmp_path / "survey"
    (folder / "tex").mkdir(parents=True)
    Image.new("RGB", (4, 4), (1, 2, 3)).save(folder / "tex" / "a.png")
    Image.new("RGB", (4, 4), (4, 5, 6)).save(folder / "normal.png")
    (folder / "reef.mtl").write_text("newmtl m\nmap_Kd tex\\A.png\nmap_Bump -bm 1 normal.png\n")
    path = folder / "reef.obj"
    path.write_text("mtllib reef.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n")
    source = source_of(path)
    out = tmp_path / "out"
    out.mkdir()
    files = rewrite(source, make_mover(source, TURN, Frame()), out / "reef_registered.obj")
    relative = {str(file.relative_to(out)) for file in files}
    assert relative == {"reef_registered.obj", "reef.mtl", "tex/a.png", "normal.png"}
    moved = opened(out / "reef_registered.obj")
    assert (moved.geometry.textures[0].load() == [1, 2, 3]).all()
    (out / "tex" / "a.png").write_bytes(b"another page")
    with pytest.raises(OutputError, match="other content"):
        rewrite(source, make_mover(source, TURN, Frame()), out / "again.obj")


def triangle(tmp_path):
    path = tmp_path / "reef.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    source = source_of(path)
    return path, source, make_mover(source, TURN, Frame())


def test_a_source_that_changed_is_refused(tmp_path):
    path, source, mover = triangle(tmp_path)
    path.write_text(path.read_text() + "v 1 1 1\n")
    with pytest.raises(InputError, match="changed"):
        rewrite(source, mover, tmp_path / "out.obj")
    assert os.listdir(tmp_path) == ["reef.obj"]


def test_a_full_disk_leaves_what_was_there(tmp_path):
    mesh = grid_mesh(60, 60)
    path, moved = tmp_path / "reef.obj", tmp_path / "moved.obj"
    write(Survey("reef", mesh), path)
    source = source_of(path)
    before = path.read_bytes()
    moved.write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OutputError, match="intact"):
            write(Survey("reef", mesh), path)
        with pytest.raises(OutputError, match="intact"):
            rewrite(source, make_mover(source, TURN, Frame()), moved)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert moved.read_text() == "old"
    assert sorted(os.listdir(tmp_path)) == ["moved.obj", "reef.obj"]


def test_a_file_is_not_moved_onto_itself(tmp_path):
    path, source, mover = triangle(tmp_path)
    with pytest.raises(UsageError, match="itself"):
        rewrite(source, mover, path)


def spoiled(monkeypatch, change):
    """Let the writing kernel spoil the bytes that it has written."""
    real = obj_write_kernels.put_vectors

    def put(data, end, spans, values, decimals, out):
        size = real(data, end, spans, values, decimals, out)
        text = change(out[:size].tobytes())
        out[: len(text)] = np.frombuffer(text, np.uint8)
        return len(text)

    monkeypatch.setattr(obj_write_kernels, "put_vectors", put)


def test_one_wrong_number_is_not_kept(tmp_path, monkeypatch):
    """Within the bounds of the others too: each point is compared."""
    path, moved = tmp_path / "reef.obj", tmp_path / "moved.obj"
    write(Survey("reef", grid_mesh(5, 5)), path)
    source = source_of(path)
    mover = make_mover(source, Transform(), Frame())
    rewrite(source, mover, moved)
    lines = moved.read_bytes().split(b"\n")
    middle = [line for line in lines if line.startswith(b"v ")][12]
    words = middle.split(b" ")
    words[3] = b"%.6f" % (float(words[3]) + 0.00001)
    moved.unlink()
    spoiled(monkeypatch, lambda text: text.replace(middle, b" ".join(words), 1))
    with pytest.raises(OutputError, match=r"does not read back.*off by up to 1"):
        rewrite(source, mover, moved)
    assert not moved.exists()


def test_lost_points_and_lines_are_noticed(tmp_path, monkeypatch):
    _, source, mover = triangle(tmp_path)
    spoiled(monkeypatch, lambda text: text.replace(b"v ", b"# ", 1))
    with pytest.raises(OutputError, match="2 points of 3"):
        rewrite(source, mover, tmp_path / "out.obj")
    monkeypatch.undo()
    spoiled(monkeypatch, lambda text: text.replace(b"\nf ", b"  f ", 1))
    with pytest.raises(OutputError, match="lines of"):
        rewrite(source, mover, tmp_path / "out.obj")
    assert os.listdir(tmp_path) == ["reef.obj"]


def test_numbers_too_large_for_fixed_notation_are_refused(tmp_path):
    _, source, _ = triangle(tmp_path)
    far = make_mover(source, Transform(offset=np.array([1e17, 0, 0])), Frame())
    with pytest.raises(OutputError, match="too large"):
        rewrite(source, far, tmp_path / "out.obj")
    assert os.listdir(tmp_path) == ["reef.obj"]
