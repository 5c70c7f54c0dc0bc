"""Pictures small enough to travel inside a page: shrunk, colored, encoded within a given size."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from meshreg.records import Float64, SurveyRaster, UInt8

SIDE = 2048  # longest side of a picture in the page
# What is tried until a picture fits: its share of the longest side, and the encoder's quality.
_LADDER = (
    (1.0, 84), (1.0, 72), (1.0, 58), (0.71, 72), (0.71, 55), (0.5, 65), (0.5, 45), (0.35, 45),
    (0.25, 40), (0.18, 35), (0.12, 30),
)  # fmt: skip


def shrunk(raster: SurveyRaster, side: int = SIDE) -> UInt8:
    """Return (h, w, 4) uint8 of the colors, area means; transparent where nothing was seen."""
    from PIL import Image

    rows, cols = raster.grid.shape
    scale = min(1.0, side / max(rows, cols))
    color, seen = raster.color, raster.color_valid.astype(np.uint8) * np.uint8(255)
    if scale == 1.0:
        return np.dstack([color, seen])
    size = max(1, round(cols * scale)), max(1, round(rows * scale))
    box = Image.Resampling.BOX
    mean = np.asarray(Image.fromarray(np.ascontiguousarray(color)).resize(size, box), np.float32)
    share = np.asarray(Image.fromarray(seen).resize(size, box), np.float32)
    # Unseen cells are zero, so that the mean is too dark by the share that was seen.
    mean *= 255.0 / np.maximum(share, 1.0)[..., None]
    return np.dstack([np.clip(np.round(mean), 0, 255), np.round(share)]).astype(np.uint8)


def grey(values: Float64) -> UInt8:
    """Return (h, w, 4) uint8 of a picture in 0-1; transparent where it is NaN."""
    level = np.round(255 * np.clip(np.nan_to_num(values), 0, 1)).astype(np.uint8)
    seen = np.where(np.isfinite(values), 255, 0).astype(np.uint8)
    return np.dstack([level, level, level, seen])


def colored(values: Float64, low: float, high: float, colors: str) -> UInt8:
    """Return (h, w, 4) uint8 of values through matplotlib's map `colors`; transparent where NaN."""
    from matplotlib import colormaps

    table = np.round(255 * colormaps[colors](np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)
    place = np.clip((np.nan_to_num(values) - low) / max(high - low, 1e-30), 0, 1)
    seen = np.where(np.isfinite(values), 255, 0).astype(np.uint8)
    return np.dstack([table[np.round(255 * place).astype(np.uint8)], seen])


def encoded(picture: UInt8, limit: int, *, exact: bool = False) -> UInt8:
    """Return a picture as WebP of at most `limit` bytes, made coarser until it fits.

    Parameters
    ----------
    picture : (h, w, 4) uint8
    limit : int
        Bytes.
    exact : bool
        Try without loss first.
    """
    from PIL import Image

    image = Image.fromarray(picture)
    if exact and len(data := _webp(image, lossless=True)) <= limit:
        return np.frombuffer(data, np.uint8)
    data = b""
    for share, quality in _LADDER:
        size = tuple(max(1, round(share * side)) for side in image.size)
        small = image if share == 1.0 else image.resize(size, Image.Resampling.BOX)
        data = _webp(small, quality=quality)
        if len(data) <= limit:
            break
    return np.frombuffer(data, np.uint8)


def _webp(image: Any, **how: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, format="WEBP", method=2, **how)  # half the time, one per cent larger
    return file.getvalue()


def block_peak(values: Float64, side: int, *, lowest: bool) -> Float64:
    """Shrink to at most `side` cells a side by the best value of each block, so no peak is lost."""
    step = -(-max(values.shape) // side)
    if step == 1:
        return values
    worst = np.inf if lowest else -np.inf
    rows, cols = (-(-n // step) * step for n in values.shape)
    padded = np.full((rows, cols), worst)
    padded[: values.shape[0], : values.shape[1]] = np.where(np.isfinite(values), values, worst)
    blocks = padded.reshape(rows // step, step, cols // step, step)
    best = blocks.min(axis=(1, 3)) if lowest else blocks.max(axis=(1, 3))
    return np.where(np.isfinite(best), best, np.nan)
