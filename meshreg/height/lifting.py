"""Height and tilt, once east, north and yaw are known.

Robust against change, yet uniform over the ground: sand that moved as a sheet, growth, loss and
loose things are left out, and a block that departs from its neighbours is told by them, but the
slow bending of the models is kept with equal weight everywhere. So the answer is the best rigid fit
over all ground that both surveys see, not the fit to where the models happen to agree.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from meshreg.height.dem_pair import DemPair, points_of
from meshreg.height.gain import relief_gain
from meshreg.height.ground import block_grounds, numbered
from meshreg.height.ground_plane import CHANGED, SET_ASIDE, STABLE, UNKNOWN, GroundPlane, fit_plane
from meshreg.records import (
    Float64,
    Gain,
    Grid,
    OffsetAt,
    SurveyRaster,
    Tear,
    Transform,
    UInt8,
    Warp,
)
from meshreg.refine import find_tear
from meshreg.statistics import MAD_TO_SIGMA

__all__ = [
    "CHANGED",
    "MAX_TILT",
    "SET_ASIDE",
    "SHEET",
    "STABLE",
    "UNKNOWN",
    "Heights",
    "fit_heights",
    "rotation",
    "stable_ground",
]

STEP_PART = 0.5  # cells: a smaller step is no sign of a tear
STEP_BLOCKS = 8  # along the overlap's side, whose heights are asked for a step
STEP_SHARE = 0.1  # of a block that must recur for its height to be asked
STEP_CELLS = 0.02  # of a cell: no height of a block is better than this
MAX_TILT = np.deg2rad(3.0)
# m, sigma: how far sand may have risen or fallen where nothing tells; by then up is no better known
# than by two depths of 5 cm each.
SHEET = 0.07
NO_DETAIL = (
    "too little ground shows the same small relief in both surveys: if it rose or fell as a whole "
    f"(sand), up is off by as much; ±{100 * SHEET:g} cm is added for that"
)


@dataclass(frozen=True, eq=False)
class Heights:
    """How far the moving survey must be lifted and tilted after its horizontal registration.

    Attributes
    ----------
    place : (3,) float64
        Centroid of the cells that both surveys see, in moving coordinates [m].
    up : float
        Metres to add at the place.
    tilt : (2,) float64
        Right-handed turns about the east and the north axis [rad]; 0 where not significant.
    covariance : (3, 3) float64
        Of (up, tilt_east, tilt_north) at the place; zero where there was nothing to compare.
    kept : float
        Share of the common cells that count as unchanged ground.
    sigma : float
        Robust deviation of the blocks from their neighbours' median [m].
    note, doubt : str
        What the user should know; why the answer cannot be accepted.
    ground : (H, W) uint8 or None
        What each cell of the moving DEM was: UNKNOWN, CHANGED, SET_ASIDE or STABLE. A stable cell
        has a weight of one, the others of nought; None where there was too little ground to tell.
    gain : Gain or None
        How many times as high the moving survey's relief is.
    step : Tear or None
        Two populations of the heights of recurring ground, which lie apart.
    relief : float
        Range of 98 % of the common cells' heights [m].
    """

    place: Float64
    up: float = 0.0
    tilt: Float64 = field(default_factory=lambda: np.zeros(2))
    covariance: Float64 = field(default_factory=lambda: np.zeros((3, 3)))
    kept: float = 0.0
    sigma: float = float("nan")
    note: str = ""
    doubt: str = ""
    ground: UInt8 | None = None
    gain: Gain | None = None
    step: Tear | None = None
    relief: float = float("inf")

    def transform(self, horizontal: Transform) -> Transform:
        """Complete a horizontal registration: lifted by `up` and tilted about `place`."""
        if not self.tilt.any():
            offset = horizontal.offset + np.array([0.0, 0.0, self.up])
            return replace(horizontal, offset=offset)
        there = horizontal.at(self.place)
        offset = there.offset + np.array([0.0, 0.0, self.up])
        turned = rotation(self.tilt) @ there.rotation
        whole = Transform(turned, there.scale, offset, self.place)
        return whole.at(horizontal.pivot)

    def levelled(self) -> Heights:
        """Return the same without tilt, for maps, which cannot be tilted."""
        if not self.tilt.any():
            return self
        degrees = np.rad2deg(np.hypot(*self.tilt))
        note = f"tilted by {degrees:.2f}° against the reference, which maps cannot undo"
        covariance = self.covariance.copy()
        covariance[1:, 1:] += np.outer(self.tilt, self.tilt)
        note = "; ".join(filter(None, (note, self.note)))
        return replace(self, tilt=np.zeros(2), covariance=covariance, note=note)


def rotation(tilt: Float64) -> Float64:
    """(3, 3) rotation by the vector (tilt about east, tilt about north, 0) [rad] (Rodrigues)."""
    a, b = float(tilt[0]), float(tilt[1])
    angle = float(np.hypot(a, b))
    k = np.array([[0.0, 0.0, b], [0.0, 0.0, -a], [-b, a, 0.0]])
    # sin(x)/x and (1 - cos x)/x², which np.sinc gives without dividing by a small angle
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * k @ k
    )


def fit_heights(
    reference: SurveyRaster,
    moving: SurveyRaster,
    horizontal: Transform,
    offset_at: OffsetAt | None = None,
) -> Heights:
    """Lift and tilt of the moving survey (`fitted_plane`), its gain, and whether it is torn.

    Parameters
    ----------
    reference, moving : SurveyRaster
        DEMs as delivered, each on its own grid.
    horizontal : Transform
        `reference_from_moving` in east, north and yaw.
    offset_at : callable, optional
        ``offset_at(places)`` of places (N, 2) in the moving survey: how far the ground there must
        go [m], (N, 2), internal warp included. Heights are compared there, where the same ground
        is; without it, where the rigid motion leads.
    """
    pair = DemPair.of(reference, moving, horizontal, offset_at)
    if not pair.row.size:
        return Heights(horizontal.pivot, note="no heights in common; up is not known")
    answer = fitted_plane(pair, horizontal)
    transform = answer.transform(horizontal)
    height = moving.height[pair.row, pair.col].astype(np.float64)
    relief = float(np.subtract(*np.quantile(height, (0.99, 0.01))))
    step = _height_step(pair, transform)
    return replace(answer, gain=relief_gain(pair, transform), step=step, relief=relief)


def _height_step(pair: DemPair, transform: Transform) -> Tear | None:
    """Find two populations of height among blocks of recurring ground."""
    recurs = pair.where_detail_recurs(transform, 0.0)  # blocks are asked whether enough does
    row, col = pair.row[recurs.counts], pair.col[recurs.counts]
    if not row.size:
        return None
    difference, points = pair.differences(transform)
    difference, points = difference[recurs.counts], points[recurs.counts]
    side = max(int(np.sqrt(np.ptp(row) * np.ptp(col))) // STEP_BLOCKS, 8)
    lattice, number = numbered(row // side, col // side)
    value, cells, _, _ = block_grounds(difference, number, len(lattice))
    known = cells >= STEP_SHARE * side**2
    if not known.any():
        return None
    sums = [np.bincount(number, part, len(lattice)) for part in points[:, :2].T]
    places = (np.stack(sums, axis=1) / cells[:, None])[known]
    cell = pair.moving.grid.cell
    found = find_tear(places, value[known, None], STEP_CELLS * cell)
    # what lies within a cell may be the ground's slope where it is not quite the same place
    return None if found is None or found.size <= STEP_PART * cell else found


def fitted_plane(pair: DemPair, horizontal: Transform) -> Heights:
    """Lift and tilt of the moving survey, from raw height differences.

    The difference ``dz = reference - moving`` at a moved cell is modelled as
    ``up + tilt_east * (n - n0) - tilt_north * (e - e0)``. Cells count where the detail of their
    surroundings recurs (`height.ground.recurring`). Each block's ground is the trimmed mean of
    those around the centre of its shortest half (least trimmed squares: Rousseeuw and Leroy 1987,
    chapter 4), blocks that a step or four deviations part from their neighbours are told by them,
    and the plane is the least-squares fit with a weight of one for each cell. Since the moved cells
    are looked up anew after each step, relief does not bias a large tilt.

    The covariance is the block sandwich of the blocks' departures from their
    neighbours for `up`, from a slow bending (a cubic in east and north) for the tilt, over parcels
    at least two correlation lengths of these departures wide: the slow bending itself moves the
    best fit over all ground as much as this one. Added to the variance of `up` is the square of how
    much it changes if nothing is left out (median of all cells: when much has changed, what counts
    as stable ground is a choice) or, where that is more, of `sigma` (growth that covers half of the
    ground lifts it as a whole by as much as it makes its parts differ); to both, what the bending
    may do where no ground counts.

    Parameters
    ----------
    pair : DemPair
        With some cells in common.
    horizontal : Transform
        `reference_from_moving` in east, north and yaw.

    Returns
    -------
    Heights
        With the tilt at zero unless Hotelling's T² calls it significant at three sigmas (0.27 %);
        the covariance knows what that leaves out.
    """
    place = points_of(pair.moving, pair.row, pair.col).mean(axis=0)
    start = Heights(place)
    first = pair.differences(start.transform(horizontal))[0]
    start = replace(start, up=float(np.median(first)))
    everything, sheet, note = pair, 0.0, ""
    pair = everything.where_detail_recurs(start.transform(horizontal))
    free, plane = _settled(pair, horizontal, start, tilted=True)
    if plane is None:
        pair, sheet, note = everything, SHEET, NO_DETAIL
        free, plane = _settled(pair, horizontal, start, tilted=True)
    if plane is None:
        return _unblocked(pair, horizontal, start)
    tilt = float(np.hypot(*free.tilt))
    significant = plane.tells(free.tilt, sheet)
    if significant and tilt > MAX_TILT:
        degrees = np.rad2deg(tilt)
        doubt = f"the surveys are tilted against each other by {degrees:.1f}°, beyond 3°"
        level, _ = _settled(pair, horizontal, start, tilted=False)
        return replace(level, covariance=plane.covariance(sheet), doubt=doubt, note=note)
    left_out = np.zeros((3, 3))
    if not significant:
        level, found = _settled(pair, horizontal, start, tilted=False)
        if found is not None:
            left_out[1:, 1:] = np.outer(free.tilt, free.tilt)
            free, plane = level, found
    covariance = plane.covariance(sheet) + left_out
    return replace(free, covariance=covariance, kept=plane.kept, sigma=plane.sigma, note=note)


def _settled(
    pair: DemPair, horizontal: Transform, start: Heights, *, tilted: bool
) -> tuple[Heights, GroundPlane | None]:
    """Step until the plane lies still; None where the blocks are too few."""
    answer, plane = start, None
    for _ in range(8):
        plane = fit_plane(pair, answer.transform(horizontal), start.place, tilted=tilted)
        if plane is None:
            return answer, None
        tilt = answer.tilt + plane.step[1:]
        if np.hypot(*tilt) > 4 * MAX_TILT:  # no ground at all; do not turn it upside down
            return replace(answer, tilt=tilt), plane
        up = answer.up + float(plane.step[0])
        answer = replace(answer, up=up, tilt=tilt, ground=plane.ground)
        if abs(plane.step[0]) < 1e-5 and np.abs(plane.step[1:]).max() < 1e-6:
            break
    return answer, plane


def _unblocked(pair: DemPair, horizontal: Transform, start: Heights) -> Heights:
    """Too little ground for blocks: the median, as uncertain as a single cell."""
    difference, _ = pair.differences(start.transform(horizontal))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(difference - np.median(difference))))
    covariance = np.diag([spread**2, MAX_TILT**2 / 9, MAX_TILT**2 / 9])
    return replace(
        start, covariance=covariance, kept=1.0, note="too little common ground to measure tilt"
    )


def stable_ground(
    ground: UInt8,
    grid: Grid,
    transform: Transform,
    moved: SurveyRaster,
    warp: Warp | None = None,
) -> UInt8:
    """(h, w) uint8: `Heights.ground`, on the `grid` of the moving DEM as delivered, laid down.

    Each cell of the `moved` DEM takes what the nearest cell was from which it came.
    """
    row, col = np.nonzero(moved.valid)
    points = points_of(moved, row, col)
    if warp is not None:  # its displacement changes by millimetres over itself: no inverse needed
        points = points - warp.displacement(points)
    points = transform.inverse().apply(points)
    there = np.rint(np.stack(grid.row_col(points[:, 0], points[:, 1]))).astype(int)
    inside = ((there >= 0) & (there < np.array(grid.shape)[:, None])).all(axis=0)
    laid = np.zeros(moved.grid.shape, np.uint8)
    laid[row[inside], col[inside]] = ground[tuple(there[:, inside])]
    return laid
