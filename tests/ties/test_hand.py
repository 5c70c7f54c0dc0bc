"""The hand registration, and a registration held against it; truth by drawing it."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import seafloor
from hypothesis import given, settings
from hypothesis import strategies as st
from made_registration import EAST, NORTH, made_registration

from meshreg.cli import app as cli
from meshreg.errors import InputError
from meshreg.io.result import document as document_module
from meshreg.io.result.document import read_registration, registration_document, to_json
from meshreg.judge.verdict import findings
from meshreg.pipeline import decision
from meshreg.records import OffsetEstimate, Transform
from meshreg.settings import Settings, SiftSettings
from meshreg.ties import TiePair, TiePoints, hand_registration, ties_estimate, write_ties
from meshreg.ties.cover import sectors, weak_spots
from meshreg.ties.hand import free_hand, turn_degrees
from meshreg.ties.page import sentence
from meshreg.ties.placing import Placing
from meshreg.ties.validate import validate

OFFSET = np.array([1.7, -0.9])


def picked(reference, moving, crs=None) -> TiePoints:
    rows = zip(np.asarray(reference), np.asarray(moving), strict=True)
    pairs = (TiePair(k, "", tuple(a), tuple(b)) for k, (a, b) in enumerate(rows, 1))
    return TiePoints(tuple(pairs), crs)


def clicked(seed=0, count=25, wrong=0, noise=0.02, offset=OFFSET, at=(0.0, 0.0)):
    """Points clicked `noise` metres off in both pictures, the first `wrong` on another thing."""
    rng = np.random.default_rng(seed)
    moving = rng.uniform(0, 12, (count, 2)) + at
    reference = moving + offset + rng.normal(0, noise, (count, 2))
    angle = rng.uniform(0, 2 * np.pi, wrong)
    far = rng.uniform(0.6, 2.0, wrong)[:, None]
    reference[:wrong] += far * np.column_stack([np.cos(angle), np.sin(angle)])
    return reference, moving + rng.normal(0, noise, (count, 2))


@pytest.mark.parametrize(("count", "wrong"), [(8, 0), (8, 2), (25, 0), (25, 5), (25, 8), (60, 12)])
def test_the_true_offset_is_found_among_wrong_pairs(count, wrong):
    errors, residuals = [], []
    for seed in range(4):
        hand = hand_registration(picked(*clicked(seed, count, wrong)))
        assert not hand.inliers[:wrong].any()
        assert hand.inliers[wrong:].all()
        errors.append(math.hypot(hand.east - OFFSET[0], hand.north - OFFSET[1]))
        residuals.append(hand.residual_inliers)
        assert hand.residual >= hand.residual_inliers - 1e-12
    # noise of both pictures along two axes: the mean distance is Rayleigh's
    expected = math.hypot(0.02, 0.02) * math.sqrt(math.pi / 2)
    assert 0.75 * expected < np.mean(residuals) < 1.25 * expected
    assert np.mean(errors) < 2.2 * expected / math.sqrt(count - wrong)


def test_25_pairs_are_drawn_as_published():
    hand = hand_registration(picked(*clicked()))
    assert (hand.sample, hand.draws, hand.radius) == (10, 4714, 0.20)


def test_the_swapped_pair_gives_the_inverse():
    reference, moving = clicked(3, wrong=4)
    there = hand_registration(picked(reference, moving))
    back = hand_registration(picked(moving, reference))
    assert (back.east, back.north) == pytest.approx((-there.east, -there.north), abs=1e-12)
    assert np.array_equal(back.inliers, there.inliers)


@settings(max_examples=10, deadline=None)
@given(st.integers(3, 30), st.integers(0, 2**31), st.floats(-1e6, 1e6), st.floats(-1e7, 1e7))
def test_an_exact_copy_has_no_residual(count, seed, east, north):
    reference, moving = clicked(seed, count, noise=0.0, at=(east, north))
    hand = hand_registration(picked(reference, moving))
    assert hand.inliers.all()
    assert hand.residual < 1e-7
    assert math.hypot(hand.east - OFFSET[0], hand.north - OFFSET[1]) < 1e-7


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_pairs_say_nothing(count):
    ties = picked(*clicked(count=count))
    assert hand_registration(ties) is None
    estimate = ties_estimate(ties)
    assert estimate.status == "failed"
    assert f"only {count} complete pairs" in estimate.reason
    assert estimate.manual


def test_pairs_of_chance_are_weak_and_open_ones_are_not_counted():
    rng = np.random.default_rng(1)
    ties = picked(rng.uniform(0, 12, (20, 2)), rng.uniform(0, 12, (20, 2)))
    ties = dataclasses.replace(ties, pairs=(*ties.pairs, TiePair(99, "open", (1.0, 1.0))))
    estimate = ties_estimate(ties)
    assert estimate.status == "weak"
    assert "of 20 pairs agree" in estimate.reason
    assert hand_registration(ties).contradictory


def turned(moving, degrees, scale=1.0):
    c, s = scale * math.cos(math.radians(degrees)), scale * math.sin(math.radians(degrees))
    middle = moving.mean(axis=0)
    return (moving - middle) @ np.array([[c, s], [-s, c]]) + middle


@pytest.mark.parametrize("wrong", [0, 5])
@pytest.mark.parametrize(("degrees", "scale"), [(12.0, 1.0), (-170.0, 1.0), (179.9, 0.9)])
def test_pairs_know_their_own_turn(degrees, scale, wrong):
    reference, moving = clicked(6, wrong=wrong, noise=0.01)
    delivered = turned(moving, -degrees, 1 / scale)
    assert hand_registration(picked(reference, delivered)).contradictory
    hand, turn = free_hand(picked(reference, delivered))
    assert not hand.inliers[:wrong].any()
    assert hand.inliers[wrong:].all()
    difference = (turn_degrees(turn) - degrees + 180) % 360 - 180
    assert difference == pytest.approx(0, abs=0.4)
    assert turn.scale == pytest.approx(scale, abs=0.005)
    # the true translation in the pairs' middle, where an error of the turn does nothing
    assert (hand.east, hand.north) == pytest.approx(OFFSET, abs=0.02)


def test_a_translation_that_does_is_left_alone():
    for yaw in (0.0, 0.3):  # 6 m from the middle 0.3 degrees are 3 cm
        reference, moving = clicked(3, wrong=4)
        ties = picked(reference, turned(moving, yaw))
        hand, turn = free_hand(ties)
        assert turn is None
        assert (hand.east, hand.north) == (
            hand_registration(ties).east,
            hand_registration(ties).north,
        )
    assert free_hand(picked(*clicked(count=2))) == (None, None)
    same = picked([(1.0, 1.0)] * 4, [(0.0, 0.0)] * 4)  # no line between any two
    assert free_hand(same)[1] is None


def test_weak_spots_are_named_by_the_compass():
    east, north = np.meshgrid(np.arange(0.5, 12), np.arange(0.5, 12))
    ground = np.column_stack([east.ravel(), north.ravel()])
    points = ground[(ground[:, 0] > 4) | (ground[:, 1] < 8)]  # nothing in the north-west
    parts = sectors(points, ground)
    assert weak_spots(parts) == ("north-west",)
    assert sum(p.share for p in parts) == pytest.approx(1.0)
    assert sum(p.pairs for p in parts) == len(points)
    assert weak_spots(sectors(np.zeros((0, 2)), ground)) == tuple(p.name for p in parts)
    assert sectors(points, np.zeros((0, 2))) == ()


def made(error=(0.0, 0.0), yaw=None):
    """A registration off by `error` from the pairs that it returns with."""
    registration = made_registration("accepted")
    transform = registration.transform
    if yaw is not None:
        c, s = math.cos(yaw), math.sin(yaw)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        transform = dataclasses.replace(transform, rotation=turn)
    rng = np.random.default_rng(2)
    moving = np.array([EAST, NORTH]) + rng.uniform(3, 22, (25, 2))
    solid = np.column_stack([moving, np.full(25, transform.pivot[2])])
    reference = transform.apply(solid)[:, :2]
    wrong = Transform(
        transform.rotation, 1.0, transform.offset + np.append(error, 0.0), transform.pivot
    )
    return dataclasses.replace(registration, transform=wrong), reference, moving


@pytest.mark.parametrize("error", [(0.0, 0.0), (0.05, -0.12), (0.3, 0.1)])
def test_the_error_that_was_made_is_found(error):
    registration, reference, moving = made(error)
    found = validate(registration, picked(reference, moving), Placing(registration)).document
    fused = found["fused"]
    assert fused["difference"] == pytest.approx(error, abs=2e-3)  # a yaw of 0.2° is not a shift
    assert fused["error"] == pytest.approx(math.hypot(*error), abs=2e-3)
    assert fused["residual"] == pytest.approx(math.hypot(*error), abs=1e-9)  # exact, yaw included
    assert found["confirmed"] == (math.hypot(*error) <= 0.20)
    sift = found["methods"]["sift"]
    hand = found["hand"]
    assert sift["difference"] == pytest.approx([1.31 - hand["east"], -0.69 - hand["north"]])
    assert found["methods"]["mutual_information"]["error"] is None
    assert found["turned_first"] is None


def test_a_survey_delivered_turned_is_turned_first():
    registration, reference, moving = made((0.04, 0.03), math.radians(20))
    assert hand_registration(picked(reference, moving)).contradictory
    found = validate(registration, picked(reference, moving), Placing(registration)).document
    assert found["turned_first"] == pytest.approx(20)
    assert found["fused"]["error"] == pytest.approx(0.05, abs=1e-6)
    assert found["confirmed"]


@pytest.mark.parametrize("seen", [None, (19.8, 1.0)])
def test_methods_are_compared_in_the_frame_that_they_looked_at(seen):
    """Their offsets are of the survey as it was turned about its centre: by the result's own turn,
    or by what the evidence says that they saw."""
    registration, reference, moving = made(yaw=math.radians(20))
    ties = picked(reference, moving)
    centre = registration.transform.pivot[:2]
    c, s = (f(math.radians(20 if seen is None else seen[0])) for f in (math.cos, math.sin))
    looked_at = (moving - centre) @ np.array([[c, s], [-s, c]]) + centre
    # truth: the mean offset of what the method looked at, and an error that is put in
    true = (reference - looked_at).mean(axis=0)
    error = np.array([0.06, -0.02])
    estimate = OffsetEstimate("terrain", "ok", "", *(true + error))
    registration = dataclasses.replace(registration, estimates=(estimate,))
    found = validate(registration, ties, Placing(registration), turned=seen).document
    method = found["methods"]["terrain"]
    assert method["difference"] == pytest.approx(error, abs=1e-9)
    assert method["error"] == pytest.approx(np.hypot(*error))
    hand = np.array([found["hand"]["east"], found["hand"]["north"]])
    assert method["offset"] == pytest.approx(hand + error)
    assert found["methods_turned"] == pytest.approx(20 if seen is None else seen[0])


def test_a_wrong_turn_is_not_confirmed_though_it_is_right_in_the_middle():
    registration, reference, moving = made(yaw=math.radians(2))
    middle = np.append(moving.mean(axis=0), registration.transform.pivot[2])
    # the same place for the middle, three degrees too far
    c, s = math.cos(math.radians(3)), math.sin(math.radians(3))
    more = Transform(
        np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]),
        pivot=registration.transform.apply(middle),
    )
    wrong = dataclasses.replace(registration, transform=more @ registration.transform)
    document = validate(wrong, picked(reference, moving), Placing(wrong)).document
    assert document["fused"]["error"] < 1e-6
    assert document["fused"]["residual"] > 0.2
    assert not document["confirmed"]
    assert "its turn is wrong" in sentence(document)
    right = validate(registration, picked(reference, moving), Placing(registration)).document
    assert right["confirmed"]
    assert right["fused"]["within"] == 25


def test_a_rejected_registration_has_methods_only():
    registration, reference, moving = made()
    rejected = dataclasses.replace(
        registration, verdict="rejected", transform=None, covariance=None
    )
    found = validate(rejected, picked(reference, moving)).document
    assert found["fused"]["error"] is None
    assert not found["confirmed"]
    assert found["methods"]["sift"]["error"] < 0.1


def test_pairs_of_another_frame_are_refused():
    registration, reference, moving = made()
    with pytest.raises(InputError, match="The reference points lie around"):
        validate(registration, picked(reference - [731_000, 0], moving), Placing(registration))
    with pytest.raises(InputError, match="too few"):
        validate(registration, picked(reference[:2], moving[:2]), Placing(registration))


def test_placing_goes_back_by_the_way_it_came_tilt_included():
    registration, _, moving = made()
    tilt = math.radians(1.5)
    c, s = math.cos(tilt), math.sin(tilt)
    leaning = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ registration.transform.rotation
    transform = dataclasses.replace(registration.transform, rotation=leaning)
    registration = dataclasses.replace(registration, transform=transform)
    # truth: a tilted surface of moving points, with heights as the registered survey has them
    heights = -12 + 0.3 * np.sin(moving[:, 0]) + 0.2 * np.cos(moving[:, 1])
    solid = transform.apply(np.column_stack([moving, heights]))

    def height_at(points):
        near = np.hypot(*(points[:, None] - solid[None, :, :2]).transpose(2, 0, 1)).argmin(axis=1)
        return solid[near, 2]

    placing = Placing(registration, height_at)
    assert np.allclose(placing.to_moving(solid[:, :2]), moving, rtol=0, atol=1e-7)
    assert np.allclose(placing.to_reference(moving), solid[:, :2], rtol=0, atol=1e-6)


SETTINGS = Settings().changed({"methods": "terrain,mutual_information", "search.radius": 5.0})
TRUE = (1.237, -2.412)


def decided(rasters, offset, count=25):
    reference, moving = clicked(4, count, offset=np.array(offset))
    ties = picked(reference, moving)
    return decision.decide(
        rasters,
        SETTINGS,
        SETTINGS.search.radius,
        manual=lambda motion: ties_estimate(ties, SETTINGS.sift, motion=motion),
    )


@pytest.fixture(scope="module")
def rasters():
    return seafloor.rasters(2, TRUE, change=0.3, half=7.0, size=20.0)


def test_ties_are_one_more_method_marked_as_manual(rasters):
    without = decision.decide(rasters, SETTINGS, SETTINGS.search.radius)
    right = decided(rasters, TRUE)
    assert right.judgement.verdict == without.judgement.verdict == "accepted"
    assert "ties" in right.judgement.best.methods
    estimate = right.estimates[-1]
    assert (estimate.method, estimate.manual, estimate.status) == ("ties", True, "ok")
    assert not any(e.manual for e in right.estimates[:-1])
    # image and terrain remain the channels: their evidence is the same with and without hands
    assert right.judgement.best.gaps == pytest.approx(without.judgement.best.gaps)


@pytest.mark.parametrize("offset", [(-3.0, 3.0), (1.9, -2.4), (40.0, 0.0)])
def test_wrong_ties_move_nothing(rasters, offset):
    wrong = decided(rasters, offset)
    best = wrong.judgement.best
    assert wrong.placed.verdict == "accepted"
    assert wrong.judgement.verdict == "review"  # a person's points say otherwise
    assert [finding.code for finding in findings(wrong.found)] == ["ties"]
    assert math.hypot(best.east - TRUE[0], best.north - TRUE[1]) < 0.06
    assert "ties" not in best.methods
    if offset[0] > 5:
        assert wrong.estimates[-1].status == "failed"
        assert "outside the search radius" in wrong.estimates[-1].reason


def test_a_person_s_bias_does_not_outweigh_what_was_measured(rasters):
    """Pairs that agree to a centimetre, all wrong alike, and near enough to be of one mind."""
    found = decided(rasters, (TRUE[0] + 0.15, TRUE[1] + 0.1), 60)
    best = found.judgement.best
    assert "ties" in best.methods
    assert math.hypot(best.east - TRUE[0], best.north - TRUE[1]) < 0.03
    assert np.linalg.eigvalsh(found.estimates[-1].sigma).min() > 0.05**2


def test_ties_do_not_make_another_place_acceptable():
    here = seafloor.rasters(2, TRUE, half=7.0, size=20.0)
    there = seafloor.rasters(102, TRUE, half=7.0, size=20.0)
    mixed = {name: (here[name][0], there[name][1]) for name in here}
    assert decided(mixed, TRUE).judgement.verdict == "rejected"


def test_the_record_says_that_a_person_picked(tmp_path):
    estimate = ties_estimate(picked(*clicked()), SiftSettings())
    registration = dataclasses.replace(made_registration(), estimates=(estimate,))
    document = registration_document(registration)
    entry = document["methods"]["ties"]
    assert entry["manual"] is True
    assert entry["offset"] == [estimate.east, estimate.north]
    schema = Path(document_module.__file__).with_name("registration.schema.json")
    jsonschema.validate(document, json.loads(schema.read_text()))
    (tmp_path / "registration.json").write_text(to_json(document))
    read = read_registration(tmp_path).estimates[0]
    assert read.manual
    assert np.array_equal(read.sigma, estimate.sigma)
    others = registration_document(made_registration())["methods"].values()
    assert all("manual" not in other for other in others)


def test_validate_writes_page_figures_and_document(tmp_path, capsys):
    registration, reference, moving = made((0.03, 0.0))
    out = tmp_path / "OUT"
    out.mkdir()
    (out / "registration.json").write_text(to_json(registration_document(registration)))
    reference[3] += [0.8, 0.1]
    crs = registration.reference["crs"]
    ties = picked(reference, moving, crs)
    named = dataclasses.replace(ties.pairs[0], name="<script>alert(1)</script>")
    write_ties(dataclasses.replace(ties, pairs=(named, *ties.pairs[1:])), tmp_path / "ties.csv")
    assert cli.run(["validate", str(out), str(tmp_path / "ties.csv")]) == 0
    said = capsys.readouterr().out
    assert "CONFIRMED" in said
    document = json.loads((out / "validation.json").read_text())
    assert document["schema"] == "meshreg.validation/1"
    assert document["hand"]["inliers"] == 24
    assert document["fused"]["error"] == pytest.approx(0.03, abs=3e-3)
    page = (out / "validation.html").read_text()
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert page.count("data:image/png") == 3
    assert '<a href="report.html">' in page
    assert "http" not in page.split("<body>")[1]
    drawn = {path.name for path in (out / "figures").iterdir()}
    assert drawn == {f"validation_{n}.png" for n in ("errors", "offsets", "residuals")}

    assert cli.run(["validate", str(out), str(tmp_path / "ties.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == document

    # the report leads there, and does so when it is made again
    for again in (False, True):
        if again:
            assert cli.run(["report", str(out)]) == 0
            capsys.readouterr()
        report = (out / "report.html").read_text()
        assert "Confirmed by tie points picked by hand" in report
        assert document["said"] in report
        assert '<a href="validation.html">' in report

    # pairs that took part are no check, and that is said
    digest = document["ties"]["sha256"][0]
    assert document["ties"]["independent"]
    used = dataclasses.replace(registration, notes=(f"25 tie points (SHA-256 {digest}).",))
    (out / "registration.json").write_text(to_json(registration_document(used)))
    assert cli.run(["validate", str(out), str(tmp_path / "ties.csv"), "--json"]) == 0
    assert not json.loads(capsys.readouterr().out)["ties"]["independent"]
    for page in ("validation.html", "report.html"):
        assert "do not check it" in (out / page).read_text()

    far = picked(reference + np.array([0.5, 0.0]), moving, crs)
    write_ties(far, tmp_path / "ties.csv")
    assert cli.run(["validate", str(out), str(tmp_path / "ties.csv"), "--json"]) == 4
    assert "Not confirmed by tie points" in (out / "report.html").read_text()
    write_ties(dataclasses.replace(far, crs="EPSG:3857"), tmp_path / "ties.csv")
    assert cli.run(["validate", str(out), str(tmp_path / "ties.csv")]) == 2
    assert cli.run(["validate", str(tmp_path / "none"), str(tmp_path / "ties.csv")]) == 2


def test_a_report_that_is_not_made_again_is_said(tmp_path, capsys, monkeypatch):
    registration, reference, moving = made((0.03, 0.0))
    out = tmp_path / "OUT"
    out.mkdir()
    (out / "registration.json").write_text(to_json(registration_document(registration)))
    write_ties(picked(reference, moving, registration.reference["crs"]), tmp_path / "ties.csv")
    command = ["validate", str(out), str(tmp_path / "ties.csv")]
    assert cli.run(command) == 0
    assert "report.html leads there" in capsys.readouterr().out
    before = (out / "report.html").read_bytes()

    def starved(folder):
        raise MemoryError

    monkeypatch.setattr("meshreg.cli.reporting.write_report", starved)
    assert cli.run(command) == 0
    said = capsys.readouterr()
    assert "report.html was not made again: not enough memory" in said.err
    assert "leads there" not in said.out
    assert (out / "report.html").read_bytes() == before
