"""Tiles alone: sub-cell steps on a grid of tenths of a cell, in both directions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import seafloor
from scipy import ndimage

from meshreg.records import Grid
from meshreg.refine.tile_kernels import polish
from meshreg.refine.tiles import Overlap, Relief, correlated_tiles, polished_tiles

CELL = 0.1


def polished(reference, moving, offset=(0.0, 0.0), guess=np.zeros_like):
    return polished_tiles(Relief.of(reference), Relief.of(moving), np.array(offset), guess)


@pytest.mark.parametrize("tenths", [(0, 0), (1, 9), (3, -4), (5, 5), (-7, 2), (9, -9)])
def test_tenths_of_a_cell(tenths):
    """Every tile reads a shift of tenths of a cell to a thirtieth of a cell, nearly all better."""
    east, north = (t * CELL / 10 for t in tenths)
    floor = seafloor.Seafloor.random(3, size=16.0)
    reference = floor.raster(CELL, 5.0, noise=0.0)
    moving = floor.moved(-east, -north).raster(CELL, 5.0, noise=0.0, up=0.2)
    found = polished(reference, moving)
    error = np.abs(found.offsets - (east, north))
    assert error.max() < 0.033 * CELL
    assert np.median(error) < 0.005 * CELL


def test_a_survey_onto_itself_does_not_move_at_all():
    reference = seafloor.Seafloor.random(3, size=16.0).raster(CELL, 5.0)
    found = polished(reference, reference)
    assert np.abs(found.offsets).max() < 1e-9


def test_heights_biased_in_proportion_to_themselves_do_not_drift():
    """A vertical scale error of 1 % shifts Nuth and Kääb; the offset must not follow it."""
    floor = seafloor.Seafloor.random(4, size=16.0)
    reference = floor.raster(CELL, 5.0, noise=0.0)
    moving = floor.moved(-0.03, 0.04).raster(CELL, 5.0, noise=0.0)
    stretched = dataclasses.replace(moving, height=1.01 * moving.height)
    plain, biased = (polished(reference, m) for m in (moving, stretched))
    assert np.abs(biased.offsets.mean(axis=0) - plain.offsets.mean(axis=0)).max() < 0.002 * CELL


def test_disturbed_starts_end_at_one_answer():
    floor = seafloor.Seafloor.random(5, size=16.0)
    reference = floor.raster(CELL, 5.0, seed=1)
    moving = floor.changed(6, 0.3).moved(-0.02, 0.01).raster(CELL, 5.0, seed=2)
    answers = []
    for start in ((0.0, 0.0), (0.08, -0.05), (-0.06, 0.07)):
        answer = np.array(start)
        for _ in range(4):
            found = polished(reference, moving, answer, lambda places, a=answer: a + 0 * places)
            answer = np.median(found.offsets, axis=0)
        answers.append(answer)
    assert np.ptp(answers, axis=0).max() < 0.02 * CELL


@pytest.mark.parametrize("channel", ["terrain", "image"])
def test_correlated_tiles_find_the_offset_from_afar(channel):
    floor = seafloor.Seafloor.random(7, size=16.0)
    reference = floor.raster(CELL, 5.0, seed=1)
    moving = floor.moved(-1.23, 0.71).raster(CELL, 5.0, seed=2)
    found = correlated_tiles(reference, moving, channel, (1.3, -0.6))
    error = np.median(found.offsets, axis=0) - (1.23, -0.71)
    assert np.abs(error).max() < 0.1 * CELL
    assert len(found.offsets) >= 12


def test_overlap_is_the_cells_that_meet():
    reference, moving = Grid(0, 0, 1.0, (10, 12)), Grid(3, -2, 1.0, (10, 12))
    overlap = Overlap.at(reference, moving, (-1.0, 0.0))
    # moved one cell west, the moving grid starts at column 2 and row 2 of the reference
    assert overlap.shift == (2, 2)
    assert overlap.rows == (0, 8)
    assert overlap.cols == (0, 10)
    assert overlap.offset == (-1.0, 0.0)
    assert Overlap.at(reference, moving, (40.0, 0.0)).side <= 0


def test_tiles_without_ground_are_left_out():
    floor = seafloor.Seafloor.random(8, size=16.0)
    reference = floor.raster(CELL, 5.0)
    hole = np.ones(reference.grid.shape, bool)
    hole[:, :50] = False
    moving = dataclasses.replace(
        reference, height=np.where(hole, reference.height, np.nan), valid=hole
    )
    found = polished(reference, moving)
    assert (found.places[:, 0] > -0.5).all()
    assert len(found.places) >= 12


def fitted_slowly(still, moved, place):
    """What `tile_kernels` does to one tile, in NumPy, SciPy and one loop.

    `place` (N, 4): row and column in the moving survey, and where the cell is bent to [m].
    """
    row, col = place[:, :2].T.astype(int)
    field, _, d_east, d_north, _ = moved.layers
    value, slope = field[row, col], np.stack([d_east, d_north], axis=-1)[row, col]
    offset = np.zeros(2)
    for _ in range(15):
        at = np.stack(still.grid.row_col(*(place[:, 2:] + offset).T))
        near = np.rint(at).astype(int)
        inside = ((near >= 0) & (near < np.array(still.grid.shape)[:, None])).all(axis=0)
        inside[inside] = still.mask[tuple(near[:, inside])]
        if inside.sum() < 0.5 * len(place):
            return np.full(4, np.nan)
        at = at[:, inside]
        residual = ndimage.map_coordinates(still.layers[1], at, order=3, prefilter=False)
        residual -= value[inside]
        other = [ndimage.map_coordinates(still.layers[k], at, order=1) for k in (2, 3)]
        design = 0.5 * (slope[inside] + np.stack(other, axis=1))
        spread = 1.4826 * np.median(np.abs(residual - np.median(residual)))
        weight = np.clip(1 - (residual / (4 * spread)) ** 2, 0, None) ** 2
        normal = (design * weight[:, None]).T @ design
        if np.linalg.cond(normal) >= 1e4:
            return np.full(4, np.nan)
        variance = np.average(residual**2, weights=weight) * np.diag(np.linalg.inv(normal))
        step = -np.linalg.solve(normal, (design * weight[:, None]).T @ residual)
        offset += step
        if np.abs(step).max() < 1e-7:
            break
    close = np.hypot(*offset) <= 3 * still.grid.cell and np.abs(step).max() < 1e-2 * CELL
    return np.append(offset, variance) if close else np.full(4, np.nan)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_kernel_does_what_its_twin_does(seed):
    """On changed ground with holes, from starts that are off, some of them hopelessly."""
    rng = np.random.default_rng(seed)
    floor = seafloor.Seafloor.random(seed, size=16.0)
    still = floor.raster(CELL, 5.0, seed=1)
    moved = floor.changed(seed + 1, 0.5).moved(-0.02, 0.01).raster(CELL, 4.5, seed=2)
    still = dataclasses.replace(still, valid=still.valid & (rng.random(still.valid.shape) > 2e-3))
    one, other = Relief.of(still), Relief.of(moved)
    parts = []
    for _ in range(40):
        top, left = rng.integers(0, 60, 2)
        row, col = np.nonzero(other.mask[top : top + 16, left : left + 16])
        row, col = row + top, col + left
        east, north = moved.grid.east_north(row, col)
        away = rng.normal(0, rng.choice([0.02, 0.1, 0.5]), 2)
        parts.append(np.column_stack([row, col, east + away[0], north + away[1]]))
    bounds = np.cumsum([0, *map(len, parts)])
    corner = np.array([still.grid.west, still.grid.north])
    sizes = np.full(len(parts), 256)
    found = polish(one.layers, other.layers, np.concatenate(parts), bounds, sizes, corner, CELL)
    expected = np.array([fitted_slowly(one, other, part) for part in parts])
    full = np.diff(bounds) >= 128
    assert np.isnan(found[~full]).all()
    np.testing.assert_array_equal(np.isnan(found[full]), np.isnan(expected[full]))
    assert np.isfinite(found).any(axis=1).sum() >= 10
    np.testing.assert_allclose(found[full], expected[full], rtol=0, atol=1e-7)


def test_flat_ground_beside_it_does_not_change_the_relief():
    """A sea of no relief, seen by one survey: what is asked of the rock stays as it was."""
    rock = seafloor.Seafloor.random(3, size=16.0).raster(CELL, 5.0, noise=0.0)
    rows, cols = rock.grid.shape
    sea = np.full((rows, 3 * cols), rock.height.min(), np.float32)
    sea[:, :cols] = rock.height
    valid = np.ones(sea.shape, bool)
    grid = dataclasses.replace(rock.grid, shape=sea.shape)
    color, samples = np.zeros((*sea.shape, 3), np.uint8), np.ones(sea.shape, np.uint16)
    both = dataclasses.replace(
        rock, grid=grid, height=sea, valid=valid, color=color, color_valid=valid, samples=samples
    )
    inland = np.s_[:, :, : cols - 12]
    alone, beside = Relief.of(rock).layers[inland], Relief.of(both).layers[inland]
    np.testing.assert_allclose(beside[[0, 2, 3]], alone[[0, 2, 3]], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(beside[4][:, 3:], alone[4][:, 3:])
