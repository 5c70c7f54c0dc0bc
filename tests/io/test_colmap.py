"""COLMAP models: made by a writer of the test's own after COLMAP's description of its format."""

from __future__ import annotations

import shutil
import struct
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.colmap import files as colmap_files
from meshreg.io.colmap import positions, similarity
from meshreg.io.colmap import read as colmap
from meshreg.io.frames.mover import make_mover
from meshreg.io.options import ReadOptions
from meshreg.records import Frame, Survey, Transform

DATA = Path(__file__).parents[1] / "data" / "colmap"

# What the model's frame is to the world: model = (world - PLACE) @ TURN / UNIT.
TURN = Rotation.from_euler("xyz", [140, 25, 70], degrees=True).as_matrix()
UNIT = 3.7
SITE = np.array([300.0, 200.0, -12.0])
UTM = np.array([5e5, 6e6, 0.0])
PLACE = np.array([300.0, 200.0, -10.0])


@dataclass
class Scene:
    """The truth: seafloor points and cameras above, in metres; and the same in the model."""

    world: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    tracks: np.ndarray
    cameras: np.ndarray
    looks: np.ndarray  # rotation world to camera
    names: list[str]

    @property
    def points(self) -> np.ndarray:
        return (self.world - PLACE) @ TURN / UNIT

    @property
    def centres(self) -> np.ndarray:
        return (self.cameras - PLACE) @ TURN / UNIT


def make_scene(seed: int = 0, side: int = 5) -> Scene:
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-10, 10, (1500, 2))
    height = 0.4 * np.sin(flat[:, 0]) * np.cos(0.7 * flat[:, 1]) + rng.normal(0, 0.02, 1500)
    world = np.column_stack([flat, height]) + SITE
    grid = np.linspace(-8, 8, side)
    east, north = (a.ravel() for a in np.meshgrid(grid, grid))
    cameras = np.column_stack([east, north, np.full(side**2, 3.0)]) + SITE
    cameras += rng.normal(0, 0.3, cameras.shape)
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # camera y is down, z ahead
    shake = Rotation.from_euler("xyz", rng.normal(0, 4, (side**2, 3)), degrees=True).as_matrix()
    return Scene(
        world,
        rng.integers(1, 255, (1500, 3)).astype(np.uint8),
        rng.uniform(0.1, 2.0, 1500),
        rng.integers(3, 6, 1500),
        cameras,
        shake @ down,
        [f"dive/IMG_{i:04d}.JPG" for i in range(side**2)],
    )


def poses(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of camera from model world: x_cam = R x + t."""
    turn = scene.looks @ TURN
    shift = -np.einsum("nij,nj->ni", turn, scene.centres)
    return turn, shift


def write_bin(folder: Path, scene: Scene, names: list[bytes] | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    names = names or [name.encode() for name in scene.names]
    (folder / "cameras.bin").write_bytes(
        struct.pack("<QIiQQ4d", 1, 1, 1, 4000, 3000, 3000.0, 3000.0, 2000.0, 1500.0)
    )
    seen: list[list[int]] = [[] for _ in names]
    tracks = []
    for number, length in enumerate(scene.tracks):
        images = [(number + k) % len(names) for k in range(length)]
        tracks.append([(image + 1, len(seen[image])) for image in images])
        for image in images:
            seen[image].append(number + 1)
    turn, shift = poses(scene)
    data = struct.pack("<Q", len(names))
    for i, name in enumerate(names):
        x, y, z, w = Rotation.from_matrix(turn[i]).as_quat()
        data += struct.pack("<I7dI", i + 1, w, x, y, z, *shift[i], 1) + name + b"\0"
        data += struct.pack("<Q", len(seen[i]))
        data += b"".join(struct.pack("<ddq", 10.0, 20.0, point) for point in seen[i])
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(scene.points))
    for i, point in enumerate(scene.points):
        data += struct.pack("<Q3d3Bd", i + 1, *point, *scene.colors[i].tolist(), scene.errors[i])
        data += struct.pack("<Q", len(tracks[i]))
        data += b"".join(struct.pack("<II", *entry) for entry in tracks[i])
    (folder / "points3D.bin").write_bytes(data)
    return folder


def write_txt(folder: Path, scene: Scene) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(
        "# Number of cameras: 1\n1 PINHOLE 4000 3000 3e3 3e3 2e3 1500\n"
    )
    turn, shift = poses(scene)
    seen: list[list[int]] = [[] for _ in scene.names]
    lines = [f"# Number of points: {len(scene.points)}, mean track length: 4"]
    for i, point in enumerate(scene.points):
        images = [(i + k) % len(scene.names) for k in range(scene.tracks[i])]
        track = " ".join(f"{image + 1} {len(seen[image])}" for image in images)
        for image in images:
            seen[image].append(i + 1)
        where = " ".join(f"{v:.17g}" for v in point)
        color = " ".join(map(str, scene.colors[i].tolist()))
        lines.append(f"{i + 1} {where} {color} {scene.errors[i]:.17g} {track}")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
    lines = [f"# Number of images: {len(scene.names)}, mean observations per image: 1"]
    for i, name in enumerate(scene.names):
        x, y, z, w = Rotation.from_matrix(turn[i]).as_quat()
        pose = " ".join(f"{v:.17g}" for v in (w, x, y, z, *shift[i]))
        lines.append(f"{i + 1} {pose} 1 {name}")
        lines.append(" ".join(f"10 20 {point}" for point in seen[i]))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_table(path: Path, scene: Scene, xyz: np.ndarray, header: str = "image,east,north,up"):
    rows = [
        f"{n},{x!r},{y!r},{z!r}" for n, (x, y, z) in zip(scene.names, xyz.tolist(), strict=True)
    ]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def absolute(survey: Survey) -> np.ndarray:
    return survey.geometry.points + survey.origin


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


@pytest.fixture
def scene() -> Scene:
    return make_scene()


@pytest.mark.parametrize("writer", [write_bin, write_txt])
def test_model_comes_level_and_without_scale(tmp_path, scene, writer):
    survey = colmap.read(writer(tmp_path / "reef", scene), ReadOptions())
    axes = survey.source[0].frame.axes
    # Up in the model is TURN' z; the surface itself leans a little, so not exactly.
    up = axes @ (TURN.T @ [0, 0, 1])
    assert angle_between(up, np.array([0, 0, 1])) < np.radians(0.5)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0
    assert survey.scale_known is False
    assert survey.name == "reef"
    np.testing.assert_allclose(absolute(survey), scene.points @ axes.T, atol=1e-9)
    np.testing.assert_array_equal(survey.geometry.colors, scene.colors)
    assert survey.source[0].counts == {"points": 1500, "images": 25}
    assert any("Levelled by the ground" in note for note in survey.notes)
    assert any("arbitrary" in note for note in survey.notes)


def test_bin_and_txt_are_the_same(tmp_path, scene):
    one = colmap.read(write_bin(tmp_path / "a", scene), ReadOptions())
    two = colmap.read(write_txt(tmp_path / "b", scene), ReadOptions())
    np.testing.assert_allclose(absolute(one), absolute(two), atol=1e-9)
    np.testing.assert_array_equal(one.geometry.colors, two.geometry.colors)


def test_bin_goes_before_txt(tmp_path, scene):
    write_bin(tmp_path / "reef", scene)
    scene.colors[:] = 7
    write_txt(tmp_path / "reef", scene)
    survey = colmap.read(tmp_path / "reef", ReadOptions())
    assert survey.geometry.colors.max() > 7
    (tmp_path / "reef" / "images.bin").unlink()
    assert colmap.read(tmp_path / "reef", ReadOptions()).geometry.colors.max() == 7


def test_stated_scale_multiplies(tmp_path, scene):
    write_bin(tmp_path / "reef", scene)
    plain = colmap.read(tmp_path / "reef", ReadOptions())
    scaled = colmap.read(tmp_path / "reef", ReadOptions(scale=UNIT))
    assert scaled.scale_known is False
    assert any("stated to be 3.7 m" in note for note in scaled.notes)
    np.testing.assert_allclose(absolute(scaled), UNIT * absolute(plain), atol=1e-9)
    size = np.ptp(absolute(scaled)[:, 2])
    assert abs(size - np.ptp(scene.world[:, 2])) < 0.15  # metres again, but for the lean


@pytest.mark.parametrize("options", [ReadOptions(up="z", unit="m"), ReadOptions(shift=(0, 0, 9))])
def test_a_frame_that_is_stated_is_taken(tmp_path, scene, options):
    write_bin(tmp_path / "reef", scene)
    survey = colmap.read(tmp_path / "reef", options)
    shift = options.shift or (0, 0, 0)
    np.testing.assert_allclose(absolute(survey), scene.points + shift, atol=1e-9)
    assert survey.scale_known is True
    assert any("Taken to be level already" in note for note in survey.notes)


def test_sidecar_beside_the_folder_counts(tmp_path, scene):
    write_bin(tmp_path / "reef", scene)
    (tmp_path / "reef_offset.xyz").write_text("500 600 7\n")
    survey = colmap.read(tmp_path / "reef", ReadOptions())
    np.testing.assert_allclose(absolute(survey), scene.points + np.array([500, 600, 7]), atol=1e-9)
    assert survey.scale_known is True


def test_exact_positions_give_the_truth(tmp_path, scene):
    write_bin(tmp_path / "reef", scene)
    table = write_table(tmp_path / "nav.csv", scene, scene.cameras)
    survey = colmap.read(tmp_path / "reef", ReadOptions(positions=table, crs=None))
    np.testing.assert_allclose(absolute(survey), scene.world, atol=1e-8)
    assert survey.scale_known is True
    frame = survey.source[0].frame
    np.testing.assert_allclose(frame.axes, UNIT * TURN, atol=1e-9)


@pytest.mark.parametrize("far", [1e303, -1e200, 1e13, np.nan])
def test_points_beyond_measure_are_left_out(tmp_path, scene, far):
    folder = write_bin(tmp_path / "reef", scene)
    data = bytearray((folder / "points3D.bin").read_bytes())
    struct.pack_into("<d", data, 16, far)  # x of the first point, after two counters of 8 bytes
    (folder / "points3D.bin").write_bytes(data)
    table = write_table(tmp_path / "nav.csv", scene, scene.cameras)
    survey = colmap.read(folder, ReadOptions(positions=table, crs=None))
    np.testing.assert_allclose(absolute(survey), scene.world[1:], atol=1e-8)
    assert any(f"1 of {len(scene.world)} points" in note for note in survey.notes)


@pytest.mark.parametrize("seed", range(3))
def test_noisy_positions_with_blunders(tmp_path, seed):
    """Errors are about the noise put in: not more, and the stated sigma neither more nor less."""
    scene = make_scene(seed, side=8)
    rng = np.random.default_rng(seed)
    noise = 0.05
    measured = scene.cameras + rng.normal(0, noise, scene.cameras.shape)
    wrong = rng.permutation(64)[:20]
    measured[wrong] += rng.uniform(5, 40, (20, 3))
    measured += UTM
    write_bin(tmp_path / "reef", scene)
    table = write_table(tmp_path / "nav.csv", scene, measured)
    survey = colmap.read(tmp_path / "reef", ReadOptions(positions=table, crs="EPSG:32754"))
    assert survey.crs == "EPSG:32754"
    miss = absolute(survey) - scene.world - UTM
    # 44 good positions over 16 m: about 1 cm at the centre, some more at the edges.
    assert 1e-4 < np.sqrt((miss**2).sum(axis=1).mean()) < 0.04
    scale = np.cbrt(np.linalg.det(survey.source[0].frame.axes))
    assert abs(scale / UNIT - 1) < 0.005
    note = next(note for note in survey.notes if "camera positions" in note)
    used, sigma = (
        int(note.split("fitted to ")[1].split()[0]),
        float(note.split("off by ")[1].split()[0]),
    )
    assert 40 <= used <= 44
    assert 0.6 * noise < sigma < 1.4 * noise


def test_positions_too_poor_for_the_tilt_leave_it_to_the_ground(tmp_path, scene):
    """A nearly straight line of cameras knows nothing of the roll about it."""
    scene.cameras[:, 1] = 200 + np.random.default_rng(1).normal(0, 0.02, 25)
    scene.cameras[:, 2] = -9
    write_bin(tmp_path / "reef", scene)
    measured = scene.cameras + np.random.default_rng(2).normal(0, 0.05, (25, 3))
    table = write_table(tmp_path / "nav.csv", scene, measured)
    survey = colmap.read(tmp_path / "reef", ReadOptions(positions=table))
    assert any("tilt is the ground's" in note for note in survey.notes)
    axes = survey.source[0].frame.axes
    assert angle_between(axes @ TURN.T @ [0, 0, 1], np.array([0, 0, 1])) < np.radians(0.6)
    miss = absolute(survey) - scene.world
    assert np.abs(miss).max() < 0.3
    assert np.abs(miss.mean(axis=0)).max() < 0.1


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        ("image,east,north,up\na,1,2,3\nb,4,5,6\n", False),
        ("a,1,2,3\nb,4,5,6\n", False),
        ("a 1 2 3\nb 4 5 6\n", False),
        ("# by hand\n#Label;X/Easting;Y/Northing;Z/Altitude\na;1;2;3\nb;4;5;6\n", False),
        ("\ufeffNorth\tEast\tHeight (m)\tName\n2\t1\t3\ta\n5\t4\t6\tb\n", False),
        ("label,lat,lon,depth,acc\na,2,1,-3,9\nb,5,4,-6,9\n", True),
        ("label,lat,lon,depth,acc\na,2,1,3,9\nb,5,4,6,9\n", True),
        ('"image","lon","lat","alt"\n"a",1,2,3\n"b",4,5,6\n', True),
    ],
)
def test_tables_of_positions(tmp_path, text, degrees):
    path = tmp_path / "nav.csv"
    path.write_text(text, "utf-8")
    found = positions.read_positions(path)
    assert found.names == ("a", "b")
    assert found.degrees is degrees
    sign = -1 if "depth" in text else 1
    np.testing.assert_array_equal(found.xyz, [[1, 2, sign * 3], [4, 5, sign * 6]])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no position"),
        ("image,east,north,up\n", "no position"),
        ("image,east,north,up\na,1,2,3\nb,1\n", "line 3"),
        ("image;east;north;up\na;1,5;2;3\n", "decimal points"),
        ("image,east,north,up\na,1,nan,3\n", "line 2"),
        ("image,east,up,x\na,1,2,3\n", "were looked for"),
        ("a 1 2\n", "too few columns"),
        ("a\0b", "not a table"),
    ],
)
def test_bad_tables(tmp_path, text, said):
    path = tmp_path / "nav.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        positions.read_positions(path)


def test_names_match_by_path_then_name_then_stem():
    images = ["a/1.JPG", "b/1.JPG", "b/2.jpg", "c/3.tif", "c/4.tif"]
    table = ["B\\1.jpg", "2.JPG", "3", "5", "A/1.jpg", "4.png"]
    assert positions.match_names(images, table) == [(0, 4), (1, 0), (2, 1), (3, 2), (4, 5)]
    assert positions.match_names(["a/1.JPG", "b/1.JPG"], ["1.jpg"]) == []


def test_degrees_become_utm(tmp_path, scene):
    from pyproj import Transformer

    east_north_up = scene.cameras + UTM
    to_degrees = Transformer.from_crs(32754, 4326, always_xy=True)
    lon, lat = to_degrees.transform(*east_north_up[:, :2].T)
    table = write_table(
        tmp_path / "nav.csv",
        scene,
        np.column_stack([lon, lat, east_north_up[:, 2]]),
        "image,lon,lat,alt",
    )
    write_bin(tmp_path / "reef", scene)
    truth = scene.world + UTM
    for crs in (None, "EPSG:4326", "EPSG:32754"):
        survey = colmap.read(tmp_path / "reef", ReadOptions(positions=table, crs=crs))
        assert survey.crs == "EPSG:32754"
        np.testing.assert_allclose(absolute(survey), truth, atol=1e-5)


def write_photograph(path: Path, lon: float, lat: float, up: float) -> None:
    def parts(value: float) -> tuple[float, float, float]:
        value = abs(value)
        minutes = (value % 1) * 60
        return float(int(value)), float(int(minutes)), (minutes % 1) * 60

    exif = Image.Exif()
    block = exif.get_ifd(0x8825)
    block[1], block[2] = "N" if lat >= 0 else "S", parts(lat)
    block[3], block[4] = "E" if lon >= 0 else "W", parts(lon)
    block[5], block[6] = b"\x01" if up < 0 else b"\x00", abs(up)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8)).save(path, exif=exif)


def test_exif_of_photographs_in_the_folder(tmp_path, scene):
    from pyproj import Transformer

    back = Transformer.from_crs(32754, 4326, always_xy=True)
    root = tmp_path / "reef"
    write_bin(root / "sparse" / "0", scene)
    for name, (east, north, up) in zip(scene.names, scene.cameras + UTM, strict=True):
        write_photograph(root / "images" / name, *back.transform(east, north), up)
    survey = colmap.read(root, ReadOptions())
    assert survey.name == "reef"
    assert survey.crs == "EPSG:32754"
    assert survey.scale_known is True
    # Seconds are stored as fractions of limited size: about a centimetre.
    miss = absolute(survey) - scene.world - UTM
    assert np.abs(miss).max() < 0.1
    # Photographs outside the folder that was named are not looked at.
    inner = colmap.read(root / "sparse" / "0", ReadOptions())
    assert inner.scale_known is False
    # A stated scale stands against them.
    assert colmap.read(root, ReadOptions(scale=2.0)).scale_known is False


def test_photograph_names_do_not_lead_outside(tmp_path, scene):
    write_photograph(tmp_path / "secret.jpg", 141.0, -36.0, 1.0)
    found = positions.exif_positions(tmp_path / "reef", ["../secret.jpg", "/etc/hostname"])
    assert found.names == ()
    write_photograph(tmp_path / "reef" / "a.jpg", 141.0, -36.0, -1.0)
    (tmp_path / "reef" / "b.jpg").write_bytes(b"\xff\xd8\xff broken")
    found = positions.exif_positions(tmp_path / "reef", ["a.jpg", "b.jpg", "c.jpg"])
    assert found.names == ("a.jpg",)
    np.testing.assert_allclose(found.xyz, [[141.0, -36.0, -1.0]], atol=1e-6)


@pytest.mark.parametrize("missing", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_missing_files_are_named(tmp_path, scene, missing, kind):
    folder = (write_bin if kind == "bin" else write_txt)(tmp_path / "reef", scene)
    (folder / f"{missing}.{kind}").unlink()
    with pytest.raises(InputError, match=f"{missing}.{kind} missing"):
        colmap.read(folder, ReadOptions())


@pytest.mark.parametrize("part", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("cut", [0, 7, 8, 60, 0.5, -1])
def test_truncated_binaries_are_named(tmp_path, scene, part, cut, monkeypatch):
    folder = write_bin(tmp_path / "reef", scene)
    data = (folder / part).read_bytes()
    (folder / part).write_bytes(data[: int(cut * len(data)) if cut == 0.5 else cut])
    import pycolmap

    monkeypatch.setattr(pycolmap, "Reconstruction", lambda *a: pytest.fail("pycolmap saw it"))
    with pytest.raises(InputError) as caught:
        colmap.read(folder, ReadOptions())
    assert caught.value.file.endswith(part)


@pytest.mark.parametrize("part", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("count", [2**62, 10**9, 1501 * 7])
def test_lying_counts_never_reach_pycolmap(tmp_path, scene, part, count, monkeypatch):
    folder = write_bin(tmp_path / "reef", scene)
    data = (folder / part).read_bytes()
    (folder / part).write_bytes(struct.pack("<Q", count) + data[8:])
    import pycolmap

    monkeypatch.setattr(pycolmap, "Reconstruction", lambda *a: pytest.fail("pycolmap saw it"))
    with pytest.raises(InputError):
        colmap.read(folder, ReadOptions())


@pytest.mark.parametrize(("part", "at"), [("points3D.bin", 8 + 43), ("images.bin", 8 + 64 + 18)])
def test_lying_inner_counts(tmp_path, scene, part, at):
    folder = write_bin(tmp_path / "reef", scene)
    data = bytearray((folder / part).read_bytes())
    data[at : at + 8] = struct.pack("<Q", 2**40)
    (folder / part).write_bytes(data)
    with pytest.raises(InputError, match="ends early"):
        colmap.read(folder, ReadOptions())


@pytest.mark.parametrize(
    ("part", "change", "said"),
    [
        ("points3D.txt", lambda t: t[: len(t) // 2], "ends within a line"),
        ("points3D.txt", lambda t: t[: t.index(b"\n", len(t) // 2) + 1], "declares 1500 points3D"),
        ("images.txt", lambda t: t.replace(b"dive", b"di\0e"), "NUL"),
        ("cameras.txt", lambda t: t.replace(b"PINHOLE", b"MIRROR"), "cannot be read"),
    ],
)
def test_damaged_texts(tmp_path, scene, part, change, said):
    folder = write_txt(tmp_path / "reef", scene)
    (folder / part).write_bytes(change((folder / part).read_bytes()))
    with pytest.raises(InputError, match=said):
        colmap.read(folder, ReadOptions())


@pytest.mark.parametrize("value", [float("nan"), 1e200])
def test_a_pose_that_is_none(tmp_path, scene, value):
    folder = write_bin(tmp_path / "reef", scene)
    data = bytearray((folder / "images.bin").read_bytes())
    data[12:44] = struct.pack("<4d", value, value, 0.0, value)
    (folder / "images.bin").write_bytes(data)
    with pytest.raises(InputError, match="pose is none: 'dive/IMG_0000"):
        colmap.read(folder, ReadOptions())


def test_several_models_are_listed_with_their_sizes(tmp_path, scene):
    write_bin(tmp_path / "reef" / "sparse" / "0", scene)
    write_txt(tmp_path / "reef" / "sparse" / "1", make_scene(1, side=3))
    with pytest.raises(UsageError) as caught:
        colmap.read(tmp_path / "reef", ReadOptions())
    assert "0: 25 images, 1500 points; 1: 9 images, 1500 points" in str(caught.value)
    assert colmap.read(tmp_path / "reef" / "sparse" / "1", ReadOptions()).name == "reef"


def test_no_model(tmp_path):
    with pytest.raises(InputError, match="no COLMAP model"):
        colmap.read(tmp_path, ReadOptions())
    with pytest.raises(InputError, match="not a folder"):
        colmap.read(tmp_path / "nothing", ReadOptions())


def test_empty_model(tmp_path, scene):
    folder = write_bin(tmp_path / "reef", scene)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    (folder / "images.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(InputError, match="0 points and 0 images"):
        colmap.read(folder, ReadOptions())


def test_poor_points_are_left_out_and_counted(tmp_path, scene):
    scene.errors[:10] = 5.0
    scene.tracks[10:30] = 2
    scene.errors[40] = -1.0  # not computed
    survey = colmap.read(write_bin(tmp_path / "reef", scene), ReadOptions(up="z"))
    np.testing.assert_allclose(absolute(survey), scene.points[30:], atol=1e-9)
    assert survey.notes[0].startswith("30 of 1500 points were left out")


def test_black_models_have_no_colors(tmp_path, scene):
    scene.colors[:] = 0
    survey = colmap.read(write_bin(tmp_path / "reef", scene), ReadOptions())
    assert survey.geometry.colors is None
    assert any("black" in note for note in survey.notes)


@pytest.mark.parametrize(
    "options",
    [
        ReadOptions(positions=Path("nav.csv"), scale=2.0),
        ReadOptions(positions=Path("nav.csv"), shift=(1, 2, 3)),
        ReadOptions(scale=2.0, unit="mm"),
        ReadOptions(scale=-1.0),
    ],
)
def test_options_that_contradict(tmp_path, scene, options):
    with pytest.raises(UsageError):
        colmap.read(write_bin(tmp_path / "reef", scene), options)


def test_positions_of_another_survey(tmp_path, scene):
    folder = write_bin(tmp_path / "reef", scene)
    table = tmp_path / "nav.csv"
    table.write_text("image,east,north,up\nx,1,2,3\ny,4,5,6\nz,7,8,9\n")
    with pytest.raises(InputError, match="fits 0 of 25 images"):
        colmap.read(folder, ReadOptions(positions=table))
    noise = np.random.default_rng(0).normal(0, 100, (25, 3))
    write_table(table, scene, noise)
    with pytest.raises(InputError, match="do not fit the model"):
        colmap.read(folder, ReadOptions(positions=table))


def test_latin_1_names_do_not_stop_the_reading(tmp_path, scene):
    names = [b"caf\xe9_%d.jpg" % i for i in range(25)]
    survey = colmap.read(write_bin(tmp_path / "reef", scene, names), ReadOptions())
    assert len(survey.geometry.points) == 1500


def test_pose_as_property_and_as_method():
    assert colmap_files.camera_from_world(SimpleNamespace(cam_from_world=7)) == 7
    assert colmap_files.camera_from_world(SimpleNamespace(cam_from_world=lambda: 7)) == 7


def test_a_view_from_the_side_is_said(tmp_path, scene):
    sideways = Rotation.from_euler("x", 60, degrees=True).as_matrix()
    scene.looks = scene.looks @ sideways
    survey = colmap.read(write_bin(tmp_path / "reef", scene), ReadOptions())
    assert any("no view from above" in note for note in survey.notes)


def test_real_model_is_level():
    survey = colmap.read(DATA, ReadOptions())
    points = survey.geometry.points
    assert survey.scale_known is False
    assert len(points) == 556
    # A beach from above: as flat as its own relief, and below its cameras.
    assert np.percentile(points[:, 2], 90) - np.percentile(points[:, 2], 10) < 0.5
    assert np.ptp(points[:, :2], axis=0).min() > 7
    model, _ = colmap_files.read_model(colmap_files.find_model(DATA))
    cameras = model.centres @ survey.source[0].frame.axes.T - survey.origin
    assert cameras[:, 2].min() - points[:, 2].max() > 4


def pixels(turn, shift, points):
    cam = points @ turn.T + shift
    return cam[:, :2] / cam[:, 2:]


@pytest.mark.parametrize("writer", [write_bin, write_txt])
def test_rewrite_moves_points_and_cameras(tmp_path, scene, writer):
    import pycolmap

    survey = colmap.read(writer(tmp_path / "reef", scene), ReadOptions(scale=UNIT))
    axes = survey.source[0].frame.axes
    turn = Rotation.from_euler("zx", [30, 3], degrees=True).as_matrix()
    transform = Transform(turn, 1.01, [4e5, 6e6, 2.0], survey.centre)
    target = Frame(np.eye(3), [4e5, 6e6, 0.0])
    move = make_mover(survey.source[0], transform, target)
    out = tmp_path / "moved"
    written = colmap.rewrite(survey.source[0], move, out)
    suffix = ".bin" if writer is write_bin else ".txt"
    assert {p.name for p in written} >= {f"{n}{suffix}" for n in ("cameras", "images", "points3D")}
    assert sorted(out.iterdir()) == sorted(written)
    again = colmap.read(out, ReadOptions(shift=(4e5, 6e6, 0), up="z"))
    expected = transform.apply(scene.points @ axes.T)
    np.testing.assert_allclose(absolute(again), expected, rtol=0, atol=5e-9)
    # Every camera sees every point in the same pixel as before.
    model = pycolmap.Reconstruction(out)
    old_turn, old_shift = poses(scene)
    new_points = np.array([model.points3D[i + 1].xyz for i in range(1500)])
    for i in (0, 12, 24):
        pose = model.images[i + 1].cam_from_world()
        np.testing.assert_allclose(
            pixels(pose.rotation.matrix(), pose.translation, new_points),
            pixels(old_turn[i], old_shift[i], scene.points),
            atol=1e-9,
        )
    assert model.images[3].name == scene.names[2]
    assert model.points3D[5].track.length() == scene.tracks[4]


def test_names_with_blanks_stay_whole(tmp_path, scene):
    """RealityScan writes such names; pycolmap cuts them at the first blank."""
    scene.names = [f"Dive 1, reef\u00e9/IMG ({i:04d}) copy.JPG" for i in range(25)]
    folder = write_txt(tmp_path / "reef", scene)
    text = (folder / "images.txt").read_bytes().replace(b"\n", b"\r\n")
    text = text.replace(b"copy.JPG", "c\u00f6py.JPG".encode("latin-1"), 1)
    (folder / "images.txt").write_bytes(b"# made by hand\r\n\r\n" + text)
    xyz = scene.cameras + UTM
    scene.names[0] = scene.names[0].replace("copy", "c\u00f6py").replace("\u00e9", "\u00c3\u00a9")
    table = write_table(tmp_path / "positions.csv", scene, xyz)
    rows = table.read_text().splitlines()
    table.write_text("\n".join([rows[0], *(f'"{n}",{r[len(n) + 1:]}' for n, r in zip(
        scene.names, rows[1:], strict=True))]) + "\n")  # fmt: skip
    survey = colmap.read(folder, ReadOptions(positions=table))
    assert absolute(survey) == pytest.approx(scene.world + UTM, abs=1e-6)
    turn = Rotation.from_euler("zx", [30, 3], degrees=True).as_matrix()
    move = make_mover(survey.source[0], Transform(turn, 1.01, [1, 2, 3], survey.centre), Frame())
    colmap.rewrite(survey.source[0], move, tmp_path / "moved")
    old = (folder / "images.txt").read_bytes().split(b"\r\n")
    new = (tmp_path / "moved" / "images.txt").read_bytes().split(b"\r\n")
    assert len(new) == len(old) == 4 + 2 * 25
    names = 0
    for before, after in zip(old, new, strict=True):
        if before.endswith(b".JPG"):
            names += 1
            assert after != before
            assert after.split(b" ", 8)[8] == before.split(b" ", 8)[8]  # camera and name
        else:
            assert after == before
    assert names == 25
    again = colmap.read(tmp_path / "moved", ReadOptions(up="z"))
    assert absolute(again) == pytest.approx(
        Transform(turn, 1.01, [1, 2, 3], survey.centre).apply(absolute(survey)), abs=1e-6
    )


@pytest.mark.parametrize("cut", ["IMG", "IMG (0003)"])
def test_a_name_that_is_cut_in_writing_is_found(tmp_path, scene, cut, monkeypatch):
    from meshreg.io.colmap import write as colmap_write

    scene.names = [f"IMG ({i:04d}) copy.JPG" for i in range(25)]
    survey = colmap.read(write_txt(tmp_path / "reef", scene), ReadOptions(scale=1))
    kept = colmap_write._edited

    def cutting(form, line, moved):
        text = kept(form, line, moved)
        return text.replace(b"IMG (0003) copy.JPG", cut.encode())

    monkeypatch.setattr(colmap_write, "_edited", cutting)
    move = make_mover(survey.source[0], Transform(offset=(1, 2, 3)), Frame())
    with pytest.raises(OutputError, match="read back"):
        colmap.rewrite(survey.source[0], move, tmp_path / "moved")
    assert not (tmp_path / "moved").exists()


@pytest.mark.parametrize("kind", ["txt", "bin"])
def test_rigs_of_two_cameras_move_along(tmp_path, scene, kind):
    """Every camera of a rig goes on seeing each point in the same pixel."""
    import pycolmap

    folder = write_txt(tmp_path / "reef", scene)
    with open(folder / "cameras.txt", "a") as stream:
        stream.write("2 PINHOLE 4000 3000 3e3 3e3 2e3 1500\n")
    camera = (folder / "cameras.txt").read_text().replace("cameras: 1", "cameras: 2")
    (folder / "cameras.txt").write_text(camera)
    turn, shift = poses(scene)
    aside, apart = Rotation.from_euler("xyz", [2, 20, -3], degrees=True), np.array([0.2, 0.1, 0.05])
    lines = (folder / "images.txt").read_text().split("\n")
    frames, rows = [], []
    for i in range(24):
        pose = Rotation.from_matrix(turn[i - i % 2])
        where, number = shift[i - i % 2], i // 2 + 1
        if i % 2:  # seen by the second camera
            pose, where = aside * pose, aside.apply(where) + apart
        numbers = [*pose.as_quat(scalar_first=True), *where]
        text = " ".join(f"{v:.17g}" for v in numbers)
        rows += [f"{i + 1} {text} {i % 2 + 1} {scene.names[i]}", lines[2 + 2 * i]]
        if i % 2 == 0:
            frames.append(f"{number} 1 {text} 2 CAMERA 1 {i + 1} CAMERA 2 {i + 2}")
    rows += [f"25 {' '.join(lines[49].split()[1:8])} 1 {scene.names[24]}", lines[50]]
    frames.append(f"13 1 {' '.join(lines[49].split()[1:8])} 1 CAMERA 1 25")
    (folder / "images.txt").write_text("\n".join(rows) + "\n")
    (folder / "frames.txt").write_text("\n".join(frames) + "\n")
    numbers = [*aside.as_quat(scalar_first=True), *apart]
    (folder / "rigs.txt").write_text(
        f"# a rig\n1 2 CAMERA 1 CAMERA 2 1 {' '.join(f'{v:.17g}' for v in numbers)}\n"
    )
    if kind == "bin":
        folder = tmp_path / "binary"
        folder.mkdir()
        pycolmap.Reconstruction(tmp_path / "reef").write_binary(folder)
    survey = colmap.read(folder, ReadOptions(scale=UNIT))
    turned = Rotation.from_euler("zx", [30, 3], degrees=True).as_matrix()
    transform = Transform(turned, 1.25, [1, 2, 3], survey.centre)
    move = make_mover(survey.source[0], transform, Frame())
    written = colmap.rewrite(survey.source[0], move, tmp_path / "moved")
    assert len(written) == 5
    models = [pycolmap.Reconstruction(place) for place in (folder, tmp_path / "moved")]
    seen = []
    for model in models:
        points = np.array([model.points3D[k + 1].xyz for k in range(100)])
        poses_now = [model.images[k + 1].cam_from_world() for k in range(25)]
        seen.append([pixels(p.rotation.matrix(), p.translation, points) for p in poses_now])
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-8)
    sensor = models[1].rigs[1].sensor_from_rig(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2))
    assert sensor.translation == pytest.approx(1.25 * UNIT * apart, rel=1e-12)


def test_rewrite_refuses_what_is_no_similarity(tmp_path, scene):
    survey = colmap.read(write_bin(tmp_path / "reef", scene), ReadOptions())
    shear = make_mover(survey.source[0], Transform(), Frame(np.diag([1.0, 1.0, 1.2])))
    with pytest.raises(OutputError, match="mirror or shear"):
        colmap.rewrite(survey.source[0], shear, tmp_path / "moved")
    mirror = make_mover(survey.source[0], Transform(), Frame(np.diag([1.0, 1.0, -1.0])))
    with pytest.raises(OutputError, match="mirror or shear"):
        colmap.rewrite(survey.source[0], mirror, tmp_path / "moved")
    assert not (tmp_path / "moved").exists()


def test_rewrite_refuses_a_model_that_has_changed(tmp_path, scene):
    folder = write_bin(tmp_path / "reef", scene)
    survey = colmap.read(folder, ReadOptions())
    shutil.copy(folder / "points3D.bin", tmp_path / "copy")
    (folder / "points3D.bin").write_bytes((tmp_path / "copy").read_bytes() + b"\0")
    move = make_mover(survey.source[0], Transform(), Frame())
    with pytest.raises(InputError, match="has changed"):
        colmap.rewrite(survey.source[0], move, tmp_path / "moved")


angles = st.floats(-180, 180)


@settings(max_examples=30, deadline=None)
@given(angles, angles, angles, st.floats(0.01, 100), st.integers(0, 2**31))
def test_umeyama_recovers_any_similarity(a, b, c, scale, seed):
    turn = Rotation.from_euler("xyz", [a, b, c], degrees=True).as_matrix()
    rng = np.random.default_rng(seed)
    of, shift = rng.normal(0, 3, (6, 3)), rng.normal(0, 1e5, 3)
    found = similarity.umeyama(of, scale * of @ turn.T + shift)
    assert abs(found[0] / scale - 1) < 1e-6 * (1 + 1 / scale)
    np.testing.assert_allclose(found[1], turn, atol=1e-6 * (1 + 1 / scale))


@settings(max_examples=30, deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_turn_up_is_the_least_rotation(up):
    up = np.array(up)
    turn = similarity.turn_up(up)
    np.testing.assert_allclose(turn @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) > 0
    start = np.eye(3) if up[2] >= 0 else np.diag([1.0, -1.0, -1.0])
    needed = angle_between(start @ up, np.array([0, 0, 1.0]))
    assert abs(Rotation.from_matrix(turn @ start).magnitude() - needed) < 1e-6


def test_heading_of_a_model_that_looks_down_is_steady():
    """Up is almost -z in a usual model; a hair of tilt must not turn it about."""
    turns = [similarity.turn_up(np.array([x, y, -1.0])) for x, y in ((0.01, 0), (0, -0.01))]
    for turn in turns:
        np.testing.assert_allclose(turn, np.diag([1.0, -1.0, -1.0]), atol=0.011)


def test_ground_stands_against_outliers():
    rng = np.random.default_rng(3)
    flat = rng.uniform(-5, 5, (1000, 2))
    ground = np.column_stack(
        [flat, 0.1 * flat[:, 0] - 0.2 * flat[:, 1] + rng.normal(0, 0.05, 1000)]
    )
    fish = rng.uniform([-5, -5, 0], [5, 5, 6], (350, 3))
    far = rng.normal(0, 300, (20, 3))
    up = similarity.ground_up(np.concatenate([ground, fish, far]), np.array([0.05, 0.1, 1.0]))
    assert angle_between(up, np.array([-0.1, 0.2, 1.0])) < np.radians(3)
    clean = similarity.ground_up(ground, np.array([0.05, 0.1, 1.0]))
    assert angle_between(clean, np.array([-0.1, 0.2, 1.0])) < np.radians(0.2)
