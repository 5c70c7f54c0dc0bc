"""Coordinate reference systems: read what they are, choose a metric one.

A CRS travels as text ("EPSG:32754" where the registry knows it, else WKT), so that records stay
plain. Changing between two is in `meshreg.io.bridge`.
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

import numpy as np

from meshreg.errors import InputError, UsageError

_LOG = logging.getLogger("meshreg")
_MAX_SCALE_ERROR = 0.005  # a grid whose metre is further off is no metre (Mercator away from 0°)
_ODM = re.compile(r"WGS\s?84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
_DIGITS = re.compile(r"(?:EPSG:{0,2})?\s*(\d{4,6})", re.IGNORECASE)


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
        If PROJ does not know it.
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
        return pyproj.CRS.from_user_input(text)
    except (pyproj.exceptions.CRSError, pyproj.exceptions.DataDirError) as error:
        raise InputError(
            f"the coordinate reference system {short(value)!r} is not known ({short(error)}).",
            remedy="Give it as EPSG:number or as WKT.",
        ) from error


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


def lonlat(value: str, x: float, y: float, z: float = 0.0) -> tuple[float, float]:
    """Return longitude and latitude [degrees, on the CRS's own datum] of one point.

    Raises
    ------
    InputError
        If the point lies outside what the CRS can represent.
    """
    import pyproj

    horizontal = horizontal_part(parse_crs(value))
    geographic = horizontal.geodetic_crs
    if horizontal.is_geocentric:
        geographic = pyproj.crs.GeographicCRS(datum=horizontal.datum).to_3d()
    if horizontal.is_geographic:
        lon, lat = x, y
    else:
        mover = pyproj.Transformer.from_crs(horizontal, geographic, always_xy=True)
        try:
            lon, lat = mover.transform(x, y, z, errcheck=True)[:2]
        except pyproj.exceptions.ProjError as error:
            raise outside_error(value, x, y, short(error)) from error
    if not (np.isfinite([lon, lat]).all() and abs(lon) <= 360 and abs(lat) <= 90):
        raise outside_error(value, x, y, f"longitude {lon:.6g}, latitude {lat:.6g}")
    return float(lon), float(lat)


def outside_error(value: str, x: float, y: float, why: str) -> InputError:
    """Return the error for coordinates that cannot be in a CRS."""
    return InputError(
        f"coordinates about ({x:.8g}, {y:.8g}) lie outside the area of {crs_name(value)}: {why}.",
        remedy="Give the shift that was subtracted on export, or the right CRS.",
    )


def check_area(value: str, x: float, y: float, z: float = 0.0) -> None:
    """Refuse coordinates that cannot be meant in a CRS.

    A zone is often used beyond its borders (Norway keeps UTM 33 for the whole country), so only
    points far outside are refused; those within 50 km of (0, 0) must lie inside, because local
    coordinates with a CRS but without their shift look like that.

    Raises
    ------
    InputError
    """
    lon, lat = lonlat(value, x, y, z)
    area = parse_crs(value).area_of_use
    if area is None:
        return
    local = not is_geographic(value) and np.hypot(x, y) * metres_per_unit(value) < 50_000
    wide, tall = (0.0, 0.0) if local else (25.0, 5.0)
    width = (area.east - area.west) % 360 or 360.0
    inside = (lon - area.west + wide) % 360 <= width + 2 * wide or width + 2 * wide >= 360
    if not (inside and area.south - tall <= lat <= area.north + tall):
        raise outside_error(value, x, y, f"longitude {lon:.3f}, latitude {lat:.3f}")


@lru_cache(maxsize=256)
def _is_metric_grid(value: str) -> bool:
    """Whether the horizontal part is in metres east and north."""
    horizontal = horizontal_part(parse_crs(value))
    if not horizontal.is_projected:
        return False
    axes = horizontal.axis_info
    directions = {axis.direction for axis in axes}  # polar grids have two of "north" or "south"
    return (
        all(abs(axis.unit_conversion_factor - 1) < 1e-9 for axis in axes)
        and "west" not in directions
        and directions != {"east", "south"}
    )


def metric_crs(value: str, centre: Any) -> str | None:
    """Choose the CRS of absolute coordinates for data in CRS `value`.

    Parameters
    ----------
    value : str
        CRS of the data.
    centre : (x, y) or (x, y, z)
        The data's centre in that CRS, easting or longitude first.

    Returns
    -------
    str or None
        `value` itself where it is projected in metres, east and north, with a grid scale within
        0.5 % of one; else the UTM zone of the centre on the same datum, with the same vertical
        datum in metres upward. None for a local (engineering) CRS.

    Raises
    ------
    InputError
        Unknown CRS, or a centre outside its area.
    """
    text = crs_text(value)
    if text is None:
        return None
    x, y, *z = (float(item) for item in centre)
    lon, lat = lonlat(text, x, y, *z)
    if _is_metric_grid(text):
        scale, _ = grid_scale_and_convergence(text, x, y)
        if abs(scale - 1) <= _MAX_SCALE_ERROR or abs(lat) > 84:
            return text if abs(metres_up(parse_crs(text)) - 1) < 1e-9 else _metric(text, None)
    lon = (lon + 180) % 360 - 180
    zone = min(int((lon + 180) // 6) + 1, 60)
    return _metric(text, f"{zone}{'N' if lat >= 0 else 'S'}")


@lru_cache(maxsize=64)
def _metric(value: str, zone: str | None) -> str | None:
    """Return a CRS on the same datums in metres: its own grid, or UTM where a zone is given."""
    from pyproj.crs import CompoundCRS, VerticalCRS
    from pyproj.crs.coordinate_system import VerticalCS

    crs = parse_crs(value)
    horizontal, vertical = horizontal_part(crs), vertical_part(crs)
    flat = parse_crs(str(text_of(horizontal if zone is None else _utm(horizontal, zone))))
    if horizontal.is_geocentric or (vertical is not None and not vertical.is_vertical):
        return text_of(flat.to_3d())
    if vertical is None or vertical_datum(crs) is None:
        return text_of(flat)
    # The registry's name for the same heights in metres, so that it is recognised there.
    label = re.sub(r"\s*\(.*?\)", "", vertical.name).replace("depth", "height")
    high = VerticalCRS(name=label, datum=vertical.datum, vertical_cs=VerticalCS())
    return text_of(CompoundCRS(f"{flat.name} + {high.name}", [flat, high]))


def _utm(horizontal: Any, zone: str) -> Any:
    from pyproj.crs import GeographicCRS, ProjectedCRS
    from pyproj.crs.coordinate_operation import UTMConversion

    base = horizontal.geodetic_crs
    if horizontal.is_geocentric:
        base = GeographicCRS(name=horizontal.datum.name, datum=horizontal.datum)
    conversion = UTMConversion(zone[:-1], zone[-1])
    name = f"{base.name} / UTM zone {zone}"
    return ProjectedCRS(conversion=conversion, geodetic_crs=base, name=name)


def grid_scale_and_convergence(crs: str, east: float, north: float) -> tuple[float, float]:
    """Return what a projected grid does to true lengths and directions at one place.

    Parameters
    ----------
    crs : str
        A projected CRS.
    east, north : float
        The place, in that CRS.

    Returns
    -------
    scale : float
        Grid length over length on the ellipsoid (0.9996 at a UTM zone's centre).
    convergence : float
        Angle [rad] from true north to grid north, clockwise positive: north of the equator it is
        positive east of the central meridian. PROJ's `proj_factors`.
    """
    import pyproj

    horizontal = horizontal_part(parse_crs(crs))
    if not horizontal.is_projected:
        raise UsageError(f"{crs_name(crs)} is not projected; it has no grid scale.")
    lon, lat = lonlat(crs, east, north)
    factors = pyproj.Proj(horizontal).get_factors(lon, lat)
    scale = float(np.sqrt(factors.meridional_scale * factors.parallel_scale))
    return scale, float(np.radians(factors.meridian_convergence))
