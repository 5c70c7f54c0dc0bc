"""Flat unseen color, small gaps, the user's mask."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from reference_raster import draped, sheet

from meshreg.errors import UsageError
from meshreg.raster import rasterize
from meshreg.records import Grid, Mesh, Transform
from meshreg.settings import RasterSettings

NO_FILL = RasterSettings(fill_cells=0)


def ground(size=400, seed=0, dark=1.0):
    """A noisy picture of sand, with large soft shapes."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((size, size)) / size
    shapes = 110 + 40 * np.sin(9 * x + 3 * y) + 30 * np.cos(7 * y - 2 * x)
    noise = rng.normal(0, 4, (size, size, 3))
    return np.clip(dark * (shapes[..., None] * [1.0, 0.95, 0.8] + noise), 0, 255).astype(np.uint8)


def as_jpeg(image, quality):
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", quality=quality)
    return np.asarray(Image.open(stream))


# -- flat color -----------------------------------------------------------------------------------


@pytest.mark.parametrize("fill", [(0, 0, 0), (255, 127, 39), (255, 255, 255), (110, 104, 88)])
@pytest.mark.parametrize("quality", [None, 95, 75])
@pytest.mark.parametrize("cell", [0.01, 0.04])
def test_fill_of_any_color_is_masked_and_counted(fill, quality, cell):
    image = ground()
    unseen = np.zeros((400, 400), bool)
    unseen[40:120, 60:200] = True
    unseen[300:, 350:] = True
    image[unseen] = fill
    if quality:
        image = as_jpeg(image, quality)
    count = round(4 / cell)
    raster = rasterize(draped(image, 4.0, 4.0), Grid(0, 4, cell, (count, count)), NO_FILL)
    times = 400 // count
    inside = unseen.reshape(count, times, count, times).any(axis=(1, 3))
    assert not (raster.color_valid & inside).any()
    lost = ~raster.color_valid & ~inside
    assert lost.mean() < (0.06 if cell == 0.01 else 0.10)  # the rim of two texels and a cell
    assert raster.masked["flat color"] == (~raster.color_valid).sum()
    assert raster.valid.all()  # heights stay
    assert not raster.color[~raster.color_valid].any()


def test_unseen_faces_on_one_texel_are_masked():
    """As texturing programs do it: all unseen faces share one tiny patch of the page."""
    survey = draped(ground(), 4.0, 4.0, n=40)
    uv = survey.geometry.uv.copy()
    middle = survey.geometry.vertices[survey.geometry.faces].mean(axis=1)
    unseen = (middle[:, 0] > 1) & (middle[:, 0] < 2) & (middle[:, 1] > 1) & (middle[:, 1] < 1.6)
    uv[unseen] = (0.00125, 0.99875)
    image = ground()
    image[0, 0] = (255, 127, 39)
    mesh = dataclasses.replace(draped(image, 4.0, 4.0, n=40).geometry, uv=uv)
    raster = rasterize(
        dataclasses.replace(survey, geometry=mesh), Grid(0, 4, 0.02, (200, 200)), NO_FILL
    )
    assert not raster.color_valid[121:149, 51:99].any()
    assert raster.color_valid[:115].all()
    assert raster.masked["flat color"] == pytest.approx(50 * 30, rel=0.3)


@pytest.mark.parametrize("quality", [None, 90, 60, 30])
@pytest.mark.parametrize("cell", [0.01, 0.005, 0.04])
def test_dark_ground_with_noise_stays(quality, cell):
    image = ground(dark=0.12)  # grey values of 5 to 20
    if quality:
        image = as_jpeg(image, quality)
    count = round(4 / cell)
    raster = rasterize(draped(image, 4.0, 4.0), Grid(0, 4, cell, (count, count)))
    assert "flat color" not in raster.masked
    assert raster.color_valid.all()


def test_overexposed_sand_stays():
    """Saturated, and so without variation, but it goes over gently into what is around."""
    y, x = np.indices((400, 400)) / 400
    bright = 330 - 500 * np.hypot(x - 0.5, y - 0.5)
    noise = np.random.default_rng(0).normal(0, 2, (400, 400))
    image = np.repeat(np.clip(bright + noise, 0, 255)[..., None], 3, axis=2)
    assert (image == 255).all(axis=2).mean() > 0.02
    raster = rasterize(draped(image, 4.0, 4.0), Grid(0, 4, 0.01, (400, 400)))
    assert "flat color" not in raster.masked


@pytest.mark.parametrize("cell", [0.01, 0.002])
def test_a_smooth_gradient_stays(cell):
    """Eight bits make plateaus of it; they differ from their neighbours by one level."""
    ramp = np.broadcast_to(np.linspace(20, 60, 400)[:, None, None], (400, 400, 3))
    count = round(2 / cell)
    raster = rasterize(draped(ramp, 4.0, 4.0), Grid(1, 3, cell, (count, count)))
    assert "flat color" not in raster.masked


def test_a_survey_of_one_color_throughout_stays():
    raster = rasterize(draped(np.full((50, 50, 3), 128), 4.0, 4.0), Grid(0, 4, 0.05, (80, 80)))
    assert raster.color_valid.all()


def test_little_flat_color_is_left_alone_and_the_mask_can_be_switched_off():
    image = ground()
    image[10:30, 10:30] = 0  # 0.25 % of the ground
    grid = Grid(0, 4, 0.01, (400, 400))
    assert rasterize(draped(image, 4.0, 4.0), grid).masked == {}
    image[40:160, 60:200] = 0
    off = RasterSettings(mask_flat_color=False)
    assert rasterize(draped(image, 4.0, 4.0), grid, off).color_valid.all()


def test_white_vertices_that_no_camera_saw_are_masked():
    survey = sheet(lambda x, y: 0 * x, size=4.0, step=0.05)
    rng = np.random.default_rng(0)
    colors = rng.integers(60, 180, (81 * 81, 3))
    x, y = survey.geometry.vertices[:, :2].T
    unseen = (x > 1) & (x < 2.5) & (y > 1) & (y < 2.5)
    colors[unseen] = 255
    mesh = Mesh(survey.geometry.vertices, survey.geometry.faces, colors=colors)
    raster = rasterize(dataclasses.replace(survey, geometry=mesh), Grid(0, 4, 0.05, (80, 80)))
    assert not raster.color_valid[32:58, 22:48].any()
    assert raster.color_valid[:28].all()


# -- gaps -----------------------------------------------------------------------------------------


def plane_without(holes, cell=0.1, size=3.0):
    """A sloping sheet with the faces over the given cells (row, col, rows, cols) cut out."""
    survey = sheet(lambda x, y: 2 * x + y, size=size, step=cell)
    mesh = survey.geometry
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    row, col = np.floor((size - middle[:, 1]) / cell), np.floor(middle[:, 0] / cell)
    keep = np.ones(len(mesh.faces), bool)
    for r, c, rows, cols in holes:
        keep &= ~((row >= r) & (row < r + rows) & (col >= c) & (col < c + cols))
    mesh = Mesh(mesh.vertices, mesh.faces[keep], colors=np.full((len(mesh.vertices), 3), 90))
    count = round(size / cell)
    return dataclasses.replace(survey, geometry=mesh), Grid(0.0, size, cell, (count, count))


HOLES = [(3, 3, 1, 1), (3, 20, 2, 2), (10, 10, 1, 3), (18, 5, 4, 4), (0, 12, 1, 1), (29, 29, 1, 1)]


@pytest.mark.parametrize(("width", "closed"), [(0, 0), (1, 1), (2, 2), (3, 3), (4, 4)])
def test_gaps_up_to_the_width_are_closed_and_the_edge_is_not(width, closed):
    survey, grid = plane_without(HOLES)
    raster = rasterize(survey, grid, RasterSettings(fill_cells=width, remove_floaters=False))
    whole = np.ones(grid.shape, bool)
    for r, c, rows, cols in HOLES[closed:]:
        whole[r : r + rows, c : c + cols] = False
    np.testing.assert_array_equal(raster.valid, whole)
    np.testing.assert_array_equal(raster.color_valid, whole)
    filled = raster.valid & (raster.samples == 0)
    assert filled.sum() == sum(rows * cols for _, _, rows, cols in HOLES[:closed])
    rows, cols = np.indices(grid.shape)
    east, north = grid.east_north(rows, cols)
    error = raster.height + raster.datum - (2 * east + north)
    assert np.abs(error[raster.samples > 0]).max() < 1e-5
    assert np.abs(error[filled]).max(initial=0) < 0.3  # within the relief of a gap
    assert (raster.color[filled] == 90).all()


def test_two_gaps_that_touch_by_a_corner_are_one():
    survey, grid = plane_without([(5, 5, 1, 1), (6, 6, 1, 1)])
    one = rasterize(survey, grid, RasterSettings(fill_cells=1, remove_floaters=False))
    two = rasterize(survey, grid, RasterSettings(fill_cells=2, remove_floaters=False))
    assert (~one.valid).sum() == 2
    assert two.valid.all()


# -- the user's mask ------------------------------------------------------------------------------


class Half:
    """Use the ground west of a line."""

    def __init__(self, line):
        self.line = line

    def at(self, east, north):
        return east < self.line

    def __call__(self, grid):
        rows, cols = np.indices(grid.shape)
        return self.at(*grid.east_north(rows, cols))


def test_the_mask_empties_cells_and_counts_them():
    survey = draped(ground(100), 4.0, 4.0, origin=(10.0, 0, 0))
    raster = rasterize(survey, Grid(10.0, 4.0, 0.1, (40, 60)), mask=Half(11.0))
    assert raster.valid[:, :10].all()
    assert raster.color_valid[:, :10].all()
    assert not raster.valid[:, 10:].any()
    assert not raster.color_valid[:, 10:].any()
    assert np.isnan(raster.height[:, 10:]).all()
    assert not raster.color[:, 10:].any()
    assert raster.masked["mask"] == 40 * 30  # the 20 columns beyond the survey held nothing


def test_a_mask_speaks_of_the_survey_before_it_was_moved():
    survey = draped(ground(100), 4.0, 4.0)
    half_turn = Transform(
        np.diag([-1.0, -1.0, 1.0]), 1.0, np.array([0.5, 0, 0]), np.array([2, 2, 0])
    )
    grid = Grid(0.5, 4.0, 0.1, (40, 40))
    raster = rasterize(survey, grid, transform=half_turn, mask=Half(1.0))
    assert raster.valid.sum() == 40 * 10
    assert raster.valid[:, 30:].all()  # the west metre is the east one after half a turn


def test_masks_that_do_not_fit_are_refused():
    survey = draped(ground(100), 4.0, 4.0)
    grid = Grid(0, 4, 0.1, (40, 40))
    with pytest.raises(UsageError, match=r"shape \(3, 3\)"):
        rasterize(survey, grid, mask=lambda grid: np.ones((3, 3), bool))
    with pytest.raises(UsageError, match="at\\(east, north\\)"):
        rasterize(survey, grid, transform=Transform(), mask=lambda grid: np.ones((40, 40), bool))
