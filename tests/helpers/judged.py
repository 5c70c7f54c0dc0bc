"""Rasters of one seafloor twice, and what the judge says of them."""

from __future__ import annotations

import functools

import seafloor

from meshreg.judge.judging import judge
from meshreg.offsets import estimate_offsets
from meshreg.settings import Settings

OFFSET = (1.237, -2.412)
SETTINGS = Settings().changed({"methods": "terrain,mutual_information", "search.radius": 5.0})


@functools.cache
def pair(seed, change=0.4, **kind):
    return seafloor.rasters(seed, OFFSET, change=change, half=7.0, size=20.0, **kind)


def verdict(rasters, settings=SETTINGS):
    estimates = estimate_offsets(rasters, settings)
    return judge(estimates, rasters, settings, settings.search.radius)
