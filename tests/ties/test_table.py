"""ties.csv and the points of other programs: what is read is what was meant, or says why not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.ties import TiePair, TiePoints, read_ties, write_ties
from meshreg.ties.foreign import Context
from meshreg.ties.formats import read_points

METASHAPE = f"""\
#CoordinateSystem: {pyproj.CRS("EPSG:32755").to_wkt("WKT1_GDAL")}
#Label,X/East,Y/North,Z/Altitude,Error_(m),X_error,Y_error,Z_error,X_est,Y_est,Z_est
target 1,500000.000,6000000.000,-9.1,0.0,0,0,0,499998.750,6000000.500,-9.0
target 2,500004.000,6000001.000,-9.2,0.0,0,0,0,500002.750,6000001.500,-9.1
"corner, north",500002.000,6000003.000,-9.3,,,,,,,
# Total error,,,,0.0
"""


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


numbers = st.floats(-1e7, 1e7, allow_nan=False).map(lambda value: round(value, 4))
points = st.none() | st.tuples(numbers, numbers)
# the csv module knows no NUL; control characters never come from the page
names = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), max_size=60)


@given(st.lists(st.tuples(names, points, points), max_size=12), st.sampled_from([None, "EPSG:1"]))
def test_what_is_written_is_read_again(tmp_path_factory, rows, crs):
    path = tmp_path_factory.mktemp("ties") / "ties.csv"
    pairs = tuple(TiePair(k, name.strip(), *both) for k, (name, *both) in enumerate(rows, 1))
    ties = TiePoints(pairs, crs)
    write_ties(ties, path)
    found = read_ties(path)
    assert found.pairs == ties.pairs
    assert found.crs == (crs if rows else None)


def test_a_failed_writing_leaves_the_file(tmp_path, monkeypatch):
    path = tmp_path / "ties.csv"
    write_ties(TiePoints((TiePair(1, "kept", (1.0, 2.0)),)), path)
    before = path.read_bytes()
    with monkeypatch.context() as patch:

        def full(*_):
            raise OSError(28, "No space left on device")

        patch.setattr("os.replace", full)
        with pytest.raises(OutputError, match="No space left"):
            write_ties(TiePoints(), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["ties.csv"]


HEAD = "id,name,reference_east,reference_north,moving_east,moving_north,crs\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no line of column names"),
        ("a,b\n1,2\n", "no line of column names"),
        (HEAD + "1,,x,2,3,4,\n", "line 2.*'x' in its reference point"),
        (HEAD + "1,,1,,3,4,\n", "line 2.*'' in its reference point"),
        (HEAD + "1,,1,nan,3,4,\n", "'nan'"),
        (HEAD + "1,,1,1e300,3,4,\n", "'1e300'"),
        (HEAD + "1,,1,2,3,4,\n1,,1,2,3,4,\n", "line 3.*id 1 twice"),
        (HEAD + "0,,1,2,3,4,\n", "whole number"),
        (HEAD + "1,,1,2,3,4,EPSG:1\n2,,1,2,3,4,EPSG:2\n", "several CRS"),
        (HEAD + "1,,1,2,3,4,,5\n", "8 values for 7 columns"),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused(tmp_path, text, said):
    with pytest.raises(InputError, match=said) as refused:
        read_ties(written(tmp_path / "ties.csv", text))
    assert "ties.csv" in str(refused.value)


def test_bytes_that_are_no_text_are_refused(tmp_path):
    path = tmp_path / "ties.csv"
    path.write_bytes(HEAD.encode() + b"1,\xff\xfe,1,2,3,4,\n")
    with pytest.raises(InputError, match="UTF-8"):
        read_ties(path)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_delimiters_byte_order_mark_and_missing_ids(tmp_path, delimiter):
    text = "\ufeff" + HEAD + ",pin,1,2,3,4,\n5,rock,5,6,,,\n,late,7,8,9,10,\n"
    path = written(tmp_path / "ties.csv", text.replace(",", delimiter))
    found = read_ties(path)
    assert [(p.id, p.name) for p in found.pairs] == [(1, "pin"), (5, "rock"), (6, "late")]
    assert found.pairs[1].moving is None
    assert [p.id for p in found.complete] == [1, 6]


def test_metashape_markers_of_one_file(tmp_path):
    """The source coordinates are the reference's, the estimated ones the moving survey's."""
    found = read_points(written(tmp_path / "markers.csv", METASHAPE), Context("EPSG:32755"))
    reference, moving = found.arrays()
    assert [p.name for p in found.pairs] == ["target 1", "target 2"]
    assert np.array_equal(reference - moving, [[1.25, -0.5], [1.25, -0.5]])
    assert "1 points have no partner" in found.notes[0]


def test_metashape_markers_of_two_files_are_matched_by_name(tmp_path):
    first = written(tmp_path / "a.csv", METASHAPE)
    rows = "#Label,X/East,Y/North\ntarget 2,10,20\ntarget 9,0,0\ncorner, north,1,1\n"
    second = written(tmp_path / "b.csv", rows.replace("corner, north", '"corner, north"'))
    found = read_points(f"{first},{second}")
    by_name = {p.name: p for p in found.pairs}
    assert set(by_name) == {"target 2", "corner, north"}
    assert by_name["target 2"].reference == (500002.75, 6000001.5)  # estimated before source
    assert by_name["corner, north"].reference == (500002.0, 6000003.0)
    assert by_name["target 2"].moving == (10.0, 20.0)


def test_degrees_go_to_the_surveys_crs(tmp_path):
    rows = "gis_label,gis_lat,gis_lon,Marker Depth (m),xyAcc,zAcc\nT1,{},{},-9,0.1,0.1\n"
    crs = "EPSG:32617"  # the Bahamas, where ReefShape comes from
    places = [(250000.0, 2800000.0), (250001.5, 2800002.5)]
    back = pyproj.Transformer.from_crs(crs, "EPSG:4326")
    files = [
        written(tmp_path / f"{k}.csv", rows.format(*(f"{v:.10f}" for v in back.transform(*place))))
        for k, place in enumerate(places)
    ]
    found = read_points(",".join(map(str, files)), Context(crs))
    assert np.allclose(found.pairs[0].reference, places[0], rtol=0, atol=1e-4)
    assert np.allclose(found.pairs[0].moving, places[1], rtol=0, atol=1e-4)
    assert any("WGS 84" in note for note in found.notes)
    with pytest.raises(InputError, match="degrees"):
        read_points(",".join(map(str, files)), Context(None))


# exportReference as ReefShape calls it, columns "nouvwUVW": the estimated coordinates alone
ESTIMATED = (
    "#Label,Enabled,X_est,Y_est,Z_est,X_error,Y_error,Z_error\ntarget 1,1,{},{},-9.1,0,0,0\n"
)


@pytest.mark.parametrize("said", [True, False])
def test_an_export_of_estimates_in_degrees_is_no_offset_of_zero(tmp_path, said):
    crs = "EPSG:32617"
    wkt = pyproj.CRS("EPSG:4326").to_wkt("WKT1_GDAL")
    head = f"#CoordinateSystem: {wkt}\n" if said else ""  # ReefShape takes that line away
    places = [(250000.0, 2800000.0), (250001.5, 2800002.5)]
    back = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    files = [
        written(
            tmp_path / f"{k}.csv",
            head + ESTIMATED.format(*(f"{v:.9f}" for v in back.transform(*place))),
        )
        for k, place in enumerate(places)
    ]
    found = read_points(",".join(map(str, files)), Context(crs))
    assert np.allclose(found.pairs[0].reference, places[0], rtol=0, atol=2e-4)
    assert np.allclose(found.pairs[0].moving, places[1], rtol=0, atol=2e-4)


def test_markers_of_another_grid_are_moved_and_of_a_local_frame_are_not(tmp_path):
    place, crs = (500000.0, 6000000.0), "EPSG:32755"
    other = pyproj.Transformer.from_crs(crs, "EPSG:32754", always_xy=True)
    wkt = pyproj.CRS("EPSG:32754").to_wkt("WKT1_GDAL")
    rows = "{}#Label,X/East,Y/North,X_est,Y_est\na,{},{},{},{}\n"
    text = rows.format(f"#CoordinateSystem: {wkt}\n", *(2 * other.transform(*place)))
    found = read_points(written(tmp_path / "other.csv", text), Context(crs))
    assert np.allclose(found.arrays(), [[place], [place]], rtol=0, atol=1e-3)
    local = '#CoordinateSystem: LOCAL_CS["Local Coordinates (m)",UNIT["metre",1]]\n'
    text = rows.format(local, 1, 2, 3, 4)
    found = read_points(written(tmp_path / "local.csv", text), Context(None))
    assert found.pairs[0].reference == (1.0, 2.0)
    text = rows.format("#CoordinateSystem: PROJCS[nonsense]\n", 500000, 6000000, 500001, 6000000)
    found = read_points(written(tmp_path / "odd.csv", text), Context(crs))
    assert found.pairs[0].reference == (500000.0, 6000000.0)
    assert "not understood" in found.notes[0]


def test_cameras_before_and_scale_bars_after_the_markers_are_passed_over(tmp_path):
    text = METASHAPE.replace(
        "#Label",
        "#Cameras\n#Label,X/East,Y/North,Yaw,Pitch,Roll,X_est,Y_est,Z_est\n"
        "IMG_1.JPG,500001,6000001,0,0,0,500001,6000001,-5\n#Markers\n#Label",
        1,
    )
    text += (
        "#Scalebars\n#Label,Distance_(m),Error_(m),Distance_est\ntarget 1_target 2,0.5,0.1,0.6\n"
    )
    found = read_points(written(tmp_path / "all.csv", text), Context("EPSG:32755"))
    assert [p.name for p in found.pairs] == ["target 1", "target 2"]


def test_a_spreadsheet_with_decimal_commas(tmp_path):
    text = "Label;X/East;Y/North;X_est;Y_est\nA;500000,25;6000000,5;500001,5;6000001,0\n"
    found = read_points(written(tmp_path / "excel.csv", text))
    assert found.pairs[0].reference == (500000.25, 6000000.5)
    assert found.pairs[0].moving == (500001.5, 6000001.0)
    text = 'Label,X,Y,X_est,Y_est\nA,"1,234.5",2,3,4\n'
    with pytest.raises(InputError, match="not a coordinate"):
        read_points(written(tmp_path / "thousands.csv", text))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("Label,X,Y\n" + "a" * 200_000 + ",1,2\n", "line 2"),
        ("Label,X,Y\n" * 100_001, "are the limit"),
        ("Label,X,Y\n" + "a,1,2\n" * 10_001, "are the limit"),
        ("a" * 17_000_000, "larger than"),
    ],
)
def test_hostile_tables_are_refused_at_once(tmp_path, text, said):
    with pytest.raises(InputError, match=said):
        read_points(written(tmp_path / "hostile.csv", text))


TAGLAB = (
    "Image name,TagLab Id,TagLab Type,TagLab Date,TagLab Class name,TagLab Genet Id,"
    "TagLab Centroid x,TagLab Centroid y,TagLab Area,TagLab Note\n"
)


def test_taglab_annotations_are_matched_by_genet_and_note(tmp_path):
    rows = (
        "2012,1,Region,2012-01-01,Porites,4,100,200,1,\n"
        "2012,2,Region,2012-01-01,Porites,6,110,210,1,\n"
        "2012,3,Point,2012-01-01,Pin,0,10,20,0,pin A\n"
        "2013,1,Region,2013-01-01,Porites,4,90,190,1,\n"
        "2013,2,Region,2013-01-01,Porites,6,95,195,1,\n"
        "2013,4,Region,2013-01-01,Porites,6,96,196,1,\n"
        "2013,3,Point,2013-01-01,Pin,0,11,21,0,pin A\n"
    )
    path = written(tmp_path / "taglab.csv", TAGLAB + rows)
    context = Context(
        None,
        {
            "reference": lambda p: np.column_stack([1000 + 0.01 * p[:, 0], 50 - 0.01 * p[:, 1]]),
            "moving": lambda p: np.column_stack([2000 + 0.02 * p[:, 0], 90 - 0.02 * p[:, 1]]),
        },
    )
    found = read_points(path, context)
    assert {p.name for p in found.pairs} == {"genet 4", "pin A"}  # 6 split: which part is meant?
    colony = next(p for p in found.pairs if p.name == "genet 4")
    assert colony.reference == pytest.approx((1001.0, 48.0))
    assert colony.moving == pytest.approx((2001.8, 86.2))
    assert any("twice" in note for note in found.notes)
    with pytest.raises(UsageError, match="--reference-ortho"):
        read_points(path)


def test_taglab_project_markers(tmp_path):
    ends = {
        "ref": [{"x": 1, "y": 2}, {"x": 3, "y": 4}],
        "coreg": [{"x": 5, "y": 6}, {"x": 7, "y": 8}],
        "type": [0, 1],
    }
    path = tmp_path / "project.json"
    # millimetres: a pixel is 2 mm in one map, 0.5 mm in the other, written as text
    images = [{"id": "a", "map_px_to_mm_factor": "2"}, {"id": "b", "map_px_to_mm_factor": 0.5}]
    document = {"images": images, "markers": {"a": {"b": {"markers": ends}}}}
    path.write_text(json.dumps(document))
    same = {"reference": lambda p: p, "moving": lambda p: p}
    found = read_points(path, Context(None, same))
    reference, moving = found.arrays()
    assert np.array_equal(reference, [[0.5, 1], [1.5, 2]])
    assert np.array_equal(moving, [[10, 12], [14, 16]])
    assert any("'a' is taken as the reference" in note for note in found.notes)
    for broken in ({**document, "images": []}, {**document, "images": [{"id": "a"}] * 2}):
        path.write_text(json.dumps(broken))
        with pytest.raises(InputError, match="there is no image"):
            read_points(path, Context(None, same))
    images[0]["map_px_to_mm_factor"] = "0"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="a size of 0"):
        read_points(path, Context(None, same))
    path.write_text("{}")
    with pytest.raises(InputError, match="TagLab"):
        read_points(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("Label,X,Y\na,1,2\n", "one survey only"),
        ("what,is,this\n1,2,3\n", "no points that are known"),
        ("Label,X,Y,X_est,Y_est\na,1,2,3,4\na,1,2,3,4\n", "two points called 'a'"),
        ("Label,X,Y,X_est,Y_est\na,1,2,,\n", "one survey only"),
    ],
)
def test_points_that_make_no_pairs_are_refused(tmp_path, text, said):
    with pytest.raises(InputError, match=said):
        read_points(written(tmp_path / "points.csv", text))


def test_three_files_are_too_many():
    with pytest.raises(UsageError, match="3 files"):
        read_points("a.csv,b.csv,c.csv")
