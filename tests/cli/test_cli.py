"""The command line: exit codes, what is said and where, what is left on the disk."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import logging
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pytest
from made_registration import made_registration
from PIL import Image
from rich.console import Console

import meshreg
import meshreg.pipeline
from meshreg.cli import app as cli
from meshreg.cli import common, console, info, machine
from meshreg.cli.arguments import Axes
from meshreg.cli.options import for_both, join_settings, read_options
from meshreg.doctor import Check, run_probe
from meshreg.errors import InputError, UsageError
from meshreg.io.result.document import read_registration
from meshreg.records import Grid, Maps, Mesh, PointCloud, Survey, Transform
from meshreg.settings import Settings

ROOT = Path(__file__).parents[2]
SCHEMA = json.loads(
    (Path(meshreg.__file__).parent / "io/result/registration.schema.json").read_text()
)
Run = Callable[..., tuple[int, str, str]]


def write_obj(path: Path, seed: int = 0) -> Path:
    """A small bumpy OBJ, 8 × 8 vertices half a metre apart."""
    rng = np.random.default_rng(seed)
    rows = [
        f"v {0.5 * i:.3f} {0.5 * j:.3f} {rng.uniform(-0.1, 0.1):.4f}"
        for j in range(8)
        for i in range(8)
    ]
    for j in range(7):
        for i in range(7):
            a = 8 * j + i + 1
            rows += [f"f {a} {a + 1} {a + 9}", f"f {a} {a + 9} {a + 8}"]
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.fixture
def pair(tmp_path: Path) -> tuple[str, str]:
    folder = tmp_path / "in"
    folder.mkdir()
    return str(write_obj(folder / "old.obj", 1)), str(write_obj(folder / "new.obj", 2))


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.setenv("COLUMNS", "200")

    def call(*arguments: object) -> tuple[int, str, str]:
        code = cli.run([str(argument) for argument in arguments])
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


@pytest.fixture
def verdict(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], dict[str, Any]]:
    """Replace the registration itself by a made one; return what the command line asked of it."""

    def decide(name: str) -> dict[str, Any]:
        asked: dict[str, Any] = {}

        def register_pair(
            reference: Survey, moving: Survey, settings: Settings, **rest: Any
        ) -> Any:
            asked.update(reference=reference, moving=moving, settings=settings, **rest)
            for stage in ("rasterize", "sift", "judge"):
                rest["progress"](stage, 0.0)
                rest["progress"](stage, 1.0)
            logging.getLogger("meshreg").warning("a [bold]loud[/bold] word")
            return dataclasses.replace(
                made_registration(name),
                settings=settings.as_dict(),
                reference=meshreg.pipeline.recording._about(reference),
                moving=meshreg.pipeline.recording._about(moving),
            )

        monkeypatch.setattr(meshreg.pipeline, "register_pair", register_pair)
        return asked

    # Figures have their own tests; here only that they are asked for.
    monkeypatch.setattr(
        "meshreg.report.draw_figures",
        lambda registration, folder: Path(folder).mkdir() or (),
    )
    return decide


# ---- register ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "code"), [("accepted", 0), ("review", 4), ("rejected", 4)])
def test_register_tells_the_verdict_by_its_exit_code(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any, name: str, code: int
) -> None:
    verdict(name)
    out = tmp_path / "deep" / "out"
    got, said, error = run("register", *pair, "-o", out)
    assert got == code
    assert name.upper() in said
    assert made_registration(name).reason in said
    assert str(out) in said
    names = {path.name for path in out.iterdir()}
    assert {"registration.json", "settings.toml", "log.txt", "figures"} <= names
    assert ("new_registered.obj" in names) == (name != "rejected")
    assert ("next:" in said) == (code == 4)
    # Plain lines, one a stage, when nobody watches; markup in a message is not interpreted.
    lines = error.splitlines()
    assert [line for line in lines if line == "rasterizing"] == ["rasterizing"]
    assert lines.index("reading") < lines.index("rasterizing") < lines.index("writing")
    assert "warning: a [bold]loud[/bold] word" in lines
    log = (out / "log.txt").read_text()
    assert "a [bold]loud[/bold] word" in log
    assert f"{name}: " in log
    assert sorted(path.name for path in out.parent.iterdir()) == ["out"]  # no lock, no leftovers


def test_json_is_the_record_and_nothing_else(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    verdict("accepted")
    code, said, error = run("register", *pair, "-o", tmp_path / "out", "--json")
    assert (code, error) == (0, "")
    document = json.loads(said)
    jsonschema.validate(document, SCHEMA)
    assert said == (tmp_path / "out" / "registration.json").read_text()
    assert document["seconds"]["read"] > 0


def test_options_reach_the_registration(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    asked = verdict("accepted")
    config = tmp_path / "c.toml"
    config.write_text("seed = 3\n[sift]\nratio = 0.7\n[search]\nradius = 4.0\n")
    code, _, error = run(
        "register", *pair, "-o", tmp_path / "out",
        "--reference-shift", "731000,5705000,-1.5", "--moving-shift", "-13.4,8.7,-1.25",
        "--axes", "ned", "--unit", "cm", "--search-radius", 30, "--dem-cell", 0.2,
        "--methods", "terrain,sift", "--config", config, "--set", "judge.min_overlap=0.4",
        "--set", "sift.sample=7",
    )  # fmt: skip
    assert code == 0, error
    settings: Settings = asked["settings"]
    assert settings.search.radius == 30.0  # an option beats the file
    assert settings.sift.ratio == 0.7
    assert settings.sift.sample == 7
    assert settings.seed == 3
    assert settings.judge.min_overlap == 0.4
    assert settings.raster.dem_cell == 0.2
    assert settings.methods == ("terrain", "sift")
    # north, east, down in centimetres, then the shift: written out for the first vertices
    for name, shift in (("reference", [731000, 5705000, -1.5]), ("moving", [-13.4, 8.7, -1.25])):
        survey: Survey = asked[name]
        assert isinstance(survey.geometry, Mesh)
        path = Path(pair[0 if name == "reference" else 1])
        x, y, z = (float(word) for word in path.read_text().splitlines()[9].split()[1:])
        expected = np.array([y, x, -z]) / 100 + shift
        np.testing.assert_allclose(survey.geometry.vertices[9] + survey.origin, expected, atol=1e-9)
    assert (tmp_path / "out" / "settings.toml").read_text().count("radius = 30.0") == 1


def test_masks_go_to_the_survey_that_they_name(tmp_path: Path) -> None:
    square = {
        "type": "Feature", "properties": {},
        "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [2, 0], [2, 2], [0, 2], [0, 0]]]},
    }  # fmt: skip
    path = tmp_path / "a.geojson"
    # Coordinates beyond degrees are the local frame's own metres.
    far = json.loads(
        json.dumps(square).replace("[2, 2]", "[2, 1000]").replace("[0, 2]", "[0, 1000]")
    )
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [far]}))
    grid = Grid(-1.0, 3.0, 1.0, (4, 4))
    inside = np.zeros((4, 4), bool)
    inside[0:3, 1:3] = True
    square_survey = Survey("a", PointCloud(np.array([[0.0, 0, 0], [2, 2, 0]])))
    surveys = {"reference": square_survey, "moving": square_survey}
    plain = common.read_masks([str(path)], surveys)
    assert plain["moving"] is None
    assert plain["reference"] is not None
    np.testing.assert_array_equal(plain["reference"](grid), inside)
    other = common.read_masks([f"moving:not:{path}"], surveys)
    assert other["reference"] is None
    assert other["moving"] is not None
    np.testing.assert_array_equal(other["moving"](grid), ~inside)
    both = common.read_masks([str(path), f"not:{path}"], surveys)
    assert both["reference"] is not None
    assert not both["reference"](grid).any()
    # Asked at places, as the rasterizer asks of a survey that it moves.
    twice = common.read_masks([f"moving:{path}", f"moving:{path}"], surveys)["moving"]
    assert twice is not None
    assert twice.at([0.5, 2.5], [0.5, 0.5]).tolist() == [True, False]  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match="no moving survey"):
        common.read_masks([f"moving:{path}"], {"reference": square_survey})
    with pytest.raises(InputError):
        common.read_masks([str(tmp_path / "none.geojson")], surveys)


def test_same_file_twice_is_said(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    verdict("accepted")
    code, said, error = run("register", pair[0], pair[0], "-o", tmp_path / "out")
    assert code == 3
    assert "--allow-same" in error
    assert not (tmp_path / "out").exists()
    assert run("selftest", pair[0], pair[0])[0] == 3
    command = ("register", pair[0], pair[0], "-o", tmp_path / "out", "--allow-same")
    code, said, error = run(*command)
    assert code == 0
    assert "same file" in error
    assert "same file" in said
    notes = json.loads((tmp_path / "out" / "registration.json").read_text())["notes"]
    assert any("same file" in note for note in notes)


@pytest.mark.parametrize("lost", ["old", "new"])
def test_a_lost_shift_is_made_up_for_and_said(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any, lost: str
) -> None:
    """One of two local exports has its shift file: kilometres apart, yet one frame."""
    asked = verdict("accepted")
    kept = "new" if lost == "old" else "old"
    (tmp_path / "in" / f"{kept}_offset.xyz").write_text("731000 5705000 0\n")
    code, _, error = run("register", *pair, "-o", tmp_path / "out")
    assert code == 0, error
    assert "reference's was taken for both" in error
    shifts = [asked[which].source[0].frame.shift.tolist() for which in ("reference", "moving")]
    assert shifts == [[731000, 5705000, 0] if kept == "old" else [0, 0, 0]] * 2
    assert np.abs(asked["reference"].centre - asked["moving"].centre).max() < 0.5
    document = json.loads((tmp_path / "out" / "registration.json").read_text())
    assert document["moving"]["shift"] == shifts[0]
    assert any("731000, 5705000, 0" in note for note in document["notes"])
    # The registered file lies in the reference file's coordinates: moved by the transform alone.
    transform = made_registration().transform
    assert transform is not None
    first = np.array(Path(pair[1]).read_text().split()[1:4], float)
    moved = transform.apply(first + shifts[1]) - shifts[0]
    written = (tmp_path / "out" / "new_registered.obj").read_text().split()[1:4]
    np.testing.assert_allclose(np.array(written, float), moved, atol=1e-5)
    # A shift that the user states is not made up for.
    asked.clear()
    code, _, error = run("register", *pair, "-o", tmp_path / "two", "--moving-shift", "500000,0,0")
    assert np.abs(asked["moving"].centre[0] - 500000) < 10


@pytest.mark.parametrize("side", ["reference", "moving"])
def test_a_crs_on_one_side_only_is_no_obstacle(tmp_path: Path, run: Run, side: str) -> None:
    """The whole way: the numbers of both are one local frame, and it is said."""
    import pyproj
    from surveys import OFFSET, displaced, floors, survey

    first, later = floors()
    reference = survey(first, half=3.0, name="old")
    moving, _ = displaced(survey(later, half=3.0, seed=2, name="new"))
    for one in (reference, moving):
        far = dataclasses.replace(one, origin=one.origin + np.array([731_000.0, 5_705_000.0, 0.0]))
        meshreg.write_survey(far, tmp_path / f"{one.name}.ply")
    name = {"reference": "old", "moving": "new"}[side]
    (tmp_path / f"{name}.prj").write_text(pyproj.CRS(32754).to_wkt("WKT1_ESRI"))
    out = tmp_path / "out"
    code, said, error = run(
        "register", tmp_path / "old.ply", tmp_path / "new.ply", "-o", out,
        "--search-radius", 4, "--methods", "terrain", "--json",
    )  # fmt: skip
    assert code == 0, said + error
    document = json.loads(said)
    found = [document["offset"][key] for key in ("east", "north", "up")]
    np.testing.assert_allclose(found, OFFSET, atol=0.02)
    assert any("one local frame" in note for note in document["notes"])
    known = document["reference"]["crs"]
    assert (known == "EPSG:32754") == (side == "reference")
    again = meshreg.read_survey(out / "new_registered.ply")
    assert again.crs == known
    # the middle of the box: a tilt of a tenth of a degree lifts it by a centimetre
    assert np.abs(again.centre - moving.centre - [731_000, 5_705_000, 0] - found).max() < 0.03


def test_geometry_alone_where_the_texture_is_broken(
    tmp_path: Path, run: Run, verdict: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every command that reads a survey takes the option that its error message names."""
    asked = verdict("accepted")
    monkeypatch.setattr(
        "meshreg.pipeline.self_test",
        lambda *surveys, **rest: SimpleNamespace(document=lambda: {"verdict": "accepted"}),
    )
    old, new = (write_obj(tmp_path / f"{name}.obj", k) for k, name in enumerate(("old", "new")))
    broken = new.read_text().replace("f 1 2 10", "vt 0 0\nusemtl m\nf 1/1 2/1 10/9")
    new.write_text("mtllib new.mtl\n" + broken)
    (tmp_path / "new.mtl").write_text("newmtl m\nmap_Kd new.png\n")
    Image.new("RGB", (4, 4)).save(tmp_path / "new.png")
    jobs: tuple[tuple[object, ...], ...] = (
        ("register", old, new, "-o", tmp_path / "out"),
        ("selftest", old, new),
        ("rasterize", new, "-o", tmp_path / "maps"),
        ("info", new),
        ("apply", tmp_path / "out", new, "-o", tmp_path / "moved"),
    )
    for job in jobs:
        code, said, error = run(*job, "--json")
        assert code == 3
        assert "--geometry-only" in json.loads(said)["error"]["remedy"]
        code, said, error = run(*job, "--geometry-only", "--json")
        assert code == 0, (job, said, error)
    assert asked["moving"].geometry.uv is None
    assert len(asked["moving"].geometry.faces) == 98
    # and what is written keeps the file's own bytes, the broken ones too
    assert "10/9" in (tmp_path / "out" / "new_registered.obj").read_text()
    assert "10/9" in next((tmp_path / "moved").glob("new*.obj")).read_text()


def test_two_models_of_unknown_scale_need_one(tmp_path: Path, run: Run, verdict: Any) -> None:
    asked = verdict("accepted")
    model = ROOT / "tests" / "data" / "colmap"
    code, _, error = run("register", model, model, "-o", tmp_path / "out", "--allow-same")
    assert code == 2
    assert "--scale" in error
    assert not asked
    assert list(tmp_path.iterdir()) == []
    code, _, error = run(
        "register", model, model, "-o", tmp_path / "out", "--scale", 2, "--scale", 3, "--allow-same"
    )
    assert code == 0, error
    sizes = [np.ptp(asked[which].bounds[:, 0]) for which in ("reference", "moving")]
    assert sizes[1] / sizes[0] == pytest.approx(1.5)


def test_a_model_that_changes_meanwhile_gives_no_output(
    tmp_path: Path, run: Run, verdict: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A COLMAP folder as the reference: its files are looked at again at the end."""
    import shutil

    model = tmp_path / "in" / "model"
    shutil.copytree(ROOT / "tests" / "data" / "colmap", model)
    new = write_obj(tmp_path / "in" / "new.obj")

    def register_pair(*surveys: Any, **rest: Any) -> Any:
        (model / "images.bin").write_bytes((model / "images.bin").read_bytes() + b" ")
        return made_registration()

    verdict("accepted")
    monkeypatch.setattr(meshreg.pipeline, "register_pair", register_pair)
    code, _, error = run("register", model, new, "-o", tmp_path / "out")
    assert code == 3
    assert "model" in error
    assert "changed" in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_names_with_markup_are_shown_as_they_are(tmp_path: Path, run: Run, verdict: Any) -> None:
    verdict("accepted")
    folder = tmp_path / "[bold]"
    folder.mkdir()
    (folder / "a[").mkdir()
    old, new = write_obj(folder / "[red]x.obj", 1), write_obj(folder / "a[" / "b].obj", 2)
    out = folder / "[green]out"
    code, said, error = run("register", old, new, "-o", out)
    assert code == 0, error
    assert "[green]out" in said
    assert "b]_registered.obj" in said
    code, _, error = run("register", folder / "a[" / "i]none.obj", new, "-o", folder / "o2")
    assert code == 3
    assert "a[/i]none.obj" in error


def test_existing_output_is_refused_then_replaced(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    asked = verdict("accepted")
    out = tmp_path / "out"
    assert run("register", *pair, "-o", out)[0] == 0
    before = (out / "registration.json").read_bytes()
    asked.clear()
    code, _, error = run("register", *pair, "-o", out)
    assert code == 2
    assert "--overwrite" in error
    assert not asked  # refused before any work
    assert (out / "registration.json").read_bytes() == before
    verdict("rejected")
    assert run("register", *pair, "-o", out, "--overwrite")[0] == 4
    assert not (out / "new_registered.obj").exists()


def test_a_folder_of_somebody_elses_is_never_replaced(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    verdict("accepted")
    precious = tmp_path / "out" / "thesis.txt"
    precious.parent.mkdir()
    precious.write_text("mine")
    assert run("register", *pair, "-o", precious.parent, "--overwrite")[0] == 2
    assert precious.read_text() == "mine"


@pytest.mark.parametrize(
    "kind", ["reference", "moving", "texture", "side file", "ties", "mask", "config", "notes"]
)
def test_an_input_in_the_old_result_is_never_removed(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any, kind: str
) -> None:
    """Whatever is read, whether meshreg wrote it or not: refused with its name, and all stays."""
    verdict("accepted")
    out = tmp_path / "out"
    assert run("register", *pair, "-o", out)[0] == 0
    surveys = [Path(path) for path in pair]
    more: list[object] = []
    if kind in ("reference", "moving"):
        named = out / "new_registered.obj"  # a file of our own, but it is read
        surveys[("reference", "moving").index(kind)] = named
    elif kind == "texture":
        named = out / "page.mtl"
        named.write_text("newmtl a\n")
        beside = tmp_path / "beside.obj"
        beside.write_text("mtllib out/page.mtl\n" + surveys[1].read_text())
        surveys[1] = beside
        with (out / "manifest.json").open() as file:  # as if it were of ours
            document = json.load(file)
        document["files"]["page.mtl"] = {
            "bytes": 9, "sha256": hashlib.sha256(b"newmtl a\n").hexdigest(),
        }  # fmt: skip
        (out / "manifest.json").write_text(json.dumps(document))
    elif kind == "side file":
        named = out / "settings.toml"
        (tmp_path / "in" / "new_offset.xyz").symlink_to(named)
        surveys[1] = out / "new_registered.obj"
    elif kind == "notes":
        named = out / "notes.txt"
        named.write_text("mine")
    else:
        named = out / {"ties": "ties.csv", "mask": "mask.geojson", "config": "settings.toml"}[kind]
        if kind != "config":
            named.write_text("mine")
        more = [f"--{kind}", f"moving:not:{named}" if kind == "mask" else named]
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    code, _, error = run("register", *surveys, "-o", out, "--overwrite", *more)
    assert code == 2, error
    assert "Nothing is deleted" in error
    assert named.name in error or kind == "side file"
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_a_rejected_result_is_replaced_without_being_asked_for(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    out = tmp_path / "out"
    verdict("rejected")
    assert run("register", *pair, "-o", out)[0] == 4
    (out / "notes.txt").write_text("mine")
    verdict("accepted")
    code, _, error = run("register", *pair, "-o", out)
    assert (code, "notes.txt" in error) == (2, True)
    (out / "notes.txt").unlink()
    assert run("register", *pair, "-o", out)[0] == 0
    assert run("register", *pair, "-o", out)[0] == 2


@pytest.mark.parametrize("command", ["rasterize", "apply", "selftest", "synth"])
def test_no_command_removes_what_it_did_not_write(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any, command: str
) -> None:
    verdict("accepted")
    out, other = tmp_path / "out", tmp_path / "result"
    marker = {"rasterize": "dem.tif", "apply": "moved.json", "selftest": "selftest.json"}
    arguments: dict[str, list[object]] = {
        "rasterize": [pair[0], "--dem-cell", 1],
        "apply": [other, pair[1]],
        "selftest": [*pair, "--shifts", 1],
        "synth": ["flat_sand", "--size", 2, "--format", "ply-cloud"],
    }
    if command == "apply":
        assert run("register", *pair, "-o", other)[0] == 0
    out.mkdir()
    (out / marker.get(command, "truth.json")).write_text("{}")
    (out / "mine.txt").write_text("mine")
    code, _, error = run(command, *arguments[command], "-o", out, "--overwrite")
    assert (code, "mine.txt" in error) == (2, True), error
    assert (out / "mine.txt").read_text() == "mine"
    if command in ("selftest", "synth"):
        return  # the work itself has its own tests
    (out / "mine.txt").unlink()
    (out / marker[command]).unlink()
    for _ in range(2):
        code, _, error = run(command, *arguments[command], "-o", out, "--overwrite")
        assert code == 0, error
    assert json.loads((out / "manifest.json").read_text())["command"] == command


def test_input_that_changes_meanwhile_gives_no_output(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def register_pair(*surveys: Any, **rest: Any) -> Any:
        write_obj(Path(pair[1]), 77)
        return made_registration()

    verdict("accepted")
    monkeypatch.setattr(meshreg.pipeline, "register_pair", register_pair)
    code, _, error = run("register", *pair, "-o", tmp_path / "out")
    assert code == 3
    assert "new.obj" in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


@pytest.mark.parametrize(
    ("raised", "code", "words"),
    [
        (MemoryError("12 GB"), 5, ("memory", "12 GB", "--dem-cell")),
        (RuntimeError("odd"), 1, ("RuntimeError: odd", "bug", "--debug")),
        (OSError(28, "No space left on device"), 6, ("No space left",)),
        (InputError("is odd.", file="x.obj", place="line 3", remedy="Mend it."), 3,
         ("x.obj, line 3: is odd.", "Mend it.")),
    ],
)  # fmt: skip
@pytest.mark.parametrize("flags", [(), ("--json",), ("--debug",)])
def test_what_goes_wrong_is_one_message_and_no_output(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any, monkeypatch: pytest.MonkeyPatch,
    raised: BaseException, code: int, words: tuple[str, ...], flags: tuple[str, ...],
) -> None:  # fmt: skip
    def register_pair(*surveys: Any, **rest: Any) -> Any:
        raise raised

    verdict("accepted")
    monkeypatch.setattr(meshreg.pipeline, "register_pair", register_pair)
    got, said, error = run("register", *pair, "-o", tmp_path / "out", *flags)
    assert got == code
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]
    assert ("Traceback" in error) == ("--debug" in flags)
    if "--json" in flags:
        assert error == ""
        found = json.loads(said)
        assert found["schema"] == "meshreg.error/1"
        assert found["error"]["code"] == code
        assert set(found["error"]) == {"code", "kind", "file", "place", "cause", "remedy"}
        text = f"{found['error']['file']}, {found['error']['place']}: {found['error']['cause']} "
        text += str(found["error"]["remedy"])
    else:
        assert said == ""
        text = error
    for word in words:
        assert word in text


def test_keyboard_interrupt_outside_the_job(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("meshreg.doctor.examine", interrupted)
    code, said, error = run("doctor", "--debug")
    assert (code, said) == (130, "")
    assert error.strip() == "Stopped; nothing was written."


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("register", "a.obj"), "Missing argument"),
        (("register", "a", "b"), "--out"),
        (("register", "a", "b", "-o", "c", "--no-such"), "no-such"),
        (("register", "a", "b", "-o", "c", "--axes", "xyz"), "enu"),
        (("register", "a", "b", "-o", "c", "--moving-shift", "1,2"), "three numbers"),
        (("register", "a", "b", "-o", "c", "--set", "sift.sample"), "="),
        (("register", "a", "b", "-o", "c", "--set", "sift.nothing=3"), "sift.nothing"),
        (("register", "a", "b", "-o", "c", "--set", "sift.sample=many"), "sift.sample"),
        (("register", "a", "b", "-o", "c", "--config", "none.toml"), "none.toml"),
        (("register", "a", "b", "-o", "c", "--scale", "1", "--scale", "2", "--scale", "3"), "3"),
        (("frobnicate",), "frobnicate"),
    ],
)
@pytest.mark.parametrize("as_json", [False, True])
def test_usage_errors(run: Run, arguments: tuple[str, ...], words: str, as_json: bool) -> None:
    code, said, error = run(*arguments, *(["--json"] if as_json else []))
    assert code == 2
    if as_json:
        assert error == ""
        assert json.loads(said)["error"]["code"] == 2
        assert words in json.loads(said)["error"]["cause"] + said
    else:
        assert said == ""
        assert words in error
        assert "Traceback" not in error


@pytest.mark.parametrize("flags", [(), ("--json",)])
def test_missing_input_is_bad_input(
    tmp_path: Path, pair: tuple[str, str], run: Run, flags: tuple[str, ...]
) -> None:
    code, said, error = run("register", tmp_path / "no.obj", pair[1], "-o", tmp_path / "o", *flags)
    assert code == 3
    assert "no.obj" in said + error
    assert not (tmp_path / "o").exists()


def test_full_disk_is_found_before_the_work(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = verdict("accepted")
    usage = type("Usage", (), {"free": 3_000_000})
    monkeypatch.setattr("shutil.disk_usage", lambda folder: usage)
    code, _, error = run("register", *pair, "-o", tmp_path / "out")
    assert code == 6
    assert "3 MB free" in error
    assert not asked


def test_output_that_cannot_be_written_is_found_before_the_work(
    pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    asked = verdict("accepted")
    for out in ("/proc/meshreg/out", pair[0] + "/out"):
        code, _, error = run("register", *pair, "-o", out)
        assert code == 6
        assert "cannot be written" in error
    assert not asked


def test_help_version_and_no_arguments(run: Run) -> None:
    code, said, _ = run("--help")
    assert code == 0
    for command in ("register", "rasterize", "apply", "info", "doctor", "demo"):
        assert command in said
        assert run(command, "--help")[0] == 0
    assert run("--version")[1].strip() == f"meshreg {meshreg.__version__}"
    assert run()[0] == 2


# ---- stopping ---------------------------------------------------------------------------------

BUSY = """
import sys, ctypes, time
import meshreg.pipeline
def register_pair(*surveys, **rest):
    print("working", flush=True)
    if {native}:
        ctypes.CDLL(None).sleep(60)  # a native call: Python hears of signals only after it
    else:
        while True:
            time.sleep(0.01)
meshreg.pipeline.register_pair = register_pair
from meshreg.cli.app import run
sys.exit(run(sys.argv[1:]))
"""


@pytest.mark.parametrize("native", [False, True])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_stop_the_job_and_leave_nothing(
    tmp_path: Path, pair: tuple[str, str], native: bool, number: int, code: int
) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-c", BUSY.format(native=native), "register", *pair, "-o", str(out)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "working\n"
        assert any(path.name.startswith(".out") for path in tmp_path.iterdir())
        time.sleep(0.2)
        process.send_signal(number)
        _, error = process.communicate(timeout=30)  # a native call would last 60
    assert process.returncode == code, error
    assert "Stopped" in error
    assert "Traceback" not in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_second_signal_ends_at_once(tmp_path: Path, pair: tuple[str, str]) -> None:
    command = [
        sys.executable, "-c", BUSY.format(native=True), "register", *pair,
        "-o", str(tmp_path / "out"),
    ]  # fmt: skip
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        for _ in range(2):
            process.send_signal(signal.SIGINT)
            time.sleep(0.3)
        process.communicate(timeout=30)
    assert process.returncode == 130


def test_a_second_run_into_one_folder_is_refused(
    tmp_path: Path, pair: tuple[str, str], run: Run
) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-c", BUSY.format(native=False), "register", *pair, "-o", str(out)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "working\n"
        code, said, _ = run("register", *pair, "-o", out, "--json")
        assert code == 6
        assert f"process {process.pid}" in json.loads(said)["error"]["cause"]
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_reader_that_goes_away_is_no_error(tmp_path: Path, pair: tuple[str, str]) -> None:
    code = f"{sys.executable} -m meshreg info {pair[0]} | head -c 1"
    done = subprocess.run(code, shell=True, capture_output=True, text=True, cwd=ROOT, check=False)
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


# ---- the other commands -----------------------------------------------------------------------


def test_rasterize_writes_a_dem(tmp_path: Path, pair: tuple[str, str], run: Run) -> None:
    import rasterio

    out = tmp_path / "maps"
    code, said, error = run("rasterize", pair[0], "-o", out, "--dem-cell", 0.25, "--json")
    assert code == 0, error
    document = json.loads(said)
    assert set(document["maps"]) == {"dem"}  # the mesh has no color
    assert document["maps"]["dem"]["cell"] == 0.25
    with rasterio.open(out / "dem.tif") as file:
        assert file.res == (0.25, 0.25)
        height = file.read(1, masked=True)
        rows = [
            line.split()[3] for line in Path(pair[0]).read_text().splitlines() if line[0] == "v"
        ]
        z = np.array(rows, float)
        assert z.min() <= height.min() <= height.max() <= z.max()
        assert height.count() * 0.0625 == pytest.approx(3.5**2, rel=0.2)
    code, said, _ = run("rasterize", pair[0], "-o", out)
    assert code == 2
    assert run("rasterize", pair[0], "-o", out, "--overwrite")[0] == 0


def test_apply_moves_a_further_file(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    verdict("accepted")
    out = tmp_path / "out"
    assert run("register", *pair, "-o", out)[0] == 0
    cloud = tmp_path / "in" / "more.xyz"
    points = np.random.default_rng(4).uniform(0, 3, (50, 3)).round(3)
    cloud.write_text("\n".join(" ".join(f"{v:.3f}" for v in row) for row in points) + "\n")
    code, said, error = run("apply", out, cloud, "-o", tmp_path / "moved", "--json")
    assert code == 0, error
    document = json.loads(said)
    assert document["verdict"] == "accepted"
    assert all(Path(name).is_file() for name in document["files"])
    moved = np.loadtxt(tmp_path / "moved" / "more_registered.xyz")
    transform = made_registration().transform
    assert isinstance(transform, Transform)
    np.testing.assert_allclose(moved[:, :3], transform.apply(points), atol=2e-3)


def test_apply_refuses_before_the_work_what_cannot_be_written(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import meshreg.io
    from meshreg.errors import InputError

    verdict("accepted")
    out = tmp_path / "out"
    assert run("register", *pair, "-o", out)[0] == 0
    written: list[Any] = []

    def bent(survey: Any, reference: Any = None) -> None:
        raise InputError("would be bent by that.", file=survey.source[0].path)

    monkeypatch.setattr(meshreg.io, "require_writable", bent)
    monkeypatch.setattr(meshreg.io, "rewrite_survey", lambda *given, **more: written.append(given))
    code, _, error = run("apply", out, pair[1], "-o", tmp_path / "moved")
    assert code == 3
    assert "would be bent" in error
    assert not written
    assert not (tmp_path / "moved").exists()


def test_apply_writes_in_the_reference_files_axes(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    verdict("accepted")
    out = tmp_path / "out"
    code, _, error = run("register", *pair, "-o", out, "--axes", "ned")
    assert code == 0, error
    # The same file again: `apply` knows the axes and shift of the reference from the record only.
    code, _, error = run("apply", out, pair[1], "-o", tmp_path / "moved", "--axes", "ned")
    assert code == 0, error
    again = (tmp_path / "moved" / "new_registered.obj").read_bytes()
    assert again == (out / "new_registered.obj").read_bytes()
    first = Path(pair[1]).read_text().split()[1:4]
    x, y, z = (float(word) for word in first)
    transform = made_registration().transform
    assert transform is not None
    east, north, up = transform.apply([y, x, -z])  # north, east, down
    moved = [float(word) for word in again.decode().split()[1:4]]
    np.testing.assert_allclose(moved, [north, east, -up], atol=1e-5)


def test_apply_adds_the_shift_that_the_registered_survey_had(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    verdict("accepted")
    out, shift = tmp_path / "out", "731000,5705000,0"
    code, _, error = run(
        "register", *pair, "-o", out, "--reference-shift", shift, "--moving-shift", shift
    )
    assert code == 0, error
    # The same file, in the same local coordinates, but nothing is said of its shift.
    code, _, error = run("apply", out, pair[1], "-o", tmp_path / "moved")
    assert code == 0
    assert "shift (731000, 5705000, 0) was added" in error
    again = (tmp_path / "moved" / "new_registered.obj").read_bytes()
    assert again == (out / "new_registered.obj").read_bytes()
    # A shift that is said is taken, and what then lies elsewhere is warned of.
    code, _, error = run("apply", out, pair[1], "-o", tmp_path / "far", "--shift", "9,9,9")
    assert code == 0
    assert "outside the survey that was registered" in error


def test_apply_lays_a_model_as_it_was_registered(tmp_path: Path, run: Run, verdict: Any) -> None:
    """Its scale was stated then; `apply` has it from the record."""
    import shutil

    verdict("accepted")
    model, out = tmp_path / "model", tmp_path / "out"
    shutil.copytree(ROOT / "tests" / "data" / "colmap", model)
    code, _, error = run(
        "register", model, model, "-o", out, "--scale", 2, "--scale", 3, "--allow-same"
    )
    assert code == 0, error
    code, _, error = run("apply", out, model, "-o", tmp_path / "moved")
    assert code == 0, error
    assert "when it was registered" in error
    moved, was = (meshreg.read_survey(x / "model_registered") for x in (tmp_path / "moved", out))
    assert np.abs(moved.geometry.points - was.geometry.points).max() < 1e-9  # type: ignore[union-attr]
    # Another model has another frame.
    other = tmp_path / "other"
    shutil.copytree(was.source[0].path, other)
    code, _, error = run("apply", out, other, "-o", tmp_path / "two")
    assert code == 2
    assert "not the model that was registered" in error


def test_apply_refuses_a_rejected_registration(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    verdict("rejected")
    out = tmp_path / "out"
    run("register", *pair, "-o", out)
    code, _, error = run("apply", out / "registration.json", pair[1], "-o", tmp_path / "moved")
    assert code == 2
    assert "rejected" in error
    assert not (tmp_path / "moved").exists()


def test_apply_warns_of_a_review(
    tmp_path: Path, pair: tuple[str, str], run: Run, verdict: Any
) -> None:
    verdict("review")
    run("register", *pair, "-o", tmp_path / "out")
    code, _, error = run("apply", tmp_path / "out", pair[1], "-o", tmp_path / "moved")
    assert code == 0
    assert "review" in error


def test_info_says_what_is_there(pair: tuple[str, str], run: Run) -> None:
    code, said, error = run("info", pair[0], "--json")
    assert (code, error) == (0, "")
    document = json.loads(said)
    assert document["kind"] == "mesh"
    assert document["counts"] == {"vertices": 64, "faces": 98, "texture pages": 0}
    assert document["bounds"]["low"][:2] == [0.0, 0.0]
    assert document["size"][:2] == [3.5, 3.5]
    assert 0.5 <= document["spacing"]["edges"] < 0.6
    assert document["up"]["level"] is True
    code, said, _ = run("info", pair[0])
    for words in ("64 vertices, 98 faces", "none stated", "level", "edges 0.5"):
        assert words in said


def test_info_reads_a_model_as_register_does(tmp_path: Path, run: Run) -> None:
    model = ROOT / "tests" / "data" / "colmap"
    plain, scaled = (
        json.loads(run("info", model, "--json", *more)[1]) for more in ((), ("--scale", 2.5))
    )
    assert not plain["scale_known"]
    np.testing.assert_allclose(scaled["size"], 2.5 * np.array(plain["size"]), rtol=1e-6)


def tilted(angle: float, axis: str = "x") -> Survey:
    """A rough square of ground, turned about an axis."""
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(-5, 5, (4000, 2)), rng.normal(0, 0.05, 4000)])
    points[:20, 2] += 300  # floaters
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) if axis == "x" else np.eye(3)
    return Survey("made", PointCloud(points @ turn.T))


@pytest.mark.parametrize("angle", [0.0, 4.0, 25.0, 88.0])
def test_info_measures_the_tilt(angle: float) -> None:
    document = info.describe(tilted(angle))
    assert document["up"]["tilt_degrees"] == pytest.approx(angle, abs=0.3)
    assert document["up"]["level"] == (angle < 10)
    assert document["up"]["guess"] == ("y" if angle > 45 else "z")
    said = " ".join(document["notes"])
    assert ("Not level" in said) == (angle > 10)
    assert ("--up y" in said) == (angle > 45)
    if angle == 0:  # 4000 points on 100 m²
        assert document["spacing"]["points"] == pytest.approx(np.sqrt(100 / 4000), rel=0.1)


def test_info_measures_texels() -> None:
    from meshreg.records import Texture

    corners = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [10, 10, 0]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    uv = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])[faces]
    page = Texture("page.jpg", (1000, 1000), lambda: np.zeros((1000, 1000, 3), np.uint8))
    mesh = Mesh(corners, faces, uv=uv, face_texture=np.zeros(2), textures=(page,))
    document = info.describe(Survey("made", mesh))
    assert document["spacing"]["texels"] == pytest.approx(0.01, rel=1e-6)
    assert document["textures"] == [{"name": "page.jpg", "width": 1000, "height": 1000, "faces": 2}]


def test_info_of_maps_and_of_projected_numbers_without_crs() -> None:
    grid = Grid(500_000.0, 6_000_000.0, 0.5, (4, 6))
    document = info.describe(Survey("made", Maps(np.zeros((4, 6)), grid)))
    assert document["spacing"] == {"height cell": 0.5, "color cell": None}
    assert document["counts"] == {"cells with height": 24}
    assert any("no CRS" in note for note in document["notes"])


# ---- doctor -----------------------------------------------------------------------------------


def test_probe_tells_success_failure_and_death() -> None:
    assert run_probe("print('one'); print('two')") == (True, "two")
    found, said = run_probe("import no_such_module_at_all")
    assert not found
    assert "no_such_module_at_all" in said
    found, said = run_probe("import os; os.kill(os.getpid(), 11)")
    assert (found, said) == (False, "killed by signal 11")
    found, said = run_probe("import time; time.sleep(60)", seconds=0.5)
    assert not found
    assert "no answer" in said


def test_doctor_prints_the_command_that_helps(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    checks = (
        Check("Python", "ok", "everything", "3.11.2"),
        Check("libGL.so.1", "optional", "3-D pictures", "not [found]", "apt-get install libgl1"),
        Check("3-D", "optional", "pictures", "no", "apt-get install libgl1 libegl1"),
        Check("E57", "optional", "E57", "no", "python -m pip install pye57"),
    )
    monkeypatch.setattr("meshreg.doctor.examine", lambda: checks)
    code, said, _ = run("doctor")
    assert code == 0
    assert "not [found]" in said
    commands = [line.strip() for line in said.splitlines() if line.startswith("  ")][-2:]
    assert commands == ["apt-get install libgl1 libegl1", "python -m pip install pye57"]
    assert "runs without them" in said
    missing = (*checks, Check("PROJ", "missing", "CRS", "broken", "unset PROJ_DATA"))
    monkeypatch.setattr("meshreg.doctor.examine", lambda: missing)
    code, said, _ = run("doctor", "--json")
    assert code == 5
    assert json.loads(said)["checks"][-1]["remedy"] == "unset PROJ_DATA"
    assert machine.document(checks)["schema"] == "meshreg.doctor/1"


@pytest.mark.needs("pycolmap")  # which is among the checks
def test_doctor_examines_this_machine(run: Run) -> None:
    code, said, _ = run("doctor", "--json")
    checks = {check["name"]: check for check in json.loads(said)["checks"]}
    assert code == 0
    for name in ("Python", "numba", "SIFT", "PROJ", "GeoTIFF", "LAZ", "COLMAP"):
        assert checks[name]["state"] == "ok", checks[name]
    for check in checks.values():
        assert check["state"] == "ok" or check["remedy"]


def test_doctor_sees_a_wrong_proj_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from meshreg import doctor

    monkeypatch.setenv("PROJ_DATA", str(tmp_path))
    monkeypatch.setenv("PROJ_LIB", str(tmp_path))
    checks = {check.name: check for check in doctor.examine()}
    # meshreg ignores such a setting for itself, so it is not fatal; but it is said.
    assert checks["PROJ"].state == "optional"
    assert "PROJ_DATA" in checks["PROJ"].detail
    assert checks["PROJ"].remedy == "unset PROJ_DATA PROJ_LIB"


# ---- settings and words -----------------------------------------------------------------------


def test_settings_are_joined_in_order(tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text('preset = "paper"\n[terrain]\nhigh_pass = [1.0]\n')
    settings = join_settings(None, config, ["terrain.high_pass=[3, 4]"], {"seed": 5})
    paper = Settings.from_preset("paper")
    assert settings.sift == paper.sift
    assert settings.terrain.high_pass == (3.0, 4.0)
    assert settings.seed == 5
    assert join_settings("paper", None, None, {}) == paper
    assert join_settings("paper", config, None, {}).preset == "paper"
    with pytest.raises(UsageError, match="robust"):
        join_settings("robust", config, None, {})


def test_values_for_one_or_both() -> None:
    assert for_both("--scale", None) == (None, None)
    assert for_both("--scale", [2.0]) == (2.0, 2.0)
    assert for_both("--scale", [2.0, 3.0]) == (2.0, 3.0)
    assert read_options(None, "--shift").shift is None
    assert read_options("-1.5,2e3, 0", "--shift").shift == (-1.5, 2000.0, 0.0)
    assert type(read_options(None, "--shift", axes=Axes.ned).axes) is str


def test_bars_on_a_terminal() -> None:
    voice = console.Terminal()
    voice.err = Console(force_terminal=True, width=100, record=True, file=io.StringIO())
    with console.Progress(voice) as progress:
        progress("sift", 0.0)
        progress("sift", 0.5)
        progress("terrain", 1.0)
    said = voice.err.export_text()
    assert "matching image features" in said
    assert "100%" in said


# ---- the real thing, on the pair that the package carries (the made one: test_demo.py) ----------

TRUTH = np.array([13.4, -8.7, 1.25])
DEMO = Path(meshreg.__file__).parent / "demo_data"


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The demonstration on real beaches as a user runs it, in a process of its own."""
    out = tmp_path_factory.mktemp("demo") / "out"
    command = [sys.executable, "-m", "meshreg", "demo", "--real", "-o", str(out), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    assert done.stderr == ""
    return out, json.loads(done.stdout)


def test_demo_finds_the_known_offset(demo: tuple[Path, dict[str, Any]]) -> None:
    out, document = demo
    jsonschema.validate(document, SCHEMA)
    assert document["verdict"] == "accepted"
    found = np.array([document["offset"][key] for key in ("east", "north", "up")])
    assert np.abs(found[:2] - TRUTH[:2]).max() < 2.0
    assert abs(found[2] - TRUTH[2]) < 0.5  # the sand moved too
    assert document["after"]["height_nmad"] < 0.3 * document["before"]["height_nmad"]
    names = {path.name for path in out.iterdir()}
    assert names >= {
        "registration.json", "beach_2019_registered.obj", "transform.txt", "transform_inverse.txt",
        "transform_global.txt", "reference_dem.tif", "moving_dem.tif", "reference_ortho.tif",
        "moving_ortho.tif", "figures", "settings.toml", "log.txt",
    }  # fmt: skip
    figures = {path.stem for path in (out / "figures").iterdir()}
    assert figures >= {"extents", "orthos", "relief", "section", "offsets", "height_difference"}


def test_demo_moves_every_vertex_and_keeps_the_texture(demo: tuple[Path, dict[str, Any]]) -> None:
    out, document = demo
    matrix = np.array(document["transform"]["reference_from_moving"])

    def vertices(path: Path) -> np.ndarray:
        lines = path.read_text().splitlines()
        return np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)

    before, after = vertices(DEMO / "beach_2019.obj"), vertices(out / "beach_2019_registered.obj")
    expected = before @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(after, expected, atol=1e-5)
    rows = [
        [line for line in path.read_text().splitlines() if not line.startswith("v ")]
        for path in (DEMO / "beach_2019.obj", out / "beach_2019_registered.obj")
    ]
    assert rows[0] == rows[1]
    survey = meshreg.read_survey(out / "beach_2019_registered.obj")
    assert isinstance(survey.geometry, Mesh)
    with Image.open(DEMO / "beach_2019.jpg") as page:
        assert survey.geometry.textures[0].size == page.size
        np.testing.assert_array_equal(survey.geometry.textures[0].load(), np.asarray(page))


def test_demo_record_applies_to_its_own_survey(
    demo: tuple[Path, dict[str, Any]], tmp_path: Path, run: Run
) -> None:
    out, _ = demo
    code, _, error = run("apply", out, DEMO / "beach_2019.obj", "-o", tmp_path / "again")
    assert code == 0, error
    again = (tmp_path / "again" / "beach_2019_registered.obj").read_bytes()
    assert again == (out / "beach_2019_registered.obj").read_bytes()


def test_same_seed_gives_the_same_answer(
    demo: tuple[Path, dict[str, Any]], tmp_path: Path, run: Run
) -> None:
    _, first = demo
    code, said, _ = run("demo", "--real", "-o", tmp_path / "out", "--json")
    second = json.loads(said)
    assert code == 0
    assert second["offset"] == first["offset"]
    assert second["covariance"] == first["covariance"]
    assert [m["offset"] for m in second["methods"].values()] == [
        m["offset"] for m in first["methods"].values()
    ]


def test_surveys_of_different_places_are_rejected(tmp_path: Path, run: Run) -> None:
    pair = DEMO / "beach_2018.obj", DEMO / "beach_2019.obj"
    code, said, _ = run("register", *pair, "-o", tmp_path / "o", "--moving-shift", "900,0,0")
    assert code == 4
    assert "REJECTED" in said
    assert "--moving-shift" in said
    names = {path.name for path in (tmp_path / "o").iterdir()}
    assert names == {
        "registration.json",
        "settings.toml",
        "log.txt",
        "figures",
        "manifest.json",
        "report.html",
    }
    assert {path.stem for path in (tmp_path / "o" / "figures").iterdir()} == {"extents"}


def test_colmap_models_made_and_registered(tmp_path: Path, run: Run) -> None:
    """As the README says: the models' own frames are arbitrary, their camera positions place them.

    The truth is that of `synth`, as far as the positions place the models: they err little here.
    """
    pair = tmp_path / "pair"
    code, said, error = run(
        "synth", "abrolhos_12mo", "--format", "colmap", "--size", 6, "-o", pair, "--json",
        "--set", "sfm.nav_noise=0.001",
    )  # fmt: skip
    assert code == 0, error
    truth = json.loads((pair / "truth.json").read_text())
    models = [pair / name for name in ("reference", "moving")]
    code, said, error = run("register", *models, "-o", tmp_path / "none")
    assert code == 2
    assert "--positions" in error
    for model in models:
        code, said, _ = run("info", model, "--positions", model / "positions.csv", "--json")
        document = json.loads(said)
        assert code == 0
        assert document["scale_known"]
        assert document["size"][:2] == pytest.approx([6.0, 6.0], abs=0.4)
        assert document["bounds"]["low"][1] > 6.8e6
    places = [word for model in models for word in ("--positions", model / "positions.csv")]
    out = tmp_path / "out"
    code, said, error = run("register", *models, *places, "-o", out, "--json")
    assert code == 0, said + error
    found = read_registration(out)
    centroid = np.array(truth["centroid"])
    miss = found.transform.apply(centroid) - centroid - truth["offset"]
    sigma = np.array([found.registration_error[axis] for axis in "xyz"])
    assert (np.abs(miss) < np.minimum(4 * sigma, 0.015)).all()
    assert sigma.max() < 0.06  # 30 DEM cells have no tiles: the image tells, and light may bias it
    # the registered model is in the reference model's own frame: the same positions place it
    positions = models[0] / "positions.csv"
    reference = meshreg.read_survey(models[0], positions=positions)
    moving = meshreg.read_survey(models[1], positions=models[1] / "positions.csv")
    again = meshreg.read_survey(out / "moving_registered")
    want = found.transform.apply(moving.geometry.points + moving.origin)
    np.testing.assert_allclose(again.geometry.points + again.origin, want, atol=1e-3)
    assert np.abs(again.centre - reference.centre).max() < 1.0


def test_missing_texture_is_said_loudly(tmp_path: Path, run: Run) -> None:
    for name in ("beach_2019.obj", "beach_2019.mtl"):
        (tmp_path / name).write_bytes((DEMO / name).read_bytes())
    code, _, error = run(
        "register", DEMO / "beach_2018.obj", tmp_path / "beach_2019.obj", "-o", tmp_path / "o",
        "--search-radius", 20,
    )  # fmt: skip
    assert code in (0, 4)
    assert "beach_2019.jpg" in error
    document = json.loads((tmp_path / "o" / "registration.json").read_text())
    assert document["methods"]["sift"]["status"] == "failed"
    assert "beach_2019.jpg" in " ".join(document["moving"]["notes"])


def test_truncated_ply_names_the_place(tmp_path: Path, run: Run) -> None:
    whole = tmp_path / "whole.ply"
    meshreg.write_survey(meshreg.read_survey(DEMO / "beach_2018.obj"), whole)
    content = whole.read_bytes()
    (tmp_path / "cut.ply").write_bytes(content[: len(content) // 2])
    code, _, error = run("register", tmp_path / "cut.ply", whole, "-o", tmp_path / "o")
    assert code == 3
    assert "cut.ply" in error
    assert "byte" in error
    assert not (tmp_path / "o").exists()


# ---- where nobody listens -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shell", "code"),
    [
        ("info DATA > /dev/full", 6),
        ("info DATA --json > /dev/full", 6),
        ("--help > /dev/full", 6),
        ("info DATA >&-", 0),
        ("info DATA --json >&-", 0),
        ("info DATA 2>&- > /dev/null", 0),
        ("info DATA >&- 2>&- <&-", 0),
        ("info nothing.obj 2> /dev/full", 3),
        ("info DATA | true; exit ${PIPESTATUS[0]}", 0),
        ("--help | true; exit ${PIPESTATUS[0]}", 0),
    ],
)
def test_streams_that_take_nothing_end_quietly(shell: str, code: int) -> None:
    command = shell.replace("DATA", str(DEMO / "beach_2018.obj"))
    done = subprocess.run(
        ["bash", "-c", f'"{sys.executable}" -m meshreg {command}'],
        capture_output=True, text=True, check=False, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert "internal error" not in done.stderr


def test_letters_that_the_terminal_lacks_are_escaped(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "gr\u00fcn \U0001f41f.obj", 1)
    for end in ((), ("--json",)):
        done = subprocess.run(
            [sys.executable, "-m", "meshreg", "info", str(path), *end],
            capture_output=True, check=False, cwd=ROOT,
            env={"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PATH": "/bin"},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stdout.isascii()
        assert b"Traceback" not in done.stderr
    assert json.loads(done.stdout)["name"] == path.stem
