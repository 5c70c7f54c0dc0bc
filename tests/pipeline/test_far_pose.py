"""A turn or a scale beyond the search is named, and nothing is named on unrelated ground."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest
import seafloor

from meshreg.judge.judging import Judgement
from meshreg.judge.verdict import Found, findings, last_word
from meshreg.pipeline.far_pose import far_pose
from meshreg.records import Finding
from meshreg.settings import SearchSettings

HALF = 6.0


def pair(yaw=0.0, scale=1.0, seed=None):
    floor = seafloor.Seafloor.random(5, size=26)
    later = floor.changed(6, 0.2) if seed is None else seafloor.Seafloor.random(seed, size=26)
    later = later.moved(1.1, -0.7, math.radians(yaw))
    sizes = {n: getattr(later, n) * scale for n in ("east", "north", "radius", "height")}
    later = dataclasses.replace(later, **sizes)
    still = floor.raster(0.2, HALF, seed=1)
    return {"dem": (still, later.raster(0.2, HALF * scale, seed=2, gain=0.8))}


@pytest.mark.parametrize("yaw", [25.0, -137.0])
def test_a_far_turn_is_named(yaw):
    said = far_pose(pair(yaw=yaw), 5.0, SearchSettings()).text
    assert float(re.search(r"about ([+-]\d+)°", said)[1]) == pytest.approx(yaw, abs=5.0)


def test_a_far_scale_is_named():
    said = far_pose(pair(scale=0.8), 5.0, SearchSettings()).text
    assert float(re.search(r"about ([\d.]+) times", said)[1]) == pytest.approx(0.8, abs=0.04)


@pytest.mark.parametrize("seed", [50, 51])
def test_unrelated_ground_has_no_name(seed):
    assert far_pose(pair(seed=seed), 5.0, SearchSettings()) is None


@pytest.mark.parametrize(("yaw", "scale"), [(5.0, 1.0), (-9.0, 1.0), (0.0, 1.035)])
def test_what_was_searched_has_no_name(yaw, scale):
    """A turn that the search missed is not one further than is searched."""
    assert far_pose(pair(yaw=yaw, scale=scale), 5.0, SearchSettings()) is None


def test_a_far_turn_takes_the_place_of_a_reason_that_it_explains():
    lost = Judgement("rejected", "no offset stands out; another place", None)
    said = last_word(lost, findings(Found(far=Finding("turned", "turned by about +25°"))))
    assert (said.verdict, said.reason) == ("rejected", "turned by about +25°")
