"""What a user may say about a survey file that the file does not say itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from meshreg.settings.checked import checked_values, choice, flag, listed, number

FARTHEST = 1e9  # m; the Earth's own coordinates stay under 1e8 in feet
UNIT_RANGE = (1e-9, 1e9)  # metres per unit


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

    shift: tuple[float, float, float] | None = listed(
        None, "added to coordinates", least=3, most=3, low=-FARTHEST, high=FARTHEST, unit="m"
    )
    axes: Literal["enu", "ned"] | None = choice(None, "of the file", ("enu", "ned"))
    up: Literal["y", "z"] | None = choice(None, "axis of the file that points up", ("y", "z"))
    unit: str | None = None
    crs: str | None = None
    positions: Path | None = None
    scale: float | None = number(
        None, "metres per unit", low=UNIT_RANGE[0], high=UNIT_RANGE[1], unit="m"
    )
    geometry_only: bool = flag(False, "leave out textures")
    max_pixels: int = number(1_000_000_000, "of a texture page", low=1, high=1e12)

    def checked(self) -> ReadOptions:
        """Return the options with each value in its type.

        Raises
        ------
        UsageError
            A shift that is not finite, a scale of zero, or another value out of its range.
        """
        return replace(self, **checked_values(self))
