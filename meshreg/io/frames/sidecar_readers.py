"""Read one side file of each kind: what it says of shift, CRS, axes and unit.

Who writes which is in docs/georeference.md.
"""

from __future__ import annotations

import html
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.io.files.safe import beside, decode_name, open_regular
from meshreg.io.frames.axes import UNITS
from meshreg.io.options import FARTHEST, UNIT_RANGE
from meshreg.settings.checked import parse_toml, shown

_MAX_BYTES = 1 << 20  # coords.txt lists every photograph; the rest are a few lines
KEYS = frozenset(("name", "date", "crs", "shift", "axes", "up", "unit", "columns"))
_ODM_CRS = re.compile(r"WGS\s?84\s+UTM|EPSG:|\+proj|\+init|[A-Z]+CRS\[|PROJCS\[", re.IGNORECASE)


@dataclass(frozen=True)
class SidecarInfo:
    """What the files beside a survey say; None is "nothing said".

    Attributes
    ----------
    path : Path or None
        The file that gave the shift, else the one that gave anything.
    shift : (east, north, up) or None
        Added to the file's coordinates after axes and unit [m, or the CRS's unit].
    crs : str or None
    axes : "enu", "ned", (3, 3) nested tuple or None
    up : "y", "z" or None
    unit : str, float (metres per unit) or None
    name, date : str or None
    columns : tuple of str or None
        Names of a text cloud's columns, instead of its header's or of a guess.
    shift_path, crs_path : Path or None
        Where those two came from.
    explicit_crs : bool
        The CRS is from a `.survey.toml`, which is written on purpose and so overrides the file.
    notes : tuple of str
    """

    path: Path | None = None
    shift: tuple[float, float, float] | None = None
    crs: str | None = None
    axes: Any = None
    up: str | None = None
    unit: str | float | None = None
    name: str | None = None
    date: str | None = None
    columns: tuple[str, ...] | None = None
    shift_path: Path | None = None
    crs_path: Path | None = None
    explicit_crs: bool = False
    notes: tuple[str, ...] = ()

    @property
    def shift_name(self) -> str:
        """Name of the file that gave the shift, for messages."""
        return self.shift_path.name if self.shift_path is not None else "its sidecar"


def join(
    first: SidecarInfo, second: SidecarInfo, settled: frozenset[str] = frozenset()
) -> SidecarInfo:
    """Return both together, or refuse two that say different things; not of what is `settled`."""
    changes: dict[str, Any] = {"notes": (*first.notes, *second.notes)}
    for key in (*sorted(KEYS), "shift_path", "crs_path"):
        one, two = getattr(first, key), getattr(second, key)
        if one is None:
            changes[key] = two
        elif two is not None and key in KEYS and key not in settled and not _same(key, one, two):
            place = getattr(first, f"{key}_path", None) or first.path
            raise InputError(
                f"says {key} = {two}, but {place} says {key} = {one}.",
                file=second.path,
                remedy=f"Remove the wrong one, or give the {key} yourself.",
            )
    changes["path"] = changes.get("shift_path") or first.shift_path or first.path or second.path
    changes["explicit_crs"] = first.explicit_crs or second.explicit_crs
    return replace(first, **changes)


def _same(key: str, one: Any, two: Any) -> bool:
    if key == "shift":
        return bool(np.allclose(one, two, rtol=0, atol=1e-3))
    if key == "crs":
        from meshreg.io.frames.crs import crs_text

        return crs_text(one) == crs_text(two)
    return bool(one == two)


def _lines(path: Path) -> list[str]:
    """Return the lines of a small text file: UTF-8 (BOM or not), else Latin-1."""
    with open_regular(path) as stream:
        content = stream.read(_MAX_BYTES)
    if b"\0" in content:
        raise InputError("is not text (it holds NUL bytes).", file=path)
    return decode_name(content.removeprefix(b"\xef\xbb\xbf")).splitlines()


def _numbers(path: Path, line: int, words: list[str], count: int) -> tuple[float, ...]:
    """Return finite numbers from words, or say what was expected."""
    try:
        values = tuple(float(word) for word in words)
    except ValueError:
        values = ()
    if len(values) != count or not np.isfinite(values).all():
        remedy = "Write numbers with a decimal point."
        raise InputError(
            f"expected {count} numbers, found {' '.join(words)!r}.",
            file=path,
            place=f"line {line}",
            remedy=remedy,
        )
    return values


def _filled(lines: list[str]) -> list[tuple[int, str]]:
    return [
        (number, line.strip())
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]


def located(path: Path, shift: Any, crs: str | None) -> SidecarInfo:
    """Return what a file says of shift and CRS, after a look at whether the CRS is one."""
    _check_crs(path, crs)
    return SidecarInfo(
        path=path,
        shift=shift,
        crs=crs,
        shift_path=path if shift is not None else None,
        crs_path=path if crs is not None else None,
    )


def _check_crs(path: Path, crs: str | None) -> None:
    if crs is None:
        return
    from meshreg.io.frames.crs import parse_crs

    try:
        parse_crs(crs)
    except InputError as error:
        raise InputError(error.message, file=path, remedy=error.remedy) from error


def read_offset(path: Path) -> SidecarInfo | None:
    """Read Pix4D's offset.xyz: three numbers, on one line or three.

    A longer list of numbers is a point cloud that happens to carry that name, and no sidecar.
    """
    lines = _filled(_lines(path))
    words = [word for _, line in lines for word in re.split(r"[\s,;]+", line) if word]
    if len(lines) > 3 or (len(words) > 3 and len(words) % 3 == 0):
        return None
    number = lines[0][0] if lines else 1
    return located(path, _numbers(path, number, words, 3), None)


def read_prj(path: Path) -> SidecarInfo:
    """Read a .prj: one CRS as WKT, of ESRI's kind or another."""
    return located(path, None, " ".join(_lines(path)))


def read_offset_txt(path: Path) -> SidecarInfo | None:
    """Read three numbers from offset.txt (Skycatch), as far as it holds just those."""
    try:
        found = read_offset(path)
    except InputError:
        found = None
    if found is None:
        return SidecarInfo(
            notes=(f"{path.name} does not hold three numbers, as a shift would; ignored.",)
        )
    return found


def read_metadata(path: Path) -> SidecarInfo | None:
    """Read metadata.xml of ContextCapture (iTwin Capture), DJI Terra and Metashape's tiles.

    ``<SRS>`` is a code, WKT, or "ENU:latitude,longitude" for axes east, north and up at that
    place; ``<SRSOrigin>`` is what was subtracted, in that system. Files of that name that others
    write (ESRI, ISO 19115) are none of ours. The ENU system is read as the orthographic projection
    about the place (EPSG method 9840), whose easting and northing are the same for points on the
    ellipsoid; up stays what it is.
    """
    text = re.sub(r"<!--.*?-->", "", "\n".join(_lines(path)), flags=re.DOTALL)
    if "<ModelMetadata" not in text:
        return None
    srs, origin = (
        re.search(rf"<{tag}[^>]*>(.*?)</{tag}>", text, re.DOTALL) for tag in ("SRS", "SRSOrigin")
    )
    shift = None
    if origin and (words := re.split(r"[\s,;]+", html.unescape(origin[1]).strip())) != [""]:
        line = text[: origin.start()].count("\n") + 1
        shift = _numbers(path, line, words, 3)
    crs = " ".join(html.unescape(srs[1]).split()) if srs else ""
    if crs.upper().startswith("ENU"):
        return _read_enu(path, crs, shift)
    if crs.upper() in ("", "NONE", "LOCAL", "UNKNOWN") or crs.upper().startswith("LOCAL"):
        return located(path, shift, None)
    said = located(path, shift, crs)
    from meshreg.io.frames.crs import crs_name, is_geographic

    if is_geographic(crs):
        note = (
            f"{path.name} gives an origin in {crs_name(crs)}: whether the coordinates beside it "
            "are degrees or metres is not known, so it is not applied. Export in a projected "
            "system, or give the shift."
        )
        return SidecarInfo(notes=(note,))
    return said


def tell_metadata(path: Path) -> SidecarInfo | None:
    """Tell of a metadata.xml further up that need not speak of the survey."""
    if (said := read_metadata(path)) is None or said.shift is None or not any(said.shift):
        return None
    text = ", ".join(f"{value:.12g}" for value in said.shift)
    note = (
        f"{path.name} in the folder {path.parent.name!r} gives the origin ({text}), which is not "
        "applied: it lies further up than where it would speak of this file."
    )
    return SidecarInfo(notes=(note,))


def _read_enu(path: Path, text: str, shift: Any) -> SidecarInfo:
    words = re.split(r"[\s,;]+", text[3:].strip(" :"))
    try:
        latitude, longitude = (float(word) for word in words[:2])
        good = abs(latitude) <= 90 and abs(longitude) <= 360 and len(words) == 2
    except ValueError:
        good = False
    if not good:
        raise InputError(
            f"has the local system {shown(text)}; expected ENU:latitude,longitude.",
            file=path,
            remedy="Give shift and CRS in a .survey.toml, and remove it.",
        )
    from meshreg.io.frames.crs_parts import local_axes

    note = (
        f"{path.name}: coordinates are in local axes east, north, up at latitude {latitude:.9g}, "
        f"longitude {longitude:.9g}. Heights are above the plane there, which leaves the ellipsoid "
        "by 8 cm at 1 km and 8 m at 10 km from that place."
    )
    return replace(located(path, shift, local_axes(latitude, longitude)), notes=(note,))


def tell_realityscan(path: Path) -> SidecarInfo:
    """Tell of RealityScan's (RealityCapture's) info file: what it says is not enough to go by.

    It names the project's CRS, a kind of export and a matrix "to the model", whose order and
    direction are not published; the same name stands beside absolute, shifted and geocentric
    coordinates. https://rchelp.capturingreality.com/en-US/tools/export.htm
    """
    text = "\n".join(_lines(path))
    name = re.search(r'globalCoordinateSystemName="([^"]{1,120})"', text)
    matrix = re.search(r"transformToModel(?:=\"|>)([^\"<]{1,600})", text)
    words = matrix[1].split() if matrix else []
    more = f" It names {html.unescape(name[1])}" if name and name[1] != "NONE" else ""
    if len(words) == 16 and words[3:12:4] != ["0", "0", "0"]:
        place = ", ".join(words[3:12:4])
        more += f"{' and' if more else ' It holds'} a matrix with ({place}) in its last column"
    note = (
        f"{path.name} (RealityScan) may say where the coordinates are, but is not applied: its "
        f"matrix has no published meaning.{more}{'.' if more else ''} If they are shifted, give "
        "the shift (--reference-shift, --moving-shift, or a .survey.toml)."
    )
    return SidecarInfo(notes=(note,))


def tell_tileset(path: Path) -> SidecarInfo | None:
    """Tell of a 3D Tiles tileset, which may place its tiles by matrices."""
    text = "".join(_lines(path))
    if '"transform"' not in text or '"geometricError"' not in text:
        return None
    note = (
        f"{path.name} (3D Tiles) places its tiles by matrices, which are not applied: if the "
        "coordinates are shifted, give the shift and the axes (.survey.toml)."
    )
    return SidecarInfo(notes=(note,))


def tell_opensfm(path: Path) -> SidecarInfo:
    """Tell of OpenSfM's origin, which not all of its exports refer to."""
    note = (
        f"{path.name} (OpenSfM) gives an origin in degrees, which is not applied: not all of its "
        "exports refer to it."
    )
    return SidecarInfo(notes=(note,))


def read_shift_txt(path: Path) -> SidecarInfo:
    """Read Metashape's and 3DSC's SHIFT.txt: ``CRS X Y Z``."""
    lines = _filled(_lines(path))
    if not lines:
        raise InputError("is empty; expected 'CRS X Y Z'.", file=path)
    number, line = lines[0]
    words = line.replace(",", " ").split()
    crs = " ".join(words[:-3])
    named = crs.lower() not in ("", "none", "local")
    return located(path, _numbers(path, number, words[-3:], 3), crs if named else None)


def read_coords(path: Path) -> SidecarInfo:
    """Read OpenDroneMap's coords.txt: the CRS, then east and north of the offset; up is not moved.

    https://docs.opendronemap.org/outputs/ : "WGS84 UTM 16N", or a PROJ string, which proj.txt
    beside it repeats.
    """
    lines = _filled(_lines(path))
    if not lines or not _ODM_CRS.match(lines[0][1]):
        # Others call their lists of control points so; that is no reason to refuse a survey.
        return SidecarInfo(notes=(f"{path.name} does not start with a CRS as ODM's; ignored.",))
    if len(lines) < 2:
        raise InputError("needs a line with the CRS and one with east and north.", file=path)
    number, line = lines[1]
    east, north = _numbers(path, number, line.split()[:2], 2)
    said = located(path, (east, north, 0.0), lines[0][1])
    repeated = beside(path.parent, "proj.txt")
    return said if repeated is None else join(said, read_prj(repeated))


def read_toml(path: Path) -> SidecarInfo:
    """Read our own .survey.toml; any key may be missing, none may be unknown."""
    try:
        document = parse_toml("\n".join(_lines(path)))
    except ValueError as error:
        raise InputError(f"is not TOML: {error}.", file=path) from error
    for key, value in document.items():
        _check_key(path, key, value)
    shift = document.get("shift")
    crs = document.get("crs")
    _check_crs(path, crs)
    axes = document.get("axes")
    return SidecarInfo(
        path=path,
        shift=None if shift is None else (float(shift[0]), float(shift[1]), float(shift[2])),
        crs=crs,
        axes=axes if not isinstance(axes, list) else tuple(tuple(row) for row in axes),
        up=document.get("up"),
        unit=document.get("unit"),
        name=document.get("name"),
        date=None if "date" not in document else str(document["date"]),
        columns=None if "columns" not in document else tuple(document["columns"]),
        shift_path=None if shift is None else path,
        crs_path=None if crs is None else path,
        explicit_crs=crs is not None,
    )


def _check_key(path: Path, key: str, value: Any) -> None:
    """Refuse a key or a value that cannot be meant, rather than read the survey elsewhere."""

    def within(item: Any, low: float, high: float) -> bool:
        return type(item) in (int, float) and low <= item <= high  # false for NaN

    def numbers(items: Any, largest: float) -> bool:
        return (
            isinstance(items, list)
            and len(items) == 3
            and all(within(item, -largest, largest) for item in items)
        )

    wanted = {
        "name": ("text", isinstance(value, str)),
        "date": ("a date", isinstance(value, str) or hasattr(value, "isoformat")),
        "crs": ("text such as 'EPSG:32754'", isinstance(value, str)),
        "shift": (f"three numbers of up to {FARTHEST:g} m", numbers(value, FARTHEST)),
        "axes": (
            '"enu", "ned" or a 3 × 3 matrix',
            value in ("enu", "ned")
            or (
                isinstance(value, list)
                and len(value) == 3
                and all(numbers(row, UNIT_RANGE[1]) for row in value)
                and abs(np.linalg.det(np.array(value, float))) > 1e-12
            ),
        ),
        "up": ('"y" or "z"', value in ("y", "z")),
        "unit": (
            f"one of {', '.join(UNITS)}, or metres per unit from {UNIT_RANGE[0]:g} to "
            f"{UNIT_RANGE[1]:g}",
            (isinstance(value, str) and value in UNITS) or within(value, *UNIT_RANGE),
        ),
        "columns": (
            "a list of names",
            isinstance(value, list)
            and 3 <= len(value) <= 1000
            and all(isinstance(item, str) for item in value),
        ),
    }
    if key not in wanted:
        raise InputError(
            f"{shown(key)} is not known.", file=path, remedy=f"Use {', '.join(wanted)}."
        )
    expected, fits = wanted[key]
    if not fits:
        raise InputError(f"{key} = {shown(value)}; expected {expected}.", file=path)
