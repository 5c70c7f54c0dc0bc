"""What every reader of other programs' points needs: what is known of the surveys, and cells."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from meshreg.errors import UsageError
from meshreg.records import Float64
from meshreg.ties.records import Point
from meshreg.ties.table import number

KNOWN = (
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
class Named:
    """Points of one survey by name; `second` are those of the other survey in the same file."""

    first: Mapping[str, Point]
    second: Mapping[str, Point]
    notes: tuple[str, ...] = ()


def first_of(header: Sequence[str], names: Sequence[str]) -> str | None:
    """Return the first of some column names that a table has."""
    return next((name for name in names if name in header), None)


def place(
    path: Path, line: int, row: Mapping[str, str], columns: tuple[str | None, str | None]
) -> Point | None:
    """Return the point in two columns of a line; None where it is not given."""
    x, y = columns
    if x is None or y is None or not (row[x].strip() and row[y].strip()):
        return None
    return number(path, line, row[x], x), number(path, line, row[y], y)


def metres(points: Mapping[str, Point], side: str, context: Context) -> dict[str, Point]:
    """Take pixels of a survey's orthomosaic to its coordinates."""
    if not points:
        return {}
    if side not in context.pixels:
        raise UsageError(
            f"The points of the {side} survey are pixels of an orthomosaic that is not known.",
            remedy="Name both with --reference-ortho and --moving-ortho.",
        )
    flat = context.pixels[side](np.array(list(points.values()), float))
    return dict(zip(points, ((float(e), float(n)) for e, n in flat), strict=True))
