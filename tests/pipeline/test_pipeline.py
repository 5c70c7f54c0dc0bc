"""The whole way, on meshes and clouds whose motion is known exactly."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from surveys import OFFSET, QUICK, displaced, floors, survey

from meshreg import Settings, apply_transform, register_pair
from meshreg.errors import UsageError
from meshreg.height.lifting import STABLE, rotation
from meshreg.io.result.evidence import read_evidence, write_evidence
from meshreg.pipeline.compare import APART
from meshreg.records import Transform
from meshreg.refine.surfaces import Polished
from meshreg.report import keep
from meshreg.statistics import registration_sigma


def errors(registration, truth, points):
    return np.abs(registration.transform.apply(points) - truth.apply(points))


@pytest.mark.parametrize("yaw_deg", [0.0, 0.6])
@pytest.mark.parametrize("cloud", [False, True])
def test_known_motion_is_recovered_both_ways(cloud, yaw_deg):
    first, later = floors()
    reference = survey(first, seed=1, name="first", cloud=cloud)
    moving, truth = displaced(survey(later, seed=2, name="later", cloud=cloud), np.deg2rad(yaw_deg))
    there = register_pair(reference, moving, QUICK)
    assert there.verdict == "accepted", there.reason
    low, high = moving.bounds
    corners = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    assert errors(there, truth, moving.centre)[:2].max() < 0.01
    assert errors(there, truth, corners)[:, :2].max() < 0.03
    assert errors(there, truth, corners)[:, 2].max() < 0.01
    # the stated covariance covers, and does not hide behind a barn door
    sigma = np.sqrt(np.diag(there.covariance))
    assert (sigma[:3] < 0.02).all()
    back = register_pair(moving, reference, QUICK)
    assert back.verdict == "accepted", back.reason
    home = back.transform.apply(there.transform.apply(corners))
    assert np.abs(home - corners).max() < 0.03


def test_a_tilted_survey_is_levelled():
    first, later = floors()
    reference = survey(first, half=5.0, seed=1)
    flat = survey(later, half=5.0, seed=2)
    turn = rotation(np.deg2rad([0.9, -0.5]))
    truth = Transform(turn, 1.0, OFFSET, (1.0, -2.0, 0.5))
    found = register_pair(reference, apply_transform(flat, truth.inverse()), QUICK)
    assert found.verdict == "accepted", found.reason
    between = found.transform.rotation @ truth.rotation.T
    assert np.rad2deg(np.arccos((np.trace(between) - 1) / 2)) < 0.15
    turned = 0.5 * np.array([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0]])
    assert (np.abs(turned) < 3 * np.sqrt(np.diag(found.covariance)[3:5])).all()
    low, high = flat.bounds
    corners = truth.inverse().apply(
        [[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])]
    )
    assert errors(found, truth, corners).max() < 0.02
    # the doubt of each parameter is stated, that of the scale, which was not fitted, too
    sigma = np.sqrt(np.diag(found.covariance))
    assert (sigma > 0).all()
    assert sigma[6] < 0.005
    stated = registration_sigma(found, *(truth.apply(corners)).T)
    assert (stated > 0).all()
    at = registration_sigma(found, *found.registration_error["at"])
    np.testing.assert_allclose([found.registration_error[axis] for axis in "xyz"], at, rtol=1e-9)
    assert (stated[:, 2] > at[2]).all()  # a tilt's doubt grows with the lever


@pytest.mark.parametrize(("degrees", "codes"), [(9.5, []), (10.5, ["lean"])])
def test_the_tilt_that_counts_is_that_after_the_surfaces(monkeypatch, degrees, codes):
    first, later = floors()

    def tilted(reference, moving, transform, place, error, stable, seed, *, kind):
        assert np.abs(transform.rotation[2, :2]).max() < 0.02
        turned = rotation([np.deg2rad(degrees), 0.0]) @ transform.rotation
        return Polished(dataclasses.replace(transform, rotation=turned), True, 0.0, 0.1, 0.1, "x")

    monkeypatch.setattr("meshreg.pipeline.answer.polish", tilted)
    pair = survey(first, half=2.5, step=0.05, seed=1), displaced(survey(later, half=2.5, step=0.05))
    found = register_pair(pair[0], pair[1][0], QUICK.changed({"refine.surfaces": "gicp"}))
    assert [finding.code for finding in found.findings] == codes
    assert found.verdict == ("review" if codes else "accepted")


@pytest.mark.needs("small_gicp")
def test_surfaces_polish_a_registration():
    first, _ = floors()
    reference = survey(first, half=3.0, seed=1)
    moving, truth = displaced(survey(first, half=3.0, seed=2))
    settings = QUICK.changed({"refine.surfaces": "gicp"})
    found = register_pair(reference, moving, settings)
    assert found.verdict == "accepted", found.reason
    assert any("surfaces" in note for note in found.notes)
    assert errors(found, truth, moving.centre).max() < 0.003
    # never surer than without, and what is stated is what the covariance says there
    plain = register_pair(reference, moving, QUICK)
    stated, before = (
        np.array([r.registration_error[axis] for axis in "xyz"]) for r in (found, plain)
    )
    assert (stated > before).all()
    assert (stated < before + 0.003).all()
    at = registration_sigma(found, *found.registration_error["at"])
    np.testing.assert_allclose(stated, at, rtol=1e-9)
    with pytest.raises(UsageError, match="ndt"):
        register_pair(reference, moving, QUICK.changed({"refine.surfaces": "ndt"}))


def test_a_survey_onto_itself_stays():
    reference = survey(floors()[0], half=5.0)
    registration = register_pair(reference, reference, QUICK)
    assert registration.verdict == "accepted"
    matrix = registration.transform.matrix
    assert np.abs(matrix - np.eye(4)).max() < 1e-6


def test_large_coordinates_change_nothing():
    """The same pair near (0, 0) and at southern UTM size: one answer, to 0.1 mm."""
    first, later = floors()
    reference = survey(first, half=5.0)
    moving, _ = displaced(survey(later, half=5.0, seed=3))
    near = register_pair(reference, moving, QUICK)
    far_away = np.array([512_345.0, 8_388_700.0, -1800.0])
    far = register_pair(
        *(dataclasses.replace(s, origin=s.origin + far_away) for s in (reference, moving)), QUICK
    )
    assert far.verdict == near.verdict == "accepted"
    np.testing.assert_allclose(far.transform.offset, near.transform.offset, atol=1e-4)


def test_evidence_for_the_report_is_on_common_grids():
    first, later = floors()
    reference = survey(first, half=5.0)
    moving, _ = displaced(survey(later, half=5.0, seed=3))
    evidence = register_pair(reference, moving, QUICK).evidence
    for kind in ("dem", "ortho"):
        grids = {evidence[f"{which}_{kind}"].grid for which in ("reference", "moving")}
        grids.add(evidence[f"moving_{kind}_before"].grid)
        assert len(grids) == 1
    # after registration the heights agree to what changed; before, to the relief
    pair = evidence["reference_dem"], evidence["moving_dem"], evidence["moving_dem_before"]
    both = pair[0].valid & pair[1].valid
    # nothing of the registered survey is cut off: OFFSET carries it beyond what was delivered
    assert pair[1].valid.sum() == pytest.approx(pair[2].valid.sum(), rel=0.01)
    # a fifth of the bumps changed; of the rest most ground is stable, and all of it is seen by both
    stable = evidence["stable"] == STABLE
    assert 0.5 < (stable & both).sum() / both.sum() < 1
    assert (stable & ~both).sum() < 0.02 * both.sum()
    after = pair[0].height + pair[0].datum - pair[1].height - pair[1].datum
    assert abs(np.median(after[both])) < 0.005
    assert np.percentile(np.abs(after[both]), 50) < 0.02


def test_maps_do_not_hold_the_way_between_a_far_survey_and_its_place(tmp_path):
    """Delivered 60 m off: cells of the way between cost what the survey itself does not."""
    first, later = floors()
    away = np.array([-48.0, 37.0, 0.0])
    moving = dataclasses.replace(survey(later, half=3.0, seed=3), origin=away)
    registration = register_pair(
        survey(first, half=5.0), moving, QUICK.changed({"search.radius": 70.0})
    )
    assert registration.verdict == "accepted"
    np.testing.assert_allclose(registration.transform.offset, -away, atol=0.01)
    evidence = registration.evidence
    for kind in ("dem", "ortho"):
        reference, after = (evidence[f"{which}_{kind}"] for which in ("reference", "moving"))
        assert f"moving_{kind}_before" not in evidence
        assert reference.grid == after.grid
        np.testing.assert_allclose(reference.grid.bounds, [-5, -5, 5, 5], atol=0.2)
        apart = evidence[f"moving_{kind}_apart"]
        np.testing.assert_allclose(apart.grid.bounds, [-51, 34, -45, 40], atol=0.2)
        assert after.valid.sum() == pytest.approx(apart.valid.sum(), rel=0.01)
    assert registration.before == APART
    assert registration.before.keys() == registration.after.keys()
    write_evidence(keep(registration), tmp_path)
    kept = read_evidence(tmp_path)
    np.testing.assert_allclose(kept["meta"]["apart"]["bounds"], [-51, 34, -45, 40], atol=0.2)
    low, high = np.percentile(kept["matches"][kept["matches"][:, 4] > 0, 2], [1, 99])
    assert -51 < low < high < -45
    assert kept["matches"][:, 2].mean() - kept["matches"][:, 0].mean() == pytest.approx(-48, abs=1)


def test_surveys_kilometres_apart_are_rejected_without_rasterizing_the_sea_between():
    reference = survey(floors()[0], half=3.0)
    moving = dataclasses.replace(reference, origin=np.array([731_000.0, 5_705_000.0, 0.0]))
    registration = register_pair(reference, moving, QUICK)
    assert registration.verdict == "rejected"
    assert registration.transform is None
    assert "--moving-shift" in registration.reason
    assert "rasterize" not in registration.seconds


def test_same_seed_same_document():
    first, later = floors()
    reference = survey(first, half=4.0)
    moving, _ = displaced(survey(later, half=4.0, seed=3))
    runs = [register_pair(reference, moving, QUICK) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].transform.matrix, runs[1].transform.matrix)
    np.testing.assert_array_equal(runs[0].covariance, runs[1].covariance)


@pytest.mark.parametrize("warp", ["none", "auto"])
def test_the_transform_is_told_as_soon_as_it_stands(warp):
    """Not where a warp may follow, nor for a pair that has none."""
    floor, later = floors()
    moving, _ = displaced(survey(later, seed=1))
    told, stages = [], []
    registration = register_pair(
        survey(floor),
        moving,
        QUICK.changed({"warp.model": warp}),
        settled=lambda transform: told.append((transform, stages[-1])),
        progress=lambda stage, fraction: stages.append((stage, fraction)),
    )
    assert registration.transform is not None
    if warp == "none":
        ((transform, when),) = told
        assert transform is registration.transform
        assert when[0] == "refine"
    else:
        assert not told
    apart = apply_transform(moving, Transform(offset=[5000.0, 0.0, 0.0]))
    rejected = register_pair(survey(floor), apart, QUICK, settled=told.append)
    assert rejected.transform is None
    assert len(told) == (warp == "none")


def test_misuse_names_the_remedy():
    reference = survey(floors()[0], half=2.0)
    other_crs = dataclasses.replace(reference, crs="EPSG:32755")
    with pytest.raises(UsageError, match="common_crs"):
        register_pair(dataclasses.replace(reference, crs="EPSG:32754"), other_crs)
    with pytest.raises(UsageError, match="--scale"):
        register_pair(reference, dataclasses.replace(reference, scale_known=False))
    with pytest.raises(UsageError, match="'magic'"):
        register_pair(reference, reference, Settings(methods=("magic",)))


def test_progress_names_each_stage_once_begun_and_once_done():
    told = []
    reference = survey(floors()[0], half=4.0)
    register_pair(reference, reference, QUICK, progress=lambda *word: told.append(word))
    for stage in ("rasterize", "sift", "terrain", "mutual_information", "judge", "apply"):
        fractions = [f for s, f in told if s == stage]
        assert fractions[0] == 0.0
        assert fractions[-1] == 1.0
        assert fractions == sorted(fractions)


def test_the_radius_that_the_reason_names_gives_the_answer():
    """A plot whose first place is 300 m off, end to end."""
    first, later = floors()
    reference = survey(first, half=4.0, step=0.05, seed=1)
    away = np.array([300.0, -40.0, 0.0])
    moving = survey(later, half=4.0, step=0.05, seed=2)
    moving = dataclasses.replace(moving, origin=moving.origin + away)
    refused = register_pair(reference, moving)
    assert refused.verdict == "rejected"
    radius = float(re.search(r"--search-radius ([\d.e+]+)", refused.reason)[1])
    assert 300 < radius < 400
    found = register_pair(reference, moving, Settings().changed({"search.radius": radius}))
    assert found.verdict == "accepted", found.reason
    np.testing.assert_allclose(found.transform.apply(away[None])[0], 0, atol=0.02)
