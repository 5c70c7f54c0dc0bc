"""III-C: scan the offsets for the one at which the two DEMs agree best.

The paper's cost over the N cells of the overlap is

    c(x, y) = (1/N) sum (z1 - z2)² / (s1 s2)

with s1, s2 the standard deviations of each DEM within the overlap; the paper's (x, y) are north
and east. Expanding the square, ``c = s1/s2 + s2/s1 - 2 rho + (m1 - m2)²/(s1 s2)``: correlation
plus a penalty on differing spread and one on a vertical bias, which on flat ground swamps the
rest. The robust preset correlates high-passed heights at several scales instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from meshreg.offsets.channels import high_pass
from meshreg.offsets.correlate import Correlator, Window, overlap_floor
from meshreg.offsets.surface import Peak, find_peak
from meshreg.records import Float64, SurveyRaster
from meshreg.settings import Settings, TerrainSettings

FLAT = 1e-6  # smallest s1 * s2 that is divided by [m²]


def scan(
    reference: SurveyRaster, moving: SurveyRaster, settings: Settings, window: Window
) -> tuple[Peak | None, float, Mapping[str, Any]]:
    """Score every offset in the window; return the peak, the score at it, and the surface.

    The score is the paper's cost (lower is better) or, high-passed, the mean correlation
    coefficient of the scales (higher is better).
    """
    share = settings.search.min_overlap
    if settings.terrain.high_pass:
        surface, counts = correlation_surface(
            reference, moving, window, share, settings.terrain.high_pass
        )
        quality = surface * np.sqrt(counts)  # chance correlation shrinks as 1/sqrt(N)
    else:
        surface, counts = cost_surface(reference, moving, window, share)
        quality = -surface
    peak = find_peak(quality, window.east, window.north, exclusion=window.exclusion(3))
    scales = settings.terrain.high_pass or TerrainSettings().high_pass
    evidence = {
        "pairs": lambda _: block_fields(reference, moving, scales),
        "surface": surface,
        "lower_is_better": not settings.terrain.high_pass,
        "counts": counts,
    }
    return peak, float(surface[peak.index]) if peak else float("nan"), evidence


def cost_surface(
    reference: SurveyRaster, moving: SurveyRaster, window: Window, min_overlap: float
) -> tuple[Float64, Float64]:
    """III-C's cost for each offset, exactly, by six masked correlations.

    Returns
    -------
    cost : (K, L) float64
        NaN where the overlap is under `min_overlap` of the largest, or flat.
    counts : (K, L) float64
        Cells in the overlap.
    """
    first, second = absolute_heights(reference, moving)
    correlator = Correlator(window)
    m1 = correlator.transform(reference.valid)
    m2 = correlator.transform(moving.valid)
    z1, z2 = correlator.transform(first), correlator.transform(second)
    q1, q2 = correlator.transform(first**2), correlator.transform(second**2)
    counts = correlator.counts(m1, m2)
    n = np.maximum(counts, 1.0)
    mean1, mean2 = correlator.sums((z1, m2)) / n, correlator.sums((m1, z2)) / n
    square1, square2 = correlator.sums((q1, m2)) / n, correlator.sums((m1, q2)) / n
    cross = correlator.sums((z1, z2)) / n
    spread = np.sqrt(np.maximum(square1 - mean1**2, 0.0) * np.maximum(square2 - mean2**2, 0.0))
    scored = overlap_floor(counts, min_overlap) & (spread >= FLAT)
    cost = np.full(counts.shape, np.nan)
    np.divide(square1 + square2 - 2 * cross, spread, out=cost, where=scored)
    return cost, counts


def correlation_surface(
    reference: SurveyRaster,
    moving: SurveyRaster,
    window: Window,
    min_overlap: float,
    scales: tuple[float, ...],
) -> tuple[Float64, Float64]:
    """Mean over the scales of the correlation of high-passed heights, for each offset."""
    correlator = Correlator(window)
    first, second = absolute_heights(reference, moving)
    m1, m2 = correlator.transform(reference.valid), correlator.transform(moving.valid)
    counts = correlator.counts(m1, m2)
    scored = overlap_floor(counts, min_overlap)
    total = np.zeros(counts.shape)
    for sigma in scales:
        a = high_pass(first, reference.valid, sigma)
        b = high_pass(second, moving.valid, sigma)
        cross = correlator.sums((correlator.transform(a), correlator.transform(b)))
        power1 = correlator.sums((correlator.transform(a**2), m2))
        power2 = correlator.sums((m1, correlator.transform(b**2)))
        power = np.sqrt(np.maximum(power1, 0.0) * np.maximum(power2, 0.0))
        scored &= power > FLAT * 1e-6 * np.maximum(counts, 1.0)
        total += np.divide(cross, power, out=np.zeros_like(cross), where=power > 0)
    return np.where(scored, total / len(scales), np.nan), counts


def block_fields(
    reference: SurveyRaster, moving: SurveyRaster, scales: tuple[float, ...]
) -> list[tuple[Float64, Float64]]:
    """High-passed heights of both at each scale, of unit length: what the blocks are asked with.

    The paper's raw heights too: within a block a slope of the warp would pass for an offset.
    """
    pairs = []
    first, second = absolute_heights(reference, moving)
    for sigma in scales:
        a, b = high_pass(first, reference.valid, sigma), high_pass(second, moving.valid, sigma)
        length = float(np.linalg.norm(a) * np.linalg.norm(b))
        pairs.append((a / max(length, 1e-300), b))
    return pairs


def absolute_heights(reference: SurveyRaster, moving: SurveyRaster) -> tuple[Float64, Float64]:
    """Heights [m] of both less one common constant (never one each: it would hide their bias)."""
    constant = reference.datum
    if reference.valid.any():
        constant += float(np.mean(reference.height[reference.valid], dtype=np.float64))
    pair = []
    for raster in (reference, moving):
        height = raster.height.astype(np.float64) + (raster.datum - constant)
        pair.append(np.where(raster.valid, height, 0.0))
    return pair[0], pair[1]
