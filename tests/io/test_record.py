"""The record of a registration: written as JSON, read back, and the folder that holds it."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_registration import EAST, NORTH, OFFSET, YAW, made_registration

import meshreg
from meshreg.errors import InputError, UsageError
from meshreg.io.result.document import SCHEMA, registration_document, to_json
from meshreg.io.result.record import matrix_text, read_registration, write_registration
from meshreg.records import Frame, Mesh, PointCloud, Registration, SourceFile, Survey
from meshreg.settings import Settings, read_settings

SCHEMA_FILE = Path(meshreg.__file__).parent / "io" / "result" / "registration.schema.json"
VERDICTS = ("accepted", "review", "rejected")


@pytest.fixture(scope="module")
def validator() -> Any:
    schema = json.loads(SCHEMA_FILE.read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def strict(text: str) -> Any:
    """Parse JSON as other programs do: NaN and Infinity are errors."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not a JSON")

    return json.loads(text, parse_constant=refuse)


def written(tmp_path: Path, registration: Registration) -> Path:
    path = tmp_path / "registration.json"
    path.write_text(to_json(registration_document(registration)), encoding="utf-8")
    return path


@pytest.mark.parametrize("verdict", VERDICTS)
def test_document_fits_its_schema(verdict: str, validator: Any) -> None:
    document = strict(to_json(registration_document(made_registration(verdict))))
    validator.validate(document)
    rejected = verdict == "rejected"
    assert document["verdict"] == verdict
    assert (document["offset"] is None) == rejected
    assert (document["transform"]["reference_from_moving"] is None) == rejected
    assert set(document["methods"]) == {"sift", "terrain", "mutual_information"}
    assert document["methods"]["mutual_information"]["offset"] is None
    assert document["methods"]["sift"]["offset"] == [1.31, -0.69]
    assert document["methods"]["sift"]["sigma"] == pytest.approx([0.02, 0.03], rel=1e-15)


def test_schema_catches_a_rejected_pair_that_moves(validator: Any) -> None:
    document = registration_document(made_registration("accepted"))
    document["verdict"] = "rejected"
    with pytest.raises(jsonschema.ValidationError):
        validator.validate(document)


def test_document_moves_points_as_the_truth_does() -> None:
    document = registration_document(made_registration())
    matrix = np.array(document["transform"]["reference_from_moving"])
    pivot = np.array([EAST + 12, NORTH + 13, -12.5])
    # The truth is written out: turn by YAW about the pivot, then add OFFSET.
    arm = np.array([3.0, -2.0, 0.5])
    c, s = math.cos(YAW), math.sin(YAW)
    expected = pivot + OFFSET + [c * 3 + s * 2, s * 3 - c * 2, 0.5]
    np.testing.assert_allclose((matrix @ [*(pivot + arm), 1])[:3], expected, atol=5e-9, rtol=0)
    assert [document["offset"][k] for k in ("east", "north", "up")] == OFFSET.tolist()
    assert document["transform"]["yaw_degrees"] == pytest.approx(math.degrees(YAW), rel=1e-12)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_reading_gives_back_every_field(tmp_path: Path, verdict: str) -> None:
    first = made_registration(verdict)
    second = read_registration(written(tmp_path, first))
    for name in ("verdict", "reason", "before", "after", "settings", "versions", "seconds"):
        assert getattr(second, name) == getattr(first, name), name
    for name in ("reference", "moving", "notes", "schema"):
        assert getattr(second, name) == getattr(first, name), name
    assert [dict(h) for h in second.hypotheses] == [dict(h) for h in first.hypotheses]
    for one, two in zip(first.estimates, second.estimates, strict=True):
        for name in ("method", "status", "reason", "overlap", "seconds"):
            assert getattr(two, name) == getattr(one, name)
        np.testing.assert_array_equal(
            [one.east, one.north, one.score, one.gap], [two.east, two.north, two.score, two.gap]
        )
        assert (one.sigma is None) == (two.sigma is None)
        if one.sigma is not None:
            np.testing.assert_array_equal(one.sigma, two.sigma)
    if first.transform is None:
        assert second.transform is None
        return
    assert second.transform is not None
    np.testing.assert_array_equal(second.transform.offset, first.transform.offset)
    np.testing.assert_array_equal(second.transform.pivot, first.transform.pivot)
    np.testing.assert_allclose(
        second.transform.rotation, first.transform.rotation, atol=1e-15, rtol=0
    )
    np.testing.assert_array_equal(second.covariance, first.covariance)
    assert second.registration_error == first.registration_error
    # Written again, it is the same text: nothing drifts.
    again = to_json(registration_document(second))
    third = read_registration(written(tmp_path, second))
    assert to_json(registration_document(third)) == again


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_floats_survive_and_stay_floats(value: float) -> None:
    text = to_json({"v": value})
    back = strict(text)["v"]
    assert isinstance(back, float)
    assert back == value
    assert math.copysign(1, back) == math.copysign(1, value)
    digits = re.sub(r"e.*", "", text.split(":")[1]).strip(" }\n-").replace(".", "").strip("0")
    assert len(digits) <= 17


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_any_plain_value_survives(value: Any) -> None:
    assert strict(to_json(value)) == value


def test_what_json_cannot_say_is_refused_or_null() -> None:
    for bad in (math.nan, math.inf, {"a": [-math.inf]}):
        with pytest.raises(UsageError, match="cannot be said"):
            to_json(bad)
    with pytest.raises(UsageError, match="set"):
        to_json({"a": {1}})
    registration = dataclasses.replace(made_registration(), before={"overlap": np.float32("nan")})
    assert registration_document(registration)["before"]["overlap"] is None
    odd = dataclasses.replace(made_registration(), notes=("a\ud800b.obj",))
    assert strict(to_json(registration_document(odd)))["notes"] == ["a\ud800b.obj"]
    unknown = dataclasses.replace(made_registration(), settings={"x": object()})
    with pytest.raises(UsageError, match=r"registration\.settings\.x"):
        registration_document(unknown)


def change(document: dict[str, Any], place: str, value: Any) -> None:
    *path, last = place.split(".")
    for key in path:
        document = document[key]
    if value is KeyError:
        del document[last]
    else:
        document[last] = value


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("schema", "meshreg.registration/3", "newer"),
        ("schema", "odm.alignment/1", "meshreg.registration/2"),
        ("schema", KeyError, "has schema None"),
        ("verdict", "fine", "verdict"),
        ("verdict", "rejected", "offset: is .*; it must be null"),
        ("transform.reference_from_moving", None, r"reference_from_moving: is None; it must"),
        (
            "transform.reference_from_moving",
            [[1, 2], [3, 4]],
            r"reference_from_moving: is \[\[1, 2",
        ),
        ("transform.pivot", KeyError, "transform: .* contain .*pivot"),
        ("offset.east", 5.0, "contradicts itself"),
        ("offset", None, "offset: is None; it must be object"),
        ("methods.sift.status", "great", "great"),
        ("methods.sift", 3, "methods.sift: is 3; it must be object"),
        ("covariance", [[1]], "covariance"),
        ("before", [], r"before: is \[\]; it must be object"),
        ("notes", KeyError, "contain .*notes"),
    ],
)
def test_bad_records_are_refused(tmp_path: Path, place: str, value: Any, message: str) -> None:
    document = registration_document(made_registration())
    change(document, place, value)
    path = tmp_path / "registration.json"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=message) as caught:
        read_registration(path)
    assert caught.value.file == str(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not JSON"),
        (b'{"schema": "meshreg.reg', "not JSON"),
        (b"\xff\xfe{}", "not JSON"),
        (b"[]", "has schema None"),
        (b'{"schema": NaN}', "NaN"),
        (b"[" * 100_000, "not JSON"),
        (b'{"a": ' + b"1" * 10_000 + b"}", r"a: has a number over 1e\+15"),
        (b'{"a": {"b": [1, 1e400]}}', r"a\.b\[1\]: has a number over 1e\+15"),
    ],
)
def test_files_that_are_no_record(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "registration.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_registration(path)


def test_missing_and_special_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        read_registration(tmp_path / "none.json")
    with pytest.raises(InputError):
        read_registration(tmp_path)  # a folder without a record
    with pytest.raises(InputError):
        read_registration("/dev/zero")


def test_schema_constant_is_the_one_in_the_types() -> None:
    assert made_registration().schema == SCHEMA


# ---- the folder -------------------------------------------------------------------------------

NED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


def square(path: Path) -> Path:
    """A small textured-less OBJ whose numbers do not matter here."""
    path.write_text("v 1 2 3\nv 21 2 3\nv 1 22 4\nv 21 22 4\nf 1 2 3\nf 2 4 3\n")
    return path


def survey(path: Path, frame: Frame, crs: str | None = None) -> Survey:
    local = np.array([[1.0, 2, 3], [21, 2, 3], [1, 22, 4], [21, 22, 4]])
    absolute = local @ frame.axes.T + frame.shift
    mesh = Mesh(absolute - absolute[0], np.array([[0, 1, 2], [1, 3, 2]]))
    from meshreg.io.files.safe import fingerprint, sha256

    source = SourceFile(path, "obj", frame, sha256=sha256(path), fingerprint=fingerprint(path))
    return Survey(path.stem, mesh, absolute[0], crs=crs, source=(source,))


def read_matrix(path: Path) -> np.ndarray:
    lines = path.read_text().splitlines()
    assert len(lines) == 4
    for line in lines:
        # CloudCompare: four numbers, single spaces, fixed notation, 12 decimals or more
        assert re.fullmatch(r"-?\d+\.\d{12,}( -?\d+\.\d{12,}){3}", line)
    return np.array([[float(word) for word in line.split(" ")] for line in lines])


@pytest.mark.parametrize(
    ("reference_axes", "moving_axes"), [(np.eye(3), np.eye(3)), (NED, np.eye(3)), (NED, 0.01 * NED)]
)
def test_transform_files_take_file_coordinates_to_file_coordinates(
    tmp_path: Path, reference_axes: np.ndarray, moving_axes: np.ndarray
) -> None:
    registration = made_registration()
    assert registration.transform is not None
    frames = (
        Frame(reference_axes, [EAST - 3, NORTH + 7, -20.0]),
        Frame(moving_axes, [EAST + 100, NORTH, 1.5]),
    )
    surveys = [
        survey(square(tmp_path / name), frame)
        for name, frame in zip(("old.obj", "new.obj"), frames, strict=True)
    ]
    out = tmp_path / "out"
    files = write_registration(registration, out, reference=surveys[0], moving=surveys[1])
    assert set(files) == {path for path in out.rglob("*") if path.is_file()}
    forward, back, absolute = (
        read_matrix(out / f"transform{name}.txt") for name in ("", "_inverse", "_global")
    )
    rng = np.random.default_rng(1)
    for point in rng.uniform(-50, 50, (20, 3)):
        # Written out step by step: file -> absolute -> moved -> the reference's file.
        placed = moving_axes @ point + frames[1].shift
        moved = registration.transform.rotation @ (placed - registration.transform.pivot)
        moved = moved + registration.transform.pivot + OFFSET
        expected = np.linalg.solve(reference_axes, moved - frames[0].shift)
        np.testing.assert_allclose((forward @ [*point, 1])[:3], expected, atol=1e-8, rtol=0)
        np.testing.assert_allclose((back @ [*expected, 1])[:3], point, atol=1e-6, rtol=0)
        np.testing.assert_allclose((absolute @ [*placed, 1])[:3], moved, atol=1e-7, rtol=0)


def test_registered_survey_lies_in_the_reference_frame(tmp_path: Path) -> None:
    registration = made_registration()
    assert registration.transform is not None
    reference = survey(square(tmp_path / "old.obj"), Frame(np.eye(3), [EAST, NORTH, -10.0]))
    moving = survey(square(tmp_path / "new.obj"), Frame(NED, [EAST + 2, NORTH, -12.0]))
    out = tmp_path / "out"
    write_registration(registration, out, reference=reference, moving=moving)
    moved = out / "new_registered.obj"
    rows = [line.split()[1:4] for line in moved.read_text().splitlines() if line.startswith("v ")]
    assert isinstance(moving.geometry, Mesh)
    placed = moving.geometry.vertices + moving.origin
    expected = registration.transform.apply(placed) - [EAST, NORTH, -10.0]
    np.testing.assert_allclose(np.array(rows, float), expected, atol=2e-6, rtol=0)
    # The shift beside it puts it back in the world: reading it again gives absolute coordinates.
    again = meshreg.read_survey(moved)
    assert isinstance(again.geometry, Mesh)
    np.testing.assert_allclose(
        again.geometry.vertices + again.origin, registration.transform.apply(placed), atol=2e-6
    )


@pytest.mark.parametrize("verdict", VERDICTS)
def test_folder_holds_what_the_verdict_allows(tmp_path: Path, verdict: str) -> None:
    registration = made_registration(verdict)
    reference = survey(square(tmp_path / "old.obj"), Frame(np.eye(3), [EAST, NORTH, 0.0]))
    moving = survey(square(tmp_path / "new.obj"), Frame(np.eye(3), [EAST, NORTH, 0.0]))
    out = tmp_path / "out"
    write_registration(registration, out, reference=reference, moving=moving)
    names = {path.name for path in out.iterdir()}
    record = {"registration.json", "settings.toml", "manifest.json"}
    maps = {f"{which}_{what}.tif" for which in ("reference", "moving") for what in ("dem", "ortho")}
    transforms = {"transform.txt", "transform_inverse.txt", "transform_global.txt"}
    assert record <= names
    if verdict == "rejected":
        assert names == record
    else:
        assert record | maps | transforms | {"new_registered.obj"} <= names
    assert read_registration(out).verdict == verdict
    assert read_settings(out / "settings.toml") == Settings()
    assert tomllib.loads((out / "settings.toml").read_text())["preset"] == "robust"


def test_maps_in_the_folder_are_the_registered_rasters(tmp_path: Path) -> None:
    import rasterio

    registration = made_registration()
    out = tmp_path / "out"
    write_registration(registration, out)
    grids = []
    for which in ("reference", "moving"):
        raster = registration.evidence[f"{which}_dem"]
        with rasterio.open(out / f"{which}_dem.tif") as file:
            grids.append((file.transform, file.shape))
            height = file.read(1, masked=True)
            np.testing.assert_array_equal(~height.mask, raster.valid)
            expected = raster.height[raster.valid].astype(float) + raster.datum
            np.testing.assert_allclose(height.compressed(), expected, atol=2e-6)
        raster = registration.evidence[f"{which}_ortho"]
        with rasterio.open(out / f"{which}_ortho.tif") as file:
            seen = file.dataset_mask() > 0
            np.testing.assert_array_equal(seen, raster.color_valid)
            np.testing.assert_array_equal(
                np.moveaxis(file.read([1, 2, 3]), 0, -1)[seen], raster.color[seen]
            )
    assert grids[0] == grids[1]


def test_a_survey_made_in_memory_leaves_out_what_needs_files(tmp_path: Path) -> None:
    cloud = Survey("made", PointCloud(np.zeros((3, 3))))
    out = tmp_path / "out"
    write_registration(made_registration(), out, reference=cloud, moving=cloud)
    assert not (out / "transform.txt").exists()
    assert (out / "transform_global.txt").exists()


def test_existing_folder_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    with pytest.raises(UsageError):
        write_registration(made_registration("rejected"), out)
    with pytest.raises(UsageError):
        write_registration(made_registration("rejected"), out, overwrite=True)
    assert (out / "precious.txt").read_text() == "mine"
    other = tmp_path / "other"
    write_registration(made_registration("rejected"), other)
    write_registration(made_registration("accepted"), other, overwrite=True)
    assert read_registration(other).verdict == "accepted"


def test_matrix_text_keeps_the_digits_that_a_utm_northing_needs() -> None:
    matrix = made_registration().transform.matrix  # type: ignore[union-attr]
    back = np.array([[float(w) for w in line.split()] for line in matrix_text(matrix).splitlines()])
    point = np.array([EAST, NORTH, -12.0, 1.0])
    assert np.abs((back - matrix) @ point).max() < 1e-8
    assert "-0.000000000000000" not in matrix_text(-np.zeros((4, 4)))
