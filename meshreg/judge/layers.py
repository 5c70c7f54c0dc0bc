"""More than one surface in a survey: counted, and a second copy of the whole told from overhangs.

Images or scans that were aligned in two groups give a model whose surface is there twice. Seen from
above one of them hides the other, or both are averaged. Points that lie off the surface that the
DEM shows are compared with that same surface moved aside: overhangs, branches and plants lie at all
distances from it, a copy at one.
"""

from __future__ import annotations

import math

import numpy as np

from meshreg.records import Bool, Float64, Layer, Maps, Survey, SurveyRaster
from meshreg.statistics import half_scale, nmad

MOST_POINTS = 400_000  # that are looked at
MOST_VOTES = 4_000  # of the points off the surface, that say where a copy lies
LEAST_OFF = 100  # points
OFF = 4.0  # deviations from the surface at which a point is off it
NEAR = 2.0  # deviations
REACH = 1.0  # m aside that a copy is looked for, but from 6 to 12 cells
# Of the points off the surface that one copy must explain: of clouds of 80 made seafloors with a
# tenth to a fifth of their points 12 to 70 cm aside it was 0.68 and more, of real ones with plants,
# houses and cliffs (five clouds, cells of one to eight spacings) 0.47 and less. This lies between.
COPIED = 0.57
LOPSIDED = 2.0  # It must explain so many times what a copy on the other side explains


def second_surface(survey: Survey, dem: SurveyRaster, seed: int = 0) -> Layer | None:
    """Count the cells that hold a second surface, and those where it is one copy of the first.

    Parameters
    ----------
    survey : Survey
        As it was rasterized; of ready maps nothing can be told.
    dem : SurveyRaster
        Of the survey as delivered.
    seed : int
        Of the choice of points, where there are many.

    Returns
    -------
    Layer or None
        None where there are no points to tell.
    """
    if isinstance(survey.geometry, Maps) or not dem.valid.any():
        return None
    points = survey.geometry.points
    rng = np.random.default_rng(seed)
    if len(points) > MOST_POINTS:
        points = points[np.sort(rng.choice(len(points), MOST_POINTS, replace=False))]
    points = points + survey.origin
    surface = _Surface(dem)
    rest, rough = surface.residuals(points, (0.0, 0.0))
    known = np.isfinite(rest)
    points, rest, rough = points[known], rest[known], rough[known]
    if len(points) < LEAST_OFF:
        return None
    cells, where = np.unique(surface.cell_of(points), return_inverse=True)
    noise = nmad(rest)
    larger = half_scale(rest)
    if abs(float(np.median(rest))) > NEAR * larger:
        noise = larger  # most points lie off the DEM, which shows a copy of fewer
    noise = max(noise, 0.02 * dem.grid.cell)
    deviation = np.hypot(noise, rough)
    off = np.abs(rest) > OFF * deviation

    def share(members: Bool) -> float:
        return len(np.unique(where[members])) / len(cells)

    counted = share(off)
    if off.sum() < LEAST_OFF or counted < 0.01:
        return Layer(counted)
    beside = points[off]
    votes = beside
    if len(votes) > MOST_VOTES:
        votes = votes[rng.choice(len(votes), MOST_VOTES, replace=False)]
    east, north, up = _most_common(surface, votes, noise)
    explained = _explained(surface, beside, (east, north, up), noise)
    other = _explained(surface, beside, (-east, -north, -up), noise)
    if explained.mean() < COPIED or explained.mean() < LOPSIDED * other.mean():
        return Layer(counted)
    members = np.zeros(len(points), bool)
    members[np.flatnonzero(off)[explained]] = True
    moved = surface.residuals(points, (east, north))[0] - up
    seen = np.abs(moved - rest) > OFF * deviation
    where_seen = len(np.unique(where[members])) / max(len(np.unique(where[seen])), 1)
    return Layer(counted, share(members), min(where_seen, 1.0), (east, north, up))


class _Surface:
    """The DEM as a surface that can be looked up anywhere, and how rough it is within a cell."""

    def __init__(self, dem: SurveyRaster) -> None:
        from scipy.ndimage import distance_transform_edt, laplace, median_filter

        self.dem = dem
        near = distance_transform_edt(~dem.valid, return_distances=False, return_indices=True)
        self.height = dem.height.astype(np.float64)[tuple(near)]
        # a cell that a plant or a copy has lifted is no sign of rough ground
        self.rough = 0.25 * np.abs(laplace(median_filter(self.height, 3)))
        self.known = dem.valid.astype(np.float64)

    def cell_of(self, points: Float64) -> np.ndarray:
        row, col = self.dem.grid.row_col(points[:, 0], points[:, 1])
        at = np.rint(row).astype(np.int64) * self.dem.grid.shape[1] + np.rint(col).astype(np.int64)
        return np.asarray(at)

    def residuals(self, points: Float64, step: tuple[float, float]) -> tuple[Float64, Float64]:
        """Height of points over the surface moved by `step` [m], NaN off it; its roughness."""
        from scipy.ndimage import map_coordinates

        grid = self.dem.grid
        at = np.stack(grid.row_col(points[:, 0] - step[0], points[:, 1] - step[1]))
        found = [
            map_coordinates(part, at, order=1, mode="constant", cval=np.nan)
            for part in (self.height, self.rough, self.known)
        ]
        inside = np.nan_to_num(found[2]) > 0.99
        rest = points[:, 2] - self.dem.datum - found[0]
        return np.where(inside, rest, np.nan), found[1]


def _most_common(surface: _Surface, votes: Float64, noise: float) -> tuple[float, float, float]:
    """Return the step of the surface (east, north, up) [m] on which most of the points lie."""
    cell = surface.dem.grid.cell
    reach = int(np.clip(math.ceil(REACH / cell), 6, 12))
    best = (-1, 0.0, 0.0, 0.0)
    steps = np.arange(-reach, reach + 1) * cell
    for fine in (False, True):
        if fine:
            around = np.linspace(-0.75, 0.75, 7) * cell
            tries = [(best[1] + a, best[2] + b) for a in around for b in around]
        else:
            tries = [(a, b) for a in steps for b in steps]
        for east, north in tries:
            rest = np.sort(surface.residuals(votes, (east, north))[0])  # NaN comes last
            rest = rest[np.isfinite(rest)]
            if not len(rest):
                continue
            ends = np.searchsorted(rest, rest + 2 * NEAR * noise, side="right")
            held = ends - np.arange(len(rest))
            first = int(np.argmax(held))
            if held[first] > best[0]:
                middle = float(np.median(rest[first : ends[first]]))
                best = (int(held[first]), float(east), float(north), middle)
    return best[1:]


def _explained(
    surface: _Surface, points: Float64, step: tuple[float, float, float], noise: float
) -> Bool:
    """(N,): whether each point lies on the surface moved by `step`."""
    rest, rough = surface.residuals(points, step[:2])
    return np.asarray(np.abs(rest - step[2]) <= NEAR * np.hypot(noise, rough))
