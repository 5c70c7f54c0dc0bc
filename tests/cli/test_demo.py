"""`meshreg demo`: a reef is made, registered, and the answer held against the truth."""

from __future__ import annotations

import io
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from made_registration import OFFSET, YAW, made_registration
from rich.console import Console

import meshreg
from meshreg.cli import console, demonstrating

ROOT = Path(__file__).parents[2]
SCHEMA = json.loads(
    (Path(meshreg.__file__).parent / "io/result/registration.schema.json").read_text()
)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The demonstration as a user runs it, over a former one."""
    out = tmp_path_factory.mktemp("demo") / "out"
    out.mkdir()
    (out / "registration.json").write_text("{}")
    (out / "validation.html").write_text("of the former run")
    command = [sys.executable, "-m", "meshreg", "demo", "--overwrite", "-o", str(out), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    assert done.stderr == ""
    return out, json.loads(done.stdout)


def test_made_reef_is_registered_to_a_tenth_of_a_cell(demo: tuple[Path, dict[str, Any]]) -> None:
    out, document = demo
    jsonschema.validate(document, SCHEMA)
    assert document["verdict"] == "accepted"
    truth = json.loads((out / "surveys" / "truth.json").read_text())
    found, true = (
        np.array(rows)
        for rows in (
            document["transform"]["reference_from_moving"],
            truth["reference_from_moving"],
        )
    )
    centroid = np.array([*truth["centroid"], 1.0])
    east, north, up, _ = (found - true) @ centroid
    assert math.hypot(east, north) < 0.1 * document["settings"]["raster"]["dem_cell"]
    assert abs(up) < 0.02
    turn = math.degrees(math.atan2(found[1, 0], found[0, 0]) - truth["yaw"])
    assert abs(turn) < 0.1
    assert math.hypot(*truth["offset"][:2]) > 0.5  # there was something to find
    said = f"{math.hypot(east, north):.4f} m horizontally, {up:+.4f} m vertically, {turn:+.4f}° yaw"
    assert document["notes"][-1] == f"Against the truth: {said}."


def test_surveys_are_meshes_of_several_pages_and_can_be_read(
    demo: tuple[Path, dict[str, Any]],
) -> None:
    out, document = demo
    assert {path.name for path in out.parent.iterdir()} == {"out"}
    names = {path.name for path in out.iterdir()}
    assert names >= {"registration.json", "surveys", "figures", "moving_registered.obj", "log.txt"}
    assert "validation.html" not in names
    assert (out / "figures" / "orthos.png").is_file()
    assert str(out.parent / ".out") not in (out / "log.txt").read_text()  # no passing names
    for name in ("reference", "moving"):
        assert document[name]["path"] == [f"{name}.obj"]
        survey = meshreg.read_survey(out / "surveys" / f"{name}.obj")
        assert len(survey.geometry.textures) == 4
        west, south, _ = survey.geometry.vertices.min(axis=0) + survey.origin
        east, north, _ = survey.geometry.vertices.max(axis=0) + survey.origin
        assert 11.5 < east - west < 13.0
        assert 11.5 < north - south < 13.0


def truth_beside(offset: np.ndarray, yaw: float) -> dict[str, Any]:
    """A truth that differs from the made registration by `offset` [m] at its pivot, and `yaw`."""
    transform = made_registration("accepted").transform
    assert transform is not None
    c, s = math.cos(YAW + yaw), math.sin(YAW + yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    pivot = np.array(transform.pivot)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = pivot + transform.offset + offset - rotation @ pivot
    return {"reference_from_moving": matrix.tolist(), "centroid": pivot.tolist()}


def test_errors_have_their_signs() -> None:
    truth = truth_beside(np.array([0.3, -0.4, 0.05]), math.radians(-0.1))
    done = demonstrating.compared(made_registration("accepted"), truth)
    assert done.found is not None
    assert done.errors is not None
    np.testing.assert_allclose(done.found[:3], OFFSET, atol=1e-6)
    np.testing.assert_allclose(done.errors, (-0.3, 0.4, -0.05, 0.1), atol=1e-6)


@pytest.mark.parametrize("verdict", ["accepted", "review", "rejected"])
def test_what_a_person_reads(tmp_path: Path, verdict: str) -> None:
    (tmp_path / "figures").mkdir()
    truth = truth_beside(np.array([0.3, -0.4, 0.05]), 0.0)
    done = demonstrating.compared(made_registration(verdict), truth)
    voice = console.Terminal()
    voice.out = Console(record=True, width=200, file=io.StringIO())
    demonstrating.show(done, tmp_path, voice)
    said = voice.out.export_text()
    assert f"Figures: {tmp_path / 'figures'}" in said
    assert ("Error: 0.5000 m horizontally, -0.0500 m vertically" in said) == (verdict != "rejected")
    assert ("east [m]" in said.rpartition("against the truth")[2]) == (verdict != "rejected")
    notes = demonstrating.document(done)["notes"]
    assert any("Against the truth" in note for note in notes) == (verdict != "rejected")
