"""What lies beside a GeoTIFF: GDAL's mask (.msk) and auxiliary metadata (.aux.xml).

GDAL itself is kept from looking at side files (`geotiff.environment`), because they may
name any other; so the few things that matter are read here, with GDAL's precedence: a place in
.aux.xml replaces the file's own, all else stands in for what the file does not say.
https://gdal.org/en/stable/drivers/raster/gtiff.html, section "Georeferencing"
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.io.files.safe import beside, open_regular
from meshreg.records import Bool, Float64

MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_MAX_BYTES = 1 << 24  # histograms and attribute tables are long
_UNREAD = (".aux", ".rrd", ".points", ".tab", ".rpb", "_rpc.txt")
_ESRI = "xml:ESRI"


@dataclass(frozen=True, eq=False)
class Sides:
    """What the side files of one GeoTIFF say; None is "nothing said".

    Attributes
    ----------
    mask : Path or None
        The .msk.
    matrix : (2, 3) float64 or None
        As `RawMap.matrix`.
    crs : str or None
        WKT.
    nodata, scale, offset : float or None
        Of the first band.
    unit : str
        Of the first band; "" where none is said.
    notes : tuple of str
    """

    mask: Path | None = None
    matrix: Float64 | None = None
    crs: str | None = None
    nodata: float | None = None
    scale: float | None = None
    offset: float | None = None
    unit: str = ""
    notes: tuple[str, ...] = ()


def read_sides(path: Path) -> Sides:
    """Read the side files of a GeoTIFF.

    Raises
    ------
    InputError
        An .aux.xml that is damaged or of another kind.
    UnsafeReferenceError
        A link that leaves the file's folder.
    """
    folder = path.parent
    mask = beside(folder, f"{path.name}.msk")
    notes = [
        f"{name} beside it is not read."
        for suffix in _UNREAD
        for name in dict.fromkeys((f"{path.stem}{suffix}", f"{path.name}{suffix}"))
        if beside(folder, name) is not None
    ]
    file = beside(folder, f"{path.name}.aux.xml")
    if file is None:
        return Sides(mask, notes=tuple(notes))
    tree = _parsed(file)
    if tree is None:
        return Sides(mask, notes=(*notes, f"{file.name} is not GDAL's (PAMDataset); ignored."))
    for domain in (item.get("domain", "") for item in tree.findall("Metadata")):
        if domain == _ESRI and tree.find("GeoTransform") is None:
            notes.append(f"{file.name} holds a geodata transform of ESRI's, which is not read.")
    if tree.find("GCPList") is not None:
        notes.append(f"{file.name} holds ground control points, which are not read.")
    band = next((item for item in tree.findall("PAMRasterBand") if item.get("band") == "1"), None)

    def number(name: str) -> float | None:
        text = None if band is None else band.findtext(name)
        return None if text is None else _numbers(file, name, text, 1)[0]

    matrix = None
    if (text := tree.findtext("GeoTransform")) is not None:
        c, a, b, f, d, e = _numbers(file, "GeoTransform", text, 6)
        matrix = np.array([[a, b, c], [d, e, f]])
    return Sides(
        mask,
        matrix,
        (tree.findtext("SRS") or "").strip() or None,
        number("NoDataValue"),
        number("Scale"),
        number("Offset"),
        ("" if band is None else band.findtext("UnitType") or "").strip(),
        tuple(notes),
    )


def _parsed(path: Path) -> ET.Element | None:
    """Return the root of an .aux.xml, or None where it is not GDAL's."""
    with open_regular(path) as stream:
        content = stream.read(_MAX_BYTES + 1)
    if len(content) > _MAX_BYTES or re.search(rb"<!(DOCTYPE|ENTITY)", content):
        raise InputError(
            "is too long for auxiliary metadata, or declares entities.",
            file=path,
            remedy="Remove it, if the GeoTIFF is right without it.",
        )
    try:
        root = ET.fromstring(content)
    except (ET.ParseError, ValueError) as error:
        raise InputError(
            f"is not XML: {error}.",
            file=path,
            remedy="Remove it, if the GeoTIFF is right without it.",
        ) from error
    return root if root.tag == "PAMDataset" else None


def _numbers(path: Path, name: str, text: str, count: int) -> list[float]:
    words = [word for word in re.split(r"[\s,]+", text) if word]
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    finite = all(map(math.isfinite, values)) or name == "NoDataValue"
    if len(values) != count or not finite:
        raise InputError(
            f"has {name} {text.strip()[:60]!r}; expected {count} number{'s' * (count > 1)}.",
            file=path,
            remedy="Remove it, if the GeoTIFF is right without it.",
        )
    return values


def read_mask_file(
    sides: Sides, shape: tuple[int, int], opened: Callable[[Path, int], Any], notes: list[str]
) -> Bool | None:
    """Return where the .msk shows data (H, W), or None where there is none that fits."""
    if sides.mask is None:
        return None
    with open_regular(sides.mask) as stream:
        is_tiff = stream.read(4) in MAGIC
    if not is_tiff:  # a VRT in disguise, for one, which names other files
        notes.append(f"{sides.mask.name} beside it is not a TIFF, as GDAL's masks are; ignored.")
        return None
    with opened(sides.mask, shape[0] * shape[1]) as dataset:
        if dataset.shape != shape:
            notes.append(f"{sides.mask.name} is of another size than the map; ignored.")
            return None
        mask: Bool = dataset.read(1) > 0
    notes.append(f"{sides.mask.name} masks {np.count_nonzero(~mask)} of {mask.size} pixels.")
    return mask
