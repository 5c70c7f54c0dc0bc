"""How widely numbers scatter, whatever some of them are."""

from __future__ import annotations

import numpy as np

from meshreg.records import Float64

MAD_TO_SIGMA = 1.4826


def nmad(values: Float64) -> float:
    """Normalised median absolute deviation (Höhle and Höhle 2009, section 3.2)."""
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))


def half_scale(values: Float64) -> float:
    """Return the standard deviation that the shortest half of the values tells.

    Of normal values it is their sigma; of two groups that of the larger one, where the median
    absolute deviation tells how far they lie apart. Rousseeuw and Leroy (1987), chapter 4.
    """
    ordered = np.sort(values)
    _, shortest = densest(ordered, (len(ordered) + 1) // 2)
    return shortest / 1.349  # the quartiles of a normal distribution lie so far apart


def densest(ordered: Float64, count: int) -> tuple[int, float]:
    """Return where the shortest run of `count` of sorted values begins, and how long it is."""
    width = ordered[count - 1 :] - ordered[: len(ordered) - count + 1]
    at = int(np.argmin(width))
    return at, float(width[at])
