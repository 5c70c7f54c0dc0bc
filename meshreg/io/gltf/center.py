"""Where a glTF file is: the centre that CESIUM_RTC gives, and what else hints at a place.

P. Cozzi and T. Fili, CESIUM_RTC, glTF 1.0 vendor extension: positions are relative to a centre in
"an application-specific coordinate system". Its readers (CesiumJS, 3D Tiles) add the centre after
the turn from y up to z up, so that it is in x, y, z of the CRS, most often WGS 84 geocentric.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.io.assemble import RawGeometry
from meshreg.io.frames.axes import Y_UP
from meshreg.io.frames.sidecar import SidecarInfo, find_sidecar
from meshreg.io.gltf.document import Document, extension
from meshreg.io.options import FARTHEST, ReadOptions
from meshreg.records import Float64

NAME = "CESIUM_RTC"
_GEOCENTRIC = "EPSG:4978"
_EARTH = (6.33e6, 6.40e6)  # radii [m] of places at the surface; the deep sea and peaks included
_HIGHEST = 2e4  # no height or depth is that large [m]
_LEVEL = np.cos(np.radians(35.0))  # a survey's mean normal is that near to the vertical
_PLACES = re.compile(r"(?i)geopose|georef|geospatial|geolocation|scene_crs|_crs$|_rtc$")
_KEYS = re.compile(r"(?i)^(epsg|crs|srs|(utm|geo)?_?(offset|origin|shift|translation))$")


@dataclass(frozen=True, eq=False)
class Center:
    """Axes (3, 3) and CRS of the file's coordinates, and what it says of its shift.

    `up_counts` is False where no axis of the file points up.
    """

    axes: Float64
    crs: str | None = None
    own: SidecarInfo | None = None
    up_counts: bool = True


def center_of(document: Document) -> Float64 | None:
    """Return the centre (3,) of CESIUM_RTC, as written; None where there is none."""
    found = extension(document.tree, NAME)
    if not isinstance(found, dict):
        return None
    center = document.numbers(found, "center", 3, f"extensions.{NAME}")
    if center is not None and np.abs(center).max() > FARTHEST:
        document.fail(f"gives a centre {center.tolist()}.", f"extensions.{NAME}")
    return center


def relative_to_center(
    document: Document,
    raw: RawGeometry,
    axes: Float64,
    options: ReadOptions,
    notes: list[str],
) -> Center:
    """Say what CESIUM_RTC makes of the file's coordinates.

    A centre at the Earth's radius is geocentric (EPSG:4978). Its file's axes are then those of
    the CRS once y up is turned to z up; or, where the survey lies level in the file's own axes and
    stands on edge on the ground, east, up and south at the centre, as some exporters leave them.
    Any other centre is a shift, x east, y north, z up; where it can only be (east, up, -north),
    because its second number alone could be a height, it is turned as the coordinates are.
    """
    center = center_of(document)
    if center is None or not center.any():
        return Center(axes)
    if options.shift is not None:  # "replaces a side file's shift", this one too
        notes.append(f"The stated shift replaces the centre that {NAME} gives.")
        return Center(axes)
    path = document.path
    radius = float(np.linalg.norm(center))
    plain = abs(center[2]) < _HIGHEST
    said = find_sidecar(path, again=True)
    crs = options.crs or (None if said is None else said.crs)
    up_counts = True
    if crs is None and _EARTH[0] < radius < _EARTH[1] and not plain:
        crs = _GEOCENTRIC
    if crs is not None and _is_geocentric(crs):
        shift = center
        axes, up_counts = _geocentric_axes(raw, axes, center)
        how = "east, north, up" if up_counts else "geocentric x, y, z"
        notes.append(f"{NAME} gives a geocentric centre; coordinates were read as {how} from it.")
    else:
        turned = not plain and abs(center[1]) < _HIGHEST
        shift = axes @ center if turned else center
        how = "x east, y up, z south" if turned else "x east, y north, z up"
        note = f"{NAME} gives a centre, read as {how}."
        if crs is None and _EARTH[0] < radius < _EARTH[1]:
            note += ' If it is geocentric, close to the equator, say crs = "EPSG:4978".'
        notes.append(note)
    east, north, up = (float(value) for value in shift)
    own = SidecarInfo(path=path, shift=(east, north, up), shift_path=path)
    return Center(axes, crs if crs == _GEOCENTRIC else None, own, up_counts)


def _is_geocentric(crs: str) -> bool:
    from meshreg.io.frames.crs import parse_crs

    return bool(parse_crs(crs).is_geocentric)


def _geocentric_axes(raw: RawGeometry, axes: Float64, center: Float64) -> tuple[Float64, bool]:
    """Return the axes of coordinates beside a geocentric centre, and whether they are local."""
    local = local_axes_at(center)
    normal = _mean_normal(raw)
    if normal is not None:
        on_ground = abs(float((Y_UP @ normal) @ local[:, 2]))
        in_file = abs(float((axes @ normal)[2]))
        if on_ground < _LEVEL < in_file:
            return local @ axes, True
    return Y_UP, False


def local_axes_at(center: Float64) -> Float64:
    """Return (3, 3) whose columns are east, north and up at a geocentric place (WGS 84)."""
    import pyproj

    way = pyproj.Transformer.from_crs(_GEOCENTRIC, "EPSG:4979", always_xy=True)
    longitude, latitude, _ = (np.radians(value) for value in way.transform(*center))
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    up = [
        np.cos(latitude) * np.cos(longitude),
        np.cos(latitude) * np.sin(longitude),
        np.sin(latitude),
    ]
    return np.array([east, np.cross(up, east), up]).T


def _mean_normal(raw: RawGeometry) -> Float64 | None:
    """Return the unit normal of a survey as a whole, in the file's axes; None where there is none.

    The mean normal of a mesh; of a cloud the direction in which it is thinnest.
    """
    points = np.asarray(raw.points[np.isfinite(raw.points).all(axis=1)], np.float64)
    if len(points) < 3:
        return None
    if raw.faces is not None:
        corners = np.asarray(raw.points, np.float64)[raw.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = normals[np.isfinite(normals).all(axis=1)]
        total = normals.sum(axis=0)
        length = float(np.linalg.norm(total))
        area = float(np.linalg.norm(normals, axis=1).sum())
        if area > 0 and length > 0.3 * area:
            return np.asarray(total / length)
    away = points - points.mean(axis=0)
    values, vectors = np.linalg.eigh(away.T @ away)
    return np.asarray(vectors[:, 0]) if values[0] < 0.3 * values[1] else None


def with_center(tree: dict[str, Any], center: Any) -> None:
    """Set the centre of a tree's CESIUM_RTC, or take the extension out where it is zero."""
    if center.any():
        tree["extensions"][NAME]["center"] = [float(value) for value in center]
        return
    del tree["extensions"][NAME]
    for key in ("extensionsUsed", "extensionsRequired"):
        if isinstance(names := tree.get(key), list):
            tree[key] = [name for name in names if name != NAME]
            if not tree[key]:  # the format allows no empty list
                del tree[key]
    if not tree["extensions"]:
        del tree["extensions"]


def unread_places(document: Document) -> list[str]:
    """Name what else in a file speaks of a place on Earth: extensions and extras."""
    named = []
    owners: list[Any] = [document.tree, *document.items("scenes"), *document.items("nodes")]
    for owner in owners:
        extensions = owner.get("extensions")
        if isinstance(extensions, dict):
            named += [
                f"the extension {name[:40]}"
                for name in extensions
                if name != NAME and _PLACES.search(name)
            ]
    owners = [document.tree, document.tree.get("asset"), *document.items("scenes")]
    for owner in owners:
        extras = owner.get("extras") if isinstance(owner, dict) else None
        if isinstance(extras, dict):
            named += [f"{key!r} in its extras" for key in extras if _KEYS.match(key)]
    if not named:
        return []
    listed = ", ".join(list(dict.fromkeys(named))[:3])
    return [
        f"The file has {listed}, which may say where it is and is not applied: if the coordinates "
        "are shifted, give the shift."
    ]
