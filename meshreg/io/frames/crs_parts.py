"""Coordinate reference systems: read what they are and take them apart.

A CRS travels as text ("EPSG:32754" where the registry knows it, else WKT), so that records stay
plain.
"""

from __future__ import annotations

import logging
import os
import re
import sqlite3
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import Any

from meshreg.errors import InputError

_LOG = logging.getLogger("meshreg")
_ODM = re.compile(r"WGS\s?84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
_DIGITS = re.compile(r"(?:EPSG:{0,2})?\s*(\d{4,6})", re.IGNORECASE)
_LENGTHS = (1e-3, 2e5)  # of a unit [m]: a millimetre, more than the 150 km of a coarse grid
_ANGLES = (1e-7, 1.0)  # of a unit [rad]: a tenth of a microradian, the radian
_BODIES = (1e5, 1e8)  # semi-major axes [m]: of every planet, and of moons that are round


def mend_proj_data() -> str | None:
    """Forget PROJ_DATA and PROJ_LIB, for this process, where they lead to no usable proj.db.

    Returns
    -------
    str or None
        What was forgotten and why, or None. Call it before the first use of pyproj or rasterio.
    """
    told = []
    for name in ("PROJ_DATA", "PROJ_LIB"):
        value = os.environ.get(name)
        if value is not None and not any(map(_usable_database, value.split(os.pathsep))):
            del os.environ[name]
            told.append(f"{name} = {value!r} leads to no usable proj.db and was ignored.")
    for text in told:
        _LOG.warning(text)
    return " ".join(told) or None


def _usable_database(folder: str) -> bool:
    """Whether a folder holds a proj.db of a layout that current PROJ reads (1.6 and later)."""
    path = Path(folder, "proj.db")
    query = "SELECT value FROM metadata WHERE key = 'DATABASE.LAYOUT.VERSION.MINOR'"
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
            row = database.execute(query).fetchone()
            return row is not None and int(row[0]) >= 6
    except (sqlite3.Error, ValueError, OSError):
        return False


@lru_cache(maxsize=256)
def parse_crs(value: str) -> Any:
    """Return the `pyproj.CRS` of a text: a code, WKT, a PROJ string or ODM's "WGS84 UTM 16N".

    Raises
    ------
    InputError
        If PROJ does not know it, or its units or its ellipsoid cannot be those of a survey.
    """
    mend_proj_data()
    import pyproj

    text = value.strip().strip("\ufeff")
    odm, digits = _ODM.fullmatch(text), _DIGITS.fullmatch(text)
    if odm:
        zone = int(odm[1])
        text = f"EPSG:{(32600 if odm[2].upper() == 'N' else 32700) + zone}" if zone <= 60 else text
    elif digits:
        text = f"EPSG:{digits[1]}"
    else:
        text = re.sub(r"^([A-Za-z]+)::(\d+)$", r"\1:\2", text)
    try:
        crs = pyproj.CRS.from_user_input(text)
    except (pyproj.exceptions.CRSError, pyproj.exceptions.DataDirError) as error:
        raise InputError(
            f"the coordinate reference system {short(value)!r} is not known ({short(error)}).",
            remedy="Give it as EPSG:number or as WKT.",
        ) from error
    absurd = _absurd(crs)
    if absurd:
        raise InputError(
            f"the coordinate reference system {short(value)!r} cannot be right: {absurd}.",
            remedy="Give it as EPSG:number, or mend its text.",
        )
    return crs


def _absurd(crs: Any) -> str:
    """Say what of a CRS no survey has, a unit or the size of the Earth; or ''."""
    parts = [unbound(part) for part in (crs.sub_crs_list if crs.is_compound else [crs])]
    parts += [part.geodetic_crs for part in parts if part.is_projected]
    for part in parts:
        for axis in part.axis_info:
            factor = axis.unit_conversion_factor
            angle = part.is_geographic and axis.direction in ("north", "south", "east", "west")
            low, high = _ANGLES if angle else _LENGTHS
            if not low <= factor <= high:  # also where it is not a number
                unit = "rad" if angle else "m"
                return f"the unit {short(axis.unit_name)!r} of its {axis.name} is {factor:g} {unit}"
    body = crs.ellipsoid
    if body is not None and not _BODIES[0] <= body.semi_major_metre <= _BODIES[1]:
        return f"its ellipsoid {short(body.name)!r} has a radius of {body.semi_major_metre:g} m"
    return ""


@lru_cache(maxsize=64)
def local_axes(latitude: float, longitude: float) -> str:
    """Return a CRS of axes east and north in the plane that touches WGS 84 at a place [degrees].

    The orthographic projection (EPSG method 9840): easting and northing of points on the ellipsoid
    are those of the topocentric system there (EPSG method 9837).
    """
    place = f"+lat_0={latitude!r} +lon_0={longitude!r}"
    crs = parse_crs(f"+proj=ortho {place} +datum=WGS84 +units=m +no_defs +type=crs")
    named = crs.to_json_dict() | {"name": f"local axes at {latitude:.7g}, {longitude:.7g}"}
    return str(type(crs).from_json_dict(named).to_wkt())


def short(text: Any, length: int = 80) -> str:
    """Return a text on one line, cut to a length, for messages."""
    text = " ".join(str(text).split())
    return str(text if len(text) <= length else text[: length - 3] + "...")


@lru_cache(maxsize=256)
def crs_text(value: str) -> str | None:
    """Return one spelling of a CRS, so that equal ones are equal strings; None if it is local.

    Local (engineering) systems say nothing about the place on Earth and count as no CRS.
    """
    return text_of(parse_crs(value))


def text_of(crs: Any) -> str | None:
    """Return the spelling of a `pyproj.CRS` that `crs_text` promises."""
    import pyproj

    if crs.is_engineering:
        return None
    for authority in (crs.to_authority("EPSG", 70), crs.to_authority(None, 70)):
        if authority is None:
            continue
        code = f"{authority[0]}:{authority[1]}"
        if pyproj.CRS(code).equals(crs, ignore_axis_order=True):
            return code
    if crs.is_compound:
        parts = [text_of(part) for part in crs.sub_crs_list]
        if len(parts) == 2 and all(part and part.startswith("EPSG:") for part in parts):
            return f"{parts[0]}+{str(parts[1])[5:]}"
    return str(crs.to_wkt())


def crs_name(value: str | None) -> str:
    """Return a CRS as people say it: "EPSG:32754 (WGS 84 / UTM zone 54S)", "a local frame"."""
    if value is None:
        return "a local frame"
    name = parse_crs(value).name
    return f"{value} ({name})" if len(value) < 24 else str(name)


def unbound(crs: Any) -> Any:
    """Take off a bound transformation (TOWGS84), which says how to change datum, not what it is."""
    return crs.source_crs if crs.is_bound else crs


def horizontal_part(crs: Any) -> Any:
    """Return the two-dimensional part of a CRS (a geocentric one has none and stays)."""
    crs = unbound(crs)
    if crs.is_compound:
        return unbound(crs.sub_crs_list[0])
    if crs.is_geocentric or len(crs.axis_info) != 3:
        return crs
    return crs.to_2d()


def vertical_part(crs: Any) -> Any | None:
    """Return the height part: a vertical CRS, the 3-D CRS itself (ellipsoidal), or None."""
    crs = unbound(crs)
    if crs.is_compound:
        return unbound(crs.sub_crs_list[1])
    return crs if len(crs.axis_info) == 3 and not crs.is_geocentric else None


def vertical_datum(crs: Any) -> str | None:
    """Return what heights refer to, None where it is not stated."""
    vertical = vertical_part(crs)
    if vertical is None:
        return None
    if vertical.is_vertical:
        name = str(vertical.datum.name)
        return None if name.lower().startswith("unknown") else name
    return f"ellipsoidal height, {horizontal_part(crs).geodetic_crs.datum.name}"


@lru_cache(maxsize=64)
def with_vertical_unit(value: str, metres: float) -> str:
    """Add heights in a unit of this many metres, above a datum that nobody states, to a 2-D CRS."""
    flat = parse_crs(value)
    axis = f'AXIS["height (H)",up,LENGTHUNIT["{metres:.9g} m",{metres!r}]]'
    height = f'VERTCRS["unknown height",VDATUM["unknown"],CS[vertical,1],{axis}]'
    return f'COMPOUNDCRS["{flat.name} + unknown height",{flat.to_wkt()},{height}]'


def metres_up(crs: Any) -> float:
    """Return metres upward for one step of the CRS's third axis.

    Where no vertical axis is stated, heights are in the unit of the horizontal axes (the custom
    of American state plane files, and of LAS), or in metres where those are degrees.
    """
    vertical = vertical_part(crs)
    if vertical is None:
        return _metres_per_unit(crs)
    axis = vertical.axis_info[-1]
    return float(axis.unit_conversion_factor) * (-1.0 if axis.direction == "down" else 1.0)


def _metres_per_unit(crs: Any) -> float:
    horizontal = horizontal_part(crs)
    return (
        1.0 if horizontal.is_geographic else float(horizontal.axis_info[0].unit_conversion_factor)
    )


@lru_cache(maxsize=256)
def metres_per_unit(value: str) -> float:
    """Return the length of a CRS's horizontal unit [m]; 1 where that is the degree."""
    return _metres_per_unit(parse_crs(value))


@lru_cache(maxsize=256)
def is_geographic(value: str) -> bool:
    """Whether coordinates in this CRS are longitude and latitude."""
    return bool(horizontal_part(parse_crs(value)).is_geographic)
