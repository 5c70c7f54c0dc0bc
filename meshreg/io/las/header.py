"""Check a LAS or LAZ header against its file before laspy sees it, and read its CRS.

laspy (2.7) takes a file cut at a record for a smaller cloud, spins on a VLR count of 2^31 and
accepts a scale of zero; lazrs may panic on damage. ASPRS LAS 1.4 R15, section 2.4.
"""

from __future__ import annotations

import contextlib
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from meshreg.errors import InputError
from meshreg.io.files.safe import open_regular, require, require_proportion
from meshreg.io.frames.crs import crs_text, metres_per_unit, parse_crs, with_vertical_unit
from meshreg.io.las.laz_chunks import DAMAGED, Vlr, check_chunks

_SIZES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}  # by minor version
_PER_POINT = 80  # bytes of memory: steps, coordinates, colors, and copies of them
_RECORDS = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)  # by point format
_LINEAR_UNITS = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}  # GeoTIFF codes
_ODD = "Its coordinates were taken as a local frame."
CRS_RECORDS = (2111, 2112, 34735, 34736, 34737)


@dataclass(frozen=True)
class LasHead:
    """What the checked header says: `count` points of `record` bytes, in `step`s from `offset`."""

    count: int
    record: int
    point_format: int
    compressed: bool
    step: tuple[float, float, float]
    offset: tuple[float, float, float]
    minor: int
    inner_waveforms: bool


def check_header(path: Path) -> LasHead:
    """Read and check the header, the VLRs and the EVLRs of a LAS or LAZ file.

    Raises
    ------
    InputError
        Not LAS, a version or point format that is not known, counts that the file's size cannot
        hold, a step of zero, an offset that is no number.
    """
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        head = stream.read(393)
        if head[:4] != b"LASF":
            raise InputError("does not start with 'LASF'.", file=path, remedy=DAMAGED)
        if len(head) < 227 or head[24] != 1 or head[25] not in _SIZES:
            version = f"{head[24]}.{head[25]}" if len(head) >= 227 else "cut off"
            raise InputError(f"has an unknown LAS version ({version}).", file=path, remedy=DAMAGED)
        minor = head[25]
        length, start, n_vlrs, form, record = struct.unpack_from("<HIIBH", head, 94)
        if not _SIZES[minor] <= length <= start <= size or len(head) < _SIZES[minor]:
            raise InputError(
                f"has a header of {length} bytes and points from byte {start}, in {size} bytes.",
                file=path,
                place="header",
                remedy=DAMAGED,
            )
        (encoding,) = struct.unpack_from("<H", head, 6)
        compressed, form = bool(form & 0xC0), form & 0x3F
        if form >= len(_RECORDS) or record < _RECORDS[form]:
            raise InputError(
                f"has point format {form} in records of {record} bytes.",
                file=path,
                place="header",
                remedy="Point formats 0 to 10 are read.",
            )
        (count,) = struct.unpack_from("<I", head, 107)
        waves = struct.unpack_from("<Q", head, 227)[0] if minor >= 3 else 0
        end = size
        if minor >= 4:
            evlrs, n_evlrs, count = struct.unpack_from("<QIQ", head, 235)
            if n_evlrs:
                _walk(stream, path, evlrs, n_evlrs, size, start, extended=True)
                end = evlrs
        vlrs = _walk(stream, path, length, n_vlrs, start, length, extended=False)
    inner = bool(encoding & 2) and 0 < waves < size
    if inner and form in (4, 5, 9, 10):
        end = min(end, waves)
    require(count, _least_bytes(compressed, record), end - start, path, "header", "points")
    require_proportion(_PER_POINT * count, size, path, f"{count} points")
    step, offset = struct.unpack_from("<3d", head, 131), struct.unpack_from("<3d", head, 155)
    _check_numbers(path, step, offset)
    if count == 0:
        raise InputError("holds no points.", file=path, remedy="Export it again.")
    if compressed:
        check_chunks(path, vlrs, start, size, count, record)
    return LasHead(count, record, form, compressed, step, offset, minor, inner)


def _least_bytes(compressed: bool, record: int) -> float:
    """Return the least size of a point: LAZ of constant points comes to some 1/400 byte each."""
    return 1e-3 if compressed else record


def _check_numbers(path: Path, step: Any, offset: Any) -> None:
    if not (np.isfinite(step).all() and all(1e-15 < abs(value) < 1e9 for value in step)):
        raise InputError(
            f"has the scale {step}.", file=path, place="byte 131", remedy="Export it again."
        )
    if not (np.isfinite(offset).all() and np.abs(offset).max() < 1e15):
        raise InputError(
            f"has the offset {offset}.", file=path, place="byte 155", remedy="Export it again."
        )


def _walk(
    stream: BinaryIO, path: Path, start: int, count: int, end: int, least: int, *, extended: bool
) -> list[Vlr]:
    """Step over all (E)VLRs, each of which must lie before `end`."""
    what = "EVLRs" if extended else "VLRs"
    form = struct.Struct("<H16sHQ32s" if extended else "<H16sHH32s")
    if start < least or start > end:
        raise InputError(f"has its {what} at byte {start}.", file=path, remedy=DAMAGED)
    require(count, form.size, end - start, path, "header", what)
    found = []
    here = start
    for number in range(count):
        stream.seek(here)
        raw = stream.read(form.size)
        _, user, record, length, _ = form.unpack(raw.ljust(form.size, b"\xff"))
        found.append(Vlr(user.rstrip(b"\0"), record, here + form.size, length))
        here += form.size + length
        if here > end:
            raise InputError(
                f"has {count} {what}, of which number {number + 1} runs beyond byte {end}.",
                file=path,
                place=f"byte {here - form.size - length}",
                remedy=DAMAGED,
            )
    return found


def file_crs(header: Any, notes: list[str]) -> tuple[str | None, float | None]:
    """Return the CRS of a laspy header and, where that is not known, its linear unit [m].

    WKT goes before GeoTIFF keys. Keys give the vertical CRS (4096) or at least its unit (4099)
    where the horizontal part does not.
    """
    keys = {
        key.id: key.value_offset
        for vlr in header.vlrs.get("GeoKeyDirectoryVlr")
        for key in vlr.geo_keys
        if key.tiff_tag_location == 0
    }
    with contextlib.suppress(InputError):
        text = crs_text(_wkt(header)) if _wkt(header) else _from_keys(keys)
        if text is not None:
            return _with_height(text, keys), None
    if keys or _wkt(header):
        notes.append(f"The file's coordinate reference system is not understood. {_ODD}")
    unit = _LINEAR_UNITS.get(keys.get(3076, 9001), 1.0)
    if unit != 1.0:
        notes.append(f"Its coordinates are in feet of {unit:.9g} m.")
        return None, unit
    return None, None


def _wkt(header: Any) -> str:
    records = [*header.vlrs.get("WktCoordinateSystemVlr")]
    if header.evlrs is not None:
        records += header.evlrs.get("WktCoordinateSystemVlr")
    return next((str(item.string).strip("\0 ") for item in records if item.string), "")


def _from_keys(keys: dict[int, int]) -> str | None:
    """Return the CRS of GeoTIFF keys; a geographic one only where coordinates are in it."""
    projected, geographic = keys.get(3072, 0), keys.get(2048, 0)
    if 1024 <= projected <= 32766:
        return crs_text(f"EPSG:{projected}")
    if keys.get(1024) == 2 and 1024 <= geographic <= 32766:
        return crs_text(f"EPSG:{geographic}")
    return None


def _with_height(text: str, keys: dict[int, int]) -> str:
    if parse_crs(text).is_compound or len(parse_crs(text).axis_info) == 3:
        return text
    vertical, unit = keys.get(4096, 0), _LINEAR_UNITS.get(keys.get(4099, 0))
    if 1024 <= vertical <= 32766:
        with contextlib.suppress(InputError):
            if parse_crs(f"EPSG:{vertical}").is_vertical and ":" in text[:6]:
                return crs_text(f"{text}+{vertical}") or text
    if unit is not None and abs(unit - metres_per_unit(text)) > 1e-12:
        return with_vertical_unit(text, unit)
    return text
