"""Polygons: read from GeoJSON and shapefiles, and what lies inside them.

Inside is what an odd number of edges separates from the east, so that holes need no orientation.
"""

from __future__ import annotations

import json
import logging
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.io.files.safe import FARTHEST, MissingReferenceError, open_regular, resolve_reference
from meshreg.io.frames.bridge import bridge
from meshreg.io.frames.crs import crs_name, crs_text
from meshreg.records import Bool, Float64, Grid

log = logging.getLogger("meshreg")

MAX_BYTES = 200_000_000
KINDS = "Give a GeoTIFF, a GeoJSON file of polygons, or a shapefile."
_BROKEN = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    TypeError,
    ValueError,
    Warning,
    struct.error,
)
_LON_LAT = "OGC:CRS84"
_POLYGON_SHAPES = (5, 15, 25)  # Polygon, PolygonZ, PolygonM


@dataclass(frozen=True, eq=False)
class Area:
    """One polygon with its holes: `rings` of (N, 2) float64, inside by the even-odd rule."""

    rings: tuple[Float64, ...]
    use: bool = True


def moved(area: Area, source: str, target: str) -> Area:
    """Return a polygon with its corners taken from one CRS to another."""
    way = bridge(source, target)
    rings = []
    for ring in area.rings:
        points = np.column_stack([ring, np.zeros(len(ring))])
        rings.append(way.forward(points)[:, :2])
    return replace(area, rings=tuple(rings))


def read_geojson(path: Path, target: str | None) -> tuple[tuple[Area, ...], str | None]:
    """Read the polygons of a GeoJSON and their CRS; None where they are in `target` or local."""
    with open_regular(path) as stream:
        text = stream.read(MAX_BYTES + 1)
    if len(text) > MAX_BYTES:
        raise InputError(f"has more than {MAX_BYTES} bytes.", file=path, remedy=KINDS)
    try:
        document = json.loads(text.decode("utf-8-sig"))
        areas = tuple(_geojson_areas(document, {}))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"is not GeoJSON: {error}.", file=path, remedy=KINDS) from error
    named = document.get("crs")
    if named:
        try:
            return areas, crs_text(str(named["properties"]["name"]))
        except (TypeError, KeyError) as error:
            raise InputError("has a 'crs' without a name.", file=path, remedy=KINDS) from error
    if target is None or not areas:
        return areas, None
    reach = np.max([np.abs(ring).max(axis=0) for area in areas for ring in area.rings], axis=0)
    if reach[0] > 360 or reach[1] > 90:
        log.warning("%s: its numbers are not degrees; taken to be in %s.", path, crs_name(target))
        return areas, None
    return areas, crs_text(_LON_LAT)


def _geojson_areas(item: Any, properties: Any) -> Iterator[Area]:
    """Give the polygons of a GeoJSON object (RFC 7946 section 3), whatever holds them."""
    kind = item["type"]
    if kind == "FeatureCollection":
        for feature in item["features"]:
            yield from _geojson_areas(feature, {})
    elif kind == "Feature":
        if item["geometry"] is not None:
            yield from _geojson_areas(item["geometry"], item.get("properties") or {})
    elif kind == "GeometryCollection":
        for geometry in item["geometries"]:
            yield from _geojson_areas(geometry, properties)
    elif kind in ("Polygon", "MultiPolygon"):
        polygons = [item["coordinates"]] if kind == "Polygon" else item["coordinates"]
        for rings in filter(None, polygons):  # empty ones are no geometry (RFC 7946, 3.1)
            yield Area(
                tuple(_ring([point[:2] for point in ring]) for ring in rings), _use(properties)
            )


def _ring(points: Any) -> Float64:
    ring = np.asarray(points, float)
    if ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 3:
        raise ValueError(f"a ring of {len(ring)} points that bounds nothing")
    if not (np.abs(ring) < FARTHEST).all():
        raise ValueError(f"a ring with coordinates that are not below {FARTHEST:g}")
    return ring


def _use(properties: Any) -> bool:
    said = {str(key).strip().lower(): value for key, value in dict(properties).items()}
    return not (_word(said.get("use")) is False or _word(said.get("exclude")) is True)


def _word(value: Any) -> bool | None:
    """Return an attribute as true or false, None where it says neither."""
    if isinstance(value, str):
        word = value.strip().lower()
        truth = {"true": True, "yes": True, "t": True, "y": True}
        lies = {"false": False, "no": False, "f": False, "n": False}
        if word in truth or word in lies:
            return (truth | lies)[word]
        try:
            value = float(word)
        except ValueError:
            return None
    return bool(value) if isinstance(value, bool | int | float) else None


def read_shapefile(path: Path) -> tuple[tuple[Area, ...], str | None]:
    """Read a shapefile's polygons, their attributes (.dbf) and CRS (.prj), if those are there."""
    import shapefile

    def beside(suffix: str) -> Path | None:
        try:
            return resolve_reference(path.parent, path.stem + suffix, root=path.parent)
        except MissingReferenceError:
            return None

    table, projection = beside(".dbf"), beside(".prj")
    streams = {"shp": open_regular(path)}
    if table is not None:
        streams["dbf"] = open_regular(table)
    areas = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a file that makes the reader doubt is refused
            with shapefile.Reader(**streams, encodingErrors="replace") as reader:
                for number, shape in enumerate(reader.iterShapes()):
                    if shape.shapeType not in _POLYGON_SHAPES:
                        continue
                    record = {} if table is None else reader.record(number).as_dict()
                    ends = [*shape.parts, len(shape.points)]
                    rings = (shape.points[a:b] for a, b in pairwise(ends))
                    areas.append(Area(tuple(map(_ring, rings)), _use(record)))
    except (*_BROKEN, shapefile.ShapefileException) as error:
        raise InputError(
            f"is a damaged shapefile: {type(error).__name__} {error}.", file=path, remedy=KINDS
        ) from error
    finally:
        for stream in streams.values():
            stream.close()
    if projection is None:
        return tuple(areas), None
    with open_regular(projection) as stream:
        return tuple(areas), crs_text(stream.read(1 << 16).decode("utf-8", "replace"))


def _edges(area: Area) -> Iterator[tuple[float, float, float, float]]:
    """Give the edges of all rings, each from its lower to its upper end; level ones are none."""
    for ring in area.rings:
        ends = np.concatenate([ring, np.roll(ring, -1, axis=0)], axis=1)
        for x0, y0, x1, y1 in ends.tolist():
            if y0 < y1:
                yield x0, y0, x1, y1
            elif y1 < y0:
                yield x1, y1, x0, y0


def inside(area: Area, east: Float64, north: Float64) -> Bool:
    """Return which points lie inside: an odd number of edges to the east of them."""
    order = np.argsort(north, kind="stable")
    x, y = east[order], north[order]
    odd = np.zeros(len(x), bool)
    for x0, y0, x1, y1 in _edges(area):
        part = slice(*np.searchsorted(y, [y0, y1]))  # half open: no corner counts twice
        odd[part] ^= x[part] < x0 + (y[part] - y0) * ((x1 - x0) / (y1 - y0))
    result = np.empty_like(odd)
    result[order] = odd
    return result


def inside_cells(area: Area, grid: Grid) -> Bool:
    """Return which cell centres lie inside, by the same rule, a row of cells at a time."""
    rows, cols = grid.shape
    north = grid.east_north(np.arange(rows), 0)[1]
    toggles = np.zeros((rows, cols + 1), bool)
    for x0, y0, x1, y1 in _edges(area):
        # Rows run southward: the first centre below y1 to the last not below y0.
        row = slice(*np.searchsorted(-north, [-y1, -y0], side="right"))
        crossing = x0 + (north[row] - y0) * ((x1 - x0) / (y1 - y0))
        col = grid.row_col(crossing, north[row])[1]
        count = np.clip(np.ceil(col), 0, cols).astype(int)  # cells whose centre is west of it
        toggles[np.arange(rows)[row], count] ^= True
    # A cell is inside if an odd number of crossings lies to its east.
    return np.logical_xor.accumulate(toggles[:, ::-1], axis=1)[:, ::-1][:, 1:]
