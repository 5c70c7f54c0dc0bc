"""Where a CRS is on Earth, and the metric CRS that absolute coordinates are in.

Taking a CRS apart is in `crs_parts`, changing between two in `bridge`.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

import numpy as np

from meshreg.errors import InputError, UsageError
from meshreg.io.frames.crs_parts import (
    crs_name,
    crs_text,
    horizontal_part,
    is_geographic,
    mend_proj_data,
    metres_per_unit,
    metres_up,
    parse_crs,
    short,
    text_of,
    unbound,
    vertical_datum,
    vertical_part,
    with_vertical_unit,
)

__all__ = [
    "check_area",
    "crs_name",
    "crs_text",
    "grid_scale_and_convergence",
    "horizontal_part",
    "is_geographic",
    "lonlat",
    "mend_proj_data",
    "metres_per_unit",
    "metres_up",
    "metric_crs",
    "outside_error",
    "parse_crs",
    "short",
    "text_of",
    "unbound",
    "vertical_datum",
    "vertical_part",
    "with_vertical_unit",
]

_MAX_SCALE_ERROR = 0.005  # a grid whose metre is further off is no metre (Mercator away from 0°)


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
        try:
            mover = pyproj.Transformer.from_crs(horizontal, geographic, always_xy=True)
        except pyproj.exceptions.ProjError as error:
            raise InputError(
                f"the coordinate reference system {crs_name(value)} cannot be worked with: "
                f"{short(error).rstrip('.')}.",
                remedy="It is damaged; state the right one in NAME.survey.toml (crs = ...).",
            ) from error
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
