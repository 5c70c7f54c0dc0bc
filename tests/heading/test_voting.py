"""A survey turned or stretched far beyond what one offset can bear: voted on, mended, named."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
import seafloor

from data_synth.rasters import make_rasters
from data_synth.recipe import load
from meshreg import Mesh, Settings, Survey, apply_transform, register_pair
from meshreg.benchmark import plan
from meshreg.benchmark import rasters as rasters_of_jobs
from meshreg.benchmark.measure import register_rasters
from meshreg.heading import turned as heading
from meshreg.heading import voting
from meshreg.heading.tile_surfaces import channel_surfaces, surfaces_bytes
from meshreg.heading.voting import STANDS_OUT, not_voted, similarity, vote
from meshreg.heading.voting_kernels import BIAS, SCORED, strongest
from meshreg.judge.judging import judge
from meshreg.pipeline import decision
from meshreg.raster.grid import coarsened
from meshreg.records import Grid, SurveyRaster, Transform
from meshreg.settings import SearchSettings
from meshreg.statistics import registration_sigma

OFFSET = np.array([1.337, -2.412, 0.083])
SEARCH = SearchSettings()
QUICK = Settings(methods=("terrain", "mutual_information")).changed({"search.radius": 5.0})


@functools.cache
def survey(seed, change=0.0, half=7.0, step=0.05):
    """A mesh of bumps with its heights and colors at the vertices, around (0, 0)."""
    floor = seafloor.Seafloor.random(seed, size=3 * half)
    if change:
        floor = floor.changed(seed + 1, change)
    n = round(2 * half / step)
    raster = floor.raster(step, half, noise=0.002, seed=round(100 * change))
    row, col = np.mgrid[0:n, 0:n]
    east, north = raster.grid.east_north(row, col)
    points = np.stack([east, north, raster.height], axis=-1).reshape(-1, 3)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = [np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)]
    return Survey("floor", Mesh(points, np.concatenate(faces), raster.color.reshape(-1, 3)))


def displaced(survey, yaw_deg=0.0, scale=1.0):
    """Deliver a survey by the inverse of a known reference_from_moving."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    truth = Transform(rotation, scale, OFFSET, (0.0, 0.0, 0.0))
    return apply_transform(survey, truth.inverse()), truth


def yaw_of(transform):
    return math.degrees(math.atan2(transform.rotation[1, 0], transform.rotation[0, 0]))


def place(survey):
    """The moving survey's own centre, at the height of its ground."""
    return survey.geometry.points.mean(axis=0) + survey.origin


# -- the vote itself, on rasters -----------------------------------------------------------------


@functools.cache
def rasters(yaw_deg, change=0.3, seed=3):
    return seafloor.rasters(seed, yaw=math.radians(yaw_deg), change=change, size=27.0)


@pytest.mark.parametrize("yaw_deg", [-8, -5, -2, 0, 0.4, 3, 8])
def test_tiles_vote_for_the_heading(yaw_deg):
    turn = vote(rasters(yaw_deg), SEARCH, 5.0)
    assert turn.gap > STANDS_OUT
    # delivered turned by +yaw, it must be turned back
    assert math.degrees(turn.yaw) == pytest.approx(-yaw_deg, abs=0.3)
    assert turn.scale == 1.0
    assert turn.stretch == pytest.approx(1.0, abs=0.01)  # tiles at 8° run off their peaks
    assert turn.needed == (abs(yaw_deg) > 1)


def test_swapped_surveys_vote_for_the_inverse():
    pairs = rasters(5)
    there = vote(pairs, SEARCH, 5.0)
    back = vote({name: pair[::-1] for name, pair in pairs.items()}, SEARCH, 5.0)
    assert math.degrees(there.yaw + back.yaw) == pytest.approx(0.0, abs=0.3)
    assert there.stretch * back.stretch == pytest.approx(1.0, abs=0.01)


def test_each_channel_alone_finds_the_heading():
    pairs = rasters(5)
    dark = {
        name: tuple(
            dataclasses.replace(
                r, color=np.zeros_like(r.color), color_valid=np.zeros_like(r.color_valid)
            )
            for r in pair
        )
        for name, pair in pairs.items()
    }
    turn = vote(dark, SEARCH, 5.0)
    assert turn.channel == "terrain"
    assert math.degrees(turn.yaw) == pytest.approx(-5, abs=0.3)


def test_a_small_survey_in_a_large_reference_is_cut_out_first():
    """Ground beyond the window changes neither the tiles' surfaces nor the work."""
    large, small = rasters(5)["dem"][0], rasters(5)["dem"][1]
    part = (slice(60, 120), slice(50, 110))
    west, north = small.grid.east_north(part[0].start - 0.5, part[1].start - 0.5)
    grid = dataclasses.replace(small.grid, west=float(west), north=float(north), shape=(60, 60))
    names = ("height", "color", "valid", "color_valid", "samples")
    cut = dataclasses.replace(small, grid=grid, **{n: getattr(small, n)[part] for n in names})
    tiles = channel_surfaces(large, cut, "terrain", 0.1, 1.0, 0.1)
    inner = dataclasses.replace(large.grid, west=large.grid.west + 1.0)
    inner = dataclasses.replace(inner, shape=(inner.shape[0], inner.shape[1] - 10))
    fields = {n: getattr(large, n)[:, 10:] for n in names}
    again = channel_surfaces(
        dataclasses.replace(large, grid=inner, **fields), cut, "terrain", 0.1, 1.0, 0.1
    )
    np.testing.assert_allclose(tiles.surfaces, again.surfaces, atol=0.2)
    assert np.abs(tiles.surfaces).max() > 3


def test_nothing_is_voted_on_where_nothing_stands_out_or_none_asked():
    assert vote(rasters(5), SearchSettings(max_yaw=0.0, max_scale=0.0), 5.0) is None
    other = rasters(0, seed=40)
    mixed = {name: (rasters(0)[name][0], other[name][1]) for name in other}
    assert vote(mixed, SEARCH, 5.0) is None
    apart = {
        name: (a, dataclasses.replace(b, grid=dataclasses.replace(b.grid, west=b.grid.west + 90)))
        for name, (a, b) in rasters(0).items()
    }
    assert vote(apart, SEARCH, 5.0) is None


def test_similarity_survives_wild_tiles():
    rng = np.random.default_rng(0)
    arm = rng.uniform(-10, 10, (40, 2))
    c, s = 1.02 * math.cos(0.1), 1.02 * math.sin(0.1)
    moved = np.array([0.3, -0.2]) + arm @ (np.array([[c, -s], [s, c]]) - np.eye(2)).T
    moved[::5] += rng.uniform(1, 2, (8, 2))
    offset, yaw, scale, ratio = similarity(arm, moved, 0.001)
    assert offset == pytest.approx((0.3, -0.2), abs=1e-6)
    assert yaw == pytest.approx(0.1, abs=1e-7)
    assert scale == pytest.approx(1.02, abs=1e-7)
    assert ratio > 50
    assert similarity(np.zeros((5, 2)), np.zeros((5, 2)), 0.001) is None


def test_chance_is_as_much_likelier_as_turns_were_tried():
    alone, of_fifty = (judge((), rasters(0), QUICK, 5.0, trials) for trials in (1, 50))
    assert of_fifty.false_alarm == pytest.approx(min(1.0, 50 * alone.false_alarm))
    assert of_fifty.best.east == alone.best.east


# -- the whole way, on meshes whose motion is known exactly --------------------------------------


@pytest.mark.parametrize("yaw_deg", [-8, -5, -2, 0, 0.4, 3, 8])
def test_any_heading_is_recovered(yaw_deg):
    moving, truth = displaced(survey(21, 0.1), yaw_deg)
    found = register_pair(survey(21), moving, QUICK)
    assert found.verdict == "accepted", found.reason
    assert found.transform.scale == 1.0
    assert 0 < found.covariance[6, 6] < 0.003**2  # a scale that was not fitted is not certain
    assert abs(yaw_of(found.transform) - yaw_deg) < 0.02
    error = found.transform.apply(place(moving)) - truth.apply(place(moving))
    assert np.abs(error).max() < 0.01
    assert any("heading" in note for note in found.notes) == (abs(yaw_deg) > 1)


def test_both_directions_are_inverse():
    moving, _ = displaced(survey(21, 0.1), 6.0)
    there = register_pair(survey(21), moving, QUICK)
    back = register_pair(moving, survey(21), QUICK)
    corners = place(moving) + np.array([[x, y, 0.0] for x in (-6, 6) for y in (-6, 6)])
    home = back.transform.apply(there.transform.apply(corners))
    assert np.abs(home - corners)[:, :2].max() < 0.02


@pytest.mark.parametrize("scale", [0.97, 1.02, 1.03])
def test_a_wrong_scale_is_named_and_mended(scale):
    moving, truth = displaced(survey(21, 0.1), 2.0, scale)
    found = register_pair(survey(21), moving, QUICK)
    assert found.verdict == "review"
    percent = 100 * abs(1 / scale - 1)
    assert f"{percent:.1f} % too {'small' if scale > 1 else 'large'}" in found.reason
    assert "check the scale bars" in found.reason
    assert found.transform.scale == pytest.approx(scale, abs=5e-4)
    assert found.covariance is None  # no error bar of an answer that is not accepted
    error = found.transform.apply(place(moving)) - truth.apply(place(moving))
    assert np.abs(error)[:2].max() < 0.01


def test_a_scale_that_was_asked_for_may_be_accepted():
    moving, _ = displaced(survey(21, 0.1), 0.0, 1.02)
    found = register_pair(survey(21), moving, QUICK.changed({"search.free_scale": True}))
    assert found.verdict == "accepted", found.reason
    sigma = np.sqrt(found.covariance[6, 6])
    assert 2e-6 < sigma < 3e-4
    assert abs(found.transform.scale - 1.02) < 3 * sigma
    # the doubt of the scale is no doubt of the place, but of what lies away from it
    assert np.abs(found.covariance[6, :6]).max() < 0.3 * sigma * np.sqrt(found.covariance[0, 0])
    home = found.transform.pivot + found.transform.offset
    near, far = (
        registration_sigma(found, home[0] + east, home[1], home[2])[0] for east in (0.0, 500.0)
    )
    assert far**2 - near**2 == pytest.approx((500 * sigma) ** 2, rel=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_another_place_stays_rejected(seed):
    pairs, other = rasters(0, seed=50 + seed), rasters(4, seed=70 + seed)
    mixed = {name: (pairs[name][0], other[name][1]) for name in pairs}
    mixed["sift"] = mixed["ortho"]
    assert register_rasters(mixed, QUICK).judgement.verdict == "rejected"


def test_a_mirrored_survey_stays_rejected():
    pairs = {
        name: (
            a,
            dataclasses.replace(
                b,
                **{
                    n: np.fliplr(getattr(b, n))
                    for n in ("height", "color", "valid", "color_valid", "samples")
                },
            ),
        )
        for name, (a, b) in rasters(4).items()
    }
    decision = register_rasters(pairs, QUICK)
    assert decision.judgement.verdict == "rejected"


# -- the generator's scenarios --------------------------------------------------------------------


def synthetic(name, seed, size, changes=None):
    made = make_rasters(load(name, changes), seed, size, dem_cell=0.1, ortho_cell=0.05, step=0.05)
    pairs = {
        "dem": (made.reference_dem, made.moving_dem),
        "ortho": (made.reference_ortho, made.moving_ortho),
    }
    return pairs, made.truth


def test_scenario_five_degrees():
    pairs, truth = synthetic("yaw_5deg", 0, 12.0)
    found = register_rasters(pairs, QUICK)
    assert found.judgement.verdict in ("accepted", "review")
    centroid = np.array(truth["centroid"])
    error = found.transform.apply(centroid) - centroid - truth["offset"]
    assert np.hypot(*error[:2]) < 0.05
    assert abs(yaw_of(found.transform) - math.degrees(truth["yaw"])) < 0.3


def test_scenario_two_per_cent():
    pairs, truth = synthetic("scale_2pct", 0, 15.0, {"sfm.warp": 0.03})
    found = register_rasters(pairs, QUICK)
    assert found.judgement.verdict == "review"
    assert "check the scale bars" in found.judgement.reason
    assert found.scale == pytest.approx(truth["similarity"]["scale"], abs=0.003)


@pytest.mark.parametrize("name", ["files_tasmania_12h_0000", "crossing_abrolhos_12mo_0016"])
def test_a_scale_that_only_coarse_tiles_see_is_not_held_against_a_pair(name):
    """Models of true scale that bend by 20 cm: the vote sees 3 %, the finest tiles a bend."""
    job = next(job for job in plan.jobs(plan.Options())[0] if job.name == name)
    kind = "scenario" if job.kind == "files" else job.kind
    pairs, made = rasters_of_jobs.make(dataclasses.replace(job, kind=kind))
    found = register_rasters(pairs, QUICK.changed({"search.radius": 10.0}))
    assert found.judgement.verdict == "accepted", found.judgement.reason
    assert found.scale == 1.0
    assert found.motion is None
    centroid = np.array(made.truth["centroid"])
    error = found.transform.apply(centroid) - centroid - made.truth["offset"]
    assert np.hypot(*error[:2]) < 0.05


def test_coarse_cells_vote_too():
    """A DEM of 0.2 m with an orthomosaic of 0.05 m: the voting cells differ from both."""
    pairs = rasters(-5)
    mixed = {"dem": tuple(coarsened(r, 2) for r in pairs["dem"]), "ortho": pairs["ortho"]}
    turn = vote(mixed, SEARCH, 5.0)
    assert math.degrees(turn.yaw) == pytest.approx(5, abs=0.3)


# -- the kernel and its slow twin -----------------------------------------------------------------


def test_strongest_sums_are_those_of_a_slow_twin():
    rng = np.random.default_rng(5)
    tiles, size, reach, hypotheses = 7, 13, 3, 4
    values = rng.integers(-BIAS + 1, BIAS, (tiles, size, size))
    scored = rng.random(values.shape) < 0.7
    starts = rng.integers(0, size - 2 * reach, (hypotheses, tiles, 2))
    least = np.array([4, 2, 3])
    packed = np.where(scored, SCORED + BIAS + values, 0).astype(np.int32)
    highest, choice = strongest(packed, starts, 3, least, reach)
    sets = [range(tiles), range(3), range(3, tiles)]
    for which, row, col in np.ndindex(3, 2 * reach + 1, 2 * reach + 1):
        sums = []
        for number in range(hypotheses):
            cells = [
                (t, starts[number, t, 0] + row, starts[number, t, 1] + col) for t in sets[which]
            ]
            known = [values[c] for c in cells if scored[c]]
            enough = len(known) >= least[which]
            sums.append(sum(known) / math.sqrt(len(known)) if enough else -math.inf)
        assert highest[which, row, col] == pytest.approx(max(sums), rel=1e-6)
        if math.isfinite(max(sums)):
            assert sums[choice[which, row, col]] == pytest.approx(max(sums), rel=1e-6)


# -- a long, narrow plot whose detail is a cell or two across -----------------------------------


def strip(yaw_deg, scale):
    """A beach of 570 x 60 cells on a slant, with relief of two to four cells."""
    made = []
    for angle, factor, seed in ((0.0, 1.0, 1), (yaw_deg, scale, 2)):
        rng = np.random.default_rng(77)
        count = 9000
        east, north = rng.uniform(-290, 290, count), rng.uniform(-40, 40, count)
        radius, height = rng.uniform(1.0, 2.0, count), 0.3 * rng.normal(size=count)
        noise = np.random.default_rng(seed)
        gone = noise.random(count) < 0.4  # other tussocks, of the same kind, at other places
        east = np.where(gone, noise.uniform(-290, 290, count), east)
        north = np.where(gone, noise.uniform(-40, 40, count), north)
        turn = np.exp(1j * math.radians(60.0 + angle)) * factor
        place, size = turn * (east + 1j * north), 560
        cols, rows = np.meshgrid(np.arange(size), np.arange(size))
        x, y = cols + 0.5 - size / 2, size / 2 - rows - 0.5
        field = np.zeros((size, size))
        for p, r, h in zip(place, radius * factor, height, strict=True):
            c, q = int(p.real + size / 2), int(size / 2 - p.imag)
            box = np.s_[max(q - 8, 0) : q + 9, max(c - 8, 0) : c + 9]
            far = (x[box] - p.real) ** 2 + (y[box] - p.imag) ** 2
            field[box] += h * np.exp(-far / (2 * r**2))
        home = (x + 1j * y) / turn
        valid = (np.abs(home.real) < 285) & (np.abs(home.imag) < 30)
        field += 0.05 * noise.normal(size=field.shape)
        made.append((np.where(valid, field, np.nan).astype(np.float32), valid))
    grid = Grid(0.0, 0.0, 1.0, (560, 560), None)
    dark = np.zeros((560, 560), bool)
    rasters = [
        SurveyRaster(grid, h, np.zeros((*h.shape, 3), np.uint8), v, dark, v.astype(np.uint16), 0.0)
        for h, v in made
    ]
    return {"dem": tuple(rasters), "ortho": tuple(rasters)}


@pytest.mark.parametrize(("yaw_deg", "scale"), [(5.0, 1.0), (-8.0, 1.0), (0.0, 1.03), (0.0, 0.99)])
def test_a_long_beach_votes_on_its_own_cells(yaw_deg, scale):
    turn = vote(strip(yaw_deg, scale), SEARCH, 40.0)
    assert math.degrees(turn.yaw) == pytest.approx(-yaw_deg, abs=0.2)
    # a tile that is turned runs off its peak; a turned survey is measured anew once it is straight
    assert turn.stretch == pytest.approx(1 / scale, abs=0.01 if yaw_deg else 0.002)
    assert turn.scale == (turn.stretch if scale != 1 else 1.0)


def test_cells_that_would_need_too_much_memory_are_not_voted_on_and_that_is_said(monkeypatch):
    pairs = strip(5.0, 1.0)
    assert not_voted(pairs, SEARCH, 40.0) == ""
    per_cell = surfaces_bytes(pairs["dem"][1], 1.0, 40.0, math.radians(8.0) + SEARCH.max_scale)
    monkeypatch.setattr(voting, "MOST_BYTES", 0.99 * per_cell)
    said = not_voted(pairs, SEARCH, 40.0)
    assert "cells of 2 m and coarser" in said
    assert f"the DEM, 1 m, would need {per_cell / 1e9:.3g} GB" in said
    assert not_voted(pairs, SearchSettings(max_yaw=0.0, max_scale=0.0), 40.0) == ""
    lost = decision.decide(pairs, QUICK.changed({"search.radius": 40.0}), 40.0)
    assert lost.judgement.verdict != "accepted"
    assert said in lost.notes


@pytest.mark.parametrize(("yaw", "scale"), [(0.05, 1.0), (0.0, 0.975)])
def test_a_vote_that_the_finer_tiles_contradict_is_given_up(monkeypatch, yaw, scale):
    """Four tiles of a small overlap may vote for anything, and stand out at the right place."""
    pairs = rasters(0)
    true = vote(pairs, SEARCH, 5.0)
    wrong = dataclasses.replace(true, yaw=yaw, scale=scale, stretch=scale, gap=20.0)
    assert wrong.proven
    assert wrong.needed
    monkeypatch.setattr(decision, "vote", lambda *_: wrong)
    monkeypatch.setattr(heading, "settled", lambda pairs, turn, guess: turn)
    found = register_rasters(pairs, QUICK, 5.0)
    assert found.judgement.verdict == "accepted", found.judgement.reason
    assert found.motion is None
    assert found.scale == 1.0
