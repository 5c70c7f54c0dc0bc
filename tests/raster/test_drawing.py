"""The mesh rasterizer against formulas and against its slow twin."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_raster import grid_faces, mesh_raster, moved, several, sheet

from meshreg.errors import InputError, ResourceLimitError, UsageError
from meshreg.raster import rasterize
from meshreg.raster.grid import survey_grid
from meshreg.raster.mesh import draw_mesh, samples_per_side
from meshreg.raster.placing import place
from meshreg.raster.spacing import Spacing
from meshreg.records import Grid, Mesh, Survey, Transform
from meshreg.settings import RasterSettings

PLAIN = RasterSettings(fill_cells=0, remove_floaters=False, mask_flat_color=False)


def absolute(raster):
    return raster.height.astype(np.float64) + raster.datum


def drawn(survey, grid, times):
    """Mean height and number of samples by `times`² samples a cell, nothing else done."""
    placing = place(survey, grid, None, np.zeros(1))
    assert isinstance(survey.geometry, Mesh)
    layers = draw_mesh(survey.geometry, placing, grid, Spacing(1.0, None), PLAIN, times)
    return layers.height.astype(float) + placing.datum, layers.samples


def centres(grid):
    rows, cols = np.indices(grid.shape)
    return grid.east_north(rows, cols)


def test_a_plane_gives_its_own_area_means():
    survey = sheet(lambda x, y: 0.3 * x - 0.2 * y + 1.7, size=4.0, step=0.13, jitter=0.3)
    raster = rasterize(survey, Grid(0.0, 4.0, 0.25, (16, 16)), PLAIN)
    east, north = centres(raster.grid)
    assert raster.valid.all()
    np.testing.assert_allclose(absolute(raster), 0.3 * east - 0.2 * north + 1.7, atol=2e-6)


def test_north_is_the_first_row_and_east_the_last_column():
    survey = sheet(lambda x, y: 10 * x + y, size=2.0, step=0.5)
    raster = rasterize(survey, Grid(0.0, 2.0, 1.0, (2, 2)), PLAIN)
    np.testing.assert_allclose(absolute(raster), [[6.5, 16.5], [5.5, 15.5]], atol=1e-6)


def test_a_sphere_is_recovered_to_the_sagitta_of_its_facets():
    radius, step = 5.0, 0.02
    survey = sheet(lambda x, y: np.sqrt(radius**2 - (x - 1) ** 2 - (y - 1) ** 2), 2.0, step)
    raster = rasterize(survey, Grid(0.0, 2.0, 0.1, (20, 20)), PLAIN)
    # Truth: the formula averaged by 40 × 40 points a cell.
    fine = raster.grid.divided(40)
    rows, cols = np.indices(fine.shape)
    east, north = fine.east_north(rows, cols)
    truth = np.sqrt(radius**2 - (east - 1) ** 2 - (north - 1) ** 2)
    truth = truth.reshape(20, 40, 20, 40).mean(axis=(1, 3))
    error = absolute(raster) - truth
    sagitta = (step * np.sqrt(2)) ** 2 / (8 * radius)
    assert -sagitta < error.min() < error.max() < 0.2 * sagitta  # facets lie inside the sphere


def test_a_step_takes_the_share_of_its_area():
    # A cliff 1 m high at x = 0.75 of the cell 0 to 1, with its vertical wall.
    low = np.array([[0, 0, 0], [0.75, 0, 0], [0.75, 1, 0], [0, 1, 0]], float)
    high = np.array([[0.75, 0, 1], [1, 0, 1], [1, 1, 1], [0.75, 1, 1]], float)
    wall = np.array([[0.75, 0, 0], [0.75, 0, 1], [0.75, 1, 1], [0.75, 1, 0]], float)
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = several(*(Mesh(part, quad) for part in (low, high, wall)))
    height, samples = drawn(Survey("step", mesh), Grid(0.0, 1.0, 1.0, (1, 1)), times=8)
    assert samples[0, 0] == 64
    assert height[0, 0] == 0.25


def test_samples_on_a_cliff_take_its_top():
    low = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 1, 0], [0, 1, 0]], float)
    high = np.array([[0.5, 0, 1], [1, 0, 1], [1, 1, 1], [0.5, 1, 1]], float)
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    for parts in ((low, high), (high, low)):
        mesh = several(*(Mesh(part, quad) for part in parts))
        height, _ = drawn(Survey("step", mesh), Grid(0.4, 1.0, 0.2, (5, 1)), times=1)
        assert (height == 1.0).all()


def test_the_highest_surface_wins_whatever_the_order():
    sea = sheet(lambda x, y: 0.1 * x, 2.0, 0.25).geometry
    roof = sheet(lambda x, y: 1.0 + 0 * x, 1.0, 0.25).geometry
    grid = Grid(0.0, 2.0, 0.5, (4, 4))
    one = rasterize(Survey("a", several(sea, roof)), grid, PLAIN)
    two = rasterize(Survey("b", several(roof, sea)), grid, PLAIN)
    np.testing.assert_array_equal(one.height, two.height)
    assert (absolute(one)[2:, :2] == 1.0).all()
    assert (absolute(one)[:2] < 0.21).all()
    assert one.masked["beneath"] == 4  # the sea under the roof


@pytest.mark.parametrize("jitter", [0.0, 0.45])
def test_the_kernel_agrees_with_its_twin(jitter):
    rng = np.random.default_rng(3)
    survey = sheet(lambda x, y: np.sin(3 * x) * y, 1.0, 0.125, jitter=jitter, seed=3)
    mesh = survey.geometry
    keep = rng.random(len(mesh.faces)) < 0.9  # holes
    colors = rng.integers(0, 256, (len(mesh.vertices), 3))
    mesh = Mesh(mesh.vertices, mesh.faces[keep], colors=colors)
    survey = dataclasses.replace(survey, geometry=mesh)
    grid = Grid(-0.1537, 1.0411, 0.1203, (11, 11))
    raster = rasterize(survey, grid, PLAIN)
    times = samples_per_side(0.1203, Spacing(0.125, None))
    height, count, color, seen = mesh_raster(survey, grid, times)
    np.testing.assert_array_equal(raster.samples, count)
    np.testing.assert_allclose(raster.height, height, atol=1e-6)
    np.testing.assert_array_equal(raster.color_valid, seen)
    assert np.abs(raster.color.astype(float) - color).max() <= 0.5001


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_no_sample_inside_a_surface_is_lost(seed):
    """Watertight: any triangulation of a square covers every sample in it, edges included."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(seed)
    inner = rng.uniform(0, 8, (30, 2))
    if seed % 2:  # on the sample lattice, where edges and vertices fall exactly on samples
        inner = np.round(inner * 4) / 4
    plan = np.unique(np.concatenate([inner, [[0, 0], [8, 0], [0, 8], [8, 8]]]), axis=0)
    faces = Delaunay(plan).simplices
    faces = faces[np.abs(np.linalg.det(plan[faces[:, 1:]] - plan[faces[:, :1]])) > 1e-12]
    survey = Survey("t", Mesh(np.column_stack([plan, rng.normal(size=len(plan))]), faces))
    # Samples at multiples of 0.25 from 0 to 8: also on the outline and on its corners.
    _, samples = drawn(survey, Grid(-0.125, 8.125, 0.25, (33, 33)), times=1)
    assert (samples == 1).all()


@given(st.integers(0, 10_000), st.floats(-3, 3), st.floats(-3, 3))
@settings(max_examples=30, deadline=None)
def test_neighbours_leave_no_crack_wherever_the_mesh_lies(seed, east, north):
    rng = np.random.default_rng(seed)
    survey = sheet(lambda x, y: x * y, 4.0, 0.5, jitter=0.49, seed=int(rng.integers(1000)))
    _, samples = drawn(moved(survey, (east, north, 0)), Grid(east + 1, north + 3, 0.1, (20, 20)), 1)
    assert (samples == 1).all()


def test_cells_with_data_on_less_than_half_their_area_are_empty():
    survey = sheet(lambda x, y: 0 * x, size=1.0, step=0.05)
    # In tenths: cells of 1.0 with 0.4 and 0.6 of their width on the sheet, at its west and east.
    thin = rasterize(survey, Grid(-0.6, 1.0, 1.0, (1, 2)), PLAIN)
    thick = rasterize(survey, Grid(-0.4, 1.0, 1.0, (1, 2)), PLAIN)
    assert thin.valid.tolist() == [[False, True]]
    assert thick.valid.tolist() == [[True, False]]
    assert thick.samples[0, 0] == pytest.approx(0.6 * 256, rel=0.05)
    assert thin.samples[0, 0] == 0
    assert np.isnan(thin.height[0, 0])


def test_holes_stay_empty_and_cells_beside_them_keep_their_height():
    survey = sheet(lambda x, y: 2.0 * x, size=3.0, step=0.1)
    mesh = survey.geometry
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    hole = (np.abs(middle[:, :2] - 1.5) < 0.6).all(axis=1)
    survey = dataclasses.replace(survey, geometry=Mesh(mesh.vertices, mesh.faces[~hole]))
    raster = rasterize(survey, Grid(0.0, 3.0, 0.3, (10, 10)))
    assert not raster.valid[3:7, 3:7].any()
    assert raster.valid.sum() == 100 - 16
    east, _ = centres(raster.grid)
    np.testing.assert_allclose(absolute(raster)[raster.valid], 2 * east[raster.valid], atol=1e-5)


def test_shifting_by_whole_lattice_steps_changes_nothing_but_the_corner():
    survey = sheet(lambda x, y: np.sin(5 * x + y), 2.0, 0.1, jitter=0.4, origin=(0.03, 0.01, -7))
    colors = np.random.default_rng(0).integers(0, 256, (len(survey.geometry.vertices), 3))
    mesh = dataclasses.replace(survey.geometry, colors=colors)
    survey = dataclasses.replace(survey, geometry=mesh)
    one = rasterize(survey, survey_grid(survey, 0.125))
    other = moved(survey, (0.125 * 24, -0.125 * 8, 0.0))
    two = rasterize(other, survey_grid(other, 0.125))
    assert (two.grid.west - one.grid.west, two.grid.north - one.grid.north) == (3.0, -1.0)
    np.testing.assert_array_equal(one.height, two.height)
    np.testing.assert_array_equal(one.color, two.color)
    np.testing.assert_array_equal(one.samples, two.samples)


def test_utm_coordinates_cost_no_accuracy():
    survey = sheet(lambda x, y: np.sin(5 * x + y), 2.0, 0.1, jitter=0.4)
    far = moved(survey, (731_000, 5_705_000, 0))
    grid = Grid(0.0, 2.0, 0.1, (20, 20))
    near = rasterize(survey, grid, PLAIN)
    away = rasterize(far, dataclasses.replace(grid, west=731_000.0, north=5_705_002.0), PLAIN)
    np.testing.assert_array_equal(near.samples, away.samples)
    np.testing.assert_allclose(near.height, away.height, atol=1e-7)


def test_deep_water_keeps_its_millimetres():
    survey = sheet(lambda x, y: 1e-4 * x, 2.0, 0.1, origin=(0, 0, -4321.0))
    raster = rasterize(survey, Grid(0.0, 2.0, 0.5, (4, 4)), PLAIN)
    assert raster.datum == -4300.0
    east, _ = centres(raster.grid)
    np.testing.assert_allclose(absolute(raster), 1e-4 * east - 4321.0, atol=4e-6)


def test_the_order_of_faces_does_not_matter():
    survey = sheet(lambda x, y: np.sin(5 * x + y), 2.0, 0.1, jitter=0.4)
    mesh = survey.geometry
    colors = np.random.default_rng(0).integers(0, 256, (len(mesh.vertices), 3))
    order = np.random.default_rng(1).permutation(len(mesh.faces))
    grid = Grid(0.0, 2.0, 0.1, (20, 20))
    rasters = [
        rasterize(Survey("s", Mesh(mesh.vertices, faces, colors=colors)), grid, PLAIN)
        for faces in (mesh.faces, mesh.faces[order], np.roll(mesh.faces, 1, axis=1))
    ]
    for other in rasters[1:]:
        np.testing.assert_allclose(other.height, rasters[0].height, atol=1e-6)
        assert np.abs(other.color.astype(int) - rasters[0].color).max() <= 1
    np.testing.assert_array_equal(rasters[0].height, rasters[1].height)


def test_runs_repeat_bit_for_bit_on_any_number_of_threads():
    import numba

    survey = sheet(lambda x, y: np.sin(5 * x + y), 4.0, 0.05, jitter=0.4)
    colors = np.random.default_rng(0).integers(0, 256, (len(survey.geometry.vertices), 3))
    mesh = dataclasses.replace(survey.geometry, colors=colors)
    survey = dataclasses.replace(survey, geometry=mesh)
    threads = numba.get_num_threads()
    rasters = []
    try:
        for number in (1, threads, threads):
            numba.set_num_threads(number)
            rasters.append(rasterize(survey, Grid(0.0, 4.0, 0.02, (200, 200))))
    finally:
        numba.set_num_threads(threads)
    for other in rasters[1:]:
        np.testing.assert_array_equal(other.height, rasters[0].height)
        np.testing.assert_array_equal(other.color, rasters[0].color)
        np.testing.assert_array_equal(other.samples, rasters[0].samples)


def test_a_transform_moves_the_points_first():
    survey = sheet(lambda x, y: np.sin(5 * x + y), 2.0, 0.1, jitter=0.4, origin=(500.0, 300.0, 4.0))
    angle = 0.3
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    move = Transform(rotation, 1.1, np.array([3.0, -2.0, 0.5]), np.array([501.0, 301.0, 4.0]))
    points = move.apply(survey.geometry.vertices + survey.origin)
    baked = Survey("baked", Mesh(points, survey.geometry.faces))
    grid = survey_grid(survey, 0.25, transform=move)
    assert grid == survey_grid(baked, 0.25)
    one = rasterize(survey, grid, PLAIN, transform=move)
    two = rasterize(baked, grid, PLAIN)
    np.testing.assert_array_equal(one.valid, two.valid)
    np.testing.assert_allclose(one.height, two.height, atol=1e-6)


def test_faces_with_corners_that_are_not_finite_are_left_out_and_counted():
    survey = sheet(lambda x, y: 0 * x + 1, size=1.0, step=0.1)
    vertices = survey.geometry.vertices.copy()
    vertices[60] = np.nan
    vertices[0, 2] = np.inf
    broken = Survey("broken", Mesh(vertices, survey.geometry.faces))
    touched = np.isin(survey.geometry.faces, [60, 0]).any(axis=1).sum()
    raster = rasterize(broken, Grid(0.0, 1.0, 0.1, (10, 10)), PLAIN)
    assert raster.masked["not finite"] == touched
    assert (absolute(raster)[raster.valid] == 1.0).all()
    assert survey_grid(broken, 0.1).shape == (10, 10)


def test_degenerate_and_doubled_faces_weigh_nothing():
    survey = sheet(lambda x, y: np.sin(3 * x), size=1.0, step=0.1)
    mesh = survey.geometry
    extra = np.concatenate([mesh.faces, mesh.faces[:50], [[3, 3, 7], [5, 5, 5], [0, 1, 2]]])
    grid = Grid(0.0, 1.0, 0.1, (10, 10))
    one = rasterize(survey, grid, PLAIN)
    two = rasterize(Survey("extra", Mesh(mesh.vertices, extra)), grid, PLAIN)
    np.testing.assert_array_equal(one.height, two.height)
    np.testing.assert_array_equal(one.samples, two.samples)


def test_slivers_stay_between_their_corners():
    vertices = np.array([[0, 0, 0], [1, 1e-13, 5], [2, 0, 0], [1, 2, 1]], float)
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3]])
    raster = rasterize(Survey("s", Mesh(vertices, faces)), Grid(0.0, 2.0, 0.5, (4, 4)), PLAIN)
    assert 0 <= np.nanmin(absolute(raster)) <= np.nanmax(absolute(raster)) <= 5.0


def test_large_rasters_are_drawn_in_slabs_alike(monkeypatch):
    from meshreg.raster import mesh as module

    survey = sheet(lambda x, y: np.sin(5 * x + y), 2.0, 0.1, jitter=0.4)
    colors = np.random.default_rng(0).integers(0, 256, (len(survey.geometry.vertices), 3))
    survey = dataclasses.replace(
        survey, geometry=dataclasses.replace(survey.geometry, colors=colors)
    )
    grid = Grid(0.0, 2.0, 0.05, (40, 40))
    one = rasterize(survey, grid)
    monkeypatch.setattr(module, "_SLAB_CELLS", 7 * 40)
    monkeypatch.setattr(module, "_BAND_BYTES", 3 * 8 * 40 * 4)
    two = rasterize(survey, grid)
    np.testing.assert_array_equal(one.height, two.height)
    np.testing.assert_array_equal(one.color, two.color)
    np.testing.assert_array_equal(one.color_valid, two.color_valid)


def test_what_cannot_be_meant_is_refused():
    survey = sheet(lambda x, y: 0 * x)
    with pytest.raises(ResourceLimitError, match=r"16,000,000 cells \(0.2 GB\)"):
        rasterize(survey, Grid(0, 4, 0.001, (4000, 4000)), RasterSettings(max_cells=10**6))
    with pytest.raises(UsageError, match="EPSG:1"):
        rasterize(dataclasses.replace(survey, crs="EPSG:2"), Grid(0, 4, 1, (4, 4), crs="EPSG:1"))
    with pytest.raises(InputError, match="covers no ground"):
        rasterize(Survey("no faces", Mesh(np.zeros((3, 3)), np.empty((0, 3)))))


def test_without_a_grid_the_survey_sets_it():
    survey = sheet(lambda x, y: 0 * x, size=8.0, step=0.04, origin=(100.02, 200.0, 0))
    raster = rasterize(survey)
    assert raster.grid.cell == 0.05
    assert raster.grid.bounds == pytest.approx((100.0, 200.0, 108.05, 208.0))


def test_settings_by_hand_decide_the_cell():
    survey = sheet(lambda x, y: 0 * x, size=8.0, step=0.1)
    assert rasterize(survey, settings=RasterSettings(ortho_cell=0.5)).grid.cell == 0.5


def test_grid_faces_cover_a_square_once():
    faces = grid_faces(3, 3)
    assert len(faces) == 8
    assert sorted(np.unique(faces)) == list(range(9))
