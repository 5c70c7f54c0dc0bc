"""What is said of a doubtful pair: frames, units, axes, scale, what was left out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from made_registration import made_registration

from meshreg.cli import pairing
from meshreg.cli.common import SurveyRequest
from meshreg.errors import ResourceLimitError, UsageError
from meshreg.io.options import ReadOptions
from meshreg.records import Frame, Grid, Maps, PointCloud, SourceFile, Survey
from meshreg.settings import Settings

HOME = np.array([731_000.0, 5_705_000.0, 0.0])
PLAIN = (SurveyRequest("old", ReadOptions()), SurveyRequest("new", ReadOptions()))


def survey(name, shift=(0, 0, 0), size=20.0, crs=None, at=(0.0, 0, 0), turned=False):
    """Ground of `size` metres around `at` in its file, which `shift` takes to its place."""
    rng = np.random.default_rng(len(name))
    points = rng.uniform(-size / 2, size / 2, (900, 3)) * (1, 1, 0.01) + at
    if turned:
        points = points[:, [0, 2, 1]]
    frame = Frame(np.eye(3), shift, crs, crs)
    source = (SourceFile(Path(f"{name}.ply"), "ply", frame),)
    return Survey(name, PointCloud(points), frame.shift, crs=crs, source=source)


@pytest.mark.parametrize(("home", "away"), [(HOME, (0, 0, 0)), ((0, 0, 0), HOME)])
def test_a_lost_shift_leaves_one_local_frame(home, away):
    pair = survey("old", home), survey("new", away, at=(1.0, 0, 0))
    moving, (note,) = pairing.same_frame(PLAIN, pair, 10.0)
    np.testing.assert_array_equal(moving.source[0].frame.shift, home)
    placed = pair[1].geometry.points + np.asarray(home)
    np.testing.assert_allclose(moving.geometry.points + moving.origin, placed, atol=1e-9)
    assert "731000, 5705000, 0" in note
    assert "(0, 0, 0)" in note
    assert "taken for both" in note


@pytest.mark.parametrize(
    ("reference", "moving", "requests"),
    [
        (survey("old", HOME), survey("new", HOME + 3e4), PLAIN),
        (survey("old", HOME), survey("new", crs="EPSG:32754"), PLAIN),
        (
            survey("old", HOME),
            survey("new"),
            (PLAIN[0], SurveyRequest("new", ReadOptions(shift=(0.0, 0.0, 0.0)))),
        ),
    ],
    ids=["two shifts", "a place of its own", "stated"],
)
def test_what_is_stated_stands_and_is_told(reference, moving, requests):
    found, (note,) = pairing.same_frame(requests, (reference, moving), 10.0)
    assert found is moving
    assert "--moving-shift 731000,5705000,0" in note
    assert "own coordinates meet" in note


@pytest.mark.parametrize(
    ("reference", "moving"),
    [
        (survey("old", HOME), survey("new", HOME)),
        (survey("old", HOME), survey("new", np.add(HOME, (3, -4, 0)))),  # exported each its own way
        (survey("old", HOME), survey("new", at=(500.0, 0, 0))),  # meets nowhere
        (survey("old", HOME), survey("new", at=HOME)),  # absolute numbers, no shift needed
        (survey("old", HOME), Survey("new", Maps(np.zeros((4, 4)), Grid(0, 4, 1, (4, 4))))),
        (survey("old", HOME), Survey("made", PointCloud(np.zeros((3, 3))))),
    ],
)
def test_other_pairs_are_left_alone(reference, moving):
    found, notes = pairing.same_frame(PLAIN, (reference, moving), 10.0)
    assert found is moving
    assert notes == []


def test_two_models_without_scale_need_one():
    models = [dataclasses.replace(survey(name), scale_known=False) for name in ("old", "new")]
    stated = SurveyRequest("new", ReadOptions(scale=2.0))
    for requests in (PLAIN, (PLAIN[0], stated), (stated, PLAIN[1])):
        with pytest.raises(UsageError, match="--scale"):
            pairing.require_scale(requests, (models[0], models[1]))
    pairing.require_scale((stated, stated), (models[0], models[1]))
    pairing.require_scale(PLAIN, (models[0], survey("known")))  # refused by register_pair


@pytest.mark.parametrize(
    ("times", "unit"), [(100, "cm"), (1000, "mm"), (1 / 0.3048, "ft"), (39.4, "in"), (5.5, None)]
)
def test_units_that_differ_are_named(times, unit):
    plain, large = survey("plain"), survey("large", size=20.0 * times)
    for pair in ((plain, large), (large, plain)):
        (note,) = pairing.unit_notes(pair)
        assert f"{pair[1].name!r} is " in note
        assert (f"'large' were in {unit}" in note) == (unit is not None)
        assert ('unit = "' in note) == (unit is not None)


def test_surveys_of_like_size_have_like_units():
    assert pairing.unit_notes((survey("a"), survey("b", size=45.0))) == []
    flat = Survey("dot", PointCloud(np.zeros((3, 3))))
    assert pairing.unit_notes((survey("a"), flat)) == []


def test_an_upright_survey_is_told():
    (note,) = pairing.level_notes((survey("level"), survey("standing", turned=True)))
    assert note.startswith("standing: Not level")
    assert "--up y" in note


def test_what_was_left_out_is_counted_and_small_shares_are_not():
    registration = made_registration()
    raster = registration.evidence["reference_dem"]
    settings = Settings().changed(
        {"raster.dem_cell": raster.grid.cell, "raster.ortho_cell": raster.grid.cell / 2,
         "raster.sift_cell": raster.grid.cell / 2}
    )  # fmt: skip
    seen = int(raster.valid.sum())
    masked = {
        "reference": {"floaters": 12, "beneath": seen, "flat color": seen // 200},
        "moving": {"mask": 1},
    }
    registration = dataclasses.replace(
        registration,
        settings=settings.as_dict(),
        evidence={**registration.evidence, "masked": masked},
    )
    # half the cell: a quarter of the ground for each cell of the DEM
    assert pairing.masked_notes(registration) == [
        "Left out of the reference's rasters: floaters 12; hidden beneath other surface "
        "(overhangs) 25% of the ground."
    ]
    assert pairing.masked_notes(made_registration("rejected")) == []


def test_rasters_larger_than_memory_are_refused_before_the_work(monkeypatch):
    """20 × 20 m twice, in cells of 0.1, 0.05 and 0.01 m: 8.4 million cells, four million in one."""
    pair = survey("old"), survey("new")
    settings = Settings().changed(
        {"raster.dem_cell": 0.1, "raster.ortho_cell": 0.05, "raster.sift_cell": 0.01}
    )
    needed = 2 * 11 * 2 * 400 * (100 + 400 + 10_000) + 10 * 400 * 10_000
    monkeypatch.setattr("meshreg.io.files.safe.free_memory", lambda: needed)
    pairing.require_memory(pair, settings)
    monkeypatch.setattr("meshreg.io.files.safe.free_memory", lambda: int(0.95 * needed))
    with pytest.raises(ResourceLimitError, match=r"0\.2 GB at least.*--dem-cell"):
        pairing.require_memory(pair, settings)
    pairing.require_memory(pair, settings.changed({"methods": "terrain"}))  # no SIFT: less
    monkeypatch.setattr("meshreg.io.files.safe.free_memory", lambda: None)
    pairing.require_memory(pair, settings)
