"""The command line on files, as a user gives them: what is said, where, and with which exit code.

The surveys are sums of Gaussian bumps, written by trimesh; their motion is known exactly.
"""

from __future__ import annotations

import csv
import functools
import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from surveys import OFFSET, floors, survey

from meshreg.cli import app as cli
from meshreg.ties.table import COLUMNS

HALF = 3.5
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@functools.cache
def meshes() -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """The place and the same place later, delivered OFFSET too far south-west."""
    made = []
    for seed, floor in enumerate(floors(), 1):
        part = survey(floor, half=HALF, step=0.07, seed=seed).geometry
        points = part.vertices - (seed - 1) * OFFSET
        made.append(trimesh.Trimesh(points, part.faces, vertex_colors=part.colors, process=False))
    return made[0], made[1]


def written(folder: Path, name: str, axes: Any = None) -> tuple[Path, Path]:
    """Reference as PLY, and the moving survey as NAME, in other axes where they are given."""
    first, later = meshes()
    if axes is not None:
        later = trimesh.Trimesh(
            later.vertices @ np.asarray(axes).T,
            later.faces,
            vertex_colors=later.visual.vertex_colors,
            process=False,
        )
    paths = folder / "first.ply", folder / name
    for path, mesh in zip(paths, (first, later), strict=True):
        mesh.export(path)
    return paths


class Told:
    """One call of `meshreg register`: exit code, terminal, record and page."""

    def __init__(self, out: Path, code: int, terminal: str) -> None:
        self.code = code
        self.terminal = " ".join(terminal.split())
        self.record = json.loads((out / "registration.json").read_text())
        page = (out / "report.html").read_text(encoding="utf-8")
        self.page = " ".join(html.unescape(re.sub(r"<[^>]+>", "", page)).split())

    @property
    def codes(self) -> list[str]:
        return [finding["code"] for finding in self.record["findings"]]


@pytest.fixture
def register(tmp_path: Path, capsys: Any, monkeypatch: Any) -> Any:
    monkeypatch.setenv("COLUMNS", "400")

    def call(*arguments: Any) -> Told:
        out = tmp_path / f"out{len(list(tmp_path.glob('out*')))}"
        words = ["register", *arguments, "-o", out, "--search-radius", "5"]
        code = cli.run([str(word) for word in words])
        said = capsys.readouterr()
        return Told(out, code, said.out + said.err)

    return call


def tie_points(path: Path, off: np.ndarray) -> np.ndarray:
    """Write 13 pairs whose offsets are the true one and `off` (13, 2); return the moving ones."""
    rng = np.random.default_rng(3)
    here = rng.uniform(-0.8 * HALF, 0.8 * HALF, (13, 2)) - OFFSET[:2]
    there = here + OFFSET[:2] + off
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for k, pair in enumerate(np.hstack([there, here]), 1):
            table.writerow([k, "", *pair, ""])
    return here


def test_tie_points_beside_the_answer_are_said_everywhere(tmp_path, register):
    pair = written(tmp_path, "later.ply")
    rng = np.random.default_rng(5)
    tie_points(tmp_path / "ties.csv", np.array([0.73, 0.0]) + rng.normal(0, 0.02, (13, 2)))
    told = register(*pair, "--ties", tmp_path / "ties.csv")
    assert told.code == 4
    assert told.record["verdict"] == "review"
    assert told.codes == ["ties"]
    said = re.search(r"tie points lie (\d\.\d\d) m from the answer", told.record["reason"])
    assert said is not None
    assert float(said[1]) == pytest.approx(0.73, abs=0.03)
    assert "(13 of 13 further than 0.2 m)" in told.record["reason"]
    for text in (told.terminal, told.page):
        assert said[0] in text
    # the row of the pairs does not say "ok" beside that
    row = told.record["methods"]["ties"]
    assert row["status"] == "weak"
    assert said[0] in row["reason"]
    # the answer is that of relief and image all the same
    found = [told.record["hypotheses"][0][axis] for axis in ("east", "north")]
    assert np.hypot(*(found - OFFSET[:2])) < 0.05


def test_tie_points_that_agree_are_counted_by_their_own_residuals(tmp_path, register):
    pair = written(tmp_path, "later.glb")  # with z up, as trimesh writes what it is given
    rng = np.random.default_rng(6)
    off = rng.normal(0, 0.02, (13, 2))
    off[4] = [0.238, 0.0]
    tie_points(tmp_path / "ties.csv", off)
    told = register(*pair, "--ties", tmp_path / "ties.csv")
    assert told.code == 0
    assert "it was read as z up" in told.terminal
    found = [told.record["offset"][axis] for axis in ("east", "north", "up")]
    assert np.abs(found - OFFSET).max() < 0.02
    row = told.record["methods"]["ties"]
    assert row["status"] == "ok"
    assert row["score"] == pytest.approx(12 / 13)
    assert np.hypot(*(row["offset"] - OFFSET[:2])) < 0.02
    out = tmp_path / "out0"
    assert cli.run(["validate", str(out), str(tmp_path / "ties.csv")]) == 0
    hand = json.loads((out / "validation.json").read_text())["hand"]
    assert (hand["pairs"], hand["inliers"]) == (13, 12)


def test_a_glb_on_its_side_is_not_accepted_and_the_remedy_works(tmp_path, register):
    """A dip of 35 degrees: neither plainly z up nor y up, so that glTF's own rule holds."""
    first, later = meshes()
    slope = trimesh.transformations.rotation_matrix(np.deg2rad(35), [1, 0, 0])
    for mesh, name in ((first, "first.ply"), (later, "later.glb")):
        mesh.copy().apply_transform(slope).export(tmp_path / name)
    pair = tmp_path / "first.ply", tmp_path / "later.glb"
    told = register(*pair)
    assert told.code == 4
    remedy = re.search(r"would agree if the moving survey were read with (--up z):", told.terminal)
    assert remedy is not None
    assert remedy[0] in told.page
    assert remedy[0] in told.record["reason"]
    again = register(*pair, *remedy[1].split())
    assert "axes" not in again.codes
    assert "lean" not in again.codes


def test_north_east_down_is_named_and_the_remedy_works(tmp_path, register):
    pair = written(tmp_path, "later.ply", NED)
    told = register(*pair)
    assert told.code == 4
    assert told.codes == ["axes", "mirrored"]
    remedy = 'read with axes = "ned" in later.survey.toml beside it'
    for text in (told.terminal, told.page, told.record["reason"]):
        assert remedy in text
    (tmp_path / "later.survey.toml").write_text('axes = "ned"\n')
    again = register(*pair)
    assert again.code == 0
    moved = trimesh.load(tmp_path / "out1" / "later_registered.ply", process=False)
    truth = meshes()[1].vertices + OFFSET
    # in the reference file's axes, whatever the moving file's were
    assert np.abs(moved.vertices - truth).max() < 0.03


def test_degrees_are_told_and_nothing_else_is_guessed(tmp_path, register):
    scale = np.array([1 / 102_000, 1 / 111_000, 1.0])
    first, later = meshes()
    paths = tmp_path / "first.xyz", tmp_path / "later.xyz"
    np.savetxt(paths[0], first.vertices[::7], fmt="%.4f")
    np.savetxt(paths[1], later.vertices[::7] * scale + [151.9, -23.4, -9.0], fmt="%.9f")
    told = register(*paths)
    assert told.code == 4
    assert "look like degrees" in told.record["reason"]
    assert 'crs = "EPSG:4326" into later.survey.toml' in told.terminal
    for guess in ("--up", "--unit", "Not level", "times as wide"):
        assert guess not in told.terminal
        assert guess not in " ".join(told.record["notes"])
