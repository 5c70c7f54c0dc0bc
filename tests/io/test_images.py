"""Texture pages: every kind is decoded to the right pixels, every broken one is refused."""

from __future__ import annotations

import io
import struct
import warnings
import zlib

import numpy as np
import pytest
from PIL import Image

from meshreg.errors import InputError, OutputError, ResourceLimitError, UsageError
from meshreg.io.files.images import (
    EncodedImage,
    open_texture,
    open_texture_bytes,
    texture_from_array,
    texture_suffix,
    write_texture,
)

BIG = 10**9


@pytest.fixture
def pixels():
    """Smooth colors, so that JPEG changes them little; each channel and axis differs."""
    row, col = np.mgrid[0:40, 0:60]
    return np.stack([row * 6, col * 4, (row + col) * 2], axis=2).astype(np.uint8)


def load(path, **options):
    texture = open_texture(path, BIG, **options)
    values = texture.load()
    assert values.dtype == np.uint8
    assert values.shape[:2] == texture.size[::-1]
    return values


@pytest.mark.parametrize(
    ("suffix", "options", "error"),
    [
        ("png", {}, 0),
        ("tif", {}, 0),
        ("tif", {"compression": "tiff_lzw"}, 0),
        ("tif", {"compression": "tiff_deflate"}, 0),
        ("webp", {"lossless": True}, 0),
        ("jpg", {"quality": 95, "subsampling": 0}, 4),
    ],
)
def test_kinds_of_files(tmp_path, pixels, suffix, options, error):
    path = tmp_path / f"page.{suffix}"
    Image.fromarray(pixels).save(path, **options)
    values = load(path).astype(int)
    assert values.shape == (40, 60, 3)
    assert np.abs(values - pixels).max() <= error


def test_only_the_header_is_read_when_opened(tmp_path, pixels):
    path = tmp_path / "page.png"
    Image.fromarray(pixels).save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[:60])
    texture = open_texture(path, BIG, clamp=True)
    assert texture.size == (60, 40)
    assert texture.name == "page.png"
    assert texture.clamp


def test_the_kind_is_told_by_content(tmp_path, pixels):
    path = tmp_path / "page.jpg"
    Image.fromarray(pixels).save(path, format="PNG")
    np.testing.assert_array_equal(load(path), pixels)
    assert texture_suffix(open_texture(path, BIG)) == ".png"


@pytest.mark.parametrize("kind", ["GIF", "BMP", "PPM", "EPS", "PCX", "TGA"])
def test_other_kinds_are_refused(tmp_path, pixels, kind):
    path = tmp_path / "page.png"
    Image.fromarray(pixels).save(path, format=kind)
    with pytest.raises(InputError, match="not an image of a known kind") as caught:
        open_texture(path, BIG)
    assert str(path) in str(caught.value)


def test_a_vrt_under_another_name_reads_no_other_file(tmp_path):
    path = tmp_path / "page.tif"
    path.write_text(
        '<VRTDataset rasterXSize="4" rasterYSize="1"><VRTRasterBand dataType="Byte" band="1" '
        'subClass="VRTRawRasterBand"><SourceFilename>/etc/hostname</SourceFilename>'
        "</VRTRasterBand></VRTDataset>"
    )
    with pytest.raises(InputError, match="known kind"):
        open_texture(path, BIG)


def modes(pixels):
    """Images of every mode, with the pixels that each must decode to."""
    grey = pixels[..., 0]
    rgb = Image.fromarray(pixels)
    alpha = np.where(np.arange(60) < 30, 255, 0)[None].repeat(40, 0).astype(np.uint8)
    rgba = np.dstack([pixels, alpha])
    palette = Image.fromarray((grey // 64).astype(np.uint8)).convert("P")
    palette.putpalette([10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 110, 120])
    colors = np.array([[10, 20, 30], [40, 50, 60], [70, 80, 90], [100, 110, 120]], np.uint8)
    see_through = palette.copy()
    see_through.info["transparency"] = 0
    mask = np.where(grey // 64 == 0, 0, 255).astype(np.uint8)
    cmyk = Image.fromarray(np.dstack([255 - pixels, np.zeros((40, 60), np.uint8)]), mode=None)
    cmyk = Image.frombytes("CMYK", (60, 40), cmyk.tobytes())
    bilevel = Image.fromarray(grey > 100)
    grey16 = grey.astype(np.uint16) * 257 + 100
    return {
        "L": (Image.fromarray(grey), np.repeat(grey[..., None], 3, 2), ("png", "tif", "jpg")),
        "RGBA": (Image.fromarray(rgba), rgba, ("png", "tif", "webp")),
        "P": (palette, colors[grey // 64], ("png", "tif")),
        "P+transparency": (see_through, np.dstack([colors[grey // 64], mask]), ("png",)),
        "CMYK": (cmyk, pixels, ("tif", "jpg")),
        "1": (bilevel, np.where(grey > 100, 255, 0)[..., None].repeat(3, 2), ("png", "tif")),
        "I;16": (Image.fromarray(grey16), np.repeat(grey[..., None], 3, 2), ("png", "tif")),
        "LA": (
            Image.fromarray(np.dstack([grey, alpha])),
            np.dstack([grey, grey, grey, alpha]),
            ("png", "tif"),
        ),
        "F": (
            Image.fromarray((grey / np.float32(255)).astype(np.float32)),
            np.repeat(grey[..., None], 3, 2),
            ("tif",),
        ),
        "YCbCr": (rgb.convert("YCbCr"), pixels, ("jpg",)),
    }


@pytest.mark.parametrize(
    "mode", ["L", "RGBA", "P", "P+transparency", "CMYK", "1", "I;16", "LA", "F", "YCbCr"]
)
def test_pixel_modes(tmp_path, pixels, mode):
    image, expected, suffixes = modes(pixels)[mode]
    for suffix in suffixes:
        path = tmp_path / f"page.{suffix}"
        options = {"quality": 98, "subsampling": 0} if suffix == "jpg" else {}
        if suffix == "webp":
            options = {"lossless": True, "exact": True}
        image.save(path, **options)
        values = load(path).astype(int)
        assert values.shape == expected.shape, suffix
        limit = 6 if suffix == "jpg" else 1 if mode in ("I;16", "F") else 0
        assert np.abs(values - expected).max() <= limit, suffix


def test_converted_modes_are_noted(tmp_path, pixels):
    image, _, _ = modes(pixels)["CMYK"]
    image.save(tmp_path / "cmyk.tif")
    Image.fromarray(pixels).save(tmp_path / "rgb.tif")
    notes: list[str] = []
    open_texture(tmp_path / "rgb.tif", BIG, notes=notes)
    assert notes == []
    open_texture(tmp_path / "cmyk.tif", BIG, notes=notes)
    assert len(notes) == 1
    assert "cmyk.tif" in notes[0]
    assert "CMYK" in notes[0]


def png(width, height, depth, color, rows):
    """Make a PNG of any bit depth, byte by byte."""

    def chunk(kind, data):
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    head = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    start = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head)
    return start + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def test_color_png_of_sixteen_bits(tmp_path, pixels):
    deep = (pixels.astype(np.uint16) * 256 + 77).astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in deep)
    path = tmp_path / "deep.png"
    path.write_bytes(png(60, 40, 16, 2, rows))
    np.testing.assert_array_equal(load(path), pixels)


@pytest.mark.parametrize(
    ("dtype", "factor", "count"),
    [("uint16", 257, 3), ("float32", 1 / 255, 3), ("float32", 1, 3), ("uint16", 257, 5)],
)
def test_tiffs_of_many_bits_in_color(tmp_path, pixels, dtype, factor, count):
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "deep.tif"
    bands = np.moveaxis(pixels, 2, 0).astype(float) * factor
    bands = np.concatenate([bands, bands])[:count].astype(dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no georeference
        with rasterio.open(
            path, "w", driver="GTiff", width=60, height=40, count=count, dtype=dtype
        ) as file:
            file.write(bands)
    values = load(path)
    assert values.shape == (40, 60, 3)
    assert np.abs(values.astype(int) - pixels).max() <= 1


def test_alpha_of_deep_tiffs_is_kept(tmp_path, pixels):
    rasterio = pytest.importorskip("rasterio")
    from rasterio.enums import ColorInterp

    path = tmp_path / "deep.tif"
    bands = np.concatenate([np.moveaxis(pixels, 2, 0), pixels[None, ..., 0]]).astype(np.uint16)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no georeference
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=60,
            height=40,
            count=4,
            dtype="uint16",
            photometric="RGB",
        ) as file:
            file.colorinterp = (
                ColorInterp.red,
                ColorInterp.green,
                ColorInterp.blue,
                ColorInterp.alpha,
            )
            file.write(bands * 257)
    values = load(path)
    assert values.shape == (40, 60, 4)
    assert np.abs(values[..., :3].astype(int) - pixels).max() <= 1
    assert np.abs(values[..., 3].astype(int) - pixels[..., 0]).max() <= 1


def test_rotation_in_exif_is_ignored(tmp_path, pixels):
    path = tmp_path / "turned.jpg"
    exif = Image.Exif()
    exif[0x0112] = 6  # turn by 90 degrees
    Image.fromarray(pixels).save(path, quality=95, subsampling=0, exif=exif)
    values = load(path)
    assert values.shape == (40, 60, 3)
    assert np.abs(values.astype(int) - pixels).max() <= 4


def test_a_page_of_more_rows_than_a_strip(tmp_path):
    values = np.random.default_rng(1).integers(0, 256, (1300, 3, 3), np.uint8)
    path = tmp_path / "tall.png"
    Image.fromarray(values).save(path)
    np.testing.assert_array_equal(load(path), values)


def test_too_many_pixels_are_told_by_the_header(tmp_path):
    path = tmp_path / "bomb.png"
    path.write_bytes(png(50_000, 50_000, 8, 2, b""))
    with pytest.raises(ResourceLimitError, match="50000 x 50000") as caught:
        open_texture(path, BIG)
    assert caught.value.exit_code == 5
    assert open_texture(path, 3 * 10**9).size == (50_000, 50_000)


def test_more_pixels_than_pillow_likes_are_opened(tmp_path):
    path = tmp_path / "large.png"
    path.write_bytes(png(16384, 16384, 8, 0, b""))
    assert open_texture(path, BIG).size == (16384, 16384)
    assert Image.MAX_IMAGE_PIXELS is not None


def test_a_page_larger_than_memory_is_refused_before_decoding(tmp_path):
    path = tmp_path / "bomb.png"
    path.write_bytes(png(10**6, 10**6, 8, 2, b""))
    with pytest.raises(ResourceLimitError, match="GB"):
        open_texture(path, 10**13).load()


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
def test_a_truncated_page_is_refused_when_decoded(tmp_path, suffix):
    path = tmp_path / f"cut.{suffix}"
    noise = np.random.default_rng(2).integers(0, 256, (300, 300, 3), np.uint8)
    Image.fromarray(noise).save(path)
    whole = path.read_bytes()
    for share in (0.3, 0.7):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError) as caught:
            open_texture(path, BIG).load()
        assert f"cut.{suffix}" in str(caught.value)
        assert "copy it again" in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"II*\0", b"x"]
)
def test_what_is_no_image_is_refused_when_opened(tmp_path, content):
    path = tmp_path / "page.png"
    path.write_bytes(content)
    with pytest.raises(InputError):
        open_texture(path, BIG)


def test_damaged_pages_raise_nothing_else(tmp_path, pixels):
    rng = np.random.default_rng(3)
    for suffix in ("jpg", "png", "tif", "webp"):
        path = tmp_path / f"page.{suffix}"
        Image.fromarray(pixels).save(path)
        whole = np.frombuffer(path.read_bytes(), np.uint8)
        for _ in range(60):
            damaged = whole.copy()
            places = rng.integers(0, len(damaged), 6)
            damaged[places] = rng.integers(0, 256, 6)
            path.write_bytes(damaged.tobytes())
            try:
                values = open_texture(path, 10**6).load()
            except (InputError, ResourceLimitError):
                continue
            assert values.dtype == np.uint8
            assert values.ndim == 3


def test_a_page_that_changed_is_refused(tmp_path, pixels):
    path = tmp_path / "page.png"
    Image.fromarray(pixels).save(path)
    texture = open_texture(path, BIG)
    Image.fromarray(pixels[::-1].copy()).save(path, compress_level=0)
    with pytest.raises(InputError, match="changed since"):
        texture.load()


def test_pages_inside_other_files(pixels):
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    texture = open_texture_bytes(buffer.getvalue(), "image 0", BIG)
    np.testing.assert_array_equal(texture.load(), pixels)
    assert texture.name == "image 0"
    with pytest.raises(InputError, match="image 1"):
        open_texture_bytes(buffer.getvalue()[:40][::-1], "image 1", BIG)


def test_textures_from_arrays(pixels):
    texture = texture_from_array(pixels, "mine")
    assert texture.size == (60, 40)
    np.testing.assert_array_equal(texture.load(), pixels)
    for wrong in (pixels[..., 0], pixels.astype(float), pixels[..., :2]):
        with pytest.raises(UsageError, match="uint8"):
            texture_from_array(wrong)


def test_writing_pages(tmp_path, pixels):
    source = tmp_path / "page.jpg"
    Image.fromarray(pixels).save(source)
    texture = open_texture(source, BIG)
    assert texture_suffix(texture) == ".jpg"
    write_texture(texture, tmp_path / "copy.jpg")
    assert (tmp_path / "copy.jpg").read_bytes() == source.read_bytes()

    inside = open_texture_bytes(source.read_bytes(), "image 0", BIG)
    assert isinstance(inside.load, EncodedImage)
    write_texture(inside, tmp_path / "inside.jpg")
    assert (tmp_path / "inside.jpg").read_bytes() == source.read_bytes()

    made = texture_from_array(np.dstack([pixels, pixels[..., 0]]))
    assert texture_suffix(made) == ".png"
    write_texture(made, tmp_path / "made.png")
    np.testing.assert_array_equal(load(tmp_path / "made.png"), made.load())
    with pytest.raises(OutputError, match="other content"):
        write_texture(texture, tmp_path / "made.png")
