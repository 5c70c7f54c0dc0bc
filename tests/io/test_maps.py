"""Maps: GeoTIFFs made by rasterio of surfaces that are known in closed form."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
import reference_regrid
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio import Affine
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from meshreg.errors import InputError, OutputError, ResourceLimitError, UsageError
from meshreg.io.frames.mover import make_mover
from meshreg.io.maps import geotiff, regrid
from meshreg.io.maps import pair as maps
from meshreg.io.maps import write as geotiff_write
from meshreg.io.options import ReadOptions
from meshreg.records import (
    Frame,
    Grid,
    Maps,
    PointCloud,
    Survey,
    SurveyRaster,
    Transform,
)

WEST, NORTH = 500000.0, 6000040.0
CRS = "EPSG:32754"


def ground(east, north):
    """A smooth seafloor, metres; wavelengths of some 20 m and more."""
    x, y = east - WEST, north - NORTH
    return -12 + 0.05 * x + 1.5 * np.sin(0.3 * x) * np.cos(0.2 * y)


def paint(east, north):
    """Smooth colors (..., 3)."""
    x, y = east - WEST, north - NORTH
    channels = [128 + 90 * np.sin(0.2 * x), 128 + 90 * np.cos(0.25 * y), 100 + 0.5 * x]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


def centres(affine: Affine, shape) -> tuple[np.ndarray, np.ndarray]:
    """Places of pixel centres by the affine's own definition (outer corner at (0, 0))."""
    row, col = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    return affine.a * col + affine.b * row + affine.c, affine.d * col + affine.e * row + affine.f


def write_tif(path: Path, bands, affine: Affine, crs=CRS, **extra) -> Path:
    """Write (H, W) or (bands, H, W); `mask`, `tags`, `colorinterp`, `scales`... set afterwards."""
    bands = np.asarray(bands)
    bands = bands[None] if bands.ndim == 2 else bands
    after = {k: extra.pop(k) for k in ("mask", "tags", "scales", "offsets", "units") if k in extra}
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=bands.shape[1],
        width=bands.shape[2],
        count=len(bands),
        dtype=bands.dtype,
        crs=crs,
        transform=affine,
        **extra,
    ) as dataset:
        dataset.write(bands)
        if "tags" in after:
            dataset.update_tags(**after["tags"])
        for name in ("scales", "offsets", "units"):
            if name in after:
                setattr(dataset, name, after[name])
        if "mask" in after:
            dataset.write_mask(after["mask"])
    return path


SQUARE = Affine(0.5, 0, WEST, 0, -0.5, NORTH)
SHAPE = (80, 120)


def dem(path: Path, affine=SQUARE, shape=SHAPE, **extra) -> Path:
    return write_tif(path, ground(*centres(affine, shape)).astype(np.float32), affine, **extra)


def ortho(path: Path, affine=SQUARE, shape=SHAPE, **extra) -> Path:
    colors = np.moveaxis(paint(*centres(affine, shape)), 2, 0)
    return write_tif(path, colors, affine, photometric="RGB", **extra)


def off_ground(found: Maps) -> np.ndarray:
    grid = found.height_grid
    rows, cols = np.mgrid[0 : grid.shape[0], 0 : grid.shape[1]]
    return found.height - ground(*grid.east_north(rows, cols))


def off_paint(found: Maps) -> np.ndarray:
    grid = found.color_grid
    rows, cols = np.mgrid[0 : grid.shape[0], 0 : grid.shape[1]]
    miss = found.color.astype(int) - paint(*grid.east_north(rows, cols)).astype(int)
    return miss[found.color_valid]


def test_a_plain_dem_is_taken_as_it_is(tmp_path):
    survey = maps.read(dem(tmp_path / "a.tif"), ReadOptions())
    assert survey.geometry.height_grid == Grid(WEST, NORTH, 0.5, SHAPE, CRS)
    assert np.abs(off_ground(survey.geometry)).max() < 1e-5
    assert survey.geometry.color is None
    assert survey.crs == CRS
    assert survey.notes == ()
    assert survey.name == "a"
    assert survey.source[0].format == "maps"
    assert survey.source[0].counts == {"rows": 80, "cols": 120, "valid": 9600}


def test_pixel_is_point_or_area_by_half_a_pixel(tmp_path):
    area = dem(tmp_path / "area.tif", tags={"AREA_OR_POINT": "Area"})
    point = dem(tmp_path / "point.tif", tags={"AREA_OR_POINT": "Point"})
    assert area.read_bytes() != point.read_bytes()
    for path in (area, point):
        found = maps.read(path, ReadOptions()).geometry
        assert found.height_grid.west == WEST
        assert np.abs(off_ground(found)).max() < 1e-5
    # The raw tie point of the second is the centre of the first pixel.
    with rasterio.Env(GTIFF_POINT_GEO_IGNORE=True), rasterio.open(point) as dataset:
        assert dataset.transform.c == WEST + 0.25


@pytest.mark.parametrize(
    ("affine", "shape", "why"),
    [
        (Affine(0.5, 0, WEST, 0, -0.4, NORTH), (100, 120), "by 0.4"),
        (Affine(0.4, -0.3, WEST, -0.3, -0.4, NORTH), SHAPE, "rotated"),
        (Affine(0, 0.5, WEST, 0.5, 0, NORTH - 60), SHAPE, "rotated"),
    ],
)
def test_rasters_that_are_not_square_to_north_are_sampled_anew(tmp_path, affine, shape, why):
    paths = dem(tmp_path / "a.tif", affine, shape), ortho(tmp_path / "b.tif", affine, shape)
    survey = maps.read(f"{paths[0]},{paths[1]}", ReadOptions())
    assert any(why in note for note in survey.notes)
    grid = survey.geometry.height_grid
    pixel = abs(affine.a * affine.e - affine.b * affine.d) ** 0.5
    assert abs(grid.cell / pixel - 1) < 1e-5
    miss = off_ground(survey.geometry)
    # Bilinear: an eighth of the pixel squared times the curvature, less than 0.02 m here; in the
    # outer half pixel the edge's value holds, a quarter of a pixel off on average.
    rim = binary_erosion(np.isfinite(miss), iterations=2)
    assert np.abs(miss[rim]).max() < 0.02
    assert np.nanmax(np.abs(miss)) < 0.15
    assert abs(np.nanmean(miss)) < 0.003
    covered = np.isfinite(miss).sum() * grid.cell**2
    assert abs(covered / (shape[0] * shape[1] * pixel**2) - 1) < 0.01
    off = np.abs(off_paint(survey.geometry))
    assert np.mean(off > 2) < 0.03
    assert off.max() <= 6


def test_south_up_and_nearly_square(tmp_path):
    path = dem(tmp_path / "a.tif", Affine(0.5, 0, WEST, 0, 0.5, NORTH - 40))
    found = maps.read(path, ReadOptions())
    assert found.geometry.height_grid == Grid(WEST, NORTH, 0.5, SHAPE, CRS)
    assert np.abs(off_ground(found.geometry)).max() < 1e-5
    path = dem(tmp_path / "b.tif", Affine(0.5, 0, WEST, 0, -0.5000001, NORTH))
    assert maps.read(path, ReadOptions()).notes == ()


def test_feet_become_metres(tmp_path):
    """State plane feet, heights in feet too; truth by pyproj."""
    from pyproj import Transformer

    cell = 2.0
    affine = Affine(cell, 0, 980000.0, 0, -cell, 200000.0)
    east, _ = centres(affine, SHAPE)
    height = -40 + 0.02 * (east - 980000)
    path = write_tif(tmp_path / "a.tif", height.astype(np.float32), affine, "EPSG:2263")
    survey = maps.read(path, ReadOptions())
    assert survey.crs == "EPSG:26918"  # UTM on the same datum
    grid = survey.geometry.height_grid
    assert abs(grid.cell / (cell * 1200 / 3937) - 1) < 1e-3
    rows, cols = np.nonzero(np.isfinite(survey.geometry.height))
    back = Transformer.from_crs(26918, 2263, always_xy=True)
    x, _ = back.transform(*grid.east_north(rows, cols))
    truth = (-40 + 0.02 * (np.asarray(x) - 980000)) * 1200 / 3937
    miss = survey.geometry.height[rows, cols] - truth
    inner = (x > 980002) & (x < 980238)  # at the outer half pixel the edge's value holds
    assert np.abs(miss[inner]).max() < 1e-3
    metres = maps.read(path, ReadOptions(unit="m")).geometry.height
    assert abs(np.nanmedian(metres) / np.nanmedian(survey.geometry.height) - 3937 / 1200) < 1e-6


def test_degrees_become_metres(tmp_path):
    from pyproj import Transformer

    step = 0.5e-5
    affine = Affine(step, 0, 141.0, 0, -step, -36.1)
    lon, _ = centres(affine, SHAPE)
    height = (-5 + 3e3 * (lon - 141)).astype(np.float32)
    path = write_tif(tmp_path / "a.tif", height, affine, "EPSG:4326")
    survey = maps.read(path, ReadOptions())
    assert survey.crs == CRS
    grid = survey.geometry.height_grid
    rows, cols = np.nonzero(np.isfinite(survey.geometry.height))
    x, _ = Transformer.from_crs(32754, 4326, always_xy=True).transform(*grid.east_north(rows, cols))
    inner = (x > 141 + step) & (x < 141 + 119 * step)
    miss = survey.geometry.height[rows, cols] - (-5 + 3e3 * (np.asarray(x) - 141))
    assert np.abs(miss[inner]).max() < 1e-4
    assert 0.45 < grid.cell < 0.56


@pytest.mark.parametrize(
    ("options", "sign", "shift"),
    [
        (ReadOptions(shift=(10.0, 20.0, 3.0)), 1, (10.0, 20.0, 3.0)),
        (ReadOptions(axes="ned"), -1, (0, 0, 0)),
        (ReadOptions(unit="cm"), 0.01, (0, 0, 0)),
    ],
)
def test_options_apply_to_heights(tmp_path, options, sign, shift):
    path = dem(tmp_path / "a.tif")
    plain = maps.read(path, ReadOptions()).geometry
    found = maps.read(path, options).geometry
    np.testing.assert_allclose(found.height, sign * plain.height + shift[2], rtol=1e-6)
    assert found.height_grid.west == WEST + shift[0]
    assert found.height_grid.north == NORTH + shift[1]


def test_band_says_its_unit_and_scale(tmp_path):
    whole = np.rint(ground(*centres(SQUARE, SHAPE)) * 100).astype(np.int16)
    path = write_tif(tmp_path / "a.tif", whole, SQUARE, scales=[0.01], offsets=[2.0])
    found = maps.read(path, ReadOptions()).geometry
    assert np.abs(off_ground(found) - 2).max() < 0.0051
    path = write_tif(tmp_path / "b.tif", whole, SQUARE, units=["US survey foot"])
    found = maps.read(path, ReadOptions()).geometry
    np.testing.assert_allclose(found.height, whole * (1200 / 3937), rtol=1e-6)


@pytest.mark.parametrize("value", [-9999, -10000, -32767, -32768, -3.4028234663852886e38, 0])
def test_undeclared_nodata_is_recognised(tmp_path, value):
    height = ground(*centres(SQUARE, SHAPE)).astype(np.float32)
    height[:10, :10] = value
    survey = maps.read(write_tif(tmp_path / "a.tif", height, SQUARE), ReadOptions())
    assert np.isnan(survey.geometry.height[:10, :10]).all()
    assert np.isfinite(survey.geometry.height).sum() == 9500
    assert "undeclared (100 of 9600 cells)" in survey.notes[0]


def test_a_usual_value_among_the_data_is_kept(tmp_path):
    height = ground(*centres(SQUARE, SHAPE)).astype(np.float32) - 9990
    height[0, 0] = -9999
    survey = maps.read(write_tif(tmp_path / "a.tif", height, SQUARE), ReadOptions())
    assert survey.geometry.height[0, 0] == -9999
    assert "kept" in survey.notes[0]
    height += 9990 + 12  # zero lies among these
    height[0, 0] = 0
    survey = maps.read(write_tif(tmp_path / "b.tif", height, SQUARE), ReadOptions())
    assert np.isfinite(survey.geometry.height).all()
    assert survey.notes == ()


def test_declared_nodata_inside_the_data_is_warned_of(tmp_path):
    height = ground(*centres(SQUARE, SHAPE)).astype(np.float32) + 7
    height[:3] = -5
    survey = maps.read(write_tif(tmp_path / "a.tif", height, SQUARE, nodata=-5), ReadOptions())
    assert np.isnan(survey.geometry.height[:3]).all()
    assert np.isfinite(survey.geometry.height).sum() == 77 * 120
    assert "-5 lies inside the heights" in survey.notes[0]


def test_mask_band_alpha_and_infinities(tmp_path):
    height = ground(*centres(SQUARE, SHAPE)).astype(np.float32)
    height[5, 5], height[6, 6] = np.inf, np.nan
    keep = np.ones(SHAPE, np.uint8) * 255
    keep[:4] = 0
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        path = write_tif(tmp_path / "a.tif", height, SQUARE, mask=keep)
    found = maps.read(path, ReadOptions()).geometry
    assert np.isnan(found.height[:4]).all()
    assert np.isfinite(found.height).sum() == 76 * 120 - 2


def test_alpha_of_an_orthomosaic(tmp_path):
    colors = np.moveaxis(paint(*centres(SQUARE, SHAPE)), 2, 0)
    alpha = np.full((1, *SHAPE), 255, np.uint8)
    alpha[0, :, :30] = 0
    path = write_tif(
        tmp_path / "b.tif", np.concatenate([colors, alpha]), SQUARE, photometric="RGB", alpha="YES"
    )
    survey = maps.read(f"{dem(tmp_path / 'a.tif')},{path}", ReadOptions())
    found = survey.geometry
    assert not found.color_valid[:, :30].any()
    assert found.color_valid[:, 30:].all()
    assert np.abs(off_paint(found)).max() == 0
    assert (found.color[:, :30] == 0).all()


@pytest.mark.parametrize(("value", "name"), [(0, "black"), (255, "white")])
def test_undeclared_border_of_an_orthomosaic(tmp_path, value, name):
    colors = np.moveaxis(paint(*centres(SQUARE, SHAPE)), 2, 0)
    colors[:, :, :20] = value
    path = write_tif(tmp_path / "b.tif", colors, SQUARE, photometric="RGB")
    survey = maps.read(f"{dem(tmp_path / 'a.tif')},{path}", ReadOptions())
    assert survey.geometry.color_valid.sum() == 80 * 100
    assert f"Pure {name}" in survey.notes[0]
    colors[:, :, :20] = 100
    colors[:, 30:40, 30:40] = value  # not along the border: a black stone, a white tile
    write_tif(path, colors, SQUARE, photometric="RGB")
    survey = maps.read(f"{dem(tmp_path / 'a.tif')},{path}", ReadOptions())
    assert survey.geometry.color_valid.all()


@pytest.mark.parametrize(
    ("top", "dtype"), [(65535, "uint16"), (4095, "uint16"), (1.0, "float32"), (255, "float32")]
)
def test_deep_colors_are_scaled(tmp_path, top, dtype):
    colors = np.moveaxis(paint(*centres(SQUARE, SHAPE)), 2, 0) / 255.0 * top
    colors[0, 0, 0] = top
    deep = (colors if dtype == "float32" else np.rint(colors)).astype(dtype)
    path = write_tif(tmp_path / "b.tif", deep, SQUARE, photometric="RGB")
    survey = maps.read(f"{dem(tmp_path / 'a.tif')},{path}", ReadOptions())
    miss = np.abs(off_paint(survey.geometry))
    assert miss[3:].max() <= 1
    assert bool(survey.notes) == (top != 255)


def test_palette_and_grey(tmp_path):
    index = np.tile(np.array([[0, 1], [2, 3]], np.uint8), (40, 60))
    path = tmp_path / "b.tif"
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=80,
        width=120,
        count=1,
        dtype="uint8",
        crs=CRS,
        transform=SQUARE,
        photometric="PALETTE",
    ) as dataset:
        dataset.write(index[None])
        dataset.write_colormap(1, {0: (9, 8, 7), 1: (255, 0, 0), 2: (0, 0, 9), 3: (1, 2, 3)})
    first = dem(tmp_path / "a.tif")
    found = maps.read(f"{first},{path}", ReadOptions()).geometry
    np.testing.assert_array_equal(
        found.color[:2, :2], [[[9, 8, 7], [255, 0, 0]], [[0, 0, 9], [1, 2, 3]]]
    )
    write_tif(path, index + 50, SQUARE)
    found = maps.read(f"{first},{path}", ReadOptions()).geometry
    np.testing.assert_array_equal(found.color, np.repeat(index[..., None] + 50, 3, 2))


def test_orthomosaic_in_another_crs_comes_to_the_dems(tmp_path):
    from pyproj import Transformer

    first = dem(tmp_path / "a.tif")
    # The same place in zone 53: turned by some degrees of convergence.
    there = Transformer.from_crs(32754, 32753, always_xy=True)
    west, north = np.floor(there.transform(WEST, NORTH + 5))
    affine = Affine(0.4, 0, west, 0, -0.4, north)
    east, up = there.transform(*centres(affine, (160, 200)), direction="INVERSE")
    path = write_tif(
        tmp_path / "b.tif",
        np.moveaxis(paint(east, up), 2, 0),
        affine,
        "EPSG:32753",
        photometric="RGB",
    )
    survey = maps.read(f"{first},{path}", ReadOptions())
    assert survey.geometry.color_grid.crs == CRS
    assert survey.geometry.color_valid.sum() > 25000
    off = np.abs(off_paint(survey.geometry))
    assert np.mean(off > 2) < 0.03  # those in the outer half pixel
    assert off.max() <= 6
    assert any("from EPSG:32753" in note for note in survey.notes)
    with pytest.raises(InputError, match="does not overlap"):
        maps.read(f"{first},{path}", ReadOptions(crs=CRS))


def test_crs_of_one_map_counts_for_both(tmp_path):
    first, second = dem(tmp_path / "a.tif", crs=None), ortho(tmp_path / "b.tif")
    survey = maps.read(f"{first},{second}", ReadOptions())
    assert any("states no CRS" in note for note in survey.notes)
    assert survey.geometry.color_grid.crs == survey.crs
    second = ortho(tmp_path / "b.tif", crs=None)
    survey = maps.read(f"{dem(tmp_path / 'a.tif')},{second}", ReadOptions())
    assert survey.geometry.color_grid.crs == CRS


def test_either_order_but_no_picture_alone(tmp_path):
    first, second = dem(tmp_path / "a.tif"), ortho(tmp_path / "b.tif")
    survey = maps.read(f"{second}, {first}", ReadOptions())
    assert [source.path for source in survey.source] == [first, second]
    assert survey.source[1].companions == (first,)
    with pytest.raises(InputError, match="picture, not a DEM") as caught:
        maps.read(second, ReadOptions())
    assert "dem.tif,ortho.tif" in str(caught.value)
    with pytest.raises(InputError, match="is a DEM, not a picture"):
        maps.read_pair(first, first, ReadOptions())
    with pytest.raises(UsageError, match="3 maps"):
        maps.read(f"{first},{second},{second}", ReadOptions())


def test_no_overlap(tmp_path):
    first = dem(tmp_path / "a.tif")
    second = ortho(tmp_path / "b.tif", Affine(0.5, 0, WEST + 61, 0, -0.5, NORTH))
    with pytest.raises(InputError, match="does not overlap its DEM"):
        maps.read(f"{first},{second}", ReadOptions())


def test_a_vrt_called_tif_is_refused(tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(range(100)))
    path = tmp_path / "a.tif"
    path.write_text(
        '<VRTDataset rasterXSize="10" rasterYSize="10"><GeoTransform>0,1,0,9,0,-1'
        '</GeoTransform><VRTRasterBand dataType="Byte" band="1" '
        f'subClass="VRTRawRasterBand"><SourceFilename>{secret}</SourceFilename>'
        "</VRTRasterBand></VRTDataset>"
    )
    with rasterio.open(path) as dataset:  # GDAL by itself reads the other file
        assert dataset.read(1)[0, 3] == 3
    with pytest.raises(InputError, match="is not a TIFF"):
        maps.read(path, ReadOptions())


def test_files_beside_are_not_followed(tmp_path):
    """A .msk or .ovr beside a TIFF is opened by GDAL with any of its drivers."""
    path = dem(tmp_path / "a.tif")
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(80 * 120))
    vrt = (
        '<VRTDataset rasterXSize="120" rasterYSize="80"><VRTRasterBand dataType="Byte" band="1" '
        f'subClass="VRTRawRasterBand"><SourceFilename>{secret}</SourceFilename></VRTRasterBand>'
        '<Metadata><MDI key="INTERNAL_MASK_FLAGS_1">2</MDI></Metadata></VRTDataset>'
    )
    (tmp_path / "a.tif.msk").write_text(vrt)
    (tmp_path / "a.tif.ovr").write_text(vrt)
    (tmp_path / "a.tif.aux.xml").write_text(
        '<PAMDataset><PAMRasterBand band="1"><NoDataValue>-12</NoDataValue></PAMRasterBand>'
        "</PAMDataset>"
    )
    assert np.isfinite(maps.read(path, ReadOptions()).geometry.height).all()


@pytest.mark.parametrize("cut", [0, 3, 8, 200, 0.5])
def test_truncated(tmp_path, cut):
    path = dem(tmp_path / "a.tif")
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * cut) if cut == 0.5 else cut])
    with pytest.raises(InputError) as caught:
        maps.read(path, ReadOptions())
    assert caught.value.file.endswith("a.tif")


def test_size_limits(tmp_path):
    path = dem(tmp_path / "a.tif")
    with pytest.raises(ResourceLimitError, match="120 × 80 pixels"):
        maps.read(path, ReadOptions(max_pixels=9599))
    bomb = tmp_path / "bomb.tif"
    with rasterio.open(
        bomb,
        "w",
        driver="GTiff",
        height=30000,
        width=30000,
        count=1,
        dtype="float32",
        transform=SQUARE,
        crs=CRS,
        sparse_ok=True,
        tiled=True,
        blockxsize=16384,
        blockysize=16384,
    ):
        pass
    assert bomb.stat().st_size < 1000
    with pytest.raises(InputError, match="declares 30000 × 30000 pixels"):
        maps.read(bomb, ReadOptions())


def test_no_georeference_and_world_files(tmp_path):
    height = ground(*centres(SQUARE, SHAPE)).astype(np.float32)
    path = tmp_path / "a.tif"
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        write_tif(path, height, Affine.identity(), None)
    with pytest.raises(InputError, match="no georeference"):
        maps.read(path, ReadOptions())
    (tmp_path / "a.tfw").write_text(f"0.5\n0\n0\n-0.5\n{WEST + 0.25}\n{NORTH - 0.25}\n")
    survey = maps.read(path, ReadOptions(crs=CRS))
    assert survey.geometry.height_grid == Grid(WEST, NORTH, 0.5, SHAPE, CRS)
    (tmp_path / "a.tfw").write_text("0.5\n0\n")
    with pytest.raises(InputError, match="six numbers"):
        maps.read(path, ReadOptions())


def test_ground_control_points_alone_do_not_place_a_map(tmp_path):
    path = tmp_path / "a.tif"
    gcps = [
        rasterio.control.GroundControlPoint(r, c, WEST + c, NORTH - r)
        for r, c in ((0, 0), (0, 9), (9, 0), (9, 9))
    ]
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=80,
        width=120,
        count=1,
        dtype="float32",
        gcps=gcps,
        crs=CRS,
    ) as dataset:
        dataset.write(ground(*centres(SQUARE, SHAPE)).astype(np.float32)[None])
    with pytest.raises(InputError, match="ground control points only"):
        maps.read(path, ReadOptions())


def test_nothing_but_nodata(tmp_path):
    path = write_tif(tmp_path / "a.tif", np.full(SHAPE, -9999, np.float32), SQUARE, nodata=-9999)
    with pytest.raises(InputError, match="every cell is without data"):
        maps.read(path, ReadOptions())


def move_of(survey: Survey, transform: Transform, target: Frame, number: int = 0):
    return make_mover(survey.source[number], transform, target, centre=survey.centre)


def pair(tmp_path: Path) -> Survey:
    first, second = dem(tmp_path / "a.tif"), ortho(tmp_path / "b.tif")
    return maps.read(f"{first},{second}", ReadOptions())


@pytest.mark.parametrize(
    "turn",
    [
        np.eye(3),
        Rotation.from_euler("z", 1.5, degrees=True).as_matrix(),
        Rotation.from_euler("xyz", [3, -2, 10], degrees=True).as_matrix(),
    ],
    ids=["shift", "yaw", "tilt"],
)
@pytest.mark.parametrize("scale", [1.0, 1.01])
def test_rewrite_moves_the_surface(tmp_path, turn, scale):
    """Each new cell's place, moved back, lies on the old surface and has the old color."""
    survey = pair(tmp_path)
    transform = Transform(turn, scale, [13.37, -8.71, 1.25], survey.centre)
    paths = []
    for number, name in enumerate(("dem.tif", "ortho.tif")):
        move = move_of(survey, transform, survey.source[0].frame, number)
        paths += maps.rewrite(survey.source[number], move, tmp_path / name)
    found = maps.read(f"{paths[0]},{paths[1]}", ReadOptions()).geometry
    rows, cols = np.nonzero(np.isfinite(found.height))
    east, north = found.height_grid.east_north(rows, cols)
    points = np.column_stack([east, north, found.height[rows, cols]])
    back = transform.inverse().apply(points)
    miss = back[:, 2] - ground(back[:, 0], back[:, 1])
    inner = ((np.abs(back[:, :2] - [WEST + 30, NORTH - 20])) < [29, 19]).all(axis=1)
    assert np.abs(miss[inner]).max() < 0.015  # bilinear in 0.5 m cells
    assert abs(miss[inner].mean()) < 0.002
    assert abs(inner.sum() * 0.25 / (58 * 38 * scale**2) - 1) < 0.03
    # Colors lie where the surface under them has gone.
    grid = found.color_grid
    rows, cols = np.nonzero(found.color_valid)
    east, north = grid.east_north(rows, cols)
    up = np.full(len(rows), np.nan)
    r, c = np.rint(found.height_grid.row_col(east, north)).astype(int)
    ok = (r >= 0) & (r < found.height.shape[0]) & (c >= 0) & (c < found.height.shape[1])
    up[ok] = found.height[r[ok], c[ok]]
    back = transform.inverse().apply(np.column_stack([east, north, up]))
    inner = ((np.abs(back[:, :2] - [WEST + 30, NORTH - 20])) < [29, 19]).all(axis=1)
    expected = paint(back[inner, 0], back[inner, 1]).astype(int)
    assert np.abs(found.color[rows, cols][inner] - expected).max() <= 4
    assert grid.cell == found.height_grid.cell


def test_rewrite_refuses_a_file_that_has_changed(tmp_path):
    survey = pair(tmp_path)
    with open(tmp_path / "a.tif", "ab") as stream:
        stream.write(b"more")
    move = move_of(survey, Transform(), survey.source[0].frame)
    with pytest.raises(InputError, match="has changed"):
        maps.rewrite(survey.source[0], move, tmp_path / "moved.tif")
    assert not (tmp_path / "moved.tif").exists()


def test_whole_cells_move_without_any_loss(tmp_path):
    """A shift by whole cells must give back the same numbers, and its inverse the same file."""
    survey = pair(tmp_path)
    transform = Transform(offset=[5.0, -3.5, 0.0])
    move = move_of(survey, transform, survey.source[0].frame)
    maps.rewrite(survey.source[0], move, tmp_path / "moved.tif")
    moved = maps.read(tmp_path / "moved.tif", ReadOptions())
    assert moved.geometry.height_grid == Grid(WEST + 5, NORTH - 3.5, 0.5, SHAPE, CRS)
    np.testing.assert_array_equal(moved.geometry.height, survey.geometry.height)


def test_moved_maps_share_the_lattice_of_their_cell(tmp_path):
    survey = pair(tmp_path)
    move = move_of(survey, Transform(offset=[0.12, 0.34, 0.0]), survey.source[0].frame)
    maps.rewrite(survey.source[0], move, tmp_path / "moved.tif")
    grid = maps.read(tmp_path / "moved.tif", ReadOptions()).geometry.height_grid
    assert grid.west / 0.5 == round(grid.west / 0.5)
    assert grid.north / 0.5 == round(grid.north / 0.5)


def test_rewrite_into_a_local_frame_and_another_crs(tmp_path):
    """Maps state absolute coordinates, whatever axes and shift the reference's file has."""
    from pyproj import Transformer

    survey = pair(tmp_path)
    ned = Frame([[0, 1, 0], [1, 0, 0], [0, 0, -1]], [WEST, NORTH, 0], CRS, CRS)
    move = move_of(survey, Transform(), ned)
    maps.rewrite(survey.source[0], move, tmp_path / "local.tif")
    found = maps.read(tmp_path / "local.tif", ReadOptions()).geometry
    assert found.height_grid == survey.geometry.height_grid
    other = Frame(file_crs="EPSG:32753", crs="EPSG:32753")
    move = move_of(survey, Transform(), other)
    maps.rewrite(survey.source[0], move, tmp_path / "zone.tif")
    moved = maps.read(tmp_path / "zone.tif", ReadOptions())
    assert moved.crs == "EPSG:32753"
    again = maps.reproject(survey.geometry, "EPSG:32753")
    for found in (moved.geometry, again):
        rows, cols = np.nonzero(np.isfinite(found.height))
        east, north = found.height_grid.east_north(rows, cols)
        back = np.array(Transformer.from_crs(32753, 32754, always_xy=True).transform(east, north))
        inner = ((np.abs(back.T - [WEST + 30, NORTH - 20])) < [29, 19]).all(axis=1)
        miss = found.height[rows, cols] - ground(*back)
        assert np.abs(miss[inner]).max() < 0.015
    with pytest.raises(UsageError, match="no CRS"):
        maps.reproject(Maps(np.zeros((2, 2)), Grid(0, 0, 1, (2, 2))), CRS)


@settings(max_examples=25, deadline=None)
@given(st.floats(-180, 180), st.floats(-50, 50), st.floats(-50, 50), st.floats(0.3, 3))
def test_a_plane_stays_a_plane_under_any_turn(yaw, east, north, cell):
    """Bilinear sampling is exact on planes; so is the way to each cell."""
    grid = Grid(WEST, NORTH, 0.5, (60, 70), None)
    rows, cols = np.mgrid[0:60, 0:70]
    x, y = grid.east_north(rows, cols)
    height = (0.25 * (x - WEST) - 0.125 * (y - NORTH)).astype(np.float32)
    turn = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
    transform = Transform(turn, 1.0, [east, north, 2.0], [WEST, NORTH, 0])
    placed = regrid.placed_grid(grid, transform.apply)
    target = regrid.covering_grid(placed, None, cell)
    moved, valid = regrid.regrid(height, np.isfinite(height), placed, target, is_height=True)
    r, c = np.nonzero(valid)
    e, n = target.east_north(r, c)
    back = transform.inverse().apply(np.column_stack([e, n, np.zeros(len(e))]))
    inside = (
        (back[:, :2] > [WEST + 0.25, NORTH - 29.75]) & (back[:, :2] < [WEST + 34.75, NORTH - 0.25])
    ).all(axis=1)
    truth = 0.25 * (back[:, 0] - WEST) - 0.125 * (back[:, 1] - NORTH) + 2
    np.testing.assert_allclose(moved[r, c][inside], truth[inside], atol=1e-4)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.booleans(), st.booleans(), st.sampled_from([1, 7, 32]))
def test_kernel_equals_its_slow_twin(seed, is_height, with_tilt, step):
    rng = np.random.default_rng(seed)
    shape = (40, 50)
    valid = rng.random(shape) > 0.2
    height = rng.normal(0, 1, shape).astype(np.float32)
    height[rng.random(shape) < 0.1] = np.nan
    values = height[..., None] if is_height else rng.integers(0, 256, (*shape, 3)).astype(np.uint8)
    valid &= np.isfinite(height)
    angles = [2, -3, 40] if with_tilt else [0, 0, 40]
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    placed = regrid.Placed(
        np.array([[0.5, 0.1, WEST], [0.05, -0.4, NORTH]]),
        shape,
        Transform(turn, 1.0, rng.normal(0, 5, 3), [WEST, NORTH, 0]).apply,
        0.5,
    )
    grid = regrid.covering_grid(placed, None)
    surface = (height, placed) if with_tilt else None
    array = values[..., 0] if is_height else values
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(regrid, "_STEP", step)
        fast, seen = regrid.regrid(array, valid, placed, grid, is_height=is_height, surface=surface)
        source = regrid.Source(placed, grid)
    slow, expected = reference_regrid.resample(
        values, valid, placed, source, height if with_tilt else None, placed, is_height
    )
    # A cell whose source lies midway between two pixels may round either way.
    assert (seen != expected).mean() < 1e-3
    both = seen & expected
    slow = slow[..., 0] if is_height else slow
    if is_height:
        np.testing.assert_allclose(fast[both], slow[both], rtol=0, atol=1e-5)
    else:
        assert np.abs(fast[both].astype(int) - slow[both]).max(initial=0) <= 1
        assert (fast[both] != slow[both]).mean() < 1e-3
    assert with_tilt == source.tilts(height)


def test_missing_cells_neither_spread_nor_close():
    grid = Grid(0, 20, 1, (20, 20), None)
    height = np.ones((20, 20), np.float32)
    height[8:12, 8:12] = np.nan
    placed = regrid.placed_grid(grid, lambda p: p + np.array([0.25, 0.25, 0]))
    target = Grid(0, 21, 1, (21, 21), None)
    moved, valid = regrid.regrid(height, np.isfinite(height), placed, target, is_height=True)
    assert (moved[valid] == 1).all()
    assert np.isnan(moved[~valid]).all()
    assert (~valid[5:18, 5:18]).sum() == 16


def raster(seed: int = 0) -> SurveyRaster:
    rng = np.random.default_rng(seed)
    grid = Grid(WEST, NORTH, 0.1, (600, 700), CRS)
    height = rng.normal(0, 1, grid.shape).astype(np.float32)
    valid = rng.random(grid.shape) > 0.2
    height[~valid] = np.nan
    color = rng.integers(0, 255, (*grid.shape, 3)).astype(np.uint8)
    return SurveyRaster(grid, height, color, valid, ~valid, np.ones(grid.shape, np.uint16), -30.0)


def test_write_raster_height(tmp_path):
    made = raster()
    maps.write_raster(made, tmp_path / "dem.tif")
    with rasterio.open(tmp_path / "dem.tif") as dataset:
        assert dataset.nodata == -9999
        assert dataset.dtypes == ("float32",)
        assert dataset.crs.to_epsg() == 32754
        assert dataset.tags()["AREA_OR_POINT"] == "Area"
        assert dataset.tags()["TIFFTAG_SOFTWARE"].startswith("meshreg ")
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dataset.overviews(1) == [2]
        assert tuple(dataset.bounds) == pytest.approx(made.grid.bounds, abs=1e-9)
        values = dataset.read(1, masked=True)
    np.testing.assert_array_equal(~np.ma.getmaskarray(values), made.valid)
    expected = (made.height[made.valid].astype(float) - 30).astype(np.float32)
    np.testing.assert_array_equal(values.compressed(), expected)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dem.tif"]


def test_write_raster_color(tmp_path):
    made = raster()
    maps.write_raster(made, tmp_path / "ortho.tif", "color")
    with rasterio.open(tmp_path / "ortho.tif") as dataset:
        assert [c.name for c in dataset.colorinterp] == ["red", "green", "blue", "alpha"]
        bands = dataset.read()
        np.testing.assert_array_equal(dataset.dataset_mask() > 0, made.color_valid)
    np.testing.assert_array_equal(np.moveaxis(bands[:3], 0, 2), made.color)


def test_rasters_read_back_as_a_survey(tmp_path):
    made = raster()
    maps.write_raster(made, tmp_path / "dem.tif")
    maps.write_raster(made, tmp_path / "ortho.tif", "color")
    survey = maps.read(f"{tmp_path / 'dem.tif'},{tmp_path / 'ortho.tif'}", ReadOptions())
    assert survey.notes == ()
    found = survey.geometry
    assert found.height_grid.west == made.grid.west
    np.testing.assert_array_equal(np.isfinite(found.height), made.valid)
    np.testing.assert_array_equal(found.color[found.color_valid], made.color[made.color_valid])
    names = maps.write(survey, tmp_path / "copy_dem.tif")
    assert [p.name for p in names] == ["copy_dem.tif", "copy_ortho.tif"]
    again = maps.read(",".join(map(str, names)), ReadOptions()).geometry
    np.testing.assert_array_equal(again.height, found.height)
    np.testing.assert_array_equal(again.color, found.color)


def test_local_frame_without_crs(tmp_path):
    height = np.arange(12, dtype=np.float32).reshape(3, 4)
    survey = Survey("reef", Maps(height, Grid(1.5, 2.5, 0.25, (3, 4))))
    maps.write(survey, tmp_path / "a.tif")
    again = maps.read(tmp_path / "a.tif", ReadOptions())
    assert again.crs is None
    assert again.geometry.height_grid == survey.geometry.height_grid
    np.testing.assert_array_equal(again.geometry.height, height)
    feet = maps.read(tmp_path / "a.tif", ReadOptions(unit="ft")).geometry
    assert feet.height_grid.cell == pytest.approx(0.25 * 0.3048, rel=1e-5)
    assert np.nanmax(feet.height) == pytest.approx(11 * 0.3048, rel=1e-5)


def test_only_maps_are_written(tmp_path):
    survey = Survey("reef", PointCloud(np.zeros((1, 3))))
    with pytest.raises(UsageError, match="PointCloud is not written as GeoTIFF"):
        maps.write(survey, tmp_path / "a.tif")


def test_what_does_not_read_back_is_not_kept(tmp_path, monkeypatch):
    (tmp_path / "dem.tif").write_bytes(b"old")
    real = geotiff.opened

    def damaged(path, max_pixels):
        data = bytearray(Path(path).read_bytes())
        data[len(data) // 2] ^= 255
        Path(path).write_bytes(data)
        return real(path, max_pixels)

    monkeypatch.setattr(geotiff_write, "opened", damaged)
    with pytest.raises(OutputError):
        maps.write_raster(raster(), tmp_path / "dem.tif")
    assert (tmp_path / "dem.tif").read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["dem.tif"]


def test_folder_that_is_not_there(tmp_path):
    with pytest.raises(OutputError):
        maps.write_raster(raster(), tmp_path / "no" / "dem.tif")


_FILLING = """
import resource, signal, sys
import numpy as np
import subprocess
import sys
from pathlib import Path
from meshreg.errors import OutputError
from meshreg.io.maps.write import write_height
from meshreg.records import Grid

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
folder = Path(sys.argv[1])
height = np.random.default_rng(0).normal(size=(600, 700)).astype(np.float32)
write_height(height, Grid(0.0, 600.0, 1.0, height.shape), folder / "whole.tif")
whole = (folder / "whole.tif").read_bytes()
for part in (0.0, 0.001, 0.1, 0.5, 0.9, 0.99, 0.99999, 1.0):
    size = int(part * len(whole))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    try:
        write_height(height, Grid(0.0, 600.0, 1.0, height.shape), folder / "part.tif")
    except OutputError as error:
        assert part < 1.0, error
        assert "What was there before is intact" in str(error), error
        assert [path.name for path in folder.iterdir()] == ["whole.tif"]
    else:
        assert part == 1.0, part
        assert (folder / "part.tif").read_bytes() == whole
print("done")
"""


def test_a_disk_that_is_full_at_any_byte_is_an_error(tmp_path):
    """GDAL itself is silent where the blocks fail that it writes while it closes a file."""
    done = subprocess.run(
        [sys.executable, "-c", _FILLING, tmp_path], capture_output=True, text=True, check=False
    )
    assert done.stdout == "done\n", done.stderr
    assert done.stderr == ""  # GDAL writes nothing to the disk that it could complain of
