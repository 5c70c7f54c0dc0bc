"""Texture pages: known by their header, decoded when asked, by Pillow and nothing else.

The kind of an image is told by its first bytes, never by its name. EXIF rotation is ignored:
texture coordinates refer to the pixels as they are stored.
"""

from __future__ import annotations

import io
import math
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, ResourceLimitError, UsageError
from meshreg.io.files.atomic import atomic_file, copy_file
from meshreg.io.files.decoding import Decoder
from meshreg.io.files.safe import fingerprint, free_memory, open_regular, require_proportion
from meshreg.records import Texture, UInt8

FORMATS = ("JPEG", "PNG", "TIFF", "WEBP")
SUFFIXES = {"JPEG": ".jpg", "PNG": ".png", "TIFF": ".tif", "WEBP": ".webp"}
_STRIP_ROWS = 512
_APART = 1 << 25  # pixels from which a page is decoded in a process of its own
_PER_PIXEL = 12  # bytes of memory: Pillow's own, the array that is filled from it, the texels
_PILLOW = threading.RLock()  # around a setting of Pillow that is one for the whole process


@dataclass(frozen=True)
class EncodedImage:
    """Decodes one image file (or the bytes of one) when called; what `Texture.load` holds.

    Attributes
    ----------
    name : str
        For messages.
    kind : str
        "JPEG", "PNG", "TIFF" or "WEBP".
    path : Path or None
    data : bytes or None
        The encoded image, where it is part of another file.
    fingerprint : (size, mtime)
        Of the file when its header was read; a page that has changed since is refused.
    """

    name: str
    kind: str
    path: Path | None = None
    data: bytes | None = None
    fingerprint: tuple[int, int] = (0, 0)

    @property
    def n_bytes(self) -> int:
        """Size of the encoded image."""
        return self.fingerprint[0] if self.data is None else len(self.data)

    def __call__(self) -> UInt8:
        """Return (height, width, 3) or (height, width, 4) uint8.

        Raises
        ------
        InputError
            The image is cut off or damaged, or has changed since it was opened.
        ResourceLimitError
            Decoding needs more memory than is free.
        """
        if self.path is not None and fingerprint(self.path) != self.fingerprint:
            raise InputError(
                "has changed since the survey was opened.", file=self.path, remedy="Read it again."
            )
        with _opened(self.path, self.data, self.name) as image:
            # Pillow keeps 4 bytes a pixel beside the array that is filled from it.
            _require_memory(8 * image.width * image.height, image.size, self.name)
            if image.width * image.height <= _APART:
                pixels: UInt8 = _pixels(image, self.name)
                return pixels
            room = 4 * image.width * image.height
        with Decoder("page", self.path, room, data=self.data, name=self.name) as decoder:
            decoder.place = self.name if self.path is None else ""
            shape = decoder.ask("read", slot=0)["shape"]
            flat = np.frombuffer(decoder.slot(0), np.uint8, math.prod(shape))
            return flat.reshape(shape)


def decode_into(file: str, name: str, slot: memoryview) -> tuple[int, ...]:
    """Decode an image file to the front of some memory; return its shape (H, W, 3 or 4)."""
    with _opened(Path(file), None, name) as image:
        return _pixels(image, name, np.frombuffer(slot, np.uint8)).shape


def open_texture(
    path: Path, max_pixels: int, clamp: bool = False, notes: list[str] | None = None
) -> Texture:
    """Open a texture page by its header: JPEG, PNG, TIFF or WebP, told by the first bytes.

    When its `load` is called: 16-bit values are divided by 257 (by 256 where Pillow reads color
    PNG and TIFF), float values are multiplied by 255 where none is above 1; grey, palette, 1-bit
    and CMYK pages become RGB, and transparency a fourth channel.

    Parameters
    ----------
    path : Path
    max_pixels : int
        Largest width times height that is accepted.
    clamp : bool
        Passed on to the `Texture`.
    notes : list of str, optional
        Gets one sentence where the page is converted with a loss or guess.

    Raises
    ------
    InputError
        Not an image of a known kind.
    ResourceLimitError
        More than `max_pixels`.
    """
    return _texture(path.name, path, None, max_pixels, clamp, notes)


def open_texture_bytes(
    data: bytes, name: str, max_pixels: int, clamp: bool = False, notes: list[str] | None = None
) -> Texture:
    """Open a texture page that is part of another file; otherwise as `open_texture`."""
    return _texture(name, None, data, max_pixels, clamp, notes)


def texture_from_array(pixels: Any, name: str = "texture", clamp: bool = False) -> Texture:
    """Wrap (height, width, 3 or 4) uint8, row 0 at the top, as a `Texture`."""
    pixels = np.ascontiguousarray(pixels)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise UsageError(
            f"A texture is (height, width, 3 or 4) uint8; got {pixels.shape} {pixels.dtype}."
        )
    height, width = pixels.shape[:2]
    return Texture(name, (width, height), lambda: pixels, clamp)


def require_pages(textures: Sequence[Texture]) -> None:
    """Refuse pages that would fill the memory from few bytes, before any is decoded.

    Raises
    ------
    ResourceLimitError
        As `meshreg.io.files.safe.require_proportion`.
    """
    for texture in textures:
        load = texture.load
        if isinstance(load, EncodedImage):
            width, height = texture.size
            needed = _PER_PIXEL * width * height
            where = load.path or load.name
            require_proportion(needed, load.n_bytes, where, f"{width} × {height} pixels")


def texture_suffix(texture: Texture) -> str:
    """Return the suffix of the file that `write_texture` makes."""
    load = texture.load
    return SUFFIXES[load.kind] if isinstance(load, EncodedImage) else ".png"


def write_texture(texture: Texture, path: Path) -> None:
    """Write a page: byte for byte where it came from a file, else as PNG without loss.

    Raises
    ------
    OutputError
        `path` exists with other content, or cannot be written.
    """
    from PIL import Image

    load = texture.load
    if isinstance(load, EncodedImage) and load.path is not None:
        copy_file(load.path, path)
        return
    with atomic_file(path) as temporary:
        if isinstance(load, EncodedImage) and load.data is not None:
            temporary.write_bytes(load.data)
        else:
            Image.fromarray(load()).save(temporary, format="PNG", compress_level=3)


def _texture(
    name: str,
    path: Path | None,
    data: bytes | None,
    max_pixels: int,
    clamp: bool,
    notes: list[str] | None,
) -> Texture:
    with _opened(path, data, name) as image:
        size, kind, mode = image.size, str(image.format), image.mode
    width, height = size
    if width * height > max_pixels:
        raise ResourceLimitError(
            f"is {width} x {height} pixels; at most {max_pixels} in all are opened.",
            file=path or name,
            remedy="Export smaller texture pages, or raise max_pixels.",
        )
    if notes is not None and mode not in ("RGB", "RGBA"):
        notes.append(f"Texture page {name} has pixels of mode {mode}: converted to 8-bit RGB.")
    mark = (0, 0) if path is None else fingerprint(path)
    return Texture(name, (width, height), EncodedImage(name, kind, path, data, mark), clamp)


@contextmanager
def _opened(path: Path | None, data: bytes | None, name: str) -> Iterator[Any]:
    """Give Pillow's image of a file or of bytes; everything Pillow raises is an InputError."""
    from PIL import Image

    where = path or name
    stream = open_regular(path) if path is not None else io.BytesIO(data or b"")
    try:
        with stream, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of odd metadata, which are not used
            with _PILLOW:
                limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None  # we have our own
                try:
                    image = Image.open(stream, formats=FORMATS)
                except Image.UnidentifiedImageError:
                    image = _by_rasterio(stream, where)
                finally:
                    Image.MAX_IMAGE_PIXELS = limit
            with image:
                yield image
    except (InputError, ResourceLimitError):
        raise
    except MemoryError as error:
        raise ResourceLimitError("needs more memory than is free.", file=where) from error
    except Exception as error:  # Pillow raises OSError, SyntaxError, ValueError, struct.error ...
        raise InputError(
            f"is cut off or damaged: {error}.", file=where, remedy="Export or copy it again."
        ) from error


class _RasterioImage:
    """The few members of a Pillow image that this module uses, for TIFFs that Pillow lacks."""

    format = "TIFF"

    def __init__(self, path: Path) -> None:
        import rasterio

        # The driver is fixed: by itself GDAL would also open a VRT that names other files.
        self._file = rasterio.open(path, driver="GTiff")
        self.width, self.height = self.size = (self._file.width, self._file.height)
        bands = "one band" if self._file.count < 3 else f"{self._file.count} bands"
        self.mode = f"{bands} of {self._file.dtypes[0]}"

    def pixels(self, room: UInt8 | None) -> UInt8:
        """Decode the first three bands, and the fourth where it is called alpha."""
        from rasterio.windows import Window

        bands = [1, 2, 3] if self._file.count >= 3 else [1, 1, 1]
        if self._file.count > 3 and self._file.colorinterp[3].name == "alpha":
            bands.append(4)

        def rows(top: int, bottom: int) -> Any:
            window = Window(0, top, self.width, bottom - top)
            return np.moveaxis(self._file.read(bands, window=window), 0, -1)

        return _eight_bit_rows(rows, _place((self.height, self.width, len(bands)), room))

    def __enter__(self) -> _RasterioImage:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _by_rasterio(stream: Any, where: Path | str) -> _RasterioImage:
    """Open a TIFF of several 16-bit or float bands; anything else is no image at all."""
    stream.seek(0)
    start = stream.read(4)
    if isinstance(where, Path) and start[:2] in (b"II", b"MM") and start[2:] != b"\0\0":
        return _RasterioImage(where)
    raise InputError(
        "is not an image of a known kind (JPEG, PNG, TIFF or WebP).",
        file=where,
        remedy="Convert it to one of these.",
    )


def _place(shape: tuple[int, int, int], room: UInt8 | None) -> UInt8:
    """Return an array to fill: the front of `room`, where there is one."""
    return np.empty(shape, np.uint8) if room is None else room[: math.prod(shape)].reshape(shape)


def _strips(height: int) -> Iterator[tuple[int, int]]:
    """Give the first row and the end of each strip."""
    for top in range(0, height, _STRIP_ROWS):
        yield top, min(top + _STRIP_ROWS, height)


def _eight_bit_rows(rows: Callable[[int, int], Any], out: UInt8) -> UInt8:
    """Fill `out` from rows of any type, a strip at a time.

    Integers are scaled by their type's range, floats from 0-1 (or 0-255 where any is above 1).
    """
    scale = None
    for top, bottom in _strips(len(out)):
        values = rows(top, bottom)
        if values.dtype == np.uint8:
            out[top:bottom] = values
            continue
        if scale is None and values.dtype.kind == "f":
            largest = max(float(_finite(rows(*ends)).max(initial=0)) for ends in _strips(len(out)))
            scale = 255.0 if largest <= 1.0 else 1.0
        elif scale is None:
            scale = 255.0 / np.iinfo(values.dtype).max
        if values.dtype.kind == "f":
            values = _finite(values)
        out[top:bottom] = np.clip(np.rint(values * scale), 0, 255)
    return out


def _finite(values: Any) -> Any:
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


def _pixels(image: Any, name: str, room: UInt8 | None = None) -> UInt8:
    """Decode an image into (height, width, 3 or 4) uint8, at the front of `room` if it is given.

    By strips, because Pillow's conversion and its export hold what they convert again.
    """
    if isinstance(image, _RasterioImage):
        return image.pixels(room)
    image.load()

    def strip(top: int, bottom: int) -> Any:
        return image.crop((0, top, image.width, bottom))

    if image.mode[0] in "IF":  # one band of 16 or 32 bits

        def rows(top: int, bottom: int) -> Any:
            values = np.asarray(strip(top, bottom))[..., None]
            # 16 bits may be held in 32.
            return np.clip(values, 0, 65535).astype(np.uint16) if image.mode == "I" else values

        return _eight_bit_rows(rows, _place((image.height, image.width, 3), room))
    has_alpha = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
    mode = "RGBA" if has_alpha else "RGB"
    if image.mode == "LAB":
        raise InputError("has CIELAB pixels.", file=name, remedy="Convert it to RGB.")
    out = _place((image.height, image.width, len(mode)), room)
    for top, bottom in _strips(image.height):
        part = strip(top, bottom)
        out[top:bottom] = np.asarray(part if part.mode == mode else part.convert(mode))
    return out


def _require_memory(needed: int, size: tuple[int, int], name: str) -> None:
    """Refuse to decode what the machine has no room for, where the machine tells."""
    free = free_memory()
    if free is not None and needed > free:
        raise ResourceLimitError(
            f"is {size[0]} x {size[1]} pixels and takes {needed / 1e9:.1f} GB to decode; "
            f"{free / 1e9:.1f} GB are free.",
            file=name,
            remedy="Close other programs, or export smaller texture pages.",
        )
