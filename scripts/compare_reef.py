#!/usr/bin/env python3
"""Compare the synthetic reef with a real one: roughness spectrum and slopes, as a figure.

    scripts/compare_reef.py path/to/horseshoe_dem.tif [-o docs/seafloor_vs_reef.png]

The real one: DEM of Horseshoe Reef, Lizard Island, 8 x 8 m at 1 cm, from jmadinlab/habtools (MIT).
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from data_synth.seafloor import make_seafloor
from data_synth.sites import SITES

SIDE, CELL = 8.0, 0.01


def synthetic(site: str, seed: int) -> np.ndarray:
    """Heights (800, 800) of the synthetic seafloor, area-averaged to 1 cm."""
    half = SIDE / 2
    floor = make_seafloor(SITES[site], seed, (-half - 1, -half - 1, half + 1, half + 1))
    side = (np.arange(1600) + 0.5) * CELL / 2 - half
    x, y = np.meshgrid(side, side[::-1])
    return floor.height(x, y, 0.01).reshape(800, 2, 800, 2).mean(axis=(1, 3))


def level(z: np.ndarray) -> np.ndarray:
    """Heights without their best plane."""
    rows, cols = np.mgrid[: z.shape[0], : z.shape[1]]
    design = np.stack([rows.ravel(), cols.ravel(), np.ones(z.size)], axis=1)
    plane = design @ np.linalg.lstsq(design, z.ravel(), rcond=None)[0]
    return z - plane.reshape(z.shape)


def spectrum(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths [m] and the power spectral density [m4] averaged over rings."""
    window = np.outer(np.hanning(z.shape[0]), np.hanning(z.shape[1]))
    power = np.abs(np.fft.fft2(level(z) * window)) ** 2 * CELL**2 / (window**2).sum()
    f = np.fft.fftfreq(z.shape[0], CELL)
    radius = np.hypot(*np.meshgrid(f, f))
    edges = np.geomspace(0.2, 50.0, 25)
    rings = [(radius >= a) & (radius < b) for a, b in pairwise(edges)]
    return 1 / np.sqrt(edges[:-1] * edges[1:]), np.array([power[ring].mean() for ring in rings])


def slopes(z: np.ndarray, times: int) -> np.ndarray:
    """Slopes [degrees] of the heights averaged over `times` cells."""
    n = z.shape[0] // times
    z = z[: n * times, : n * times].reshape(n, times, n, times).mean(axis=(1, 3))
    gy, gx = np.gradient(z, CELL * times)
    return np.degrees(np.arctan(np.hypot(gx, gy))).ravel()


def main() -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import rasterio
    from matplotlib.colors import LightSource

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dem", type=Path, help="the real DEM (GeoTIFF, 1 cm)")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/seafloor_vs_reef.png"))
    parser.add_argument("--site", default="reef")
    parser.add_argument("--seeds", type=int, default=6)
    args = parser.parse_args()
    with rasterio.open(args.dem, driver="GTiff") as data:
        real = data.read(1).astype(float)
    made = [synthetic(args.site, seed) for seed in range(args.seeds)]

    figure, axes = plt.subplots(2, 3, figsize=(15, 10), layout="constrained")
    light = LightSource(315, 40)
    for axis, z, title in (
        (axes[0, 0], real, "Horseshoe Reef, 8 x 8 m"),
        (axes[0, 1], made[0], "synthetic, seed 0"),
        (axes[0, 2], made[1], "synthetic, seed 1"),
    ):
        axis.imshow(light.hillshade(z, dx=CELL, dy=CELL), cmap="gray")
        axis.set_title(title)
        axis.set_axis_off()
    spectra = [spectrum(z) for z in made]
    wavelength, truth = spectrum(real)
    for _, power in spectra:
        axes[1, 0].loglog(wavelength, power, color="tab:orange", alpha=0.5, lw=1)
    axes[1, 0].loglog(wavelength, truth, color="black", lw=2, label="Horseshoe Reef")
    axes[1, 0].plot([], [], color="tab:orange", label=f"synthetic, {len(made)} seeds")
    axes[1, 0].set(xlabel="wavelength [m]", ylabel="power spectral density [m⁴]")
    axes[1, 0].set_title("roughness spectrum")
    axes[1, 0].legend()
    print("wavelength  real  synthetic/real")
    middle = np.exp(np.mean([np.log(power) for _, power in spectra], axis=0))
    for w, a, b in zip(wavelength, truth, middle, strict=True):
        print(f"{w:9.3f} {a:.2e} {b / a:6.2f}")
    for axis, times in ((axes[1, 1], 1), (axes[1, 2], 10)):
        bins = np.linspace(0, 90, 46)
        for z in made:
            axis.hist(slopes(z, times), bins, density=True, histtype="step", color="tab:orange")
        axis.hist(slopes(real, times), bins, density=True, histtype="step", color="black", lw=2)
        axis.set(title=f"slope at {times} cm", xlabel="degrees", ylabel="share per degree")
        q = [5, 25, 50, 75, 90, 95]
        print(
            f"slope quantiles {q} at {times} cm, real",
            np.percentile(slopes(real, times), q).round(1),
        )
        for z in made[:3]:
            print(
                "   synthetic",
                np.percentile(slopes(z, times), q).round(1),
                "sd",
                level(z).std().round(3),
            )
    print("sd of levelled height, real", level(real).std().round(3))
    args.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.output, dpi=80)


if __name__ == "__main__":
    main()
