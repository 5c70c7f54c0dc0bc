"""Files that were made to harm, or damaged as no program would: refused by name, never worse."""

from __future__ import annotations

import errno
import gc
import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from rasterio import Affine

from meshreg.errors import InputError, ResourceLimitError
from meshreg.io import read_survey, rewrite_survey
from meshreg.io.files import decoding, safe
from meshreg.io.las import read as cloud
from meshreg.records import Transform

DATA = Path(__file__).parent.parent / "data" / "hostile"
MOVE = Transform(offset=np.array([1.5, -0.5, 0.25]))


def refused(path: Path, *said: str) -> InputError:
    with pytest.raises(InputError) as caught:
        read_survey(path)
    assert caught.value.file == str(path)
    for text in said:
        assert text in str(caught.value)
    return caught.value


# Native decoders


def laz_of(path: Path, n: int) -> np.ndarray:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [0.001] * 3, [500_000, 4_000_000, 0]
    rng = np.random.default_rng(7)
    points = np.round(rng.uniform(0, 30, (n, 3)), 3) + header.offsets
    record = laspy.ScaleAwarePointRecord.zeros(n, header=header)
    record.x, record.y, record.z = points.T
    with laspy.open(path, "w", header=header) as writer:
        writer.write_points(record)
    return points


def test_a_decoder_that_overflows_its_stack_is_an_error():
    error = refused(DATA / "overflow.laz", "the decoder crashed (SIGSEGV)")
    assert error.place == "points 1 to 1000"


def test_points_come_whole_and_in_order_through_the_decoder(tmp_path, monkeypatch):
    points = laz_of(tmp_path / "a.laz", 10_007)
    monkeypatch.setattr(cloud, "chunk_points", lambda record: 1_000)
    survey = read_survey(tmp_path / "a.laz")
    np.testing.assert_allclose(survey.geometry.points + survey.origin, points, atol=1e-6)


def children():
    """Processes that this one has started, with those of other tests."""
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


def test_a_decoder_leaves_no_process_and_no_handle(tmp_path):
    laz_of(tmp_path / "a.laz", 500)
    gc.collect()  # what other tests have left open
    before = set(os.listdir("/proc/self/fd"))
    running = children()
    for _ in range(3):
        read_survey(tmp_path / "a.laz")
        with pytest.raises(InputError):
            read_survey(DATA / "overflow.laz")
    assert set(os.listdir("/proc/self/fd")) == before
    assert children() <= running


def test_memory_that_a_decoder_does_not_get_is_no_damage_of_the_file(tmp_path, monkeypatch):
    def none(handle, size):
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))

    laz_of(tmp_path / "a.laz", 1000)
    monkeypatch.setattr(decoding.os, "ftruncate", none)
    with pytest.raises(ResourceLimitError, match="decoder"):
        read_survey(tmp_path / "a.laz")


def test_a_decoder_has_a_bound_on_its_memory(tmp_path, monkeypatch):
    laz_of(tmp_path / "a.laz", 500)
    monkeypatch.setattr(decoding, "_MEMORY", 1 << 20)
    monkeypatch.setattr(decoding, "_PER_BYTE", 0)
    refused(tmp_path / "a.laz", "cannot be decoded")


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "I;16"])
@pytest.mark.parametrize("inside", [False, True])
def test_a_large_page_comes_the_same_from_a_process_of_its_own(tmp_path, monkeypatch, mode, inside):
    from PIL import Image

    from meshreg.io.files import images

    rng = np.random.default_rng(5)
    depth = {"RGB": (3,), "RGBA": (4,)}.get(mode, ())
    kind = np.uint16 if mode == "I;16" else np.uint8
    values = rng.integers(0, np.iinfo(kind).max, (37, 53, *depth), kind)
    path = tmp_path / "t.png"
    Image.fromarray(values).save(path)

    def texture():
        if inside:
            return images.open_texture_bytes(path.read_bytes(), "t.png", 10**6)
        return images.open_texture(path, 10**6)

    here = texture().load()
    monkeypatch.setattr(images, "_APART", 100)
    apart = texture().load()
    assert apart.shape == here.shape
    np.testing.assert_array_equal(apart, here)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="damaged"):
        texture().load()


# Files that change while they are read


def test_a_file_cut_short_while_it_is_read_is_an_error(tmp_path, monkeypatch):
    path = tmp_path / "a.xyz"
    path.write_text("".join(f"{k % 50} {k // 50} {k % 7}\n" for k in range(5_000)))
    plain = safe.read_into

    def cut(stream, buffer, name):
        os.truncate(name, 100)
        return plain(stream, buffer, name)

    monkeypatch.setattr(safe, "read_into", cut)
    refused(path, "changed while it was read")


def test_a_file_that_loses_its_end_later_does_not_end_the_process(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"\1" * 1_000_000)
    program = (
        "import os, sys; from pathlib import Path; from meshreg.io.files.safe import file_bytes\n"
        "data = file_bytes(Path(sys.argv[1])); os.truncate(sys.argv[1], 0); print(data.sum())"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, path], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout.strip()) == (0, "1000000")


# Numbers that nobody means


@pytest.mark.parametrize("value", ["1e10", "-3e25", "2e6"])
def test_texture_coordinates_far_off_are_refused_in_every_format(tmp_path, value):
    from PIL import Image

    Image.new("RGB", (32, 32), (90, 80, 70)).save(tmp_path / "t.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    square = "v 0 0 0\nv 1 0 0.1\nv 1 1 0\nv 0 1 0.2\n"
    (tmp_path / "a.obj").write_text(
        f"mtllib a.mtl\n{square}vt 0 0\nvt {value} 0\nvt {value} 1\nvt 0 1\nusemtl m\n"
        "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile t.png\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\nelement face 2\n"
        "property list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
        "0 0 0\n1 0 0.1\n1 1 0\n0 1 0.2\n"
        f"3 0 1 2 6 0 0 {value} 0 {value} 1\n3 0 2 3 6 0 0 {value} 1 0 1\n"
    )
    for name in ("a.obj", "a.ply"):
        refused(tmp_path / name, "texture coordinates", "beyond 1e+06")
        assert len(read_survey(tmp_path / name, geometry_only=True).geometry.faces) == 2


def tif(path: Path, heights: np.ndarray, transform: Affine, **more) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", width=heights.shape[1], height=heights.shape[0], count=1,
        dtype="float32", transform=transform, **more,
    ) as dataset:  # fmt: skip
        dataset.write(heights.astype("float32"), 1)
    return path


@pytest.mark.parametrize("height", [1e20, -1e9, 3e12])
def test_a_height_that_no_place_has_is_refused(tmp_path, height):
    heights = np.add.outer(np.arange(12.0), np.arange(15.0))
    heights[3, 4] = height
    path = tif(tmp_path / "a.tif", heights, Affine(1e-5, 0, 144.9, 0, -1e-5, -38.2), crs=4326)
    assert refused(path, "has 1 heights of 1e+09 or more").place == "row 4, column 5"


@pytest.mark.parametrize("blank", [3.4028234663852886e38, 1.70141e38, 9.969209968386869e36])
def test_blanks_of_other_programs_are_no_data(tmp_path, blank):
    heights = np.add.outer(np.arange(12.0), np.arange(15.0))
    heights[3, 4] = blank
    path = tif(tmp_path / "a.tif", heights, Affine(1, 0, 10, 0, -1, 20))
    survey = read_survey(path)
    assert np.argwhere(~np.isfinite(survey.geometry.height)).tolist() == [[3, 4]]


@pytest.mark.parametrize("north", [1e229, 1e15, 4e12])
def test_a_georeference_that_tells_no_pixels_apart_is_refused(tmp_path, north):
    path = tif(tmp_path / "a.tif", np.ones((9, 9)), Affine(0.5, 0, 0, 0, -0.5, north))
    refused(path, "cannot be told apart")


@pytest.mark.parametrize("shift", ["1e229 0 0", "0 -1e13 0", "0 0 1e300"])
def test_a_shift_that_tells_no_points_apart_is_refused(tmp_path, shift):
    path = tmp_path / "a.xyz"
    path.write_text("0 0 0\n1 0 0\n0 1 0\n1 1 1\n")
    (tmp_path / "a_offset.xyz").write_text(shift)
    refused(path, "coordinates of up to", "shift included")


def test_damage_that_gdal_raises_on_its_own_is_refused():
    refused(DATA / "geokeys.tif", "cannot be read")


def test_a_crs_that_proj_cannot_work_with_is_refused(tmp_path):
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = [0.001] * 3
    header.global_encoding.wkt = True
    header.vlrs.append(
        laspy.vlrs.known.WktCoordinateSystemVlr(
            'PROJCS["odd",GEOGCS["a",DATUM["b",SPHEROID["c",6378137,298.257222101]],'
            'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],'
            'PROJECTION["No_Such_Way"],PARAMETER["false_easting",0],UNIT["metre",1]]'
        )
    )
    record = laspy.ScaleAwarePointRecord.zeros(50, header=header)
    record.x, record.y = np.arange(50.0) % 7, np.arange(50.0) // 7
    with laspy.open(tmp_path / "a.las", "w", header=header) as writer:
        writer.write_points(record)
    refused(tmp_path / "a.las", "odd", "cannot be worked with")


@pytest.mark.parametrize("ring", ["[]", "[[0, 0], [1e300, 0], [0, 1e300]]", "[[0, 0], [1, 1]]"])
def test_a_mask_that_bounds_nothing_is_refused(tmp_path, ring):
    from meshreg.io.masks.read import read_mask

    rings = "[]" if ring == "[]" else f"[{ring}]"
    path = tmp_path / "m.geojson"
    path.write_text(f'{{"type": "Polygon", "coordinates": {rings}}}')
    with pytest.raises(InputError) as caught:
        read_mask(path, False, "EPSG:32754")
    assert caught.value.file == str(path)


# Texts that are not plain


def test_a_normal_with_a_decimal_comma_is_made_anew(tmp_path):
    facet = "outer loop\nvertex {} 0 0\nvertex {} 1 0\nvertex 0 1 {}\nendloop\nendfacet\n"
    (tmp_path / "a.stl").write_text(
        f"solid x\nfacet normal 0 0 1\n{facet.format(0, 1, 0)}"
        f"facet normal 0,5 0 1\n{facet.format(1, 1, 0.2)}endsolid x\n"
    )
    survey = read_survey(tmp_path / "a.stl")
    files = rewrite_survey(survey, MOVE, tmp_path / "out")
    lines = [line.split()[2:] for line in files[0].read_text().splitlines() if "normal" in line]
    across = np.cross([0, 1, 0], [-1, 1, 0.2])
    np.testing.assert_allclose(np.array(lines, float), [[0, 0, 1], across / np.linalg.norm(across)])


def test_facets_on_one_line_are_refused_before_the_work(tmp_path):
    (tmp_path / "a.stl").write_text(
        "solid x\nfacet normal 0 0 1 outer loop vertex 0 0 0 vertex 1 0 0\nvertex 0 1 0\n"
        "endloop endfacet\nendsolid x\n"
    )
    refused(tmp_path / "a.stl", "has 1 facets, but 2 lines of numbers")


def test_software_named_in_latin1_is_written_as_it_was(tmp_path):
    points = laz_of(tmp_path / "a.las", 60)
    data = bytearray((tmp_path / "a.las").read_bytes())
    name = "Vermessungsbüro Müller".encode("latin-1").ljust(32, b"\0")
    data[58:90] = name
    (tmp_path / "a.las").write_bytes(data)
    files = rewrite_survey(read_survey(tmp_path / "a.las"), MOVE, tmp_path / "out")
    assert files[0].read_bytes()[58:90] == name
    again = np.column_stack([getattr(laspy.read(files[0]), axis) for axis in "xyz"])
    np.testing.assert_allclose(again, points + MOVE.offset, atol=1e-3)


# Small files that claim much


def refused_for_size(path: Path, *said: str) -> None:
    with pytest.raises(ResourceLimitError) as caught:
        read_survey(path)
    assert caught.value.exit_code == 5
    for text in said:
        assert text in str(caught.value)


def png_of(path: Path, width: int, height: int) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(1_000))
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    )


def test_a_small_page_of_many_pixels_is_refused_before_it_is_decoded(tmp_path):
    png_of(tmp_path / "t.png", 20_000, 20_000)
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    refused_for_size(tmp_path / "a.obj", "20000 × 20000 pixels", "4.8 GB")
    assert len(read_survey(tmp_path / "a.obj", geometry_only=True).geometry.faces) == 1


def test_a_small_dem_of_many_cells_is_refused_before_it_is_decoded(tmp_path):
    with rasterio.open(
        tmp_path / "a.tif", "w", driver="GTiff", width=9000, height=9000, count=1,
        dtype="float32", transform=Affine(1, 0, 10, 0, -1, 20), SPARSE_OK=True, compress="deflate",
    ):  # fmt: skip
        pass
    assert (tmp_path / "a.tif").stat().st_size < 100_000
    refused_for_size(tmp_path / "a.tif", "9000 × 9000 pixels")


def test_instances_may_not_multiply_a_small_gltf(tmp_path):
    points = np.random.default_rng(0).uniform(0, 1, (20_000, 3)).astype("<f4").tobytes()
    (tmp_path / "a.bin").write_bytes(points)
    (tmp_path / "a.gltf").write_text(
        json.dumps(
            {
                "asset": {"version": "2.0"},
                "scenes": [{"nodes": list(range(900))}],
                "nodes": [{"mesh": 0}] * 900,
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}],
                "accessors": [
                    {"bufferView": 0, "componentType": 5126, "count": 20_000, "type": "VEC3"}
                ],
                "bufferViews": [{"buffer": 0, "byteLength": len(points)}],
                "buffers": [{"uri": "a.bin", "byteLength": len(points)}],
            }
        )
    )
    refused_for_size(tmp_path / "a.gltf", "points and indices")


@pytest.mark.parametrize(
    ("needed", "n_bytes"),
    [(900_000_000, 10), (3_220_000_000, 4_000_000), (12 * 32_768**2, 14_000_000)],
)
def test_what_is_in_proportion_is_read(needed, n_bytes):
    safe.require_proportion(needed, n_bytes, "a.jpg", "pixels")
    with pytest.raises(ResourceLimitError):
        safe.require_proportion(needed + 1_000 * n_bytes + 1, n_bytes, "a.jpg", "pixels")


def test_pages_of_few_bytes_are_not_decoded_all_at_once():
    from meshreg.io.files.images import EncodedImage
    from meshreg.raster.textures import plan_pages
    from meshreg.records import Mesh, Texture

    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    faces = np.tile(np.arange(3, dtype=np.int32), (8, 1))
    uv = np.tile(np.array([[0, 0], [1, 0], [0, 1]], np.float32), (8, 1, 1))

    def groups(n_bytes: int) -> int:
        pages = tuple(
            Texture(f"{k}", (5000, 5000), EncodedImage(f"{k}", "PNG", fingerprint=(n_bytes, 0)))
            for k in range(8)
        )
        mesh = Mesh(vertices, faces, None, uv, np.arange(8, dtype=np.int32), pages)
        return len(plan_pages(mesh, np.arange(8, dtype=np.int32), 1e-9))

    assert groups(1_000) == 4  # two pages of 100 MB fit 256 MiB
    assert groups(50_000_000) == 1


def test_a_crs_in_which_all_places_are_one_is_refused(tmp_path):
    """Its scale factor is so small that nothing can be turned in it."""
    wkt = pyproj.CRS("EPSG:32754").to_wkt("WKT1_ESRI")
    assert "0.9996" in wkt
    (tmp_path / "a.prj").write_text(wkt.replace("0.9996", "1e-30"))
    points = np.random.default_rng(3).uniform(0, 10, (60, 3)) + np.array([731_000, 5_705_000, -12])
    np.savetxt(tmp_path / "a.xyz", points, fmt="%.3f")
    with pytest.raises(InputError, match=r"cannot be worked with|not told apart"):
        rewrite_survey(read_survey(tmp_path / "a.xyz"), MOVE, tmp_path / "out")


STRIP = """
import sys
from pathlib import Path
import numpy as np
from meshreg.io import read_survey, rewrite_survey
from meshreg.records import Transform

cos, sin = np.cos(0.02), np.sin(0.02)
turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])

def peak():  # MiB; getrusage's would begin at what the parent holds: it is kept over fork and exec
    (line,) = (a for a in Path("/proc/self/status").open() if a.startswith("VmHWM"))
    return int(line.split()[1]) / 1024

for path in sys.argv[1:3]:  # a small one first: what is imported and compiled is not counted
    survey = read_survey(path)
    before = peak()
    rewrite_survey(survey, Transform(turn, 1.0, np.zeros(3), survey.centre), Path(sys.argv[3]))
print(peak() - before)
"""


def strip(path: Path, length: int) -> Path:
    rng = np.random.default_rng(1)
    heights = np.full((24, length), -12.5, np.float32)
    heights[:, :600] = np.round(rng.normal(-12, 1, (24, 600)), 1)
    shape = {"width": length, "height": 24, "count": 1, "dtype": "float32", "crs": "EPSG:32754"}
    place = Affine(0.5, 0, 5e5, 0, -0.5, 4e6)
    with rasterio.open(path, "w", "GTiff", transform=place, compress="DEFLATE", **shape) as file:
        file.write(heights, 1)
    return path


def test_a_thin_strip_that_is_turned_takes_the_memory_of_its_result_once(tmp_path):
    """40,000 x 24 cells in some kilobytes become 33 million: 126 MiB, and a quarter for what is."""
    small, long = strip(tmp_path / "small.tif", 2000), strip(tmp_path / "long.tif", 40_000)
    command = [sys.executable, "-c", STRIP, str(small), str(long), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert 126 < float(done.stdout) < 3.25 * 126
    (moved,) = (tmp_path / "out").glob("long*.tif")
    with rasterio.open(moved) as file:
        assert file.width * file.height > 30e6
        there = file.read(1) != file.nodata
    assert abs(there.sum() / (24 * 40_000) - 1) < 0.01  # nothing lost, nothing filled
    row, col = np.nonzero(there)
    assert abs(np.polyfit(col, -row, 1)[0] - np.tan(0.02)) < 1e-5
