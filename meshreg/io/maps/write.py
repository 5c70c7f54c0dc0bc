"""Write GeoTIFFs: cloud-optimised, whole or not at all, read back before they count."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError, OutputError
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.safe import open_regular
from meshreg.io.frames.crs import parse_crs
from meshreg.io.maps.geotiff import environment, opened, windows
from meshreg.records import Bool, Float32, Grid, UInt8

log = logging.getLogger("meshreg")

NODATA = -9999.0
_TILE = 512  # cells, as in a cloud-optimised GeoTIFF
_RETURN = "Check free space and run again."


def write_height(
    height: Float32,
    grid: Grid,
    path: Path,
    *,
    local: str | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write heights (H, W) float32 [m], NaN where there is none (-9999 in the file, declared).

    `local` is the WKT of a local CRS, for a grid that has none on Earth; `tags` are added.

    Raises
    ------
    OutputError
        It could not be written, or did not read back as written.
    """
    if (height == NODATA).any():
        log.warning("%s: heights of exactly %g become no data.", path, NODATA)
    _write(height[None], grid, path, nodata=NODATA, units="metre", local=local, tags=tags)


def write_color(
    color: UInt8,
    valid: Bool,
    grid: Grid,
    path: Path,
    *,
    local: str | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write colors (H, W, 3) uint8 with an alpha band that is 255 where `valid` (H, W), else 0.

    `local` and `tags` as for `write_height`.

    Raises
    ------
    OutputError
        It could not be written, or did not read back as written.
    """
    bands = np.empty((4, *valid.shape), np.uint8)
    bands[:3] = np.moveaxis(color, 2, 0)
    bands[3] = np.where(valid, 255, 0)
    _write(bands, grid, path, local=local, tags=tags)


def _write(
    bands: NDArray[Any],
    grid: Grid,
    path: Path,
    *,
    nodata: float | None = None,
    units: str = "",
    local: str | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    from meshreg import __version__

    with atomic_file(path) as temporary, environment():
        from rasterio import Affine
        from rasterio.crs import CRS
        from rasterio.enums import ColorInterp
        from rasterio.errors import RasterioError
        from rasterio.io import MemoryFile
        from rasterio.shutil import copy

        crs = None if grid.crs is None else CRS.from_wkt(parse_crs(grid.crs).to_wkt())
        if crs is None and local is not None:
            crs = CRS.from_wkt(local)
        # GDAL writes some blocks while it closes a file, and a full disk is then no error to it.
        # In its memory there is none, and what Python writes fails where it fails.
        try:
            with MemoryFile(ext=".tif") as plain, MemoryFile(ext=".tif") as memory:
                with plain.open(
                    driver="GTiff",
                    width=grid.shape[1],
                    height=grid.shape[0],
                    count=len(bands),
                    dtype=bands.dtype,
                    crs=crs,
                    transform=Affine(grid.cell, 0, grid.west, 0, -grid.cell, grid.north),
                    nodata=nodata,
                    tiled=True,
                    blockxsize=_TILE,
                    blockysize=_TILE,
                    sparse_ok=True,  # a turned strip is mostly empty
                    bigtiff="IF_SAFER",
                ) as dataset:
                    for _, window in dataset.block_windows():
                        dataset.write(_cut(bands, window, nodata), window=window)
                    dataset.update_tags(**(tags or {}))
                    dataset.update_tags(
                        AREA_OR_POINT="Area", TIFFTAG_SOFTWARE=f"meshreg {__version__}"
                    )
                    if len(bands) == 4:
                        dataset.colorinterp = [
                            ColorInterp.red,
                            ColorInterp.green,
                            ColorInterp.blue,
                            ColorInterp.alpha,
                        ]
                    if units:
                        dataset.units = (units,) * len(bands)
                copy(
                    plain.name,
                    memory.name,
                    driver="COG",
                    compress="DEFLATE",
                    predictor="YES",
                    bigtiff="IF_SAFER",
                    overview_resampling="AVERAGE",
                )
                temporary.write_bytes(memory.getbuffer())
        except RasterioError as error:
            raise OutputError(f"cannot be written: {error}.", file=path, remedy=_RETURN) from error
        _check(bands, grid, temporary, path, nodata)


def _cut(bands: NDArray[Any], window: Any, nodata: float | None) -> NDArray[Any]:
    """Return a window of the bands as it is in the file: what is not a number is no data there."""
    cut = bands[(slice(None), *window.toslices())]
    return cut if nodata is None else np.where(np.isfinite(cut), cut, cut.dtype.type(nodata))


def _check(
    bands: NDArray[Any], grid: Grid, temporary: Path, path: Path, nodata: float | None
) -> None:
    """Compare what is on disk with what was meant, value by value."""
    try:
        with opened(temporary, 1 << 62) as dataset:
            same = dataset.shape == grid.shape and dataset.bounds == grid.bounds
            for window in windows(dataset) if same else ():
                there = dataset.read(window=window)
                same = same and np.array_equal(there, _cut(bands, window, nodata))
    except InputError as error:
        raise OutputError(error.message, file=path, remedy=_RETURN) from error
    if not (same and _tags_agree(grid, temporary)):
        raise OutputError("does not read back as written.", file=path, remedy=_RETURN)


def _tags_agree(grid: Grid, written: Path) -> bool:
    """Whether the tags say the grid to Pillow too, which has not written them.

    OGC GeoTIFF 1.1, requirements class 8: model = tie point + pixel times scale.
    """
    from PIL import TiffImagePlugin

    with open_regular(written) as stream:
        head = stream.read(8)
        if head[2:3] == b"+" or head[3:4] == b"+":  # BigTIFF
            head += stream.read(8)
        tags = TiffImagePlugin.ImageFileDirectory_v2(head)
        stream.seek(tags.next)
        tags.load(stream)
        size, scale, tie = (tags.get(number) for number in (257, 33550, 33922))
        wide = tags.get(256)
    if scale is None or tie is None:
        return False
    corner = (tie[3] - tie[0] * scale[0], tie[4] + tie[1] * scale[1])
    return (
        (size, wide) == tuple(grid.shape)
        and np.allclose(scale[:2], grid.cell, rtol=1e-12, atol=0)
        and np.allclose(corner, (grid.west, grid.north), rtol=1e-14, atol=1e-9)
    )
