"""III-D: scan the offsets for the one at which the two mosaics share most information.

With the joint histogram J of the two grey images over the overlap, divided by its count N, the
mutual information is ``H1 + H2 - H12`` (natural logarithm). Equation (2) of the paper is printed
with a minus before its last term, which would make it the joint entropy's negative twice over;
the sum of the marginal entropies less the joint one is meant and is computed here.

Counts for all offsets at once come from correlating the level sets ``[A = a]`` and ``[B = b]``
(Öfverstedt, Lindblad and Sladoje, Pattern Recognition Letters 159, 2022).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from meshreg.offsets.channels import grey, local_normalised
from meshreg.offsets.correlate import Correlator, Window, overlap_floor
from meshreg.offsets.error_bars import laid
from meshreg.offsets.surface import Peak, find_peak
from meshreg.records import Bool, Float64, SurveyRaster
from meshreg.settings import MutualInformationSettings, Settings

SINGLE_CELLS = 200_000


def scan(
    reference: SurveyRaster, moving: SurveyRaster, settings: Settings, window: Window
) -> tuple[Peak | None, float, Mapping[str, Any]]:
    """Score every offset in the window; return the peak, the information at it, the surface."""
    options, share = settings.mutual_information, settings.search.min_overlap
    first, second = (
        levels(raster, options.bins, options.high_pass) for raster in (reference, moving)
    )
    masks = reference.color_valid, moving.color_valid
    if options.direct:
        surface, counts = direct_surface(first, second, masks, window, share, options.bins)
        quality = surface
    else:
        surface, counts = fft_surface(first, second, masks, window, share, options.bins)
        quality = without_small_sample_bias(surface, counts) * counts
    peak = find_peak(quality, window.east, window.north, exclusion=window.exclusion(3))
    pairs = partial(_asked, reference, moving, (first, second), options)
    evidence = {"surface": surface, "lower_is_better": False, "counts": counts, "pairs": pairs}
    return peak, float(surface[peak.index]) if peak else float("nan"), evidence


def levels(raster: SurveyRaster, bins: int, high_pass: float) -> Any:
    """(H, W) uint8 level of each cell, under `bins`.

    `high_pass` 0 is the paper's raw grey in equal bins of 0-255. Otherwise the grey is locally
    normalised (sigma in metres) and cut at its own quantiles, so that all levels are used.
    """
    field = grey(raster)
    if high_pass <= 0:
        return np.minimum(np.rint(field) * bins // 256, bins - 1).astype(np.uint8)
    mask = raster.color_valid
    sigma = max(high_pass / raster.grid.cell, 2.0)
    field = local_normalised(field, mask, sigma)
    if not mask.any():
        return np.zeros(field.shape, np.uint8)
    edges = np.quantile(field[mask], np.linspace(0, 1, bins + 1)[1:-1])
    return np.searchsorted(edges, field, side="right").astype(np.uint8)


def direct_surface(
    first: Any,
    second: Any,
    masks: tuple[Bool, Bool],
    window: Window,
    min_overlap: float,
    bins: int,
) -> tuple[Float64, Float64]:
    """Count each offset's joint histogram cell by cell (the paper's way)."""
    from meshreg.offsets.kernels import direct_information

    correlator = Correlator(window)
    counts = correlator.counts(*(correlator.transform(mask) for mask in masks))
    scored = overlap_floor(counts, min_overlap)
    a = np.where(masks[0], first.astype(np.int16), bins)
    b = np.where(masks[1], second.astype(np.int16), bins)
    surface = direct_information(a, b, window.rows, window.cols, scored, bins)
    return np.where(scored, surface, np.nan), counts


def fft_surface(
    first: Any,
    second: Any,
    masks: tuple[Bool, Bool],
    window: Window,
    min_overlap: float,
    bins: int,
) -> tuple[Float64, Float64]:
    """Return the same surface from the correlations of all pairs of level sets.

    ``MI = (sum n_ab ln n_ab - sum n_a ln n_a - sum n_b ln n_b) / N + ln N``, with the marginal
    counts n_a, n_b taken over the overlap too. Counts are whole numbers, so a transform need only
    be right to under a half: float32 is, for level sets of up to `SINGLE_CELLS` cells (its error
    grows as 1e-7 times the geometric mean of the two sets' sizes and the logarithm of the image).
    """
    exact = Correlator(window)
    counts = exact.counts(*(exact.transform(mask) for mask in masks))
    scored = overlap_floor(counts, min_overlap)
    sets1 = [(first == level) & masks[0] for level in range(bins)]
    sets2 = [(second == level) & masks[1] for level in range(bins)]
    n = np.maximum(counts, 1.0)
    information = _sum_of_n_log_n(sets1, sets2, window) / n + np.log(n)
    return np.where(scored, information, np.nan), counts


def _sum_of_n_log_n(sets1: list[Bool], sets2: list[Bool], window: Window) -> Float64:
    """``sum n_ab ln n_ab - sum n_a ln n_a - sum n_b ln n_b`` for each offset.

    The sets of each image are disjoint and fill its mask, so the marginal counts over the overlap
    are sums of the joint ones. Logarithms come from a table.
    """
    from meshreg.offsets.kernels import add_entropies, subtract_marginals

    largest = max(int(members.sum()) for members in (*sets1, *sets2))
    correlator = Correlator(window, single=largest <= SINGLE_CELLS)
    table = _n_log_n(np.arange(largest + 1, dtype=np.float64))
    conjugates = np.stack([np.conj(correlator.transform(members)) for members in sets2])
    cols = window.cols % window.padded[1]
    total = np.zeros((len(window.rows), len(cols)))
    marginal = np.zeros((len(window.rows), len(cols), len(sets2)), np.int32)
    product = np.empty_like(conjugates)
    for members in sets1:
        np.multiply(correlator.transform(members), conjugates, out=product)
        add_entropies(total, marginal, correlator.rows_back(product), cols, table)
    subtract_marginals(total, marginal, table)
    return total


def without_small_sample_bias(surface: Float64, counts: Float64) -> Float64:
    """Subtract what unrelated images of this size would show: a multiple of 1/N.

    The plain estimate exceeds the truth by about (cells filled)/2N, which favours small
    overlaps; with correlated pixels the multiple is larger, so it is fitted: the median of
    ``MI * N`` over the window, since all but a few offsets are unrelated.
    """
    finite = np.isfinite(surface)
    if not finite.any():
        return surface
    multiple = float(np.median((surface * counts)[finite]))
    return surface - multiple / np.maximum(counts, 1.0)


def _asked(
    reference: SurveyRaster,
    moving: SurveyRaster,
    sets: tuple[Any, Any],
    options: MutualInformationSettings,
    shift: tuple[int, int],
) -> list[tuple[Float64, Float64]]:
    """Return what blocks are asked with: raw grey, hundreds of levels are too much for them."""
    bins = options.bins
    if options.high_pass <= 0 or bins > 32:
        plain = MutualInformationSettings()
        bins = plain.bins
        sets = levels(reference, bins, plain.high_pass), levels(moving, bins, plain.high_pass)
    return block_fields(*sets, (reference.color_valid, moving.color_valid), shift, bins)


def block_fields(
    first: Any, second: Any, masks: tuple[Bool, Bool], shift: tuple[int, int], bins: int
) -> list[tuple[Float64, Float64]]:
    """Fields whose products add up to the information that the images share at a shift.

    To first order the information of a cell with levels a, b is ``p_ab / (p_a p_b) - 1``, which
    correspondence analysis takes apart into products of one function of a and one of b (Greenacre,
    Theory and Applications of Correspondence Analysis, 1984, chapter 4): brightness first, then
    contrast. The two strongest are kept; the rest is noise in a block.
    """
    under = laid(first, shift, second.shape, 0)
    both = laid(masks[0], shift, second.shape, 0) & masks[1]
    joint = np.bincount(under[both].astype(int) * bins + second[both], minlength=bins * bins)
    share = joint.reshape(bins, bins) / max(int(joint.sum()), 1)
    rows, cols = share.sum(axis=1), share.sum(axis=0)
    roots = np.sqrt(np.maximum(rows, 1e-12)), np.sqrt(np.maximum(cols, 1e-12))
    left, sizes, right = np.linalg.svd((share - np.outer(rows, cols)) / np.outer(*roots))
    pairs = []
    for k in (0, 1):
        a = np.where(masks[0], (sizes[k] * left[:, k] / roots[0])[first], 0.0)
        pairs.append((a, np.where(masks[1], (right[k] / roots[1])[second], 0.0)))
    return pairs


def _n_log_n(counts: Float64) -> Float64:
    from scipy.special import xlogy

    return np.asarray(xlogy(counts, counts))
