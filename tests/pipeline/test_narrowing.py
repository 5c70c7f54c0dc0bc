"""A large window is looked at in coarse cells first, with the answer of the whole search."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import seafloor

from meshreg.offsets.correlate import Window
from meshreg.pipeline import decision as deciding
from meshreg.pipeline.narrowing import cut, elsewhere, narrowing, places
from meshreg.settings import SearchSettings, Settings

OFFSET = np.array([13.4, -10.8])
RADIUS = 25.0
SETTINGS = Settings().changed(
    {
        "search.radius": RADIUS,
        "raster.dem_cell": 0.2,
        "raster.ortho_cell": 0.1,
        "raster.sift_cell": 0.1,
        "methods": ["terrain", "mutual_information"],
        "search.max_yaw": 0,
        "search.max_scale": 0,
    }
)


@functools.cache
def pair(seed=None, twice=False):
    """A plot of 10 m in a reference of 50 m: OFFSET off, or (`seed`) of another place."""
    floor = seafloor.Seafloor.random(4, size=54.0)
    later = floor.changed(5, 0.2) if seed is None else seafloor.Seafloor.random(seed, size=20.0)
    if seed is None:
        later = later.moved(*-OFFSET)
    made = {}
    for name, cell in (("dem", 0.2), ("ortho", 0.1)):
        still = floor.raster(cell, 25.0, seed=1)
        if twice:  # the same ground again, elsewhere
            rows, cols = (int(4 / cell), int(6 / cell))
            part = [np.copy(getattr(still, n)) for n in ("height", "color")]
            size = int(14 / cell)
            row, col = (int(v) for v in still.grid.row_col(OFFSET[0] - 7, OFFSET[1] + 7))
            for array in part:
                array[rows : rows + size, cols : cols + size] = array[
                    row : row + size, col : col + size
                ]
            still = dataclasses.replace(still, height=part[0], color=part[1])
        made[name] = still, later.raster(cell, 5.0, seed=2, gain=0.8)
    made["sift"] = made["ortho"]
    return made


def grids(pairs, name):
    return tuple(raster.grid for raster in pairs[name])


def both_ways(pairs, monkeypatch):
    """Decide with every offset looked at, and coarse cells first."""
    monkeypatch.setattr(deciding, "narrowing", lambda dem, ortho, radius: 1)
    whole = deciding.decide(pairs, SETTINGS, RADIUS)
    monkeypatch.setattr(deciding, "narrowing", lambda dem, ortho, radius: 1 + 1)
    return whole, deciding.decide(pairs, SETTINGS, RADIUS)


def test_a_true_pair_has_the_answer_of_the_whole_search(monkeypatch):
    whole, coarse = both_ways(pair(), monkeypatch)
    assert whole.judgement.verdict == coarse.judgement.verdict == "accepted"
    np.testing.assert_allclose(coarse.refined.offset, OFFSET, atol=0.02)
    np.testing.assert_allclose(coarse.refined.offset, whole.refined.offset, atol=0.005)
    assert [e.status for e in coarse.estimates] == [e.status for e in whole.estimates]
    assert any("in cells of 0.4 m first" in note for note in coarse.notes)
    assert not any("first" in note for note in whole.notes)


@pytest.mark.parametrize("seed", [50])
def test_another_place_stays_rejected(seed, monkeypatch):
    whole, coarse = both_ways(pair(seed), monkeypatch)
    assert whole.judgement.verdict == coarse.judgement.verdict == "rejected"


def test_ground_that_lies_in_two_places_is_accepted_in_neither(monkeypatch):
    """The second place is outside of the window about the first, and is remembered all the same."""
    whole, coarse = both_ways(pair(twice=True), monkeypatch)
    assert whole.judgement.verdict != "accepted"
    assert coarse.judgement.verdict != "accepted"
    assert max(coarse.judgement.best.gaps.values()) < SETTINGS.judge.accept_gap


def test_the_true_place_is_among_few_and_the_cut_holds_it():
    pairs = pair()
    found = places(pairs, SearchSettings(), RADIUS, 2)
    assert 1 <= len(found) <= 6
    assert min(np.hypot(*(np.array(place) - OFFSET)) for place in found) < 0.5
    near = cut(pairs, tuple(OFFSET), 12.0)
    for name, (still, moving) in near.items():
        assert still.grid.shape[0] * still.grid.cell < 36
        window = Window.around(still.grid, moving.grid, RADIUS)
        assert window.east.min() < OFFSET[0] - 10 < OFFSET[0] + 10 < window.east.max()
        # what is left of the reference lies where it lay
        full = pairs[name][0]
        row, col = full.grid.row_col(*still.grid.east_north(3, 4))
        assert still.height[3, 4] == full.height[round(float(row)), round(float(col))]


def test_only_what_gains_by_it_is_narrowed():
    """A default search, or one that reaches little further than the surveys, is left as it was."""
    floor = seafloor.Seafloor.random(1, size=2.0)
    grid = floor.raster(0.1, 0.5).grid

    def made(cell, size, at=0.0):
        n = round(size / cell)
        return dataclasses.replace(grid, west=at, north=size + at, cell=cell, shape=(n, n))

    def asked(large, small, radius):
        dem, ortho = ([made(c, s) for s in (large, small)] for c in (0.1, 0.05))
        return narrowing(tuple(dem), tuple(ortho), radius)

    assert asked(50, 50, 10) == 1
    assert asked(300, 300, 10) == 1
    assert asked(100, 12, 10) == 1
    assert asked(12, 12, 300) == 1
    assert 1 < asked(300, 12, 300) <= 3  # 32 cells across the small plot are left
    assert asked(300, 50, 300) > 1
    assert asked(300, 12, 300) == narrowing(
        (made(0.1, 12), made(0.1, 300)), (made(0.05, 12), made(0.05, 300)), 300
    )


def test_chance_grows_with_what_was_looked_through():
    pairs = pair()
    from meshreg.judge.judging import channel_maps

    here = channel_maps(cut(pairs, tuple(OFFSET), 5.0), RADIUS, chance=False)
    there = channel_maps(cut(pairs, (-12.0, 12.0), 5.0), RADIUS, chance=False)
    window = Window.around(*grids(pairs, "dem"), RADIUS)
    beyond = elsewhere(here, [there], window)
    area = min(channel.window.area for channel in here.values())
    assert beyond.times == pytest.approx(window.area / area, abs=1.0)
    for name, channel in there.items():
        assert beyond.values[name] == pytest.approx(channel.peak.value)
    assert elsewhere(here, [here], window).values == {}
