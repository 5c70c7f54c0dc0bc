"""Markers of Metashape and ReefShape.

Metashape's Export Reference writes `#Label,X/East,Y/North,Z/Altitude,...,X_est,Y_est,Z_est` after a
line with the WKT of its CRS; from there points go to the surveys' CRS. In one file the source
coordinates are the reference's and the estimated ones the moving survey's, as where ReefShape
carries markers from chunk to chunk; of two files the estimated coordinates count, else the source.
ReefShape's own table has gis_label, gis_lat, gis_lon; its export of one chunk has the estimated
coordinates alone, in degrees.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.ties.foreign import Context, Named, first_of, place
from meshreg.ties.records import Point
from meshreg.ties.table import read_text

_LABELS = ("label", "gis_label", "marker", "target", "name", "point", "id")
_EAST = ("x/east", "x/easting", "east", "easting", "x")
_NORTH = ("y/north", "y/northing", "north", "northing", "y")
_LON = ("x/longitude", "gis_lon", "longitude", "lon", "long")
_LAT = ("y/latitude", "gis_lat", "latitude", "lat")
_ESTIMATED = (("x_est", "y_est"), ("x est", "y est"))
_WKT = re.compile(r"\b(?:PROJCS|GEOGCS|COMPD_CS|LOCAL_CS)\[.*\]")
_CODE = re.compile(r'AUTHORITY\["EPSG",\s*"?(\d+)"?\]\]$')


def is_markers(names: Sequence[str]) -> bool:
    """Whether a line's names are those of a table of markers."""
    flat = first_of(names, _EAST) and first_of(names, _NORTH)
    round_ = first_of(names, _LON) and first_of(names, _LAT)
    return bool(first_of(names, _LABELS) and (flat or round_ or _estimated(names)[0]))


def _estimated(names: Sequence[str]) -> tuple[str, str] | tuple[None, None]:
    return next((pair for pair in _ESTIMATED if set(pair) <= set(names)), (None, None))


def read_markers(
    path: Path, header: Sequence[str], rows: Sequence[Any], context: Context, alone: bool
) -> Named:
    """Read Metashape's and ReefShape's markers; those without coordinates are left out."""
    label = first_of(header, _LABELS)
    lon, lat = first_of(header, _LON), first_of(header, _LAT)
    degrees = lon is not None and lat is not None
    source = (lon, lat) if degrees else (first_of(header, _EAST), first_of(header, _NORTH))
    estimated = _estimated(header)
    first: dict[str, Point] = {}
    second: dict[str, Point] = {}
    for line, row in rows:
        name = row[label].strip()
        if not name:
            continue
        places = [place(path, line, row, columns) for columns in (source, estimated)]
        chosen = (places[0], places[1]) if alone else (places[1] or places[0], None)
        for found, point in zip((first, second), chosen, strict=True):
            if point is None:
                continue
            if name in found:
                raise InputError(
                    f"has two points called {name!r}.", file=path, place=f"line {line}"
                )
            found[name] = point
    stated, notes = _stated_crs(path)
    small = context.crs is not None and _look_like_degrees([*first.values(), *second.values()])
    if stated is None and (degrees or small):
        stated = "EPSG:4326"
        notes = (*notes, f"{path.name}: degrees were taken as WGS 84 (EPSG:4326).")
    first, second = (_moved(path, points, stated, context.crs) for points in (first, second))
    return Named(first, second, notes)


def _stated_crs(path: Path) -> tuple[str | None, tuple[str, ...]]:
    """Return the CRS that a comment of Metashape's states; None where there is none to tell."""
    from meshreg.io.frames.crs import parse_crs

    for text in read_text(path).splitlines():
        wkt = _WKT.search(text.replace('""', '"')) if text.lstrip(' "').startswith("#") else None
        if wkt is None:
            continue
        if wkt[0].startswith("LOCAL_CS"):
            return None, ()
        code = _CODE.search(wkt[0])
        said = f"EPSG:{code[1]}" if code else wkt[0]
        try:
            parse_crs(said)
        except InputError:
            return None, (f"{path.name}: its line with the CRS is not understood.",)
        return said, ()
    return None, ()


def _look_like_degrees(points: Sequence[Point]) -> bool:
    """Whether no point is further from zero than degrees go; on a metric grid all are."""
    return bool(points) and all(abs(x) <= 180 and abs(y) <= 90 for x, y in points)


def _moved(
    path: Path, points: dict[str, Point], stated: str | None, crs: str | None
) -> dict[str, Point]:
    """Take points from the CRS that their file states to the surveys'."""
    if not points or stated is None or stated == crs:
        return points
    from meshreg.io.frames.bridge import bridge
    from meshreg.io.frames.crs import is_geographic

    if crs is None:
        if not is_geographic(stated):
            return points  # the surveys' frame may well be that grid, unsaid
        raise InputError(
            "is in degrees, but the surveys are in a local frame.",
            file=path,
            remedy="Export the markers in the coordinates of the models.",
        )
    flat = np.column_stack([np.array(list(points.values())), np.zeros(len(points))])
    found = bridge(stated, crs).forward(flat)
    return dict(zip(points, ((float(e), float(n)) for e, n, _ in found), strict=True))
