"""Array types, and arrays in records: of a stated type and shape, and read-only."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import UsageError

Float64 = NDArray[np.float64]

Float32 = NDArray[np.float32]

Int32 = NDArray[np.int32]

UInt8 = NDArray[np.uint8]

Bool = NDArray[np.bool_]

NOTHING: Mapping[Any, Any] = MappingProxyType({})


def frozen(array: Any, dtype: Any, shape: tuple[int | None, ...], name: str) -> Any:
    """Return `array` as a read-only view of the stated type, or say which shape was expected."""
    array = np.ascontiguousarray(array, dtype=dtype)
    fits = array.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        want = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
        raise UsageError(f"{name} has shape {array.shape}; expected {want}.")
    array = array.view()
    array.flags.writeable = False
    return array


def ends(points: Float64) -> Float64:
    """(2, 3) float64: lowest and highest coordinates; by columns, which is ten times as fast."""
    columns = points.T
    return np.array([[c.min() for c in columns], [c.max() for c in columns]])


def put(record: Any, name: str, value: Any) -> None:
    """Set a field of a frozen record, while it is made."""
    object.__setattr__(record, name, value)
