"""The values of a GeoTIFF: one band of heights or a picture, and where there is no data.

No-data values come declared, as mask, as alpha band, or not at all; what was taken for no data
without being declared is said in a note.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, UsageError
from meshreg.io.frames.axes import UNITS
from meshreg.io.maps.geotiff import (
    EXPORT,
    crs_of,
    lattice,
    local_crs_of,
    opened,
    place_notes,
    windows,
)
from meshreg.io.maps.sides import read_mask_file, read_sides
from meshreg.records import Bool, Float32, Float64, UInt8

# Written without being declared, by Metashape, PDAL, ODM, CODEM, ASP, and as others' defaults.
# The large positive ones are those of ESRI, Surfer and netCDF.
_HUGE = (-3.4028234663852886e38, 3.4028234663852886e38, 1.70141e38, 9.969209968386869e36)
NODATA = (-9999.0, -10000.0, -32767.0, -32768.0, -99999.0, -1e6, *_HUGE, 0.0)
_HIGHEST = 1e9  # heights from here on are damage, in whatever unit
NODATA_COLORS = (0, 255)
_STALE = re.compile(r"AREA_OR_POINT|STATISTICS_|TIFFTAG_(SOFTWARE|[XY]?RESOLUTION)|OVERVIEW|OVR")


@dataclass(frozen=True, eq=False)
class RawMap:
    """One raster as it is in its file.

    Attributes
    ----------
    path : Path
    values : (H, W) float32, NaN where there is none, or (H, W, 3) uint8
    valid : (H, W) bool
    matrix : (2, 3) float64
        Takes (col, row, 1) of outer pixel corners to x, y in the file's CRS.
    crs : str or None
    unit : str
        Unit of the band, as written; "" where it does not say.
    notes : tuple of str
    local : str or None
        WKT of the file's local (engineering) CRS, which says nothing about the place on Earth.
    tags : mapping
        What the file says of itself beside.
    """

    path: Path
    values: Float32 | UInt8
    valid: Bool
    matrix: Float64
    crs: str | None
    unit: str
    notes: tuple[str, ...]
    local: str | None = None
    tags: Mapping[str, str] = field(default_factory=dict)


def read_height(path: Path, max_pixels: int) -> RawMap:
    """Read a DEM: the first band, float32, NaN where there is no data.

    No data are cells under the declared value, the mask or the alpha band, values that are not
    finite, and undeclared values in `NODATA` that lie far outside all others.

    Raises
    ------
    InputError
        Not a GeoTIFF, damaged, not georeferenced, or without a valid height.
    ResourceLimitError
        More than `max_pixels`.
    """
    sides = read_sides(path)
    notes: list[str] = list(sides.notes)
    with opened(path, max_pixels) as dataset:
        matrix, crs = lattice(dataset, path, sides), crs_of(dataset, path, sides)
        local, tags = local_crs_of(dataset, sides), _tags(dataset)
        notes += place_notes(dataset, path, sides)
        if np.dtype(dataset.dtypes[0]).kind not in "iuf":
            raise InputError(f"holds {dataset.dtypes[0]}, not heights.", file=path, remedy=EXPORT)
        others = [c.name for c in dataset.colorinterp[1:] if c.name != "alpha"]
        if others:
            notes.append(f"The first of {dataset.count} bands was taken as height.")
        scale, offset = dataset.scales[0], dataset.offsets[0]
        if (scale, offset) == (1, 0):
            scale = 1.0 if sides.scale is None else sides.scale
            offset = 0.0 if sides.offset is None else sides.offset
        declared = dataset.nodata
        beside = None  # the value in .aux.xml, as the band's type holds it
        if declared is None and sides.nodata is not None:
            declared = sides.nodata
            with np.errstate(all="ignore"):
                beside = float(np.array(sides.nodata, np.float64).astype(dataset.dtypes[0]))
        mask = read_mask_file(sides, dataset.shape, opened, notes)
        values = np.empty(dataset.shape, np.float32)
        for window in windows(dataset):
            rows = slice(window.row_off, window.row_off + window.height)
            with np.errstate(all="ignore"):  # what is not finite becomes NaN below
                part = dataset.read(1, window=window).astype(np.float64)
                part[dataset.read_masks(1, window=window) < 128] = np.nan
                if beside is not None:
                    part[part == beside] = np.nan
                if mask is not None:
                    part[~mask[rows]] = np.nan
                values[rows] = part * scale + offset if (scale, offset) != (1, 0) else part
        unit = (dataset.units[0] or "").strip() or sides.unit
    values[~np.isfinite(values)] = np.nan
    _drop_undeclared(values, notes)
    _require_heights(values, path)
    valid = np.isfinite(values)
    if not valid.any():
        raise InputError("holds no height: every cell is without data.", file=path, remedy=EXPORT)
    _warn_of_nodata_in_range(values, declared, scale, offset, notes)
    return RawMap(path, values, valid, matrix, crs, unit, tuple(notes), local, tags)


def _tags(dataset: Any) -> dict[str, str]:
    """Return a file's own tags that hold for its moved copy too."""
    found = {str(key): str(value) for key, value in dataset.tags().items()}
    return {key: value for key, value in found.items() if not _STALE.match(key)}


def _require_heights(values: Float32, path: Path) -> None:
    """Refuse heights that no place has."""
    with np.errstate(invalid="ignore"):
        high = np.abs(values) >= _HIGHEST
    count = int(np.count_nonzero(high))
    if count:
        row, col = (int(k) for k in np.argwhere(high)[0])
        raise InputError(
            f"has {count} heights of {_HIGHEST:g} or more, the first {values[row, col]:g}.",
            file=path,
            place=f"row {row + 1}, column {col + 1}",
            remedy="Where they stand for no data, declare that value (gdal_edit.py -a_nodata).",
        )


def _drop_undeclared(values: Float32, notes: list[str]) -> None:
    """Set cells to NaN that hold a usual no-data value, where that stands apart from all others."""
    counts = {np.float32(v): int(np.count_nonzero(values == np.float32(v))) for v in NODATA}
    found = {value: count for value, count in counts.items() if count}
    if not found:
        return
    low, high = np.inf, -np.inf
    for part in np.array_split(values, max(1, values.size >> 22)):
        kept = part[np.isfinite(part) & ~np.isin(part, list(found))]
        if len(kept):
            low, high = min(low, float(kept.min())), max(high, float(kept.max()))
    for value, count in found.items():
        apart = max(low - float(value), float(value) - high)
        share = f"{count} of {values.size} cells"
        if low <= high and apart > max(1.0, high - low):
            values[values == value] = np.nan
            notes.append(f"{value:g} was taken as no data, undeclared ({share}).")
        elif value != 0 and low <= high:
            notes.append(f"{share} hold {value:g}, often no data, among others like it; kept.")


def _warn_of_nodata_in_range(
    values: Float32, declared: float | None, scale: float, offset: float, notes: list[str]
) -> None:
    if declared is None or not math.isfinite(declared):
        return
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low < declared * scale + offset < high:
        notes.append(
            f"The declared no-data value {declared:g} lies inside the heights ({low:.3g} to "
            f"{high:.3g}): true surface of exactly that height is lost."
        )


def read_color(path: Path, max_pixels: int) -> RawMap:
    """Read an orthomosaic: (H, W, 3) uint8 and where it was seen.

    Not seen is what the alpha or mask band or the declared value says; where none of these is
    there, exact black (or white), if that runs along the border.

    Raises
    ------
    InputError
        Not a GeoTIFF, damaged, not georeferenced, or of numbers that are no colors.
    ResourceLimitError
        More than `max_pixels`.
    """
    sides = read_sides(path)
    notes: list[str] = list(sides.notes)
    with opened(path, max_pixels) as dataset:
        matrix, crs = lattice(dataset, path, sides), crs_of(dataset, path, sides)
        local, tags = local_crs_of(dataset, sides), _tags(dataset)
        notes += place_notes(dataset, path, sides)
        mask = read_mask_file(sides, dataset.shape, opened, notes)
        beside = sides.nodata if dataset.nodata is None else None
        bands, palette = _color_bands(dataset)
        factor = _color_factor(dataset, bands, path, notes) if palette is None else 1.0
        colors = np.empty((*dataset.shape, 3), np.uint8)
        valid = np.empty(dataset.shape, bool)
        for window in windows(dataset):
            rows = slice(window.row_off, window.row_off + window.height)
            part = dataset.read(bands, window=window)
            valid[rows] = dataset.dataset_mask(window=window) >= 128
            if mask is not None:
                valid[rows] &= mask[rows]
            if beside is not None:
                valid[rows] &= (part != beside).any(axis=0)
            if palette is not None:
                colors[rows] = palette[part[0]]
            else:
                if factor != 1:
                    part = np.clip(np.rint(np.nan_to_num(part) * factor), 0, 255)
                colors[rows] = np.moveaxis(part, 0, 2)  # one grey band spreads over all three
        undeclared = all(
            flag.name == "all_valid" for flags in dataset.mask_flag_enums for flag in flags
        )
    if undeclared and mask is None and beside is None:
        _drop_undeclared_color(colors, valid, notes)
    if not valid.any():
        raise InputError("holds no color: every pixel is masked.", file=path, remedy=EXPORT)
    colors[~valid] = 0
    return RawMap(path, colors, valid, matrix, crs, "", tuple(notes), local, tags)


def _color_bands(dataset: Any) -> tuple[list[int], UInt8 | None]:
    """Return the bands of red, green and blue (or one of grey) and the palette, if any."""
    names = [interpretation.name for interpretation in dataset.colorinterp]
    if names[0] == "palette":
        table = dataset.colormap(1)
        palette = np.zeros((1 << 16, 3), np.uint8)
        for index, color in table.items():
            palette[index] = color[:3]
        return [1], palette
    if all(name in names for name in ("red", "green", "blue")):
        return [names.index(name) + 1 for name in ("red", "green", "blue")], None
    plain = [number for number, name in enumerate(names, 1) if name != "alpha"]
    return (plain[:3] if len(plain) >= 3 else plain[:1]), None


def _color_factor(dataset: Any, bands: list[int], path: Path, notes: list[str]) -> float:
    """Return what values are multiplied by to reach 0-255; stated in a note where not 1."""
    dtype = np.dtype(dataset.dtypes[bands[0] - 1])
    if dtype == np.uint8:
        return 1.0
    highest = 0.0
    for window in windows(dataset):
        part = dataset.read(bands, window=window, masked=True)
        part = np.ma.masked_invalid(part)
        if part.count():
            highest = max(highest, float(part.max()))
    if dtype.kind == "f":
        full = 1.0 if highest <= 1 else 255.0 if highest <= 255 else math.nan
    else:
        full = float(next((2**n - 1 for n in (8, 10, 12, 14, 16) if highest < 2**n), math.nan))
    if math.isnan(full):
        raise InputError(
            f"holds {dtype} values up to {highest:g}, which are not colors.",
            file=path,
            remedy="Export the orthomosaic in 8 or 16 bits a band.",
        )
    if full != 255:
        notes.append(f"Colors of 0 to {full:g} were scaled to 0 to 255.")
    return 255.0 / full


def _drop_undeclared_color(colors: UInt8, valid: Bool, notes: list[str]) -> None:
    border = np.concatenate([colors[0], colors[-1], colors[:, 0], colors[:, -1]])
    for value in NODATA_COLORS:
        # A photograph's border has some black; a mosaic's ragged edge has much.
        if (border == value).all(axis=1).mean() < 0.02:
            continue
        empty = (colors == value).all(axis=2)
        valid &= ~empty
        name = "black" if value == 0 else "white"
        notes.append(
            f"Pure {name} along the border was taken as no data, undeclared "
            f"({np.count_nonzero(empty)} of {valid.size} pixels)."
        )


def height_unit(raw: RawMap, option: str | None) -> float | None:
    """Return metres per unit of a DEM's heights as the user or the band says; None if neither."""
    if option is not None:
        if option.strip().lower() not in UNITS:
            raise UsageError(f"unit {option!r} is not known.", remedy=f"Use {', '.join(UNITS)}.")
        return UNITS[option.strip().lower()]
    name = re.sub(r"[^a-z]", "", raw.unit.lower())
    if "survey" in name or name in ("usft", "ftus", "usfoot"):
        return UNITS["us-ft"]
    if name.startswith(("f", "international")):
        return UNITS["ft"]
    known = {"m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0}
    return known.get(name) or UNITS.get(name)
