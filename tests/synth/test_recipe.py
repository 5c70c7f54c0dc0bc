"""Recipes: all load, all say what to expect, and mistakes are named."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from data_synth.change import Change
from data_synth.recipe import Recipe, load, scenarios
from data_synth.scene import make_scene
from meshreg.errors import UsageError

NEEDED = {
    "tasmania_12h",
    "abrolhos_12mo",
    "scott_24mo",
    "severity",
    "flat_sand",
    "low_overlap",
    "large_offset",
    "yaw_5deg",
    "scale_2pct",
    "doming",
    "repetitive_ripples",
    "elsewhere",
    "mirrored",
    "night_kelp",
}


def test_all_scenarios_are_there():
    assert set(scenarios()) >= NEEDED


@pytest.mark.parametrize("name", [*scenarios(), *(f"severity_{k:02d}" for k in range(11))])
def test_every_scenario_loads_and_ends_with_what_to_expect(name):
    recipe = load(name)
    assert isinstance(recipe, Recipe)
    assert recipe.name == name
    assert recipe.description.endswith(".")
    assert set(recipe.expect.verdicts) <= {"accepted", "review", "rejected"}
    assert recipe.expect.verdicts
    assert 0 <= recipe.expect.max_error <= 1


def test_expect_is_the_last_table_of_each_file():
    from data_synth.recipe import SCENARIOS

    for path in SCENARIOS.glob("*.toml"):
        tables = [line for line in path.read_text().splitlines() if line.startswith("[")]
        assert [name for name in tables if not name.startswith("[severe")][-1] == "[expect]", path


def test_ladder_mixes_all_change():
    steps = [load(f"severity_{k:02d}").change for k in range(11)]
    assert steps[0] == Change()
    for item in fields(Change):
        values = [getattr(step, item.name) for step in steps]
        assert (np.diff(values) > 0).all(), item.name
        np.testing.assert_allclose(np.diff(values), values[-1] / 10, atol=1e-12)


def test_overrides():
    recipe = load(
        "severity_05",
        {
            "change.bleaching": 0.5,
            "sfm.yaw": "[-1, 1]",
            "sfm.mirrored": "true",
            "place.crs": "EPSG:32601",
            "settings.search.radius": 3.0,
            "expect.verdicts": "review",
        },
    )
    assert recipe.change.bleaching == 0.5
    assert recipe.sfm.yaw == (-1.0, 1.0)
    assert recipe.sfm.mirrored is True
    assert recipe.place.crs == "EPSG:32601"
    assert recipe.settings["search.radius"] == 3.0
    assert recipe.expect.verdicts == ("review",)
    assert load("severity", {"severity": 0.7}).change == load("severity_07").change


@pytest.mark.parametrize(
    ("name", "changes", "says"),
    [
        ("nowhere", {}, "no scenario 'nowhere'"),
        ("doming", {"change.nothing": 1}, "Unknown recipe key 'change.nothing'"),
        ("doming", {"sfm.warp": "far"}, r"'sfm.warp' is 'far'"),
        ("doming", {"sfm.holes": [0, 1]}, r"'sfm.holes' is \[0, 1\]"),
        ("doming", {"sfm.mirrored": 1}, "'sfm.mirrored' is 1"),
        ("doming", {"sfm.warp": "nan"}, "'sfm.warp' is nan; it must be from"),
        ("doming", {"sfm.warp": [0, float("inf")]}, "'sfm.warp' is .*; it must be from"),
        ("doming", {"output.size": "1e400"}, "'output.size' is inf; it must be from 1 to 1000"),
        ("doming", {"output.pages": 0}, "'output.pages' is 0; it must be from 1 to 64"),
        ("doming", {"severity": "nan"}, "severity is nan; it must be a number from 0 to 1"),
        ("doming", {"settings.search.radius": -1}, "search.radius is -1; it must be"),
        ("doming", {"change.growth": 2.0}, "change.growth is 2.0"),
        ("doming", {"name.first": "x"}, "has no part 'first'"),
    ],
)
def test_mistakes_are_named(name, changes, says):
    with pytest.raises(UsageError, match=says):
        load(name, changes)


def test_broken_file_is_named(tmp_path: Path):
    path = tmp_path / "mine.toml"
    path.write_text("[change\n")
    with pytest.raises(UsageError, match=r"mine\.toml: The recipe cannot be read"):
        load(path)
    path.write_text('[site]\nbase = "moon"\n')
    with pytest.raises(UsageError, match=r"site\.base is 'moon'"):
        load(path)
    path.write_text('description = "Mine."\n[site]\nbase = "sand"\n')
    assert load(path).name == "mine"


def test_elsewhere_shares_footprint_depth_and_coordinates():
    for seed in range(3):
        scene = make_scene(load("elsewhere"), seed, 10.0)
        one, other = scene.reference, scene.moving
        boxes = [
            np.array(take.footprint) + np.tile(take.distortion.start[:2], 2)
            for take in (one, other)
        ]
        np.testing.assert_allclose(boxes[0], boxes[1], atol=1e-9)
        side = np.linspace(-4.5, 4.5, 150)
        x, y = np.meshgrid(side, side)
        heights = [take.seafloor.height(x, y) + take.distortion.start[2] for take in (one, other)]
        assert abs(heights[0].mean() - heights[1].mean()) < 0.1
        assert abs(np.corrcoef(heights[0].ravel(), heights[1].ravel())[0, 1]) < 0.6
        assert other.seafloor.ground.seed != one.seafloor.ground.seed


def test_low_overlap_is_a_fifth():
    from data_synth.truth import make_truth

    shares = [make_truth(make_scene(load("low_overlap"), seed))["overlap"] for seed in range(5)]
    assert min(shares) > 0.12
    assert max(shares) < 0.22


def test_mirrored_has_no_rigid_truth():
    from data_synth.truth import make_truth

    truth = make_truth(make_scene(load("mirrored"), 1, 8.0))
    assert truth["mirrored"] is True
    assert truth["reference_from_moving"] is None
    assert np.linalg.det(truth["warp"]["linear"]) < 0
