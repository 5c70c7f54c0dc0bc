"""Coordinates that went through 32-bit numbers at large values: told, or refused where spoilt."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.records import Float64

_EXPORT = "Export it in local coordinates with a shift, or with 64-bit numbers."
_COLLAPSED = 0.02  # share of points fallen together from which 32-bit steps have spoilt a survey


def single_precision_note(
    path: Path, xyz: Any, ends: Float64, detail: Callable[[], float | None] | None
) -> tuple[str, ...]:
    """Find coordinates that went through 32-bit numbers at large values; refuse spoilt ones.

    Float32 steps by 0.5 m at a UTM northing. A file is refused when its points fell together on
    such steps, or when these tear a texture apart by over a quarter of its pixels; regular grids,
    which happen to be representable, keep their points apart.
    """
    step = float(np.spacing(np.abs(ends[:, :2]).max().astype(np.float32)))
    if step < 1e-3:
        return ()
    sample = np.asarray(xyz[:: max(1, len(xyz) // 200_000), :2], float)
    with np.errstate(over="ignore"):
        if not (sample.astype(np.float32) == sample).all():
            return ()
    share = 1 - len(np.unique(sample, axis=0)) / len(sample)
    if share > _COLLAPSED and len(sample) > 100:
        raise InputError(
            f"has lost its coordinates to 32-bit numbers: they step by {step:.3g} m, and "
            f"{share:.0%} of the points coincide with another.",
            file=path,
            remedy=_EXPORT,
        )
    pixel = detail() if detail is not None else None
    coarse = step if pixel is None or step <= pixel / 4 else _rounding(sample)
    if pixel is not None and coarse > pixel / 4:
        raise InputError(
            f"has lost its coordinates to 32-bit numbers: they step by {coarse:.3g} m, but its "
            f"texture's pixels are {pixel:.3g} m.",
            file=path,
            remedy=_EXPORT,
        )
    return (f"Coordinates are 32-bit numbers that step by {step:.3g} m.",)


def _rounding(sample: Float64) -> float:
    """Return the largest step that float32 rounded a column (N, 2) to; none on a coarser grid."""
    steps = [0.0]
    for column in sample.T:
        step = float(np.spacing(np.abs(column).max().astype(np.float32)))
        values = np.unique(column)
        if len(values) > 1 and np.diff(values).min() < 1.5 * step:
            steps.append(step)
    return max(steps)
