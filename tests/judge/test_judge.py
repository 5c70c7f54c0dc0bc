"""The verdict: right pairs accepted, wrong ones never."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from judged import OFFSET, SETTINGS, pair, verdict
from scipy import ndimage

from meshreg.judge.judging import TURN_NAMES, agree_distance, channel_map, judge, relief_of
from meshreg.offsets.neutral import fields
from meshreg.records import Grid, OffsetEstimate, SurveyRaster
from meshreg.settings import Settings


def swapped_moving(rasters, change):
    return {name: (a, change(b)) for name, (a, b) in rasters.items()}


@pytest.mark.parametrize("change", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_true_pairs_are_accepted_and_right(seed, change):
    judged = verdict(pair(seed, change))
    assert judged.verdict == "accepted", judged.reason
    assert np.hypot(judged.best.east - OFFSET[0], judged.best.north - OFFSET[1]) < 0.06
    assert judged.false_alarm < 1e-6


@pytest.mark.parametrize("seed", range(8))
def test_another_place_is_rejected(seed):
    """Same footprint, depth and coordinates; only the seafloor differs."""
    here, there = pair(seed), pair(seed + 100)
    judged = verdict({name: (here[name][0], there[name][1]) for name in here})
    assert judged.verdict == "rejected"
    assert "stands out from chance" in judged.reason
    assert judged.false_alarm > 1e-4


def test_channels_that_contradict_are_reviewed():
    """Terrain of one offset under an image of another: nothing to accept."""
    rasters = dict(pair(4, 0.1))
    reference, moving = rasters["ortho"]
    grid = dataclasses.replace(moving.grid, west=moving.grid.west - 1.0)
    rasters["ortho"] = (reference, dataclasses.replace(moving, grid=grid))
    judged = verdict(rasters)
    assert judged.verdict == "review"
    assert "contradict" in judged.reason
    assert len(judged.hypotheses) >= 2
    # both are offered, 1 m apart
    gap = judged.hypotheses[0].east - judged.hypotheses[1].east
    assert abs(gap) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("name", ["mirrored east-west", "turned by 180°"])
def test_mirrored_and_turned_surveys_are_named(name):
    turn, flip = next(k for k, v in TURN_NAMES.items() if v == name)

    def change(raster: SurveyRaster) -> SurveyRaster:
        def turned(array):
            array = np.rot90(array, turn)
            return np.fliplr(array) if flip else array

        return dataclasses.replace(raster, height=turned(raster.height), color=turned(raster.color))

    judged = verdict(swapped_moving(pair(5, 0.1), change))
    assert judged.verdict == "rejected"
    assert name in judged.reason
    assert "axes" in judged.reason


def test_terrain_alone_may_be_overwhelming():
    def grey(raster):
        return dataclasses.replace(raster, color_valid=np.zeros(raster.grid.shape, bool))

    rasters = {name: (grey(a), grey(b)) for name, (a, b) in pair(6, 0.2).items()}
    judged = verdict(rasters)
    assert judged.verdict == "accepted"
    assert "overwhelming" in judged.reason
    assert np.hypot(judged.best.east - OFFSET[0], judged.best.north - OFFSET[1]) < 0.06


def test_periodic_ground_is_not_accepted_at_the_wrong_crest():
    """Perfect ripples fit at every wavelength: no answer may be accepted."""

    def rippled(raster: SurveyRaster, phase: float, seed: int) -> SurveyRaster:
        rows, cols = raster.grid.shape
        east, _ = raster.grid.east_north(0, np.arange(cols))
        wave = np.sin(2 * np.pi * (east + phase) / 0.7)
        rng = np.random.default_rng(seed)
        height = 0.05 * wave[None, :] + rng.normal(0, 0.005, (rows, cols))
        color = np.clip(110 + 40 * wave[None, :, None] + rng.normal(0, 4, (rows, cols, 3)), 0, 255)
        return dataclasses.replace(raster, height=height, color=color.astype(np.uint8))

    rasters = {name: (rippled(a, 0.0, 1), rippled(b, 0.3, 2)) for name, (a, b) in pair(7).items()}
    assert verdict(rasters).verdict != "accepted"


def test_a_wrong_candidate_does_not_win():
    """A method that shouts a wrong offset is outvoted by the evidence."""
    rasters = pair(1, 0.3)
    shout = OffsetEstimate("sift", "ok", "", -3.0, 3.0, np.eye(2) * 1e-8, 1.0, 99.0)
    judged = judge([shout], rasters, SETTINGS, 5.0)
    assert judged.verdict == "accepted"
    assert np.hypot(judged.best.east - OFFSET[0], judged.best.north - OFFSET[1]) < 0.06
    assert "sift" not in judged.best.methods


def test_small_overlap_is_not_accepted_silently():
    reference, _ = pair(1)["dem"]
    grid = dataclasses.replace(reference.grid, west=reference.grid.west + 200.0)
    moving = dataclasses.replace(reference, grid=grid)
    judged = judge([], {"dem": (reference, moving), "ortho": (reference, moving)}, SETTINGS, 5.0)
    assert judged.verdict == "rejected"
    assert "overlap" in judged.reason


def test_null_gaps_are_exponential_in_their_scale():
    """Over unrelated pairs, gap / null_gap exceeds x about as often as exp(-x)."""
    ratios = []
    for seed in range(12):
        reference, other = pair(seed)["dem"][0], pair(seed + 50)["dem"][1]
        found = channel_map(reference, other, "terrain", 5.0, 0.3)
        ratios.append(found.peak.gap / found.null_gap)
    assert 0.3 < np.mean(ratios) < 1.8
    assert max(ratios) < 6


def test_the_joined_offset_lies_among_its_members():
    """Two long, slanted ellipses cross far outside both centres; their mean must not go there."""
    rasters = pair(2, 0.2)
    slanted = np.array([[0.0601, 0.06], [0.06, 0.0601]])
    across = np.array([[0.0601, -0.06], [-0.06, 0.0601]])
    told = [
        OffsetEstimate("sift", "ok", "", OFFSET[0] + 0.05, OFFSET[1], slanted, 1.0, 9.0),
        OffsetEstimate("terrain", "ok", "", OFFSET[0] - 0.05, OFFSET[1], across, 1.0, 9.0),
    ]
    judged = judge(told, rasters, SETTINGS, 5.0)
    assert {"sift", "terrain"} <= set(judged.best.methods)
    assert abs(judged.best.east - OFFSET[0]) < 0.06
    assert abs(judged.best.north - OFFSET[1]) < 0.06


def flattened(raster: SurveyRaster, height: float, seed: int) -> SurveyRaster:
    """Bare ground: hummocks of `height` [m] that do not stay in their place, and grey grain."""
    rng = np.random.default_rng(seed)
    shape = raster.grid.shape
    hummocks = ndimage.gaussian_filter(rng.normal(size=shape), 2.0)
    grain = ndimage.gaussian_filter(rng.normal(size=shape), 1.0)
    color = np.clip(120 + 60 * grain, 0, 255).astype(np.uint8)
    return dataclasses.replace(
        raster,
        height=height * hummocks / hummocks.std(),
        color=np.repeat(color[..., None], 3, axis=2),
    )


@pytest.mark.parametrize(("height", "expected"), [(0.015, "review"), (0.15, "rejected")])
@pytest.mark.parametrize("seed", [1, 2])
def test_flat_ground_is_not_taken_for_another_place(seed, height, expected):
    """Where all that is there is mobile, nothing fits: on sand that does not mean elsewhere."""
    pairs = pair(seed)
    rasters = {
        name: (flattened(a, height, 10 * seed), flattened(b, height, 10 * seed + 1))
        for name, (a, b) in pairs.items()
    }
    judged = verdict(rasters)
    assert judged.verdict == expected
    said = "reference survey is flat" in judged.reason and "moving survey is flat" in judged.reason
    assert said == (expected == "review")
    # one flat survey is enough: the bedforms of the other may have come since
    mixed = verdict({name: (pairs[name][0], rasters[name][1]) for name in rasters})
    assert mixed.verdict == expected
    assert "reference survey is flat" not in mixed.reason


def test_relief_is_the_range_about_the_surroundings():
    raster = pair(1)["dem"][0]
    rows, cols = np.indices(raster.grid.shape)
    tilted = 3.0 + 0.05 * rows - 0.02 * cols  # a slope is no relief
    plain = dataclasses.replace(raster, height=tilted, valid=np.ones(rows.shape, bool))
    assert relief_of(plain) < 1e-5  # heights are float32
    bumps = dataclasses.replace(plain, height=tilted + 0.2 * ((rows + cols) % 2))
    assert relief_of(bumps) == pytest.approx(0.2, rel=0.03)
    assert relief_of(dataclasses.replace(plain, valid=rows < 0)) == 0.0


@pytest.mark.parametrize(("down", "across"), [(True, False), (False, True), (True, True)])
def test_exchanged_parts_lie_where_the_steps_say(down, across):
    """Every cell of the exchanged fields is a cell of the former ones, one of the steps away."""
    raster = pair(1)["dem"][1]
    mask = np.zeros(raster.grid.shape, bool)
    mask[7:108, 11:140] = True  # odd and even; not the whole grid
    before = fields(dataclasses.replace(raster, valid=raster.valid & mask), "terrain")
    after, steps = before.exchanged(down, across)
    assert len(steps) == 2 ** (down + across)
    assert (0, 0) not in steps
    sources = np.zeros(mask.shape, int)
    for row, col in steps:
        sources += shifted(before.mask, row, col) & (
            shifted(before.parts[0][0], row, col) == after.parts[0][0]
        )
    assert (sources[after.mask] == 1).mean() > 0.99
    assert after.mask.sum() == before.mask.sum()


def shifted(array, row, col):
    """The array moved by whole cells; what comes from outside is zero."""
    moved = np.zeros_like(array)
    height, width = array.shape
    moved[max(row, 0) : height + min(row, 0), max(col, 0) : width + min(col, 0)] = array[
        max(-row, 0) : height - max(row, 0), max(-col, 0) : width - max(col, 0)
    ]
    return moved


def test_chance_is_measured_without_the_true_match():
    """Exchanged halves of a true pair still match in part, further off: that is not chance."""
    for seed in (1, 2, 3):
        for channel, name in (("terrain", "dem"), ("image", "ortho")):
            found = channel_map(*pair(seed, 0.1)[name], channel, 5.0, 0.1)
            assert found.peak.gap > 10
            assert len(found.exchanged) == 3
            assert max(found.exchanged) < 3


@pytest.mark.parametrize(
    ("half", "cell", "expected"),
    [(7.0, 0.1, 0.25), (0.25, 0.002, 0.025), (0.25, 0.02, 0.05), (300.0, 1.0, 2.5)],
    ids=["reef", "quadrat", "coarse quadrat", "beach"],
)
def test_on_a_small_plot_places_that_agree_lie_nearer(half, cell, expected):
    """A quarter of a metre is half of a quadrat of 0.5 m."""
    flat = np.zeros((round(2 * half / cell), round(3 * half / cell)), np.float32)
    one = SurveyRaster(
        Grid(0.0, 0.0, cell, flat.shape, None), flat, np.zeros((*flat.shape, 3), np.uint8),
        np.ones(flat.shape, bool), np.ones(flat.shape, bool), np.ones(flat.shape, np.uint16),
    )  # fmt: skip
    assert agree_distance(Settings().judge, (one, one)) == pytest.approx(expected)
