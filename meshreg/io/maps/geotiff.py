"""Open GeoTIFFs, and nothing that only claims to be one; say where their pixels lie.

GDAL has 150 drivers and follows references between files; here it gets one driver, no look at the
folder, and only files that start as a TIFF does.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, MeshregError, ResourceLimitError
from meshreg.io.files.safe import FARTHEST, beside, open_regular, require_proportion
from meshreg.io.frames.crs import crs_text, mend_proj_data
from meshreg.io.maps.sides import MAGIC, Sides
from meshreg.records import Float64

_CACHE = 64  # MB; a twentieth of the memory else, filled by any large raster
_WINDOW = 1 << 22  # pixels decoded at once
_PER_PIXEL = 64  # bytes of memory: values, what is valid, both sampled anew, rasters of them
ANY_SIZE = 1 << 62  # `max_pixels` for files that we wrote, or have read before
_DENSEST = 5000  # pixels that one byte of a compressed file may stand for
_WORLD_FILES = (".tfw", ".TFW", ".tifw", ".tiffw", ".wld")
EXPORT = "Export it as a GeoTIFF again."


@contextmanager
def environment() -> Iterator[None]:
    """Keep GDAL from looking at other files, and PROJ from a broken database."""
    mend_proj_data()
    import rasterio

    with rasterio.Env(
        GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_PAM_ENABLED="NO", GDAL_CACHEMAX=_CACHE
    ):
        yield


@contextmanager
def opened(path: Path, max_pixels: int) -> Iterator[Any]:
    """Give the rasterio dataset of a GeoTIFF; what goes wrong inside becomes an InputError.

    Raises
    ------
    InputError
        Not a TIFF by its first bytes (a VRT in disguise, for one), or damaged.
    ResourceLimitError
        More than `max_pixels`.
    """
    with open_regular(path) as stream:
        magic = stream.read(4)
    if magic not in MAGIC:
        raise InputError(f"is not a TIFF: it starts with {magic!r}.", file=path, remedy=EXPORT)
    with environment():
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioError

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                dataset = rasterio.open(path.resolve(), driver="GTiff", sharing=False)
            with dataset:
                _check_size(dataset, path, max_pixels)
                yield dataset
        except MeshregError:
            raise
        except Exception as error:
            # GDAL's own errors come through rasterio as they are, with no root of their own.
            if not isinstance(error, RasterioError) and "rasterio" not in type(error).__module__:
                raise
            cause = error.__cause__ or error
            raise InputError(
                f"cannot be read: {_first_line(cause)}.",
                file=path,
                remedy="The file is cut off or damaged; export or copy it again.",
            ) from error


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")


def _check_size(dataset: Any, path: Path, max_pixels: int) -> None:
    pixels = dataset.width * dataset.height
    if pixels > max_pixels:
        raise ResourceLimitError(
            f"has {dataset.width} × {dataset.height} pixels; {max_pixels} are the limit.",
            file=path,
            remedy="Cut it, or raise the limit (max_pixels).",
        )
    size = path.stat().st_size
    if pixels > size * _DENSEST:
        raise InputError(
            f"declares {dataset.width} × {dataset.height} pixels, but has {size} bytes.",
            file=path,
            remedy="The file is cut off or damaged; export or copy it again.",
        )
    if max_pixels >= ANY_SIZE:
        return
    declared = f"{dataset.width} × {dataset.height} pixels of {dataset.count} bands"
    require_proportion(_PER_PIXEL * pixels, size, path, declared)
    # GDAL decodes whole blocks, which may be larger than the picture.
    block = max(rows * cols for rows, cols in dataset.block_shapes) * dataset.count
    wide = block * max(np.dtype(kind).itemsize for kind in dataset.dtypes)
    require_proportion(4 * wide, size, path, declared)


def is_picture(path: Path, max_pixels: int) -> bool:
    """Whether a GeoTIFF is an orthomosaic: three bands or more, or whole numbers with a palette."""
    with opened(path, max_pixels) as dataset:
        colors = [i.name for i in dataset.colorinterp if i.name not in ("alpha", "undefined")]
        whole = np.dtype(dataset.dtypes[0]).kind == "u"
        return dataset.count >= 3 or "palette" in colors or (whole and dataset.dtypes[0] == "uint8")


def windows(dataset: Any) -> Iterator[Any]:
    """Give windows of whole rows, block-aligned, that cover the raster."""
    from rasterio.windows import Window

    step = max(1, _WINDOW // (dataset.width * dataset.count))
    block = dataset.block_shapes[0][0]
    step = max(step // block, 1) * block
    for row in range(0, dataset.height, step):
        yield Window(0, row, dataset.width, min(step, dataset.height - row))


def lattice(dataset: Any, path: Path, sides: Sides | None = None) -> Float64:
    """Return the (2, 3) matrix from (col, row, 1) of outer pixel corners to file x, y.

    A file whose pixels are points (AREA_OR_POINT=Point) is given by GDAL as areas already, half a
    pixel outward of its tie point. A georeference in .aux.xml replaces the file's own; without
    either a world file beside it counts.
    """
    affine = dataset.transform
    matrix = np.array([[affine.a, affine.b, affine.c], [affine.d, affine.e, affine.f]], float)
    if sides is not None and sides.matrix is not None:
        matrix = sides.matrix
    elif affine.is_identity:
        world = _world_beside(path)
        if world is None:
            where = "ground control points only" if dataset.gcps[0] else "no georeference"
            raise InputError(
                f"has {where}: where its pixels lie is not known.",
                file=path,
                remedy="Export it as a GeoTIFF in a projected CRS, or with a world file (.tfw).",
            )
        matrix = _world_file(world)
    (a, b, _), (d, e, _) = matrix.tolist()
    if not np.isfinite([*matrix.ravel(), a * e, b * d]).all() or a * e == b * d:
        raise InputError(
            f"has a georeference that flattens its pixels ({matrix.tolist()}).",
            file=path,
            remedy=EXPORT,
        )
    pixel = np.abs(matrix[:, :2]).sum(axis=0).min()
    farthest = np.abs(matrix @ [*np.array(dataset.shape[::-1], float), 1.0]).max()
    farthest = max(farthest, np.abs(matrix[:, 2]).max())
    if not (farthest < FARTHEST and np.spacing(farthest) < 1e-3 * pixel):
        raise InputError(
            f"has pixels of {pixel:.3g} at coordinates of up to {farthest:.3g}, which cannot be "
            "told apart there.",
            file=path,
            place="georeference",
            remedy=EXPORT,
        )
    return matrix


def _world_beside(path: Path) -> Path | None:
    named = (beside(path.parent, path.with_suffix(suffix).name) for suffix in _WORLD_FILES)
    return next((file for file in named if file is not None), None)


def _world_file(path: Path) -> Float64:
    """Read six numbers: x and y steps by column, by row, and the CENTRE of the first pixel."""
    with open_regular(path) as stream:
        words = stream.read(4096).split()
    try:
        a, d, b, e, c, f = (float(word) for word in words[:6])
    except ValueError as error:
        raise InputError(
            "is not a world file: it should hold six numbers.", file=path, remedy=EXPORT
        ) from error
    return np.array([[a, b, c - (a + b) / 2], [d, e, f - (d + e) / 2]])


def place_notes(dataset: Any, path: Path, sides: Sides) -> list[str]:
    """Say where side files and the file itself give different places, and which one counts."""
    notes = []
    affine = dataset.transform
    own = np.array([[affine.a, affine.b, affine.c], [affine.d, affine.e, affine.f]], float)
    ends = np.array([[0, 0, 1], [dataset.width, dataset.height, 1]], float).T
    pixel = max(np.abs(own[:, :2]).max(), 1e-300)
    if affine.is_identity:
        pass
    elif sides.matrix is not None:
        if np.abs((sides.matrix - own) @ ends).max() > 0.01 * pixel:
            notes.append(f"{path.name}.aux.xml gives another place than the file; it counts.")
    elif (world := _world_beside(path)) is not None:
        try:
            differs = np.abs((_world_file(world) - own) @ ends).max() > 0.01 * pixel
        except InputError:
            differs = True
        if differs:
            notes.append(f"{world.name} gives another place than the file, which counts.")
    if sides.crs is not None and dataset.crs is not None:
        one, two = crs_of(dataset, path), crs_of(dataset, path, sides)
        if one != two:
            notes.append(f"{path.name}.aux.xml gives another CRS than the file; it counts.")
    return notes


def local_crs_of(dataset: Any, sides: Sides | None = None) -> str | None:
    """Return the WKT of a dataset's local (engineering) CRS; None for any other, or none."""
    from meshreg.io.frames.crs import parse_crs

    wkt = sides.crs if sides is not None and sides.crs else None
    if wkt is None and dataset.crs is not None:
        wkt = dataset.crs.to_wkt()
    if not wkt:
        return None
    try:
        return wkt if parse_crs(wkt).is_engineering else None
    except InputError:
        return None


def crs_of(dataset: Any, path: Path, sides: Sides | None = None) -> str | None:
    """Return the CRS of a dataset in the spelling of `crs_text`; None for a local one."""
    if sides is not None and sides.crs is not None:
        wkt = sides.crs
    elif dataset.crs is None:
        return None
    else:
        wkt = dataset.crs.to_wkt()
    try:
        return crs_text(wkt)
    except InputError as error:
        raise InputError(error.message, file=path, remedy=error.remedy) from error
