"""What a search will cost, reckoned from the lattices alone: before anything is rasterized.

The transforms of the judge and of mutual information, which run side by side, hold most of it;
their number follows from the fields (`offsets.neutral`) and the grey values, and their size from
the surveys and the radius.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass

from meshreg.errors import ResourceLimitError
from meshreg.io.files import safe
from meshreg.offsets.correlate import Window
from meshreg.offsets.mutual_information import SINGLE_CELLS
from meshreg.pipeline.narrowing import cut_sizes, margin, narrowing
from meshreg.records import Grid
from meshreg.settings import Settings

log = logging.getLogger(__name__)
# Bytes for each cell of the padded image: complex64 of half of it are 4. The judge holds 12
# spectra of the reference, twice (a quarter turn has another window), 12 of the moving survey, and
# three sums at a time; then 13 float64 a searched offset, which are as many at most.
JUDGED = 4 * (3 * 12 + 3) + 8 * 13
LEVEL = 4 * 4 + 4  # of each grey value: transforms, products and both halves back; its counts
WORTH_SAYING = 1e9  # bytes
SHORT_LIVED = 1.25  # times: what else there is for a moment, as measured
_STEPS = 60  # of the bisection for what would fit


@dataclass(frozen=True)
class SearchCost:
    """What one search takes.

    Attributes
    ----------
    offsets : int
        Of the DEM's cell, that are searched.
    memory : int
        Bytes for it beside the rasters, at its peak; right to about a factor of 1.5.
    coarse : int
        DEM cells to a cell of the first look; 1 where there is none.
    """

    offsets: int
    memory: int
    coarse: int

    @property
    def large(self) -> bool:
        """Whether it is worth saying before the work."""
        return self.coarse > 1 or self.memory > WORTH_SAYING

    def __str__(self) -> str:
        said = f"{self.offsets:,} offsets, about {self.memory / 1e9:.1f} GB of memory"
        if self.coarse > 1:
            said += f"; {self.coarse} cells at a time first, then the best places"
        return said


def search_cost(
    grids: Mapping[str, tuple[Grid, Grid]], settings: Settings, radius: float
) -> SearchCost:
    """Reckon what a search takes.

    Parameters
    ----------
    grids : mapping
        "dem" and "ortho" to (reference, moving).
    settings : Settings
    radius : float
        Half width of the search window [m].
    """
    dem, ortho = grids["dem"], grids["ortho"]
    window = Window.around(*dem, radius)
    offsets = len(window.rows) * len(window.cols)
    if window.empty:
        return SearchCost(0, 0, 1)
    times = narrowing(dem, ortho, radius)
    bins = settings.mutual_information.bins if "mutual_information" in settings.methods else 0
    cells = max(math.prod(grid.shape) for grid in ortho)
    level = LEVEL if cells <= SINGLE_CELLS * bins else 2 * LEVEL  # in double precision then
    if times > 1:
        closely = math.prod(cut_sizes(*ortho, radius, margin(*dem)))
        coarsely = math.prod(window.padded) / times**2
        memory = max((JUDGED + level * bins) * closely, JUDGED * coarsely)
    else:
        memory = (JUDGED + level * bins) * math.prod(Window.around(*ortho, radius).padded)
    return SearchCost(offsets, int(SHORT_LIVED * memory), times)


def require_search(
    grids: Mapping[str, tuple[Grid, Grid]], settings: Settings, radius: float
) -> SearchCost:
    """Say what a search takes; refuse one that this machine cannot hold, with what would fit.

    Raises
    ------
    ResourceLimitError
        It takes more memory than is free.
    """
    cost, free = search_cost(grids, settings, radius), safe.free_memory()
    if free is None or cost.memory <= free:
        log.log(logging.WARNING if cost.large else logging.INFO, "the search: %s", cost)
        return cost
    coarser = _up(math.sqrt(cost.memory / (0.8 * free)) * grids["ortho"][0].cell)
    cells = f"--ortho-cell {coarser:g} --dem-cell {max(2 * coarser, grids['dem'][0].cell):g}"
    less = _radius_that_fits(grids, settings, radius, free)
    near = f"Search less far (--search-radius {less:g}), or choose" if less else "Choose"
    raise ResourceLimitError(
        f"Searching {cost.offsets:,} offsets (search.radius {radius:g} m, cells of "
        f"{grids['dem'][0].cell:g} m and {grids['ortho'][0].cell:g} m) takes about "
        f"{cost.memory / 1e9:.1f} GB; {free / 1e9:.1f} GB are free.",
        remedy=f"{near} larger cells ({cells}).",
    )


def _radius_that_fits(
    grids: Mapping[str, tuple[Grid, Grid]], settings: Settings, radius: float, free: float
) -> float:
    """Return the largest radius [m], to two digits, whose search fits; 0 where none does."""
    low, high = 0.0, radius
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        fits = search_cost(grids, settings, middle).memory <= 0.9 * free
        low, high = (middle, high) if fits else (low, middle)
    if low < grids["dem"][0].cell:
        return 0.0
    power = 10.0 ** (math.floor(math.log10(low)) - 1)
    return math.floor(low / power + 1e-9) * power


def _up(length: float) -> float:
    """Round a length up to one digit."""
    power = 10.0 ** math.floor(math.log10(length))
    return math.ceil(length / power - 1e-9) * power
