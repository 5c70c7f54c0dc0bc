"""The page of a result: whole, self-contained, escaped, made from the finished record alone."""

from __future__ import annotations

import base64
import dataclasses
import functools
import hashlib
import io
import json
import math
import re
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_registration import EAST, NORTH, OFFSET, ground, made_registration, relief
from PIL import Image
from rich.console import Console

from meshreg.cli import app as cli
from meshreg.cli import console, result
from meshreg.cli.reporting import add_report, keep_evidence, write_report
from meshreg.errors import InputError, ResourceLimitError, UsageError
from meshreg.io.result.evidence import NAME, read_evidence, write_evidence
from meshreg.io.result.record import read_registration, write_registration
from meshreg.records import Finding, Grid, Registration, SurveyRaster, Transform, Warp
from meshreg.report import (
    Result,
    answer,
    charts,
    findings,
    frame,
    keep,
    keeping,
    pictures,
    stated,
    view,
    words,
)
from meshreg.report.markup import json_block, number

VERDICTS = ("accepted", "review", "rejected")
HOSTILE = "</script><img src=x onerror=alert(1)>\"'&[red]"


def made(folder: Path, registration: Registration) -> Path:
    """Write a result's folder as `meshreg register` does, without figures."""
    write_registration(registration, folder)
    keep_evidence(registration, folder)
    return write_report(folder)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A result's folder of each verdict."""
    root = tmp_path_factory.mktemp("results")
    for verdict in VERDICTS:
        made(root / verdict, made_registration(verdict))
    return {verdict: root / verdict for verdict in VERDICTS}


class Page(HTMLParser):
    """Elements with their attributes, and the text outside of scripts and styles."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.blocks: dict[str, list[str]] = {"script": [], "style": []}
        self.text = ""
        self._inside = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attributes: Any) -> None:
        self.elements.append((tag, dict(attributes)))
        self._inside = tag
        if tag in self.blocks and dict(attributes).get("type") != "application/json":
            self.blocks[tag].append("")

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside in self.blocks:
            if self.elements[-1][1].get("type") != "application/json":
                self.blocks[self._inside][-1] += data
        else:
            self.text += data


def page_of(folder: Path) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


# ---- self-contained ---------------------------------------------------------------------------


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_allows_its_own_hashes_and_nothing_else(
    results: dict[str, Path], verdict: str
) -> None:
    page = page_of(results[verdict])
    policy = next(
        a["content"] for t, a in page.elements if a.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy is not None
    rules = {name: set(values) for name, *values in (part.split() for part in policy.split(";"))}
    assert rules["default-src"] == {"'none'"}
    assert rules["img-src"] == {"data:"}
    for tag, rule in (("script", "script-src"), ("style", "style-src")):
        digests = {
            f"'sha256-{base64.b64encode(hashlib.sha256(b.encode()).digest()).decode()}'"
            for b in page.blocks[tag]
        }
        assert len(page.blocks[tag]) >= 1
        assert rules[rule] == digests
    allowed = {"default-src", "img-src", "script-src", "style-src", "base-uri", "form-action"}
    assert set(rules) == allowed | {"require-trusted-types-for", "trusted-types"}


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_points_at_itself_and_at_files_beside_it(
    results: dict[str, Path], verdict: str
) -> None:
    page = page_of(results[verdict])
    names = {a["id"] for _, a in page.elements if "id" in a}
    for tag, attributes in page.elements:
        assert not any(key.startswith("on") for key in attributes), attributes
        assert "style" not in attributes, "the policy would drop it"
        assert tag not in ("link", "iframe", "object", "embed", "base", "form")
        for key in ("src", "href"):
            value = attributes.get(key)
            if value is None or value.startswith("data:image/webp;base64,"):
                continue
            assert tag == "a"
            if value.startswith("#"):
                assert value[1:] in names
            else:
                assert (results[verdict] / value).is_file(), value


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_picture_decodes_and_is_small_enough(results: dict[str, Path], verdict: str) -> None:
    page = page_of(results[verdict])
    shown = [a["src"] or "" for t, a in page.elements if t == "img"]
    shown += [a["href"] or "" for t, a in page.elements if t == "image"]
    # mosaics and reliefs of each stage, overlays, differences, thumbnails, the stable ground,
    # score surfaces and their peaks
    assert len(shown) == {"accepted": 18, "review": 18, "rejected": 11}[verdict]
    for uri in shown:
        data = base64.b64decode(uri.removeprefix("data:image/webp;base64,"), validate=True)
        with Image.open(io.BytesIO(data)) as image:
            assert max(image.size) <= pictures.SIDE
            assert np.asarray(image.convert("RGBA")).std() > 3  # not blank
    assert (results[verdict] / "report.html").stat().st_size < 8e6


def test_the_budget_of_a_page_holds_at_its_worst() -> None:
    small = 5  # two mosaics, the relief (drawn three times), the ground
    surfaces = 3 * 1.5  # each whole, and half as much around its peak
    raw = (
        3 * keeping.ORTHO + 3 * keeping.RELIEF + 2 * keeping.TONE + keeping.DIFFERENCE
        + (small + 2 + surfaces) * keeping.SMALL + 160_000 + 3 * 2 * keeping.HEIGHT_SIDE**2
    )  # fmt: skip
    assert raw * 4 / 3 + 250_000 < 8e6


# ---- what it says -----------------------------------------------------------------------------


def test_what_the_bending_leaves_is_said_beside_the_sigmas() -> None:
    parts = {
        "horizontal": {"held_out_rigid": 0.0766, "held_out": 0.0123},
        "vertical": {"held_out_rigid": 0.0296, "held_out": 0.0045},
    }
    for applied, numbers, words_said in (
        (False, ("0.077 m", "0.030 m up"), "not in ±"),
        (True, ("0.012 m", "0.004 m up"), "after the warp"),
    ):
        internal = {"said": "x", "applied": applied, **parts}
        registration = dataclasses.replace(made_registration("accepted"), internal=internal)
        top = Page(answer.verdict(Result(registration, {}))).text
        assert all(number in top for number in (*numbers, words_said))
        kept = {name: value for name, value in keep(registration).items() if name != "meta"}
        meta = json.loads(bytes(keep(registration)["meta"]))
        left = Page(findings.left_over(Result(registration, {**kept, "meta": meta}))).text
        assert ("before the warp" in left) == applied
        assert ("The registered survey is warped" in left) == applied
    assert (
        "Left in the tiles"
        not in Page(answer.verdict(Result(made_registration("accepted"), {}))).text
    )


def test_accepted_page_says_the_answer(results: dict[str, Path]) -> None:
    text = page_of(results["accepted"]).text
    for said in ("Accepted", "+1.300 m", "−0.700 m", "+0.250 m", "+0.200°", "± 0.020 m", "88%"):
        assert said in text
    assert "What to do next" not in text


def test_what_is_not_accepted_comes_with_advice(results: dict[str, Path]) -> None:
    for verdict in ("review", "rejected"):
        text = page_of(results[verdict]).text
        assert verdict.capitalize() in text
        assert "What to do next" in text
    assert "+1.300" not in page_of(results["rejected"]).text.split("How it was found")[1][:200]
    assert "best hypothesis" in page_of(results["review"]).text.lower()


@pytest.mark.parametrize(
    ("code", "helps"),
    [
        ("apart", "report.html shows where"),
        ("degrees", "projected CRS"),
        ("turned", "to north"),
        ("resized", "scale bars"),
        ("axes", "NAME.survey.toml"),
        ("mirrored", "--axes"),
        ("upside_down", "depths"),
        ("contradiction", "--mask"),
        ("chance", "--search-radius 20"),
        ("overlap", "narrow"),
        ("border", "--search-radius 20"),
        ("weak", "common ground"),
        ("alone", "common ground"),
        ("heading", "to north"),
        ("pieces", "residual field"),
        ("tilt", "--up"),
        ("scale", "scale bars"),
        ("nothing", "too little in common"),
        ("never_seen_before", "swipe"),
    ],
)
def test_advice_follows_the_codes_of_the_findings(code: str, helps: str) -> None:
    registration = made_registration("review")
    settings = {**registration.settings, "search": {"radius": 10.0}}
    found = dataclasses.replace(
        registration, findings=(Finding(code, "x"), Finding(code, "y")), settings=settings
    )
    steps = words.next_steps(found)
    assert any(helps in step for step in steps)
    assert len(steps) == len(set(steps))
    assert words.next_steps(dataclasses.replace(found, verdict="accepted")) == ()


def test_page_and_terminal_name_the_same_findings(tmp_path: Path) -> None:
    findings = Finding("heights", "twice as high", values={"gain": 2.0}), Finding("border", "y")
    registration = dataclasses.replace(made_registration("review"), findings=findings)
    page = answer.verdict(Result(registration, {}))
    assert "Findings: <code>heights</code>, <code>border</code>" in page
    none = answer.verdict(Result(made_registration("accepted"), {}))
    assert "Findings" not in none
    terminal = console.Terminal(as_json=False)
    terminal.out = Console(record=True, width=200, file=io.StringIO())
    terminal.err = terminal.out
    result.show(registration, tmp_path, terminal)
    assert "findings: heights, border" in terminal.out.export_text()


def test_advice_does_not_speak_of_a_distance_that_other_axes_explain() -> None:
    registration = made_registration("rejected")
    apart, axes = Finding("apart", "x", "rejected"), Finding("axes", "y", "rejected")
    plain, other = (
        " ".join(words.next_steps(dataclasses.replace(registration, findings=findings)))
        for findings in ((apart,), (apart, axes))
    )
    assert "coordinate system" in plain
    assert "coordinate system" not in other
    for text in (plain, other):
        assert "search" not in text.lower()  # how far, the reason itself has said


def test_every_code_has_advice_and_the_judge_says_no_other() -> None:
    from meshreg.judge import CODES, judging

    assert set(words.ADVICE) == set(CODES)
    source = Path(judging.__file__).read_text(encoding="utf-8")
    said = re.findall(r'(?:say\(|Finding\()\s*(?:"(?:review|rejected)",\s*)?"(\w+)",', source)
    assert len(said) >= 10
    assert set(said) <= set(CODES)


def test_methods_paragraph_can_stand_in_a_paper(results: dict[str, Path]) -> None:
    registration = read_registration(results["accepted"])
    settings = {**registration.settings, "search": {"radius": 12.5}}
    settings["raster"] = {"dem_cell": 0.1, "ortho_cell": 0.05}
    text = words.methods_paragraph(dataclasses.replace(registration, settings=settings))
    for said in (
        "meshreg 0.1.0", f"numpy {np.__version__}", "ab" * 32, "2019.obj", "±12.5 m", "0.05 m",
        "EPSG:32754", "SIFT, terrain scan and mutual information", "Bryson", "seed 0",
        "+1.3000 ± 0.0200 m east", "−0.7000 ± 0.0300 m north", "0.011 m (0.310 m before)",
    ):  # fmt: skip
        assert said in text
    assert "  " not in text
    rejected = words.methods_paragraph(made_registration("rejected"))
    assert "No registration was accepted: No offset stands out" in rejected
    assert "could not be registered to" in rejected
    for claim in ("+1.3", "was registered", "refined", "NMAD", "It moves", "sigma"):
        assert claim not in rejected


def test_methods_paragraph_names_the_warp_with_the_nmad_that_belongs_to_it() -> None:
    rigid = made_registration("accepted")
    table = np.zeros((4, 4, 3))
    bent = Warp("quadratic", "dome", np.zeros(2), np.ones(2), table)
    nmad = f"{rigid.after['height_nmad']:.3f} m"
    text = words.methods_paragraph(dataclasses.replace(rigid, warp=bent))
    assert "bent by a smooth warp (quadratic horizontally and dome in height)" in text
    assert "After registration and warp" in text
    assert f"NMAD of the height differences there is {nmad}" in text
    plain = words.methods_paragraph(rigid)
    assert "warp" not in plain.lower()
    assert f"After registration {rigid.after['overlap']:.0%}" in plain


def test_methods_paragraph_says_what_was_not_determined() -> None:
    known = made_registration("accepted")
    assert "not determined" not in words.methods_paragraph(known)
    covariance = np.array(known.covariance)
    covariance[2, 2] = 0.94**2
    worse = {**known.after, "height_nmad": 1.2 * known.before["height_nmad"]}
    unsure = dataclasses.replace(known, covariance=covariance, after=worse)
    text = words.methods_paragraph(unsure)
    assert "The height was not determined: up is known to ± 0.94 m and the heights agree" in text
    assert "no better than before" in text
    still = dataclasses.replace(known.transform, rotation=np.eye(3))
    text = words.methods_paragraph(dataclasses.replace(known, transform=still))
    sigma = np.rad2deg(np.sqrt(known.covariance[5, 5]))
    assert f"The yaw was not determined: no turn stood out of its error of {sigma:.4f}°" in text


def test_names_are_text_and_nothing_else(tmp_path: Path) -> None:
    registration = made_registration("review")
    entry = {**registration.moving, "name": HOSTILE, "path": [HOSTILE], "notes": [HOSTILE]}
    hostile = dataclasses.replace(
        registration,
        reason=HOSTILE,
        moving=entry,
        notes=(HOSTILE,),
        estimates=tuple(dataclasses.replace(e, reason=HOSTILE) for e in registration.estimates),
        versions={**registration.versions, HOSTILE: HOSTILE},
    )
    page = Page(made(tmp_path / "r", hostile).read_text(encoding="utf-8"))
    plain = Page(made(tmp_path / "plain", registration).read_text(encoding="utf-8"))
    count = [tag for tag, _ in page.elements if tag in ("script", "img")]
    assert count == [tag for tag, _ in plain.elements if tag in ("script", "img")]
    assert all((a.get("src") or "data:").startswith("data:") for _, a in page.elements)
    assert page.text.count(HOSTILE) >= 8
    # a key among the settings reaches no page: such a record is refused when it is read
    foreign = dataclasses.replace(registration, settings={**registration.settings, HOSTILE: 1})
    with pytest.raises(InputError, match="settings"):
        made(tmp_path / "foreign", foreign)


@given(st.text(), st.text())
def test_no_text_ends_a_data_block(key: str, value: str) -> None:
    html = json_block("x", {key: value})
    inside = html.removeprefix('<script type="application/json" id="x">').removesuffix("</script>")
    assert "<" not in inside
    assert json.loads(inside) == {key: value}


def test_log_and_files_are_shown(tmp_path: Path) -> None:
    registration = made_registration("accepted")
    write_registration(registration, tmp_path / "r")
    (tmp_path / "r" / "log.txt").write_text("first <b> line\n" + 30_000 * "x y " + "\nlast line\n")
    (tmp_path / "r" / "a b#?.txt").write_text("")
    write_report(tmp_path / "r")
    page = page_of(tmp_path / "r")
    assert "last line" in page.text
    assert "first <b> line" not in page.text  # the start of a long log falls away
    links = [a["href"] for tag, a in page.elements if tag == "a"]
    assert "a%20b%23%3F.txt" in links
    assert "registration.json" in links


def test_a_validation_beside_the_page_is_named(results: dict[str, Path], tmp_path: Path) -> None:
    folder = shutil.copytree(results["review"], tmp_path / "r")
    (folder / "validation.html").write_text("made by `meshreg validate`")
    write_report(folder)
    assert "tie points" not in page_of(results["review"]).text
    assert "Compared with tie points picked by hand" in page_of(folder).text


# ---- from the saved record --------------------------------------------------------------------


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_is_remade_from_the_folder_alone(
    results: dict[str, Path], verdict: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = results[verdict] / "report.html"
    first = path.read_bytes()
    path.unlink()
    assert cli.run(["report", str(results[verdict]), "--json"]) == 0
    assert path.read_bytes() == first
    said = json.loads(capsys.readouterr().out)
    assert said == {"schema": "meshreg.report/1", "report": str(path), "bytes": len(first)}


def test_without_evidence_the_page_is_whole(tmp_path: Path) -> None:
    registration = made_registration("accepted")
    write_registration(registration, tmp_path / "r")
    page = Page(write_report(tmp_path / "r").read_text(encoding="utf-8"))
    assert not [tag for tag, _ in page.elements if tag in ("img", "image")]
    ids = {a.get("id") for tag, a in page.elements if tag == "section"}
    assert ids == {"verdict", "left", "found", "methods", "surveys", "record"}


def test_a_pair_too_far_apart_gets_its_page(tmp_path: Path) -> None:
    registration = dataclasses.replace(
        made_registration("rejected"), evidence={}, before={}, hypotheses=(),
        reason="the surveys lie 400 m apart, beyond the search radius of 10 m",
        estimates=tuple(
            dataclasses.replace(e, status="failed", east=math.nan, north=math.nan, evidence={})
            for e in made_registration("rejected").estimates
        ),
    )  # fmt: skip
    assert keep(registration) == {}
    text = Page(made(tmp_path / "r", registration).read_text(encoding="utf-8")).text
    assert not (tmp_path / "r" / NAME).exists()
    assert "Where the surveys lie" in text
    assert "--reference-shift" in text


def test_a_page_that_fails_is_said_and_loses_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    registration = made_registration("accepted")
    write_registration(registration, tmp_path / "r")
    names = {path.name for path in (tmp_path / "r").iterdir()}

    def fail(*_: Any) -> None:
        raise RuntimeError("no page today")

    monkeypatch.setattr("meshreg.report.keep", fail)
    add_report(registration, tmp_path / "r")
    assert (
        "evidence.npz and report.html were not made: RuntimeError: no page today" in caplog.messages
    )
    assert {path.name for path in (tmp_path / "r").iterdir()} == names
    monkeypatch.undo()
    (tmp_path / "r" / "report.html").mkdir()  # no room for the file
    with pytest.raises(UsageError, match="is not as meshreg wrote it"):
        add_report(registration, tmp_path / "r")


def _truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-2000])


def _no_archive(path: Path) -> None:
    path.write_bytes(b"not a zip")


def _pickled(path: Path) -> None:
    np.savez(path, meta=np.array([{"a": 1}], object), allow_pickle=True)


def _newer(path: Path) -> None:
    np.savez(path, meta=np.frombuffer(b'{"schema": "meshreg.evidence/2"}', np.uint8))


def _no_meta(path: Path) -> None:
    np.savez(path, height_reference=np.zeros((2, 2)))


def _bomb(path: Path) -> None:
    np.savez_compressed(path, meta=np.zeros(140_000_000, np.uint8))


@pytest.mark.parametrize("spoil", [_truncated, _no_archive, _pickled, _newer, _no_meta, _bomb])
def test_damaged_evidence_is_refused_and_the_page_stays(
    results: dict[str, Path],
    tmp_path: Path,
    spoil: Callable[[Path], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = shutil.copytree(results["accepted"], tmp_path / "r") / "report.html"
    before = path.read_bytes()
    spoil(tmp_path / "r" / NAME)
    with pytest.raises(InputError, match="evidence"):
        read_evidence(tmp_path / "r")
    assert cli.run(["report", str(tmp_path / "r")]) == 3
    assert "evidence" in capsys.readouterr().err
    assert path.read_bytes() == before


@pytest.mark.parametrize("state", ["as written", "changed", "no manifest"])
def test_only_a_changed_result_is_blamed_for_a_page_that_fails(
    results: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: str
) -> None:
    import meshreg.report
    from meshreg.io.result.manifest import write_manifest

    folder = shutil.copytree(results["accepted"], tmp_path / "r")
    if state != "no manifest":
        write_manifest(folder, "register")
    if state == "changed":
        record = folder / "registration.json"
        record.write_text(record.read_text() + "\n")

    def broken(result: Any) -> str:
        raise KeyError("ours")

    monkeypatch.setattr(meshreg.report, "report_page", broken)
    assert cli.run(["report", str(folder)]) == (1 if state == "as written" else 3)


def test_a_folder_without_a_result_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("report", "view"):
        assert cli.run([command, str(tmp_path)]) == 3
        assert "registration.json" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_folder_s_name_is_no_markup(
    results: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(results["rejected"], tmp_path / "[red]")
    assert cli.run(["report", str(tmp_path / "[red]")]) == 0
    assert "[red]" in capsys.readouterr().out.replace("\n", "")


# ---- what is kept -----------------------------------------------------------------------------


def test_heights_are_kept_to_their_step(results: dict[str, Path]) -> None:
    kept = read_evidence(results["accepted"])
    about = kept["meta"]["height"]
    west, _, _, north = about["bounds"]
    level = kept["height_reference"]
    rows, cols = level.shape
    grid = Grid(west, north, about["cell"], (rows, cols))
    truth = relief(*grid.east_north(*np.mgrid[:rows, :cols]))
    found = np.where(level == keeping.NO_HEIGHT, np.nan, about["middle"] + about["step"] * level)
    seen = np.isfinite(found)
    assert 0.8 < seen.mean() < 0.99  # the made survey has an empty rim
    assert about["step"] < 1e-3
    assert np.abs(found - truth)[seen].max() < 1.1 * about["step"] + 1e-5


def test_difference_is_registered_less_reference(results: dict[str, Path]) -> None:
    kept = read_evidence(results["accepted"])
    counts, edges = kept["difference_counts"], kept["difference_edges"]
    middles = 0.5 * (edges[1:] + edges[:-1])
    evidence = made_registration("accepted").evidence
    reference, after = evidence["reference_dem"], evidence["moving_dem"]
    truth = (after.height.astype(float) - reference.height)[reference.valid & after.valid]
    assert counts.sum() == truth.size
    assert np.average(middles, weights=counts) == pytest.approx(truth.mean(), abs=2e-3)
    assert truth.mean() == pytest.approx(0.03, abs=2e-3)  # as made_registration lays it down
    with Image.open(io.BytesIO(kept["difference"].tobytes())) as image:
        color = np.asarray(image.convert("RGBA"), float)
    red, _, blue = (color[color[..., 3] > 200][:, k].mean() for k in range(3))
    assert red > blue + 60  # higher is red


def test_a_spike_does_not_cost_the_heights_their_digits() -> None:
    registration = made_registration("accepted")
    dem: SurveyRaster = registration.evidence["reference_dem"]
    height = np.array(dem.height)
    height[40, 40] = 5000.0
    spiked = {**registration.evidence, "reference_dem": dataclasses.replace(dem, height=height)}
    kept = keep(dataclasses.replace(registration, evidence=spiked))
    assert json.loads(bytes(kept["meta"]))["height"]["step"] < 1e-3


@given(st.integers(1, 90), st.integers(1, 90), st.integers(3, 40), st.integers(0, 2**32 - 1))
def test_blocks_keep_the_peak(rows: int, cols: int, side: int, seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=(rows, cols))
    values[0, 0] = np.nan
    for lowest, best in ((True, np.nanmin), (False, np.nanmax)):
        if not np.isfinite(values).any():
            continue
        small = pictures.block_peak(values, side, lowest=lowest)
        assert max(small.shape) <= side
        assert best(small) == best(values)


def test_shrinking_is_the_mean_of_what_was_seen() -> None:
    rng = np.random.default_rng(1)
    shape = (60, 40)
    color = rng.integers(0, 255, (*shape, 3), np.uint8)
    seen = rng.uniform(size=shape) > 0.3
    color[~seen] = 0
    empty = np.full(shape, np.nan, np.float32)
    raster = SurveyRaster(
        Grid(0, 60, 1.0, shape), empty, color, np.zeros(shape, bool), seen, np.zeros(shape)
    )
    small = pictures.shrunk(raster, 12)
    assert small.shape == (12, 8, 4)
    blocks = color.astype(float).reshape(12, 5, 8, 5, 3).sum(axis=(1, 3))
    counts = seen.reshape(12, 5, 8, 5).sum(axis=(1, 3))
    assert np.abs(small[..., :3] - blocks / counts[..., None]).max() < 2.0
    assert np.abs(small[..., 3] - 255 * counts / 25).max() <= 1.0
    np.testing.assert_array_equal(pictures.shrunk(raster)[..., :3], color)


@pytest.mark.parametrize("limit", [3_000, 20_000, 60_000])
def test_noise_is_made_to_fit(limit: int) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (300, 500, 4), np.uint8)
    data = pictures.encoded(noise, limit)
    assert data.size <= limit
    with Image.open(io.BytesIO(data.tobytes())) as image:
        assert image.size[0] / image.size[1] == pytest.approx(5 / 3, rel=0.1)


def test_written_evidence_reads_back(tmp_path: Path) -> None:
    kept = keep(made_registration("accepted"))
    write_evidence(kept, tmp_path)
    read = read_evidence(tmp_path)
    assert read.pop("meta") == json.loads(bytes(kept.pop("meta")))
    assert set(read) == set(kept)
    for name, array in kept.items():
        np.testing.assert_array_equal(read[name], array)
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


def _colors(picture: Any) -> np.ndarray:
    with Image.open(io.BytesIO(bytes(picture))) as image:
        return np.asarray(image.convert("RGBA"), int)


def test_stable_ground_is_kept_cell_by_cell(results: dict[str, Path]) -> None:
    kept = read_evidence(results["accepted"])
    state, about = ground(), kept["meta"]["ground"]
    for name, value in (("changed", 1), ("set_aside", 2), ("stable", 3)):
        assert about[name] == pytest.approx((state == value).sum() / (state > 0).sum())
    assert about["bounds"] == kept["meta"]["dem"]["bounds"]
    color = _colors(kept["ground"])
    assert color.shape[:2] == state.shape
    assert ((color[..., 3] > 128) == (state > 0)).all()
    seen = {tuple(color[state == value][0, :3]) for value in (1, 2, 3)}
    assert len(seen) == 3
    for value in (1, 2, 3):
        assert (color[state == value] == color[state == value][0]).all()
    assert "ground" not in read_evidence(results["rejected"])
    text = page_of(results["accepted"]).text
    for share in (about["stable"], about["changed"], about["set_aside"]):
        assert f": {share:.0%}" in text


def test_the_picture_around_a_peak_has_it_where_its_bounds_say(results: dict[str, Path]) -> None:
    kept = read_evidence(results["accepted"])
    west, south, east, north = kept["meta"]["surfaces"]["terrain"]["near"]
    color = _colors(kept["near_terrain"])
    rows, cols = color.shape[:2]
    assert (east - west) / cols == pytest.approx(0.1)
    assert (north - south) / rows == pytest.approx(0.1)
    row, col = np.unravel_index(np.argmax(color[..., 0]), (rows, cols))  # the brightest is yellow
    found = west + (col + 0.5) * (east - west) / cols, north - (row + 0.5) * (north - south) / rows
    assert found == pytest.approx(tuple(OFFSET[:2]), abs=0.16)


def turned(degrees: float) -> Transform:
    """Turn the made moving survey about its centre, as the search does before it looks."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return Transform(rotation, 1.0, np.zeros(3), np.array([EAST + 12, NORTH + 13, -12.5]))


def test_matches_of_a_turned_survey_end_in_the_delivered_one() -> None:
    registration = made_registration("accepted")
    sift = registration.estimates[0]
    truth = np.array(sift.evidence["moving_points"])
    level = np.full((len(truth), 1), -3.0)  # a turn about the vertical asks for no height
    motion = turned(7.0)
    seen = {**sift.evidence, "moving_points": motion.apply(np.hstack([truth, level]))[:, :2]}
    moved = dataclasses.replace(sift, evidence=seen)
    kept = keep(
        dataclasses.replace(
            registration,
            estimates=(moved,),
            evidence={**registration.evidence, "motion": motion},
        )
    )
    assert json.loads(bytes(kept["meta"]))["turned"]["yaw_degrees"] == pytest.approx(7.0)
    order = np.r_[70:180, 0:70]  # outliers first, so that inliers are drawn over them
    assert np.abs(kept["matches"][:, 2:4] - truth[order]).max() < 1e-8
    unturned = keep(dataclasses.replace(registration, estimates=(moved,)))
    assert np.abs(unturned["matches"][:, 2:4] - truth[order]).max() > 0.5


@functools.cache
def bare() -> Registration:
    return dataclasses.replace(made_registration("accepted"), evidence={})


@settings(deadline=None)  # the first example makes the registration
@given(st.floats(-9, 9), st.floats(-30, 30), st.floats(-30, 30))
def test_the_result_is_stated_as_a_method_would(degrees: float, east: float, north: float) -> None:
    registration, motion = bare(), turned(degrees)
    place = np.array([EAST + 12 + east, NORTH + 13 + north, -12.5])
    error = {"x": 0.1, "y": 0.1, "z": 0.1, "isotropic": 0.1, "at": place.tolist()}
    stated_there = dataclasses.replace(
        registration, registration_error=error, evidence={"motion": motion}
    )
    answer = stated.among_methods(stated_there)
    assert answer is not None
    assert registration.transform is not None
    back = np.linalg.inv(registration.transform.matrix) @ np.append(place, 1.0)
    start = motion.matrix @ back
    assert answer[0] == pytest.approx((place - start[:3])[:2], abs=1e-6)
    # the variance of the place under draws of the record's covariance, to first order
    assert registration.covariance is not None
    root = np.linalg.cholesky(registration.covariance[np.ix_([0, 1, 5], [0, 1, 5])])
    home = registration.transform.pivot + registration.transform.offset
    arm = (place - home)[:2]
    steps = [column[:2] + column[2] * np.array([-arm[1], arm[0]]) for column in root.T]
    expected = sum(np.outer(step, step) for step in steps)
    np.testing.assert_allclose(answer[1], expected, rtol=1e-9, atol=1e-15)


# ---- charts -----------------------------------------------------------------------------------


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(2, 12))
def test_ticks_are_even_and_inside(low: float, span: float, count: int) -> None:
    span = max(span, 1e-9 * abs(low))
    found = [value for value, _ in frame.ticks(low, low + span, count)]
    assert len(found) <= count + 1
    slack = 1e-6 * span
    assert all(low - slack <= value <= low + span + slack for value in found)
    steps = np.diff(found)
    assert steps.size == 0 or np.ptp(steps) <= 1e-6 * steps.max() + 1e-9 * abs(low)


def _places(svg: str) -> dict[str, tuple[float, float]]:
    """Where the marks of an offsets chart lie, by method."""
    found = re.findall(
        r'<g class="(sift|terrain|mutual_information|result)" '
        r'transform="translate\(([-\d.]+) ([-\d.]+)\)',
        svg.split("<ul", maxsplit=1)[0],
    )
    return {name: (float(x), float(y)) for name, x, y in found}


def test_offsets_chart_is_true_to_scale() -> None:
    registration = made_registration("accepted")
    svg = charts.offsets(registration)
    places = _places(svg)
    assert set(places) == {"sift", "terrain", "result"}  # the third method failed
    (x1, y1), (x2, y2) = places["sift"], places["terrain"]
    scale = (x1 - x2) / (1.31 - 1.27)
    assert scale > 0  # east is to the right
    assert (y2 - y1) / scale == pytest.approx(-0.69 + 0.72, abs=0.01 / scale * 2)  # north is up
    (x3, _) = places["result"]
    assert (x3 - x2) / scale == pytest.approx(OFFSET[0] - 1.27, abs=1e-4)
    half = re.search(r'<ellipse class="ellipse terrain"[^>]*rx="([\d.]+)" ry="([\d.]+)"', svg)
    assert half is not None
    axes = sorted(float(value) / scale for value in half.groups())
    # 95 % of a 2-D normal distribution lie within sqrt(-2 ln 0.05) sigmas
    expected = [math.sqrt(-2 * math.log(0.05)) * s for s in (0.04, 0.05)]
    assert axes == pytest.approx(expected, rel=2e-3)


def test_match_lines_end_where_the_features_lie() -> None:
    ends = np.array([[100.0, 50.0, 110.0, 40.0, 1.0], [120.0, 60.0, 100.0, 50.0, 0.0]])
    empty = np.zeros(4, np.uint8)
    svg = charts.matches(ends, (empty, empty), ((100.0, 30.0, 145.0, 60.0),) * 2)
    paths = dict(re.findall(r'<path class="(inlier|outlier)" d="([^"]*)"', svg))
    # 10 units a metre, the second picture 470 units to the right
    assert paths == {"inlier": "M0.0 100.0L570.0 200.0", "outlier": "M200.0 0.0L470.0 100.0"}


def test_match_lines_of_a_survey_delivered_elsewhere_end_on_its_own_map() -> None:
    ends = np.array([[100.0, 50.0, 710.0, 840.0, 1.0]])
    bounds = (100.0, 30.0, 145.0, 60.0), (700.0, 830.0, 722.5, 850.0)
    svg = charts.matches(ends, (np.zeros(4, np.uint8),) * 2, bounds)
    # the scale of the wider one, 10 units a metre, for both; each from its own northwest corner
    assert re.findall(r'd="(M[^"]*)"', svg) == ["M0.0 100.0L570.0 100.0"]
    assert re.findall(r'width="([\d.]+)" height="([\d.]+)"', svg) == [
        ("450.0", "300.00"),
        ("225.0", "200.00"),
    ]


def test_residual_arrows_point_where_the_tiles_should_go() -> None:
    # east, north, d_east, d_north, weight, model_east, model_north; the last tile is an outlier
    field = np.array(
        [
            [105.0, 205.0, 0.03, 0.00, 1.0, 0.01, 0.02],
            [110.0, 210.0, 0.00, 0.03, 1.0, 0.01, 0.02],
            [115.0, 215.0, 9.00, 9.00, 0.0, 0.01, 0.02],
        ]
    )
    svg, said = charts.residuals(field, (100.0, 200.0, 120.0, 220.0), None)
    number = r"(-?[\d.]+)"
    lines = re.findall(rf'class="(arrow[ a-z]*)" d="M{number} {number}L{number} {number}', svg)
    steps = {
        look: [
            (float(x2) - float(x1), float(y1) - float(y2))
            for n, x1, y1, x2, y2 in lines
            if n == look
        ]
        for look in ("arrow", "arrow model")
    }
    assert len(steps["arrow"]) == 2
    assert len(steps["arrow model"]) == 3
    (e1, n1), (e2, n2) = steps["arrow"]
    assert (e1, n2) == (pytest.approx(n2, abs=0.2), pytest.approx(e1, abs=0.2))
    assert (n1, e2) == (0.0, 0.0)
    assert e1 > 10
    for east, north in steps["arrow model"]:
        assert (east, north) == pytest.approx((e1 / 3, 2 * e1 / 3), abs=0.2)
    assert svg.count('class="aside"') == 1
    assert "2 of 3 tiles" in said
    assert "30.0 mm" in said


def test_discs_of_heights_left_are_true_in_area_and_sign() -> None:
    field = np.array([[105.0, 205.0, 0.04, 1.0], [110.0, 210.0, -0.01, 1.0], [1e9, 0.0, 5.0, 0.0]])
    field[2, :2] = 115.0, 215.0
    svg, said = charts.ups(field, (100.0, 200.0, 120.0, 220.0), None)
    discs = re.findall(r'<circle class="(up|down)" cx="[\d.]+" cy="[\d.]+" r="([\d.]+)"', svg)
    assert [look for look, _ in discs] == ["up", "down"]
    assert float(discs[0][1]) == pytest.approx(2 * float(discs[1][1]), rel=0.02)
    assert "40 mm" in said


def test_numbers_that_are_none_are_dashes() -> None:
    assert number(None) == number(math.nan) == number(math.inf) == "–"
    assert number(-0.5) == "−0.500"


# ---- the window -------------------------------------------------------------------------------


def test_without_a_screen_the_window_says_so(
    results: dict[str, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(view.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert cli.run(["view", str(results["accepted"])]) == 2
    said = capsys.readouterr().err
    assert "no screen" in said
    assert "report.html" in said


def test_a_window_that_dies_is_an_error(
    results: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view, "_has_display", lambda: True)
    monkeypatch.setattr(view, "_CHILD", "import os; os.abort()")
    with pytest.raises(ResourceLimitError, match="signal 6"):
        view.open_view(read_evidence(results["accepted"]), results["accepted"])
    monkeypatch.setattr(view, "_CHILD", "raise RuntimeError('bad X server')")
    with pytest.raises(ResourceLimitError, match="bad X server"):
        view.open_view(read_evidence(results["accepted"]), results["accepted"])
    with pytest.raises(UsageError, match="no surfaces"):
        view.open_view({}, results["accepted"])


@pytest.mark.needs("opengl")
def test_the_window_s_scene_can_be_drawn(results: dict[str, Path], tmp_path: Path) -> None:
    arrays = view._arrays(read_evidence(results["rejected"]))
    assert arrays is not None
    code, said = view._run(arrays, tmp_path / "p.npy")
    assert code == 0, said
    picture = np.load(tmp_path / "p.npy")
    assert picture.shape[:2] == (900, 1400)
    assert picture[300:600, 500:900].std() > 10
