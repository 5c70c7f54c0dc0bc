"""Files beside a survey that say where it is."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from meshreg.errors import InputError, OutputError
from meshreg.io.frames.axes import NED, Y_UP
from meshreg.io.frames.place import frame_from
from meshreg.io.frames.sidecar import SidecarInfo, find_sidecar, is_sidecar, write_shift
from meshreg.io.options import ReadOptions
from meshreg.records import Frame

CENTRE = (500.0, 400.0, 3.0)  # file coordinates; with the shift they lie in zone 54 south
SHIFT = (731000.0, 5705000.0, 0.0)
UTM = pyproj.CRS("EPSG:32754").to_wkt("WKT1_ESRI")


@pytest.fixture
def survey(tmp_path):
    return tmp_path / "reef.obj"


# --- each kind


@pytest.mark.parametrize("name", ["reef_offset.xyz", "offset.xyz"])
@pytest.mark.parametrize(
    "text",
    [
        "731000 5705000 0\n",
        "731000.000\t5705000.000\t0.000",
        "731000\n5705000\n0\n",
        "731000, 5705000, 0\r\n",
        "# offset\n731000;5705000;0\n",
        "\ufeff731000 5705000 0",
    ],
)
def test_pix4d_offset(survey, name, text):
    survey.with_name(name).write_text(text, "utf-8")
    found = find_sidecar(survey)
    assert found.shift == SHIFT
    assert found.path == survey.with_name(name)
    assert found.crs is None


def test_pix4d_offset_with_its_prj(survey):
    import pyproj

    survey.with_name("reef_offset.xyz").write_text("731000 5705000 0")
    survey.with_name("reef_wkt.prj").write_text(pyproj.CRS("EPSG:32754").to_wkt("WKT1_ESRI"))
    frame = frame_from(ReadOptions(), find_sidecar(survey), centre=CENTRE)
    assert frame.shift == pytest.approx(SHIFT)
    assert frame.crs == "EPSG:32754"


def test_a_prj_alone(survey):
    survey.with_suffix(".prj").write_text("EPSG:32754")
    found = find_sidecar(survey)
    assert found.shift is None
    assert found.crs == "EPSG:32754"
    assert found.path == survey.with_suffix(".prj")


@pytest.mark.parametrize("line", ["WGS84 UTM 54S", "+proj=utm +zone=54 +south +datum=WGS84"])
@pytest.mark.parametrize("folder", ["odm_georeferencing", "odm_texturing/odm_georeferencing"])
def test_odm_coords_in_the_sibling_folder(tmp_path, line, folder):
    mesh = tmp_path / "odm_texturing" / "odm_textured_model_geo.obj"
    mesh.parent.mkdir()
    (tmp_path / folder).mkdir()
    coords = tmp_path / folder / "coords.txt"
    coords.write_text(f"{line}\n731000 5705000\n1 2 3\n4 5 6\n")
    found = find_sidecar(mesh)
    assert found.shift == SHIFT  # up is not moved
    assert frame_from(ReadOptions(), found, centre=CENTRE).crs == "EPSG:32754"
    assert found.path.name == "coords.txt"


def test_odm_coords_do_not_speak_of_other_models(tmp_path):
    (tmp_path / "odm_georeferencing").mkdir()
    (tmp_path / "odm_georeferencing" / "coords.txt").write_text("WGS84 UTM 54S\n731000 5705000\n")
    for name in ("odm_texturing/odm_textured_model.obj", "other/mesh_geo.obj"):
        assert find_sidecar(tmp_path / name) is None


def test_odm_proj_txt_repeats_the_crs_or_is_refused(survey):
    coords, proj = survey.with_name("coords.txt"), survey.with_name("proj.txt")
    coords.write_text("WGS84 UTM 54S\n731000 5705000\n")
    proj.write_text("+proj=utm +zone=54 +south +datum=WGS84 +units=m +no_defs\n")
    assert find_sidecar(survey).shift == SHIFT
    proj.write_text("+proj=utm +zone=55 +south +datum=WGS84 +units=m +no_defs\n")
    with pytest.raises(InputError, match=r"proj\.txt: says crs.*coords\.txt says crs"):
        find_sidecar(survey)


def test_somebody_elses_coords_txt_is_left_alone_and_said(survey):
    survey.with_name("coords.txt").write_text("marker east north\n1 2 3\n")
    found = find_sidecar(survey)
    assert found.shift is None
    assert "coords.txt" in found.notes[0]


@pytest.mark.parametrize(
    ("text", "crs"),
    [
        ("EPSG::32754 731000 5705000 0", "EPSG:32754"),
        ("EPSG:32754 731000.0 5705000.0 0.0\n", "EPSG:32754"),
        ("WGS84 UTM 54S 731000 5705000 0\n", "EPSG:32754"),
        ("32754 731000 5705000 0", "EPSG:32754"),
        ("Local 731000 5705000 0", None),
    ],
)
@pytest.mark.parametrize("name", ["SHIFT.txt", "shift.txt"])
def test_metashape_shift_txt(survey, name, text, crs):
    survey.with_name(name).write_text(text)
    found = find_sidecar(survey)
    assert found.shift == SHIFT
    assert frame_from(ReadOptions(), found, centre=CENTRE).crs == crs


@pytest.mark.parametrize("suffix", [".rcInfo", ".rcinfo"])
def test_a_realitycapture_file_is_told(tmp_path, suffix):
    (tmp_path / f"reef{suffix}").write_text("<ModelExport/>")
    said = find_sidecar(tmp_path / "reef.obj")
    assert said.shift is None
    assert f"reef{suffix}" in said.notes[0]
    assert "--moving-shift" in said.notes[0]
    (tmp_path / "reef_offset.xyz").write_text("731000 5705000 0")
    said = find_sidecar(tmp_path / "reef.obj")
    assert said.shift == (731000, 5705000, 0)
    assert len(said.notes) == 1
    assert find_sidecar(tmp_path / "other.obj") is None


def test_our_own_toml_says_everything(survey):
    survey.with_suffix(".survey.toml").write_text(
        'name = "Reef, first dive"\ndate = 2018-06-01\ncrs = "EPSG:32754"\n'
        'shift = [731000, 5705000.0, 0]\naxes = "ned"\nunit = "mm"\n'
    )
    found = find_sidecar(survey)
    assert (found.name, found.date, found.axes, found.unit) == (
        "Reef, first dive",
        "2018-06-01",
        "ned",
        "mm",
    )
    frame = frame_from(ReadOptions(), found, centre=(400_000, 500_000, -3000))
    assert frame.axes == pytest.approx(NED * 0.001)
    assert frame.shift == pytest.approx(SHIFT)
    assert frame.crs == "EPSG:32754"


def test_no_sidecar_is_none(survey):
    assert find_sidecar(survey) is None


# --- what a folder says, what one file says


def test_shared_sidecars_are_for_formats_without_a_place(survey):
    survey.with_name("offset.xyz").write_text("731000 5705000 0")
    assert find_sidecar(survey, shared=False) is None
    survey.with_name("reef_offset.xyz").write_text("731000 5705000 0")
    assert find_sidecar(survey, shared=False).shift == SHIFT


def test_a_copc_file_has_the_stem_before_both_suffixes(tmp_path):
    (tmp_path / "reef_offset.xyz").write_text("731000 5705000 0")
    assert find_sidecar(tmp_path / "reef.copc.laz", shared=False).shift == SHIFT


def test_a_cloud_called_offset_is_no_sidecar(tmp_path, survey):
    cloud = tmp_path / "offset.xyz"
    cloud.write_text("".join(f"{k} {k} 1\n" for k in range(9)))
    assert not is_sidecar(cloud)
    assert find_sidecar(survey) is None
    cloud.write_text("1 2 3\n")
    assert is_sidecar(cloud)
    assert find_sidecar(cloud) is None  # not its own


def test_what_is_known_as_a_sidecar(tmp_path):
    for name in ("a.prj", "a.survey.toml", "coords.txt", "proj.txt", "SHIFT.txt"):
        assert is_sidecar(tmp_path / name)
    for name in ("a.xyz", "a.txt", "coords.csv", "a.toml"):
        assert not is_sidecar(tmp_path / name)


# --- the user decides


def test_a_stated_shift_replaces_the_sidecars(survey):
    survey.with_name("offset.xyz").write_text("731000 5705000 0")
    frame = frame_from(ReadOptions(shift=(1, 2, 3)), find_sidecar(survey))
    assert frame.shift == pytest.approx((1, 2, 3))
    zero = frame_from(ReadOptions(shift=(0, 0, 0)), find_sidecar(survey))
    assert not zero.shift.any()


def test_stated_axes_replace_the_sidecars_axes_and_up():
    said = SidecarInfo(axes="ned")
    assert (frame_from(ReadOptions(up="y"), said).axes == Y_UP).all()
    assert (frame_from(ReadOptions(up="z"), said).axes == np.eye(3)).all()
    assert (frame_from(ReadOptions(unit="mm"), said).axes == NED * 0.001).all()


# --- disagreement and damage


def test_two_that_disagree_are_refused_by_name(survey):
    survey.with_name("offset.xyz").write_text("731000 5705000 0")
    survey.with_name("SHIFT.txt").write_text("EPSG:32754 731000 5705000 10")
    with pytest.raises(InputError, match=r"SHIFT\.txt: says shift.*offset\.xyz says shift") as bad:
        find_sidecar(survey)
    assert bad.value.exit_code == 3
    survey.with_name("SHIFT.txt").write_text("EPSG:32754 731000 5705000 0.0004")
    found = find_sidecar(survey)
    assert found.shift == SHIFT
    assert found.crs == "EPSG:32754"
    assert found.crs_path.name == "SHIFT.txt"


def test_two_crs_that_are_spelled_apart_agree(survey):
    survey.with_suffix(".prj").write_text("EPSG:32754")
    survey.with_suffix(".survey.toml").write_text('crs = "WGS84 UTM 54S"\n')
    assert find_sidecar(survey).explicit_crs


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("offset.xyz", "731000 5705000\n", "line 1: expected 3 numbers"),
        ("offset.xyz", "\n\n731000,5 5705000,5 0\n", "line 3: expected 3 numbers"),
        ("offset.xyz", "731000 5705000 nan\n", "line 1: expected 3 numbers"),
        ("offset.xyz", "", "line 1: expected 3 numbers"),
        ("offset.xyz", "a b c", "line 1: expected 3 numbers, found 'a b c'"),
        ("offset.xyz", "1 2 \0", "NUL"),
        ("SHIFT.txt", "", "is empty"),
        ("SHIFT.txt", "EPSG:32754 731000 north 0", "line 1: expected 3 numbers"),
        ("SHIFT.txt", "EPSG:99999 731000 5705000 0", "not known"),
        ("coords.txt", "WGS84 UTM 54S\n", "needs a line"),
        ("coords.txt", "WGS84 UTM 54S\neast north\n", "line 2: expected 2 numbers"),
        ("coords.txt", "WGS84 UTM 99S\n1 2\n", "not known"),
        ("reef.prj", "PROJCS[nonsense", "not known"),
        ("reef.prj", UTM.replace("0.0174532925199433", "9" * 20), "is 1e.20 rad"),
        ("reef.prj", UTM.replace("0.0174532925199433", "1e-9"), "is 1e-09 rad"),
        ("reef.prj", UTM.replace('"Meter",1.0', '"Meter",1e9'), r"unit .* is 1e\+09 m"),
        ("reef.prj", UTM.replace('"Meter",1.0', '"Meter",1e-9'), "is 1e-09 m"),
        ("reef.prj", UTM.replace("6378137.0", "6378.137"), "radius of 6378.14 m"),
        ("reef.survey.toml", "shift = [1, 2\n", "not TOML"),
        ("reef.survey.toml", "shift = [1, 2]\n", "expected three numbers"),
        ("reef.survey.toml", "shift = [1, 2, nan]\n", "expected three numbers"),
        ("reef.survey.toml", 'shift = "1 2 3"\n', "expected three numbers"),
        ("reef.survey.toml", "offset = [1, 2, 3]\n", "'offset' is not known"),
        ("reef.survey.toml", 'axes = "wsd"\n', "axes = 'wsd'; expected"),
        ("reef.survey.toml", "axes = [[1,0,0],[0,1,0],[0,0,0]]\n", "expected"),
        ("reef.survey.toml", 'up = "x"\n', "expected"),
        ("reef.survey.toml", 'unit = "furlong"\n', "expected"),
        ("reef.survey.toml", "unit = -1\n", "expected"),
        ("reef.survey.toml", "crs = 32754\n", "expected text"),
        ("reef.survey.toml", 'crs = "EPSG:99999"\n', "not known"),
        ("reef.survey.toml", "name = 3\n", "expected text"),
    ],
)
def test_a_malformed_sidecar_is_refused_by_name(survey, name, text, message):
    survey.with_name(name).write_text(text)
    with pytest.raises(InputError, match=message) as bad:
        find_sidecar(survey)
    assert bad.value.file.endswith(name)


def test_a_folder_with_a_sidecars_name_is_none(survey):
    survey.with_name("offset.xyz").mkdir()
    assert find_sidecar(survey) is None


# --- writing

AXES = [np.eye(3), NED, Y_UP, np.diag([1.0, 1.0, -1.0])]


@given(
    st.sampled_from(AXES),
    st.sampled_from([1.0, 0.001, 0.3048, 1200 / 3937, 0.0123]),
    st.tuples(*[st.floats(-1e7, 1e7)] * 3),
    st.sampled_from([None, "EPSG:32754"]),
)
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_reads_back_as_the_same_frame(tmp_path, axes, unit, shift, crs):
    path = tmp_path / "reef_registered.obj"
    frame = Frame(axes * unit, shift, crs, crs)
    written = write_shift(path, frame)
    found = find_sidecar(path)
    if found is None:
        assert written == ()
        found = SidecarInfo()
    again = frame_from(ReadOptions(crs=None), _without_crs(found))
    assert again.axes == pytest.approx(frame.axes, rel=1e-12)
    assert (again.shift == frame.shift).all()
    assert found.crs == crs


def _without_crs(info: SidecarInfo) -> SidecarInfo:
    from dataclasses import replace

    return replace(info, crs=None)


def test_a_plain_shift_is_three_numbers_that_others_read(tmp_path):
    path = tmp_path / "reef.obj"
    (written,) = write_shift(path, Frame(shift=(731000.125, 5705000, -0.5)))
    assert written.name == "reef_offset.xyz"
    assert written.read_text() == "731000.125 5705000 -0.5\n"


def test_a_format_that_carries_its_crs_needs_no_toml(tmp_path):
    frame = Frame(file_crs="EPSG:32754", crs="EPSG:32754")
    assert write_shift(tmp_path / "a.las", frame, carries_crs=True) == ()
    assert [p.name for p in write_shift(tmp_path / "a.obj", frame)] == ["a.survey.toml"]


def test_turned_axes_go_into_the_toml_alone(tmp_path):
    """As three numbers the shift would be taken for x, y, z."""
    path = tmp_path / "reef.obj"
    (written,) = write_shift(path, Frame(NED, (1, 2, 3)))
    assert written.name == "reef.survey.toml"
    assert find_sidecar(path).axes == "ned"


def test_stale_sidecars_go(tmp_path):
    path = tmp_path / "reef.obj"
    write_shift(path, Frame(NED, (1, 2, 3)))
    assert [p.name for p in write_shift(path, Frame(shift=(4, 5, 6)))] == ["reef_offset.xyz"]
    assert find_sidecar(path).shift == (4, 5, 6)
    assert find_sidecar(path).axes is None
    assert write_shift(path, Frame()) == ()
    assert find_sidecar(path) is None


def test_feet_are_said_for_a_crs_in_feet(tmp_path):
    """Inches on a CRS in feet: a twelfth of its unit."""
    path = tmp_path / "reef.obj"
    write_shift(path, Frame(np.eye(3) / 12, (0, 0, 0), "EPSG:2992", "EPSG:26910"))
    found = find_sidecar(path)
    assert found.unit == "in"
    frame = frame_from(ReadOptions(), found, centre=(637_000 * 12, 851_000 * 12, 0))
    assert frame.axes == pytest.approx(np.eye(3) / 12, rel=1e-12)


def test_a_sidecar_that_cannot_be_written_says_so(tmp_path):
    with pytest.raises(OutputError):
        write_shift(tmp_path / "missing" / "a.obj", Frame(shift=(1, 2, 3)))
