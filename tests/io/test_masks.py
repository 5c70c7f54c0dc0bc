"""Masks: against matplotlib's point-in-polygon and rasters made by rasterio."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
import shapefile
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from rasterio import Affine

from meshreg.errors import InputError
from meshreg.io.masks import files as mask_polygons
from meshreg.io.masks import read as masks
from meshreg.records import Frame, Grid, PointCloud, SourceFile, Survey

CRS = "EPSG:32754"
# Corners that lie on no cell centre and on no line through them.
OUTER = [[0.011, 0.007], [10.03, 1.013], [11.017, 9.019], [5.023, 12.029], [-1.031, 8.037]]
HOLE = [[3.003, 3.009], [3.011, 6.017], [6.019, 6.023], [6.029, 3.031]]
SECOND = [[15.007, 0.013], [19.009, 0.017], [19.021, 5.003]]
GRID = Grid(-3.0, 14.0, 0.1, (160, 240))


def closed(ring):
    return [*ring, ring[0]]


def feature(*rings, properties=None):
    geometry = {"type": "Polygon", "coordinates": [closed(ring) for ring in rings]}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def write_json(path: Path, *features, **extra) -> Path:
    document = {"type": "FeatureCollection", "features": list(features), **extra}
    path.write_text(json.dumps(document))
    return path


def places(grid: Grid = GRID):
    rows, cols = np.mgrid[0 : grid.shape[0], 0 : grid.shape[1]]
    return grid.east_north(rows, cols)


def truth(*outlines, grid: Grid = GRID):
    """Inside each outline, by matplotlib, as one (H, W) array for each."""
    east, north = places(grid)
    points = np.column_stack([east.ravel(), north.ravel()])
    return [Outline(outline).contains_points(points).reshape(grid.shape) for outline in outlines]


def test_holes_and_several_polygons(tmp_path):
    path = write_json(tmp_path / "m.geojson", feature(OUTER, HOLE), feature(SECOND))
    mask = masks.read_mask(path)
    outer, hole, second = truth(OUTER, HOLE, SECOND)
    expected = (outer & ~hole) | second
    np.testing.assert_array_equal(mask(GRID), expected)
    np.testing.assert_array_equal(mask.at(*places()), expected)
    np.testing.assert_array_equal(masks.read_mask(path, invert=True)(GRID), ~expected)
    assert mask.at(4.5, 4.5).shape == ()
    assert not mask.at(4.5, 4.5)
    assert mask.at([1.0, 100.0], 2.0).tolist() == [True, False]


def test_multipolygon_collection_and_third_coordinate(tmp_path):
    rings = [[[*corner, 7.0] for corner in closed(ring)] for ring in (OUTER, HOLE, SECOND)]
    multi = {"type": "MultiPolygon", "coordinates": [rings[:2], rings[2:]]}
    path = tmp_path / "m.json"
    path.write_text(
        json.dumps(
            {
                "type": "GeometryCollection",
                "geometries": [{"type": "Point", "coordinates": [0, 0]}, multi],
            }
        ),
        "utf-8-sig",
    )
    outer, hole, second = truth(OUTER, HOLE, SECOND)
    np.testing.assert_array_equal(masks.read_mask(path)(GRID), (outer & ~hole) | second)


def test_polygons_that_overlap_add_up(tmp_path):
    shifted = [[x + 2, y] for x, y in OUTER]
    path = write_json(tmp_path / "m.geojson", feature(OUTER), feature(shifted))
    one, two = truth(OUTER, shifted)
    np.testing.assert_array_equal(masks.read_mask(path)(GRID), one | two)


@pytest.mark.parametrize(
    "properties",
    [
        {"use": 0},
        {"Use": "false"},
        {"use": False},
        {"EXCLUDE": 1},
        {"exclude": "yes"},
        {"use": 1, "exclude": True},
        {"use": "0.0"},
    ],
)
def test_attributes_that_leave_out(tmp_path, properties):
    whole, small = feature(OUTER), feature(HOLE, properties=properties)
    outer, hole = truth(OUTER, HOLE)
    path = write_json(tmp_path / "m.geojson", whole, small)
    np.testing.assert_array_equal(masks.read_mask(path)(GRID), outer & ~hole)
    path = write_json(tmp_path / "m.geojson", small)
    np.testing.assert_array_equal(masks.read_mask(path)(GRID), ~hole)


@pytest.mark.parametrize(
    "properties", [None, {}, {"use": 1}, {"use": None}, {"use": "sand"}, {"exclude": 0}]
)
def test_attributes_that_use(tmp_path, properties):
    path = write_json(tmp_path / "m.geojson", feature(OUTER, properties=properties))
    np.testing.assert_array_equal(masks.read_mask(path)(GRID), truth(OUTER)[0])


def write_shapefile(path: Path, kind=shapefile.POLYGON, crs: str | None = None) -> Path:
    with shapefile.Writer(path, shapeType=kind) as writer:
        writer.field("use", "N")
        writer.field("NAME", "C")
        put = writer.polyz if kind == shapefile.POLYGONZ else writer.poly
        extra = [[1.0]] if kind == shapefile.POLYGONZ else []
        put(
            [
                [[*p, *e] for p in closed(OUTER)[::-1] for e in (extra or [[]])],
                [[*p, *e] for p in closed(HOLE) for e in (extra or [[]])],
            ]
        )
        writer.record(1, "reef")
        put([[[*p, *e] for p in closed(SECOND) for e in (extra or [[]])]])
        writer.record(0, "buoy")
    if crs is not None:
        path.with_suffix(".prj").write_text(pyproj.CRS(crs).to_wkt("WKT1_ESRI"))
    return path


@pytest.mark.parametrize("kind", [shapefile.POLYGON, shapefile.POLYGONZ])
def test_shapefile(tmp_path, kind):
    path = write_shapefile(tmp_path / "m.shp", kind)
    outer, hole = truth(OUTER, HOLE)
    np.testing.assert_array_equal(masks.read_mask(path)(GRID), outer & ~hole)
    # Without its table every polygon is one to use.
    path.with_suffix(".dbf").unlink()
    second = truth(SECOND)[0]
    np.testing.assert_array_equal(masks.read_mask(path)(GRID), (outer & ~hole) | second)


def far(ring):
    return [[x + 500000.0, y + 6000000.0] for x, y in ring]


FAR_GRID = Grid(499997.0, 6000014.0, 0.1, (160, 240), CRS)


def other_crs(ring, crs):
    from pyproj import Transformer

    x, y = Transformer.from_crs(CRS, crs, always_xy=True).transform(*np.array(far(ring)).T)
    return np.column_stack([x, y]).tolist()


@pytest.mark.parametrize(
    ("crs", "named"),
    [
        ("EPSG:4326", {}),
        (
            "EPSG:32753",
            {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32753"}}},
        ),
        (CRS, {}),  # numbers that are not degrees are in the survey's CRS
        (
            "EPSG:4326",
            {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}},
        ),
    ],
)
def test_geojson_comes_to_the_surveys_crs(tmp_path, crs, named):
    path = write_json(tmp_path / "m.geojson", feature(other_crs(OUTER, crs)), **named)
    expected = truth(far(OUTER), grid=FAR_GRID)[0]
    mask = masks.read_mask(path, crs=CRS)
    assert mask.crs == CRS
    assert (mask(FAR_GRID) != expected).mean() < 1e-4  # a centre within a hair of an edge
    assert mask(FAR_GRID).mean() > 0.2


def test_shapefile_and_grid_in_other_crs(tmp_path):
    path = write_shapefile(tmp_path / "m.shp", crs=CRS)
    far_path = tmp_path / "far.shp"
    with shapefile.Writer(far_path) as writer:
        writer.field("a", "C")
        writer.poly([closed(other_crs(OUTER, "EPSG:32753"))])
        writer.record("x")
    far_path.with_suffix(".prj").write_text(pyproj.CRS(32753).to_wkt("WKT1_ESRI"))
    expected = truth(far(OUTER), grid=FAR_GRID)[0]
    assert (masks.read_mask(far_path, crs=CRS)(FAR_GRID) != expected).mean() < 1e-4
    # A mask made for one frame serves a grid in the other.
    assert (masks.read_mask(far_path, crs="EPSG:32753")(FAR_GRID) != expected).mean() < 1e-4
    # A local survey shares the mask's coordinates, whatever the mask says.
    assert masks.read_mask(path)(GRID).any()


def write_raster(path: Path, values, crs=CRS, affine=None, **extra) -> Path:
    affine = affine or Affine(1.0, 0, 500000, 0, -1.0, 6000010)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=values.shape[0],
        width=values.shape[1],
        count=1,
        dtype=values.dtype,
        crs=crs,
        transform=affine,
        **extra,
    ) as dataset:
        dataset.write(values[None])
    return path


def test_raster_mask(tmp_path):
    values = np.zeros((10, 8), np.uint8)
    values[2:5, 1:4] = 1
    values[7, 7] = 9
    path = write_raster(tmp_path / "m.tif", values, nodata=9)
    mask = masks.read_mask(path, crs=CRS)
    assert mask.at(500001.001, 6000007.999)  # just inside the block's north-west corner
    assert not mask.at(500000.999, 6000007.999)
    assert not mask.at(500001.001, 6000008.001)
    assert not mask.at(500007.5, 6000002.5)  # no data
    assert not mask.at(0.0, 0.0)  # outside
    fine = Grid(499999.0, 6000011.0, 0.5, (24, 20), CRS)
    expected = np.zeros((24, 20), bool)
    expected[2:22, 2:18] = np.kron(values == 1, np.ones((2, 2))).astype(bool)
    np.testing.assert_array_equal(mask(fine), expected)
    np.testing.assert_array_equal(masks.read_mask(path, True, CRS)(fine), ~expected)


def test_raster_mask_of_floats_and_in_another_crs(tmp_path):
    from pyproj import Transformer

    values = np.ones((200, 200), np.float32)
    values[:100] = np.nan
    there = Transformer.from_crs(CRS, "EPSG:32753", always_xy=True)
    x, y = there.transform(500000.0, 6000000.0)
    affine = Affine(1.0, 0, x - 100, 0, -1.0, y + 100)
    mask = masks.read_mask(write_raster(tmp_path / "m.tif", values, "EPSG:32753", affine), crs=CRS)
    east, north = there.transform(np.array([x, x]), np.array([y + 50, y - 50]), direction="INVERSE")
    assert mask.at(east, north).tolist() == [False, True]


def shifted_survey(crs=None):
    """20 m of ground around (0, 0) of its file, which a shift takes to (500000, 6000000)."""
    frame = Frame(np.eye(3), [500000.0, 6000000.0, 0.0], crs, crs)
    points = np.array([[-3.0, -2.0, 0.0], [20.0, 14.0, 1.0]])
    source = SourceFile(Path("reef.obj"), "obj", frame)
    return Survey("reef", PointCloud(points), frame.shift, crs=crs, source=(source,))


@pytest.mark.parametrize("crs", [None, CRS])
@pytest.mark.parametrize("kind", ["geojson", "shp", "tif"])
def test_a_mask_in_the_files_own_coordinates(tmp_path, caplog, kind, crs):
    """Drawn on the file as it is seen in CloudCompare, or in absolute coordinates: the same."""
    survey = shifted_survey(crs)
    grid = Grid(FAR_GRID.west, FAR_GRID.north, 0.1, FAR_GRID.shape, crs)
    found = []
    for shift in (0.0, 1.0):
        ring = [[x + 500000.0 * shift, y + 6000000.0 * shift] for x, y in OUTER]
        path = tmp_path / f"m{shift}.{kind}"
        if kind == "geojson":
            write_json(path, feature(ring))
        elif kind == "shp":
            with shapefile.Writer(path) as writer:
                writer.field("a", "C")
                writer.poly([closed(ring)])
                writer.record("x")
        else:
            values = np.zeros((20, 30), np.uint8)
            values[4:9, 5:20] = 1
            corner = Affine(1.0, 0, 500000 * shift - 3, 0, -1.0, 6000000 * shift + 14)
            write_raster(path, values, None, corner)
        caplog.clear()
        found.append(masks.read_mask(path, crs=crs, survey=survey)(grid))
        assert ("file coordinates of reef" in caplog.text) == (shift == 0)
    np.testing.assert_array_equal(found[0], found[1])
    assert 0.1 < found[0].mean() < 0.9
    # A mask that states its CRS is taken at its word, and so is one of a survey without shift.
    caplog.clear()
    if kind == "geojson":
        name = {"crs": {"type": "name", "properties": {"name": CRS}}}
        path = write_json(tmp_path / "own.geojson", feature(OUTER), **name)
        assert not masks.read_mask(path, crs=crs, survey=survey)(grid).any()
    plain = Survey("plain", PointCloud(np.array([[0.0, 0, 0], [9, 9, 0]])))
    masks.read_mask(tmp_path / f"m0.0.{kind}", survey=plain)
    assert "file coordinates" not in caplog.text


def test_a_raster_without_crs_keeps_its_place_when_its_frame_changes(tmp_path):
    """Made in the moving survey's zone, asked in the reference's."""
    from pyproj import Transformer

    values = np.zeros((20, 20), np.uint8)
    values[:10] = 1
    mask = masks.read_mask(write_raster(tmp_path / "m.tif", values, None), crs=CRS)
    there = Transformer.from_crs(CRS, "EPSG:32753", always_xy=True)
    east, north = there.transform([500005.0, 500005.0], [6000008.5, 5999999.5])
    assert mask.to("EPSG:32753").at(east, north).tolist() == [True, False]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("m.geojson", b"", "not a mask that is known"),
        ("m.geojson", b"hello", "not a mask that is known"),
        ("m.geojson", b'{"type": "FeatureCollection"', "not GeoJSON"),
        ("m.geojson", b'{"type": "FeatureCollection", "features": []}', "holds no polygon"),
        ("m.geojson", b'{"type": "Point", "coordinates": [1, 2]}', "holds no polygon"),
        ("m.geojson", b'{"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]}', "not GeoJSON"),
        (
            "m.geojson",
            b'{"type": "Polygon", "coordinates": [[[0, "a"], [1, 1], [2, 0]]]}',
            "not GeoJSON",
        ),
        (
            "m.geojson",
            b'{"type": "Polygon", "coordinates": [[[0, NaN], [1, 1], [2, 0]]]}',
            "not GeoJSON",
        ),
        ("m.geojson", b'{"a":' * 100000, "not GeoJSON"),
        ("m.gpkg", b"SQLite format 3\0", "not a mask that is known"),
        ("m.shp", b"\0\0\x27\x0a" + b"\0" * 20, "damaged shapefile"),
        ("m.tif", b"II*\0" + b"\0" * 40, "cannot be read"),
    ],
)
def test_bad_masks(tmp_path, name, content, said):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as caught:
        masks.read_mask(path)
    assert name in str(caught.value)


@pytest.mark.parametrize("cut", [50, 100, 200, 300, -1])
def test_truncated_shapefile(tmp_path, cut):
    path = write_shapefile(tmp_path / "m.shp")
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError):
        masks.read_mask(path)


def test_shapefile_opens_nothing_outside_its_folder(tmp_path):
    (tmp_path / "inside").mkdir()
    path = write_shapefile(tmp_path / "inside" / "m.shp")
    outside = tmp_path / "secret.dbf"
    path.with_suffix(".dbf").rename(outside)
    path.with_suffix(".dbf").symlink_to(outside)
    with pytest.raises(InputError, match="leaves the survey's folder"):
        masks.read_mask(path)


def test_nothing_left_to_use_is_warned_of(tmp_path, caplog):
    path = write_json(tmp_path / "m.geojson", feature([[100.0, 50.0], [101, 50], [101, 51]]))
    assert not masks.read_mask(path)(GRID).any()
    assert "leaves nothing" in caplog.text


corner = st.tuples(st.integers(-50, 50), st.integers(-50, 50)).map(
    lambda p: [p[0] / 7 + 0.0031, p[1] / 7 + 0.0057]
)


@settings(max_examples=60, deadline=None)
@given(st.lists(corner, min_size=3, max_size=12))
def test_any_ring_by_points_and_by_cells(ring):
    """Two ways to the same answer; a ring may even cross itself (even-odd rule)."""
    area = mask_polygons.Area((np.array(ring),))
    grid = Grid(-8.0, 8.0, 0.25, (64, 64))
    east, north = places(grid)
    cells = mask_polygons.inside_cells(area, grid)
    points = mask_polygons.inside(area, east.ravel(), north.ravel()).reshape(grid.shape)
    np.testing.assert_array_equal(cells, points)
    # Turning the ring round or starting elsewhere changes nothing.
    other = mask_polygons.Area((np.array(ring[1:] + ring[:1])[::-1],))
    again = mask_polygons.inside_cells(other, grid)
    assert (again != cells).sum() <= 2  # a centre exactly on an edge may fall either way
