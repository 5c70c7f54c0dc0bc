"""From one CRS to another: exact operations only, heights apart.

Heights pass through PROJ only where two different vertical datums are stated, because PROJ may
otherwise leave them as they are and say nothing (EPSG:4979 to 4326+5773 without its grid).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.io.frames.crs import (
    crs_name,
    horizontal_part,
    metres_up,
    outside_error,
    parse_crs,
    short,
    unbound,
    vertical_datum,
)
from meshreg.records import Float64

_CHUNK = 1_000_000  # points passed to PROJ at once
_WORST_ACCURACY = 10.0  # [m]; a change of datum that PROJ knows less well is refused


@dataclass(frozen=True, eq=False)
class Bridge:
    """The way from one CRS to another, for (N, 3) float64 points.

    Attributes
    ----------
    source, target : str
    transformer : pyproj.Transformer
    spatial : bool
        Heights take part; else they are multiplied by `factor` (unit and sign).
    changes_datum : bool
    lacking : str
        The better operation that is not installed; empty where this is the best one.
    """

    source: str
    target: str
    transformer: Any
    spatial: bool
    factor: float
    changes_datum: bool
    lacking: str = ""

    def forward(self, points: Any, *, back: bool = False) -> Float64:
        """Move points from `source` to `target`, or `back`.

        Raises
        ------
        InputError
            A point outside what either CRS can represent, or an operation known to worse than
            10 m.
        """
        points = np.asarray(points, float)
        moved: Float64 = np.empty_like(points)
        for start in range(0, len(points), _CHUNK):
            part = points[start : start + _CHUNK]
            moved[start : start + _CHUNK] = self._run(part, back)
            if start == 0:
                self._accuracy()
        return moved

    def _run(self, part: Float64, back: bool = False) -> Float64:
        import pyproj

        columns = part.T if self.spatial else part.T[:2]
        way = "INVERSE" if back else "FORWARD"
        try:
            result = self.transformer.transform(*columns, errcheck=True, direction=way)
        except pyproj.exceptions.ProjError as error:
            x, y = part.mean(axis=0)[:2]
            start = self.target if back else self.source
            raise outside_error(start, x, y, short(error)) from error
        # Far outside a projection PROJ may answer with infinity and no error.
        bad = ~np.isfinite(result).all(axis=0)
        if bad.any():
            x, y = part[bad][0, :2]
            start = self.target if back else self.source
            raise outside_error(start, x, y, f"{np.count_nonzero(bad)} points cannot be moved")
        moved: Float64 = np.empty_like(part)
        for axis, column in enumerate(result):
            moved[:, axis] = column
        if not self.spatial:
            moved[:, 2] = part[:, 2] / self.factor if back else part[:, 2] * self.factor
        return moved

    def note(self, point: Any) -> str:
        """Say by which operation the datum changes at a place; empty where it does not."""
        self._run(np.asarray(point, float).reshape(1, 3))
        name, accuracy = self._accuracy()
        if accuracy == 0:
            return ""
        return f"{short(name, 200)}, accuracy {accuracy:g} m{self.lacking}"

    def _accuracy(self) -> tuple[str, float]:
        """Return name and accuracy [m] of the operation last used; refuse one known too badly."""
        if not self.changes_datum:
            return "", 0.0
        operation = self.transformer.get_last_used_operation()
        name, accuracy = str(operation.description), float(operation.accuracy)
        if not 0 <= accuracy <= _WORST_ACCURACY:
            known = "unknown" if accuracy < 0 else f"{accuracy:g} m"
            raise InputError(
                f"the change from {crs_name(self.source)} to {crs_name(self.target)} is not known "
                f"well enough (accuracy {known}: {short(name)}).",
                remedy="Export both surveys in one CRS, or install the grid (projsync).",
            )
        return name, accuracy


@lru_cache(maxsize=64)
def bridge(source: str, target: str) -> Bridge:
    """Find the operation between two CRS; never a ballpark one.

    Heights keep their datum and only change unit and sign, except where both CRS state a vertical
    datum and the two differ: then PROJ must know the way in three dimensions, grids included.

    Raises
    ------
    InputError
        No operation, or one that needs a grid that is not installed.
    """
    import pyproj

    first, last = parse_crs(source), parse_crs(target)
    datums = vertical_datum(first), vertical_datum(last)
    geocentric = unbound(first).is_geocentric or unbound(last).is_geocentric
    spatial = geocentric or (None not in datums and datums[0] != datums[1])
    ends = (first, last) if spatial else (horizontal_part(first), horizontal_part(last))
    lacking = ""
    rules = {"always_xy": True, "allow_ballpark": False}
    try:
        try:
            transformer = pyproj.Transformer.from_crs(*ends, **rules, only_best=True)
        except pyproj.exceptions.ProjError as error:
            if spatial:
                raise
            transformer = pyproj.Transformer.from_crs(*ends, **rules)
            lacking = f"; a better operation is not installed: {short(error, 200)}"
    except pyproj.exceptions.ProjError as error:
        what = f"heights from {datums[0]} to {datums[1]}" if spatial else "coordinates"
        raise InputError(
            f"{what} cannot be taken from {crs_name(source)} to {crs_name(target)}: "
            f"{short(error, 200)}",
            remedy="Export both surveys in one CRS and vertical datum, or install the grid "
            "(projsync).",
        ) from error
    factor = 1.0 if spatial else metres_up(first) / metres_up(last)
    bases = [horizontal_part(crs).geodetic_crs for crs in (first, last) if not geocentric]
    changes = not geocentric and not bases[0].equals(bases[1], ignore_axis_order=True)
    return Bridge(source, target, transformer, spatial, factor, changes, lacking)
