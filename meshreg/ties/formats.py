"""Points picked with other programs: Metashape and ReefShape markers, TagLab tables and projects.

One file holds both surveys, or two are given as "reference.csv,moving.csv" and matched by name.

Metashape (Export Reference, markers): `#Label,X/East,Y/North,Z/Altitude,...,X_est,Y_est,Z_est`,
degrees where it says X/Longitude. In one file the source coordinates are the reference's and the
estimated ones the moving survey's, as where ReefShape carries markers from chunk to chunk; of two
files the estimated coordinates count, else the source. ReefShape's own table has gis_label,
gis_lat, gis_lon. TagLab's annotation tables (`TagLab Centroid x`, pixels of the orthomosaic) are
matched by Genet Id, else by the note; its project file holds the markers of its alignment tool.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, UsageError
from meshreg.ties.records import MAX_NAME, MAX_PAIRS, Point, TiePair, TiePoints
from meshreg.ties.table import is_ours, number, read_lines, read_table, ties_from_rows
from meshreg.types import Float64

_LABELS = ("label", "gis_label", "marker", "target", "name", "point", "id")
_EAST = ("x/east", "x/easting", "east", "easting", "x")
_NORTH = ("y/north", "y/northing", "north", "northing", "y")
_LON = ("x/longitude", "gis_lon", "longitude", "lon", "long")
_LAT = ("y/latitude", "gis_lat", "latitude", "lat")
_TAGLAB = ("taglab centroid x", "taglab centroid y")
_GENET = ("taglab genet id", "taglab genet")
_KNOWN = (
    "Give the ties.csv of `meshreg pick`, markers exported from Metashape, or TagLab's annotation "
    'table; two files as "reference.csv,moving.csv".'
)
ToMetres = Callable[[Float64], Float64]  # pixels (N, 2), x right, y down, to east, north


@dataclass(frozen=True)
class Context:
    """What is known of the surveys that foreign points lie in.

    Attributes
    ----------
    crs : str or None
        The surveys' common CRS; degrees are taken there.
    pixels : mapping
        "reference" and "moving" to the function from an orthomosaic's pixels (from its outer
        north-west corner) to that survey's coordinates as delivered.
    """

    crs: str | None = None
    pixels: Mapping[str, ToMetres] = field(default_factory=dict)


@dataclass(frozen=True)
class _Named:
    """Points of one survey by name; `second` are those of the other survey in the same file."""

    first: Mapping[str, Point]
    second: Mapping[str, Point]
    notes: tuple[str, ...] = ()


def read_points(path: str | Path, context: Context | None = None) -> TiePoints:
    """Read pairs from any file that is known, or from two joined by a comma.

    Raises
    ------
    InputError
        A file that is none of these, or that has no two points of one name.
    UsageError
        More than two files, or pixels whose orthomosaic is not known.
    """
    context = context or Context()
    paths = [Path(part.strip()) for part in str(path).split(",")]
    if Path(path).is_file():
        paths = [Path(path)]
    if len(paths) > 2:
        raise UsageError(f"{len(paths)} files of points were given.", remedy=_KNOWN)
    if len(paths) == 2:
        return _from_two(paths[0], paths[1], context)
    return _from_one(paths[0], context)


def _from_one(path: Path, context: Context) -> TiePoints:
    if path.suffix.lower() == ".json":
        return _project(path, context)
    header, rows = read_table(path, is_ours)
    if header:
        return ties_from_rows(path, rows)
    found = _named(path, context, alone=True)
    if not found.second:
        raise InputError(
            "has the points of one survey only.",
            file=path,
            remedy='Give "reference.csv,moving.csv".',
        )
    return _joined(path, found.first, found.second, context, found.notes)


def _from_two(reference: Path, moving: Path, context: Context) -> TiePoints:
    first = _named(reference, context, side="reference")
    second = _named(moving, context, side="moving")
    notes = (*first.notes, *second.notes)
    return _joined(moving, first.first, second.first, context, notes)


def _joined(
    path: Path,
    reference: Mapping[str, Point],
    moving: Mapping[str, Point],
    context: Context,
    notes: tuple[str, ...],
) -> TiePoints:
    both = [name for name in reference if name in moving]
    if not both:
        some = ", ".join(sorted(set(reference) | set(moving))[:5])
        raise InputError(
            f"shares no name with the reference's points ({some} ...).", file=path, remedy=_KNOWN
        )
    alone = len(set(reference) ^ set(moving))
    if alone:
        notes = (*notes, f"{alone} points have no partner of the same name and are left out.")
    pairs = (
        TiePair(k, name[:MAX_NAME], reference[name], moving[name]) for k, name in enumerate(both, 1)
    )
    return TiePoints(tuple(pairs), context.crs, notes)


def _named(path: Path, context: Context, side: str = "reference", alone: bool = False) -> _Named:
    header, rows = read_table(path, lambda names: set(_TAGLAB) <= set(names))
    if header:
        return _taglab(path, header, rows, context, side, alone)
    header, rows = read_table(path, _is_markers)
    if header:
        return _markers(path, header, rows, context, alone)
    raise InputError("holds no points that are known here.", file=path, remedy=_KNOWN)


def _first(header: Sequence[str], names: Sequence[str]) -> str | None:
    return next((name for name in names if name in header), None)


def _is_markers(names: Sequence[str]) -> bool:
    flat = _first(names, _EAST) and _first(names, _NORTH)
    round_ = _first(names, _LON) and _first(names, _LAT)
    estimated = "x_est" in names and "y_est" in names
    return bool(_first(names, _LABELS) and (flat or round_ or estimated))


def _markers(
    path: Path, header: Sequence[str], rows: Sequence[Any], context: Context, alone: bool
) -> _Named:
    """Read Metashape's and ReefShape's markers; those without coordinates are left out."""
    label = _first(header, _LABELS)
    lon, lat = _first(header, _LON), _first(header, _LAT)
    degrees = lon is not None and lat is not None
    source = (lon, lat) if degrees else (_first(header, _EAST), _first(header, _NORTH))
    estimated = ("x_est", "y_est") if "x_est" in header and "y_est" in header else (None, None)
    first: dict[str, Point] = {}
    second: dict[str, Point] = {}
    for line, row in rows:
        name = row[label].strip()
        if not name:
            continue
        places = [_cell(path, line, row, columns) for columns in (source, estimated)]
        chosen = (places[0], places[1]) if alone else (places[1] or places[0], None)
        for found, point in zip((first, second), chosen, strict=True):
            if point is None:
                continue
            if name in found:
                raise InputError(
                    f"has two points called {name!r}.", file=path, place=f"line {line}"
                )
            found[name] = point
    notes: tuple[str, ...] = ()
    if degrees:
        first, second = (_from_degrees(path, points, context.crs) for points in (first, second))
        notes = (f"{path.name}: degrees were taken as WGS 84 (EPSG:4326).",)
    return _Named(first, second, notes)


def _cell(
    path: Path, line: int, row: Mapping[str, str], columns: tuple[str | None, str | None]
) -> Point | None:
    x, y = columns
    if x is None or y is None or not (row[x].strip() and row[y].strip()):
        return None
    return number(path, line, row[x], x), number(path, line, row[y], y)


def _from_degrees(path: Path, points: Mapping[str, Point], crs: str | None) -> dict[str, Point]:
    if not points:
        return {}
    if crs is None:
        raise InputError(
            "is in degrees, but the surveys are in a local frame.",
            file=path,
            remedy="Export the markers in the coordinates of the models.",
        )
    from meshreg.io.bridge import bridge

    lon_lat = np.array(list(points.values()))
    flat = bridge("EPSG:4326", crs).forward(np.column_stack([lon_lat, np.zeros(len(lon_lat))]))
    return dict(zip(points, ((float(e), float(n)) for e, n, _ in flat), strict=True))


def _taglab(
    path: Path,
    header: Sequence[str],
    rows: Sequence[Any],
    context: Context,
    side: str,
    alone: bool,
) -> _Named:
    """Read annotations; in one file the first image named is the reference's."""
    genet, note = _first(header, _GENET), _first(header, ("taglab note",))
    images = list(dict.fromkeys(row.get("image name", "") for _, row in rows))
    if alone and len(images) != 2:
        raise InputError(
            f"has the annotations of {len(images)} image(s), not of two.",
            file=path,
            remedy='Give "reference.csv,moving.csv".',
        )
    found: list[dict[str, Point]] = [{}, {}]
    doubled: set[str] = set()
    for line, row in rows:
        name = _taglab_name(row, genet, note)
        point = _cell(path, line, row, _TAGLAB)
        if not name or point is None:
            continue
        target = found[images.index(row.get("image name", "")) if alone else 0]
        if name in target:
            doubled.add(name)
        target[name] = point
    notes: tuple[str, ...] = ()
    if doubled:  # a colony that split: which part is meant is not said
        notes = (f"{path.name}: {len(doubled)} names stand twice and are left out.",)
    sides = ("reference", "moving") if alone else (side, side)
    first, second = (
        _metres({n: p for n, p in points.items() if n not in doubled}, which, context)
        for points, which in zip(found, sides, strict=True)
    )
    return _Named(first, second, notes)


def _taglab_name(row: Mapping[str, str], genet: str | None, note: str | None) -> str:
    number_ = row[genet].strip().removesuffix(".0") if genet else ""
    if number_ not in ("", "0", "-1", "nan"):
        return f"genet {number_}"
    return row[note].strip() if note else ""


def _metres(points: Mapping[str, Point], side: str, context: Context) -> dict[str, Point]:
    if not points:
        return {}
    if side not in context.pixels:
        raise UsageError(
            f"The points of the {side} survey are pixels of an orthomosaic that is not known.",
            remedy="Name both with --reference-ortho and --moving-ortho.",
        )
    flat = context.pixels[side](np.array(list(points.values()), float))
    return dict(zip(points, ((float(e), float(n)) for e, n in flat), strict=True))


def _project(path: Path, context: Context) -> TiePoints:
    """Read the markers that TagLab's alignment tool keeps in its project, if of one pair only."""
    try:
        document = json.loads("\n".join(read_lines(path)))
        images = document["markers"]
        found = [entry["markers"] for others in images.values() for entry in others.values()]
        if len(found) != 1:
            raise InputError(f"holds the markers of {len(found)} pairs of images.", file=path)
        sides = [
            {f"marker {k}": (float(p["x"]), float(p["y"])) for k, p in enumerate(found[0][side], 1)}
            for side in ("ref", "coreg")
        ]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"is no TagLab project with markers ({error}).", file=path, remedy=_KNOWN
        ) from error
    if max(map(len, sides)) > MAX_PAIRS:
        raise InputError(f"has {len(sides[0])} markers; {MAX_PAIRS} are the limit.", file=path)
    reference, moving = (
        _metres(points, side, context)
        for points, side in zip(sides, ("reference", "moving"), strict=True)
    )
    return _joined(path, reference, moving, context, ())
