"""The last word: what each later stage may find, found in data that have it and not in others."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import seafloor
from surveys import QUICK, displaced, floors, survey

from meshreg import Mesh, PointCloud, Survey, register_pair
from meshreg.errors import InputError
from meshreg.height.dem_pair import DemPair
from meshreg.height.gain import Gain, relief_gain
from meshreg.height.lifting import fit_heights
from meshreg.judge.judging import Judgement
from meshreg.judge.layers import second_surface
from meshreg.judge.verdict import Found, Stretch, findings, last_word
from meshreg.raster import rasterize
from meshreg.records import SourceFile, Transform
from meshreg.refine.tears import Tear, contradicts, find_tear
from meshreg.refine.tiles import TileOffsets


def raised(one: Survey, times: float) -> Survey:
    """The same survey with its heights multiplied."""
    assert isinstance(one.geometry, Mesh)
    points = one.geometry.vertices * [1.0, 1.0, times]
    return dataclasses.replace(one, geometry=dataclasses.replace(one.geometry, vertices=points))


@pytest.mark.parametrize(
    ("times", "words"),
    [(3.28084, "feet"), (1.5, "a vertical exaggeration of 1"), (1 / 1.33, "reference")],
)
def test_heights_in_another_unit_are_never_accepted(times, words):
    first, later = floors()
    reference = survey(first, half=5.0, seed=1)
    moving, _ = displaced(raised(survey(later, half=5.0, seed=2), times))
    found = register_pair(reference, moving, QUICK)
    assert found.verdict == "review"
    assert words in found.reason
    assert "heights" in [finding.code for finding in found.findings]
    assert found.heights_gain["value"] == pytest.approx(times, rel=0.05)
    # an answer that is not proven states no error
    assert found.covariance is None
    assert found.registration_error is None


@pytest.mark.parametrize("change", [0.0, 0.3, 0.6])
def test_the_gain_is_one_where_ground_changes(change):
    for seed in (0, 1, 2):
        pair = seafloor.rasters(seed, offset=(0.0, 0.0), up=0.0, change=change)["dem"]
        motion = Transform()
        gain = relief_gain(DemPair.of(*pair, motion, None), motion)
        assert not gain.departs
        assert abs(np.log(gain.value)) < max(3 * gain.sigma, 0.05)


# A gain of 1.1 departs by a tenth; with up to 6 % of sigma here, three of them make that 1.2.
@pytest.mark.parametrize("times", [0.7, 1.3, 2.0])
def test_a_gain_is_recovered_with_its_error(times):
    for seed in (0, 1):
        still, moving = seafloor.rasters(seed, offset=(0.0, 0.0), up=0.0, change=0.2)["dem"]
        moving = dataclasses.replace(moving, height=moving.height * np.float32(times))
        motion = Transform()
        gain = relief_gain(DemPair.of(still, moving, motion, None), motion)
        assert gain.departs
        assert abs(np.log(gain.value / times)) < 3 * gain.sigma < 0.3


@pytest.mark.parametrize("half", [2.5, 5.0])
def test_what_does_not_recur_has_no_gain(half):
    """Noise is alike by chance as often as it is alike upside down."""
    motion = Transform()
    for seed in range(4):
        pair = seafloor.rasters(seed, offset=(0.0, 0.0), half=half)["dem"]
        rng = np.random.default_rng(seed)
        noise = [
            dataclasses.replace(
                one, height=rng.normal(0, size, one.height.shape).astype(np.float32)
            )
            for one, size in zip(pair, (0.01, 0.05), strict=True)
        ]
        gain = relief_gain(DemPair.of(*noise, motion, None), motion)
        assert (gain.unknown, gain.departs, gain.inverted) == ("no relief recurs", False, False)


@pytest.mark.parametrize("change", [0.0, 0.5])
def test_relief_upside_down_is_known(change):
    motion = Transform()
    for seed in range(3):
        for half in (2.5, 6.0):
            still, moving = seafloor.rasters(
                seed, offset=(0.0, 0.0), up=0.0, change=change, half=half
            )["dem"]
            upright = relief_gain(DemPair.of(still, moving, motion, None), motion)
            moving = dataclasses.replace(moving, height=-moving.height)
            gain = relief_gain(DemPair.of(still, moving, motion, None), motion)
            assert gain.inverted
            assert gain.unknown == "the relief recurs upside down"
            assert not upright.inverted
            assert not upright.unknown


def bent(places, rng, size=0.1):
    """A smooth bend of some `size` m rms, as wide as the patch."""
    x, y = places.T / 12.0
    waves = [np.sin(2 * np.pi * (a * x + b * y) + c) for a, b, c in rng.uniform(-0.4, 0.4, (4, 3))]
    weights = rng.normal(0, size, (2, 4))
    return (weights @ np.array(waves)).T


def lattice(count=6, side=12.0):
    axis = (np.arange(count) + 0.5) * side / count
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("apart", [(0.34, 0.0), (-0.15, 0.2), (1.0, 0.4)])
@pytest.mark.parametrize("split", ["half", "diagonal", "strip", "rim"])
def test_a_torn_model_shows_two_populations(apart, split):
    places = lattice()
    x, y = places.T / 12.0
    part = {"half": x > 0.5, "diagonal": x + y > 1.1, "strip": x < 0.3, "rim": y < 0.16}[split]
    for seed in range(5):
        rng = np.random.default_rng(seed)
        values = bent(places, rng, 0.03) + rng.normal(0, 0.01, (36, 2))
        values[part] += apart
        values[rng.integers(36)] += [0.8, -0.5]  # ground that has changed
        tear = find_tear(places, values, 0.005)
        assert tear is not None
        smaller = min(part.mean(), 1 - part.mean())
        assert abs(tear.share - smaller) < 0.12
        assert np.hypot(*(np.abs(tear.apart) - np.abs(apart))) < 0.1


def test_three_tiles_that_match_wrongly_alike_are_no_tear():
    places = lattice()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        values = bent(places, rng, 0.03) + rng.normal(0, 0.02, (36, 2))
        lost = rng.permutation(36)[:9]
        values[lost] = rng.uniform(-1, 1, (9, 2))
        corner = np.argsort(places.sum(axis=1))[:3]
        values[corner] = np.array([0.4, 0.8]) + rng.normal(0, 0.07, (3, 2))
        assert find_tear(places, values, 0.005) is None


@pytest.mark.parametrize("torn", [True, False])
def test_the_other_channel_may_contradict_a_tear(torn):
    """What the image alone shows is ground that has changed; a torn model takes both along."""
    rng = np.random.default_rng(3)
    places = lattice()
    values = rng.normal(0, 0.01, (36, 2))
    part = places[:, 0] < 4.0
    values[part] += [0.3, 0.1]
    tear = find_tear(places, values, 0.005)
    assert tear is not None
    np.testing.assert_array_equal(tear.places, places[part])
    other = places[::2] + 0.7
    offsets = rng.normal(0, 0.02, (len(other), 2)) + torn * (other[:, :1] < 4.5) * [0.3, 0.1]
    number = np.arange(len(other))
    assert contradicts(TileOffsets(other, offsets, number, 0 * number), tear) is not torn


def test_a_smooth_bend_is_no_tear():
    places = lattice()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        values = bent(places, rng, rng.uniform(0, 0.25)) + rng.normal(0, 0.01, (36, 2))
        tear = find_tear(places, values, 0.005)
        assert tear is None or tear.size < 0.1
    dome = ((places - 6.0) ** 2).sum(axis=1)[:, None] * 0.2 / 72
    dome += np.random.default_rng(0).normal(0, 0.01, (36, 1))
    assert find_tear(places, dome, 0.002) is None


@pytest.mark.parametrize(("share", "apart"), [(0.5, 0.2), (0.5, -0.3), (0.2, -0.4), (0.0, 0.0)])
def test_a_step_in_height_is_found_and_a_bend_is_none(share, apart):
    for seed in (0, 1):
        floor = seafloor.Seafloor.random(seed, size=18.0)
        still = floor.raster(0.1, 6.0, noise=0.003, seed=seed)
        later = floor.changed(seed + 1, 0.2).raster(0.1, 6.0, noise=0.003, seed=seed + 9)
        row, col = np.mgrid[:120, :120]
        bend = 0.05 * np.cos(row / 50 + seed) * np.sin(col / 45)
        part = col >= round(120 * (1 - share))
        height = (later.height + bend + apart * part).astype(np.float32)
        step = fit_heights(still, dataclasses.replace(later, height=height), Transform()).step
        if not share:
            assert step is None
            continue
        assert step.size == pytest.approx(abs(apart), abs=0.03)
        assert step.share == pytest.approx(share, abs=0.12)
        # added to the eastern part: what it is too high by, downwards; of two halves either is told
        assert (step.apart[0] * apart < 0) == ("east" in step.side)


def test_half_a_model_that_slid_is_reviewed():
    first, later = floors()
    reference = survey(first, half=6.0, seed=1)
    whole = survey(later, half=6.0, seed=2)
    points = whole.geometry.vertices.copy()
    points[points[:, 0] > 0.3] += [0.34, 0.0, 0.0]
    torn = dataclasses.replace(whole, geometry=dataclasses.replace(whole.geometry, vertices=points))
    found = register_pair(reference, displaced(torn)[0], QUICK)
    assert found.verdict != "accepted"
    tear = next(finding for finding in found.findings if finding.code == "tear")
    assert "torn, or slid" in tear.text
    assert "torn, or slid" in found.reason


def doubled(points, step, share, rng):
    """A cloud of which a share of the points lies aside."""
    copy = rng.random(len(points)) < share
    return np.concatenate([points[~copy], points[copy] + step])


@pytest.mark.parametrize("step", [(0.25, 0, 0), (0, 0.25, 0.05), (0, 0, 0.1), (0, 0, -0.3)])
@pytest.mark.parametrize("relief", [1.0, 0.4])
def test_a_second_copy_of_the_surface_is_found(step, relief):
    floor = seafloor.Seafloor.random(11, size=18.0, relief=relief)
    points = survey(floor, half=5.0, cloud=True).geometry.points
    ghost = Survey("ghost", PointCloud(doubled(points, step, 0.2, np.random.default_rng(0))))
    layer = second_surface(ghost, rasterize(ghost, survey_lattice(ghost)))
    found = Found(layers=(layer, None))
    assert [finding.code for finding in findings(found)] == ["layers"]
    # the DEM is the mean of both, so that what is left of the step is at least 70 % of it
    told = np.array(layer.offset)
    assert np.linalg.norm(told - step) < 0.4 * np.linalg.norm(step)


@pytest.mark.parametrize("cell", [0.1, 0.2])
def test_a_copy_of_every_second_point_is_found(cell):
    """A third of all points: its distance is no measure of how rough the ground is."""
    floor = seafloor.Seafloor.random(11, size=18.0)
    points = survey(floor, half=5.0, cloud=True).geometry.points
    step = np.array([0.3, 0.1, 0.25])
    ghost = Survey("ghost", PointCloud(np.concatenate([points, points[::2] + step])))
    layer = second_surface(ghost, rasterize(ghost, survey_lattice(ghost, cell)))
    assert [finding.code for finding in findings(Found(layers=(layer, None)))] == ["layers"]


def survey_lattice(one, cell=0.1):
    from meshreg.raster.grid import survey_grid

    return survey_grid(one, cell)


def test_overhangs_and_plants_are_counted_and_not_reviewed():
    rng = np.random.default_rng(1)
    floor = seafloor.Seafloor.random(11, size=18.0)
    points = survey(floor, half=5.0, cloud=True).geometry.points
    chosen = rng.random(len(points)) < 0.1
    plants = points[chosen] + np.column_stack(
        [rng.normal(0, 0.05, (chosen.sum(), 2)), rng.uniform(0.05, 0.4, chosen.sum())]
    )
    tables = [points]
    for _ in range(30):
        middle, size, angle = rng.uniform(-4, 4, 2), rng.uniform(0.2, 0.6), rng.uniform(0, 7, 600)
        away = size * np.sqrt(rng.random(600))
        base = points[np.argmin(((points[:, :2] - middle) ** 2).sum(axis=1)), 2]
        level = np.full(600, base + rng.uniform(0.15, 0.4))
        tables.append(
            np.column_stack([middle + away[:, None] * np.c_[np.cos(angle), np.sin(angle)], level])
        )
    for scene in (points, np.concatenate([points, plants]), np.concatenate(tables)):
        one = Survey("scene", PointCloud(scene))
        layer = second_surface(one, rasterize(one, survey_lattice(one)))
        assert layer is not None
        assert (layer.cells > 0.03) == (scene is not points)
        assert not findings(Found(layers=(None, layer)))


PLACED = Judgement("accepted", "terrain and image agree", None)


@pytest.mark.parametrize(
    ("found", "code"),
    [
        (Found(stretch=Stretch(1.0199, 0.001, 5.7, 7.0)), "scale"),
        (Found(stretch=Stretch(0.99, 0.001, 2.8, 2.0)), "scale"),
        (Found(gain=Gain(3.28, 0.02, True)), "heights"),
        (Found(gain=Gain(inverted=True)), "upside_down"),
        (Found(tilt=12.0), "lean"),
        (Found(dips=(80.0, 81.0)), "upright"),
        (Found(dips=(4.0, 81.0)), "lean"),
        (Found(tear=Tear(np.array([0.34, 0.0]), 0.01, 0.5, "east")), "tear"),
        (Found(step=Tear(np.array([-0.2]), 0.01, 0.3, "north")), "tear"),
        (Found(sigma_up=0.94, relief=0.6), "up"),
        (Found(ties="the tie points lie 0.73 m from the answer"), "ties"),
    ],
)
def test_each_finding_reaches_the_verdict(found, code):
    against = findings(found)
    assert [finding.code for finding in against] == [code]
    judged = last_word(PLACED, against)
    assert judged.verdict == "review"
    assert against[0].text in judged.reason
    rejected = dataclasses.replace(PLACED, verdict="rejected")
    assert last_word(rejected, against).verdict == "rejected"


@pytest.mark.parametrize(
    "found",
    [
        Found(),
        Found(stretch=Stretch(0.98, 0.0005, 0.15, 1.2)),  # internal distortion on a small plot
        Found(stretch=Stretch(1.0199, 0.001, 5.7, 7.0, fitted=True)),
        Found(gain=Gain(1.3, 0.2, False), tilt=2.0, dips=(50.0, 48.0)),
        Found(tear=Tear(np.array([0.06, 0.0]), 0.01, 0.4, "west")),
        Found(sigma_up=0.08, relief=0.04),  # flat sand
    ],
)
def test_what_is_within_reason_stays_accepted(found):
    assert findings(found) == ()
    assert last_word(PLACED, ()) == PLACED


def test_the_same_files_are_refused_unless_allowed(tmp_path):
    one = survey(floors()[0], half=3.0, step=0.08)
    files = (SourceFile(tmp_path / "a.ply", "ply", sha256="ab" * 32),)
    same = dataclasses.replace(one, source=files)
    with pytest.raises(InputError, match="same file"):
        register_pair(same, dataclasses.replace(same, origin=np.array([5.0, 0, 0])), QUICK)
    other = (*files, SourceFile(tmp_path / "b.ply", "ply", sha256="cd" * 32))
    for moving in (dataclasses.replace(same, source=other), one):
        assert register_pair(same, moving, QUICK).verdict == "accepted"
    assert register_pair(same, same, QUICK, allow_same=True).verdict == "accepted"
