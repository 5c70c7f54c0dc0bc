"""Where points of one survey lie in the other, by a registration; points are east and north."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.records import Float64, Registration

HeightAt = Callable[[Float64], Float64]  # reference points (N, 2) to registered heights (N,) [m]


@dataclass(frozen=True, eq=False)
class Placing:
    """A registration as a map of the plane.

    Attributes
    ----------
    registration : Registration
        Not rejected.
    height_at : callable, optional
        Heights of the registered moving survey; needed only where it was tilted.
    """

    registration: Registration
    height_at: HeightAt | None = None

    def __post_init__(self) -> None:
        if self.registration.transform is None:
            raise InputError(
                f"The registration is rejected ({self.registration.reason}); it lays nothing down."
            )

    def to_moving(self, points: Any) -> Float64:
        """Take points (N, 2) [m] of the registered survey back to where it was delivered."""
        points = np.asarray(points, float).reshape(-1, 2)
        transform = self.registration.transform
        assert transform is not None
        level = transform.pivot[2] + transform.offset[2]
        heights = np.full(len(points), level)
        if self.height_at is not None:
            known = self.height_at(points)
            heights = np.where(np.isfinite(known), known, level)
        solid = np.column_stack([points, heights])
        warp = getattr(self.registration, "warp", None)
        if warp is not None:
            solid = warp.inverse(solid)
        return np.asarray(transform.inverse().apply(solid)[:, :2])

    def to_reference(self, points: Any) -> Float64:
        """Take points (N, 2) [m] of the moving survey as delivered to the reference."""
        points = np.asarray(points, float).reshape(-1, 2)
        transform = self.registration.transform
        assert transform is not None
        level = np.full((len(points), 1), transform.pivot[2])
        found = transform.apply(np.column_stack([points, level]))[:, :2]
        for _ in range(20):  # heights are known on the registered side, so the way back is exact
            missed = points - self.to_moving(found)
            found = found + missed @ transform.linear[:2, :2].T
            if np.abs(missed).max(initial=0.0) < 1e-9:
                break
        return np.asarray(found)


def read_placing(folder: str | Path) -> Placing:
    """Read a result's registration as a map of the plane.

    Parameters
    ----------
    folder : path
        What `meshreg register` wrote, or its registration.json. Heights are read from the
        registered DEM beside it where the transform is tilted and needs them.

    Raises
    ------
    InputError
        No registration, or a rejected one.
    """
    from meshreg.io.result.document import read_registration

    folder = Path(folder)
    registration = read_registration(folder)
    transform = registration.transform
    if transform is None:
        raise InputError(
            f"The registration is rejected: {registration.reason}; nothing is laid down.",
            file=folder,
            remedy="Pick on the surveys themselves: meshreg pick REFERENCE MOVING.",
        )
    dem = (folder if folder.is_dir() else folder.parent) / "moving_dem.tif"
    tilted = np.abs(transform.rotation[2, :2]).max() > 1e-9
    return Placing(registration, _heights(dem) if tilted and dem.is_file() else None)


def _heights(path: Path) -> HeightAt:
    from meshreg.io.maps.values import read_height

    raw = read_height(path, 1 << 62)
    values = np.where(raw.valid, raw.values, np.nan)
    back = np.linalg.inv(np.vstack([raw.matrix, [0.0, 0.0, 1.0]]))[:2]

    def height_at(points: Float64) -> Float64:
        col, row = np.floor(points @ back[:, :2].T + back[:, 2]).T
        inside = (row >= 0) & (row < values.shape[0]) & (col >= 0) & (col < values.shape[1])
        found = np.full(len(points), np.nan)
        found[inside] = values[row[inside].astype(int), col[inside].astype(int)]
        return found

    return height_at
