"""Extra dimensions of a LAS file that have a direction: normals, tangents, quaternions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.io.frames.directions import Directions, find_directions, stored, turn_columns
from meshreg.io.frames.mover import Mover
from meshreg.records import Float64


def extra_directions(point_format: Any) -> Directions:
    """Find the directions among the extra dimensions of a laspy point format.

    An element of a dimension that is an array goes by the dimension's name and its number.
    """
    names, fixed = [], []
    for item in point_format.extra_dimensions:
        labels = _labels(item)
        names += labels
        if item.kind.name == "UnsignedInteger" and not item.is_scaled:
            fixed += labels
    return find_directions(names, fixed=fixed)


def turn_extra(
    found: Directions, move: Mover, chunk: Any, rows: NDArray[Any], points: Float64
) -> None:
    """Turn the extra dimensions of a chunk of points; `rows` are the raw records to be changed."""
    if not found.columns:
        return
    places = {
        label: (item, k)
        for item in chunk.point_format.extra_dimensions
        for k, label in enumerate(_labels(item))
    }
    columns = {}
    for label in found.columns:
        item, k = places[label]
        values = np.asarray(chunk[item.name], float)
        columns[label] = values if values.ndim == 1 else values[:, k]
    for label, turned in turn_columns(found, move, points, columns).items():
        item, k = places[label]
        raw = turned
        if item.is_scaled:
            raw = (turned - np.ravel(item.offsets)[k]) / np.ravel(item.scales)[k]
        field = rows[item.name]
        if field.ndim == 1:
            field[:] = stored(raw, field.dtype)
        else:
            field[:, k] = stored(raw, field.dtype)


def _labels(item: Any) -> list[str]:
    count = int(item.num_elements)
    return [item.name] if count == 1 else [f"{item.name} {k}" for k in range(count)]
