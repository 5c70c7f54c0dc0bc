"""READ point clouds as text: XYZ, CSV, TXT, ASC, PTS. Writing is in `xyz_write`."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshreg.errors import InputError
from meshreg.io.assemble import Found, eight_bit_colors, placed_survey
from meshreg.io.files.safe import file_bytes
from meshreg.io.frames.axes import ENU
from meshreg.io.frames.place import place
from meshreg.io.frames.sidecar import SidecarInfo, find_sidecar
from meshreg.io.las.classes import RECLASS, ground_classes
from meshreg.io.las.read import without_strays
from meshreg.io.options import ReadOptions
from meshreg.io.text.layout import read_layout
from meshreg.io.text.values import columns_of
from meshreg.records import Float64, PointCloud, Survey, UInt8

_LOG = logging.getLogger("meshreg")
_XYZ, _RGB = ("x", "y", "z"), ("r", "g", "b")
_Z_DOWN = np.diag([1.0, 1.0, -1.0])


def read(path: Path, options: ReadOptions) -> Survey:
    """Read a text file of points.

    Delimiter (comma, semicolon, tab, blanks), header names and columns are found out from the
    file: x y z or easting northing elevation (or depth, which counts downward), longitude and
    latitude, r g b, classification. Without a header the columns are known by what is in them
    (`xyz_columns.guess_names`), and a note names them. Rows with a coordinate that is not a
    number are left out and counted, and so are points classed as noise or water.

    Parameters
    ----------
    path : Path
    options : ReadOptions

    Returns
    -------
    Survey
        With a PointCloud.

    Raises
    ------
    InputError
        Binary, a row of another width or with text for a number (with its line),
        a count in the first line that the rows contradict, no points.
    """
    path = Path(path)
    data = file_bytes(path)
    sidecar = find_sidecar(path, given=options)
    layout = read_layout(data, path, None if sidecar is None else sidecar.columns)
    notes = [*layout.notes, *layout.directions.notes]
    colored = set(_RGB) <= layout.where.keys() and not options.geometry_only
    wanted = [*_XYZ, *(_RGB if colored else ())]
    wanted += ["classification"] if "classification" in layout.where else []
    values = columns_of(data, layout, path, [layout.where[name] for name in wanted])

    points = np.stack([values[layout.where[name]] for name in _XYZ], axis=1)
    n_rows = len(points)
    if layout.down and np.nanmedian(points[:, 2]) < 0:
        layout = replace(layout, down=False)
        notes.append("Depths are negative; they were taken as heights.")
    if layout.lonlat and not _crs_is_said(sidecar, options):
        notes.append("Longitude and latitude were taken as WGS 84 (EPSG:4326).")
    colors = None
    if colored:
        colors = _colors(np.stack([values[layout.where[name]] for name in _RGB], axis=1), notes)
    classes = values.get(layout.where.get("classification", -1))
    del values
    points, colors = _cleaned(points, colors, classes, path, notes)
    for note in notes:
        _LOG.warning("%s: %s", path.name, note)
    crs = "EPSG:4326" if layout.lonlat and not _crs_is_said(sidecar, options) else None
    axes = _Z_DOWN if layout.down else ENU
    placed = place(path, points, options, crs, axes)
    geometry = PointCloud(placed.points, colors)
    found = Found("xyz", tuple(notes), counts={"points": n_rows, "used": len(points)})
    return placed_survey(path, placed, geometry, found)


def _crs_is_said(sidecar: SidecarInfo | None, options: ReadOptions) -> bool:
    return options.crs is not None or (sidecar is not None and sidecar.crs is not None)


def _cleaned(
    points: Float64,
    colors: UInt8 | None,
    classes: Float64 | None,
    path: Path,
    notes: list[str],
) -> tuple[Float64, UInt8 | None]:
    """Leave out rows without coordinates, classes that are no ground, and strays."""
    keep = np.isfinite(points).all(axis=1)
    if not keep.all():
        notes.append(f"{np.count_nonzero(~keep)} rows without coordinates were left out.")
    ground = None if classes is None else ground_classes(np.where(keep, classes, 0), notes)
    if ground is not None:
        keep &= ground
    if not keep.any():
        remedy = "Export it again." if ground is None else RECLASS
        said = "" if ground is None else f" that are ground ({' '.join(notes)})"
        raise InputError(f"holds no points{said}.", file=path, remedy=remedy)
    if not keep.all():
        points, colors = points[keep], None if colors is None else colors[keep]
    strays = without_strays(points, notes)
    if strays is None:
        return points, colors
    return points[strays], None if colors is None else colors[strays]


def _colors(values: Float64, notes: list[str]) -> UInt8:
    """Turn colors as written (0-1, 0-255 or 0-65535) into 8 bits."""
    if not np.isnan(values).any() and (values == np.rint(values)).all() and values.min() >= 0:
        if values.max() <= 255:
            return values.astype(np.uint8)
        if values.max() <= 65535:
            return eight_bit_colors(values.astype(np.uint16))[0]
    colors, more = eight_bit_colors(values)
    notes += more
    return colors
