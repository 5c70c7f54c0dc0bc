"""The slow readable twin of `meshreg.io.maps.regrid_kernels`: NumPy, a whole raster at once."""

from __future__ import annotations

import numpy as np


def sample(values, valid, matrix, x, y):
    """Return bilinear values (..., K) at file positions and whether the nearest pixel is valid."""
    rows, cols = valid.shape
    back = np.linalg.inv(matrix[:, :2])
    col, row = np.tensordot(back, np.stack([x, y]) - matrix[:, 2, None, None], 1) - 0.5
    near_row, near_col = np.rint(row), np.rint(col)
    inside = (near_row >= 0) & (near_row < rows) & (near_col >= 0) & (near_col < cols)
    ok = np.zeros(x.shape, bool)
    ok[inside] = valid[near_row[inside].astype(int), near_col[inside].astype(int)]
    row, col = row[ok], col[ok]
    top, left = np.floor(row).astype(int), np.floor(col).astype(int)
    total, weight = np.zeros((len(row), values.shape[2])), np.zeros((len(row), 1))
    for down in (0, 1):
        for right in (0, 1):
            r, c = np.clip(top + down, 0, rows - 1), np.clip(left + right, 0, cols - 1)
            share = np.abs(1 - down - (row - top)) * np.abs(1 - right - (col - left))
            share = (share * valid[r, c])[:, None]
            weight += share
            total += share * np.where(share > 0, values[r, c], 0)  # NaN times nothing is nothing
    out = np.zeros((*x.shape, values.shape[2]))
    out[ok] = total / weight
    return out, ok


def resample(values, valid, placed, source, surface, surface_placed, is_height):
    """Return what the kernel puts into `out` and `seen`, from a `meshreg.io.maps.regrid.Source`."""
    shape = source.grid.shape
    row, col = (np.arange(n) / source.step for n in shape)
    upper, left = row.astype(int), col.astype(int)
    down, right = (row - upper)[:, None, None], (col - left)[None, :, None]
    band = source.nodes[upper] * (1 - down) + source.nodes[upper + 1] * down
    x, y, up = np.moveaxis(band[:, left] * (1 - right) + band[:, left + 1] * right, 2, 0)
    height = np.full(shape, placed.level)
    if surface is not None:
        for _ in range(4):
            lift = height - placed.level
            there = x + source.lean[0] * lift, y + source.lean[1] * lift
            if _ < 3:
                found, known = sample(
                    surface[..., None], np.isfinite(surface), surface_placed.matrix, *there
                )
                height = np.where(known, found[..., 0], height)
        x, y = there
    out, seen = sample(values, valid, placed.matrix, x, y)
    if is_height:
        out = up[..., None] + source.gain * (out - placed.level)
        out[~seen] = np.nan
    return (np.rint(out) if values.dtype == np.uint8 else out).astype(values.dtype), seen
