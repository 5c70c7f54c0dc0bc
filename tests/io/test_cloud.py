"""LAS, LAZ and COPC: real files, made files, damaged files, moved files. laspy makes the truth."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reference_io import utm
from scipy.spatial.transform import Rotation

from meshreg.errors import InputError, MeshregError, OutputError
from meshreg.io import read_survey, rewrite_survey, write_survey
from meshreg.records import Frame, PointCloud, SourceFile, Survey, Transform

DATA = Path(__file__).parent.parent / "data" / "las"
BEACH = np.array([731_500.0, 5_705_400.0, 3.0])


def made(
    path,
    xyz=None,
    n=500,
    form=7,
    crs=None,
    scale=0.001,
    seed=3,
    **columns,
):
    """Write n random points (or given ones) with laspy; return their coordinates as stored."""
    rng = np.random.default_rng(seed)
    if xyz is None:
        xyz = BEACH + rng.uniform(-20, 20, (n, 3))
    header = laspy.LasHeader(version="1.4", point_format=form)
    header.scales, header.offsets = np.broadcast_to(scale, 3), np.floor(np.min(xyz, axis=0))
    if crs is not None:
        header.add_crs(pyproj.CRS(crs))
    data = laspy.LasData(header)
    data.x, data.y, data.z = np.asarray(xyz, float).T
    for name, values in columns.items():
        data[name] = values
    data.write(path)
    return np.stack([data.x, data.y, data.z], axis=1)


def absolute(survey: Survey) -> np.ndarray:
    return survey.geometry.points + survey.origin


def patched(path, name, offset, form, *values):
    """Return a copy of a file with some bytes of its header replaced."""
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, offset, *values)
    out = path.with_name(name)
    out.write_bytes(content)
    return out


def turned(angle=0.02, **rest):
    c, s = math.cos(angle), math.sin(angle)
    return Transform(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), **rest)


# --- reading


# lazrs does not compress waveforms (4, 5, 9, 10).
FORMS = [(".las", form) for form in range(11)] + [(".laz", form) for form in (0, 1, 2, 3, 6, 7, 8)]


@pytest.mark.parametrize(("suffix", "form"), FORMS)
def test_every_point_format(tmp_path, suffix, form):
    path = tmp_path / f"reef{suffix}"
    xyz = made(path, form=form, crs="EPSG:32754")
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(xyz, rel=0, abs=2e-9)
    assert survey.crs == "EPSG:32754"
    assert survey.geometry.colors is None  # black all over: nobody filled them
    assert survey.source[0].counts["points"] == 500
    assert survey.notes == ()
    assert survey.name == "reef"


@pytest.mark.parametrize("largest", [255, 256, 65535])
def test_colors_of_8_and_16_bits(tmp_path, largest):
    rng = np.random.default_rng(5)
    rgb = rng.integers(0, largest + 1, (500, 3)).astype(np.uint16)
    rgb[0] = largest
    made(tmp_path / "a.las", red=rgb[:, 0], green=rgb[:, 1], blue=rgb[:, 2])
    survey = read_survey(tmp_path / "a.las")
    if largest == 255:
        assert (survey.geometry.colors == rgb).all()
        assert "8-bit values" in survey.notes[0]
    else:
        assert np.abs(survey.geometry.colors - rgb / 257).max() <= 0.5
    assert read_survey(tmp_path / "a.las", geometry_only=True).geometry.colors is None


@pytest.mark.parametrize("form", [3, 7])
def test_withheld_and_noise_are_left_out_and_counted(tmp_path, form):
    classes = np.zeros(500, np.uint8)
    classes[:7], classes[10:14], classes[20:30] = 7, 18, 9
    withheld = np.zeros(500, bool)
    withheld[[0, 100, 101]] = True
    xyz = made(tmp_path / "a.las", form=form, classification=classes, withheld=withheld)
    survey = read_survey(tmp_path / "a.las")
    keep = ~withheld & (classes != 7) & (classes != 18)
    assert absolute(survey) == pytest.approx(xyz[keep], abs=2e-9)
    assert survey.notes == (
        "3 points flagged withheld were left out.",
        "10 points classed as noise (7, 18) were left out.",
    )
    assert survey.source[0].counts == {"points": 500, "used": 487}


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_water_over_a_bed_is_left_out_and_counted(tmp_path, suffix):
    classes = np.full(500, 40, np.uint8)
    classes[100:300] = 41
    classes[300:310], classes[310:315], classes[320:327] = 42, 45, 9
    classes[330:340], classes[490:] = 18, 2
    path = tmp_path / f"a{suffix}"
    xyz = made(path, form=7, classification=classes)
    survey = read_survey(path)
    keep = np.isin(classes, (2, 40))
    assert absolute(survey) == pytest.approx(xyz[keep], abs=2e-9)
    assert survey.notes == (
        "10 points classed as noise (7, 18) were left out.",
        "222 points classed as water (9, 41, 42, 45) were left out; the bed is 40.",
    )
    files = rewrite_survey(survey, Transform(offset=(1, 2, 3)), tmp_path / "out")
    again = laspy.read(files[0])  # the registered file keeps them all
    assert (np.asarray(again.classification) == classes).all()
    assert again.xyz == pytest.approx(np.add(xyz, (1, 2, 3)), abs=5.1e-5)


def test_nothing_but_water_is_refused_with_a_remedy(tmp_path):
    made(tmp_path / "a.las", form=6, classification=np.full(500, 41, np.uint8))
    with pytest.raises(InputError, match="500 points classed as water") as bad:
        read_survey(tmp_path / "a.las")
    assert "40 bed" in bad.value.remedy


def test_nothing_but_noise_is_refused(tmp_path):
    made(tmp_path / "a.las", classification=np.full(500, 7, np.uint8))
    with pytest.raises(InputError, match="no usable point"):
        read_survey(tmp_path / "a.las")


def test_nan_and_strays_are_left_out_and_counted(tmp_path):
    xyz = made(tmp_path / "a.las")
    data = laspy.read(tmp_path / "a.las")
    data.X[3] = np.iinfo(np.int32).min  # what laspy makes of NaN
    data.X[4] = data.Y[4] = np.iinfo(np.int32).max
    data.write(tmp_path / "a.las")
    survey = read_survey(tmp_path / "a.las")
    assert absolute(survey) == pytest.approx(np.delete(xyz, [3, 4], axis=0), abs=2e-9)
    assert survey.notes == (
        "1 points without coordinates were left out.",
        "1 points far away from all others were left out.",
    )


def test_corrupt_bounds_in_the_header_do_not_matter(tmp_path):
    xyz = made(tmp_path / "a.las")
    path = patched(tmp_path / "a.las", "b.las", 179, "<6d", *([float("nan")] * 3 + [1e300] * 3))
    assert read_survey(path).bounds == pytest.approx(np.stack([xyz.min(0), xyz.max(0)]))


def test_chunks_are_put_together_in_order(tmp_path, monkeypatch):
    from meshreg.io.las import read as cloud

    xyz = made(tmp_path / "a.laz", n=1000)
    monkeypatch.setattr(cloud, "_CHUNK_BYTES", 36 * 77)
    assert absolute(read_survey(tmp_path / "a.laz")) == pytest.approx(xyz, abs=2e-9)


def test_a_local_cloud_is_local(tmp_path):
    made(tmp_path / "a.las")
    assert read_survey(tmp_path / "a.las").crs is None


def test_degrees_become_metres(tmp_path):
    lonlat = np.array([[143.66, -38.77, 2.0], [143.661, -38.771, 3.0], [143.66, -38.771, 4.0]])
    made(tmp_path / "a.las", lonlat, crs="EPSG:7844", scale=[1e-9, 1e-9, 1e-4])
    survey = read_survey(tmp_path / "a.las")
    assert survey.crs == "EPSG:7854"
    expected = [(*utm(lon, lat, 54), up) for lon, lat, up in lonlat]
    assert absolute(survey) == pytest.approx(np.array(expected), rel=0, abs=3e-4)


def test_feet_become_metres_heights_too(tmp_path):
    feet = np.array([[637_000.0, 851_000, 450], [637_100, 851_000, 460], [637_000, 851_100, 470]])
    made(tmp_path / "a.las", feet, crs="EPSG:2992")
    survey = read_survey(tmp_path / "a.las")
    assert "taken in 0.3048 m, too" in survey.notes[-1]
    points = absolute(survey)
    assert points[:, 2] == pytest.approx([137.16, 140.208, 143.256])
    lengths = np.linalg.norm(points[1:, :2] - points[0, :2], axis=1)
    assert lengths == pytest.approx([30.48, 30.48], rel=1e-3)


# --- real files (from laspy's tests)


def test_autzen_in_feet():
    survey = read_survey(DATA / "autzen.las")
    assert survey.crs == "EPSG:3740"
    assert len(survey.geometry.points) == 106
    assert survey.bounds[:, 2] == pytest.approx([407.35 * 0.3048, 536.84 * 0.3048])
    assert "EPSG:2994" in survey.notes[0]


def test_copc_with_heights_in_feet():
    survey = read_survey(DATA / "simple.copc.laz")
    assert survey.name == "simple"
    assert survey.crs == "EPSG:2991+5703"
    assert survey.bounds[:, 2] == pytest.approx(np.array([406.59, 586.38]) * 1200 / 3937)
    assert survey.bounds[:, :2] == pytest.approx(
        np.array([[635619.85, 848899.70], [638982.55, 853535.43]])
    )


def test_a_crs_that_is_not_understood_is_local_and_said():
    survey = read_survey(DATA / "plane.laz")
    assert survey.crs is None
    assert "not understood" in survey.notes[0]


def test_laz_holds_what_las_holds():
    data = laspy.read(DATA / "extra.laz")
    survey = read_survey(DATA / "extra.laz")
    assert absolute(survey) == pytest.approx(np.stack([data.x, data.y, data.z], axis=1))
    rgb = np.stack([data.red, data.green, data.blue], axis=1)
    assert (survey.geometry.colors == rgb).all()


# --- damage


def test_a_file_cut_at_a_record_is_refused(tmp_path):
    made(tmp_path / "a.las")
    content = (tmp_path / "a.las").read_bytes()
    record = struct.unpack_from("<H", content, 105)[0]
    for cut in (record, 100 * record, record // 2, 499 * record):
        (tmp_path / "b.las").write_bytes(content[:-cut])
        with pytest.raises(InputError, match="declares 500 points") as bad:
            read_survey(tmp_path / "b.las")
        assert bad.value.place == "header"


@pytest.mark.parametrize("keep", [4, 100, 226, 300, 374, 380])
def test_a_file_cut_in_its_header_is_refused(tmp_path, keep):
    made(tmp_path / "a.las", crs="EPSG:32754")
    (tmp_path / "b.las").write_bytes((tmp_path / "a.las").read_bytes()[:keep])
    with pytest.raises(InputError, match=r"b\.las"):
        read_survey(tmp_path / "b.las")


@pytest.mark.parametrize(
    ("offset", "form", "values", "message"),
    [
        (100, "<I", (2**31,), "declares 2147483648 VLRs"),
        (100, "<I", (3,), "VLRs"),
        (96, "<I", (2**32 - 1,), "points from byte 4294967295"),
        (96, "<I", (10,), "points from byte 10"),
        (94, "<H", (20,), "header of 20 bytes"),
        (24, "<BB", (3, 1), r"version \(3\.1\)"),
        (25, "<B", (9,), r"version \(1\.9\)"),
        (104, "<B", (11,), "point format 11"),
        (105, "<H", (10,), "records of 10 bytes"),
        (105, "<H", (65535,), "declares 500 points"),
        (247, "<Q", (2**40,), "declares 1099511627776 points"),
        (247, "<Q", (501,), "declares 501 points"),
        (247, "<Q", (0,), "holds no points"),
        (131, "<3d", (0.0, 0.001, 0.001), "scale"),
        (131, "<3d", (0.001, float("nan"), 0.001), "scale"),
        (131, "<3d", (0.001, 0.001, float("inf")), "scale"),
        (155, "<3d", (float("nan"), 0.0, 0.0), "offset"),
        (155, "<3d", (0.0, float("inf"), 0.0), "offset"),
        (155, "<3d", (0.0, 0.0, 1e300), "offset"),
        (235, "<QI", (2**50, 1), "EVLRs at byte"),
        (235, "<QI", (400, 2**32 - 1), "EVLRs"),
    ],
)
def test_a_lying_header_is_refused_before_memory_is_asked_for(
    tmp_path, offset, form, values, message
):
    made(tmp_path / "a.las", crs="EPSG:32754")
    path = patched(tmp_path / "a.las", "b.las", offset, form, *values)
    with pytest.raises(InputError, match=message) as bad:
        read_survey(path)
    assert bad.value.file.endswith("b.las")
    assert bad.value.remedy


@pytest.mark.parametrize("count", [2**40, 10**9, 501])
def test_a_lying_count_of_a_laz_is_refused(tmp_path, count):
    made(tmp_path / "a.laz")
    path = patched(tmp_path / "a.laz", "b.laz", 247, "<Q", count)
    with pytest.raises(InputError):
        read_survey(path)


def test_a_vlr_that_runs_into_the_points_is_refused(tmp_path):
    made(tmp_path / "a.las", crs="EPSG:32754")
    path = patched(tmp_path / "a.las", "b.las", 375 + 20, "<H", 65535)
    with pytest.raises(InputError, match="runs beyond"):
        read_survey(path)


def test_a_cut_laz_is_refused(tmp_path):
    made(tmp_path / "a.laz", n=5000)
    content = (tmp_path / "a.laz").read_bytes()
    for keep in (0.3, 0.6, 0.9, 0.99):
        (tmp_path / "b.laz").write_bytes(content[: int(keep * len(content))])
        with pytest.raises(InputError, match=r"b\.laz"):
            read_survey(tmp_path / "b.laz")


def laz_parts(path):
    """Return a LAZ file's bytes, where its points, chunk table and LASzip record start."""
    content = bytearray(path.read_bytes())
    start = struct.unpack_from("<I", content, 96)[0]
    table = struct.unpack_from("<q", content, start)[0]
    record = content.index(b"laszip encoded") - 2 + 54
    return content, start, table, record


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("chunks", "chunks"),
        ("table", "chunk table at byte"),
        ("chunk size", "chunks of 4000000000 points"),
        ("no record", "no LASzip record"),
        ("items", "items"),
        ("item size", "compresses others"),
        ("layers", "bytes of layers in chunk 1"),
    ],
)
def test_a_lying_laz_is_refused_before_memory_is_asked_for(tmp_path, what, message):
    """Each of these made lazrs ask for gigabytes; a failed allocation there ends the process."""
    made(tmp_path / "a.laz")
    content, start, table, record = laz_parts(tmp_path / "a.laz")
    where, form, value = {
        "chunks": (table + 4, "<I", 2**32 - 20),
        "table": (start, "<q", 2**60),
        "chunk size": (record + 12, "<I", 4_000_000_000),
        "no record": (record - 36, "<H", 1),
        "items": (record + 32, "<H", 65535),
        "item size": (record + 36, "<H", 65535),
        "layers": (start + 8 + 36 + 4, "<I", 2**32 - 1),
    }[what]
    struct.pack_into(form, content, where, value)
    (tmp_path / "b.laz").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_survey(tmp_path / "b.laz")


def test_a_laz_written_as_a_stream_has_its_table_named_at_the_end(tmp_path):
    xyz = made(tmp_path / "a.laz")
    content, start, table, _ = laz_parts(tmp_path / "a.laz")
    struct.pack_into("<q", content, start, -1)
    (tmp_path / "b.laz").write_bytes(content + struct.pack("<q", table))
    assert absolute(read_survey(tmp_path / "b.laz")) == pytest.approx(xyz, abs=2e-9)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    made(folder / "a.las", crs="EPSG:32754")
    made(folder / "a.laz", crs="EPSG:32754")
    return {suffix: (folder / f"a{suffix}").read_bytes() for suffix in (".las", ".laz")}


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@given(data=st.data())
@settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_random_damage_reads_or_is_refused_and_nothing_else(tmp_path, good, suffix, data):
    content = bytearray(good[suffix])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(4, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / f"damaged{suffix}"
    path.write_bytes(content)
    try:
        survey, refusal = read_survey(path), None
    except MeshregError as error:  # and no other
        survey, refusal = None, error
    if survey is None:
        assert refusal.exit_code == 3
        assert str(path) in str(refusal)
    else:
        assert 0 < len(survey.geometry.points) <= 500


def test_a_panic_below_python_becomes_an_input_error(tmp_path, monkeypatch):
    class PanicException(BaseException):
        """What pyo3 raises when Rust panics."""

    def panic(*args):
        raise PanicException("index out of bounds")

    made(tmp_path / "a.laz")
    monkeypatch.setattr(laspy.LasReader, "chunk_iterator", panic)
    with pytest.raises(InputError, match="PanicException: index out of bounds"):
        read_survey(tmp_path / "a.laz")

    def interrupt(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(laspy.LasReader, "chunk_iterator", interrupt)
    with pytest.raises(KeyboardInterrupt):
        read_survey(tmp_path / "a.laz")


# --- writing


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("colored", [False, True])
@pytest.mark.parametrize("crs", [None, "EPSG:32754", "EPSG:32754+5711"])
def test_a_new_file_is_las_1_4_in_steps_of_a_tenth_millimetre(tmp_path, suffix, colored, crs):
    rng = np.random.default_rng(6)
    points = rng.uniform(-300, 300, (2000, 3))
    colors = rng.integers(0, 256, (2000, 3)).astype(np.uint8) if colored else None
    survey = Survey("reef", PointCloud(points, colors), np.round(BEACH), crs)
    (path,) = write_survey(survey, tmp_path / f"new{suffix}")
    data = laspy.read(path)
    assert str(data.header.version) == "1.4"
    assert data.header.point_format.id == (7 if colored else 6)
    assert data.header.scales == pytest.approx([1e-4] * 3)
    assert np.stack([data.x, data.y, data.z], axis=1) == pytest.approx(
        points + np.round(BEACH), rel=0, abs=5.01e-5
    )
    assert set(data.return_number) == set(data.number_of_returns) == {1}
    if colored:
        rgb = np.stack([data.red, data.green, data.blue], axis=1)
        assert (rgb == colors.astype(np.uint16) * 257).all()
    assert (data.header.parse_crs() is None) == (crs is None)
    again = read_survey(path)
    assert again.crs == crs
    assert again.notes == ()


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    survey = Survey("reef", PointCloud(np.random.default_rng(1).uniform(0, 9, (50, 3))))
    path = tmp_path / "new.las"
    path.write_bytes(b"old")

    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(laspy.LasWriter, "write_points", full)
    with pytest.raises(OutputError):
        write_survey(survey, path)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["new.las"]


def test_a_file_that_reads_back_otherwise_is_not_kept(tmp_path, monkeypatch):
    from meshreg.io.las import write as cloud_write

    sums = iter(range(100))
    monkeypatch.setattr(cloud_write.zlib, "crc32", lambda content: next(sums))
    survey = Survey("reef", PointCloud(np.random.default_rng(1).uniform(0, 9, (50, 3))))
    with pytest.raises(OutputError, match="does not read back"):
        write_survey(survey, tmp_path / "new.laz")
    assert not list(tmp_path.iterdir())


def test_a_wide_extent_gets_coarser_steps(tmp_path):
    points = np.array([[-400_000.0, 0, 0], [400_000.0, 10, 10], [0, 5, 5]])
    (path,) = write_survey(Survey("wide", PointCloud(points)), tmp_path / "wide.las")
    header = laspy.read(path).header
    assert header.scales == pytest.approx([1e-3, 1e-4, 1e-4])
    assert absolute(read_survey(path)) == pytest.approx(points, abs=5.1e-4)


# --- rewriting


def test_all_but_the_coordinates_stays(tmp_path):
    source = DATA / "extra.laz"
    survey = read_survey(source)
    move = turned(offset=(13.4, -8.7, 1.25), pivot=survey.centre)
    (path,) = rewrite_survey(survey, move, tmp_path)
    assert path.name == "extra_registered.laz"
    before, after = laspy.read(source), laspy.read(path)
    assert after.header.point_format == before.header.point_format
    assert after.header.version == before.header.version
    assert after.header.creation_date == before.header.creation_date
    assert after.header.scales == pytest.approx([1e-4] * 3)
    for name in before.point_format.dimension_names:
        if name not in ("X", "Y", "Z"):
            assert (np.asarray(after[name]) == np.asarray(before[name])).all(), name
    old = np.stack([before.x, before.y, before.z], axis=1)
    new = np.stack([after.x, after.y, after.z], axis=1)
    assert new == pytest.approx(move.apply(old), rel=0, abs=5.01e-5)
    assert after.header.mins == pytest.approx(new.min(axis=0))
    assert after.header.maxs == pytest.approx(new.max(axis=0))


def test_records_and_crs_stay_where_the_crs_stays(tmp_path):
    source = DATA / "1_4_w_evlr.laz"
    survey = read_survey(source)
    (path,) = rewrite_survey(survey, turned(pivot=survey.centre), tmp_path)
    with laspy.open(source) as before, laspy.open(path) as after:
        for old, new in ((before.header.vlrs, after.header.vlrs), (before.evlrs, after.evlrs)):
            old, new = (
                [(v.user_id, v.record_id, v.record_data_bytes()) for v in records]
                for records in (old, new)
            )
            assert [v for v in old if v[1] != 22204] == [v for v in new if v[1] != 22204]
    again = read_survey(path)
    assert again.crs == survey.crs
    assert absolute(again) == pytest.approx(
        turned(pivot=survey.centre).apply(absolute(survey)), abs=3e-5
    )


@pytest.mark.parametrize("name", ["unregistered_extra_bytes.las", "simple1_3.las", "autzen.las"])
def test_odd_real_files_are_moved_and_moved_back(tmp_path, name):
    survey = read_survey(DATA / name)
    move = turned(offset=(5, 6, 7), pivot=survey.centre)
    (there,) = rewrite_survey(survey, move, tmp_path / "there")
    moved = read_survey(there)
    assert absolute(moved) == pytest.approx(move.apply(absolute(survey)), rel=0, abs=6e-5)
    (back,) = rewrite_survey(moved, move.inverse(), tmp_path / "back", survey)
    assert absolute(read_survey(back)) == pytest.approx(absolute(survey), rel=0, abs=1.3e-4)


def test_copc_becomes_plain_laz(tmp_path):
    survey = read_survey(DATA / "simple.copc.laz")
    (path,) = rewrite_survey(survey, turned(pivot=survey.centre), tmp_path)
    assert path.name == "simple_registered.laz"
    with laspy.open(path) as reader:
        assert not [v for v in reader.header.vlrs if v.user_id == "copc"]
        assert not [v for v in reader.evlrs if v.user_id == "copc"]
    again = read_survey(path)
    assert again.crs == survey.crs
    # A COPC file is read in its own order, and so is the new one written.
    assert absolute(again) == pytest.approx(
        turned(pivot=survey.centre).apply(absolute(survey)), rel=0, abs=6e-5
    )
    assert (again.geometry.colors == survey.geometry.colors).all()


def in_frame(frame: Frame) -> Survey:
    source = SourceFile(Path("home.obj"), "obj", frame)
    return Survey("home", PointCloud(np.zeros((1, 3))), crs=frame.crs, source=(source,))


def test_local_coordinates_carry_no_crs_but_a_sidecar(tmp_path):
    made(tmp_path / "a.las", crs="EPSG:32754")
    survey = read_survey(tmp_path / "a.las")
    home = in_frame(Frame(shift=(731_000, 5_705_000, 0), file_crs="EPSG:32754", crs="EPSG:32754"))
    files = rewrite_survey(survey, Transform(offset=(1, 2, 3)), tmp_path / "out", home)
    assert [path.name for path in files] == [
        "a_registered.las",
        "a_registered_offset.xyz",
        "a_registered.survey.toml",
    ]
    data = laspy.read(files[0])
    assert data.header.parse_crs() is None
    local = np.stack([data.x, data.y, data.z], axis=1)
    expected = np.subtract(np.add(absolute(survey), (1, 2, 3)), (731_000, 5_705_000, 0))
    assert local == pytest.approx(expected, rel=0, abs=5.01e-5)
    again = read_survey(files[0])
    assert again.crs == "EPSG:32754"
    assert absolute(again) == pytest.approx(np.add(absolute(survey), (1, 2, 3)), abs=6e-5)
    # Back into a frame without shift the CRS is stated in the file again.
    (back,) = rewrite_survey(again, Transform(offset=(-1, -2, -3)), tmp_path / "back", survey)
    assert laspy.read(back).header.parse_crs().to_epsg() == 32754
    assert absolute(read_survey(back)) == pytest.approx(absolute(survey), abs=1.3e-4)


def test_the_crs_is_replaced_by_the_references(tmp_path):
    made(tmp_path / "a.las", crs="EPSG:28354", form=6)
    survey = read_survey(tmp_path / "a.las")
    home = in_frame(Frame(file_crs="EPSG:7854", crs="EPSG:7854"))
    (path,) = rewrite_survey(survey, Transform(), tmp_path / "out", home)
    assert laspy.read(path).header.parse_crs().to_epsg() == 7854
    moved = absolute(read_survey(path)) - absolute(survey)
    assert moved == pytest.approx(np.broadcast_to((0.570, 1.454, 0), (500, 3)), abs=2e-3)


def test_into_a_file_in_degrees_and_back(tmp_path):
    made(tmp_path / "a.las", crs="EPSG:7854")
    survey = read_survey(tmp_path / "a.las")
    home = in_frame(Frame(file_crs="EPSG:7844", crs="EPSG:7854"))
    move = turned(offset=(3, 4, 5), pivot=survey.centre)
    (path,) = rewrite_survey(survey, move, tmp_path / "out", home)
    data = laspy.read(path)
    assert data.header.scales == pytest.approx([1e-9, 1e-9, 1e-4])
    assert np.mean(data.x) == pytest.approx(143.66, abs=0.1)
    again = read_survey(path)
    assert absolute(again) == pytest.approx(move.apply(absolute(survey)), rel=0, abs=1.2e-4)


def test_normals_of_cloudcompare_turn_along(tmp_path):
    rng = np.random.default_rng(8)
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.add_extra_dims(
        [laspy.ExtraBytesParams(f"Normal{axis}", np.float32) for axis in "XYZ"]
        + [laspy.ExtraBytesParams("confidence", np.float64)]
    )
    header.scales = [0.001] * 3
    data = laspy.LasData(header)
    data.x, data.y, data.z = rng.uniform(0, 9, (3, 500))
    data.NormalX, data.NormalY, data.NormalZ = normals.T
    data.confidence = rng.uniform(size=500)
    data.write(tmp_path / "a.las")
    move = turned(0.7, offset=(1, 2, 3))
    (path,) = rewrite_survey(read_survey(tmp_path / "a.las"), move, tmp_path / "out")
    after = laspy.read(path)
    turned_normals = np.stack([after.NormalX, after.NormalY, after.NormalZ], axis=1)
    assert turned_normals == pytest.approx(normals @ move.rotation.T, abs=2e-7)
    assert (after.confidence == data.confidence).all()


def test_points_without_coordinates_stay_so(tmp_path):
    made(tmp_path / "a.las")
    data = laspy.read(tmp_path / "a.las")
    data.X[3] = np.iinfo(np.int32).min
    data.write(tmp_path / "a.las")
    survey = read_survey(tmp_path / "a.las")
    (path,) = rewrite_survey(survey, turned(pivot=survey.centre), tmp_path / "out")
    again = read_survey(path)
    assert "1 points without coordinates" in again.notes[0]
    assert len(again.geometry.points) == 499
    assert laspy.read(path).header.scales == pytest.approx([1e-4] * 3)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_directions_in_any_kind_of_extra_dimension_turn(tmp_path, suffix):
    rng = np.random.default_rng(12)
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    made(tmp_path / "a.las")
    data = laspy.read(tmp_path / "a.las")
    extra = laspy.ExtraBytesParams
    steps = {"scales": np.array([1e-4]), "offsets": np.array([0.0])}
    data.add_extra_dims(
        [
            *(extra(f"normal {axis}", "i2", **steps) for axis in "xyz"),
            extra("Normals", "3f4"),
            extra("Dip direction", "f4"),
            *(extra(f"n{axis}", "u1") for axis in "xyz"),
        ]
    )
    for k, axis in enumerate("xyz"):
        data[f"normal {axis}"] = normals[:, k]
        data[f"n{axis}"] = np.full(500, 7)
    data["Normals"] = normals
    data["Dip direction"] = np.full(500, 90)
    path = tmp_path / f"b{suffix}"
    data.write(path)
    survey = read_survey(path)
    assert survey.notes == (
        "Attributes that depend on the survey's orientation are not turned with it: "
        "'Dip direction', 'nx', 'ny', 'nz'.",
    )
    turn = Rotation.from_rotvec([0.2, -0.1, 0.9]).as_matrix()
    files = rewrite_survey(survey, Transform(turn, pivot=survey.centre), tmp_path / "out")
    after = laspy.read(files[0])
    expected = normals @ turn.T
    assert np.asarray(after["Normals"]) == pytest.approx(expected, abs=2e-7)
    turned = np.stack([np.asarray(after[f"normal {axis}"]) for axis in "xyz"], axis=1)
    assert turned == pytest.approx(expected, abs=1.5e-4)  # two roundings to 1e-4
    assert (np.asarray(after["Dip direction"]) == 90).all()
    assert (np.asarray(after["nx"]) == 7).all()
