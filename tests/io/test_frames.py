"""Frames, CRS and movers: file -> absolute -> another file, both ways."""

from __future__ import annotations

import math
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_io import scale_and_convergence, utm

from meshreg.errors import InputError, UsageError
from meshreg.io.frames.axes import NED, UNITS, Y_UP
from meshreg.io.frames.bridge import bridge
from meshreg.io.frames.crs import crs_text, mend_proj_data, metric_crs
from meshreg.io.frames.place import (
    common_crs,
    frame_from,
    grid_scale_and_convergence,
    make_mover,
    place,
    reframe,
    registered_frame,
    to_absolute,
    to_file,
)
from meshreg.io.options import ReadOptions
from meshreg.records import Frame, PointCloud, SourceFile, Survey, Transform

BEACH = (731_500.0, 5_705_400.0, 3.0)  # EPSG:32754, Victoria
OREGON_FEET = (637_000.0, 851_000.0, 450.0)  # EPSG:2992

number = st.floats(-1e4, 1e4)
points = st.lists(st.tuples(number, number, number), min_size=1, max_size=5).map(np.array)
shifts = st.tuples(st.floats(-1e6, 1e6), st.floats(-1e7, 1e7), st.floats(-1e4, 1e4))
axes = st.sampled_from([np.eye(3), NED, Y_UP, np.diag([1.0, 1.0, -1.0])])
units = st.sampled_from(sorted(UNITS.values()))


def source(frame: Frame, name: str = "a.obj", form: str = "obj") -> SourceFile:
    return SourceFile(Path(name), form, frame)


def cloud(points: object, crs: str | None, name: str = "a") -> Survey:
    xyz = np.atleast_2d(np.asarray(points, float))
    origin = np.round(xyz.mean(axis=0))
    frame = Frame(file_crs=crs, crs=crs)
    return Survey(name, PointCloud(xyz - origin), origin, crs, source=(source(frame),))


# --- linear frames


@given(points, axes, units, shifts)
def test_a_linear_frame_and_back(xyz, axes, unit, shift):
    frame = Frame(axes * unit, shift)
    again = to_file(frame, to_absolute(frame, xyz))
    largest = max(np.abs(xyz * unit).max(), np.abs(shift).max(), 1e-3)
    assert np.abs(again - xyz).max() * unit <= 1e-9 * largest


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (ReadOptions(), (1, 2, 3)),
        (ReadOptions(axes="enu"), (1, 2, 3)),
        (ReadOptions(axes="ned"), (2, 1, -3)),
        (ReadOptions(up="y"), (1, -3, 2)),
        (ReadOptions(up="z"), (1, 2, 3)),
        (ReadOptions(unit="mm"), (0.001, 0.002, 0.003)),
        (ReadOptions(unit="ft"), (0.3048, 0.6096, 0.9144)),
        (ReadOptions(unit="us-ft"), (1200 / 3937, 2400 / 3937, 3600 / 3937)),
        (ReadOptions(axes="ned", unit="cm", shift=(10, 20, 30)), (10.02, 20.01, 29.97)),
        (ReadOptions(up="y", unit="mm", shift=(7e5, 5e6, 0)), (700000.001, 4999999.997, 0.002)),
    ],
)
def test_axes_then_unit_then_shift(options, expected):
    frame = frame_from(options)
    assert to_absolute(frame, [[1, 2, 3]])[0] == pytest.approx(expected, rel=1e-15, abs=1e-12)


def test_the_formats_own_axes_give_way_to_what_the_user_says():
    assert (frame_from(ReadOptions(), default_axes=Y_UP).axes == Y_UP).all()
    assert (frame_from(ReadOptions(up="z"), default_axes=Y_UP).axes == np.eye(3)).all()
    assert (frame_from(ReadOptions(axes="ned"), default_axes=Y_UP).axes == NED).all()


@pytest.mark.parametrize(
    "options",
    [
        ReadOptions(axes="ned", up="y"),
        ReadOptions(axes="wsd"),
        ReadOptions(up="x"),
        ReadOptions(unit="furlong"),
        ReadOptions(shift=(1, float("nan"), 0)),
        ReadOptions(shift=(1, 2)),
    ],
)
def test_what_cannot_be_meant_is_refused(options):
    with pytest.raises(UsageError):
        frame_from(options)


def test_a_shift_without_a_crs_is_a_local_frame():
    frame = frame_from(ReadOptions(shift=(731000, 5705000, 0)))
    assert frame.crs is None
    assert frame.file_crs is None
    assert frame.is_linear


# --- CRS


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("EPSG:32754", "EPSG:32754"),
        ("epsg::32754", "EPSG:32754"),
        ("32754", "EPSG:32754"),
        ("WGS84 UTM 16N", "EPSG:32616"),
        ("wgs84 utm 54s", "EPSG:32754"),
        ("+proj=utm +zone=16 +datum=WGS84 +units=m +no_defs", "EPSG:32616"),
        ("EPSG:32610+5703", "EPSG:32610+5703"),
        ('LOCAL_CS["Local Coordinates (m)",UNIT["metre",1]]', None),
        (
            'PROJCS["WGS_1984_UTM_Zone_54S",GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID['
            '"WGS_1984",6378137.0,298.257223563]],PRIMEM["Greenwich",0.0],UNIT["Degree",'
            '0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["False_Easting",'
            '500000.0],PARAMETER["False_Northing",10000000.0],PARAMETER["Central_Meridian",141.0],'
            'PARAMETER["Scale_Factor",0.9996],PARAMETER["Latitude_Of_Origin",0.0],'
            'UNIT["Meter",1.0]]',
            "EPSG:32754",
        ),
    ],
)
def test_every_spelling_of_a_crs_becomes_one(text, expected):
    assert crs_text(text) == expected


@pytest.mark.parametrize("text", ["EPSG:1", "nowhere", "", "WGS84 UTM 77N"])
def test_an_unknown_crs_is_refused_with_its_name(text):
    with pytest.raises(InputError, match="not known"):
        crs_text(text)


@pytest.mark.parametrize(
    ("crs", "centre", "expected"),
    [
        ("EPSG:32754", BEACH, "EPSG:32754"),
        ("EPSG:2193", (1_600_000, 5_400_000, 0), "EPSG:2193"),  # axes north, east in the registry
        ("EPSG:4326", (143.67, -38.77, 0), "EPSG:32754"),
        ("EPSG:4326", (179.999, 10, 0), "EPSG:32660"),
        ("EPSG:4326", (181.0, 10, 0), "EPSG:32601"),
        ("EPSG:4326", (0.0, 0.0, 0), "EPSG:32631"),
        ("EPSG:7844", (143.67, -38.77, 0), "EPSG:7854"),  # GDA2020 stays on its datum
        ("EPSG:3857", (15_993_000, -4_690_000, 0), "EPSG:32754"),  # its metre is 0.78 m there
        ("EPSG:2992", OREGON_FEET, "EPSG:26910"),
        ("EPSG:2992+6360", OREGON_FEET, "EPSG:26910+5703"),
        ("EPSG:32610+6360", (500_000, 5_000_000, 10), "EPSG:32610+5703"),  # only heights in feet
        ("EPSG:4978", (-4_010_000, 2_950_000, -3_970_000), None),  # geocentric: UTM in 3-D, WKT
    ],
)
def test_absolute_coordinates_are_metres(crs, centre, expected):
    chosen = metric_crs(crs, centre)
    if expected is None:
        assert "UTM zone 54S" in chosen
    else:
        assert chosen == expected


@given(st.floats(138.1, 143.9), st.floats(-70, -1), st.floats(-100, 100))
@settings(deadline=None)
def test_degrees_become_utm_metres_as_krueger_has_it(lon, lat, up):
    frame = Frame(file_crs="EPSG:7844", crs="EPSG:7854")
    absolute = to_absolute(frame, [[lon, lat, up]])
    assert absolute[0] == pytest.approx((*utm(lon, lat, 54), up), rel=0, abs=2e-4)
    back = to_file(frame, absolute)
    assert back[0] == pytest.approx((lon, lat, up), rel=0, abs=1e-11)


@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-300, 3000))
@settings(deadline=None)
def test_feet_become_metres_and_go_back(dx, dy, z):
    frame = frame_from(ReadOptions(), None, "EPSG:2992", centre=OREGON_FEET)
    here = np.add([OREGON_FEET], [[dx, dy, 0]])
    here[0, 2] = z
    there = np.add(here, [[100.0, 0.0, 10.0]])
    moved = to_absolute(frame, np.concatenate([here, there]))
    # The two grids' scales differ from one by some 1e-4 each.
    assert np.hypot(*(moved[1] - moved[0])[:2]) == pytest.approx(30.48, rel=1e-3)
    assert moved[:, 2] == pytest.approx([z * 0.3048, (z + 10) * 0.3048], abs=1e-9)
    back = to_file(frame, moved)
    assert np.abs(back[0] - here[0]).max() <= 1e-9 * 1e6


def test_westing_and_southing_become_east_and_north():
    centre = (10_000.0, 3_700_000.0, 5.0)  # EPSG:2048 counts west and south
    frame = frame_from(ReadOptions(), None, "EPSG:2048", centre=centre)
    here, further = to_absolute(frame, [centre, np.add(centre, (100, 200, 0))])
    east, north, up = further - here
    assert (east, north, up) == pytest.approx((-100, -200, 0), abs=10)  # turned by convergence
    assert np.hypot(east, north) == pytest.approx(np.hypot(100, 200), rel=1e-3)


def test_a_unit_is_taken_to_the_unit_of_the_crs():
    inches = ReadOptions(unit="in")
    frame = frame_from(inches, None, "EPSG:2992", centre=np.multiply(OREGON_FEET, 12))
    feet = frame_from(ReadOptions(), None, "EPSG:2992", centre=OREGON_FEET)
    one = to_absolute(frame, np.multiply([OREGON_FEET], 12))
    assert one == pytest.approx(to_absolute(feet, [OREGON_FEET]), abs=1e-6)


@pytest.mark.parametrize(
    ("crs", "centre"),
    [
        ("EPSG:32610", (50.0, 50.0, 1.0)),  # local coordinates, the shift is missing
        ("EPSG:32754", (12.0, -3.0, 1.0)),
        ("EPSG:4326", (11.0, 95.0, 0.0)),
        ("EPSG:4326", (731_500.0, 5_705_400.0, 0.0)),  # metres called degrees
        ("EPSG:28354", (5.0e9, 5.0e9, 0.0)),
        ("EPSG:28992", (731_500.0, 5_705_400.0, 0.0)),  # Dutch grid, Australian numbers
    ],
)
def test_coordinates_outside_their_crs_are_refused(crs, centre):
    with pytest.raises(InputError, match="outside the area"):
        frame_from(ReadOptions(), None, crs, centre=centre)


def test_a_zone_may_be_used_beyond_its_border():
    """Norway keeps UTM 33 for the whole country; Kirkenes lies at 30° east."""
    frame = frame_from(ReadOptions(), None, "EPSG:25833", centre=(1_080_000, 7_800_000, 0))
    assert frame.crs == "EPSG:25833"


def test_points_that_proj_cannot_move_are_refused():
    frame = Frame(file_crs="EPSG:4326", crs="EPSG:32754")
    with pytest.raises(InputError, match="outside the area"):
        to_absolute(frame, [[143.0, -38.0, 0.0], [143.0, 120.0, 0.0]])


def test_two_crs_that_disagree_are_refused_unless_the_user_decides():
    from meshreg.io.frames.sidecar import SidecarInfo

    prj = SidecarInfo(path=Path("a.prj"), crs="EPSG:32755", crs_path=Path("a.prj"))
    with pytest.raises(InputError, match=r"EPSG:32754.*a\.prj says EPSG:32755"):
        frame_from(ReadOptions(), prj, "EPSG:32754", centre=BEACH)
    said = ReadOptions(crs="EPSG:28354")
    assert frame_from(said, prj, "EPSG:32754", centre=BEACH).crs == "EPSG:28354"
    own = SidecarInfo(crs="EPSG:28354", crs_path=Path("a.survey.toml"), explicit_crs=True)
    assert frame_from(ReadOptions(), own, "EPSG:32754", centre=BEACH).crs == "EPSG:28354"


def test_a_change_of_datum_moves_by_what_is_known_and_says_so():
    """GDA94 to GDA2020: 1.8 m at Canberra (ICSM manual 1.3, section 3), 1.56 m here."""
    way = bridge("EPSG:28354", "EPSG:7854")
    moved = way.forward(np.array([BEACH]))
    assert moved[0] - BEACH == pytest.approx((0.570, 1.454, 0.0), abs=2e-3)
    assert way.forward(moved, back=True) == pytest.approx(np.array([BEACH]), abs=1e-6)
    assert "accuracy 0.01 m" in way.note(BEACH)


def test_one_datum_in_two_zones_needs_no_note():
    way = bridge("EPSG:32754", "EPSG:32755")
    assert way.note(BEACH) == ""
    lonlat = bridge("EPSG:32754", "EPSG:4326").forward(np.array([BEACH]))[0]
    assert way.forward(np.array([BEACH]))[0, :2] == pytest.approx(utm(*lonlat[:2], 55), abs=5e-3)


def test_a_badly_known_change_is_refused():
    with pytest.raises(InputError, match="not known well enough"):
        bridge("EPSG:4267", "EPSG:26910").forward(np.array([[-122.0, 45.0, 0.0]]))


def _harbour(name: str, metres: float = 1.0, direction: str = "up") -> str:
    import pyproj

    flat = pyproj.CRS("EPSG:32754").to_wkt()
    return (
        f'COMPOUNDCRS["UTM + {name}",{flat},VERTCRS["{name} height",VDATUM["{name}"],'
        f'CS[vertical,1],AXIS["height",{direction},LENGTHUNIT["unit",{metres}]]]]'
    )


def test_another_vertical_datum_without_a_known_way_is_refused():
    with pytest.raises(InputError, match="heights from Old Pier to New Pier"):
        bridge(_harbour("Old Pier"), _harbour("New Pier"))
    with pytest.raises(InputError, match="heights from"):
        bridge("EPSG:4979", _harbour("New Pier"))


def test_one_vertical_datum_only_changes_unit_and_sign():
    way = bridge(_harbour("Pier", 0.3048, "down"), _harbour("Pier"))
    assert way.forward(np.array([(*BEACH[:2], 10.0)]))[0] == pytest.approx((*BEACH[:2], -3.048))
    # Where one side says nothing of heights, they stay.
    assert bridge(_harbour("Pier"), "EPSG:28354").forward(np.array([BEACH]))[0, 2] == 3.0


def test_a_wrong_proj_data_is_forgotten_with_a_note(monkeypatch, tmp_path):
    for layout in (4, 6):
        (tmp_path / str(layout)).mkdir()
        with closing(sqlite3.connect(tmp_path / str(layout) / "proj.db")) as database:
            database.execute("CREATE TABLE metadata (key TEXT, value TEXT)")
            row = ("DATABASE.LAYOUT.VERSION.MINOR", str(layout))
            database.execute("INSERT INTO metadata VALUES (?, ?)", row)
            database.commit()
    for folder, stays in ((tmp_path, False), (tmp_path / "4", False), (tmp_path / "6", True)):
        monkeypatch.setenv("PROJ_DATA", str(folder))
        note = mend_proj_data()
        assert ("PROJ_DATA" in os.environ) == stays
        assert (note is None) == stays
        assert stays or str(folder) in note


def test_a_wrong_proj_data_does_not_stop_a_change_of_crs(tmp_path):
    code = (
        "from meshreg.io.frames.bridge import bridge; "
        "print(*bridge('EPSG:32754', 'EPSG:4326').forward([[731500, 5705400, 3]])[0])"
    )
    env = {**os.environ, "PROJ_DATA": str(tmp_path), "PROJ_LIB": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
    )
    lon, lat, up = map(float, run.stdout.split())
    assert (*utm(lon, lat, 54), up) == pytest.approx(BEACH, abs=5e-3)


# --- scale and convergence


@given(st.floats(138.1, 143.9), st.floats(-70, 70).filter(lambda lat: abs(lat) > 0.5))
@settings(deadline=None)
def test_scale_and_convergence_by_a_step_northward(lon, lat):
    crs = "EPSG:7854" if lat < 0 else "EPSG:32654"
    scale, convergence = grid_scale_and_convergence(crs, *utm(lon, lat, 54))
    expected = scale_and_convergence(lon, lat, 54)
    assert scale == pytest.approx(expected[0], abs=1e-7)
    assert convergence == pytest.approx(expected[1], abs=1e-6)
    # Clockwise of true north east of the meridian in the north, and in the mirror image.
    assert np.sign(convergence) == np.sign(lon - 141) * np.sign(lat) or abs(lon - 141) < 1e-3


def test_a_geographic_crs_has_no_grid_scale():
    with pytest.raises(UsageError):
        grid_scale_and_convergence("EPSG:4326", 1, 1)


# --- two surveys


def test_equal_frames_need_nothing():
    for crs in (None, "EPSG:32754"):
        one, other = cloud([BEACH], crs), cloud([BEACH], crs)
        moved, notes = common_crs(one, other)
        assert moved is other
        assert notes == ()


def test_a_missing_crs_is_local_and_said_with_scale_and_convergence():
    utm_survey, local = cloud([BEACH], "EPSG:32754", "2018"), cloud([BEACH], None, "2019")
    scale, convergence = grid_scale_and_convergence("EPSG:32754", *BEACH[:2])
    for reference, moving in ((utm_survey, local), (local, utm_survey)):
        moved, (note,) = common_crs(reference, moving)
        assert moved.crs == reference.crs  # the numbers stay, and no stage sees two frames
        assert moved.geometry is moving.geometry
        assert (moved.origin == moving.origin).all()
        assert moved.source[0].frame is moving.source[0].frame
        assert "'2019' in a local frame" in note
        assert f"{scale:.6f}" in note
        assert f"{np.degrees(convergence):+.3f} degrees" in note


def test_the_moving_survey_goes_to_the_references_crs():
    reference, moving = cloud([BEACH], "EPSG:7854"), cloud([BEACH, np.add(BEACH, 5)], "EPSG:28354")
    moved, notes = common_crs(reference, moving)
    assert moved.crs == "EPSG:7854"
    assert moved.source[0].frame.crs == "EPSG:7854"
    assert moved.source[0].frame.file_crs == "EPSG:28354"
    assert "GDA94 to GDA2020" in notes[0]
    absolute = moved.geometry.points + moved.origin
    assert absolute[0] - BEACH == pytest.approx((0.570, 1.454, 0), abs=2e-3)
    assert absolute[1] - absolute[0] == pytest.approx((5, 5, 5), abs=1e-4)
    assert np.abs(moved.geometry.points).max() <= 5  # still local
    back = reframe(moved, "EPSG:28354")
    assert back.geometry.points + back.origin == pytest.approx(
        moving.geometry.points + moving.origin, abs=1e-6
    )


def test_a_local_survey_cannot_be_taken_to_a_crs():
    with pytest.raises(UsageError, match="no CRS"):
        reframe(cloud([BEACH], None), "EPSG:32754")


@given(st.floats(-200, 200), st.floats(-200, 200), st.floats(-20, 20))
@settings(deadline=None)
def test_utm_and_local_frames_agree(dx, dy, dz):
    shift = np.array([731_000.0, 5_705_000.0, 0.0])
    local = np.array([[dx, dy, dz], [10.25, 20.5, 3.125]])
    with_shift = place(Path("none/a.obj"), local, ReadOptions(shift=tuple(shift)))
    as_utm = place(Path("none/a.obj"), local + shift, ReadOptions())
    one, other = (p.points + p.origin for p in (with_shift, as_utm))
    assert np.abs(one - other).max() <= 1e-8
    assert np.abs((one - shift) - local).max() <= 1e-8


# --- place


def test_place_keeps_local_coordinates_exact_under_a_large_shift():
    xyz = np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]])
    placed = place(Path("none/a.obj"), xyz, ReadOptions(shift=(731_000.0, 5_705_000.0, 0.0)))
    assert placed.origin == pytest.approx((731_000, 5_705_000, 0))
    assert (placed.points == xyz).all()


def test_place_reads_sidecars_but_not_a_folders_for_georeferenced_formats(tmp_path):
    (tmp_path / "offset.xyz").write_text("731000 5705000 0\n")
    path = tmp_path / "a.obj"
    mesh = place(path, [[1, 2, 3]], ReadOptions())
    assert mesh.frame.shift == pytest.approx((731_000, 5_705_000, 0))
    assert mesh.sidecar == tmp_path / "offset.xyz"
    assert "offset.xyz" in mesh.notes[0]
    las = place(path, [[1, 2, 3]], ReadOptions(), georeferenced=True)
    assert not las.frame.shift.any()
    given = place(path, [[1, 2, 3]], ReadOptions(shift=(5, 6, 7)))
    assert given.frame.shift == pytest.approx((5, 6, 7))  # replaces, does not add
    assert "replaces" in given.notes[0]


def test_place_names_the_file_in_errors():
    with pytest.raises(InputError, match=r"a\.obj"):
        place(Path("none/a.obj"), [[1, 2, 3]], ReadOptions(crs="EPSG:32754"))
    with pytest.raises(InputError, match="no points"):
        place(Path("none/a.obj"), np.zeros((0, 3)), ReadOptions())
    with pytest.raises(InputError, match="not finite"):
        place(Path("none/a.obj"), [[1, 2, np.inf]], ReadOptions())


def test_coordinates_collapsed_by_32_bit_numbers_are_refused():
    rng = np.random.default_rng(1)
    xyz = np.add(rng.uniform(0, 5, (5000, 3)), (512_345.0, 8_400_000.0, 0.0))
    with pytest.raises(InputError, match=r"step by 1 m"):
        place(Path("none/a.ply"), xyz.astype(np.float32), ReadOptions())
    assert place(Path("none/a.ply"), xyz, ReadOptions()).notes == ()


def test_a_regular_grid_in_32_bits_is_kept_and_said():
    east, north = np.meshgrid(731_000.0 + np.arange(40), 5_705_000.0 + np.arange(40))
    xyz = np.stack([east.ravel(), north.ravel(), np.zeros(1600)], axis=1).astype(np.float32)
    placed = place(Path("none/a.ply"), xyz, ReadOptions())
    assert "step by 0.5 m" in placed.notes[0]
    assert len(np.unique(placed.points, axis=0)) == 1600


@pytest.mark.parametrize(
    ("pixel", "kept"), [(0.02, False), (1.9, False), (2.1, True), (None, True)]
)
def test_32_bit_steps_must_not_tear_a_texture(pixel, kept):
    """Points a few metres apart keep their places, but a texture of centimetres does not."""
    rng = np.random.default_rng(2)
    sparse = rng.uniform(0, 200, (2000, 3)) + np.array([731_000.0, 5_705_000.0, 0.0])
    asked = []

    def detail():
        asked.append(pixel)
        return pixel

    path = Path("none/a.ply")
    if kept:
        placed = place(path, sparse.astype(np.float32), ReadOptions(), detail=detail)
        assert "step by 0.5 m" in placed.notes[0]
    else:
        with pytest.raises(InputError, match=rf"step by 0\.5 m, but .* pixels are {pixel} m"):
            place(path, sparse.astype(np.float32), ReadOptions(), detail=detail)
    assert asked == [pixel]
    # Nothing went through 32 bits, or what did lies on a grid of metres: nothing is torn.
    assert place(path, sparse, ReadOptions(), detail=detail).notes == ()
    east, north = np.meshgrid(731_000.0 + np.arange(40), 5_705_000.0 + np.arange(40))
    grid = np.stack([east.ravel(), north.ravel(), np.zeros(1600)], axis=1).astype(np.float32)
    assert len(place(path, grid, ReadOptions(), detail=detail).points) == 1600
    assert len(asked) == 2


# --- movers


def turned(yaw: float, tilt: float = 0.0, **rest: object) -> Transform:
    c, s = math.cos(yaw), math.sin(yaw)
    ct, st_ = math.cos(tilt), math.sin(tilt)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, ct, -st_], [0, st_, ct]])
    return Transform(about_z @ about_x, **rest)


@given(points, axes, axes, units, units, shifts, st.floats(-0.2, 0.2), st.floats(-0.1, 0.1))
@settings(deadline=None)
def test_a_mover_does_what_its_parts_do_and_its_inverse_undoes_it(
    xyz, axes1, axes2, unit1, unit2, shift, yaw, tilt
):
    start, end = Frame(axes1 * unit1, shift), Frame(axes2 * unit2, np.multiply(shift, 0.5))
    transform = turned(yaw, tilt, offset=(13.4, -8.7, 1.25), pivot=shift)
    move = make_mover(source(start), transform, end)
    moved = move.points(xyz)
    by_hand = to_absolute(start, xyz)
    by_hand = by_hand @ transform.matrix[:3, :3].T + transform.matrix[:3, 3]
    size = max(np.abs(by_hand).max(), np.abs(shift).max(), 1.0)
    assert np.abs(to_absolute(end, moved) - by_hand).max() <= 1e-8 * size
    matrix = xyz @ move.matrix[:3, :3].T + move.matrix[:3, 3]
    assert np.abs(matrix - moved).max() * unit2 <= 1e-8 * size
    back = make_mover(source(end), transform.inverse(), start)
    assert np.abs(back.points(moved) - xyz).max() * unit1 <= 1e-8 * size


@given(axes, axes, units, st.floats(-3, 3), st.floats(-1, 1))
@settings(deadline=None)
def test_directions_turn_as_short_lines_do_and_keep_their_length(axes1, axes2, unit, yaw, tilt):
    transform = turned(yaw, tilt, scale=1.5)
    move = make_mover(source(Frame(axes1 * unit)), transform, Frame(axes2))
    vectors = np.array([[1.0, 0, 0], [0, 2, 0], [0.6, 0, 0.8]])
    lines = move.points(vectors) - move.points(np.zeros((3, 3)))
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    turned_ = move.directions(np.zeros((3, 3)), vectors)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    assert turned_ == pytest.approx(lines * lengths, abs=1e-12)


def test_a_mover_over_a_change_of_crs_and_its_tangent():
    start = frame_from(ReadOptions(), None, "EPSG:2992", centre=OREGON_FEET)
    end = Frame(shift=(490_000, 4_870_000, 0), file_crs="EPSG:26910", crs="EPSG:26910")
    transform = turned(0.01, offset=(10, -5, 1), pivot=to_absolute(start, [OREGON_FEET])[0])
    move = make_mover(source(start), transform, end, centre=OREGON_FEET)
    near = np.add([OREGON_FEET], [[30, -20, 5], [0, 0, 0]])
    tangent = near @ move.matrix[:3, :3].T + move.matrix[:3, 3]
    assert np.abs(tangent - move.points(near)).max() < 1e-6
    assert np.cbrt(np.linalg.det(move.matrix[:3, :3])) == pytest.approx(0.3048, rel=3e-4)
    back = make_mover(source(end), transform.inverse(), start, centre=move.points(near)[1])
    assert back.points(move.points(near)) == pytest.approx(near, abs=1e-6)
    at = np.array([*OREGON_FEET, 1.0])
    assert back.matrix @ (move.matrix @ at) == pytest.approx(at, abs=1e-6)
    # Normals turn by yaw and convergence, without the unit.
    lines = move.points(near[1:] + np.diag([3.0, 3.0, 3.0])) - move.points(near[1:])
    assert move.directions(near[1:], np.eye(3)) == pytest.approx(lines / 3 / 0.3048, abs=3e-4)


def test_a_change_of_crs_needs_a_place_to_linearise():
    start = Frame(file_crs="EPSG:2992", crs="EPSG:26910")
    with pytest.raises(UsageError, match="centre"):
        make_mover(source(start), Transform(), Frame(file_crs="EPSG:26910", crs="EPSG:26910"))


def test_a_file_of_another_datum_is_taken_to_the_targets_crs():
    start = Frame(file_crs="EPSG:28354", crs="EPSG:28354")
    end = Frame(file_crs="EPSG:7854", crs="EPSG:7854")
    move = make_mover(source(start), Transform(), end, centre=BEACH)
    assert move.points([BEACH])[0] - BEACH == pytest.approx((0.570, 1.454, 0), abs=2e-3)


def test_the_registered_file_takes_the_references_frame():
    home = Frame(NED * 0.01, (731_000, 5_705_000, 0), "EPSG:32754", "EPSG:32754")
    for form in ("obj", "ply", "las", "xyz"):
        assert registered_frame(source(home), source(Frame(), form=form)) == home


def test_gltf_keeps_its_axes_in_metres():
    home = Frame(NED, (731_000, 5_705_000, 0))
    frame = registered_frame(source(home), source(Frame(Y_UP * 0.01), "a.glb", "glb"))
    assert (frame.axes == Y_UP).all()
    assert frame.shift == pytest.approx(home.shift)


@pytest.mark.parametrize("form", ["glb", "stl"])
def test_formats_of_32_bits_get_a_near_shift(form):
    home = source(Frame(file_crs="EPSG:32754", crs="EPSG:32754"))
    frame = registered_frame(home, source(Frame(), form=form), centre=BEACH)
    assert np.abs(to_file(frame, [BEACH])).max() < 1
    near = registered_frame(source(Frame(shift=BEACH)), source(Frame(), form=form), centre=BEACH)
    assert near.shift == pytest.approx(BEACH)
