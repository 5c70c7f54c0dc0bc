"""A small seafloor for tests: thousands of Gaussian bumps, exact at any sub-cell position.

Each bump has a place, a radius, a height and a brightness. A survey is the list of bumps moved
by a known rotation and offset and summed at the cell centres: no interpolation, and no code of
`meshreg` but the records, so a half-cell slip in the code under test cannot cancel itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshreg.records import Grid, SurveyRaster


@dataclass(frozen=True)
class Seafloor:
    east: np.ndarray
    north: np.ndarray
    radius: np.ndarray
    height: np.ndarray
    brightness: np.ndarray

    @classmethod
    def random(cls, seed: int, size: float = 24.0, relief: float = 1.0, contrast: float = 1.0):
        """Bumps of 5 cm to 3 m, heights in proportion to their radius (fractal-like relief)."""
        rng = np.random.default_rng(seed)
        parts = []
        for radius, number, rise in (
            (2.5, 3.0, 0.25),
            (0.8, 20.0, 0.12),
            (0.25, 150.0, 0.05),
            (0.1, 700.0, 0.015),
        ):
            count = int(number * (size / 10) ** 2)
            parts.append(
                (
                    rng.uniform(-0.5 * size, 0.5 * size, count),
                    rng.uniform(-0.5 * size, 0.5 * size, count),
                    radius * rng.uniform(0.6, 1.6, count),
                    relief * rise * rng.normal(size=count),
                    contrast * 25 * rng.normal(size=count),
                )
            )
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def changed(self, seed: int, share: float):
        """Replace `share` of the bumps by others; repaint as many."""
        rng = np.random.default_rng(seed)
        n = len(self.east)
        gone = (rng.random(n) < share) & (self.radius < 1.2)
        paint = (rng.random(n) < share) & ~gone
        span = np.abs(self.east).max()
        return replace(
            self,
            east=np.where(gone, rng.uniform(-span, span, n), self.east),
            north=np.where(gone, rng.uniform(-span, span, n), self.north),
            brightness=np.where(paint, rng.permutation(self.brightness), self.brightness),
        )

    def moved(self, east: float, north: float, yaw: float = 0.0):
        """Coordinates as a survey with this offset and heading error would deliver them."""
        c, s = np.cos(yaw), np.sin(yaw)
        return replace(
            self,
            east=c * self.east - s * self.north + east,
            north=s * self.east + c * self.north + north,
        )

    def raster(
        self,
        cell: float,
        half: float = 9.0,
        up: float = 0.0,
        noise: float = 0.01,
        seed: int = 0,
        centre: tuple[float, float] = (0.0, 0.0),
        gain: float = 1.0,
    ) -> SurveyRaster:
        """Square of `2 half` metres around `centre`, on the lattice of the cell's multiples."""
        n = round(2 * half / cell)
        west = round((centre[0] - half) / cell) * cell
        north = round((centre[1] + half) / cell) * cell
        grid = Grid(west, north, cell, (n, n))
        z, grey = np.zeros((n, n)), np.full((n, n), 110.0)
        for e, nn, r, h, b in zip(
            self.east, self.north, self.radius, self.height, self.brightness, strict=True
        ):
            row, col = grid.row_col(e, nn)
            reach = 3.5 * r / cell
            r0, r1 = max(int(row - reach), 0), min(int(row + reach) + 2, n)
            c0, c1 = max(int(col - reach), 0), min(int(col + reach) + 2, n)
            if r0 >= r1 or c0 >= c1:
                continue
            ee, _ = grid.east_north(0, np.arange(c0, c1))
            _, mm = grid.east_north(np.arange(r0, r1), 0)
            bump = np.exp(-0.5 * ((mm[:, None] - nn) ** 2 + (ee[None, :] - e) ** 2) / r**2)
            z[r0:r1, c0:c1] += h * bump
            grey[r0:r1, c0:c1] += b * bump
        rng = np.random.default_rng(seed)
        z = z + up + rng.normal(0, noise, (n, n)) if noise else z + up
        grey = np.clip(gain * (grey + rng.normal(0, 2, (n, n))), 0, 255)
        full = np.ones((n, n), bool)
        color = np.repeat(np.rint(grey)[..., None], 3, axis=2).astype(np.uint8)
        return SurveyRaster(grid, z, color, full, full, full.astype(np.uint16), datum=0.0)


def rasters(
    seed: int = 0,
    offset=(1.237, -2.412),
    yaw: float = 0.0,
    up: float = 0.03,
    change: float = 0.3,
    cells=(0.1, 0.05),
    half: float = 9.0,
    **kind,
):
    """Return {"dem", "ortho"} to (reference, moving), whose true offset is `offset`."""
    floor = Seafloor.random(seed, **kind)
    later = floor.changed(seed + 1, change).moved(-offset[0], -offset[1], yaw)
    pair = {}
    for name, cell in zip(("dem", "ortho"), cells, strict=True):
        pair[name] = (
            floor.raster(cell, half, seed=seed + 2),
            later.raster(cell, half, up=-up, seed=seed + 3, gain=0.8),
        )
    return pair
