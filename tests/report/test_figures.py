"""Figures: what is drawn where, from finished records only."""

from __future__ import annotations

import dataclasses
import logging
import math
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from made_registration import EAST, NORTH, OFFSET, made_registration
from PIL import Image

from meshreg.records import Grid, OffsetEstimate, Registration, SurveyRaster
from meshreg.report import draw_figures, evidence, overlays, residuals, scene, style
from meshreg.report.figures import FIGURES, _picture, _save

ALL = {*FIGURES, "scores_terrain", "scores_mutual_information"}


@pytest.fixture(scope="module")
def accepted() -> Registration:
    return made_registration("accepted")


def replaced(registration: Registration, **evidence: Any) -> Registration:
    return dataclasses.replace(registration, evidence={**registration.evidence, **evidence})


# ---- the whole set ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("verdict", "absent"),
    [("accepted", set()), ("review", set()), ("rejected", {"residuals", "height_difference"})],
)
def test_every_figure_that_has_evidence_is_drawn(
    tmp_path: Path, verdict: str, absent: set[str], caplog: pytest.LogCaptureFixture
) -> None:
    settings = dict(mpl.rcParams)
    with caplog.at_level(logging.INFO, "meshreg"):
        files = draw_figures(made_registration(verdict), tmp_path, scene_seconds=0)
    assert {path.stem for path in files} == ALL - absent
    assert caplog.messages == []  # nothing went wrong
    assert dict(mpl.rcParams) == settings  # the caller's matplotlib is as it was
    assert set(tmp_path.iterdir()) == set(files)  # no temporary file stays
    for path in files:
        with Image.open(path) as image:
            assert image.format == "PNG"
            assert 300 < max(image.size) <= style.MAX_PIXELS
            assert np.asarray(image.convert("L")).std() > 5  # not blank


def test_same_record_gives_the_same_picture(tmp_path: Path, accepted: Registration) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        for name in ("offsets", "matches"):
            _save(_picture(FIGURES[name](accepted)), tmp_path / folder / f"{name}.png")
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_record_without_evidence_gets_the_offsets_only(
    tmp_path: Path, accepted: Registration
) -> None:
    bare = dataclasses.replace(
        accepted,
        evidence={},
        estimates=tuple(dataclasses.replace(e, evidence={}) for e in accepted.estimates),
    )
    assert [path.stem for path in draw_figures(bare, tmp_path)] == ["extents", "offsets"]


def test_a_figure_that_fails_is_left_out_and_said(
    tmp_path: Path, accepted: Registration, caplog: pytest.LogCaptureFixture
) -> None:
    parts = {"reference_dem": accepted.evidence["reference_dem"]}
    broken = dataclasses.replace(accepted, evidence=parts | {"residuals": {"east": np.zeros(2)}})
    files = draw_figures(broken, tmp_path, scene_seconds=0)
    assert {path.stem for path in files} == {
        "extents",
        "offsets",
        "scores_terrain",
        "scores_mutual_information",
    }
    assert any("residuals was not drawn" in message for message in caplog.messages)


# ---- what is shown where ----------------------------------------------------------------------


def value_at(axes: Any, east: float, north: float) -> Any:
    """Color or value of the axes' picture at a place, found through its extent."""
    image = axes.images[0]
    west, right, south, top = image.get_extent()
    array = image.get_array()
    rows, cols = array.shape[:2]
    row = int((top - north) / (top - south) * rows)
    col = int((east - west) / (right - west) * cols)
    return array[row, col]


@pytest.mark.parametrize("flip", [(1, 1), (-1, 1), (1, -1)])
def test_score_surface_has_its_peak_at_the_offset(flip: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    east, north = np.arange(-2, 2.01, 0.1), np.arange(-1, 1.01, 0.1)
    score = rng.uniform(0, 1, (north.size, east.size))
    row, col = 4, 33
    score[row, col] = 9.0
    best = (float(east[col]), float(north[row]))
    found = OffsetEstimate(
        "terrain", "ok", "", *best, score=9.0,
        evidence={
            "surface": score[:: flip[0], :: flip[1]], "north": north[:: flip[0]],
            "east": east[:: flip[1]], "best": best, "second": (0.0, 0.0),
        },
    )  # fmt: skip
    axes = evidence.draw_surface(found).axes[0]
    assert value_at(axes, *best) == 9.0
    marks = [tuple(c.get_offsets()[0]) for c in axes.collections]
    assert best in [pytest.approx(mark) for mark in marks]
    labels = axes.get_legend_handles_labels()[1]
    assert any(f"{best[0]:+.3f}" in label for label in labels)


def test_best_score_is_bright_also_where_low_is_good() -> None:
    rng = np.random.default_rng(3)
    axis = np.arange(-1, 1.01, 0.1)
    score = rng.uniform(4, 5, (axis.size, axis.size))
    score[10, 10] = 0.1
    found = OffsetEstimate(
        "terrain", "ok", "", 0.0, 0.0, score=0.1,
        evidence={"surface": score, "east": axis, "north": axis, "best": (0.0, 0.0)},
    )  # fmt: skip
    image = evidence.draw_surface(found).axes[0].images[0]
    brightness = image.to_rgba(image.get_array())[..., :3].sum(-1)
    assert np.unravel_index(brightness.argmax(), brightness.shape) == (10, 10)


def test_empty_surface_gives_no_figure() -> None:
    hole = {"surface": np.full((3, 3), np.nan), "east": np.arange(3), "north": np.arange(3)}
    assert evidence.draw_surface(OffsetEstimate("terrain", "failed", evidence=hole)) is None


def test_matches_are_joined_between_their_ends(accepted: Registration) -> None:
    figure = evidence.draw_matches(accepted)
    figure.canvas.draw()  # the axes must not move away from the lines any more
    place = style.Place(accepted.evidence["reference_ortho"].grid)
    corner = np.array([place.east, place.north])
    matches = accepted.estimates[0].evidence
    lines = np.concatenate([lines.get_segments() for lines in figure.artists])
    at = figure.transFigure.transform(lines.reshape(-1, 2)).reshape(-1, 2, 2)
    found = np.hstack([figure.axes[k].transData.inverted().transform(at[:, k]) for k in range(2)])
    ends = np.hstack([matches["reference_points"] - corner, matches["moving_points"] - corner])
    assert {tuple(row) for row in np.round(found, 6)} == {tuple(row) for row in np.round(ends, 6)}
    assert "70 of 180 matches agree (38.9%)" in figure.get_suptitle()


def test_many_matches_are_thinned_evenly(accepted: Registration) -> None:
    rng = np.random.default_rng(0)
    points = np.array([EAST, NORTH]) + rng.uniform(0, 20, (3000, 2))
    many = {"reference_points": points, "moving_points": points, "inliers": np.ones(3000, bool)}
    first = dataclasses.replace(accepted.estimates[0], evidence=many)
    figure = evidence.draw_matches(dataclasses.replace(accepted, estimates=(first,)))
    assert sum(len(lines.get_segments()) for lines in figure.artists) == evidence.MAX_MATCHES


def test_ellipses_hold_ninety_five_percent(accepted: Registration) -> None:
    axes = evidence.draw_offsets(accepted).axes[0]
    rng = np.random.default_rng(11)
    patches = {tuple(np.round(p.center, 3)): p for p in axes.patches}
    for estimate in accepted.estimates[:2]:
        patch = patches[(round(estimate.east, 3), round(estimate.north, 3))]
        assert estimate.sigma is not None
        drawn = rng.multivariate_normal([estimate.east, estimate.north], estimate.sigma, 20_000)
        inside = patch.get_path().contains_points(
            drawn, transform=patch.get_patch_transform(), radius=0
        )
        assert 0.94 < inside.mean() < 0.96
    labels = " ".join(axes.get_legend_handles_labels()[1])
    assert "SIFT (ok)" in labels
    assert "terrain scan (weak)" in labels
    # stated in the middle of the overlap, where the methods measure
    assert accepted.transform is not None
    assert accepted.registration_error is not None
    place = np.append(accepted.registration_error["at"], 1.0)
    east, north = (place - np.linalg.inv(accepted.transform.matrix) @ place)[:2]
    assert f"({east:+.3f}, {north:+.3f})" in labels


def test_residual_arrows_point_where_the_residuals_do(accepted: Registration) -> None:
    axes = residuals.draw_residuals(accepted).axes[0]
    arrows = next(c for c in axes.collections if type(c).__name__ == "Quiver")
    field = accepted.evidence["residuals"]
    np.testing.assert_array_equal(arrows.U, field["d_east"])
    np.testing.assert_array_equal(arrows.V, field["d_north"])
    place = style.Place(accepted.evidence["reference_dem"].grid)
    np.testing.assert_allclose(arrows.get_offsets()[:, 0], field["east"] - place.east)
    assert axes.collections[-1] is arrows  # no tile was set aside
    assert residuals.draw_residuals(replaced(accepted, residuals={})) is None


def test_tiles_without_weight_do_not_set_the_scale(accepted: Registration) -> None:
    field = {k: np.append(v, v[:1]) for k, v in accepted.evidence["residuals"].items()}
    field["d_east"][-1], field["weight"][-1] = 40.0, 1e-6
    figure = residuals.draw_residuals(replaced(accepted, residuals=field))
    plain = residuals.draw_residuals(accepted)
    shown = [
        next(c for c in f.axes[0].collections if type(c).__name__ == "Quiver")
        for f in (figure, plain)
    ]
    np.testing.assert_array_equal(shown[0].U, shown[1].U)
    assert "30 of 31 tiles" in figure.get_supxlabel()
    weight, left = field["weight"][:-1], np.hypot(field["d_east"], field["d_north"])[:-1]
    rms = np.sqrt((weight * left**2).sum() / weight.sum())
    assert f"rms {1000 * rms:.1f} mm" in figure.get_supxlabel()


def test_height_difference_is_moving_minus_reference(accepted: Registration) -> None:
    reference = accepted.evidence["reference_dem"]
    raised = dataclasses.replace(reference, datum=reference.datum + 0.2)
    axes, side = residuals.draw_height_difference(replaced(accepted, moving_dem=raised)).axes[:2]
    shown = np.asarray(axes.images[0].get_array(), float)
    np.testing.assert_allclose(shown[np.isfinite(shown)], 0.2, atol=1e-6)
    labels = side.get_legend_handles_labels()[1]
    assert labels == ["median +0.030 m", "± NMAD 0.011 m"]  # from the record, not computed anew


def test_cross_section_shows_absolute_heights(accepted: Registration) -> None:
    axes = overlays.draw_section(accepted).axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert set(lines) == {"reference", "moving, before", "moving, after"}
    raster: SurveyRaster = accepted.evidence["reference_dem"]
    place = style.Place(raster.grid)
    north, height = lines["reference"].get_data()
    # The line's own column is found from the title; its heights come from the made seafloor.
    east = float(axes.figure.get_suptitle().split("east")[1].split("m")[0])
    from made_registration import relief

    seen = np.isfinite(height)
    assert seen.sum() > 200
    expected = relief(np.full(seen.sum(), east), north[seen] + place.north)
    np.testing.assert_allclose(height[seen], expected, atol=0.01)


def test_overlay_is_grey_only_where_both_agree(accepted: Registration) -> None:
    figure = overlays.draw_relief(accepted)
    color = [
        np.ptp(axes.images[0].get_array()[60:-40, 60:-40].astype(int), axis=-1).mean()
        for axes in figure.axes
    ]
    assert [axes.get_title() for axes in figure.axes] == ["before", "after"]
    assert color[1] < 0.1 * color[0]


def test_extents_are_the_boxes_of_the_record(accepted: Registration) -> None:
    axes = overlays.draw_extents(accepted).axes[0]
    labels = (axes.get_xlabel(), axes.get_ylabel())  # "east − 731 500 [m]"
    corner = [float(text.split("−")[1].split("[")[0].replace("\u2009", "")) for text in labels]
    lines = {line.get_label(): np.array(line.get_data()) for line in axes.lines}
    low, high = np.array([[EAST, NORTH], [EAST + 24, NORTH + 26]]) - corner
    for name in ("reference", "moving"):
        np.testing.assert_allclose(lines[name].min(axis=1), low)
        np.testing.assert_allclose(lines[name].max(axis=1), high)
    # A turn by YAW widens the box by about its half side times YAW; the offset shifts it.
    moved = lines["moving, registered"]
    np.testing.assert_allclose(
        moved.mean(axis=1) - lines["moving"].mean(axis=1), OFFSET[:2], atol=0.2
    )
    rejected = overlays.draw_extents(made_registration("rejected"))
    assert len(rejected.axes[0].lines) == 2


# ---- the parts --------------------------------------------------------------------------------


def test_two_tone_colors() -> None:
    bright, dark, none = 1.0, 0.0, math.nan
    reference = np.array([[bright, bright, dark, bright, none, none]])
    moving = np.array([[bright, dark, bright, none, bright, none]])
    white, blue, red, pale_blue, pale_red, empty = style.two_tone(reference, moving)[0]
    assert white.tolist() == [255, 255, 255]
    assert blue.tolist() == [0, 0, 255]
    assert red.tolist() == [255, 0, 0]
    assert pale_blue[2] > pale_blue[0] > 150
    assert pale_red[0] > pale_red[2] > 150
    assert empty.tolist() == [255, 255, 255]


def test_hillshade_is_brighter_on_slopes_that_face_north_west() -> None:
    row, col = np.mgrid[:20, :20]
    facing = style.hillshade((col + row).astype(float), 1.0)  # rises to the south-east
    away = style.hillshade(-(col + row).astype(float), 1.0)
    assert facing[5, 5] > 0.9 > 0.2 > away[5, 5]
    holes = np.where(col == 7, np.nan, col + row).astype(float)
    shade = style.hillshade(holes, 1.0)
    assert np.isnan(shade[:, 6:9]).all()
    assert np.isfinite(shade[:, 10:]).all()


def test_reduced_rasters_are_means_of_what_was_seen() -> None:
    rng = np.random.default_rng(2)
    grid = Grid(100.0, 50.0, 0.5, (31, 17))
    height = rng.uniform(-1, 1, grid.shape)
    height[rng.uniform(size=grid.shape) < 0.3] = np.nan
    height[4:8, 4:8] = np.nan
    color = rng.integers(0, 255, (*grid.shape, 3)).astype("u1")
    seen = np.isfinite(height)
    raster = SurveyRaster(grid, height, color, seen, seen, seen.astype("u2"), datum=-30.0)
    mean, coarse = style.reduced_height(raster, side=8)
    assert (coarse.cell, coarse.shape, coarse.west, coarse.north) == (2.0, (7, 4), 100.0, 50.0)
    colors, _ = style.reduced_color(raster, side=8)
    for i in range(7):
        for j in range(4):
            block = np.s_[4 * i : 4 * i + 4, 4 * j : 4 * j + 4]
            inside = seen[block]
            if not inside.any():
                assert np.isnan(mean[i, j])
                continue
            expected = raster.height[block][inside].astype(float).mean() - 30
            assert mean[i, j] == pytest.approx(expected, abs=1e-6)
            np.testing.assert_allclose(
                colors[i, j], color[block][inside].mean(axis=0) / 255, rtol=1e-9
            )
    untouched, same = style.reduced_height(raster, side=31)
    assert same == grid
    np.testing.assert_array_equal(np.isfinite(untouched), seen)


@pytest.mark.parametrize(
    ("west", "south", "size", "corner"),
    [
        (731_512.0, 5_705_233.0, 40.0, (731_500.0, 5_705_200.0)),
        (-3.0, 2.0, 10.0, (0.0, 0.0)),
        (414.0, 142.0, 400.0, (0.0, 0.0)),
    ],
)
def test_axes_count_from_a_round_corner(
    west: float, south: float, size: float, corner: tuple[float, float]
) -> None:
    grid = Grid(west, south + size, 1.0, (int(size), int(size)))
    place = style.Place(grid)
    assert (place.east, place.north) == corner
    left, right, bottom, top = place.extent(grid)
    assert (left + place.east, right - left) == (west, size)
    assert (bottom + place.north, top - bottom) == (south, size)


@pytest.mark.parametrize("shape", [(4000, 300), (300, 4000), (1, 1), (2, 900)])
def test_long_and_tiny_surveys_fit_the_size(tmp_path: Path, shape: tuple[int, int]) -> None:
    base = made_registration()
    grid = Grid(EAST, NORTH, 0.1, shape)
    row, _ = np.mgrid[: shape[0], : shape[1]]
    seen = np.ones(shape, bool)
    color = np.full((*shape, 3), 90, np.uint8)
    raster = SurveyRaster(grid, np.sin(row), color, seen, seen, seen.astype("u2"))
    rasters = {
        f"{which}_{what}{when}": raster
        for which, when in (("reference", ""), ("moving", ""), ("moving", "_before"))
        for what in ("dem", "ortho")
    }
    for path in draw_figures(replaced(base, **rasters), tmp_path, scene_seconds=0):
        with Image.open(path) as image:
            assert max(image.size) <= style.MAX_PIXELS


# ---- the 3-D still ----------------------------------------------------------------------------


@pytest.mark.needs("opengl")
def test_scene_is_rendered_in_a_child(tmp_path: Path, accepted: Registration) -> None:
    path = scene.draw_scene(accepted, tmp_path / "scene.png", 120)
    assert path == tmp_path / "scene.png"
    with Image.open(path) as image:
        assert max(image.size) <= style.MAX_PIXELS
        grey = np.asarray(image.convert("L"), float)[40:]
    # Both halves show the surface, seen from the same place, on white, and fill the picture.
    half = grey.shape[1] // 2
    left, right = grey[:, :half], grey[:, half : 2 * half]
    for part in (left, right):
        assert 0.3 < (part < 250).mean() < 0.95
    assert np.abs(left - right).mean() < 15


def test_scene_that_cannot_be_rendered_is_skipped_with_a_note(
    tmp_path: Path,
    accepted: Registration,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(scene, "_CHILD", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    with caplog.at_level(logging.INFO, "meshreg"):
        assert scene.draw_scene(accepted, tmp_path / "scene.png", 60) is None
    assert "meshreg doctor" in caplog.text
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(scene, "_CHILD", "import time; time.sleep(60)")
    assert scene.draw_scene(accepted, tmp_path / "scene.png", 0.5) is None


def test_scene_needs_a_result(tmp_path: Path) -> None:
    assert scene.draw_scene(made_registration("rejected"), tmp_path / "s.png", 60) is None
