"""Known shifts put into surveys that show the same ground, and into some that do not."""

from __future__ import annotations

import functools
import json
import math

import numpy as np
import pytest
import seafloor
from surveys import OFFSET, displaced, floors, survey

import meshreg
from meshreg import Settings
from meshreg.cli import app as cli
from meshreg.cli import selftesting
from meshreg.errors import UsageError
from meshreg.pipeline.selftest import SelfTest, Trial, motions, self_test
from meshreg.records import Transform

QUICK = Settings().changed({"search.radius": 5.0, "methods": "terrain,mutual_information"})


@functools.cache
def good():
    first, later = floors()
    reference = survey(first, half=4.5, seed=1, name="first")
    moving, _ = displaced(survey(later, half=4.5, seed=2, name="later"))
    told = []
    result = self_test(reference, moving, QUICK, count=2, progress=lambda *word: told.append(word))
    return result, told


def test_shifts_in_good_ground_come_back():
    result, told = good()
    assert result.verdict == "accepted", result.reason
    assert [trial.verdict for trial in result.trials] == ["accepted"] * 2
    for trial in result.trials:
        assert np.hypot(*trial.error[:2]) < 0.05 * result.cell
        assert abs(trial.error[2]) < 0.002
        assert abs(math.degrees(trial.yaw_error)) < 0.12
    lengths = [np.hypot(*trial.shift[:2]) for trial in result.trials]
    np.testing.assert_allclose(lengths, result.cell * np.array([0.1, 5.0]))
    # errors are there, and far below a cell
    assert 0 < result.resolved["horizontal"] < 0.05 * result.cell
    assert 0 < result.resolved["up"] < 0.003
    assert result.rms["horizontal"] <= result.resolved["horizontal"]
    assert result.registration_error["z"] > 0
    assert [f for s, f in told if s == "trials"] == pytest.approx([0, 1 / 3, 2 / 3, 1])


def test_its_document_is_json_and_says_it_all():
    result, _ = good()
    document = json.loads(json.dumps(result.document(), allow_nan=False))
    assert document["schema"] == "meshreg.selftest/1"
    assert document["resolved"]["horizontal"] == result.resolved["horizontal"]
    assert len(document["trials"]) == 2


def test_another_place_is_refused():
    reference = survey(floors()[0], half=4.0)
    elsewhere = survey(seafloor.Seafloor.random(99, size=18.0), half=4.0, seed=2)
    result = meshreg.self_test(reference, elsewhere, QUICK, count=2)
    assert result.verdict == "rejected"
    assert result.trials == ()
    assert math.isnan(result.resolved["horizontal"])
    assert result.document()["resolved"] == {"horizontal": None, "up": None}


def test_surveys_far_apart_are_refused_without_a_raster():
    reference = survey(floors()[0], half=3.0)
    far = meshreg.apply_transform(reference, Transform(offset=(500.0, 0.0, 0.0)))
    result = self_test(reference, far, QUICK)
    assert result.verdict == "rejected"
    assert "494 m apart" in result.reason


def trial(error, verdict="accepted"):
    return Trial(np.zeros(3), 0.0, verdict, "", np.asarray(error, float), 0.0)


def test_resolved_is_the_bound_of_differences_between_answers():
    """Two answers off by 3 and by -4 mm differ by 7: less is not told from none."""
    result = SelfTest("accepted", "", 0.1, (trial([3e-3, 0, 1e-3]), trial([-4e-3, 0, -1e-3])))
    assert result.resolved["horizontal"] == pytest.approx(7e-3)
    assert result.resolved["up"] == pytest.approx(2e-3)
    assert result.rms["horizontal"] == pytest.approx(math.sqrt(12.5) * 1e-3)
    lost = SelfTest("accepted", "", 0.1, (*result.trials, trial([np.nan] * 3, "rejected")))
    assert lost.lost == 1
    assert math.isnan(lost.resolved["horizontal"])
    assert lost.rms["horizontal"] == pytest.approx(math.sqrt(12.5) * 1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_motions_stay_within_the_search(seed):
    """A pair that asks for 4.9 of 5 m must not be pushed over the edge."""
    whole = Transform(offset=(4.9, -4.9, 0.0))
    drawn = motions(np.zeros(3), whole, 0.1, 5.0, 12, seed)
    for motion in drawn:
        left = (whole @ motion.inverse()).apply(np.zeros(3))
        assert np.abs(left[:2]).max() <= 5.0 + 1e-9
    again = motions(np.zeros(3), whole, 0.1, 5.0, 12, seed)
    np.testing.assert_array_equal([m.matrix for m in drawn], [m.matrix for m in again])
    headings = [math.atan2(*m.offset[1::-1]) for m in drawn]
    assert np.ptp(headings) > 1.0


def test_no_shifts_are_a_misuse():
    reference = survey(floors()[0], half=3.0)
    with pytest.raises(UsageError, match="1 or more"):
        self_test(reference, reference, QUICK, count=0)


def test_offset_of_the_pair_is_no_part_of_the_errors():
    result, _ = good()
    assert np.hypot(*OFFSET[:2]) > 50 * result.rms["horizontal"]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Two surveys of one place and one of another, as files."""
    folder = tmp_path_factory.mktemp("surveys")
    first, later = floors()
    elsewhere = seafloor.Seafloor.random(99, size=18.0)
    paths = []
    for k, floor in enumerate((first, later, elsewhere)):
        paths.append(folder / f"survey_{k}.ply")
        meshreg.write_survey(survey(floor, half=4.0, step=0.05, seed=k), paths[-1])
    return [str(path) for path in paths]


QUICKLY = ["--shifts", "1", "--set", "search.radius=3", "--set", "methods=terrain"]


def test_command_writes_its_document_and_prints_the_same(files, tmp_path, capsys):
    out = tmp_path / "out"
    code = cli.run(["selftest", *files[:2], "-o", str(out), "--json", *QUICKLY])
    printed = json.loads(capsys.readouterr().out)
    assert code == 0, printed
    assert json.loads((out / "selftest.json").read_text()) == printed
    assert 0 < printed["resolved"]["horizontal"] < 0.02
    assert (out / "log.txt").is_file()


def test_command_refuses_another_place_with_exit_code_4(files, capsys):
    code = cli.run(["selftest", files[0], files[2], *QUICKLY])
    said = capsys.readouterr()
    assert code == 4
    assert "REJECTED" in said.out
    assert "Nothing was put in" in said.out


def test_table_names_what_can_be_resolved(capsys):
    from meshreg.cli.console import Terminal

    selftesting.show(good()[0].document(), Terminal())
    said = capsys.readouterr().out
    assert "smallest shift that this plot can resolve" in said
    assert said.count("accepted") == 2
