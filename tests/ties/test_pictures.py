"""What is shown to pick on, and what was vendored to show it."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest

from meshreg.io.maps.write import write_height
from meshreg.records import Grid, Maps, PointCloud, Survey
from meshreg.settings import RasterSettings
from meshreg.ties import server
from meshreg.ties.pictures import write_picture, write_relief
from meshreg.ties.tiles import TileSource

SETTINGS = RasterSettings()


def shown(path: Path) -> tuple[np.ndarray, Grid]:
    import rasterio

    with rasterio.open(path) as dataset:
        bands = np.moveaxis(dataset.read(), 0, 2)
    source = TileSource(path)
    grid = source.grid
    source.close()
    return bands, grid


def ramp(rows=60, cols=80):
    """Ground that falls to the south-east, with a hole."""
    row, col = np.mgrid[:rows, :cols]
    height = (-0.05 * (row + col)).astype(np.float32)
    height[20:25, 30:36] = np.nan
    return height


def test_maps_show_their_own_orthomosaic(tmp_path):
    rng = np.random.default_rng(0)
    color = rng.integers(0, 255, (120, 160, 3), np.uint8)
    seen = np.ones((120, 160), bool)
    seen[:9] = False
    color[~seen] = 0
    fine = Grid(100.0, 250.0, 0.05, (120, 160))
    maps = Maps(ramp(), Grid(100.0, 250.0, 0.1, (60, 80)), color, seen, fine)
    write_picture(Survey("maps", maps), tmp_path / "a.tif", 0.5, SETTINGS)
    bands, grid = shown(tmp_path / "a.tif")
    assert np.array_equal(bands[..., :3], color)
    assert np.array_equal(bands[..., 3] > 0, seen)
    assert (grid.west, grid.north, grid.cell) == (100.0, 250.0, 0.05)  # not the cell asked for


def test_a_survey_without_color_shows_its_relief(tmp_path):
    grid = Grid(100.0, 250.0, 0.1, (60, 80))
    write_picture(Survey("dem", Maps(ramp(), grid)), tmp_path / "a.tif", 0.5, SETTINGS)
    write_height(ramp(), grid, tmp_path / "dem.tif")
    write_relief(tmp_path / "dem.tif", tmp_path / "b.tif")
    (first, where), (second, _) = shown(tmp_path / "a.tif"), shown(tmp_path / "b.tif")
    assert np.array_equal(first, second)
    assert where.bounds == grid.bounds
    assert first[22, 33, 3] == 0  # the hole
    assert first[50, 10, 3] == 255
    plain = first[40:, :20, :3]
    assert np.ptp(plain) == 0  # one slope, one grey
    # light from the north-west leaves a slope to the south-east darker than one to the north-west
    write_height(-ramp(), grid, tmp_path / "up.tif")
    write_relief(tmp_path / "up.tif", tmp_path / "c.tif")
    assert shown(tmp_path / "c.tif")[0][50, 10, 0] > plain[0, 0, 0] + 30


def test_a_cloud_is_rasterized_where_it_lies(tmp_path):
    east, north = np.meshgrid(np.arange(0.01, 3, 0.02), np.arange(0.01, 2, 0.02))
    points = np.stack([east.ravel(), north.ravel(), 0 * east.ravel()], axis=1)
    red = np.where(points[:, 0] < 1, 200, 20).astype(np.uint8)
    colors = np.stack([red, red, np.full_like(red, 90)], axis=1)
    survey = Survey("cloud", PointCloud(points, colors), origin=np.array([500.0, 700.0, -9.0]))
    write_picture(survey, tmp_path / "a.tif", 0.05, SETTINGS)
    bands, grid = shown(tmp_path / "a.tif")
    assert grid.cell == 0.05
    _, col = grid.row_col(501.0, 701.0)
    edge = float(col + 0.5)  # in pixels from the west edge: where red changes
    middle = bands[bands.shape[0] // 2, :, 0].astype(int)
    change = np.flatnonzero(np.diff(middle) < -90) + 1
    assert len(change) == 1
    assert change[0] == pytest.approx(edge, abs=1)


def test_vendored_files_are_what_they_are_said_to_be():
    said = (server.ASSETS / "VENDORED.md").read_text()
    sums = re.findall(r"([0-9a-f]{64})  (\S+)", said)
    assert {name for _, name in sums} == {"ol.js", "ol.css"}
    for digest, name in sums:
        assert hashlib.sha256((server.ASSETS / name).read_bytes()).hexdigest() == digest
    assert "Redistribution" in (server.ASSETS / "OPENLAYERS-LICENSE.md").read_text()
    for path in server.ASSETS.glob("*.js"):
        if path.name != "ol.js":
            text = path.read_text()
            assert "http" not in text, f"{path.name} names an address"
            assert not re.search(r"innerHTML|insertAdjacentHTML|document\.write|eval\(", text)
