"""Small files beside a survey that say where it is: offset.xyz, coords.txt, SHIFT.txt and ours.

Exports are often moved near zero and the shift kept in a second file. Every known kind is looked
for; two that disagree are refused, because the wrong one would move the survey by kilometres.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.checked import parse_toml, shown
from meshreg.errors import InputError
from meshreg.io.options import FARTHEST, UNIT_RANGE
from meshreg.io.safe import beside, decode_name, open_regular, require_inside
from meshreg.io.sidecar_write import write_shift

__all__ = ["SidecarInfo", "find_sidecar", "is_sidecar", "write_shift"]

_LOG = logging.getLogger("meshreg")
_MAX_BYTES = 1 << 20  # coords.txt lists every photograph; the rest are a few lines
_KEYS = ("name", "date", "crs", "shift", "axes", "up", "unit", "columns")
_ODM_CRS = re.compile(r"WGS\s?84\s+UTM|EPSG:|\+proj|\+init|[A-Z]+CRS\[|PROJCS\[", re.IGNORECASE)
_ODM_FOLDER = "odm_georeferencing"


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


def find_sidecar(path: Path, *, shared: bool = True) -> SidecarInfo | None:
    """Read all sidecars of one survey file and join them.

    Parameters
    ----------
    path : Path
        The survey file; it need not exist.
    shared : bool
        Also read files that speak for a whole folder (offset.xyz, coords.txt, SHIFT.txt). Formats
        that state absolute coordinates themselves are not meant by those.

    Returns
    -------
    SidecarInfo or None
        None where there is no sidecar.

    Raises
    ------
    InputError
        A sidecar that is malformed (with its line), or two that disagree (naming both).
    """
    path = Path(path)
    joined = SidecarInfo()
    for folder, name, reader in _candidates(path, shared):
        candidate = beside(folder, name) if name != path.name else None
        said = None if candidate is None else reader(candidate)
        if said is not None:
            joined = _join(joined, said)
    return joined if joined.path is not None or joined.notes else None


def is_sidecar(path: Path) -> bool:
    """Whether a file is known as a sidecar by its name, and for .xyz and .txt by its content."""
    name = path.name.lower()
    if name.endswith((".survey.toml", ".prj")) or name in ("coords.txt", "proj.txt", "shift.txt"):
        return True
    if name == "offset.xyz" or name.endswith("_offset.xyz"):
        try:
            require_inside(path, path.parent)
            return _read_offset(path) is not None
        except InputError:
            return False
    return False


def _candidates(path: Path, shared: bool) -> Iterator[tuple[Path, str, Any]]:
    """Give the folder and the name of each side file that may be there, and what reads it."""
    folder, stem = path.parent, path.stem
    if path.name.lower().endswith(".copc.laz"):
        stem = path.name[: -len(".copc.laz")]
    for name in dict.fromkeys((stem, path.stem)):
        yield folder, f"{name}.survey.toml", _read_toml
        yield folder, f"{name}_offset.xyz", _read_offset
        yield folder, f"{name}.prj", _read_prj
        yield folder, f"{name}_wkt.prj", _read_prj
        for suffix in (".rcInfo", ".rcinfo"):
            yield folder, f"{name}{suffix}", _tell_rcinfo
    if not shared:
        return
    yield folder, "offset.xyz", _read_offset
    for name in ("SHIFT.txt", "shift.txt", "Shift.txt"):
        if (folder / name).is_file():
            yield folder, name, _read_shift_txt
            break
    yield folder, "coords.txt", _read_coords
    # OpenDroneMap keeps it apart: odm_texturing/odm_textured_model_geo.obj is what it speaks of.
    if folder.name.startswith("odm_texturing") and stem.endswith("_geo"):
        yield folder.absolute().parent, f"{_ODM_FOLDER}/coords.txt", _read_coords
    yield folder, f"{_ODM_FOLDER}/coords.txt", _read_coords


def _join(first: SidecarInfo, second: SidecarInfo) -> SidecarInfo:
    """Return both together, or refuse two that say different things."""
    changes: dict[str, Any] = {"notes": (*first.notes, *second.notes)}
    for key in (*_KEYS, "shift_path", "crs_path"):
        one, two = getattr(first, key), getattr(second, key)
        if one is None:
            changes[key] = two
        elif two is not None and key in _KEYS and not _same(key, one, two):
            raise InputError(
                f"says {key} = {two}, but {first.path} says {key} = {one}.",
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
        from meshreg.io.crs import crs_text

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


def _located(path: Path, shift: Any, crs: str | None) -> SidecarInfo:
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
    from meshreg.io.crs import parse_crs

    try:
        parse_crs(crs)
    except InputError as error:
        raise InputError(error.message, file=path, remedy=error.remedy) from error


def _read_offset(path: Path) -> SidecarInfo | None:
    """Read Pix4D's offset.xyz: three numbers, on one line or three.

    A longer list of numbers is a point cloud that happens to carry that name, and no sidecar.
    """
    lines = _filled(_lines(path))
    words = [word for _, line in lines for word in re.split(r"[\s,;]+", line) if word]
    if len(lines) > 3 or (len(words) > 3 and len(words) % 3 == 0):
        return None
    number = lines[0][0] if lines else 1
    return _located(path, _numbers(path, number, words, 3), None)


def _read_prj(path: Path) -> SidecarInfo:
    """Read a .prj: one CRS as WKT, of ESRI's kind or another."""
    return _located(path, None, " ".join(_lines(path)))


def _tell_rcinfo(path: Path) -> SidecarInfo:
    """Tell of RealityCapture's file: it holds the way to the model's CRS, in a form not published.

    https://rchelp.capturingreality.com/en-US/tools/export.htm
    """
    note = (
        f"{path.name} (RealityCapture) may say where the coordinates are, but is not read: if they "
        "are shifted, give the shift (--reference-shift, --moving-shift, or a .survey.toml)."
    )
    return SidecarInfo(notes=(note,))


def _read_shift_txt(path: Path) -> SidecarInfo:
    """Read Metashape's and 3DSC's SHIFT.txt: ``CRS X Y Z``."""
    lines = _filled(_lines(path))
    if not lines:
        raise InputError("is empty; expected 'CRS X Y Z'.", file=path)
    number, line = lines[0]
    words = line.replace(",", " ").split()
    crs = " ".join(words[:-3])
    named = crs.lower() not in ("", "none", "local")
    return _located(path, _numbers(path, number, words[-3:], 3), crs if named else None)


def _read_coords(path: Path) -> SidecarInfo:
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
    said = _located(path, (east, north, 0.0), lines[0][1])
    repeated = beside(path.parent, "proj.txt")
    return said if repeated is None else _join(said, _read_prj(repeated))


def _read_toml(path: Path) -> SidecarInfo:
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
    from meshreg.io.framing import UNITS

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
