"""The joint with pye57's binding of libE57Format: scans in and out, piece by piece.

Every file passes `meshreg.io.e57.xml.read_layout` before it comes here.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshreg.errors import InputError, MeshregError, OutputError
from meshreg.io.e57.xml import Entry
from meshreg.io.files.decoding import Decoder
from meshreg.records import Bool, Float64, UInt8

CHUNK = 1_000_000
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLORS = ("colorRed", "colorGreen", "colorBlue")
NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_NORMALS_URI = "http://www.libe57.org/E57_EXT_surface_normals.txt"
_FIELDS = 12  # asked for at once, at most: coordinates, state, colors, intensity, normal, class


class MissingLibraryError(MeshregError):
    """An optional dependency is not installed (exit code 3: the file cannot be read here)."""

    exit_code = 3


def library(path: Path) -> Any:
    """Return pye57's binding, or say how to install it (`path` is for the message)."""
    try:
        from pye57 import libe57
    except ImportError as error:
        raise MissingLibraryError(
            f"E57 files need pye57, which cannot be imported ({error}).",
            file=path,
            remedy='Run: pip install "meshreg[e57]"',
        ) from error
    return libe57


@contextmanager
def opened(path: Path) -> Iterator[Decoder]:
    """Give the decoder of an E57 file: libE57Format in a process of its own."""
    library(path)
    with Decoder("e57", path, _FIELDS * 8 * CHUNK) as decoder:
        yield decoder


class Piece(NamedTuple):
    """Some points of a scan, in file coordinates.

    `xyz` (n, 3) float64; `rgb` (n, 3) uint8 or None; `valid` (n,) bool; `extra` other fields.
    """

    xyz: Float64
    rgb: UInt8 | None
    valid: Bool
    extra: dict[str, Float64]


def pieces(
    decoder: Decoder, number: int, scan: Entry, extra: tuple[str, ...] = ()
) -> Iterator[Piece]:
    """Read a scan through its pose, at most `CHUNK` points at a time."""
    if scan.count == 0:
        return
    spherical = not all(name in scan.fields for name in CARTESIAN)
    coordinates = SPHERICAL if spherical else CARTESIAN
    if not all(name in scan.fields for name in coordinates):
        raise InputError(
            f"has no coordinates (its fields are {', '.join(scan.fields)}).",
            file=decoder.path,
            place=f"scan {number + 1}",
            remedy="Export it with cartesian or spherical coordinates.",
        )
    state = "sphericalInvalidState" if spherical else "cartesianInvalidState"
    has_color = all(name in scan.fields for name in COLORS)
    names = [*coordinates, *([state] if state in scan.fields else []), *(COLORS * has_color)]
    rotation = rotation_matrix(scan.rotation)
    for data in _raw(decoder, number, [*names, *extra], min(CHUNK, scan.count)):
        local = np.stack([data[name] for name in coordinates], axis=1)
        with np.errstate(all="ignore"):  # what is not finite is left out below
            if spherical:
                local = cartesian(local)
            xyz = local @ rotation.T + scan.translation
        valid = np.asarray(np.isfinite(xyz).all(axis=1))
        if state in data:
            valid = valid & (data[state] == 0)
        rgb = np.stack([data[name] for name in COLORS], axis=1) if has_color else None
        yield Piece(
            xyz,
            None if rgb is None else _eight_bits(rgb, scan),
            valid,
            {name: data[name] for name in extra},
        )


def _raw(
    decoder: Decoder, number: int, names: list[str], capacity: int
) -> Iterator[dict[str, Float64]]:
    """Give the named fields of a scan as float64, `capacity` points at a time.

    They are good until the next ones are asked for.
    """
    decoder.place = f"scan {number + 1}"
    decoder.ask("scan", number=number, names=names, capacity=capacity)
    slot = 0
    decoder.send("read", slot=slot)
    while count := decoder.receive()["count"]:
        decoder.send("read", slot=1 - slot)  # while these are worked on
        try:
            flat = np.frombuffer(decoder.slot(slot), np.float64, count * len(names))
            yield dict(zip(names, flat.reshape(-1, count), strict=True))
        except GeneratorExit:
            decoder.receive()  # no more are wanted
            raise
        slot = 1 - slot


def cartesian(rae: Float64) -> Float64:
    """Return x, y, z of range [m], azimuth and elevation [rad], (N, 3) each (E2807 8.4.4.1)."""
    distance, azimuth, elevation = rae.T
    level = distance * np.cos(elevation)
    return np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )


def rotation_matrix(quaternion: Float64) -> Float64:
    """Return the (3, 3) rotation of a unit quaternion w, x, y, z."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())


def color_range(scan: Entry) -> tuple[float, float]:
    """Return the declared range of the colors: the scan's limits, else the fields' own."""
    low = [scan.limits.get(name + "Minimum") for name in COLORS]
    high = [scan.limits.get(name + "Maximum") for name in COLORS]
    fields = [scan.fields[name] for name in COLORS if name in scan.fields]
    lows = [v for v in low if v is not None] or [item.minimum for item in fields]
    highs = [v for v in high if v is not None] or [item.maximum for item in fields]
    bottom, top = min(lows, default=0.0), max(highs, default=255.0)
    plain = np.isfinite([bottom, top]).all() and 0 <= bottom < top < 2**32
    return (bottom, top) if plain else (0.0, 255.0)


def _eight_bits(rgb: Float64, scan: Entry) -> UInt8:
    low, high = color_range(scan)
    # Several writers declare 0-65535 and then store 0-255.
    if (low, high) != (0.0, 255.0) and not (high > 255 and rgb.max(initial=0) <= 255):
        rgb = (rgb - low) * (255.0 / (high - low))
    return np.clip(np.rint(rgb), 0, 255).astype(np.uint8)


@contextmanager
def created(libe57: Any, temporary: Path, crs: str | None, path: Path) -> Iterator[Any]:
    """Give a new image file with the root elements that the standard asks for (E2807 8.4.2).

    It is written to `temporary`; messages name `path`.
    """
    from meshreg import __version__

    file = libe57.ImageFile(str(temporary), "w")
    try:
        file.extensionsAdd("", libe57.E57_V1_0_URI)
        file.extensionsAdd("nor", _NORMALS_URI)
        root = file.root()
        root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
        root.set("guid", libe57.StringNode(file, f"{{{uuid.uuid4()}}}"))
        root.set("versionMajor", libe57.IntegerNode(file, 1))
        root.set("versionMinor", libe57.IntegerNode(file, 0))
        root.set("e57LibraryVersion", libe57.StringNode(file, f"meshreg {__version__}"))
        root.set("coordinateMetadata", libe57.StringNode(file, crs or ""))
        root.set("data3D", libe57.VectorNode(file, True))
        root.set("images2D", libe57.VectorNode(file, True))
        yield file
    except libe57.E57Exception as error:
        raise OutputError(f"cannot be written: {str(error).splitlines()[0]}.", file=path) from error
    finally:
        file.close()


def add_scan(
    libe57: Any, file: Any, name: str, fields: list[str], place: Float64 | None = None
) -> Any:
    """Add a scan without points yet; return its points node."""
    scan = libe57.StructureNode(file)
    scan.set("guid", libe57.StringNode(file, f"{{{uuid.uuid4()}}}"))
    scan.set("name", libe57.StringNode(file, name))
    if place is not None:
        pose, turn, shift = (libe57.StructureNode(file) for _ in range(3))
        for key, number in zip("wxyz", (1.0, 0.0, 0.0, 0.0), strict=True):
            turn.set(key, libe57.FloatNode(file, number))
        for key, number in zip("xyz", place, strict=True):
            shift.set(key, libe57.FloatNode(file, float(number)))
        pose.set("rotation", turn)
        pose.set("translation", shift)
        scan.set("pose", pose)
    prototype = libe57.StructureNode(file)
    for key in fields:
        node = libe57.IntegerNode(file, 0, 0, 255) if key in COLORS else libe57.FloatNode(file, 0.0)
        prototype.set(key, node)
    if COLORS[0] in fields:
        limits = libe57.StructureNode(file)
        for key in COLORS:
            limits.set(f"{key}Minimum", libe57.IntegerNode(file, 0))
            limits.set(f"{key}Maximum", libe57.IntegerNode(file, 255))
        scan.set("colorLimits", limits)
    points = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    scan.set("points", points)
    file.root()["data3D"].append(scan)
    return points


@contextmanager
def writer(
    libe57: Any, file: Any, points: Any, names: list[str]
) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Give a function that appends up to CHUNK points to a scan."""
    arrays = {name: np.empty(CHUNK) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, CHUNK, True, True))
    writer = points.writer(buffers)

    def put(data: dict[str, Any]) -> None:
        count = len(data[CARTESIAN[0]])
        for name, array in arrays.items():
            array[:count] = data[name]
        if count:
            writer.write(count)

    try:
        yield put
    finally:
        writer.close()
