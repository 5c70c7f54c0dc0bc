"""Spacing, cells, grids on one lattice, block means."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.spatial  # noqa: F401  (its loading is not a part of an example's time)
from hypothesis import given
from hypothesis import strategies as st
from reference_raster import block_mean, draped, moved, sheet

from meshreg.errors import InputError, ResourceLimitError, UsageError
from meshreg.raster import rasterize
from meshreg.raster.grid import (
    cell_offset,
    check_size,
    choose_cells,
    coarsened,
    common_grid,
    measure_spacing,
    require_together,
    survey_bounds,
    survey_grid,
)
from meshreg.records import (
    Grid,
    Maps,
    Mesh,
    PointCloud,
    Survey,
    SurveyRaster,
    Transform,
)
from meshreg.settings import RasterSettings


def cloud(spacing, size=20.0, seed=0, colors=False):
    rng = np.random.default_rng(seed)
    count = round((size / spacing) ** 2)
    points = np.column_stack([rng.uniform(0, size, (count, 2)), rng.normal(0, 0.1, count)])
    return Survey("cloud", PointCloud(points, np.zeros((count, 3)) if colors else None))


# -- spacing --------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.005, 0.1, 1.0])
def test_a_mesh_spacing_is_its_edge(step):
    spacing = measure_spacing(sheet(lambda x, y: 0.2 * x, size=40 * step, step=step))
    assert spacing.points == pytest.approx(step, rel=1e-9)
    assert spacing.texels is None


@pytest.mark.parametrize("texel", [0.0004, 0.01, 0.5])
def test_texels_are_measured_on_the_ground(texel):
    image = np.zeros((30, 50, 3), np.uint8)
    survey = draped(image, 50 * texel, 30 * texel, n=7)
    assert measure_spacing(survey).texels == pytest.approx(texel, rel=1e-5)


def test_faces_that_no_camera_saw_do_not_count_as_texels():
    survey = draped(np.zeros((100, 100, 3), np.uint8), 10.0, 10.0, n=20)
    uv = survey.geometry.uv.copy()
    uv[:300] = uv[:300, :1]  # all corners on one texel
    survey = dataclasses.replace(survey, geometry=dataclasses.replace(survey.geometry, uv=uv))
    assert measure_spacing(survey).texels == pytest.approx(0.1, rel=1e-4)


@given(st.floats(0.01, 2.0), st.integers(0, 5))
def test_a_cloud_spacing_is_the_root_of_area_per_point(spacing, seed):
    found = measure_spacing(cloud(spacing, size=100 * spacing, seed=seed)).points
    assert found == pytest.approx(spacing, rel=0.05)


def test_a_cloud_with_a_great_hole_is_measured_where_it_is():
    survey = cloud(0.1, size=40.0)
    points = survey.geometry.points
    ring = np.hypot(points[:, 0] - 20, points[:, 1] - 20) > 15
    found = measure_spacing(Survey("ring", PointCloud(points[ring])))
    assert found.points == pytest.approx(0.1, rel=0.08)


def test_large_meshes_and_clouds_are_sampled_alike():
    survey = sheet(lambda x, y: 0 * x, size=40.0, step=0.1)
    assert len(survey.geometry.faces) > 200_000
    assert measure_spacing(survey).points == pytest.approx(0.1, rel=1e-9)
    assert measure_spacing(cloud(0.05, size=40)).points == pytest.approx(0.05, rel=0.03)


@pytest.mark.parametrize(
    "geometry",
    [
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])),
        Mesh(np.array([[0, 0, 0], [0, 0, 1], [0, 0, 2.0]]), np.array([[0, 1, 2]])),
        PointCloud(np.zeros((10, 3))),
        PointCloud(np.column_stack([np.arange(10), np.zeros(10), np.zeros(10)])),
        PointCloud(np.full((5, 3), np.nan)),
    ],
)
def test_what_covers_no_ground_is_refused(geometry):
    with pytest.raises(InputError, match="thing covers no ground"):
        measure_spacing(Survey("thing", geometry))


def test_maps_are_as_fine_as_their_cells():
    height_grid, color_grid = Grid(0, 4, 0.5, (8, 8)), Grid(0, 4, 0.25, (16, 16))
    color, seen = np.zeros((16, 16, 3)), np.ones((16, 16), bool)
    maps = Maps(np.zeros((8, 8)), height_grid, color, seen, color_grid)
    spacing = measure_spacing(Survey("maps", maps))
    assert (spacing.points, spacing.texels) == (0.5, 0.25)


# -- cells ----------------------------------------------------------------------------------------


def cells_of(survey, **chosen):
    return choose_cells(survey, survey, RasterSettings(**chosen))


def test_a_survey_like_the_paper_gets_the_paper_cells():
    cells = cells_of(draped(np.zeros((2000, 2000, 3), np.uint8), 20.0, 20.0, n=400))
    assert (cells.dem, cells.ortho, cells.sift) == (0.10, 0.05, 0.025)
    assert cells.notes == ()


def test_sift_sees_small_ground_more_finely():
    """Not more than a thousandth of the width, and never finer than the texels."""
    for size, expected in ((8.0, 0.01), (12.0, 0.0125), (16.0, 0.05 / 3), (30.0, 0.025)):
        image = np.zeros((2500, 2500, 3), np.uint8)
        assert cells_of(draped(image, size, size, n=300)).sift == pytest.approx(expected)


def test_coarse_data_get_coarse_cells_and_a_reason():
    cells = cells_of(draped(np.zeros((100, 100, 3), np.uint8), 100.0, 100.0, n=99))
    assert (cells.dem, cells.ortho, cells.sift) == (1.0, 1.0, 1.0)  # texels as wide as that
    assert "DEM cell 1 m instead of the paper's 0.1 m" in cells.notes[0]
    assert "apart" in cells.notes[0]


def test_the_coarser_survey_of_a_pair_decides():
    fine = draped(np.zeros((2000, 2000, 3), np.uint8), 20.0, 20.0, n=400)
    coarse = draped(np.zeros((500, 500, 3), np.uint8), 20.0, 20.0, n=100)
    for pair in ((fine, coarse), (coarse, fine)):
        cells = choose_cells(*pair)
        assert (cells.dem, cells.ortho, cells.sift) == (0.2, 0.1, pytest.approx(0.05, rel=0.3))


def test_a_small_patch_gets_finer_cells():
    cells = cells_of(draped(np.zeros((1000, 1000, 3), np.uint8), 1.0, 1.0, n=300))
    assert (cells.dem, cells.ortho, cells.sift) == (0.02, 0.01, 0.01)
    assert "1 m across" in cells.notes[0]


def test_millimetre_points_get_finer_cells():
    cells = cells_of(sheet(lambda x, y: 0 * x, size=0.4, step=0.0005))
    assert cells.dem == 0.005
    assert cells.ortho == cells.sift == 0.0025


def test_a_cloud_gets_two_points_to_a_cell_of_its_orthomosaic():
    cells = cells_of(cloud(0.2, size=60, colors=True))
    assert (cells.dem, cells.ortho, cells.sift) == (0.6, 0.3, 0.3)


def test_cells_nest_so_that_one_raster_can_be_averaged():
    for step, size in ((0.03, 6), (0.07, 14), (0.4, 80), (2.7, 500), (0.0013, 0.2)):
        for texels in (40, 333, 1000):
            image = np.zeros((texels, texels, 3), np.uint8)
            cells = cells_of(draped(image, size, size, n=round(size / step)))
            times = cells.dem / cells.ortho
            assert times == pytest.approx(round(times), abs=1e-9)
            assert 1 <= round(times) <= 2
            if size / texels < 0.6 * cells.dem:
                assert round(times) == 2
            ratio = cells.ortho / cells.sift
            assert ratio == pytest.approx(round(ratio), abs=1e-9)
            assert cells.sift >= min(0.01, cells.ortho) * (1 - 1e-9)


@given(
    dem=st.none() | st.floats(0.01, 5),
    ortho=st.none() | st.floats(0.01, 5),
    sift=st.none() | st.floats(0.001, 5),
)
def test_what_the_user_says_wins(dem, ortho, sift):
    survey = sheet(lambda x, y: 0 * x, size=10.0, step=0.5)
    cells = cells_of(survey, dem_cell=dem, ortho_cell=ortho, sift_cell=sift)
    for said, chosen in ((dem, cells.dem), (ortho, cells.ortho), (sift, cells.sift)):
        assert said is None or chosen == pytest.approx(said, rel=1e-11)
    if dem is None or ortho is None:
        ratio = cells.dem / cells.ortho
        assert ratio == pytest.approx(round(ratio), abs=1e-9)
        assert ratio >= 1


def test_a_wide_survey_coarsens_sift_and_says_so():
    image = np.zeros((4000, 4000, 3), np.uint8)
    cells = cells_of(draped(image, 40.0, 40.0, n=500), max_cells=4_000_000)
    assert cells.sift == pytest.approx(0.05)  # 1000² of a quarter of 4 million would do
    assert "SIFT cell 0.05 m instead of 0.025 m" in cells.notes[-1]
    assert "4,000,000" in cells.notes[-1]


@pytest.mark.parametrize("name", ["dem_cell", "ortho_cell", "sift_cell"])
@pytest.mark.parametrize("value", [0.0, -0.1, float("nan"), float("inf")])
def test_a_cell_that_is_no_length_is_refused(name, value):
    with pytest.raises(UsageError, match=name):
        cells_of(sheet(lambda x, y: 0 * x), **{name: value})


# -- grids ----------------------------------------------------------------------------------------


def test_a_grid_snaps_outward_to_multiples_of_its_lattice():
    survey = sheet(lambda x, y: 0 * x, size=4.0, step=0.5, origin=(100.07, -50.03, 0))
    grid = survey_grid(survey, 0.1)
    assert grid.bounds == pytest.approx((100.0, -50.1, 104.1, -46.0))
    assert grid.shape == (41, 41)
    coarse = survey_grid(survey, 0.1, 1.0)
    assert coarse.bounds == pytest.approx((100.0, -51.0, 105.0, -46.0))
    assert coarse.shape == (50, 50)


def test_edges_on_the_lattice_add_no_cells():
    for east in (0.0, 0.3, 731_000.1, -7.7):
        survey = sheet(lambda x, y: 0 * x, size=2.0, step=0.5, origin=(east, 5_705_000.3, 0))
        assert survey_grid(survey, 0.1).shape == (20, 20)


@given(
    st.floats(-1e6, 1e6), st.floats(-1e6, 1e7), st.sampled_from([0.01, 0.05, 0.1, 0.25, 1.0]),
    st.integers(1, 10),
)  # fmt: skip
def test_any_two_grids_of_a_lattice_differ_by_whole_cells(east, north, cell, times):
    one = survey_grid(sheet(lambda x, y: 0 * x, size=3.0, step=1.5), cell, cell * times)
    other = sheet(lambda x, y: 0 * x, size=3.0, step=1.5, origin=(east, north, 0))
    two = survey_grid(other, cell, cell * times)
    low, high = survey_bounds(other)
    west, south, right, top = two.bounds
    slack = 2e-6 * cell * times + 1e-6
    assert west <= low[0] + slack
    assert south <= low[1] + slack
    assert right >= high[0] - slack
    assert top >= high[1] - slack
    row, col = cell_offset(one, two)
    assert (row % times, col % times) == (0, 0)
    union = common_grid(one, two)
    for grid in (one, two):
        row, col = cell_offset(union, grid)
        assert row >= 0
        assert col >= 0
        assert row + grid.shape[0] <= union.shape[0]
        assert col + grid.shape[1] <= union.shape[1]


def test_the_offset_counts_rows_southward_and_columns_eastward():
    a = Grid(10.0, 20.0, 0.5, (4, 4))
    b = Grid(11.0, 18.5, 0.5, (2, 8))
    assert cell_offset(a, b) == (3, 2)
    assert cell_offset(b, a) == (-3, -2)
    union = common_grid(a, b)
    assert union == Grid(10.0, 20.0, 0.5, (5, 10))
    assert common_grid(b, a) == union


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (Grid(0.25, 0, 1.0, (4, 4)), "0.2500 columns"),
        (Grid(0, 0, 0.5, (4, 4)), "cells of"),
        (Grid(0, 0, 1.0, (4, 4), "EPSG:32754"), "different CRS"),
    ],
)
def test_grids_that_do_not_fit_are_refused(other, words):
    with pytest.raises(UsageError, match=words):
        cell_offset(Grid(0, 0, 1.0, (4, 4)), other)


@pytest.mark.parametrize(("cell", "lattice"), [(0.1, 0.25), (0.0, None), (-1.0, None), (1.0, 0.5)])
def test_a_lattice_that_the_cell_does_not_divide_is_refused(cell, lattice):
    with pytest.raises(UsageError, match="not a multiple"):
        survey_grid(sheet(lambda x, y: 0 * x), cell, lattice)


def test_bounds_follow_the_transform_and_skip_what_is_not_used():
    survey = sheet(lambda x, y: x, size=2.0, step=0.5, origin=(10, 20, 30))
    mesh = survey.geometry
    stray = np.concatenate([mesh.vertices, [[1e6, 0, 0], [np.nan, 0, 0]]])
    survey = Survey("s", Mesh(stray, mesh.faces), survey.origin)
    np.testing.assert_allclose(survey_bounds(survey), [[10, 20, 30], [12, 22, 32]])
    turn = Transform(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), 2.0, np.array([5, 0, 1.0]))
    np.testing.assert_allclose(survey_bounds(survey, turn), [[-39, 20, 61], [-35, 24, 65]])


def test_points_that_are_not_finite_do_not_bound():
    points = np.array([[0, 0, 0], [1, 2, 3], [np.inf, 0, 0], [0, np.nan, 0]], float)
    survey = Survey("c", PointCloud(points))
    np.testing.assert_allclose(survey_bounds(survey), [[0, 0, 0], [1, 2, 3]])
    with pytest.raises(InputError, match="no points with finite"):
        survey_bounds(Survey("c", PointCloud(points[2:])))
    with pytest.raises(InputError, match="no triangles with finite"):
        survey_bounds(Survey("c", Mesh(points, np.empty((0, 3)))))


def test_the_limit_names_its_numbers():
    with pytest.raises(ResourceLimitError) as caught:
        check_size(Grid(0, 0, 0.001, (50_000, 40_000)), 400_000_000)
    assert "2,000,000,000 cells (22.0 GB)" in str(caught.value)
    assert "400,000,000" in str(caught.value)
    assert caught.value.exit_code == 5
    check_size(Grid(0, 0, 0.001, (20_000, 20_000)), 400_000_000)


# -- block means ----------------------------------------------------------------------------------


def raster_of(shape, seed=0, empty=0.3):
    rng = np.random.default_rng(seed)
    valid = rng.random(shape) > empty
    seen = valid & (rng.random(shape) > 0.2)
    height = np.where(valid, rng.normal(size=shape), np.nan)
    color = np.where(seen[..., None], rng.integers(0, 256, (*shape, 3)), 0)
    samples = np.where(valid, rng.integers(1, 65535, shape), 0)
    return SurveyRaster(Grid(3.0, 7.0, 0.1, shape), height, color, valid, seen, samples, -100.0)


@pytest.mark.parametrize("shape", [(12, 18), (13, 17), (1, 5)])
@pytest.mark.parametrize("times", [2, 3, 5])
@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_block_means_agree_with_their_twin(shape, times, share):
    raster = raster_of(shape)
    coarse = coarsened(raster, times, share)
    height = block_mean(raster.height.astype(float), raster.valid, times, share)
    np.testing.assert_allclose(coarse.height, height, atol=1e-6)
    np.testing.assert_array_equal(coarse.valid, np.isfinite(height))
    color = block_mean(raster.color.astype(float), raster.color_valid, times, share)
    np.testing.assert_array_equal(coarse.color_valid, np.isfinite(color[..., 0]))
    assert np.nanmax(np.abs(coarse.color - color)[coarse.color_valid], initial=0) <= 0.5
    assert not coarse.color[~coarse.color_valid].any()
    assert coarse.samples.max() <= 65535
    assert (coarse.samples[~coarse.valid] == 0).all()
    assert coarse.grid.cell == pytest.approx(0.1 * times)
    assert (coarse.grid.west, coarse.grid.north) == (3.0, 7.0)
    assert coarse.datum == -100.0


def test_one_is_the_raster_itself_and_none_is_refused():
    raster = raster_of((4, 4))
    assert coarsened(raster, 1) is raster
    for times in (0, -2, 1.5):
        with pytest.raises(UsageError, match="whole number"):
            coarsened(raster, times)


def test_averaging_a_fine_raster_is_rasterizing_at_the_coarse_cell():
    from meshreg.raster import rasterize

    survey = sheet(lambda x, y: np.sin(2 * x) * y, size=4.0, step=0.1, jitter=0.3)
    survey = moved(survey, (0.31, 0.17, 0.0))
    plain = RasterSettings(fill_cells=0, remove_floaters=False)
    fine = rasterize(survey, survey_grid(survey, 0.1, 0.5), plain)
    coarse = coarsened(fine, 5)
    direct = rasterize(survey, survey_grid(survey, 0.5), plain)
    assert coarse.grid == direct.grid
    both = coarse.valid & direct.valid
    inner = both & (direct.samples == direct.samples.max())
    assert np.abs(coarse.height - direct.height)[inner].max() < 5e-3  # 10 × 10 or 5 × 5 samples
    assert (coarse.valid != direct.valid).mean() < 0.05


@pytest.mark.parametrize("turn", [0.0, 7.0, 31.0])
@pytest.mark.parametrize("phase", [(0.0, 0.0), (0.3, 0.7), (0.5, 0.5)])
def test_a_gridded_cloud_gets_the_cell_of_the_map_that_it_was_made_from(turn, phase):
    from meshreg.raster import rasterize

    step, count = 1.0024, 120
    place = step * (np.stack(np.mgrid[0:count, 0:count], -1).reshape(-1, 2) + phase)
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    points = np.column_stack([place @ [[c, s], [-s, c]], np.sin(place[:, 0])])
    known = np.hypot(*(place - 60).T) < 50  # an edge like a survey's
    gridded = Survey("gridded", PointCloud(points[known]))
    assert measure_spacing(gridded).gridded
    made = choose_cells(gridded, gridded)
    assert (made.dem, made.ortho) == (1.0, 1.0)
    # no hole wider than what rasterizing closes: almost every cell inside has a height
    raster = rasterize(gridded, survey_grid(gridded, made.dem))
    middle = points[known].mean(axis=0)
    rows, cols = np.indices(raster.valid.shape)
    east, north = raster.grid.east_north(rows, cols)
    inner = np.hypot(east - middle[0], north - middle[1]) < 40
    assert raster.valid[inner].mean() > 0.99


def test_scattered_points_keep_three_spacings():
    scattered = cloud(1.0, size=100, seed=3)
    assert not measure_spacing(scattered).gridded
    assert choose_cells(scattered, scattered).dem == 3.0


# -- points far away ------------------------------------------------------------------------------


def scattered(where, size=10.0, *, mesh=False, far=()):
    """3,000 points (or 1,000 triangles of them) on a plot; those in `far` are put elsewhere."""
    points = np.random.default_rng(5).uniform(0, size, (3000, 3))
    for row, place in far:
        points[row] = place
    faces = np.arange(3000, dtype=np.int32).reshape(-1, 3)
    geometry = Mesh(points, faces) if mesh else PointCloud(points)
    return Survey("plot", geometry, origin=where)


@pytest.mark.parametrize("mesh", [False, True])
@pytest.mark.parametrize(
    "place", [(1e6, 3.0, 0.0), (3.0, -1e6, 0.0), (1e6, 1e6, 0.0), (1e11, 0, 0)]
)
def test_a_point_far_from_all_others_is_named(mesh, place):
    where = np.array([500_000.0, 6_000_000.0, 0.0])
    survey = scattered(where, mesh=mesh, far=[(7, place)])
    east, north = place[0] + where[0], place[1] + where[1]
    with pytest.raises(InputError, match="1 of 3,000 points far away") as caught:
        rasterize(survey, settings=RasterSettings(dem_cell=0.5, ortho_cell=0.5))
    assert f"{east:.10g} m east, {north:.10g} m north" in str(caught.value)


@pytest.mark.parametrize(("cells", "refused"), [(63, False), (65, True)])
def test_64_blocks_for_the_sake_of_one_point(cells, refused):
    reach = (cells - 0.5) * 512 * 0.5
    survey = scattered(np.zeros(3), far=[(7, (reach, 5.0, 0.0))])
    if refused:
        with pytest.raises(InputError, match="far away"):
            require_together(survey, 0.5)
    else:
        require_together(survey, 0.5)


def test_a_long_strip_two_sites_and_large_triangles_are_no_outliers():
    strip = scattered(np.zeros(3))
    points = strip.geometry.points * [5000.0, 1.0, 1.0]  # 50 km x 10 m
    require_together(Survey("strip", PointCloud(points)), 0.1)
    two = strip.geometry.points + np.where(np.arange(3000)[:, None] % 20 == 0, 5e4, 0.0)
    require_together(Survey("two", PointCloud(two)), 0.1)
    corners = np.array([[0, 0, 0], [3e4, 0, 0], [0, 3e4, 0], [3e4, 3e4, 0]], float)
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    require_together(Survey("sheet", Mesh(corners, faces)), 0.5)


@pytest.mark.parametrize("mesh", [False, True])
@pytest.mark.parametrize("size", [1e-320, 1e-200, 1e-150, 1e-12])
def test_a_plot_of_no_size_is_no_ground(mesh, size):
    with pytest.raises(InputError, match="covers no ground"):
        choose_cells(*2 * [scattered(np.zeros(3), size, mesh=mesh)])


def test_a_wall_that_faces_north_is_no_ground():
    survey = scattered(np.zeros(3), mesh=True)
    points = survey.geometry.vertices.copy()
    points[:, 1] = 5.0
    wall = Survey("wall", Mesh(points, survey.geometry.faces))
    with pytest.raises(InputError, match="covers no ground"):
        choose_cells(wall, wall)
