"""Texture sampling: half texels, pages, alpha, wrapping, aliasing, pages that fail."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_raster import draped, grid_faces, mesh_raster, page, sheet

from meshreg.errors import InputError
from meshreg.raster import rasterize, textures
from meshreg.raster.mesh import samples_per_side
from meshreg.raster.spacing import Spacing, measure_spacing
from meshreg.records import Grid, Mesh, Survey, Texture
from meshreg.settings import RasterSettings

PLAIN = RasterSettings(fill_cells=0, remove_floaters=False, mask_flat_color=False)


def noise(height, width, seed=0, channels=3):
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def two_page_mesh(left, right):
    """A 2 m × 1 m sheet whose west half shows page 0 and east half page 1, each whole."""
    x, y = np.meshgrid([0.0, 1.0, 2.0], [0.0, 1.0])
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(6)], axis=1)
    faces = grid_faces(2, 3)
    on = (vertices[faces][:, :, 0].mean(axis=1) > 1).astype(np.int32)
    uv = vertices[faces][:, :, :2] - np.stack([on, np.zeros(4)], axis=1)[:, None]
    return Survey("two", Mesh(vertices, faces, uv=uv, face_texture=on, textures=(left, right)))


def test_a_page_draped_texel_on_cell_comes_back_as_it_was():
    """Half texel exactly: with one sample at each texel's centre nothing is interpolated."""
    from meshreg.raster.mesh import draw_mesh
    from meshreg.raster.placing import place

    image = noise(12, 20)
    survey = draped(image, 2.0, 1.2)
    grid = Grid(0.0, 1.2, 0.1, (12, 20))
    placing = place(survey, grid, None, np.zeros(1))
    layers = draw_mesh(survey.geometry, placing, grid, Spacing(2.0, 0.1), PLAIN, times=1)
    np.testing.assert_array_equal(layers.color, image)


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_a_cell_of_several_texels_takes_their_mean(factor):
    image = noise(6 * factor, 4 * factor)
    raster = rasterize(draped(image, 0.4, 0.6), Grid(0.0, 0.6, 0.1, (6, 4)), PLAIN)
    truth = image.reshape(6, factor, 4, factor, 3).mean(axis=(1, 3))
    assert np.abs(raster.color - truth).max() <= 0.51
    assert raster.color_valid.all()


@pytest.mark.parametrize("cell", [0.05, 0.1, 0.02, 0.01, 0.3])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.0123, -0.0077), (-0.0049, 0.0021)])
def test_a_smooth_picture_lies_within_a_hundredth_of_a_cell_or_texel(cell, offset):
    """Half texel and half cell exactly: the least-squares shift against the formula is nil."""

    def picture(east, north):
        return 120 + 60 * np.sin(3.1 * east + 0.3) + 60 * np.cos(2.3 * north - 0.2 * east)

    texel = 0.025
    row, col = np.indices((160, 160))
    image = np.repeat(picture((col + 0.5) * texel, 4 - (row + 0.5) * texel)[..., None], 3, axis=2)
    count = int(3.4 / cell)
    grid = Grid(0.2 + offset[0], 3.7 + offset[1], cell, (count, count))
    raster = rasterize(draped(np.round(image), 4.0, 4.0), grid, PLAIN)
    rows, cols = np.indices(grid.divided(8).shape)
    fine = picture(*grid.divided(8).east_north(rows, cols))
    truth = fine.reshape(count, 8, count, 8).mean(axis=(1, 3))
    error = raster.color[..., 0] - truth
    assert np.abs(error).max() <= 1.2  # rounding of texels and of cells, half a level each
    north, east = np.gradient(truth)
    design = np.stack([east.ravel(), north.ravel()], axis=1)
    shift = np.linalg.lstsq(design, error.ravel(), rcond=None)[0]
    assert np.abs(shift).max() * cell <= 0.01 * max(cell, texel)


@pytest.mark.parametrize(
    ("texel", "cell"), [(0.01, 0.1), (0.01, 0.16), (0.002, 0.1), (0.0007, 0.1)]
)
def test_a_fine_checkerboard_turns_grey(texel, cell):
    count = round(1.6 / texel)
    board = (np.indices((count, count)).sum(axis=0) % 2 * 255).astype(np.uint8)
    survey = draped(np.repeat(board[:, :, None], 3, axis=2), 1.6, 1.6)
    count = int(1.6 / cell)
    raster = rasterize(survey, Grid(0.0, 1.6, cell, (count, count)), PLAIN)
    inner = raster.color[1:-1, 1:-1].astype(float)
    assert np.abs(inner - 127.5).max() <= 13
    assert np.abs(inner.mean() - 127.5) <= 1.0


def test_stripes_at_any_pitch_under_a_cell_lose_their_contrast():
    for pitch in (0.011, 0.023, 0.037):
        x = (np.arange(4000) + 0.5) * 0.0005
        stripes = np.broadcast_to(
            (127.5 + 127.5 * np.sin(2 * np.pi * x / pitch))[None, :, None], (4, 4000, 3)
        )
        raster = rasterize(draped(stripes, 2.0, 0.002), Grid(0, 0.002, 0.1, (1, 20)), PLAIN)
        assert not raster.color_valid.any()  # a strip far thinner than a cell has no area
        raster = rasterize(draped(stripes, 2.0, 0.3), Grid(0, 0.3, 0.1, (3, 20)), PLAIN)
        ideal = 127.5 * abs(np.sinc(0.1 / pitch))
        assert np.abs(raster.color.astype(float) - 127.5).max() <= ideal + 13


def test_the_kernel_agrees_with_its_twin_on_textures_with_alpha():
    rng = np.random.default_rng(5)
    survey = sheet(lambda x, y: np.sin(3 * x) * y, 1.0, 0.2, jitter=0.4, seed=5)
    mesh = survey.geometry
    on = rng.integers(-1, 2, len(mesh.faces)).astype(np.int32)
    image = noise(13, 17, 1, channels=4)
    mesh = Mesh(
        mesh.vertices,
        mesh.faces,
        colors=rng.integers(0, 256, (len(mesh.vertices), 3)),
        uv=rng.uniform(0.0, 1.0, (len(mesh.faces), 3, 2)),
        face_texture=on,
        textures=(page(noise(9, 31), "a.png"), page(image, "b.png")),
    )
    survey = dataclasses.replace(survey, geometry=mesh)
    grid = Grid(-0.0537, 1.0411, 0.0503, (21, 21))
    spacing = measure_spacing(survey)
    times = samples_per_side(grid.cell, spacing)
    raster = rasterize(survey, grid, PLAIN)
    height, _, color, seen = mesh_raster(survey, grid, times)
    np.testing.assert_allclose(raster.height, height, atol=1e-6)
    np.testing.assert_array_equal(raster.color_valid, seen)
    assert np.abs(raster.color.astype(float) - color).max() <= 0.51
    assert 0.2 < seen.sum() / np.isfinite(height).sum() < 0.95  # both cases are there


@pytest.mark.parametrize("clamp", [False, True])
def test_coordinates_outside_the_page_wrap_or_clamp(clamp):
    image = noise(8, 8, 2)
    survey = draped(image, 1.0, 1.0, clamp=clamp)
    mesh = survey.geometry
    mesh = dataclasses.replace(mesh, uv=mesh.uv * 2.5 - np.float32(0.75))
    survey = dataclasses.replace(survey, geometry=mesh)
    grid = Grid(0.0, 1.0, 0.05, (20, 20))
    times = samples_per_side(0.05, measure_spacing(survey))
    raster = rasterize(survey, grid, PLAIN)
    _, _, color, _ = mesh_raster(survey, grid, times, wrap=not clamp)
    assert np.abs(raster.color.astype(float) - color).max() <= 0.51


def test_a_page_that_is_not_tiled_does_not_mix_its_opposite_edges():
    image = np.zeros((4, 4, 3), np.uint8)
    image[:, 2:] = 200
    raster = rasterize(draped(image, 1.0, 1.0), Grid(0, 1, 0.125, (8, 8)), PLAIN)
    assert (raster.color[:, 0] == 0).all()
    assert (raster.color[:, -1] == 200).all()


@pytest.mark.parametrize("group_bytes", [1 << 30, 1])
def test_each_face_takes_its_own_page(monkeypatch, group_bytes):
    """Alike whether the pages are in memory together or one at a time."""
    monkeypatch.setattr(textures, "_GROUP_BYTES", group_bytes)
    left, right = noise(10, 10, 1), noise(10, 10, 2)
    raster = rasterize(two_page_mesh(page(left), page(right)), Grid(0, 1, 0.1, (10, 20)), PLAIN)
    # 2 × 2 samples a texel blur it by (1 6 1) / 8 in both directions, except at page edges.
    for part, image in ((raster.color[:, :10], left), (raster.color[:, 10:], right)):
        padded = np.pad(image.astype(float), ((1, 1), (1, 1), (0, 0)), "edge")
        rows = (padded[:-2] + 6 * padded[1:-1] + padded[2:]) / 8
        truth = (rows[:, :-2] + 6 * rows[:, 1:-1] + rows[:, 2:]) / 8
        assert np.abs(part - truth).max() <= 0.51


def test_slabs_and_groups_of_pages_change_nothing(monkeypatch):
    from meshreg.raster import mesh as module

    survey = two_page_mesh(page(noise(30, 30, 1)), page(noise(30, 30, 2, channels=4)))
    colors = np.random.default_rng(0).integers(0, 256, (6, 3))
    on = survey.geometry.face_texture.copy()
    on[0] = -1
    mesh = dataclasses.replace(survey.geometry, colors=colors, face_texture=on)
    survey = dataclasses.replace(survey, geometry=mesh)
    grid = Grid(-0.01, 1.02, 0.03, (35, 70))
    one = rasterize(survey, grid)
    monkeypatch.setattr(textures, "_GROUP_BYTES", 1)
    two = rasterize(survey, grid)
    monkeypatch.setattr(module, "_SLAB_CELLS", 10 * 70)
    three = rasterize(survey, grid)
    for other in (two, three):
        np.testing.assert_array_equal(other.height, one.height)
        np.testing.assert_array_equal(other.samples, one.samples)
        np.testing.assert_array_equal(other.color_valid, one.color_valid)
        np.testing.assert_array_equal(other.color, one.color)
    assert 0.2 < one.color_valid.sum() / one.valid.sum() < 0.98


def test_pages_are_decoded_one_by_one_and_once():
    calls = []

    def loader(index):
        def load():
            calls.append(index)
            return noise(10, 10, index)

        return load

    pages = [Texture(f"{i}.png", (10, 10), loader(i)) for i in range(2)]
    survey = two_page_mesh(*pages)
    assert calls == []
    rasterize(survey, Grid(0, 1, 0.1, (10, 20)), PLAIN)
    assert calls == [0, 1]
    calls.clear()
    rasterize(survey, Grid(0, 1, 0.1, (10, 8)), PLAIN)  # the east half lies outside
    assert calls == [0]


def test_a_page_that_fails_leaves_its_faces_uncolored_and_is_counted(caplog):
    def fail():
        raise InputError("The image is truncated.", file="right.png")

    survey = two_page_mesh(page(noise(10, 10)), Texture("right.png", (10, 10), fail))
    with caplog.at_level(logging.WARNING, "meshreg"):
        raster = rasterize(survey, Grid(0, 1, 0.1, (10, 20)), PLAIN)
    assert raster.masked == {"missing page": 2}
    assert raster.valid.all()
    assert raster.color_valid[:, :10].all()
    assert not raster.color_valid[:, 10:].any()
    assert not raster.color[:, 10:].any()
    assert "right.png" in caplog.text
    assert "truncated" in caplog.text


def test_a_page_of_another_size_than_its_header_says_is_left_out():
    wrong = Texture("wrong.png", (10, 10), lambda: noise(5, 10))
    raster = rasterize(two_page_mesh(wrong, page(noise(10, 10))), Grid(0, 1, 0.1, (10, 20)), PLAIN)
    assert raster.masked == {"missing page": 2}
    assert raster.color_valid.sum() == 100


def test_transparent_texels_give_no_color_and_do_not_bleed():
    image = noise(20, 20, 0, channels=4)
    image[..., 3] = 255
    image[:, 10:, :3] = (255, 0, 255)
    image[:, 10:, 3] = 127
    raster = rasterize(draped(image, 1.0, 1.0), Grid(0, 1, 0.1, (10, 10)), PLAIN)
    assert raster.valid.all()
    assert raster.color_valid[:, :5].all()
    assert not raster.color_valid[:, 5:].any()
    opaque = image[..., :3].copy()
    opaque[:, 10:] = opaque[:, 9:10]
    other = rasterize(draped(opaque, 1.0, 1.0), Grid(0, 1, 0.1, (10, 10)), PLAIN)
    np.testing.assert_array_equal(raster.color[:, :5], other.color[:, :5])


def atlas(texels_per_cell, fill):
    """A 1 m sheet whose texture lies in the middle of a page filled with `fill`, grey 100."""
    count = 10 * texels_per_cell
    image = np.full((2 * count, 2 * count, 3), fill, np.uint8)
    start = count // 2 + 3  # off the blocks that are averaged
    image[start : start + count, start : start + count] = 100
    survey = draped(image, 1.0, 1.0)
    size = 2.0 * count
    corner = np.array([start / size, 1 - (start + count) / size], np.float32)
    mesh = dataclasses.replace(survey.geometry, uv=survey.geometry.uv * np.float32(0.5) + corner)
    return dataclasses.replace(survey, geometry=mesh)


@pytest.mark.parametrize("texels_per_cell", [16, 40, 100])
def test_averaged_pages_take_in_nothing_from_beside_a_chart(texels_per_cell):
    """The surroundings of a chart that no face uses, however bright, leave no seam."""
    survey = atlas(texels_per_cell, fill=255)
    raster = rasterize(survey, Grid(0, 1, 0.1, (10, 10)), PLAIN)
    times = samples_per_side(0.1, measure_spacing(survey))
    assert texels_per_cell / times >= 1.9  # the page is averaged, or this tests nothing
    # The texels that the outline itself cuts belong to the fill: the rounding of coordinates.
    assert np.abs(raster.color[1:-1, 1:-1].astype(int) - 100).max() == 0
    assert np.abs(raster.color.astype(int) - 100).max() <= 8


def test_an_averaged_page_that_wraps_keeps_its_period():
    image = np.zeros((60, 60, 3), np.uint8)
    image[:, 30:] = 200
    survey = draped(image, 2.0, 2.0)
    mesh = dataclasses.replace(survey.geometry, uv=survey.geometry.uv * 10)
    survey = dataclasses.replace(survey, geometry=mesh)
    # Ten periods of 0.2 m, cells of 0.1 m: 30 texels a cell, dark and bright in turn.
    raster = rasterize(survey, Grid(0, 2, 0.1, (20, 20)), PLAIN)
    assert raster.color[:, ::2].max() <= 30
    assert raster.color[:, 1::2].min() >= 170


def test_vertex_colors_fill_in_where_a_face_has_no_page():
    survey = two_page_mesh(page(noise(4, 4)), page(noise(4, 4)))
    mesh = survey.geometry
    on = np.where(mesh.face_texture == 1, -1, 0)
    colors = np.full((len(mesh.vertices), 3), (10, 20, 30))
    mesh = dataclasses.replace(mesh, face_texture=on, colors=colors)
    raster = rasterize(dataclasses.replace(survey, geometry=mesh), Grid(0, 1, 0.1, (10, 20)), PLAIN)
    assert (raster.color[:, 10:] == (10, 20, 30)).all()
    assert raster.color_valid.all()
    assert raster.color[:, :10].std() > 20


def test_a_mesh_without_any_color_says_so():
    raster = rasterize(sheet(lambda x, y: 0 * x), Grid(0, 4, 0.1, (40, 40)))
    assert raster.valid.all()
    assert not raster.color_valid.any()
    assert not raster.color.any()


def touched(corners, size, by):
    """Texels, wider by `by`, that a triangle touches: by separating axes, slow and plain."""
    row, col = np.indices(size)
    rims = -by, 1 + by
    square = np.stack(
        [np.stack([col + dx, row + dy], axis=-1) for dx in rims for dy in rims], axis=-2
    )
    edges = np.roll(corners, -1, axis=0) - corners
    axes = [*np.stack([-edges[:, 1], edges[:, 0]], axis=1), np.array([1, 0]), np.array([0, 1])]
    meets = np.ones(size, bool)
    for axis in axes:
        mine, theirs = corners @ axis, square @ axis
        meets &= (theirs.max(axis=-1) >= mine.min()) & (theirs.min(axis=-1) <= mine.max())
    return meets


@settings(deadline=None)  # the first example compiles
@given(st.lists(st.floats(-0.2, 1.2), min_size=6, max_size=6), st.integers(1, 3))
def test_texels_that_a_face_touches_are_those_that_no_axis_separates(numbers, workers):
    from meshreg.raster.page_kernels import covered

    size = 9, 7
    uv = np.array(numbers, np.float32).reshape(1, 3, 2)
    corners = np.stack([uv[0, :, 0] * 7.0, (1.0 - uv[0, :, 1]) * 9.0], axis=1).astype(float)
    elsewhere = np.float32([[[0, 0], [1, 0], [0, 1]]])
    found = covered(np.concatenate([elsewhere, uv]), np.int32([1, 0]), 0, size, workers)
    # a face that just reaches a texel's rim may round either way
    assert np.all(touched(corners, size, -1e-4) <= found)
    assert np.all(found <= touched(corners, size, 1e-4))
