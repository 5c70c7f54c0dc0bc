"""E57: scans with their poses, by pye57's binding of libE57Format (extra ``meshreg[e57]``).

`meshreg.io.e57.xml` checks the file before the library sees it. A rigid move changes the poses in
the XML and nothing else; any other move (a change of CRS) writes the points anew.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io.assemble import Found, placed_survey
from meshreg.io.e57 import pages as e57_pages
from meshreg.io.e57 import xml as e57_xml
from meshreg.io.e57.scans import (
    CARTESIAN,
    CHUNK,
    COLORS,
    NORMALS,
    add_scan,
    color_range,
    created,
    library,
    opened,
    pieces,
    rotation_matrix,
    writer,
)
from meshreg.io.e57.xml import Layout
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.rewriting import require_unchanged, warn
from meshreg.io.files.safe import open_regular
from meshreg.io.frames.crs import crs_text
from meshreg.io.frames.directions import bend_note, find_directions
from meshreg.io.frames.place import Mover, place
from meshreg.io.las.classes import RECLASS, ground_classes
from meshreg.io.options import ReadOptions
from meshreg.records import Float64, PointCloud, SourceFile, Survey, UInt8

log = logging.getLogger("meshreg")


def read(path: Path, options: ReadOptions) -> Survey:
    """Read all scans of an E57 file as one point cloud.

    Each scan's points, cartesian or spherical, pass through its pose (unit quaternion, then
    translation; ASTM E2807 section 8.4.9). Points whose state is marked invalid are left out.

    Parameters
    ----------
    path : Path
    options : ReadOptions
        Shift, axes, unit and CRS of the file's coordinates. E57 is in metres, z up.

    Returns
    -------
    Survey
        With a PointCloud; colors scaled to 8 bits where the file's range is another, present
        when every scan has them.

    Raises
    ------
    InputError
        Damaged or empty file (`UnsafeReferenceError`: a DOCTYPE or ENTITY in its XML).
    MissingLibraryError
        pye57 is not installed.
    """
    path = Path(path)
    layout = e57_xml.read_layout(path)
    notes: list[str] = []
    points, colors = _read_scans(path, layout, options.geometry_only, notes)
    notes += _direction_notes(layout)
    crs = _crs(layout, notes)
    for note in notes:
        log.warning("%s: %s", path.name, note)
    placed = place(path, points, options, crs, georeferenced=crs is not None)
    geometry = PointCloud(placed.points, colors)
    found = Found("e57", tuple(notes), counts={"points": len(points), "scans": len(layout.scans)})
    return placed_survey(path, placed, geometry, found)


def _crs(layout: Layout, notes: list[str]) -> str | None:
    """Return the file's `coordinateMetadata` where PROJ understands it."""
    if layout.crs is None:
        return None
    try:
        return crs_text(layout.crs)
    except InputError:
        notes.append(f"The file's coordinate system {layout.crs[:80]!r} is not understood.")
        return None


def _read_scans(
    path: Path, layout: Layout, geometry_only: bool, notes: list[str]
) -> tuple[Float64, UInt8 | None]:
    points, colors, classes, invalid, empty = [], [], [], 0, 0
    with opened(path) as decoder:
        for number, scan in enumerate(layout.scans):
            found = 0
            label = next((name for name in scan.fields if _is_class(name)), None)
            for xyz, rgb, kept, more in pieces(decoder, number, scan, (label,) if label else ()):
                points.append(xyz[kept])
                colors.append(None if rgb is None else rgb[kept])
                classes.append(more[label][kept] if label else np.zeros(len(points[-1])))
                found += len(kept)
                invalid += len(kept) - int(kept.sum())
            if found != scan.count:
                raise InputError(
                    f"declares {scan.count} points but holds {found}.",
                    file=path,
                    place=f"scan {number + 1}",
                    remedy="The file is cut off or damaged; export or copy it again.",
                )
            empty += found == 0
    if not sum(map(len, points)):
        raise InputError(
            f"holds no valid point ({len(layout.scans)} scans, {invalid} invalid points).",
            file=path,
            remedy="Export the cloud again.",
        )
    if invalid:
        notes.append(f"{invalid} points marked invalid were left out.")
    if empty:
        notes.append(f"{empty} of {len(layout.scans)} scans hold no points.")
    with_color = [part for part in colors if part is not None]
    every = len(with_color) == len(colors) and not geometry_only
    if every and any(color_range(scan)[1] > 255 for scan in layout.scans):
        notes.append("Colors of more than 8 bits were scaled to 8.")
    if with_color and not every and not geometry_only:
        notes.append("Colors were left out, because not every scan has them.")
    xyz, rgb = np.concatenate(points), np.concatenate(with_color) if every else None
    ground = ground_classes(np.concatenate(classes), notes)
    if ground is None:
        return xyz, rgb
    if not ground.any():
        raise InputError(f"holds no usable point ({' '.join(notes)}).", file=path, remedy=RECLASS)
    return xyz[ground], None if rgb is None else rgb[ground]


def _is_class(name: str) -> bool:
    """Whether a field is the classification, of whatever extension."""
    return name.rpartition(":")[2].lower() == "classification"


def _direction_notes(layout: Layout) -> tuple[str, ...]:
    """Return what to say of fields with a direction that a moved copy cannot turn.

    A rigid move turns the scans' own frames, in which the standard's fields and normals are.
    """
    names = {name for scan in layout.scans for name in scan.fields}
    own = [name for name in sorted(names) if not name.startswith(("cartesian", "spherical"))]
    return find_directions(own).notes


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of an E57 file.

    A rigid move composes each scan's and image's pose with it: points, colors, pictures and
    extensions keep their bytes. Any other move writes the points anew, one scan for each, with
    color, intensity and normal.

    Parameters
    ----------
    source : SourceFile
    move : Mover
        Old file coordinates to new ones.
    path : Path
        The new file; written whole or not at all, then opened again and compared.

    Raises
    ------
    InputError
        The file has changed since it was read.
    OutputError
        Not written, or not what was meant when read back.
    """
    require_unchanged(source, path)
    layout = e57_xml.read_layout(source.path)
    with atomic_file(path) as temporary:
        if _is_rigid(source.path, layout, move):
            _rewrite_poses(source.path, layout, move, temporary)
        else:
            normal = any(set(NORMALS) <= scan.fields.keys() for scan in layout.scans)
            if normal and (note := bend_note(find_directions(NORMALS), move)):
                warn(path, note)
            log.warning(
                "%s: the move is not rigid; pictures and fields other than color, intensity and "
                "normal are left out.",
                path,
            )
            _rewrite_points(source.path, layout, move, temporary, path)
        _check(source.path, temporary, move, path)
    return (path,)


def _is_rigid(path: Path, layout: Layout, move: Mover) -> bool:
    """Whether new poses alone move every point to within a micrometre."""
    linear = move.matrix[:3, :3]
    if np.abs(linear @ linear.T - np.eye(3)).max() > 1e-6 or np.linalg.det(linear) < 0:
        return False
    turn = _nearest_rotation(linear).as_matrix()
    with opened(path) as decoder:
        for number, scan in enumerate(layout.scans):
            for xyz, _, kept, _ in pieces(decoder, number, scan):
                if kept.any():
                    corners = np.stack([xyz[kept].min(axis=0), xyz[kept].max(axis=0)])
                    place = linear @ scan.translation + move.matrix[:3, 3]
                    posed = (corners - scan.translation) @ turn.T + place
                    if np.abs(move.points(corners) - posed).max() > 1e-6:
                        return False
    return True


def _nearest_rotation(linear: Float64) -> Any:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(linear)


def _rewrite_poses(path: Path, layout: Layout, move: Mover, target: Path) -> None:
    from scipy.spatial.transform import Rotation

    linear, shift = move.matrix[:3, :3], move.matrix[:3, 3]
    turn = _nearest_rotation(linear)
    poses = []
    for entry in layout.entries:
        pose = turn * Rotation.from_quat(entry.rotation, scalar_first=True)
        place = linear @ entry.translation + shift
        poses.append((np.asarray(pose.as_quat(scalar_first=True)), place))
    xml = e57_xml.with_poses(layout, poses, move.frame.file_crs)
    with open_regular(path) as old, open(target, "r+b") as new:
        shutil.copyfileobj(old, new, 1 << 20)
        # Where binary sections follow the XML, the new one goes behind them on its own page.
        end = old.tell() // e57_pages.PAGE * e57_pages.PAYLOAD
        start = layout.xml_start if layout.xml_is_last else end
        page = start // e57_pages.PAYLOAD
        old.seek(page * e57_pages.PAGE)
        before = old.read(start - page * e57_pages.PAYLOAD)
        new.truncate(page * e57_pages.PAGE)
        new.seek(page * e57_pages.PAGE)
        new.write(e57_pages.paged(before + xml))
        size = new.tell()
        new.seek(0)
        first = new.read(e57_pages.PAYLOAD)
        new.seek(0)
        new.write(e57_pages.header_page(first, size, e57_pages.to_physical(start), len(xml)))


def _rewrite_points(path: Path, layout: Layout, move: Mover, target: Path, shown: Path) -> None:
    crs = move.frame.file_crs
    libe57 = library(path)
    with opened(path) as old, created(libe57, target, crs, shown) as new:
        for number, scan in enumerate(layout.scans):
            normal = NORMALS if all(name in scan.fields for name in NORMALS) else ()
            extra = (*(name for name in ("intensity",) if name in scan.fields), *normal)
            turn = rotation_matrix(scan.rotation)
            colors = COLORS if all(name in scan.fields for name in COLORS) else ()
            names = [*CARTESIAN, *colors, *extra]
            node = add_scan(libe57, new, f"scan {number + 1}", names)
            with writer(libe57, new, node, names) as put:
                for piece in pieces(old, number, scan, extra):
                    kept = piece.valid
                    data = dict(zip(CARTESIAN, move.points(piece.xyz[kept]).T, strict=True))
                    if piece.rgb is not None:
                        data.update(zip(COLORS, piece.rgb[kept].T, strict=True))
                    data |= {name: value[kept] for name, value in piece.extra.items()}
                    if normal:  # in the scan's own frame, which the new file does not have
                        local = np.stack([data[name] for name in NORMALS], axis=1)
                        turned = move.directions(piece.xyz[kept], local @ turn.T)
                        data.update(zip(NORMALS, turned.T, strict=True))
                    put(data)


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a point cloud as a new E57 file of one scan, in absolute coordinates.

    Coordinates are doubles in the scan's own frame, whose pose is the survey's origin.

    Raises
    ------
    UsageError
        The survey is not a point cloud.
    """
    if not isinstance(survey.geometry, PointCloud):
        kind = type(survey.geometry).__name__
        raise UsageError(f"An E57 file holds points, not a {kind}.", remedy="Write an OBJ or TIFF.")
    cloud = survey.geometry
    names = [*CARTESIAN, *(() if cloud.colors is None else COLORS)]
    libe57 = library(path)
    with atomic_file(path) as temporary:
        with created(libe57, temporary, survey.crs, path) as file:
            node = add_scan(libe57, file, survey.name, names, survey.origin)
            with writer(libe57, file, node, names) as put:
                for start in range(0, len(cloud.points), CHUNK):
                    part = slice(start, start + CHUNK)
                    data = dict(zip(CARTESIAN, cloud.points[part].T, strict=True))
                    if cloud.colors is not None:
                        data.update(zip(COLORS, cloud.colors[part].T, strict=True))
                    put(data)
        e57_xml.read_layout(temporary)
    return (path,)


def _check(old_path: Path, new_path: Path, move: Mover, path: Path) -> None:
    """Read old and new file side by side: the new points must be the moved old ones.

    The poses that the new file states are read by another parser than the one that found where
    the old ones stood.
    """
    if not _poses_agree(e57_xml.read_layout(new_path)):
        raise OutputError("has other poses when read back.", file=path)
    old, new = (_valid_points(each) for each in (old_path, new_path))
    worst = 0.0
    for before, after in zip_longest(old, new):
        same = before is not None and after is not None and before.shape == after.shape
        if not same:
            raise OutputError("has lost points when read back.", file=path)
        if len(before):
            worst = max(worst, float(np.abs(move.points(before) - after).max()))
    if not worst < 1e-5:
        raise OutputError(f"is off by {worst:.3g} m when read back.", file=path)


def _poses_agree(layout: Layout) -> bool:
    """Whether ElementTree finds the poses that the layout has."""
    from xml.etree import ElementTree  # the text has no document type, see `e57_xml`

    root = ElementTree.fromstring(layout.xml)
    for kind in ("data3D", "images2D"):
        found = root.findall(f"{{*}}{kind}/{{*}}vectorChild")
        entries = [entry for entry in layout.entries if entry.kind == kind]
        if len(found) != len(entries):
            return False
        for element, entry in zip(found, entries, strict=True):
            turn, place = (
                [float(element.findtext(f"{{*}}pose/{{*}}{part}/{{*}}{k}") or 0) for k in names]
                for part, names in (("rotation", "wxyz"), ("translation", "xyz"))
            )
            size = float(np.linalg.norm(turn))
            unit = np.array(turn) / size if size else np.array([1.0, 0, 0, 0])
            if np.abs(unit - entry.rotation).max() > 1e-12 or place != entry.translation.tolist():
                return False
    return True


def _valid_points(path: Path) -> Iterator[Float64]:
    """Give the valid points, a scan at a time."""
    layout = e57_xml.read_layout(path)
    with opened(path) as decoder:
        for number, scan in enumerate(layout.scans):
            waiting: list[Float64] = []
            for xyz, _, kept, _ in pieces(decoder, number, scan):
                waiting.append(xyz[kept])
            yield np.concatenate(waiting) if waiting else np.zeros((0, 3))
