"""GDAL's side files of a GeoTIFF, read as GDAL itself does (rasterio, without our restrictions)."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from rasterio import Affine
from rasterio.crs import CRS

from meshreg.errors import InputError, UnsafeReferenceError
from meshreg.io import read_survey, rewrite_survey
from meshreg.records import Transform

HEIGHT = (np.arange(120, dtype=np.float32).reshape(10, 12) % 17) / 4 + 20
PLACE = Affine(0.5, 0, 731_000, 0, -0.5, 5_705_000)
LOCAL = 'LOCAL_CS["Tank 3",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
MOVE = Transform(offset=np.array([2.0, -1.0, 0.5]))


def dem(path, values=HEIGHT, **more):
    more = {"transform": PLACE, "crs": "EPSG:32754"} | more
    tags = more.pop("tags", {})
    with rasterio.open(
        path, "w", driver="GTiff", count=1, dtype=values.dtype, width=12, height=10, **more
    ) as file:
        file.write(values, 1)
        file.update_tags(**tags)
    return path


def ortho(path, **more):
    more = {"transform": PLACE, "crs": "EPSG:32754"} | more
    colors = np.random.default_rng(4).integers(30, 220, (3, 10, 12)).astype(np.uint8)
    with rasterio.open(
        path, "w", driver="GTiff", count=3, dtype="uint8", width=12, height=10, **more
    ) as file:
        file.write(colors)
    return path


def masked(path, mask):
    """Let GDAL write a mask beside a file."""
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(path, "r+") as file:
        file.write_mask(mask)
    assert path.with_name(path.name + ".msk").is_file()


def aux(path, body):
    path.with_name(path.name + ".aux.xml").write_text(f"<PAMDataset>\n{body}\n</PAMDataset>\n")


HOLES = np.ones((10, 12), bool)
HOLES[2:5, 3:7] = False


def test_a_mask_beside_the_maps(tmp_path):
    masked(dem(tmp_path / "dem.tif"), HOLES)
    masked(ortho(tmp_path / "ortho.tif"), ~HOLES)
    survey = read_survey(tmp_path)
    assert np.array_equal(np.isfinite(survey.geometry.height), HOLES)
    assert np.array_equal(survey.geometry.height[HOLES], HEIGHT[HOLES])
    assert np.array_equal(survey.geometry.color_valid, ~HOLES)
    files = rewrite_survey(survey, MOVE, tmp_path / "out")
    with rasterio.open(files[0]) as moved:
        assert np.array_equal(moved.read_masks(1) > 0, HOLES)
        assert moved.read(1)[HOLES] == pytest.approx(HEIGHT[HOLES] + 0.5)
    with rasterio.open(files[1]) as moved:
        assert np.array_equal(moved.dataset_mask() > 0, ~HOLES)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_mask_of_another_size_is_said(tmp_path):
    masked(dem(tmp_path / "dem.tif"), HOLES)
    with rasterio.open(
        tmp_path / "dem.tif.msk", "w", driver="GTiff", count=1, dtype="uint8", width=3, height=3
    ) as file:
        file.write(np.zeros((1, 3, 3), np.uint8))
    survey = read_survey(tmp_path / "dem.tif")
    assert np.isfinite(survey.geometry.height).all()
    assert any("another size" in note for note in survey.notes)


@pytest.mark.parametrize("dtype", [np.float32, np.int16])
def test_no_data_scale_offset_and_unit_of_an_aux_xml(tmp_path, dtype):
    values = (HEIGHT * 4).astype(dtype)
    values[HEIGHT > 23.8] = -5
    path = dem(tmp_path / "dem.tif", values)
    aux(
        path,
        '<PAMRasterBand band="1"><NoDataValue>-5.0000E+00</NoDataValue><UnitType>ft</UnitType>'
        "<Offset>100</Offset><Scale>0.25</Scale></PAMRasterBand>",
    )
    with rasterio.open(path) as file:  # as GDAL has it
        want = file.read(1, masked=True) * file.scales[0] + file.offsets[0]
        assert file.nodata == -5
        assert file.units[0] == "ft"
    survey = read_survey(path)
    assert np.array_equal(np.isfinite(survey.geometry.height), ~want.mask)
    assert survey.geometry.height[~want.mask] == pytest.approx(want.compressed() * 0.3048)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("bare", [True, False])
def test_the_place_in_an_aux_xml_counts(tmp_path, bare):
    more = {"transform": Affine.identity(), "crs": None} if bare else {}
    path = dem(tmp_path / "dem.tif", **more)
    wkt = CRS.from_epsg(32755).to_wkt().replace('"', "&quot;")
    aux(
        path,
        f"<SRS>{wkt}</SRS><GeoTransform> 5.0e5, 2.0, 0.0, 5.8e6, 0.0, -2.0</GeoTransform>",
    )
    with rasterio.open(path) as file:
        assert file.transform == Affine(2, 0, 500_000, 0, -2, 5_800_000)
        assert file.crs.to_epsg() == 32755
    survey = read_survey(path)
    assert survey.geometry.height_grid.bounds == (500_000, 5_799_980, 500_024, 5_800_000)
    assert survey.crs == "EPSG:32755"
    assert sum("it counts" in note for note in survey.notes) == (0 if bare else 2)


def test_a_world_file_that_contradicts_the_file_is_said(tmp_path):
    path = dem(tmp_path / "dem.tif")
    path.with_suffix(".tfw").write_text("0.5\n0\n0\n-0.5\n731000.25\n5704999.75\n")
    assert not read_survey(path).notes
    path.with_suffix(".tfw").write_text("0.5\n0\n0\n-0.5\n731003.25\n5704999.75\n")
    survey = read_survey(path)
    assert survey.geometry.height_grid.west == 731_000
    assert any("dem.tfw" in note for note in survey.notes)


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("<PAMDataset><GeoTransform>1,2,3</GeoTransform></PAMDataset>", "GeoTransform"),
        ("<PAMDataset><GeoTransform>1,2,3,4,5,nan</GeoTransform></PAMDataset>", "GeoTransform"),
        ('<PAMDataset><PAMRasterBand band="1"><Scale>x</Scale></PAMRasterBand></PAMDataset>', "Sc"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><PAMDataset>&b;</PAMDataset>', "entities"),
        ("<PAMDataset>", "not XML"),
        ("\0\1", "not XML"),
        ("", "not XML"),
        ("<PAMDataset><SRS>PROJCS[</SRS></PAMDataset>", "coordinate reference system"),
    ],
)
def test_a_damaged_aux_xml_is_refused_by_name(tmp_path, content, error):
    path = dem(tmp_path / "dem.tif")
    path.with_name("dem.tif.aux.xml").write_text(content)
    with pytest.raises(InputError, match=error):
        read_survey(path)


def test_side_files_that_are_links_out_of_the_folder_are_refused(tmp_path):
    (tmp_path / "in").mkdir()
    path = dem(tmp_path / "in" / "dem.tif")
    other = dem(tmp_path / "mask.tif")
    for suffix in (".msk", ".aux.xml"):
        link = path.with_name(path.name + suffix)
        link.symlink_to(other)
        with pytest.raises(UnsafeReferenceError, match="leaves the survey's folder"):
            read_survey(path)
        link.unlink()


def test_what_is_not_read_is_named(tmp_path):
    path = dem(tmp_path / "dem.tif")
    (tmp_path / "dem.aux").write_bytes(b"EHFA")
    aux(path, '<Metadata domain="xml:ESRI" format="xml"><GeodataXform/></Metadata>')
    notes = read_survey(path).notes
    assert any("dem.aux" in note for note in notes)
    assert any("ESRI" in note for note in notes)
    path.with_name("dem.tif.aux.xml").write_text("<other/>")
    assert any("ignored" in note for note in read_survey(path).notes)


def test_a_local_crs_and_tags_are_kept_on_writing(tmp_path):
    tags = {"SITE": "Tank 3", "TIFFTAG_DATETIME": "2019:02:05 10:00:00", "STATISTICS_MEAN": "7"}
    dem(tmp_path / "dem.tif", crs=CRS.from_wkt(LOCAL), tags=tags)
    ortho(tmp_path / "ortho.tif", crs=CRS.from_wkt(LOCAL))
    survey = read_survey(tmp_path)
    assert survey.crs is None
    for reference in (None, survey):
        folder = tmp_path / ("own" if reference is None else "same")
        for path in rewrite_survey(survey, MOVE, folder, reference):
            with rasterio.open(path) as moved:
                assert "Tank 3" in moved.crs.to_wkt()
                assert moved.transform.c == 731_002
                if "dem" in path.name:
                    assert moved.tags()["SITE"] == "Tank 3"
                    assert moved.tags()["TIFFTAG_DATETIME"] == tags["TIFFTAG_DATETIME"]
                    assert "STATISTICS_MEAN" not in moved.tags()


def test_a_local_crs_beside_a_mesh_is_kept(tmp_path):
    path = tmp_path / "reef.obj"
    path.write_text("v 0 0 0\nv 10 0 0\nv 0 10 1\nf 1 2 3\n")
    path.with_suffix(".prj").write_text(LOCAL)
    files = rewrite_survey(read_survey(path), MOVE, tmp_path / "out")
    again = read_survey(files[0])
    assert again.crs is None
    assert "Tank 3" in again.source[0].frame.local
