"""E57: files made by an encoder of the test's own (ASTM E2807), and oddities of the real world."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from meshreg.errors import InputError, OutputError, UnsafeReferenceError, UsageError
from meshreg.io.e57 import pages as e57_pages
from meshreg.io.e57 import read as e57
from meshreg.io.e57 import scans as e57_scans
from meshreg.io.e57 import xml as e57_xml
from meshreg.io.frames.mover import make_mover
from meshreg.io.options import ReadOptions
from meshreg.records import Frame, Mesh, PointCloud, Survey, Transform

DATA = Path(__file__).parents[1] / "data" / "e57"
NS = "http://www.astm.org/COMMIT/E57/2010-e57-v1.0"

pytestmark = pytest.mark.needs("pye57")


def crc32c(data: bytes) -> int:
    """CRC-32C bit by bit, from its definition: other code than the table under test."""
    crc = 0xFFFFFFFF
    for byte in data:
        for bit in range(8):
            mixed = (crc ^ (byte >> bit)) & 1
            crc = (crc >> 1) ^ (0x82F63B78 if mixed else 0)
    return crc ^ 0xFFFFFFFF


def pages(logical: bytes) -> bytes:
    logical += b"\0" * (-len(logical) % 1020)
    parts = [logical[i : i + 1020] for i in range(0, len(logical), 1020)]
    return b"".join(part + struct.pack(">I", crc32c(part)) for part in parts)


def physical(logical: int) -> int:
    return logical // 1020 * 1024 + logical % 1020


def section(columns: list[tuple[str, np.ndarray]], start: int) -> bytes:
    """One compressed vector in one data packet; every field is whole bytes wide."""
    streams = [np.ascontiguousarray(values, kind).tobytes() for kind, values in columns]
    body = struct.pack(f"<{len(streams)}H", *map(len, streams)) + b"".join(streams)
    body += b"\0" * (-(len(body) + 6) % 4)
    packet = struct.pack("<BBHH", 1, 0, len(body) + 5, len(streams)) + body
    assert len(packet) <= 65536
    head = struct.pack("<B7xQQQ", 1, 32 + len(packet), physical(start + 32), 0)
    return head + packet


def field(name: str, kind: str) -> str:
    if kind in ("<f8", "<f4"):
        return f'<{name} type="Float" precision="{"double" if kind == "<f8" else "single"}"/>'
    top = {"u1": 255, "<u2": 65535}[kind]
    return f'<{name} type="Integer" minimum="0" maximum="{top}"/>'


def pose_xml(rotation: tuple[float, ...], translation: tuple[float, ...]) -> str:
    turn = "".join(f'<{k} type="Float">{v!r}</{k}>' for k, v in zip("wxyz", rotation, strict=True))
    place = "".join(
        f'<{k} type="Float">{v!r}</{k}>' for k, v in zip("xyz", translation, strict=True)
    )
    return (
        f'<pose type="Structure"><rotation type="Structure">{turn}</rotation>'
        f'<translation type="Structure">{place}</translation></pose>'
    )


def e57_file(
    path: Path,
    scans: list[dict],
    *,
    root: str = "",
    prolog: str = "",
    count: int | None = None,
    xml_first: bool = False,
    header: dict | None = None,
    encoding: str = "utf-8",
    spaces: str = "",
) -> Path:
    """Write an E57 file: each scan has `columns` {name: (kind, values)}, maybe `pose`, `limits`."""

    def xml(starts: list[int]) -> bytes:
        text = ""
        for scan, start in zip(scans, starts, strict=True):
            columns = scan["columns"]
            declared = count if count is not None else len(next(iter(columns.values()))[1])
            prototype = "".join(field(name, kind) for name, (kind, _) in columns.items())
            text += (
                f'<vectorChild type="Structure">{scan.get("limits", "")}{scan.get("pose", "")}'
                f'<points type="CompressedVector" fileOffset="{physical(start):08d}" '
                f'recordCount="{declared}"><prototype type="Structure">{prototype}</prototype>'
                '<codecs type="Vector" allowHeterogeneousChildren="1"/></points></vectorChild>'
            )
        return (
            f'<?xml version="1.0" encoding="UTF-8"?>{prolog}'
            f'<e57Root type="Structure" xmlns="{NS}"{spaces}>'
            f'{root}<data3D type="Vector" allowHeterogeneousChildren="1">{text}</data3D>'
            '<images2D type="Vector" allowHeterogeneousChildren="1"/></e57Root>'
        ).encode(encoding)

    length = len(xml([0] * len(scans)))
    at = 48 + (length + (-length % 4) if xml_first else 0)
    body, starts = b"", []
    for scan in scans:
        starts.append(at + len(body))
        body += section(list(scan["columns"].values()), starts[-1])
    text = xml(starts)
    start = 48 if xml_first else at + len(body)
    logical = b"\0" * 48 + (text + b"\0" * (-length % 4) + body if xml_first else body + text)
    size = len(pages(logical))
    values = {
        "size": size,
        "start": physical(start),
        "length": len(text),
        "page": 1024,
        "major": 1,
    } | (header or {})
    head = struct.pack(
        "<8sIIQQQQ",
        b"ASTM-E57",
        values["major"],
        0,
        values["size"],
        values["start"],
        values["length"],
        values["page"],
    )
    path.write_bytes(pages(head + logical[48:]))
    return path


def xyz_columns(points: np.ndarray) -> dict:
    names = ("cartesianX", "cartesianY", "cartesianZ")
    return {name: ("<f8", column) for name, column in zip(names, points.T, strict=True)}


def rgb_columns(colors: np.ndarray, kind: str = "u1") -> dict:
    names = ("colorRed", "colorGreen", "colorBlue")
    return {name: (kind, column) for name, column in zip(names, colors.T, strict=True)}


def absolute(survey: Survey) -> np.ndarray:
    return survey.geometry.points + survey.origin


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(5).uniform(-4, 4, (300, 3))


def two_scans(path: Path, points: np.ndarray, **options) -> tuple[Path, np.ndarray, np.ndarray]:
    """A turned cartesian scan and a spherical one elsewhere; what they hold is known exactly."""
    colors = (np.arange(900).reshape(300, 3) % 256).astype(np.uint8)
    rae = np.array([[2.0, 0.0, 0.0], [2.0, np.pi / 2, 0.0], [2.0, 0.0, np.pi / 2]])
    names = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
    ball = {name: ("<f8", column) for name, column in zip(names, rae.T, strict=True)}
    half = 0.5**0.5
    scans = [
        # 90 degrees about z: (x, y, z) goes to (-y, x, z).
        {
            "columns": xyz_columns(points) | rgb_columns(colors),
            "pose": pose_xml((half, 0.0, 0.0, half), (100.0, 200.0, -7.0)),
        },
        {
            "columns": ball | rgb_columns(np.full((3, 3), 9, np.uint8)),
            "pose": pose_xml((2.0, 0.0, 0.0, 0.0), (10.0, 0.0, 0.0)),  # not of unit length
        },
    ]
    x, y, z = points.T
    first = np.stack([-y + 100, x + 200, z - 7], axis=1)
    second = np.array([[12.0, 0, 0], [10, 2, 0], [10, 0, 2]])
    truth = np.concatenate([first, second])
    return e57_file(path, scans, **options), truth, np.concatenate([colors, np.full((3, 3), 9)])


@pytest.mark.parametrize("xml_first", [False, True])
def test_scans_pass_through_their_poses(tmp_path, points, xml_first):
    path, truth, colors = two_scans(tmp_path / "a.e57", points, xml_first=xml_first)
    survey = e57.read(path, ReadOptions())
    np.testing.assert_allclose(absolute(survey), truth, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(survey.geometry.colors, colors)
    assert survey.notes == ()
    assert survey.source[0].counts == {"points": 303, "scans": 2}
    assert survey.source[0].format == "e57"
    assert len(survey.source[0].sha256) == 64


def test_chunks_join_to_the_same_scan(tmp_path, points, monkeypatch):
    path, truth, colors = two_scans(tmp_path / "a.e57", points)
    monkeypatch.setattr(e57_scans, "CHUNK", 7)
    survey = e57.read(path, ReadOptions())
    np.testing.assert_allclose(absolute(survey), truth, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(survey.geometry.colors, colors)


def test_shift_and_axes_apply_after_the_pose(tmp_path, points):
    path, truth, _ = two_scans(tmp_path / "a.e57", points)
    survey = e57.read(path, ReadOptions(axes="ned", shift=(500000.0, 6e6, 1.0), crs="EPSG:32754"))
    expected = truth[:, [1, 0, 2]] * [1, 1, -1] + [500000.0, 6e6, 1.0]
    np.testing.assert_allclose(absolute(survey), expected, rtol=0, atol=2e-9)
    assert survey.crs == "EPSG:32754"


def test_crs_comes_from_the_file(tmp_path, points):
    root = '<coordinateMetadata type="String"><![CDATA[EPSG:32754]]></coordinateMetadata>'
    scan = {"columns": xyz_columns(points + np.array([5e5, 6e6, 0]))}
    assert e57.read(e57_file(tmp_path / "a.e57", [scan], root=root), ReadOptions()).crs == (
        "EPSG:32754"
    )
    root = '<coordinateMetadata type="String">the harbour</coordinateMetadata>'
    scan = {"columns": xyz_columns(points)}
    survey = e57.read(e57_file(tmp_path / "b.e57", [scan], root=root), ReadOptions())
    assert survey.crs is None
    assert "'the harbour' is not understood" in survey.notes[0]


def test_invalid_points_are_left_out_and_counted(tmp_path, points):
    state = (np.arange(300) % 3).astype(np.uint8)  # 1: direction only, 2: invalid
    points[3] = np.nan
    scan = {"columns": xyz_columns(points) | {"cartesianInvalidState": ("u1", state)}}
    survey = e57.read(e57_file(tmp_path / "a.e57", [scan]), ReadOptions())
    keep = (state == 0) & (np.arange(300) != 3)
    np.testing.assert_allclose(absolute(survey), points[keep], atol=1e-12)
    assert survey.notes == ("201 points marked invalid were left out.",)


@pytest.mark.parametrize(
    ("top", "values", "expected"),
    [
        (65535, [0, 257, 65535], [0, 1, 255]),  # 16 bits
        (65535, [0, 7, 255], [0, 7, 255]),  # 8 bits in a 16-bit field
        (1023, [0, 1023, 512], [0, 255, 128]),
    ],
)
def test_wide_colors_become_eight_bits(tmp_path, top, values, expected):
    limits = (
        '<colorLimits type="Structure">'
        + "".join(
            f'<color{c}{end} type="Integer">{value}</color{c}{end}>'
            for c in ("Red", "Green", "Blue")
            for end, value in (("Minimum", 0), ("Maximum", top))
        )
        + "</colorLimits>"
    )
    columns = xyz_columns(np.eye(3)) | rgb_columns(np.repeat([values], 3, 0).T, "<u2")
    path = e57_file(tmp_path / "a.e57", [{"columns": columns, "limits": limits}])
    survey = e57.read(path, ReadOptions())
    assert survey.geometry.colors[:, 0].tolist() == expected
    assert survey.notes == ("Colors of more than 8 bits were scaled to 8.",)


def test_colors_need_every_scan(tmp_path, points):
    scans = [
        {"columns": xyz_columns(points) | rgb_columns(np.zeros((300, 3), np.uint8))},
        {"columns": xyz_columns(points + 10)},
    ]
    survey = e57.read(e57_file(tmp_path / "a.e57", scans), ReadOptions())
    assert survey.geometry.colors is None
    assert len(survey.geometry.points) == 600
    assert survey.notes == ("Colors were left out, because not every scan has them.",)


@pytest.mark.parametrize(
    ("name", "count", "low", "high"),
    [
        ("tiny_spherical", 180, [0, -0.5, 0], [1, 0.5, 1]),
        ("tinyCartesianFloatRgb", 2090, [-9.7795, 4.5139, 295.5247], [-6.7742, 7.5155, 298.5322]),
        ("cartesian_invalid_state_single", 1, [-1, -2, -3], [-1, -2, -3]),
        ("las2e57_no_images_tag", 153, [-0.5] * 3, [0.5] * 3),
        ("tiny_pc_with_extension", 1, [1, 2, 3], [1, 2, 3]),
    ],
)
def test_files_of_other_writers(name, count, low, high):
    survey = e57.read(DATA / f"{name}.e57", ReadOptions())
    assert len(survey.geometry.points) == count
    np.testing.assert_allclose(survey.bounds, [low, high], atol=1e-3)


def test_real_colors():
    survey = e57.read(DATA / "tinyCartesianFloatRgb.e57", ReadOptions())
    np.testing.assert_allclose(
        survey.geometry.colors.mean(axis=0), [131.007, 121.248, 113.122], atol=1e-3
    )


def test_bad_checksum_is_said_plainly():
    with pytest.raises(InputError, match="checksum mismatch") as caught:
        e57.read(DATA / "corrupt_crc.e57", ReadOptions())
    assert "corrupt_crc.e57" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "prolog",
    [
        '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/hostname">]>',
        '<!DOCTYPE r SYSTEM "http://example.org/x.dtd">',
        "<!doctype r>",
        '<!-- --><! ENTITY x "y">',
    ],
)
def test_doctype_is_refused_before_the_library_sees_it(tmp_path, points, monkeypatch, prolog):
    root = "<guid type='String'>&x;</guid>"
    path = e57_file(
        tmp_path / "a.e57", [{"columns": xyz_columns(points)}], prolog=prolog, root=root
    )
    monkeypatch.setattr(e57_scans, "library", lambda path: pytest.fail("pye57 saw the file"))
    with pytest.raises(UnsafeReferenceError, match=r"DOCTYPE|ENTITY"):
        e57.read(path, ReadOptions())


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16"])
def test_doctype_does_not_hide_in_another_encoding(tmp_path, points, encoding):
    path = e57_file(
        tmp_path / "a.e57",
        [{"columns": xyz_columns(points)}],
        prolog="<!DOCTYPE r>",
        encoding=encoding,
    )
    with pytest.raises(InputError, match="not UTF-8"):
        e57.read(path, ReadOptions())


@pytest.mark.parametrize("padding", [b"", b" " * 5000])
def test_other_declared_encoding_is_refused(tmp_path, points, padding):
    path = e57_file(tmp_path / "a.e57", [{"columns": xyz_columns(points)}])
    layout = e57_xml.read_layout(path)
    xml = layout.xml.replace(b'encoding="UTF-8"', padding + b'encoding="UTF-7"')
    data = path.read_bytes()
    before = b"".join(data[i : i + 1020] for i in range(0, len(data), 1024))[: layout.xml_start]
    new = pages(before + xml)
    head = struct.pack("<QQQ", len(new), physical(layout.xml_start), len(xml))
    path.write_bytes(pages(before[:16] + head + before[40:] + xml))
    with pytest.raises(InputError, match="utf-7"):
        e57.read(path, ReadOptions())


@pytest.mark.parametrize(
    ("header", "text"),
    [
        ({"size": 10**6}, "declares 1000000 bytes"),
        ({"start": 10**6}, "places its XML section at byte 1000000"),
        ({"start": 0}, "places its XML section at byte 0"),
        ({"start": 1022}, "places its XML section"),
        ({"length": 10**7}, "runs past its end"),
        ({"page": 2048}, "pages of 2048"),
        ({"major": 2}, "version 2"),
    ],
)
def test_lying_headers(tmp_path, points, header, text):
    path = e57_file(tmp_path / "a.e57", [{"columns": xyz_columns(points)}], header=header)
    with pytest.raises(InputError, match=text) as caught:
        e57.read(path, ReadOptions())
    assert caught.value.place == "header"


@pytest.mark.parametrize("count", [10**12, 301, -1, 0])
def test_lying_point_counts(tmp_path, points, count):
    path = e57_file(tmp_path / "a.e57", [{"columns": xyz_columns(points)}], count=count)
    with pytest.raises(InputError):
        e57.read(path, ReadOptions())


@pytest.mark.parametrize("cut", [0, 20, 48, 1000, 1024, 5000])
def test_truncated_files(tmp_path, points, cut):
    path = e57_file(tmp_path / "a.e57", [{"columns": xyz_columns(points)}])
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError):
        e57.read(path, ReadOptions())


@pytest.mark.parametrize(
    ("root", "text"),
    [
        ("<a>" * 100 + "</a>" * 100, "deeper than 64"),
        ("<a></b>", "mismatched tag"),
    ],
)
def test_malformed_xml(tmp_path, points, root, text):
    path = e57_file(tmp_path / "a.e57", [{"columns": xyz_columns(points)}], root=root)
    with pytest.raises(InputError, match=text):
        e57.read(path, ReadOptions())


@pytest.mark.parametrize(
    ("rotation", "text"), [((0.0,) * 4, "not a rotation"), (("one", 0, 0, 0), "not a number")]
)
def test_bad_poses(tmp_path, points, rotation, text):
    pose = pose_xml(rotation, (0.0, 0.0, 0.0)).replace("'one'", "one")
    path = e57_file(tmp_path / "a.e57", [{"columns": xyz_columns(points), "pose": pose}])
    with pytest.raises(InputError, match=text):
        e57.read(path, ReadOptions())


def test_scan_without_coordinates(tmp_path, points):
    path = e57_file(tmp_path / "a.e57", [{"columns": {"intensity": ("<f8", points[:, 0])}}])
    with pytest.raises(InputError, match="no coordinates"):
        e57.read(path, ReadOptions())


def test_missing_library_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(e57_scans.MissingLibraryError) as caught:
        e57.read(DATA / "tiny_spherical.e57", ReadOptions())
    assert 'pip install "meshreg[e57]"' in str(caught.value)
    assert caught.value.exit_code == 3


def test_checksums_of_real_pages():
    data = (DATA / "tiny_spherical.e57").read_bytes()
    for start in range(0, len(data), 1024):
        page = data[start : start + 1020]
        assert e57_pages.page_checksum(page) == data[start + 1020 : start + 1024]
        assert e57_pages.page_checksum(page) == struct.pack(">I", crc32c(page))


def turn(angle: float, axis: str) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    if axis == "z":
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


MOVE = Transform(turn(0.3, "z") @ turn(0.05, "x"), 1.0, [1000.0, -20.0, 3.0], [5.0, 6.0, 7.0])
STRETCH = Transform(turn(0.3, "z"), 1.001, [1000.0, -20.0, 3.0], [5.0, 6.0, 7.0])


@pytest.mark.parametrize("xml_first", [False, True])
@pytest.mark.parametrize("transform", [MOVE, STRETCH])
def test_rewrite_moves_every_point(tmp_path, points, transform, xml_first):
    path, truth, colors = two_scans(tmp_path / "a.e57", points, xml_first=xml_first)
    survey = e57.read(path, ReadOptions())
    target = Frame(np.eye(3), [900.0, 0.0, 0.0])
    move = make_mover(survey.source[0], transform, target)
    out = tmp_path / "out.e57"
    assert e57.rewrite(survey.source[0], move, out) == (out,)
    again = e57.read(out, ReadOptions(shift=(900.0, 0.0, 0.0)))
    np.testing.assert_allclose(absolute(again), transform.apply(truth), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(again.geometry.colors, colors)
    assert again.source[0].counts["scans"] == 2
    back = make_mover(again.source[0], transform.inverse(), survey.source[0].frame)
    e57.rewrite(again.source[0], back, tmp_path / "back.e57")
    same = e57.read(tmp_path / "back.e57", ReadOptions())
    np.testing.assert_allclose(absolute(same), truth, rtol=0, atol=1e-9)


def test_rigid_rewrite_keeps_the_points_bytes(tmp_path, points):
    path, _, _ = two_scans(tmp_path / "a.e57", points)
    survey = e57.read(path, ReadOptions())
    e57.rewrite(survey.source[0], make_mover(survey.source[0], MOVE, Frame()), tmp_path / "o.e57")
    old, new = path.read_bytes(), (tmp_path / "o.e57").read_bytes()
    layout = e57_xml.read_layout(path)
    last = layout.xml_start // 1020 * 1024  # the page on which the XML begins
    assert last > 1024
    assert new[1024:last] == old[1024:last]
    assert new[48:1020] == old[48:1020]


def test_rigid_rewrite_moves_pictures_and_keeps_them(tmp_path):
    path = DATA / "tiny_pc_and_images.e57"
    survey = e57.read(path, ReadOptions())
    out = tmp_path / "o.e57"
    e57.rewrite(survey.source[0], make_mover(survey.source[0], MOVE, Frame()), out)
    old, new = e57_xml.read_layout(path), e57_xml.read_layout(out)
    assert len(new.entries) == len(old.entries) == 5
    assert [entry.kind for entry in new.entries] == [entry.kind for entry in old.entries]
    for before, after in zip(old.entries, new.entries, strict=True):
        np.testing.assert_allclose(after.translation, MOVE.apply(before.translation), atol=1e-9)
        expected = MOVE.rotation @ e57_scans.rotation_matrix(before.rotation)
        np.testing.assert_allclose(e57_scans.rotation_matrix(after.rotation), expected, atol=1e-12)
    for blob in (b"\x89PNG", b"\xff\xd8\xff"):
        assert path.read_bytes().count(blob) == out.read_bytes().count(blob)


def test_rewrite_states_the_new_crs(tmp_path, points):
    scan = {"columns": xyz_columns(points + np.array([5e5, 6e6, 0]))}
    path = e57_file(tmp_path / "a.e57", [scan])
    survey = e57.read(path, ReadOptions())
    target = Frame(np.eye(3), np.zeros(3), "EPSG:32754", "EPSG:32754")
    out = tmp_path / "o.e57"
    e57.rewrite(survey.source[0], make_mover(survey.source[0], Transform(), target), out)
    assert e57.read(out, ReadOptions()).crs == "EPSG:32754"
    again = e57.read(out, ReadOptions())
    e57.rewrite(
        again.source[0], make_mover(again.source[0], Transform(), Frame()), tmp_path / "p.e57"
    )
    assert e57_xml.read_layout(tmp_path / "p.e57").crs is None


@pytest.mark.parametrize(
    ("root", "pose"),
    [
        ('<coordinateMetadata type="String"/>', '<pose type="Structure"/>'),
        ('<coordinateMetadata type="String"></coordinateMetadata>', ""),
        ("", '<pose type="Structure"><translation type="Structure"/></pose>'),
        ('<a type="Structure"><a type="Integer"/></a>', '<pose type="Structure"></pose>'),
    ],
)
def test_rewrite_finds_the_elements_however_they_are_written(tmp_path, points, root, pose):
    scans = [{"columns": xyz_columns(points), "pose": pose}, {"columns": xyz_columns(points + 1)}]
    path = e57_file(tmp_path / "a.e57", scans, root=root)
    survey = e57.read(path, ReadOptions())
    target = Frame(np.eye(3), [0, 0, 1.0], "EPSG:32754", "EPSG:32754")
    utm = Transform(offset=[5e5, 6e6, 0.0])
    out = tmp_path / "o.e57"
    e57.rewrite(survey.source[0], make_mover(survey.source[0], utm, target), out)
    again = e57.read(out, ReadOptions(shift=(0, 0, 1.0)))
    assert again.crs == "EPSG:32754"
    expected = np.concatenate([points, points + 1]) + np.array([5e5, 6e6, 0])
    np.testing.assert_allclose(absolute(again), expected, rtol=0, atol=2e-9)


def test_intensity_survives_a_stretch(tmp_path, points):
    bright = np.arange(300.0)
    scan = {"columns": xyz_columns(points) | {"intensity": ("<f8", bright)}}
    survey = e57.read(e57_file(tmp_path / "a.e57", [scan]), ReadOptions())
    out = tmp_path / "o.e57"
    e57.rewrite(survey.source[0], make_mover(survey.source[0], STRETCH, Frame()), out)
    scan = e57_xml.read_layout(out).scans[0]
    with e57_scans.opened(out) as decoder:
        pieces = list(e57_scans.pieces(decoder, 0, scan, ("intensity",)))
    np.testing.assert_array_equal(pieces[0].extra["intensity"], bright)


NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
NORMAL_SPACE = ' xmlns:nor="http://www.libe57.org/E57_EXT_surface_normals.txt"'


@pytest.mark.parametrize("rigid", [True, False])
def test_normals_turn_with_their_scan(tmp_path, points, rigid):
    """A rigid move turns the scan's frame, in which they are; any other one the normals."""
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    columns = xyz_columns(points)
    columns |= {name: ("<f8", column) for name, column in zip(NORMALS, normals.T, strict=True)}
    half = 0.5**0.5
    scan = {"columns": columns, "pose": pose_xml((half, 0.0, 0.0, half), (100.0, 200.0, -7.0))}
    path = e57_file(tmp_path / "a.e57", [scan], spaces=NORMAL_SPACE)
    survey = e57.read(path, ReadOptions())
    assert survey.notes == ()
    about = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    move = Transform(about, 1.0 if rigid else 1.02, (1, 2, 3))
    out = tmp_path / "o.e57"
    e57.rewrite(survey.source[0], make_mover(survey.source[0], move, Frame()), out)
    entry = e57_xml.read_layout(out).scans[0]
    with e57_scans.opened(out) as decoder:
        (piece,) = e57_scans.pieces(decoder, 0, entry, NORMALS)
        local = np.stack([piece.extra[name] for name in NORMALS], axis=1)
    w, x, y, z = entry.rotation
    frame = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(local @ frame.T, normals @ (about @ quarter).T, atol=1e-12)


def test_classes_of_noise_and_water_are_left_out(tmp_path, points):
    classes = np.full(300, 40, np.uint8)
    classes[:50], classes[50:60], classes[60:63], classes[70] = 41, 45, 7, 9
    columns = xyz_columns(points) | rgb_columns(np.full((300, 3), 9, np.uint8))
    columns |= {"las:Classification": ("u1", classes)}
    space = ' xmlns:las="http://example.org/las"'
    survey = e57.read(
        e57_file(tmp_path / "a.e57", [{"columns": columns}], spaces=space), ReadOptions()
    )
    np.testing.assert_allclose(absolute(survey), points[classes == 40], atol=1e-12)
    assert len(survey.geometry.colors) == 236
    assert survey.notes[0].startswith("3 points classed as noise")
    assert survey.notes[1].startswith("61 points classed as water")
    columns["las:Classification"] = ("u1", np.full(300, 41, np.uint8))
    with pytest.raises(InputError, match="300 points classed as water"):
        e57.read(e57_file(tmp_path / "b.e57", [{"columns": columns}], spaces=space), ReadOptions())


def test_rewrite_refuses_a_file_that_has_changed(tmp_path, points):
    path, _, _ = two_scans(tmp_path / "a.e57", points)
    survey = e57.read(path, ReadOptions())
    two_scans(path, points + 1)
    path.touch()
    with pytest.raises(InputError, match="has changed"):
        e57.rewrite(
            survey.source[0], make_mover(survey.source[0], MOVE, Frame()), tmp_path / "o.e57"
        )
    assert not (tmp_path / "o.e57").exists()


def test_a_wrong_result_is_not_kept(tmp_path, points, monkeypatch):
    path, _, _ = two_scans(tmp_path / "a.e57", points)
    survey = e57.read(path, ReadOptions())
    out = tmp_path / "o.e57"
    out.write_bytes(b"old")
    monkeypatch.setattr(
        e57, "_rewrite_poses", lambda old, layout, move, new: new.write_bytes(old.read_bytes())
    )
    with pytest.raises(OutputError, match="off by"):
        e57.rewrite(survey.source[0], make_mover(survey.source[0], MOVE, Frame()), out)
    assert out.read_bytes() == b"old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.e57", "o.e57"]


@pytest.mark.parametrize("with_color", [True, False])
def test_write_reads_back(tmp_path, points, with_color):
    colors = (points * 30 + 120).astype(np.uint8) if with_color else None
    origin = np.array([512345.0, 8654321.0, -12.0])
    survey = Survey("reef", PointCloud(points, colors), origin, "EPSG:32755")
    assert e57.write(survey, tmp_path / "o.e57") == (tmp_path / "o.e57",)
    again = e57.read(tmp_path / "o.e57", ReadOptions())
    np.testing.assert_allclose(absolute(again), points + origin, rtol=0, atol=2e-9)
    assert again.crs == "EPSG:32755"
    if with_color:
        np.testing.assert_array_equal(again.geometry.colors, colors)
    else:
        assert again.geometry.colors is None


def test_a_mesh_is_not_written(tmp_path, points):
    survey = Survey("reef", Mesh(points, np.zeros((0, 3), np.int32)))
    with pytest.raises(UsageError, match="holds points, not a Mesh"):
        e57.write(survey, tmp_path / "o.e57")
    assert not list(tmp_path.iterdir())
