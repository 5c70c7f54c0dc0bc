"""Make a `Frame` of what the user, a sidecar, the format and the file say."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.errors import InputError, UsageError
from meshreg.io.frames.axes import ENU, NED, UNITS, Y_UP
from meshreg.io.frames.crs import (
    check_area,
    crs_name,
    crs_text,
    metres_per_unit,
    metric_crs,
    parse_crs,
)
from meshreg.io.frames.sidecar import SidecarInfo
from meshreg.io.options import UNIT_RANGE, ReadOptions
from meshreg.records import Float64, Frame
from meshreg.settings.checked import shown


def frame_from(
    options: ReadOptions,
    sidecar: SidecarInfo | None = None,
    file_crs: str | None = None,
    default_axes: Any = None,
    *,
    centre: Any = None,
) -> Frame:
    """Join what the user, the sidecar and the file say into one `Frame`.

    Parameters
    ----------
    options : ReadOptions
        What the user says; it replaces what the sidecar says, item by item.
    sidecar : SidecarInfo or None
    file_crs : str or None
        CRS found in the file itself, any spelling.
    default_axes : (3, 3) array or None
        Axes of the format where nobody says otherwise; `Y_UP` for glTF, else x east, y north, up.
    centre : (3,) array or None
        Centre of the file's coordinates, as stored. Needed wherever a CRS is known, to check its
        area and to choose a UTM zone for degrees and feet; without it the CRS must be metric.

    Returns
    -------
    Frame
        `shift` is in metres, or in the CRS's own unit where that is feet or degrees.

    Raises
    ------
    UsageError
        Unknown axes or unit, or both `axes` and `up`.
    InputError
        Unknown CRS, two that disagree, or coordinates outside its area.
    """
    said = sidecar or SidecarInfo()
    crs = _file_crs(options, said, file_crs)
    axes = _axes(options, said, default_axes)
    unit = options.unit if options.unit is not None else said.unit
    if unit is not None:
        axes = axes * (_unit(unit) / (metres_per_unit(crs) if crs else 1.0))
    shift = np.array(options.shift if options.shift is not None else said.shift or (0, 0, 0), float)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise UsageError(f"shift is {shift.tolist()}; it needs three finite numbers.")
    if crs is None:
        return Frame(axes, shift, local=_local(options.crs or said.crs or file_crs))
    if centre is None:
        raise UsageError("The centre of the coordinates is needed to place them in their CRS.")
    place = axes @ np.asarray(centre, float) + shift
    check_area(crs, *place)
    return Frame(axes, shift, crs, metric_crs(crs, place))


def _local(crs: str | None) -> str | None:
    """Return a local (engineering) CRS as WKT; None where no CRS is stated at all."""
    return None if crs is None else str(parse_crs(crs).to_wkt())


def _file_crs(options: ReadOptions, said: SidecarInfo, file_crs: str | None) -> str | None:
    """Decide on the CRS: the user's, else our own sidecar's, else the file's or another sidecar's.

    A .prj, coords.txt or SHIFT.txt that contradicts the file is refused: one of them is stale.
    """
    own = crs_text(file_crs) if file_crs else None
    beside = crs_text(said.crs) if said.crs else None
    if options.crs:
        return crs_text(options.crs)
    if own and beside and own != beside and not said.explicit_crs:
        raise InputError(
            f"the file says {crs_name(own)}, but {said.crs_path} says {crs_name(beside)}.",
            remedy="Remove the wrong one, or say which by a .survey.toml.",
        )
    return beside or own


def _axes(options: ReadOptions, said: SidecarInfo, default: Any) -> Float64:
    axes: Any = said.axes
    up: Any = said.up
    if options.axes is not None or options.up is not None:
        axes, up = options.axes, options.up
    if axes is not None and not isinstance(axes, str):
        return np.array(axes, float)
    if axes == "ned" and up == "y":
        raise UsageError('axes="ned" and up="y" contradict each other.', remedy="Give one.")
    if axes not in (None, "enu", "ned") or up not in (None, "y", "z"):
        raise UsageError(f'axes is {axes!r} and up {up!r}; use "enu" or "ned", "y" or "z".')
    if axes == "ned":
        return NED.copy()
    if up == "y":
        return Y_UP.copy()
    if axes is None and up is None and default is not None:
        return np.array(default, float)
    return ENU.copy()


def _unit(unit: str | float) -> float:
    """Return the length of a unit [m]; a number, or its text, is taken as metres itself."""
    try:
        named = UNITS.get(unit.strip().lower()) if isinstance(unit, str) else None
        length = float(unit) if named is None else named
    except (ValueError, OverflowError):
        length = None
    if length is None or not UNIT_RANGE[0] <= length <= UNIT_RANGE[1]:
        low, high = UNIT_RANGE
        raise UsageError(
            f"unit {shown(unit)} is not known.",
            remedy=f"Use one of {', '.join(UNITS)}, or metres, from {low:g} to {high:g}.",
        )
    return length
