"""Meshes and clouds of bumps, delivered with a motion that is known exactly."""

from __future__ import annotations

import functools

import numpy as np
import seafloor

from meshreg import Mesh, PointCloud, Settings, Survey, apply_transform
from meshreg.records import Transform

OFFSET = np.array([1.337, -2.412, 0.083])
QUICK = Settings().changed({"search.radius": 5.0})


def survey(floor, half=6.0, step=0.04, seed=0, name="survey", cloud=False):
    """A jittered grid mesh (or cloud) of bumps, colored per vertex, around (0, 0)."""
    rng = np.random.default_rng(seed)
    n = round(2 * half / step)
    raster = floor.raster(step, half, noise=0.0, seed=seed)
    row, col = np.mgrid[0:n, 0:n]
    east, north = raster.grid.east_north(row, col)
    # heights noisy by a millimetre; the places stay on the lattice, where the bumps were summed
    up = raster.height + rng.normal(0, 0.001, raster.height.shape)
    points = np.stack([east, north, up], axis=-1).reshape(-1, 3)
    colors = raster.color.reshape(-1, 3)
    if cloud:
        return Survey(name, PointCloud(points, colors))
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate(
        [np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)]
    )
    return Survey(name, Mesh(points, faces, colors))


@functools.cache
def floors(change=0.2):
    floor = seafloor.Seafloor.random(11, size=18.0)
    return floor, floor.changed(12, change)


def displaced(before, yaw=0.0, at=(0.0, 0.0, 0.0)):
    """Deliver a survey with the inverse of a known reference_from_moving."""
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    truth = Transform(rotation, 1.0, OFFSET, at)
    return apply_transform(before, truth.inverse()), truth
