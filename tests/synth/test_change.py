"""Change: each class changes its polygons and nothing else; the record says how much."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from matplotlib.path import Path as Outline

from data_synth import types as t
from data_synth.change import Change, apply_change
from data_synth.recipe import load
from data_synth.regions import describe_change
from data_synth.scene import Scene, make_scene
from data_synth.seafloor import make_seafloor
from data_synth.sites import SITES
from meshreg.errors import UsageError

BOUNDS = (-4.0, -4.0, 4.0, 4.0)
EVERYTHING = replace(SITES["reef"], boulder=0.5, kelp=0.3, urchin=0.5, sand=0.2)
THINGS = [f.name for f in fields(Change) if f.name not in ("texture", "ripples")]


def scene_with(**strengths: float) -> Scene:
    recipe = load("severity_00")
    recipe = replace(recipe, site=EVERYTHING, change=Change(**strengths))
    return make_scene(recipe, 3, 6.0)


def sampled(scene: Scene, count: int = 120_000) -> tuple[np.ndarray, ...]:
    """Random points, their change of height, and whether anything at all differs."""
    rng = np.random.default_rng(8)
    x, y = rng.uniform(-scene.size / 2, scene.size / 2, (2, count))
    before, after = scene.reference.seafloor, scene.moving.seafloor
    z0, c0, _ = before.evaluate(x, y)
    z1, c1, _ = after.evaluate(x, y)
    return x, y, z1 - z0, (z0 != z1) | (c0 != c1).any(axis=1)


def within(polygons: list, scene: Scene, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    spots = np.stack([x, y], axis=1) + scene.moving.distortion.centre[:2]
    inside = np.zeros(len(x), bool)
    for polygon in polygons:
        inside |= Outline(np.array(polygon)).contains_points(spots, radius=1e-3)
    return inside


def test_no_change_is_no_change():
    scene = scene_with()
    _, _, _, differs = sampled(scene)
    assert not differs.any()
    described = describe_change(scene)
    assert described["regions"] == []
    assert described["total"] == {"gain": 0.0, "loss": 0.0}


@pytest.mark.parametrize("name", THINGS)
def test_each_class_changes_its_polygons_and_nothing_else(name):
    scene = scene_with(**{name: 0.5})
    x, y, rise, differs = sampled(scene)
    described = describe_change(scene)
    regions = described["regions"]
    assert regions
    assert {c for region in regions for c in region["classes"]} == {name}
    polygons = [region["polygon"] for region in regions]
    if name == "sediment":  # the sand that was there rises or falls as well
        polygons += described["fields"]["sand"]["polygons"]
    inside = within(polygons, scene, x, y)
    assert not (differs & ~inside).any()
    # and most regions do show it (some lie under another thing)
    shows = [
        differs[within([region["polygon"]], scene, x, y)].any()
        for region in regions[:40]
        if within([region["polygon"]], scene, x, y).sum() > 5
    ]
    assert np.mean(shows) > 0.6
    # volumes agree with an independent Monte Carlo sum over the patch
    total, area = described["total"], 36.0
    gain, loss = np.maximum(rise, 0).mean() * area, np.maximum(-rise, 0).mean() * area
    noise = 4.0 * area * rise.std() / np.sqrt(len(rise)) + 1e-4
    assert total["gain"] == pytest.approx(gain, rel=0.15, abs=noise)
    assert total["loss"] == pytest.approx(loss, rel=0.15, abs=noise)


@pytest.mark.parametrize("site", [EVERYTHING, SITES["low_reef"]], ids=["everything", "low reef"])
def test_sand_in_cracks_narrower_than_a_cell_is_within_the_polygons(site):
    recipe = replace(load("severity_00"), site=site, change=Change(sediment=0.5))
    scene = make_scene(recipe, 4, 6.0)
    x, y, rise, differs = sampled(scene, 300_000)
    described = describe_change(scene)
    polygons = [region["polygon"] for region in described["regions"]]
    sand = described["fields"]["sand"]["polygons"]
    assert not (differs & ~within(polygons + sand, scene, x, y)).any()
    # and they do not simply take in all
    inside = within(sand, scene, x, y)
    assert inside.mean() < 0.9
    assert (np.abs(rise[inside]) > 1e-3).mean() > 0.2


def test_ripples_change_the_sand_alone():
    scene = scene_with(ripples=1.0)
    x, y, rise, differs = sampled(scene)
    described = describe_change(scene)
    assert described["regions"] == []
    sand = within(described["fields"]["sand"]["polygons"], scene, x, y)
    assert not (differs & ~sand).any()
    assert differs[sand].mean() > 0.3
    assert 0.001 < np.abs(rise[differs]).mean() < 0.05


def test_texture_changes_color_everywhere_and_relief_by_the_size_of_rubble():
    scene = scene_with(texture=0.7)
    _, _, rise, differs = sampled(scene)
    assert np.abs(rise).max() < 0.06
    assert np.abs(rise).mean() < 0.006
    assert abs(rise.mean()) < 0.001
    bare = scene.reference.seafloor.features["kind"]
    assert len(bare)
    assert differs.mean() > 0.4
    assert describe_change(scene)["fields"] == {"texture": {"strength": 0.7}}


def test_texture_strength_is_decorrelation():
    site = replace(SITES["reef"], massive=0, branching=0, plate=0, encrusting=0, soft=0, sponge=0)
    floor = make_seafloor(replace(site, urchin=0.0), 5, BOUNDS)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-3.9, 3.9, (2, 60_000))
    likeness = []
    for strength in (0.0, 0.3, 0.6, 0.9, 1.0):
        after, _ = apply_change(floor, site, 5, Change(texture=strength))
        a, b = (f.evaluate(x, y)[1].mean(axis=1) for f in (floor, after))
        likeness.append(np.corrcoef(a, b)[0, 1])
    assert likeness[0] == pytest.approx(1.0)
    assert (np.diff(likeness) < -0.01).all()
    assert likeness[-1] < 0.5


@pytest.mark.parametrize("name", ["bleaching", "mortality", "breakage", "partial_mortality"])
def test_strength_is_the_share_of_corals(name):
    floor = make_seafloor(SITES["reef"], 6, (-12.0, -12.0, 12.0, 12.0))
    corals = floor.features[np.isin(floor.features["kind"], t.CORALS)]
    living = (corals["dead"] < 1.0).sum()
    _, events = apply_change(floor, SITES["reef"], 6, Change(**{name: 0.4}))
    changed = sum(name in event.classes for event in events)
    assert changed / living == pytest.approx(0.4, abs=0.07)


def test_stronger_change_includes_the_weaker():
    floor = make_seafloor(SITES["reef"], 6, BOUNDS)
    weak, strong = (
        {
            (event.id, name)
            for event in apply_change(floor, SITES["reef"], 6, Change(**every))[1]
            for name in event.classes
            if name in ("bleaching", "mortality", "breakage")
        }
        for every in ({"bleaching": 0.2, "mortality": 0.1}, {"bleaching": 0.6, "mortality": 0.1})
    )
    assert weak < strong


def test_growth_grows_at_the_pace_of_its_kind():
    floor = make_seafloor(SITES["reef"], 7, (-12.0, -12.0, 12.0, 12.0))
    after, _ = apply_change(floor, SITES["reef"], 7, Change(growth=0.5))
    old, new = floor.features, after.features
    np.testing.assert_array_equal(old["id"], new["id"])
    for kind, pace in ((t.PLATE, 0.055), (t.MASSIVE, 0.010)):
        one = (old["kind"] == kind) & (old["dead"] == 0)
        grown = (new["radius"] - old["radius"])[one]
        assert grown.min() > 0
        assert grown.mean() == pytest.approx(pace, rel=0.25)


def test_bleached_colonies_are_white():
    floor = make_seafloor(SITES["reef"], 6, BOUNDS)
    after, events = apply_change(floor, SITES["reef"], 6, Change(bleaching=1.0))
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-3.9, 3.9, (2, 100_000))
    _, before_color, winner = floor.evaluate(x, y)
    _, after_color, _ = after.evaluate(x, y)
    white = np.zeros(len(floor.features) + 1, bool)
    white[:-1] = np.isin(floor.features["id"], [e.id for e in events])
    on = white[winner] & (winner >= 0)
    living = on & (np.abs(after_color - before_color).max(axis=1) > 0)
    assert living.sum() > 1000
    mean = after_color[living].mean(axis=0)
    assert mean.min() > 0.35
    assert mean.max() / mean.min() < 1.5
    assert (before_color[living].mean(axis=0) < mean).all()


def test_strength_outside_its_range_is_refused():
    with pytest.raises(UsageError, match=r"change.mortality is 1.5"):
        Change(mortality=1.5)
