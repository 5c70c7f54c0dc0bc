"""The benchmark: its statistics, its pairs, its bookkeeping; and a dozen pairs from end to end."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_registration import made_registration
from scipy.stats import binom

from data_synth.recipe import load
from data_synth.scene import make_scene
from data_synth.sfm import make_distortion
from data_synth.truth import make_truth
from meshreg.benchmark import Options, hand, maps, measure, page, plan, rasters, run, run_benchmark
from meshreg.benchmark import jobs as running
from meshreg.benchmark.summary import summarise
from meshreg.benchmark.tables import COLUMNS, bounds, rate, write_csv
from meshreg.benchmark.workers import run_all
from meshreg.cli import app as cli
from meshreg.errors import MeshregError, OutputError, UsageError
from meshreg.records import Transform

NAMES = ("reef_12mo", "low_reef_24mo", "sand_12h", "elsewhere")
SMALL = Options(scenarios=NAMES, repeats=2, elsewhere=4, size=8.0)


# --- statistics


@given(st.integers(1, 400), st.data())
def test_bounds_are_where_the_binomial_tails_hold_a_fortieth(total: int, data: Any) -> None:
    count = data.draw(st.integers(0, total))
    low, high = bounds(count, total)
    assert 0 <= low <= count / total <= high <= 1
    if count > 0:
        assert binom.sf(count - 1, total, low) == pytest.approx(0.025, rel=1e-6)
    else:
        assert low == 0
    if count < total:
        assert binom.cdf(count, total, high) == pytest.approx(0.025, rel=1e-6)
    else:
        assert high == 1


def test_none_of_a_thousand_is_bounded_by_a_little_over_three_in_a_thousand() -> None:
    found = rate([False] * 1000)
    assert (found["count"], found["low"]) == (0, 0.0)
    assert found["high"] == pytest.approx(1 - 0.025 ** (1 / 1000), rel=1e-9)
    assert rate([])["rate"] is None


def test_an_answer_is_carried_to_another_place_as_the_transform_carries_points() -> None:
    yaw, pivot, offset = 0.02, np.array([400.0, 900.0]), np.array([1.5, -0.3])
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    whole = Transform(turn, 1.0, np.append(offset, 0.0), np.append(pivot, 0.0))
    place = np.array([412.0, 893.0])
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3)) * [0.02, 0.02, 0.001]
    covariance = root.T @ root
    found, sigma = measure.Answer(pivot, offset, yaw, covariance).at(place)
    assert found == pytest.approx((whole.apply([*place, 0.0]) - [*place, 0.0])[:2], abs=1e-12)
    # draws of the answer at the pivot, each carried on its own
    draws = rng.multivariate_normal([*offset, yaw], covariance, 40_000)
    arm = place - pivot
    cosine, sine = np.cos(draws[:, 2]), np.sin(draws[:, 2])
    moved = draws[:, :2] + np.stack(
        [(cosine - 1) * arm[0] - sine * arm[1], sine * arm[0] + (cosine - 1) * arm[1]], axis=1
    )
    assert sigma == pytest.approx(np.cov(moved.T), rel=0.05, abs=2e-6)


def test_a_region_covers_as_often_as_its_level_says() -> None:
    rng = np.random.default_rng(1)
    sigma = np.array([[4e-4, 1e-4], [1e-4, 1e-4]])
    draws = rng.multivariate_normal([0.0, 0.0], sigma, 4000)
    covered = [measure._errors(draw, sigma, np.zeros(2))["covered"] for draw in draws]
    assert 0.94 < np.mean(covered) < 0.96


# --- the simulated hand


def test_the_hand_finds_the_offset_and_its_residual_is_the_warp() -> None:
    recipe = load("scott_24mo", {"sfm.offset_length": 2.4851, "sfm.warp": 0.2})
    errors, residuals, truths = [], [], []
    for seed in range(8):
        scene = make_scene(recipe, seed, 12.0)
        truth, found = make_truth(scene), hand.click(scene, seed)
        assert found is not None
        errors.append(math.hypot(found.east - truth["offset"][0], found.north - truth["offset"][1]))
        residuals.append(found.residual)
        truths.append(truth["residual_mean_horizontal"])
    assert 0.01 < np.median(errors) < 0.12  # 25 points of a ground warped by 0.2 m
    assert 0.8 < np.mean(residuals) / np.mean(truths) < 1.6
    again = hand.click(make_scene(recipe, 3, 12.0), 3)
    assert again == hand.click(make_scene(recipe, 3, 12.0), 3)


def test_the_hand_has_nothing_to_click_on_other_ground() -> None:
    assert hand.click(make_scene(load("elsewhere"), 0, 8.0), 0) is None
    assert hand.click(make_scene(load("mirrored"), 0, 8.0), 0) is None


# --- the plan


def test_the_whole_plan_has_the_numbers_that_are_asked() -> None:
    first, second = plan.jobs(Options())
    crossing = [job for job in first if job.kind == "crossing"]
    assert len(crossing) >= 300
    kinds = {plan.CROSSING[job.scenario] for job in crossing}
    assert len(kinds) == 15  # five grounds by three intervals
    for site in plan.PAPER_SITES:
        slow = [j for j in crossing if j.scenario == site and "paper" in j.presets]
        assert len(slow) == 10
    assert len(second) >= 1000
    assert sum(job.kind == "site" for job in first) >= 60
    pairs = {job.sites for job in second}
    assert len(pairs) == len(second)
    assert all(i != j for i, j in pairs)
    whole = [*first, *second]
    assert len({job.name for job in whole}) == len(whole)
    seeds = [job.seed for job in first]
    assert len(set(seeds)) == len(seeds)  # drawn anew for every pair
    assert {job.scenario for job in first if job.kind == "table"} == set(plan.PAPER_SITES)


def test_offsets_are_drawn_over_the_whole_square() -> None:
    first, _ = plan.jobs(Options(elsewhere=0))
    drawn = []
    for job in first:
        if job.kind == "crossing":
            rng = np.random.default_rng([job.seed, 3])  # as make_scene does
            d = make_distortion(plan.recipe_of(job).sfm, rng, np.zeros(3), 12.0)
            drawn.append((d.centre - d.start)[:2])
    east, north = np.array(drawn).T
    for axis in (east, north):
        assert -5 <= axis.min() < -4.5
        assert 4.5 < axis.max() <= 5
        assert abs(axis.mean()) < 0.6
    assert abs(np.corrcoef(east, north)[0, 1]) < 0.2


def test_a_key_changes_with_whatever_the_pair_depends_on() -> None:
    job = plan.jobs(Options(scenarios=("reef_12mo",), elsewhere=0))[0][0]
    others = [
        dataclasses.replace(job, seed=job.seed + 1),
        dataclasses.replace(job, size=9.0),
        dataclasses.replace(job, presets=("robust", "paper")),
        dataclasses.replace(job, scenario="reef_24mo"),
    ]
    keys = [plan.key_of(other) for other in [job, *others]]
    assert len(set(keys)) == len(keys)
    assert plan.key_of(dataclasses.replace(job)) == keys[0]


@pytest.mark.parametrize(
    "options",
    [
        Options(scenarios=("atlantis",)),
        Options(repeats=0),
        Options(elsewhere=-1),
        Options(elsewhere=4000),
        Options(size=2.0),
    ],
)
def test_options_out_of_range_are_refused(options: Options) -> None:
    with pytest.raises(UsageError):
        plan.jobs(options)


# --- rasters of places


def test_a_place_survives_its_file_and_another_place_takes_its_coordinates(tmp_path: Path) -> None:
    kept = []
    for k in (0, 13):  # two grounds, at two of the paper's sites
        job = plan.site_job(k, 0, 6.0)
        pairs, _ = rasters.make(job)
        rasters.save_place(pairs, plan.key_of(job), tmp_path / f"{k}.npz")
        assert rasters.place_key(tmp_path / f"{k}.npz") == plan.key_of(job)
        kept.append(pairs)
    for k, pairs in zip((0, 13), kept, strict=True):
        for side, which in enumerate(("reference", "moving")):
            read = rasters.load_place(tmp_path / f"{k}.npz", which)
            for name in ("dem", "ortho", "sift"):
                made = pairs[name][side]
                assert read[name].grid == made.grid
                assert (read[name].color == made.color).all()
                assert (read[name].color_valid == made.color_valid).all()
            assert np.array_equal(read["dem"].height, pairs["dem"][side].height, equal_nan=True)
    moving = {name: pair[1] for name, pair in kept[1].items()}
    pairs = rasters.rehomed({name: pair[0] for name, pair in kept[0].items()}, moving)
    for name, (reference, placed) in pairs.items():
        middles = np.array([_middle(reference.grid), _middle(placed.grid)])
        assert np.abs(middles[0] - middles[1]).max() <= 0.5 * plan.DEM_CELL + 1e-6
        assert np.array_equal(placed.color, moving[name].color)
        shift = (reference.grid.west - placed.grid.west) / reference.grid.cell
        assert abs(shift - round(shift)) < 1e-6
    a, b = pairs["dem"]
    depths = [np.nanmedian(r.height) + r.datum for r in (a, b)]
    assert depths[0] == pytest.approx(depths[1], abs=1e-6)


def _middle(grid: Any) -> tuple[float, float]:
    west, south, east, north = grid.bounds
    return (west + east) / 2, (south + north) / 2


def test_a_broken_place_has_no_key(tmp_path: Path) -> None:
    path = tmp_path / "site.npz"
    assert rasters.place_key(path) == ""
    for junk in (b"", b"PK\x03\x04 no zip", b"\x80\x04 pickle"):
        path.write_bytes(junk)
        assert rasters.place_key(path) == ""


# --- workers


def _square_or_die(item: int, folder: Path) -> int:
    mark = folder / "died"
    if item == 2 and not mark.exists():
        mark.touch()
        os._exit(9)
    return item * item


def _die(item: int) -> int:
    os._exit(9)


def _threads(item: int) -> str | None:
    return os.environ.get("NUMBA_NUM_THREADS")


def test_a_job_whose_worker_dies_is_done_by_another(tmp_path: Path) -> None:
    found = dict(run_all(_square_or_die, range(6), 2, tmp_path))
    assert (tmp_path / "died").exists()
    assert found == {k: k * k for k in range(6)}


def test_workers_that_keep_dying_end_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshreg.benchmark.workers._DEATHS", 2)
    with pytest.raises(MeshregError, match="keep dying"):
        list(run_all(_die, range(3), 1))


def test_each_worker_has_its_share_of_the_cores() -> None:
    before = os.environ.get("NUMBA_NUM_THREADS")
    share = str(max(1, (os.cpu_count() or 1) // 2))
    assert [threads for _, threads in run_all(_threads, range(2), 2)] == [share, share]
    assert os.environ.get("NUMBA_NUM_THREADS") == before


# --- a dozen pairs, end to end


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("run") / "out"
    told: list[tuple[str, int, int]] = []
    summary = run_benchmark(SMALL, folder, workers=2, progress=lambda *news: told.append(news))
    assert told[0][0] == "pairs"
    assert told[-1] == ("tables and figures", 1, 1)
    return folder, summary


def test_the_answers_are_right_and_no_other_place_is_accepted(small: Any) -> None:
    folder, summary = small
    assert summary["pairs"]["failed_jobs"] == 0
    assert summary["pairs"]["crossing"] == 6
    assert summary["pairs"]["elsewhere"] == 4
    assert summary["verdicts"]["different places"]["accepted"]["count"] == 0
    assert summary["verdicts"]["all true pairs"]["accepted_but_wrong"]["count"] == 0
    with (folder / "pairs.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    fused = [r for r in rows if r["method"] == "fused" and r["kind"] == "crossing"]
    assert len(fused) == 6
    # 8 m patches, up to 5 m apart: one of them may show too little to hold on to
    assert sum(row["verdict"] == "rejected" for row in fused) <= 1
    for row in fused:
        if row["verdict"] == "rejected":
            assert row["east"] == ""
            continue
        away = math.hypot(
            float(row["east"]) - float(row["true_east"]),
            float(row["north"]) - float(row["true_north"]),
        )
        assert float(row["error"]) == pytest.approx(away, abs=1e-9)
        if row["ground"] != "sand":
            assert 1e-4 < away < 0.25
    assert len(rows) == 4 * (6 + 2 + 1 + 4)  # three methods and the fused answer a pair
    through_files = [r for r in rows if r["kind"] == "files" and r["method"] == "fused"]
    assert [r["verdict"] for r in through_files] == ["rejected"]


def test_tables_figures_and_page_are_there(small: Any) -> None:
    folder, summary = small
    assert json.loads((folder / "summary.json").read_text())["unmet"] == summary["unmet"]
    names = {path.name for path in (folder / "figures").iterdir()}
    assert {"error_cdf.png", "verdicts.png", "reliability.png", "runtime.png"} <= names
    text = (folder / "index.html").read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert text.count("data:image/png;base64,") == len(names)
    assert not re.search(r"<script|src=\"(?!data:)|href=|https?:", text)
    assert not list(folder.rglob("*.tmp*"))


def test_a_run_goes_on_where_it_stopped(small: Any) -> None:
    folder, summary = small
    with pytest.raises(UsageError, match="holds a benchmark"):
        run_benchmark(SMALL, folder, workers=0)
    paths = sorted((folder / "pairs").iterdir())
    before = {path: path.stat().st_mtime_ns for path in paths}
    gone = folder / "pairs" / "crossing_reef_12mo_0001.json"
    gone.unlink()
    torn = folder / "pairs" / "elsewhere_crossed_0002.json"
    torn.write_text(torn.read_text()[:100])
    again = run_benchmark(SMALL, folder, workers=0, resume=True)
    changed = {p for p in paths if p.stat().st_mtime_ns != before[p]}
    assert changed == {gone, torn}
    for part in ("success", "verdicts", "coverage", "errors"):
        assert json.dumps(again[part]) == pytest.approx(json.dumps(summary[part]))


def test_a_strange_folder_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UsageError, match="not a folder of a benchmark"):
        run_benchmark(SMALL, tmp_path, overwrite=True)
    (tmp_path / "file").touch()
    with pytest.raises((UsageError, OutputError)):
        run_benchmark(SMALL, tmp_path / "file")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_site_in_full_gives_table_one_and_its_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan, "PAPER_RADIUS", 1.2)  # the direct count takes its time
    seed = 3
    job = plan.Job("table", "abrolhos_12mo", 0, seed, 6.0, ("robust", "paper"))
    record = running.run_job(job, tmp_path)
    assert record["error"] is None, record["traceback"]
    assert record == running.read_record(job, tmp_path)
    summary, rows = summarise([record])
    (line,) = summary["table_one"]
    assert line["truth_length"] == pytest.approx(0.7708, abs=0.1)  # at the centroid, of a warp
    assert line["hand_residual"] == pytest.approx(0.0725, abs=0.06)
    terrain = [r for r in rows if r["method"] == "terrain"]
    assert {r["preset"] for r in terrain} == {"robust", "paper"}
    assert all(r["error"] < 0.1 for r in terrain)
    fused = next(r for r in rows if r["method"] == "fused" and r["preset"] == "robust")
    assert fused["error"] < 0.1
    assert abs(fused["error_up"]) < 0.05
    assert fused["covered_up"] == (abs(fused["error_up"]) <= 1.959964 * fused["sigma_up"])
    assert summary["coverage"]["crossing"]["up"]["total"] == 0  # "table" pairs stand beside these
    (tmp_path / "figures" / record["figures"][0]).unlink()
    assert running.read_record(job, tmp_path) is None  # a figure is gone: made again


# --- records, expectations, page


def record(kind: str, scenario: str, verdict: str, error: float | None, **extra: Any) -> Any:
    row = {
        "method": "fused",
        "preset": "robust",
        "status": "ok" if error is not None else "failed",
        "verdict": verdict,
        "reason": "=1+1 <script>alert(1)</script>",
        "error": error,
        "success": error is not None and error < 0.25,
        "false_alarm": 1e-9,
        "seconds": 1.0,
    }
    return {
        "job": {"kind": kind, "scenario": scenario, "index": 0, "seed": 1, "format": "",
                "name": f"{kind}_{scenario}_0000"},
        "truth": {"offset": [1.0, 2.0, 0.0], "severity": 0.0, "overlap": 0.9},
        "hand": None,
        "expect": {"verdicts": ["accepted"], "max_error": 0.25},
        "rows": [row],
        "stages": {"judge": 1.0},
        "seconds": 1.0,
        "error": None,
    } | extra  # fmt: skip


def test_what_a_recipe_does_not_expect_is_named() -> None:
    good = record("scenario", "yaw_5deg", "accepted", 0.1)
    assert summarise([good])[0]["unmet"] == []
    cases = [
        record("scenario", "doming", "review", 0.1),
        record("ladder", "severity_03", "accepted", 0.3),
        record("files", "low_overlap", "rejected", None),
        record("scenario", "night_kelp", "accepted", 0.1) | {"error": "MemoryError: x"},
    ]
    for bad in cases:
        summary, _ = summarise([good, bad])
        assert any(bad["job"]["name"] in what for what in summary["unmet"])


def test_the_crossing_is_held_to_its_rates_and_wrong_ones_to_none() -> None:
    good = [record("crossing", "reef_12mo", "accepted", 0.05) for _ in range(19)]
    one_in_review = [*good, record("crossing", "reef_12mo", "review", 0.05)]
    assert summarise(one_in_review)[0]["unmet"] == []  # 95 % accepted
    wrong = summarise([*good, record("crossing", "reef_12mo", "accepted", 0.5)])[0]
    assert len(wrong["unmet"]) == 2  # 95 % success is too little, and one is accepted but wrong
    assert any("accepted but wrong" in what for what in wrong["unmet"])
    sand = summarise([record("crossing", "sand_12mo", "review", 3.0)])[0]
    assert sand["unmet"] == []  # flat sand may be reviewed, whatever is found
    lost = summarise([record("crossing", "sand_12mo", "rejected", None)])[0]
    assert lost["unmet"] == ["flat sand rejected: none"]
    apart = record("elsewhere", "crossed", "accepted", None, truth={})
    del apart["expect"]
    apart["rows"][0]["success"] = None
    assert summarise([apart])[0]["unmet"] == ["different places accepted: none"]


def test_the_page_and_the_table_carry_no_code(tmp_path: Path) -> None:
    summary, rows = summarise([record("scenario", "doming", "rejected", None)])
    summary |= {"options": {"size": "<b>", "seed": 0}, "versions": {"x": "<i>"}}
    (tmp_path / "figures").mkdir()
    text = page.write_page(summary, tmp_path)
    assert "&lt;script&gt;alert(1)" in text
    assert not re.search(r"<script|<b>|<i>", text)
    write_csv(rows, tmp_path / "pairs.csv")
    with (tmp_path / "pairs.csv").open(encoding="utf-8", newline="") as stream:
        (line,) = csv.DictReader(stream)
    assert tuple(line) == COLUMNS
    assert line["reason"].startswith("'=1+1")


def test_the_figures_of_a_site_are_drawn_from_any_registration(tmp_path: Path) -> None:
    found = {"robust": made_registration(), "paper": made_registration("rejected")}
    names = maps.draw("scott_24mo", found, (1.0, -0.5, 0.0), tmp_path)
    assert names
    assert {path.name for path in tmp_path.iterdir()} == set(names)


# --- command line


@pytest.mark.parametrize(("unmet", "code"), [([], 0), (["terrain success at least 98 %"], 4)])
def test_exit_code_says_whether_all_is_as_expected(
    unmet: list[str],
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    summary, _ = summarise([record("crossing", "reef_12mo", "accepted", 0.05)])
    lines = [{"what": what, "found": "[bold]97 %", "holds": False} for what in unmet]
    summary |= {"unmet": unmet, "expectations": lines}
    asked: list[Any] = []

    def instead(options: Options, folder: Path, **rest: Any) -> dict[str, Any]:
        asked.append((options, folder, rest))
        return summary

    monkeypatch.setattr(run, "run_benchmark", instead)
    monkeypatch.setattr("meshreg.benchmark.run_benchmark", instead)
    out = tmp_path / "out"
    said = ["benchmark", "-o", str(out), "--scenarios", "reef_12mo, flat_sand", "--repeats", "3"]
    assert cli.run([*said, "--workers", "1", "--seed", "7", "--resume"]) == code
    options, folder, rest = asked[0]
    assert options == Options(("reef_12mo", "flat_sand"), repeats=3, seed=7)
    assert folder == out
    assert (rest["workers"], rest["resume"], rest["overwrite"]) == (1, True, False)
    printed = capsys.readouterr().out
    assert ("[bold]97 %" in printed) == (code == 4)
    assert cli.run([*said, "--json"]) == code
    assert json.loads(capsys.readouterr().out)["unmet"] == unmet


def test_an_unknown_scenario_is_a_usage_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["benchmark", "-o", str(tmp_path / "o"), "--scenarios", "atlantis"]) == 2
    assert "atlantis" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
