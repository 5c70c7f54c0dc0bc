"""Slow readable twins of the exhaustive searches: one offset at a time, straight from the paper."""

from __future__ import annotations

import numpy as np


def overlap(first, mask1, second, mask2, shift_row, shift_col):
    """Values of both rasters where both know something, the second shifted by whole cells."""
    rows, cols = np.nonzero(mask2)
    r, c = rows + shift_row, cols + shift_col
    inside = (r >= 0) & (r < mask1.shape[0]) & (c >= 0) & (c < mask1.shape[1])
    rows, cols, r, c = rows[inside], cols[inside], r[inside], c[inside]
    both = mask1[r, c]
    return first[r[both], c[both]], second[rows[both], cols[both]]


def terrain_cost(z1, z2):
    """Section III-C: mean squared difference over the product of standard deviations."""
    return float(np.mean((z1 - z2) ** 2) / (np.std(z1) * np.std(z2)))


def correlation(a, b):
    """Correlation about zero: sum(ab) / sqrt(sum(a²) sum(b²))."""
    return float(np.sum(a * b) / np.sqrt(np.sum(a * a) * np.sum(b * b)))


def mutual_information(a, b, bins):
    """Section III-D, equation (2) with the sign that is meant: H1 + H2 - H12 (nat)."""
    joint = np.zeros((bins, bins))
    for i, j in zip(a, b, strict=True):
        joint[int(i), int(j)] += 1
    joint /= joint.sum()

    def entropy(p):
        p = p[p > 0]
        return -float(np.sum(p * np.log(p)))

    return entropy(joint.sum(axis=1)) + entropy(joint.sum(axis=0)) - entropy(joint.ravel())


def scan(first, mask1, second, mask2, rows, cols, floor_share, measure):
    """`measure` at every offset whose overlap is at least `floor_share` of the largest."""
    counts = np.zeros((len(rows), len(cols)))
    surface = np.full(counts.shape, np.nan)
    for i, row in enumerate(rows):
        for j, col in enumerate(cols):
            a, _ = overlap(first, mask1, second, mask2, row, col)
            counts[i, j] = len(a)
    floor = max(floor_share * counts.max(), 1)
    for i, row in enumerate(rows):
        for j, col in enumerate(cols):
            if counts[i, j] >= floor:
                surface[i, j] = measure(*overlap(first, mask1, second, mask2, row, col))
    return surface, counts
