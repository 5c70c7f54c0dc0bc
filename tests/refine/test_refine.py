"""Tile offsets, yaw and covariance against a seafloor whose motion is known exactly."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
import seafloor

from meshreg.judge.verdict import MOST_UNDECIDED
from meshreg.pipeline.turned import as_delivered
from meshreg.records import Grid, SurveyRaster, Transform
from meshreg.refine.rigid import (
    Refined,
    blended,
    combined,
    fit,
    fit_overlap,
    misfit,
    refine,
    relief_height,
    with_scale,
)
from meshreg.refine.tiles import TileOffsets
from meshreg.statistics.kriging import Ground

OFFSET = (1.237, -2.412)
REEF = Path(__file__).parents[1] / "data" / "reef_dem" / "horseshoe_dem.tif"


@functools.cache
def refined(seed, change, yaw_deg):
    rasters = seafloor.rasters(
        seed, OFFSET, yaw=np.deg2rad(yaw_deg), change=change, half=8.0, size=22.0
    )
    used = [(*rasters["dem"], "terrain"), (*rasters["ortho"], "image")]
    return refine(used, (1.2, -2.45), np.eye(2) * 0.03**2, 0.25)


def truth_at(pivot, yaw):
    """Offset that lays `pivot` back where it came from: x = R(-yaw) (x' + offset)."""
    c, s = np.cos(-yaw), np.sin(-yaw)
    place = np.asarray(pivot) + OFFSET
    return np.array([[c, -s], [s, c]]) @ place - pivot


@pytest.mark.parametrize("yaw_deg", [0.0, 0.5, -0.8])
@pytest.mark.parametrize("change", [0.0, 0.3])
def test_offset_and_yaw(change, yaw_deg):
    result = refined(3, change, yaw_deg)
    yaw = np.deg2rad(yaw_deg)
    error = result.offset - truth_at(result.pivot, yaw)
    assert np.hypot(*error) < (0.008 if change == 0 else 0.012)
    # over eight such pairs the yaw errs by 0.032° rms
    assert abs(np.rad2deg(result.yaw) + yaw_deg) < (0.025 if change == 0 else 0.1)
    assert abs(result.yaw + yaw) < 2 * np.sqrt(result.covariance[2, 2])


@pytest.mark.parametrize("tenths", [(0, 0), (1, 7), (3, 3), (5, 5), (10, 5), (9, 10)])
def test_tenths_of_a_cell_on_a_real_reef(tenths):
    """Area means of a real reef's own 1 cm cells, so that the shift is exact."""
    import rasterio

    with rasterio.open(REEF) as file:
        fine = file.read(1).astype(np.float64)
    side = 79

    def raster(row, col):
        part = fine[row : row + 10 * side, col : col + 10 * side]
        height = part.reshape(side, 10, side, 10).mean(axis=(1, 3)).astype(np.float32)
        none = np.zeros(height.shape, bool)
        color, samples = np.zeros((*height.shape, 3), np.uint8), np.ones(height.shape, np.uint16)
        grid = Grid(0.0, 0.1 * side, 0.1, height.shape, None)
        return SurveyRaster(grid, height, color, ~none, none, samples)

    row, col = tenths
    pair = (raster(0, 0), raster(row, col), "terrain")
    found = refine([pair], (0.0, 0.0), np.eye(2) * 1e-4, 0.3)
    assert np.hypot(*(found.offset - 0.01 * np.array([col, -row]))) < 0.02 * 0.1


def test_insignificant_yaw_is_left_at_zero():
    assert refined(3, 0.3, 0.0).yaw == 0.0


def test_swapped_pair_gives_the_inverse():
    rasters = seafloor.rasters(4, OFFSET, yaw=np.deg2rad(0.5), change=0.2, half=8.0, size=22.0)
    there = refine([(*rasters["dem"], "terrain")], (1.2, -2.45), np.eye(2) * 0.03**2, 0.25)
    back = refine([(*rasters["dem"][::-1], "terrain")], (-1.2, 2.45), np.eye(2) * 0.03**2, 0.25)
    sigma = np.sqrt(there.covariance[2, 2] + back.covariance[2, 2])
    assert abs(there.yaw + back.yaw) < 3 * sigma
    c, s = np.cos(there.yaw), np.sin(there.yaw)
    place = np.array([2.0, 3.0])
    rotate = np.array([[c, -s], [s, c]])
    forth = there.pivot + there.offset + rotate @ (place - there.pivot)
    home = back.pivot + back.offset + rotate.T @ (forth - back.pivot)
    assert np.hypot(*(home - place)) < 0.02


def test_fit_ignores_wild_tiles():
    rng = np.random.default_rng(0)
    places = rng.uniform(-10, 10, (40, 2))
    pivot = places.mean(axis=0)
    arm = places - pivot
    offsets = np.array([0.3, -0.2]) + 0.006 * np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    offsets += rng.normal(0, 0.004, offsets.shape)
    offsets[::5] += rng.uniform(0.2, 0.5, (8, 2))
    tiles = TileOffsets(places, offsets, np.arange(40), np.zeros(40, int))
    result = fit(tiles, pivot)
    assert result.yaw == pytest.approx(0.006, abs=4e-4)
    np.testing.assert_allclose(result.offset, [0.3, -0.2], atol=0.004)
    assert (result.weights[::5] == 0).all()


def test_covariance_is_the_scatter():
    """The sandwich's sigma, over many draws, is what the answer scatters by."""
    rng = np.random.default_rng(1)
    places = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2) * 3
    pivot = places.mean(axis=0)
    answers, stated = [], []
    for _ in range(300):
        offsets = rng.normal(0, 0.02, (36, 2))
        both = TileOffsets(
            np.concatenate([places, places]),
            # the second channel errs exactly as the first: it must not halve the variance
            np.concatenate([offsets, offsets]),
            np.tile(np.arange(36), 2),
            np.repeat([0, 1], 36),
        )
        result = fit(both, pivot)
        answers.append([*result.offset, result.yaw])
        stated.append(np.diag(result.covariance))
    scatter, mean = np.var(np.array(answers), axis=0), np.mean(np.array(stated), axis=0)
    assert np.all((mean / scatter > 0.6) & (mean / scatter < 1.5))


def lattice(count, low, high):
    side = np.linspace(low, high, count)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def tiles_of_a_similarity(seed, scale, yaw, warp, noise=0.003):
    """Offsets of 7 × 7 tiles, 2 m apart, on ground that is scaled, turned and bent in waves.

    Also the ground, and the scale of the similarity that fits all of it best.
    """
    rng = np.random.default_rng(seed)
    places, ground = lattice(7, 0.0, 12.0), lattice(15, -0.5, 12.5)
    pivot = ground.mean(axis=0)
    waves = [
        (2 * np.pi / rng.uniform(3, 12) * np.array([np.cos(a), np.sin(a)]), p, rng.normal(0, 1, 2))
        for a, p in rng.uniform(0, 2 * np.pi, (12, 2))
    ]
    c, s = scale * np.cos(yaw), scale * np.sin(yaw)

    def offset(at):
        bent = sum(size * np.sin(at @ k + phase)[:, None] for k, phase, size in waves)
        plain = (at - pivot) @ (np.array([[c, -s], [s, c]]) - np.eye(2)).T + (0.3, -0.2)
        return plain + warp * bent / np.sqrt(6)

    arm, there = ground - pivot, ground + offset(ground)
    there = there - there.mean(axis=0)
    along = (arm * there).sum()
    across = (arm[:, 0] * there[:, 1] - arm[:, 1] * there[:, 0]).sum()
    best = np.hypot(along, across) / (arm**2).sum()
    offsets = offset(places) + rng.normal(0, noise, places.shape)
    tiles = TileOffsets(places, offsets, np.arange(49), np.zeros(49, int))
    refined = Refined(pivot, np.array([0.3, -0.2]), yaw, np.eye(3) * 1e-6, tiles)
    return refined, Ground(ground, np.full(len(ground), 1 / len(ground))), best


@pytest.mark.parametrize(
    ("scale", "yaw", "warp"), [(0.97, 0.012, 0.0), (1.02, -0.015, 0.0), (1.02, 0.0, 0.02)]
)
def test_scale_and_its_variance(scale, yaw, warp):
    """Over many draws the scale scatters about the truth by what is stated, `misfit` apart.

    Waves are smoother than the random field that the warp is taken for: there it says too much.
    """
    error, variance = [], []
    for seed in range(20):
        refined, ground, best = tiles_of_a_similarity(seed, scale, yaw, warp)
        if warp == 0:
            assert best == pytest.approx(scale, abs=1e-12)
        answer, found = with_scale(refined, ground)
        error.append(found - best)
        variance.append(answer.scale_variance)
    error, variance = np.array(error), np.array(variance)
    assert np.abs(error).max() < (0.0004 if warp == 0 else 0.002)
    ratio = variance.mean() / (error**2).mean() / misfit(refined.tiles)
    assert 0.6 < ratio < (1.9 if warp == 0 else 10.0)
    assert (error**2 < 9 * variance).all()


def test_scale_of_few_tiles_is_not_known():
    whole, ground, _ = tiles_of_a_similarity(0, 1.02, 0.0, 0.0)
    few = dataclasses.replace(whole, tiles=whole.tiles.only(np.arange(49) < 11))
    refined, scale = with_scale(few, ground)
    assert scale == 1.0
    assert np.sqrt(refined.scale_variance) == pytest.approx(0.0033, abs=1e-4)


def test_too_few_tiles_keep_the_judged_offset():
    rasters = seafloor.rasters(5, (0.1, 0.0), change=0.2, half=1.5, size=10.0)
    result = refine([(*rasters["dem"], "terrain")], (0.1, 0.0), np.eye(2) * 0.01**2, 0.25)
    np.testing.assert_array_equal(result.offset, [0.1, 0.0])
    assert result.yaw == 0.0
    assert "too few tiles" in result.note


def uniform_ground(inside, spacing=0.1, node=1.5):
    """Places that stand for all that `inside` (N, 2) -> (N,) bool holds to be seen by both."""
    axis = np.arange(-12.0, 12.0, spacing) + 0.5 * spacing
    places = np.stack([a.ravel() for a in np.meshgrid(axis, axis)], axis=1)
    places = places[inside(places)]
    _, number = np.unique(np.floor(places / node), axis=0, return_inverse=True)
    count = np.bincount(number.ravel())
    means = [np.bincount(number.ravel(), column) / count for column in places.T]
    return Ground(np.stack(means, axis=1), count / count.sum())


def bent(seed, size):
    """A warp with waves of 10 to 20 m that stretches by some per cent, and its inverse."""
    rng = np.random.default_rng(seed)
    waves = [
        (2 * np.pi / rng.uniform(10, 20) * np.array([np.cos(a), np.sin(a)]), p, rng.normal(0, 1, 2))
        for a, p in rng.uniform(0, 2 * np.pi, (5, 2))
    ]

    def there(places):
        return (0.7, -0.4) + size / np.sqrt(2.5) * sum(
            length * np.sin(places @ k + phase)[:, None] for k, phase, length in waves
        )

    def back(places):
        start = places.copy()
        for _ in range(15):
            start = places - there(start)
        return start - places

    return there, back, rng


@pytest.mark.parametrize("size", [0.03, 0.15])
def test_there_and_back_is_nothing_within_three_sigmas(size):
    """Each direction counts the ground as its own reference sees it, and says what it is worth."""
    largest = []
    for seed in range(12):
        there, back, rng = bent(seed, size)
        axis = np.linspace(-8, 8, 8)
        tiles = np.stack([a.ravel() for a in np.meshgrid(axis, axis)], axis=1)
        answers = []
        for offset in (there, back):
            noise = rng.normal(0, 0.001, tiles.shape)
            found = TileOffsets(tiles, offset(tiles) + noise, np.arange(64), np.zeros(64, int))

            def seen(places, offset=offset):
                return np.abs(places + offset(places)).max(axis=1) < 9

            ground = uniform_ground(lambda p, seen=seen: (np.abs(p).max(axis=1) < 9) & seen(p))
            answers.append(fit_overlap(found, ground, ground.share @ ground.places))
        first, second = answers
        home = first.pivot + first.offset
        arm = home - second.pivot
        returned = home + second.offset + second.yaw * np.array([-arm[1], arm[0]])
        lever = np.array([[1, 0, -arm[1]], [0, 1, arm[0]], [0, 0, 1]])
        covariance = first.covariance + lever @ second.covariance @ lever.T
        miss = np.append(returned - first.pivot, first.yaw + second.yaw)
        largest.append(np.abs(miss / np.sqrt(np.diag(covariance))).max())
    assert np.mean(np.array(largest) < 3) > 0.9
    assert max(largest) < 3.6
    assert np.median(largest) > 0.2


def rim(seed, bend):
    """Tiles that wave by 3 cm, and bend by `bend` [m] more towards the northern rim.

    Also the uniform best fit: east and north [m] at the ground's centroid, turn.
    """
    there, _, rng = bent(seed, 0.03)

    def offset(places):
        north = np.clip(places[:, 1] - 4.0, 0, None) / 5.0
        return there(places) + bend * north[:, None] ** 2 * (0.8, -0.6)

    axis = np.linspace(-8, 8, 8)
    places = np.stack([a.ravel() for a in np.meshgrid(axis, axis)], axis=1)
    offsets = offset(places) + rng.normal(0, 0.003, places.shape)
    tiles = TileOffsets(places, offsets, np.arange(64), np.zeros(64, int))
    dense = np.stack([a.ravel() for a in np.meshgrid(*[np.arange(-8.95, 9, 0.1)] * 2)], axis=1)
    x, y = dense.T
    one, none = np.ones_like(x), np.zeros_like(x)
    design = np.concatenate([np.stack([one, none, -y], 1), np.stack([none, one, x], 1)])
    best = np.linalg.lstsq(design, offset(dense).T.ravel(), rcond=None)[0]
    return tiles, uniform_ground(lambda p: np.abs(p).max(axis=1) < 9), best


def missed(tiles, ground, best):
    """Metres from the best fit, the same in sigmas, the sigma of east [m]."""
    found = fit_overlap(tiles, ground, np.zeros(2))
    miss, covariance = found.offset - best[:2], found.covariance[:2, :2]
    sigmas = np.sqrt(miss @ np.linalg.solve(covariance, miss))
    return float(np.hypot(*miss)), float(sigmas), float(np.sqrt(covariance[0, 0]))


def test_a_rim_that_bends_more_than_the_rest_counts_as_much():
    """Left out as if it had slid, it would move the answer by 2 mm in the median, not by 0.6."""
    away, sigmas, _ = np.array([missed(*rim(seed, 0.15)) for seed in range(16)]).T
    assert np.median(away) < 0.001
    assert away.max() < 0.012
    assert 0.3 < sigmas.max() < 3.0


def test_what_leaving_ground_out_changes_is_in_the_error_bar():
    """A corner slid by 40 cm: it hardly pulls, but it might have been the models that bent."""
    rows = []
    for seed in range(16):
        tiles, ground, best = rim(seed, 0.0)
        slid = (tiles.places > 3.0).all(axis=1)
        offsets = tiles.offsets + np.where(slid[:, None], (0.4, 0.0), 0.0)
        rows.append(missed(dataclasses.replace(tiles, offsets=offsets), ground, best))
        assert missed(tiles, ground, best)[2] < 0.002
    away, sigmas, east = np.array(rows).T
    pulled = 0.4 * slid.mean()
    assert np.median(away) < 0.1 * pulled
    assert away.max() < pulled
    assert sigmas.max() < 4.0
    assert 0.5 * pulled < np.median(east) < 1.5 * pulled


def test_small_tiles_are_trusted_less():
    tiles = TileOffsets(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1, int), np.zeros(1, int))
    sides = [16, 24, 36, 100, 128]
    found = [misfit(dataclasses.replace(tiles, side=side)) for side in sides]
    assert found == sorted(found, reverse=True)
    assert found[0] == pytest.approx(2.8125)
    assert found[2] == pytest.approx(1.25)
    assert found[3:] == [1.0, 1.0]


def test_where_ground_goes_is_told_from_the_survey_as_delivered():
    """Turned first: place, turn and answer together lead where the turned survey's answer does."""
    floor = refined(3, 0.0, 0.0)
    yaw, centre = np.deg2rad(5.0), np.array([3.0, -1.0, 0.0])
    c, s = np.cos(yaw), np.sin(yaw)
    motion = Transform([[c, -s, 0], [s, c, 0], [0, 0, 1]], 1.0, np.zeros(3), centre)
    whole = as_delivered(floor, motion)
    places = np.random.default_rng(1).uniform(-5, 5, (20, 2))
    turned = motion.apply(np.column_stack([places, np.zeros(20)]))[:, :2]
    np.testing.assert_allclose(
        places + whole.offset_at(places), turned + floor.offset_at(turned), atol=1e-12
    )


def test_a_tile_weighs_by_what_its_fit_says():
    """Tiles of which a few are well known: they tell the answer, and the stated sigma is true."""
    rng = np.random.default_rng(5)
    places, ground = lattice(7, 0.0, 12.0), lattice(15, -0.5, 12.5)
    ground = Ground(ground, np.full(len(ground), 1 / len(ground)))
    pivot, error = np.array([6.0, 6.0]), {"alike": [], "told": []}
    stated = []
    for _ in range(25):
        noise = np.where(rng.random(49) < 0.3, 0.01, 0.04)[:, None] ** 2 * np.ones(2)
        offsets = np.array([0.3, -0.2]) + rng.normal(0, np.sqrt(noise))
        for name, told in (("alike", None), ("told", noise)):
            found = TileOffsets(places, offsets, np.arange(49), np.zeros(49, int), 45, told)
            answer = fit_overlap(found, ground, pivot)
            error[name].append(answer.offset - (0.3, -0.2))
        stated.append(np.trace(answer.covariance[:2, :2]))
    size = {name: np.mean(np.square(e).sum(axis=1)) for name, e in error.items()}
    assert size["told"] < 0.45 * size["alike"]
    assert 0.4 < size["told"] / np.mean(stated) < 1.6


def answer_of(offset, sigma, yaw=0.0, turn=1e-3):
    """An answer of three tiles that agree with it."""
    places = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    found = TileOffsets(places, np.tile(offset, (3, 1)), np.arange(3), np.zeros(3, int))
    covariance = np.diag([sigma**2, sigma**2, turn**2])

    def there(at):
        return np.tile(offset, (len(at), 1))

    pivot = np.zeros(2)
    return Refined(pivot, np.array(offset), yaw, covariance, found, offset_at=there)


def test_channels_that_agree_are_weighed_by_their_covariances():
    both = combined(answer_of((1.0, 2.0), 0.01), answer_of((1.01, 2.0), 0.02))
    np.testing.assert_allclose(both.offset, [1.002, 2.0], atol=1e-12)
    np.testing.assert_allclose(np.diag(both.covariance)[:2], 0.01**2 * 0.8, rtol=1e-12)
    np.testing.assert_allclose(both.offset_at(np.zeros((1, 2))), [[1.002, 2.0]], atol=1e-12)
    np.testing.assert_allclose(both.residuals, [[-0.002, 0.0]] * 3, atol=1e-12)


@pytest.mark.parametrize("join", [combined, blended])
def test_what_two_answers_differ_by_is_in_the_covariance(join):
    """Two answers as sure as each other, half a metre apart: either may be right."""
    both = join(answer_of((0.0, 0.0), 0.01), answer_of((0.5, 0.0), 0.01))
    np.testing.assert_allclose(both.offset, [0.25, 0.0], atol=1e-12)
    assert np.sqrt(both.covariance[0, 0]) == pytest.approx(0.25, rel=0.01)
    assert np.sqrt(both.covariance[1, 1]) < 0.011


@pytest.mark.parametrize("join", [combined, blended])
def test_nothing_jumps_where_the_other_answer_becomes_the_surer(join):
    """Sigmas in steps of a thousandth: neither the answer nor the covariance has a step."""
    sigmas = 0.01 * 1.001 ** np.arange(-400, 401)
    found = [join(answer_of((0.0, 0.0), 0.01), answer_of((0.06, -0.02), s)) for s in sigmas]
    offsets = np.array([f.offset for f in found])
    size = np.array([np.sqrt(np.trace(f.covariance[:2, :2])) for f in found])
    assert np.abs(np.diff(offsets, axis=0)).max() < 0.002 * 0.06
    assert np.abs(np.diff(size) / size[1:]).max() < 0.003
    assert np.hypot(*offsets[0]) > 0.6 * np.hypot(0.06, 0.02) > np.hypot(*offsets[-1])


def hillshaded(raster, azimuth, seed):
    """The raster seen under a sun 45° high: Lambert's cosine, and sand that is grey all over."""
    rng = np.random.default_rng(seed)
    height, cell = raster.height.astype(float), raster.grid.cell
    north, east = np.gradient(height, -cell, cell)
    sun = np.array([np.sin(azimuth), np.cos(azimuth), 1.0]) / np.sqrt(2)
    light = (sun[2] - sun[0] * east - sun[1] * north) / np.sqrt(1 + east**2 + north**2)
    grey = np.clip(130 * np.maximum(light, 0.0) + rng.normal(0, 3, height.shape), 0, 255)
    color = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
    return dataclasses.replace(raster, color=color, color_valid=raster.valid)


@pytest.mark.parametrize("seed", [3, 4])
def test_light_from_two_sides_is_in_the_error_bar_of_an_image(seed):
    """Where the image alone tells, light may displace all of it alike; terrain takes that away."""
    flat = seafloor.Seafloor.random(seed, size=16.0, relief=0.5)
    still = hillshaded(flat.raster(0.05, 6.0, noise=0.0), np.deg2rad(80), 1)
    moving = flat.moved(-0.21, 0.13).raster(0.05, 6.0, noise=0.0)
    moving = hillshaded(moving, np.deg2rad(260), 2)
    truth, start = np.array([0.21, -0.13]), (0.2, -0.15)
    image = refine([(still, moving, "image")], start, np.eye(2) * 0.05**2, 0.3)
    assert image.tiles is not None
    sigma = np.sqrt(np.trace(image.covariance[:2, :2]) / 2)
    assert sigma > 0.9 * relief_height(still, moving, start)
    assert np.hypot(*(image.offset - truth)) < 3 * sigma
    used = [(still, moving, "terrain"), (still, moving, "image")]
    both = refine(used, start, np.eye(2) * 0.05**2, 0.3)
    assert np.sqrt(np.trace(both.covariance[:2, :2]) / 2) < 0.3 * sigma
    assert np.hypot(*(both.offset - truth)) < 0.1 * 0.05


def spectral(rng, side, slope, longest):
    """Gaussian random field (side, side) of unit deviation, its spectrum flat beyond `longest`."""
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    amplitude = np.maximum(k, 1 / longest) ** (-slope / 2)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(side, side))) * amplitude).real
    return (field - field.mean()) / field.std()


def lit_sheets(seed, turned, albedo, cell=0.05, side=360):
    """Two pictures on level sheets, of one relief lit from two sides; truth (0.2, -0.15) m."""
    rng = np.random.default_rng(seed)
    whole = side + 80
    height, paint = 0.05 * spectral(rng, whole, 3.0, 40), spectral(rng, whole, 2.0, 20)
    d_north, d_east = np.gradient(height, -cell, cell)
    sheets = []
    for azimuth, (row, col) in ((20, (40, 40)), (20 + turned, (37, 36))):
        sun = np.array([np.sin(np.deg2rad(azimuth)), np.cos(np.deg2rad(azimuth)), 0.84])
        light = np.maximum(sun[2] - sun[0] * d_east - sun[1] * d_north, 0)
        light = light / np.sqrt(1 + d_east**2 + d_north**2) * (1 + 0.25 * albedo * paint)
        grey = 110 * light / light.mean() + rng.normal(0, 3, light.shape)
        grey = np.clip(grey, 0, 255)[row : row + side, col : col + side].astype(np.uint8)
        known = np.ones((side, side), bool)
        grid = Grid(0.0, side * cell, cell, (side, side))
        color = np.repeat(grey[..., None], 3, axis=2)
        level, ones = np.zeros(known.shape, np.float32), np.ones(known.shape, np.uint16)
        sheets.append(SurveyRaster(grid, level, color, known, known, ones))
    return sheets, np.array([-4 * cell, 3 * cell])


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("turned", [0, 60, 90, 180])
@pytest.mark.parametrize("albedo", [0.0, 0.3, 1.0])
def test_shading_lit_from_another_side_is_in_the_error_bar_or_undecided(seed, turned, albedo):
    (still, moving), truth = lit_sheets(seed, turned, albedo)
    found = refine([(still, moving, "image")], tuple(truth), np.eye(2) * 0.1**2, 0.5)
    if found.undecided > MOST_UNDECIDED:
        assert turned >= 60, "one light decides"
        return
    if found.tiles is None:  # too few tiles have a peak: the judged sigma stands
        return
    miss = found.offset - truth
    assert miss @ np.linalg.solve(found.covariance[:2, :2], miss) < 3.5**2
    if turned == 0:
        assert found.undecided < 0.05
        assert np.hypot(*miss) < 0.05 * 0.05
