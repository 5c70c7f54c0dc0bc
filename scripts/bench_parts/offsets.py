"""The estimators on 500 × 500 cells: exhaustive searches by FFT beside the direct count.

The second table counts right answers (error < 0.25 m) on pairs with strong uneven light: the
paper's mutual information, ours, and SIFT, on one and the same pairs.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

ROOT = Path(__file__).parent.parent.parent
sys.path.insert(0, str(ROOT / "tests" / "helpers"))


def _noise(rng: np.random.Generator, n: int, sigma: float) -> np.ndarray:
    field = gaussian_filter(rng.normal(size=(n, n)), sigma, mode="wrap")
    return field / field.std()


def _pair(seed: int, n: int, cell: float, change: float = 0.3) -> tuple[Any, Any, Any]:
    """Fractal ground; the moving survey is cut elsewhere from it, changed and lit unevenly."""
    from meshreg.records import Grid, SurveyRaster

    rng = np.random.default_rng(seed)
    margin = int(3.75 / cell)
    big = n + 2 * margin
    scales = (1.5, 4.0, 12.0)
    z = sum(0.02 * s**0.7 * _noise(rng, big, s) for s in scales)
    grey = sum(14.0 * _noise(rng, big, s) for s in scales)
    kept, new = np.sqrt(1 - change**2), change
    grey2 = kept * grey + new * sum(14.0 * _noise(rng, big, s) for s in scales)
    z2 = z + 0.03 * change * _noise(rng, big, 3.0)
    row, col = rng.integers(-margin + 2, margin - 1, 2)
    light = 45.0 * _noise(rng, big, 60.0), 45.0 * _noise(rng, big, 60.0)

    def cut(height: Any, image: Any, top: int, left: int) -> SurveyRaster:
        part = (slice(top, top + n), slice(left, left + n))
        color = np.clip(110 + image[part], 0, 255).astype(np.uint8)
        full = np.ones((n, n), bool)
        grid = Grid(0.0, 0.0, cell, (n, n))
        return SurveyRaster(
            grid, height[part], np.repeat(color[..., None], 3, 2), full, full, full.astype("u2")
        )

    reference = cut(z, grey + light[0], margin, margin)
    moving = cut(z2, grey2 + light[1], margin + row, margin + col)
    return reference, moving, np.array([col * cell, -row * cell])


def _best_of(call: Any, times: int = 5) -> float:
    call()
    spans = []
    for _ in range(times):
        began = time.perf_counter()
        call()
        spans.append(time.perf_counter() - began)
    return float(np.median(spans))


def _speed() -> list[dict[str, Any]]:
    from meshreg.offsets import mutual_information as mi
    from meshreg.offsets import terrain
    from meshreg.offsets.correlate import Window

    rows = []
    reference, moving, _ = _pair(0, 500, 0.10)
    window = Window.around(reference.grid, moving.grid, 5.0)
    seconds = _best_of(lambda: terrain.cost_surface(reference, moving, window, 0.3))
    rows.append({"what": "III-C cost, 500² cells, ±5 m at 0.10 m, FFT", "seconds": seconds})
    seconds = _best_of(
        lambda: terrain.correlation_surface(reference, moving, window, 0.3, (2.0, 5.0))
    )
    rows.append({"what": "robust terrain, the same", "seconds": seconds})
    reference, moving, _ = _pair(0, 240, 0.05)
    window = Window.around(reference.grid, moving.grid, 3.75)
    masks = (reference.color_valid, moving.color_valid)
    for name, bins, direct in (
        ("direct, 256", 256, True),
        ("direct, 16", 16, True),
        ("FFT, 16", 16, False),
        ("FFT, 8", 8, False),
    ):
        a, b = (mi.levels(r, bins, 0.0 if bins == 256 else 0.5) for r in (reference, moving))
        run = mi.direct_surface if direct else mi.fft_surface
        times = 1 if direct else 5
        seconds = _best_of(lambda r=run, x=a, y=b, q=bins: r(x, y, masks, window, 0.3, q), times)
        what = f"III-D, 240² cells, ±3.75 m at 0.05 m, {name} levels"
        rows.append({"what": what, "seconds": seconds})
    return rows


def _success(pairs: int = 15) -> list[dict[str, Any]]:
    from meshreg.offsets import estimate_offset
    from meshreg.settings import Settings

    right: dict[str, int] = {}
    for seed in range(pairs):
        reference, moving, truth = _pair(100 + seed, 240, 0.05, change=0.6)
        for preset, method in (
            ("paper", "mutual_information"),
            ("robust", "mutual_information"),
            ("robust", "terrain"),
            ("robust", "sift"),
        ):
            settings = Settings.from_preset(preset).changed({"search.radius": 3.75})
            found = estimate_offset(reference, moving, method, settings)
            error = np.hypot(found.east - truth[0], found.north - truth[1])
            name = f"{method}, {preset}"
            right[name] = right.get(name, 0) + bool(error < 0.25)
    return [
        {"what": f"uneven light, {pairs} pairs: {name}", "right": count}
        for name, count in right.items()
    ]


def bench() -> list[dict[str, Any]]:
    return _speed() + _success()
