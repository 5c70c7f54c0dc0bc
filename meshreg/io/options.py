"""What a user may say about a survey file that the file does not say itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class ReadOptions:
    """How to read one survey; None means "as the file, its sidecar or its format says".

    Attributes
    ----------
    shift : (east, north, up) or None
        Added to the file's coordinates after axes and unit [m]; replaces a sidecar's shift.
    axes : "enu" or "ned" or None
        What the file's x, y, z are; "ned" is north, east, down.
    up : "y" or "z" or None
        Which axis of the file points up; "y" means (x, y, z) is east, up, south.
    unit : str or None
        Length unit of the file's coordinates: m, cm, mm, ft, us-ft, or metres per unit ("0.0123").
    crs : str or None
        CRS of the coordinates after the shift.
    positions : Path or None
        Camera positions for a COLMAP model (CSV: image, east, north, up).
    scale : float or None
        Metres per unit of a model of unknown scale.
    geometry_only : bool
        Leave out textures and texture coordinates, however broken they are.
    max_pixels : int
        Largest texture page that is opened.
    """

    shift: tuple[float, float, float] | None = None
    axes: Literal["enu", "ned"] | None = None
    up: Literal["y", "z"] | None = None
    unit: str | None = None
    crs: str | None = None
    positions: Path | None = None
    scale: float | None = None
    geometry_only: bool = False
    max_pixels: int = 1_000_000_000
