"""READ point clouds as text: XYZ, CSV, TXT, ASC, PTS. Writing is in `xyz_write`."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshreg.errors import InputError
from meshreg.io.assemble import Found, eight_bit_colors, placed_survey
from meshreg.io.cloud import without_strays
from meshreg.io.frames import ENU, place
from meshreg.io.options import ReadOptions
from meshreg.io.safe import file_bytes
from meshreg.io.sidecar import find_sidecar
from meshreg.io.xyz_layout import Layout, read_layout
from meshreg.io.xyz_values import read_values, wanted_columns
from meshreg.io.xyz_write import rewrite, write
from meshreg.types import Float64, PointCloud, Survey, UInt8

__all__ = ["read", "rewrite", "write"]

_LOG = logging.getLogger("meshreg")
_XYZ, _RGB = ("x", "y", "z"), ("r", "g", "b")
_Z_DOWN = np.diag([1.0, 1.0, -1.0])


def read(path: Path, options: ReadOptions) -> Survey:
    """Read a text file of points.

    Delimiter (comma, semicolon, tab, blanks), header names and columns are found out from the
    file: x y z or easting northing elevation (or depth, which counts downward), longitude and
    latitude, r g b. Without a header the first three columns are x, y, z and colours are looked
    for behind them. Rows with a coordinate that is not a number are left out and counted.

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
        Binary, decimal commas, a row of another width or with text for a number (with its line),
        a count in the first line that the rows contradict, no points.
    """
    path = Path(path)
    data = file_bytes(path)
    layout = read_layout(data, path)
    notes: list[str] = []
    values = read_values(data, layout, path)
    layout, points, colors = _interpreted(layout, values, path, options, notes)
    n_rows = len(values)
    del values
    points, colors = _cleaned(points, colors, path, notes)
    for note in notes:
        _LOG.warning("%s: %s", path.name, note)
    crs = "EPSG:4326" if layout.lonlat and not _crs_is_said(path, options) else None
    axes = _Z_DOWN if layout.down else ENU
    placed = place(path, points, options, crs, axes)
    geometry = PointCloud(placed.points, colors)
    found = Found("xyz", tuple(notes), counts={"points": n_rows, "used": len(points)})
    return placed_survey(path, placed, geometry, found)


def _crs_is_said(path: Path, options: ReadOptions) -> bool:
    sidecar = find_sidecar(path)
    return options.crs is not None or (sidecar is not None and sidecar.crs is not None)


def _cleaned(
    points: Float64, colors: UInt8 | None, path: Path, notes: list[str]
) -> tuple[Float64, UInt8 | None]:
    """Leave out rows without coordinates and strays."""
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        notes.append(f"{np.count_nonzero(~finite)} rows without coordinates were left out.")
        points, colors = points[finite], None if colors is None else colors[finite]
    if not len(points):
        raise InputError("holds no points.", file=path, remedy="Export it again.")
    keep = without_strays(points, notes)
    if keep is None:
        return points, colors
    return points[keep], None if colors is None else colors[keep]


def _interpreted(
    layout: Layout, values: Float64, path: Path, options: ReadOptions, notes: list[str]
) -> tuple[Layout, Float64, UInt8 | None]:
    """Return points (N, 3) and colours (N, 3) or None from the parsed columns."""
    if layout.guessed and layout.columns > 3:
        layout = replace(layout, where={**layout.where, **_guess_colors(values, path)})
        if "r" in layout.where:
            notes.append(f"Columns {layout.where['r'] + 1} and on were taken for red, green, blue.")
    slot = {column: number for number, column in enumerate(wanted_columns(layout))}
    if layout.guessed:
        slot = {column: column for column in range(values.shape[1])}

    def columns(names: tuple[str, ...]) -> Float64:
        return np.ascontiguousarray(values[:, [slot[layout.where[name]] for name in names]])

    points = columns(_XYZ)
    if layout.down and np.nanmedian(points[:, 2]) < 0:
        layout = replace(layout, down=False)
        notes.append("Depths are negative; they were taken as heights.")
    if layout.lonlat and not _crs_is_said(path, options):
        notes.append("Longitude and latitude were taken as WGS 84 (EPSG:4326).")
    colored = set(_RGB) <= layout.where.keys() and not options.geometry_only
    return layout, points, _colors(columns(_RGB), notes) if colored else None


def _guess_colors(values: Float64, path: Path) -> dict[str, int]:
    """Find three neighbouring columns of colours: whole numbers 0-255, or fractions 0-1.

    PTS files and some others have the intensity before them. Unit vectors are normals.
    """
    for first in (4, 3) if path.suffix.lower() == ".pts" else (3, 4):
        part = values[:, first : first + 3]
        if part.shape[1] < 3 or not np.isfinite(part).all() or part.min() < 0:
            continue
        whole = bool((part == np.rint(part)).all()) and part.max() <= 255
        length = np.linalg.norm(part, axis=1)
        if whole or (part.max() <= 1 and np.abs(length - 1).max() > 1e-3):
            return {"r": first, "g": first + 1, "b": first + 2}
    return {}


def _colors(values: Float64, notes: list[str]) -> UInt8:
    """Turn colours as written (0-1, 0-255 or 0-65535) into 8 bits."""
    if not np.isnan(values).any() and (values == np.rint(values)).all() and values.min() >= 0:
        if values.max() <= 255:
            return values.astype(np.uint8)
        if values.max() <= 65535:
            return eight_bit_colors(values.astype(np.uint16))[0]
    colors, more = eight_bit_colors(values)
    notes += more
    return colors
