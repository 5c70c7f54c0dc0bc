"""Text clouds: layouts, refusals, kernels against slow twins, moved files."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reference_io import fields_of, rows_of, spliced, utm

from meshreg.errors import InputError, MeshregError, OutputError
from meshreg.io import read_survey, rewrite_survey, write_survey
from meshreg.io.text.kernels import count_rows, parse_rows, splice_rows
from meshreg.records import Frame, PointCloud, SourceFile, Survey, Transform

POINTS = [[1.5, 2.25, 3.0], [4.0, -5.5, 6.125]]


def text(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def absolute(survey: Survey) -> np.ndarray:
    return survey.geometry.points + survey.origin


def turned(angle=0.3, **rest):
    c, s = math.cos(angle), math.sin(angle)
    return Transform(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), **rest)


# --- layouts


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    "rows",
    [
        ["1.5 2.25 3.0", "4 -5.5 6.125"],
        ["  1.5   2.25\t3.0  ", "\t4 -5.5 6.125"],
        ["1.5,2.25,3.0", "4,-5.5,6.125"],
        ["1.5, 2.25, 3.0", "4 , -5.5 , 6.125 "],
        ["1.5;2.25;3.0", "4;-5.5;6.125"],
        ["1.5\t2.25\t3.0", "4\t-5.5\t6.125"],
        ["x y z", "1.5 2.25 3.0", "4 -5.5 6.125"],
        ["X;Y;Z", "1.5;2.25;3.0", "4;-5.5;6.125"],
        ["z,y,x", "3.0,2.25,1.5", "6.125,-5.5,4"],
        ["Name,Northing,Easting,Elevation", "A,2.25,1.5,3.0", "B,-5.5,4,6.125"],
        ['"N [m]";"E [m]";"Height (m)"', "2.25;1.5;3.0", "-5.5;4;6.125"],
        ["# made by hand", "// x y z", "1.5 2.25 3.0", "# middle", "", "4 -5.5 6.125", ""],
        ["// Easting, Northing, Depth", "1.5, 2.25, -3.0", "4, -5.5, -6.125"],
        ["# y x z", "2.25 1.5 3.0", "-5.5 4 6.125"],
        ["2", "1.5 2.25 3.0", "4 -5.5 6.125"],
        ["15e-1 +2.25 3.", "4.0E0 -5.5 6.125e+0"],
        ["x,y,z,label", "1.5,2.25,3.0,", "4,-5.5,6.125,rock"],
    ],
)
def test_delimiters_headers_comments_and_line_ends(tmp_path, rows, end):
    for content in (end.join(rows), end.join(rows) + end, "\ufeff" + end.join(rows)):
        survey = read_survey(text(tmp_path / "a.txt", content))
        expected = np.array(POINTS)
        if "Depth" in rows[0]:  # negative depths are heights
            expected = expected * (1, 1, -1)
        assert absolute(survey) == pytest.approx(expected, abs=1e-15)
        assert survey.crs is None


def test_depth_counts_downward(tmp_path):
    path = text(tmp_path / "a.csv", "easting,northing,depth\n1,2,10\n3,4,12.5\n")
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(np.array([[1, 2, -10], [3, 4, -12.5]]))
    assert survey.source[0].frame.axes[2, 2] == -1
    stated = read_survey(path, axes="enu")
    assert absolute(stated)[:, 2] == pytest.approx([10, 12.5])


def test_longitude_and_latitude_become_metres(tmp_path):
    path = text(
        tmp_path / "a.csv",
        "lat,lon,elevation\n-38.77,143.66,2\n-38.771,143.661,3\n-38.772,143.66,4\n",
    )
    survey = read_survey(path)
    assert survey.crs == "EPSG:32754"
    assert "EPSG:4326" in survey.notes[0]
    expected = [
        (*utm(143.66, -38.77, 54), 2),
        (*utm(143.661, -38.771, 54), 3),
        (*utm(143.66, -38.772, 54), 4),
    ]
    # WGS 84 is flatter by so little that it shows in a tenth of a millimetre.
    assert absolute(survey) == pytest.approx(np.array(expected), rel=0, abs=1e-3)
    assert read_survey(path, crs="EPSG:7844").crs == "EPSG:7854"
    (tmp_path / "a.prj").write_text("EPSG:7844")
    said = read_survey(path)
    assert said.crs == "EPSG:7854"
    assert not any("EPSG:4326" in note for note in said.notes)


# --- colors


@pytest.mark.parametrize(
    ("name", "rows", "colors"),
    [
        ("a.xyz", ["1 2 3 255 0 10", "4 5 6 1 2 3"], [[255, 0, 10], [1, 2, 3]]),
        ("a.xyz", ["1 2 3 1.0 0.0 0.5", "4 5 6 0.2 0.4 0.6"], [[255, 0, 128], [51, 102, 153]]),
        ("a.txt", ["x y z red green blue", "1 2 3 0 1 1", "4 5 6 1 0 0"], [[0, 1, 1], [1, 0, 0]]),
        ("a.csv", ["b,g,r,z,y,x", "1,2,3,4,5,6", "7,8,9,1,2,3"], [[3, 2, 1], [9, 8, 7]]),
        ("a.csv", ["x,y,z,R,G,B", "1,2,3,65535,0,257", "4,5,6,0,0,0"], [[255, 0, 1], [0, 0, 0]]),
        ("a.pts", ["2", "1 2 3 -99 10 20 30", "4 5 6 17 1 2 3"], [[10, 20, 30], [1, 2, 3]]),
        ("a.pts", ["1 2 3 99 10 20 30", "4 5 6 17 1 2 3"], [[10, 20, 30], [1, 2, 3]]),
        ("a.xyz", ["1 2 3 -99 10 20 30", "4 5 6 17 1 2 3"], [[10, 20, 30], [1, 2, 3]]),
        ("a.xyz", ["1 2 3 10 20 30 99.5", "4 5 6 1 2 3 17"], [[10, 20, 30], [1, 2, 3]]),
        ("a.xyz", ["1 2 3 0 0 1", "4 5 6 0 1 0"], [[0, 0, 1], [0, 1, 0]]),
        ("a.xyz", ["1 2 3 0.6 0.8 0.0", "4 5 6 0 0 1"], None),  # unit vectors: normals
        ("a.xyz", ["1 2 3 -0.6 0.8 0.0", "4 5 6 0 0 1"], None),
        ("a.xyz", ["1 2 3 400 20 30", "4 5 6 17 1 2"], None),
        ("a.xyz", ["1 2 3 99", "4 5 6 17"], None),
        ("a.csv", ["x,y,z,intensity", "1,2,3,99", "4,5,6,17"], None),
        (
            "a.txt",
            ["//X Y Z Rf Gf Bf", "1 2 3 0.2 0.4 0.6", "4 5 6 1 1 1"],
            [[51, 102, 153], [255] * 3],
        ),
    ],
)
def test_colors(tmp_path, name, rows, colors):
    path = text(tmp_path / name, "\n".join(rows))
    survey = read_survey(path)
    found = survey.geometry.colors
    assert (None if found is None else found.tolist()) == colors
    assert read_survey(path, geometry_only=True).geometry.colors is None
    if colors is not None and not any(c.isalpha() for c in rows[0]):
        assert "red green blue" in survey.notes[0]


RNG = np.random.default_rng(41)
SHADE = RNG.integers(20, 230, 60)  # what the three channels of a picture have in common
RGB = np.clip(SHADE[:, None] + RNG.integers(-8, 9, (60, 3)), 0, 255)
NORMALS = RNG.normal((0, 0, 2), 1.0, (60, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
PLACES = RNG.uniform(0, 20, (60, 3)).round(3)
LIDAR = RNG.integers(0, 256, 60)  # knows nothing of the picture
COLUMNS = {
    "xyz": [[f"{v:.3f}" for v in row] for row in PLACES],
    "rgb": [[f"{v}" for v in row] for row in RGB],
    "rgb.0": [[f"{v}.000000" for v in row] for row in RGB],
    "RGB": [[f"{257 * v}" for v in row] for row in RGB],
    "rgbf": [[f"{v / 255:.6f}" for v in row] for row in RGB],
    "n": [[f"{v:.6f}" for v in row] for row in NORMALS],
    "i": [[f"{v}"] for v in LIDAR],
    "-i": [[f"{v - 2048}"] for v in 16 * LIDAR],
    "i.": [[f"{v / 7:.3f}"] for v in LIDAR],
    "class": [[f"{v % 3 + 1}"] for v in LIDAR],
    "alpha": [["255"]] * 60,
    "id": [[f"{k}"] for k in range(7, 67)],
    "label": [[f"P{k}"] for k in range(60)],
}


@pytest.mark.parametrize("delimiter", [" ", ";", "\t", ", "])
@pytest.mark.parametrize(
    ("parts", "names"),
    [
        ("xyz n", "x y z nx ny nz"),
        ("xyz n rgb", "x y z nx ny nz red green blue"),
        ("xyz rgb n", "x y z red green blue nx ny nz"),
        ("xyz rgbf n", "x y z red green blue nx ny nz"),
        ("xyz i n", "x y z other nx ny nz"),
        ("xyz i rgb", "x y z intensity red green blue"),
        ("xyz -i rgb n", "x y z intensity red green blue nx ny nz"),
        ("xyz i. rgb", "x y z intensity red green blue"),
        ("xyz rgb i", "x y z red green blue other"),
        ("xyz rgb i.", "x y z red green blue other"),
        ("xyz rgb class", "x y z red green blue other"),
        ("xyz class rgb", "x y z intensity red green blue"),
        ("xyz rgb alpha", "x y z red green blue other"),
        ("xyz class i rgb alpha n", "x y z other other red green blue other nx ny nz"),
        ("xyz i RGB", "x y z intensity red green blue"),
        ("xyz rgb.0 i", "x y z red green blue other"),
        ("id xyz rgb", "id x y z red green blue"),
        ("label xyz i rgb", "id x y z intensity red green blue"),
        ("id xyz n", "id x y z nx ny nz"),
    ],
)
def test_columns_without_a_header_are_known_by_what_is_in_them(tmp_path, parts, names, delimiter):
    table = zip(*(COLUMNS[part] for part in parts.split()), strict=True)
    rows = [[word for part in row for word in part] for row in table]
    path = text(tmp_path / "a.txt", "\n".join(delimiter.join(row) for row in rows))
    survey = read_survey(path)
    assert survey.notes[0].startswith(f"Columns: {names} (guessed")
    assert absolute(survey) == pytest.approx(PLACES, abs=1e-12)
    if "rgb" in parts.lower():
        assert np.abs(survey.geometry.colors.astype(int) - RGB).max() == 0
    else:
        assert survey.geometry.colors is None
    move = turned(0.7, offset=(1, 2, 3))
    (written, *_) = rewrite_survey(survey, move, tmp_path / "out")
    mark = "," if delimiter == ", " else delimiter
    again = [fields_of(line, mark) for line in written.read_bytes().split(b"\n")]
    for k, name in enumerate(names.split()):
        column = [row[k].decode() for row in again]
        if name in "xyz":
            expected = move.apply(PLACES)[:, "xyz".index(name)]
            assert np.array(column, float) == pytest.approx(expected, abs=5.1e-5)
        elif name in ("nx", "ny", "nz"):
            c, s = math.cos(0.7), math.sin(0.7)
            x, y, z = NORMALS.T
            expected = {"nx": c * x - s * y, "ny": s * x + c * y, "nz": z}[name]
            assert np.array(column, float) == pytest.approx(expected, abs=2e-6)
        else:
            assert column == [row[k] for row in rows]


def test_a_color_of_gray_noise_is_the_last_triple(tmp_path):
    values = np.random.default_rng(1).integers(0, 256, (50, 4))
    rows = [f"{k}.5 {k * k}.25 1.0 {' '.join(map(str, row))}" for k, row in enumerate(values)]
    survey = read_survey(text(tmp_path / "a.xyz", "\n".join(rows)))
    assert (survey.geometry.colors == values[:, 1:]).all()


def test_names_of_columns_can_be_said(tmp_path):
    path = text(tmp_path / "a.xyz", "1 2.5 3 10 20 30\n2 4 -5.5 1 2 3\n3 1 1 9 8 7\n")
    text(tmp_path / "a.survey.toml", 'columns = ["id", "y", "x", "z", "q", "w"]')
    survey = read_survey(path)
    assert absolute(survey) == pytest.approx(np.array([[3, 2.5, 10], [-5.5, 4, 1], [1, 1, 9]]))
    assert survey.geometry.colors is None
    assert not any("guessed" in note for note in survey.notes)
    text(tmp_path / "a.survey.toml", 'columns = ["x", "y", "z"]')
    with pytest.raises(InputError, match="3 names in its header, but 6 values"):
        read_survey(path)
    text(tmp_path / "a.survey.toml", "columns = [1, 2, 3]")
    with pytest.raises(InputError, match="a list of names"):
        read_survey(path)


@pytest.mark.parametrize(
    ("head", "delimiter"), [("", ";"), ("", "\t"), ("", " "), ("X;Y;Z;R;G;B;Nx;Ny;Nz\n", ";")]
)
def test_decimal_commas_are_read_and_written(tmp_path, head, delimiter):
    rows = [
        ["731000,125", "5705000,5", "-12", "255", "0", "9", "0,6", "0,8", "0,0"],
        ["731001", "5705003,25", "-13,5", "1", "2", "3", "0,0", "0,0", "1,0"],
    ]
    path = text(tmp_path / "a.csv", head + "".join(delimiter.join(row) + "\n" for row in rows))
    survey = read_survey(path)
    assert any("decimal commas" in note for note in survey.notes)
    expected = np.array([[731000.125, 5705000.5, -12], [731001, 5705003.25, -13.5]])
    assert absolute(survey) == pytest.approx(expected, abs=1e-9)
    assert survey.geometry.colors.tolist() == [[255, 0, 9], [1, 2, 3]]
    files = rewrite_survey(survey, turned(math.pi / 2, offset=(1, 2, 3)), tmp_path / "out")
    moved = [
        "-5704999,5000 731002,1250 -9,0000 255 0 9 -0,800000 0,600000 0,000000\n",
        "-5705002,2500 731003,0000 -10,5000 1 2 3 0,000000 0,000000 1,000000\n",
    ]
    assert files[0].read_text() == head + "".join(moved).replace(" ", delimiter)


def test_classes_of_noise_and_water_are_left_out(tmp_path):
    rows = "".join(f"{k},{k * k},{k},{c}\n" for k, c in enumerate((1, 2, 7, 9, 40, 41, 42, 45, 18)))
    survey = read_survey(text(tmp_path / "a.csv", "x,y,z,Classification\n" + rows))
    assert absolute(survey)[:, 0].tolist() == [0, 1, 4]
    assert survey.notes[0].startswith("2 points classed as noise")
    assert survey.notes[1].startswith("4 points classed as water")
    kept = read_survey(text(tmp_path / "b.csv", "x,y,z,class\n" + rows))  # a coral, perhaps
    assert len(kept.geometry.points) == 9
    with pytest.raises(InputError, match="no points that are ground") as bad:
        read_survey(text(tmp_path / "c.csv", "x,y,z,classification\n1,2,3,41\n2,3,4,45\n"))
    assert "40 bed" in bad.value.remedy


# --- refusals and repairs


def test_rows_without_coordinates_are_left_out_and_counted(tmp_path):
    rows = ["1 2 3", "nan 2 3", "4 5 NaN", "4 inf 6", "7 8 9"]
    survey = read_survey(text(tmp_path / "a.xyz", "\n".join(rows)))
    assert absolute(survey) == pytest.approx(np.array([[1, 2, 3], [7, 8, 9]]))
    assert survey.notes == ("3 rows without coordinates were left out.",)
    survey = read_survey(text(tmp_path / "a.csv", "x,y,z\n1,2,3\n,5,6\n7,8,\n"))
    assert len(survey.geometry.points) == 1
    with pytest.raises(InputError, match="no points"):
        read_survey(text(tmp_path / "a.csv", "x,y,z\nnan,2,3\n"))


def test_strays_are_left_out_and_counted(tmp_path):
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 20, (500, 3)) + np.array([731_000, 5_705_000, 0])
    points[77] = 0
    path = tmp_path / "a.xyz"
    np.savetxt(path, points, fmt="%.4f")
    survey = read_survey(path)
    assert len(survey.geometry.points) == 499
    assert "1 points far away" in survey.notes[0]


@pytest.mark.parametrize(
    ("content", "message", "place"),
    [
        ("1 2 3\n4 5 6\n7 8\n", "has 2 values where the other rows have 3", "line 3"),
        ("# c\n\n1 2 3\n4 5 6 7\n", "has 4 values where", "line 4"),
        ("1 2 3\r\n4 5 6\r\n7 8\r\n", "has 2 values", "line 3"),
        ("1,2,3\n4,5,6\n4,,5,6\n", "has 4 values", "line 3"),
        ("1 2 3\n4 5 x6\n", "text where a number should be: 'x6'", "line 2"),
        ("1 2 3\n4 5 6_0\n", "text where a number", "line 2"),
        ("1 2 3\n4 5 0x10\n", "text where a number", "line 2"),
        ("1 2.5 3\n4 5 6,5\n", "decimal comma", "line 2"),
        ("1,5, 2,5, 3,5\n", "decimal comma", None),
        ("x,y,z\n1,5,2,5,3,5\n", "3 names in its header, but 6 values", "line 2"),
        ("1 2 3\n4 5 \x006\n", "NUL", "byte 10"),
        ("\ufeff1 2 3\n".encode("utf-16-le"), "UTF-16", None),
        ("hello world\n", "no rows of numbers", None),
        ("hello\nwide\nworld\n", "no rows of three numbers", None),
        ("1 2\n3 4\n", "no rows of three numbers", None),
        ("# only\n// comments\n", "no rows of numbers", None),
        ("\n\n", "no rows of numbers", None),
        ("x y z\n", "no rows of numbers", None),
        ("a,b,c\n1,2,3\n", "no columns x, y and z among 'a', 'b', 'c'", "header"),
        ("x,y,r\n1,2,3\n", "no columns x, y and z", "header"),
        ("3\n1 2 3\n4 5 6\n", "announces 3 points, but holds 2", "line 1"),
        ("1\n1 2 3\n4 5 6\n", "announces 1 points, but holds 2", "line 1"),
        ("ncols 4\nnrows 2\n1 2 3 4\n", "ESRI grid", None),
    ],
)
def test_what_is_wrong_is_refused_with_its_place(tmp_path, content, message, place):
    path = text(tmp_path / "a.txt", content)
    with pytest.raises(InputError, match=re.escape(message)) as bad:
        read_survey(path)
    assert bad.value.file == str(path)
    assert bad.value.place == place
    assert bad.value.remedy
    assert bad.value.exit_code == 3


def test_one_very_long_line_ends_soon(tmp_path):
    path = text(tmp_path / "a.txt", b"1 2 3 " + b"x" * 4_000_000)
    with pytest.raises(InputError):
        read_survey(path)


GOOD = b"x,y,z,r,g,b\n" + b"".join(b"%d.25,%d.5,-%d,10,20,30\n" % (k, 2 * k, k) for k in range(40))


@given(st.data())
@settings(
    deadline=None, max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_random_damage_reads_or_is_refused_and_nothing_else(tmp_path, data):
    content = bytearray(GOOD)
    for _ in range(data.draw(st.integers(1, 5))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=3))
    path = text(tmp_path / "damaged.csv", bytes(content))
    try:
        survey, refusal = read_survey(path), None
    except MeshregError as error:  # and no other
        survey, refusal = None, error
    assert survey is not None or (refusal.exit_code == 3 and "damaged.csv" in str(refusal))


# --- kernels against their slow twins

plain = st.floats(-1e7, 1e7).map(lambda value: f"{value:.6f}")
odd = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.sampled_from(["nan", "NaN", "0", "-0.0", "+1", ".5", "5.", "1e-5", "7E+3", "1" * 25]),
)
blanks = st.sampled_from([" ", "  ", "\t", " \t "])


@st.composite
def tables(draw):
    """Lines of a text cloud and how they are delimited."""
    delimiter = draw(st.sampled_from([" ", ",", ";", "\t"]))
    columns = draw(st.integers(3, 6))
    number = st.one_of(plain, odd)
    lines = []
    for _ in range(draw(st.integers(1, 8))):
        fields = [draw(number) for _ in range(columns)]
        if delimiter == " ":
            line = "".join(draw(blanks) + field for field in fields)
            line = line.lstrip() if draw(st.booleans()) else line + draw(blanks)
        else:
            pad = " " if draw(st.booleans()) else ""
            line = delimiter.join(pad + field + pad for field in fields)
        lines.append(line)
        if draw(st.booleans()):
            lines.append(draw(st.sampled_from(["", "   ", "# c", " // 1 2 3 4 5 6 7"])))
    end = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    return end.join(lines) + draw(st.sampled_from(["", end])), delimiter, columns


def parsed(content, delimiter, slots, capacity=100):
    data = np.frombuffer(content, np.uint8)
    rows = count_rows(data, 0)
    out = np.full((rows, max(slots) + 1), np.nan)
    state = np.array([0, 1, 0], np.int64)
    unsettled = np.zeros((capacity, 5), np.int64)
    while state[0] < len(data):
        count, fields = parse_rows(data, state, ord(delimiter), np.array(slots), out, unsettled)
        for row, slot, start, end, _ in unsettled[:count]:
            out[row, slot] = float(content[start:end])
        if fields:
            return out, fields, int(state[1])
    return out, 0, 0


@given(tables(), st.integers(6, 20))
@settings(deadline=None)
def test_rows_are_parsed_as_python_parses_them(table, capacity):
    content, delimiter, columns = table
    slots = [2, -1, 0, 1, -1, 3][:columns] if columns > 3 else [2, 0, 1]
    wanted = [slots.index(k) for k in range(max(slots) + 1)]
    out, fields, _ = parsed(content.encode(), delimiter, slots, capacity)
    assert fields == 0
    expected = np.array(rows_of(content.encode(), delimiter, wanted))
    assert np.array_equal(out, expected, equal_nan=True)


@given(tables(), st.data())
@settings(deadline=None)
def test_an_uneven_row_is_found_at_its_line(table, data):
    content, delimiter, columns = table
    lines = re.split("\r\n|\n|\r", content)
    rows = [k for k, line in enumerate(lines) if fields_of(line.encode(), delimiter)]
    bad = data.draw(st.sampled_from(rows))
    lines[bad] += f"{delimiter}1"
    _, fields, line = parsed("\n".join(lines).encode(), delimiter, [0, 1, 2, -1, -1, -1][:columns])
    assert (fields, line) == (columns + 1, bad + 1)


@given(tables(), st.integers(0, 6), st.data())
@settings(deadline=None)
def test_fields_are_replaced_and_nothing_else(table, least, data):
    content, delimiter, columns = table
    replaced = sorted(data.draw(st.sets(st.integers(0, columns - 1), min_size=1, max_size=3)))
    raw = content.encode()
    array = np.frombuffer(raw, np.uint8)
    rows = count_rows(array, 0)
    value = st.one_of(st.floats(-1e6, 1e6), st.just(math.nan))
    numbers = np.array(
        data.draw(
            st.lists(
                st.lists(value, min_size=len(replaced), max_size=len(replaced)),
                min_size=rows,
                max_size=rows,
            )
        )
    )
    state, got = np.array([0, 0], np.int64), b""
    while state[0] < len(raw):
        out = np.zeros(len(raw) + 1000, np.uint8)
        size = splice_rows(
            array,
            state,
            ord(delimiter),
            np.array(replaced),
            numbers,
            np.full(len(replaced), least),
            out,
        )
        assert size > 0
        got += out[:size].tobytes()
    row, expected = 0, b""
    for line in re.findall(rb"[^\r\n]*(?:\r\n|\n|\r)|[^\r\n]+", raw):
        body, end = re.fullmatch(rb"(.*?)([\r\n]*)", line).groups()
        fields = fields_of(body, delimiter)
        if fields is not None:
            words = {}
            for number, column in zip(numbers[row], replaced, strict=True):
                if math.isfinite(number):
                    words[column] = fixed(number, fields[column], least)
            body = spliced(body, delimiter, words)
            row += 1
        expected += body + end
    assert got == expected


def fixed(number: float, field: bytes, least: int) -> bytes:
    """A number with as many decimals as the field had, at least some, while 2^53 holds it."""
    match = re.fullmatch(rb"[+-]?\d*\.(\d*)", field)
    decimals = min(max(least, len(match[1]) if match else 0), 15)
    while round(abs(number) * 10.0**decimals) > 9e15 and decimals:
        decimals -= 1
    digits = str(int(np.rint(abs(number) * 10.0**decimals))).zfill(decimals + 1)
    sign = "-" if number < 0 and digits.strip("0") else ""
    whole, part = (digits[:-decimals], digits[-decimals:]) if decimals else (digits, "")
    return (sign + whole + ("." + part if part else "")).encode()


@given(st.floats(-1e6, 1e6), st.integers(0, 9))
@settings(deadline=None)
def test_numbers_are_written_to_half_a_last_digit(number, decimals):
    out = np.zeros(200, np.uint8)
    data = np.frombuffer(b"1", np.uint8)
    state = np.zeros(2, np.int64)
    size = splice_rows(
        data, state, 44, np.array([0]), np.array([[number]]), np.array([decimals]), out
    )
    written = out[:size].tobytes().decode()
    assert re.fullmatch(rf"-?\d+\.\d{{{decimals}}}" if decimals else r"-?\d+", written)
    assert abs(float(written) - number) <= 0.5 * 10.0**-decimals + 1e-9


# --- writing and rewriting


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv"])
def test_a_new_file_can_be_read_by_numpy(tmp_path, suffix):
    rng = np.random.default_rng(9)
    points = rng.uniform(-50, 50, (300, 3))
    colors = rng.integers(0, 256, (300, 3)).astype(np.uint8)
    survey = Survey("reef", PointCloud(points, colors), (731_000, 5_705_000, 0), "EPSG:32754")
    files = write_survey(survey, tmp_path / f"new{suffix}")
    assert [p.name for p in files] == [f"new{suffix}", "new.survey.toml"]
    comma = suffix == ".csv"
    table = np.loadtxt(
        files[0], delimiter="," if comma else None, comments="//", skiprows=int(comma)
    )
    expected = np.hstack([np.add(points, (731_000, 5_705_000, 0)), colors])
    assert table == pytest.approx(expected, rel=0, abs=5.1e-7)
    again = read_survey(files[0])
    assert again.crs == "EPSG:32754"
    assert (again.geometry.colors == colors).all()


def test_only_coordinates_and_normals_change(tmp_path):
    content = (
        b"// made by hand\r\n"
        b"Name;X;Y;Z;Nx;Ny;Nz;Red;Green;Blue;Quality\r\n"
        b"A b; 10.50 ;20;30.123456;0;1;0;1;2;3;0.90\r\n"
        b"# remark\r\n"
        b"B;11;nan;30;0.6;0.8;0;1;2;3;\r\n"
        b"C;12.0;22;31;0;0;1;1;2;3;x"
    )
    survey = read_survey(text(tmp_path / "a.csv", content))
    (path,) = rewrite_survey(survey, turned(math.pi / 2, offset=(1, 2, 3)), tmp_path / "out")
    assert path.read_bytes() == (
        b"// made by hand\r\n"
        b"Name;X;Y;Z;Nx;Ny;Nz;Red;Green;Blue;Quality\r\n"
        b"A b; -19.0000 ;12.5000;33.123456;-1.000000;0.000000;0.000000;1;2;3;0.90\r\n"
        b"# remark\r\n"
        b"B;11;nan;30;0.6;0.8;0;1;2;3;\r\n"
        b"C;-21.0000;14.0000;34.0000;0.000000;0.000000;1.000000;1;2;3;x"
    )


def home(frame: Frame) -> Survey:
    source = SourceFile(Path("home.obj"), "obj", frame)  # only its frame counts
    return Survey("home", PointCloud(np.zeros((1, 3))), crs=frame.crs, source=(source,))


@pytest.mark.parametrize(
    "frame",
    [
        Frame(),
        Frame(shift=(731_000, 5_705_000, 0)),
        Frame([[0, 1, 0], [1, 0, 0], [0, 0, -1]], (731_000, 5_705_000, 10)),
        Frame(np.eye(3) * 0.3048),
    ],
)
@pytest.mark.parametrize(
    "head", ["", "x y z\n", "easting northing depth\n", "easting northing elevation\n"]
)
def test_moved_into_any_frame_and_back(tmp_path, frame, head):
    rng = np.random.default_rng(10)
    points = rng.uniform(1, 20, (50, 3))
    rows = "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in points)
    survey = read_survey(text(tmp_path / "a.txt", head + rows))
    move = turned(offset=(731_000, 5_705_000, 5))
    there = rewrite_survey(survey, move, tmp_path / "there", home(frame))
    moved = read_survey(there[0])
    assert absolute(moved) == pytest.approx(move.apply(absolute(survey)), rel=0, abs=2e-6)
    back = rewrite_survey(moved, move.inverse(), tmp_path / "back", survey)
    assert absolute(read_survey(back[0])) == pytest.approx(absolute(survey), rel=0, abs=3e-6)


def test_degrees_into_metres_are_renamed(tmp_path):
    path = text(
        tmp_path / "a.csv",
        "id,Longitude,Latitude,depth\n1,143.66,-38.77,-2\n2,143.661,-38.771,-3\n3,143.66,-38.772,-4\n",
    )
    survey = read_survey(path)
    frame = Frame(file_crs="EPSG:32754", crs="EPSG:32754")
    files = rewrite_survey(
        survey, turned(offset=(1, 2, 9), pivot=survey.centre), tmp_path / "o", home(frame)
    )
    assert files[0].read_text().startswith("id,x,y,z\n1,")
    again = read_survey(files[0])
    expected = turned(offset=(1, 2, 9), pivot=survey.centre).apply(absolute(survey))
    assert absolute(again) == pytest.approx(expected, rel=0, abs=6e-5)
    assert again.crs == "EPSG:32754"


def test_degrees_stay_degrees_without_a_reference(tmp_path):
    path = text(
        tmp_path / "a.csv",
        "lon,lat,z\n143.66,-38.77,2\n143.661,-38.771,3\n143.66,-38.772,4\n",
    )
    survey = read_survey(path)
    move = turned(offset=(1, 2, 9), pivot=survey.centre)
    files = rewrite_survey(survey, move, tmp_path / "out")
    assert files[0].read_text().startswith("lon,lat,z\n143.6")
    again = read_survey(files[0])
    assert absolute(again) == pytest.approx(move.apply(absolute(survey)), rel=0, abs=1.5e-4)


def test_a_failed_rewrite_leaves_nothing(tmp_path, monkeypatch):
    from meshreg.io.text import write as xyz_write

    survey = read_survey(text(tmp_path / "a.xyz", "1 2 3\n4 5 6\n"))

    def cut(*args):
        yield b"1 2 3\n"

    monkeypatch.setattr(xyz_write, "_moved_lines", cut)
    with pytest.raises(OutputError, match="does not read back"):
        rewrite_survey(survey, turned(), tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())
