"""How many times as high the moving survey's relief is as the reference's: feet, exaggeration.

Terrain is matched whatever it is multiplied by, so that heights in feet, or exaggerated for a
picture, would be laid down as well as true ones. The relief that recurs tells the factor: ground
that is the same has the same heights at every width, while growth, loss and smoothing change some
widths more than others. Relief that recurs upside down is that of a file whose heights are depths.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from meshreg.height.dem_pair import LEAST_RECURRING, DemPair
from meshreg.records import Bool, Float64, Gain, Transform

WIDTHS = (1.0, 2.0, 4.0, 8.0)  # cells: relief between each and the next is compared
RECURS = 0.6  # correlation of relief around a cell that recurs
LEAST_BLOCKS = 4
MOST_CELLS = 4_000_000  # beyond it every second row and column is left out, and so on
UNKNOWN = 0.3  # sigma of the logarithm from which a width tells nothing
# Unlike ground is alike by chance as often as it is alike upside down, so that the one count
# measures how much of the other is chance.
BEYOND_CHANCE = 3.0
INVERTED = 0.25  # of the cells of all widths alike upside down: chance makes a tenth


def relief_gain(pair: DemPair, transform: Transform, most: float = 0.1) -> Gain:
    """Estimate the gain from what recurs of the relief, at each of three widths.

    With errors in both surveys the slope of a regression lies between that of one on the other
    and the inverse of the reverse; in the middle, geometrically, is the ratio of the standard
    deviations (reduced major axis: Isobe et al., Astrophysical Journal 364, 1990). What lies
    between is in sigma as an even distribution, beside the scatter of blocks.

    Parameters
    ----------
    pair : DemPair
    transform : Transform
        `reference_from_moving`.
    most : float
        A gain nearer to 1 than this does not depart from it.
    """
    widths = list(_at_widths(pair, transform))
    upright, inverted = np.mean([(w.upright, w.inverted) for w in widths or [_Width(None)]], axis=0)
    if inverted >= max(INVERTED, BEYOND_CHANCE * upright):
        return Gain(inverted=True)
    found = [width.told for width in widths if width.told is not None and width.told[1] < UNKNOWN]
    if not found:
        return Gain()
    value, sigma = min(found, key=lambda told: told[1])
    logs = np.array(found)
    far = np.abs(logs[:, 0]) > np.maximum(3 * logs[:, 1], np.log1p(most))
    departs = bool(far.all() and abs(np.sign(logs[:, 0]).sum()) == len(logs))
    return Gain(float(np.exp(value)), float(sigma), departs)


@dataclass(frozen=True)
class _Width:
    told: tuple[float, float] | None  # logarithm of the gain and its sigma, where relief recurs
    upright: float = 0.0  # share of the cells that are alike
    inverted: float = 0.0  # that are alike upside down


def _at_widths(pair: DemPair, transform: Transform) -> Iterator[_Width]:
    """Compare the relief of each width with that of the other survey."""
    if not pair.row.size:
        return
    difference, points = pair.differences(transform)
    known = np.zeros(pair.moving.grid.shape, bool)
    known[pair.row, pair.col] = True
    maps = np.zeros((2, *known.shape))
    maps[:, pair.row, pair.col] = points[:, 2] + difference, points[:, 2]
    maps -= np.where(known, np.median(maps[:, known], axis=1)[:, None, None], 0.0)
    step = int(np.ceil(np.sqrt(known.size / MOST_CELLS)))
    if step > 1:
        known, maps = known[::step, ::step], maps[:, ::step, ::step]
    coarser = None
    for width in reversed(WIDTHS):
        smoothed = _smoothed(maps, known, width)
        if coarser is not None:
            first, second = smoothed - coarser
            yield _of_relief(first, second, known, 2 * width)
        coarser = smoothed


def _smoothed(maps: Float64, known: Bool, width: float) -> Float64:
    from scipy.ndimage import gaussian_filter

    weight = np.maximum(gaussian_filter(known.astype(np.float64), width, truncate=3.0), 1e-6)
    return np.where(
        known, [gaussian_filter(part, width, truncate=3.0) / weight for part in maps], 0.0
    )


def _of_relief(first: Float64, second: Float64, known: Bool, width: float) -> _Width:
    """Ratio of second to first where they are alike."""
    from scipy.ndimage import uniform_filter

    def around(products: Float64) -> Float64:
        side = 2 * round(1.5 * width) + 1
        return np.asarray(uniform_filter(products, side, mode="constant"))

    size = around(first**2).clip(0) * around(second**2).clip(0)
    alike = np.divide(
        around(first * second), np.sqrt(size), out=np.zeros_like(first), where=size > 0
    )
    row, col = np.nonzero(known & (alike >= RECURS))
    upside_down = int(np.count_nonzero(known & (alike <= -RECURS)))
    count = max(int(np.count_nonzero(known)), 1)
    shares = row.size / count, upside_down / count
    if row.size <= max(BEYOND_CHANCE * upside_down, LEAST_RECURRING * count):
        return _Width(None, *shares)
    side = max(8, int(4 * width))
    _, number = np.unique((row // side) * known.shape[1] + col // side, return_inverse=True)
    a, b = first[row, col], second[row, col]
    power, other, both = (np.bincount(number, p) for p in (a * a, b * b, a * b))
    if len(power) < LEAST_BLOCKS or min(power.sum(), other.sum()) <= 0:
        return _Width(None, *shares)
    value = 0.5 * float(np.log(other.sum() / power.sum()))
    alike_all = float(np.clip(both.sum() / np.sqrt(power.sum() * other.sum()), 1e-3, 1.0))
    between = -np.log(alike_all) / np.sqrt(3)
    apart = 0.5 * (other / other.sum() - power / power.sum())
    scatter = float((apart**2).sum()) * len(power) / (len(power) - 1)
    return _Width((value, float(np.hypot(between, np.sqrt(scatter)))), *shares)
