"""Height and tilt, once east, north and yaw are known.

Robust against change, yet uniform over the ground: sand that moved as a sheet, growth, loss and
loose things are left out, and a block that departs from its neighbours is told by them, but the
slow bending of the models is kept with equal weight everywhere. So the answer is the best rigid fit
over all ground that both surveys see, not the fit to where the models happen to agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from meshreg.ground import (
    BLOCK_CUT,
    MAD_TO_SIGMA,
    ROUNDING,
    Index,
    block_grounds,
    largest_sheet,
    least_squares,
    neighbours,
    numbered,
    recurring,
    slow_bending,
)
from meshreg.sandwich import block_sandwich
from meshreg.types import Bool, Float64, Grid, SurveyRaster, Transform, UInt8, Warp

MAX_TILT = np.deg2rad(3.0)
MIN_BLOCKS = 12
LEAST_RECURRING = 0.1  # share of the common cells; with less, all of them are asked
# m, sigma: how far sand may have risen or fallen where nothing tells; by then up is no better known
# than by two depths of 5 cm each.
SHEET = 0.07
NO_DETAIL = (
    "too little ground shows the same small relief in both surveys: if it rose or fell as a whole "
    f"(sand), up is off by as much; ±{100 * SHEET:g} cm is added for that"
)
LEAST_STEP = 0.1  # cells: what parts two blocks that did not change alike is higher than that
BEND_STEP = 8  # cells between the places at which the bending is computed
OffsetAt = Callable[[Float64], Float64]
# What a cell of ground was for the height and the tilt: not compared; changed, or without detail
# that recurs; in a block that changed as a whole, which is told by its neighbours; counted.
UNKNOWN, CHANGED, SET_ASIDE, STABLE = range(4)


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
    """Lift and tilt of the moving survey, from raw height differences.

    The difference ``dz = reference - moving`` at a moved cell is modelled as
    ``up + tilt_east * (n - n0) - tilt_north * (e - e0)``. Cells count where the detail of their
    surroundings recurs (`meshreg.ground.recurring`). Each block's ground is the trimmed mean of
    those around the centre of its shortest half (least trimmed squares: Rousseeuw and Leroy 1987,
    chapter 4), blocks that a step or four deviations part from their neighbours are told by them,
    and the plane is the least-squares fit with a weight of one for each cell. Since the moved cells
    are looked up anew after each step, relief does not bias a large tilt.

    The covariance is the block sandwich (`meshreg.sandwich`) of the blocks' departures from their
    neighbours for `up`, from a slow bending (a cubic in east and north) for the tilt, over parcels
    at least two correlation lengths of these departures wide: the slow bending itself moves the
    best fit over all ground as much as this one. Added to the variance of `up` is the square of how
    much it changes if nothing is left out (median of all cells: when much has changed, what counts
    as stable ground is a choice); to both, what the bending may do where no ground counts.

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

    Returns
    -------
    Heights
        With the tilt at zero unless Hotelling's T² calls it significant at three sigmas (0.27 %);
        the covariance knows what that leaves out.
    """
    pair = _Pair.of(reference, moving, horizontal, offset_at)
    if not pair.row.size:
        return Heights(horizontal.pivot, note="no heights in common; up is not known")
    place = _points(moving, pair.row, pair.col).mean(axis=0)
    start = Heights(place)
    first = pair.differences(start.transform(horizontal))[0]
    start = replace(start, up=float(np.median(first)))
    everything, note = pair, ""
    pair = everything.where_detail_recurs(start.transform(horizontal))
    free, plane = _settled(pair, horizontal, start, tilted=True)
    sheet = 0.0
    if plane is None:
        pair, note = everything, NO_DETAIL
        sheet = SHEET
        free, plane = _settled(pair, horizontal, start, tilted=True)
    if plane is None:
        return _unblocked(pair, horizontal, start)
    tilt = float(np.hypot(*free.tilt))
    significant = _significant(free.tilt, plane, sheet)
    if significant and tilt > MAX_TILT:
        degrees = np.rad2deg(tilt)
        doubt = f"the surveys are tilted against each other by {degrees:.1f}°, beyond 3°"
        level, _ = _settled(pair, horizontal, start, tilted=False)
        return replace(level, covariance=_covariance(plane, sheet), doubt=doubt, note=note)
    left_out = np.zeros((3, 3))
    if not significant:
        level, found = _settled(pair, horizontal, start, tilted=False)
        if found is not None:
            left_out[1:, 1:] = np.outer(free.tilt, free.tilt)
            free, plane = level, found
    covariance = _covariance(plane, sheet) + left_out
    return replace(free, covariance=covariance, kept=plane.kept, sigma=plane.sigma, note=note)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Both DEMs, ready to be compared at any lift and tilt.

    The reference's heights are a cubic spline; `inner` tells where its cells can be trusted. The
    moving cells (N,) that fall there are compared, `bend` [m] (N, 2) beside where the rigid motion
    leads; those in `counts` tell the answer.
    """

    reference: SurveyRaster
    moving: SurveyRaster
    spline: Float64
    base: float
    row: Index
    col: Index
    bend: Float64
    counts: Bool

    @classmethod
    def of(
        cls,
        reference: SurveyRaster,
        moving: SurveyRaster,
        horizontal: Transform,
        offset_at: OffsetAt | None,
    ) -> _Pair:
        from scipy.ndimage import binary_erosion, distance_transform_edt, spline_filter

        row, col = np.nonzero(moving.valid)
        nothing = np.zeros((0, 2))
        if not reference.valid.any() or not row.size:
            none = row[:0]
            flat = np.zeros(reference.grid.shape)
            return cls(reference, moving, flat, 0.0, none, none, nothing, none.astype(bool))
        # empty cells take their nearest neighbour's height, lest the spline ring at the edges
        near = distance_transform_edt(~reference.valid, return_distances=False, return_indices=True)
        height = reference.height.astype(np.float64)[tuple(near)]
        base = float(np.median(height))
        inner = binary_erosion(reference.valid, np.ones((3, 3)), border_value=1)
        bend = _bend(moving, horizontal, offset_at)[row, col]
        there = horizontal.apply(_points(moving, row, col))[:, :2] + bend
        at = np.rint(np.stack(reference.grid.row_col(*there.T))).astype(int)
        inside = np.all((at >= 0) & (at < np.array(inner.shape)[:, None]), axis=0)
        inside[inside] = inner[tuple(at[:, inside])]
        spline, row, col = spline_filter(height - base, 3), row[inside], col[inside]
        base, everything = base + reference.datum, np.ones(len(row), bool)
        return cls(reference, moving, spline, base, row, col, bend[inside], everything)

    @cached_property
    def points(self) -> Float64:
        """(N, 3) [m] as the moving survey was delivered."""
        return _points(self.moving, self.row, self.col)

    def differences(self, transform: Transform) -> tuple[Float64, Float64]:
        """Return reference less moved height [m] of each cell, and the moved points (N, 3)."""
        from scipy.ndimage import map_coordinates

        points = transform.apply(self.points)
        there = points[:, :2] + self.bend
        at = np.stack(self.reference.grid.row_col(*there.T))
        height = map_coordinates(self.spline, at, order=3, prefilter=False, mode="mirror")
        return height + self.base - points[:, 2], points

    def where_detail_recurs(self, transform: Transform) -> _Pair:
        """Return the pair that counts only recurring ground; none of it, where there is little."""
        difference, points = self.differences(transform)
        known = np.zeros(self.moving.grid.shape, bool)
        known[self.row, self.col] = True
        heights = np.zeros((2, *known.shape))
        heights[:, self.row, self.col] = points[:, 2] + difference, points[:, 2]
        counts = recurring(heights[0], heights[1], known)[self.row, self.col]
        return replace(self, counts=counts & (counts.mean() >= LEAST_RECURRING))


def _bend(moving: SurveyRaster, horizontal: Transform, offset_at: OffsetAt | None) -> Float64:
    """(H, W, 2) [m]: where each moving cell's ground is, beside where the rigid motion leads."""
    from scipy.ndimage import map_coordinates

    shape = moving.grid.shape
    if offset_at is None:
        return np.zeros((*shape, 2))
    axes = [np.arange(0, length + BEND_STEP, BEND_STEP) for length in shape]
    row, col = np.meshgrid(*axes, indexing="ij")
    places = np.stack(moving.grid.east_north(row.ravel(), col.ravel()), axis=1)
    level = np.column_stack([places, np.full(len(places), horizontal.pivot[2])])
    beside = places + offset_at(places) - horizontal.apply(level)[:, :2]
    at = np.indices(shape) / BEND_STEP
    parts = [map_coordinates(part.reshape(row.shape), at, order=1) for part in beside.T]
    return np.stack(parts, axis=-1)


@dataclass(frozen=True, eq=False)
class _Plane:
    """One weighted plane through the blocks: its step, and what its covariance is made of."""

    step: Float64  # (3,) up [m], tilt about east and north [rad]
    design: Float64  # (B, 3)
    cells: Float64  # (B,) common cells: the weights
    depart: Float64  # (B,) from the slow bending [m]; 0 where a block was not believed
    noise: Float64  # (B,) from the neighbours [m]; likewise
    lattice: tuple[Index, Index]  # (B,) row and column of the blocks
    terms: int  # of the bending that `depart` is free of
    choice: float  # change of up if nothing is left out [m]
    unseen: float  # what the bending may do where no ground counts [m]
    leverage: Float64  # (3, 3) what an error of 1 m does to the step if it is as bad as can be
    kept: float
    sigma: float
    ground: UInt8  # (H, W) of the moving DEM


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
    points = _points(moved, row, col)
    if warp is not None:  # its displacement changes by millimetres over itself: no inverse needed
        points = points - warp.displacement(points)
    points = transform.inverse().apply(points)
    there = np.rint(np.stack(grid.row_col(points[:, 0], points[:, 1]))).astype(int)
    inside = ((there >= 0) & (there < np.array(grid.shape)[:, None])).all(axis=0)
    laid = np.zeros(moved.grid.shape, np.uint8)
    laid[row[inside], col[inside]] = ground[tuple(there[:, inside])]
    return laid


def _points(raster: SurveyRaster, row: Index, col: Index) -> Float64:
    east, north = raster.grid.east_north(row, col)
    up = raster.height[row, col].astype(np.float64) + raster.datum
    return np.stack([east, north, up], axis=1)


def _settled(
    pair: _Pair, horizontal: Transform, start: Heights, *, tilted: bool
) -> tuple[Heights, _Plane | None]:
    """Step until the plane lies still; None where the blocks are too few."""
    answer, plane = start, None
    for _ in range(8):
        plane = _plane(pair, answer.transform(horizontal), start.place, tilted=tilted)
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


def _plane(pair: _Pair, transform: Transform, place: Float64, *, tilted: bool) -> _Plane | None:
    difference, points = pair.differences(transform)
    row, col, counts = pair.row, pair.col, pair.counts
    if not counts.any():
        return None
    span = min(np.ptp(row), np.ptp(col)) + 1
    side = int(np.clip(span // 20, 8, 16))
    block, number = numbered(row[counts] // side, col[counts] // side)
    ground, cells, kept, held = block_grounds(difference[counts], number, block.shape[0])
    known = cells >= 0.25 * side**2
    if known.sum() < MIN_BLOCKS:
        return None
    middle = np.stack(
        [np.bincount(number, points[counts, k], len(cells)) / cells for k in (0, 1)], axis=1
    )
    arm = (middle - transform.apply(place)[:2])[known]
    design = np.stack([np.ones(len(arm)), arm[:, 1], -arm[:, 0]], axis=1)
    value, weight = ground[known], cells[known].astype(np.float64)
    lattice = block[known] - block[known].min(axis=0)
    wild = ~largest_sheet(lattice, value, weight, LEAST_STEP * pair.moving.grid.cell)
    bent, terms = slow_bending(arm, weight, value, ~wild)
    rest = value - bent
    around = neighbours(lattice, np.where(wild, np.nan, rest))
    depart = rest - around
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(depart[~wild])))
    wild |= np.abs(depart) > BLOCK_CUT * sigma + ROUNDING
    told = np.isfinite(around)  # far from all that are believed nothing tells a block's height
    weight = np.where(told, weight, 0.0)
    around = np.where(told, around, rest)
    value = np.where(wild, bent + around, value)
    step = least_squares(design, weight, value)
    bending = float(np.sqrt(np.average((value - design @ step) ** 2, weights=weight)))
    if not tilted:
        step = np.array([np.average(value, weights=weight), 0.0, 0.0])
    believed = np.full(len(cells), UNKNOWN, np.uint8)
    believed[known] = np.where(wild, SET_ASIDE, STABLE)
    state = np.zeros(pair.moving.grid.shape, np.uint8)
    state[row, col] = CHANGED
    counted = np.where((believed[number] == STABLE) & ~held, CHANGED, believed[number])
    state[row[counts], col[counts]] = counted
    turned = points[:, :2] - transform.apply(place)[:2]
    everywhere = np.column_stack([np.ones(len(row)), turned[:, 1], -turned[:, 0]])
    flat = difference - everywhere @ step
    wider = _wider(everywhere, design, weight, side * pair.moving.grid.cell)
    unseen = (1.0 - float(weight.sum()) / len(row)) * bending * wider
    return _Plane(
        step,
        design,
        weight,
        np.where(wild, 0.0, rest),
        np.where(wild, 0.0, rest - around),
        (lattice[:, 0], lattice[:, 1]),
        terms,
        float(np.median(flat)),
        unseen,
        len(row) * np.linalg.pinv(everywhere.T @ everywhere, hermitian=True),
        float((kept[known] * weight)[~wild].sum() / len(row)),
        sigma,
        state,
    )


def _wider(everywhere: Float64, design: Float64, weight: Float64, block: float) -> float:
    """By how much more all the ground departs from a plane than the ground that counts shows.

    Bends grow with the width over which they are seen: rough ones by its root, a dome by its
    square. Taken as the width itself, where the ground that counts is the narrowest beside all.
    """
    from scipy.linalg import eigh

    middle = np.average(design[:, 1:], axis=0, weights=weight)
    seen, every = design[:, 1:] - middle, everywhere[:, 1:] - middle
    narrow = (seen * weight[:, None]).T @ seen / weight.sum() + block**2 / 12 * np.eye(2)
    ratio = eigh(every.T @ every / len(every), narrow, eigvals_only=True)
    return max(1.0, float(np.sqrt(ratio[-1])))


def _covariance(plane: _Plane, sheet: float) -> Float64:
    """Covariance of (up, tilt_east, tilt_north); `sheet` [m] is what nothing else tells of.

    The bending's mean over all ground belongs to `up`; only what departs from the neighbours makes
    that err. A tilt hangs on the rim, and with it on how the models bend there.
    """
    covariance, _ = _sandwich(plane, plane.depart)
    alone, _ = _sandwich(plane, plane.noise)
    if covariance[0, 0] > alone[0, 0]:
        less = np.sqrt(alone[0, 0] / covariance[0, 0])
        covariance[0] *= less
        covariance[:, 0] *= less
    covariance[0, 0] += plane.choice**2
    return covariance + (plane.unseen**2 + sheet**2) * plane.leverage


def _sandwich(plane: _Plane, errors: Float64) -> tuple[Float64, int]:
    """Return the sandwich of the blocks' errors, and over how many parcels it was taken."""
    _, parcel = numbered(*(a // _parcel_side(plane, errors) for a in plane.lattice))
    curvature = (plane.design * plane.cells[:, None]).T @ plane.design
    scores = plane.design * (plane.cells * errors)[:, None]
    return block_sandwich(curvature, scores, parcel, plane.terms), int(parcel.max()) + 1


def _parcel_side(plane: _Plane, errors: Float64) -> int:
    """Blocks to a parcel's side: two correlation lengths (to 1/e) of the errors, rounded up."""
    row, col = plane.lattice
    table = np.full((int(row.max()) + 1, int(col.max()) + 1), np.nan)
    table[row, col] = errors
    variance = float(np.nanmean(table**2))
    length = 1
    for lag in range(1, max(2, min(table.shape) // 3)):
        pairs = [table[lag:] * table[:-lag], table[:, lag:] * table[:, :-lag]]
        products = np.concatenate([p[np.isfinite(p)] for p in pairs])
        length = lag
        if products.size == 0 or products.mean() < variance / np.e:
            break
    return max(1, min(2 * length, min(table.shape) // 3))


def _significant(tilt: Float64, plane: _Plane, sheet: float) -> bool:
    """Hotelling's T² at three sigmas, since the parcels may be few."""
    from scipy.special import fdtri

    covariance, parcels = _sandwich(plane, plane.depart)
    freedom = max(parcels - 3, 1)
    limit = 2 * (freedom + 1) / freedom * float(fdtri(2, freedom, 0.9973))
    squared = (covariance + (plane.unseen**2 + sheet**2) * plane.leverage)[1:, 1:]
    if np.hypot(*tilt) < 1e-9:  # rounding
        return False
    return bool(tilt @ np.linalg.pinv(squared, hermitian=True) @ tilt > limit)


def _unblocked(pair: _Pair, horizontal: Transform, start: Heights) -> Heights:
    """Too little ground for blocks: the median, as uncertain as a single cell."""
    difference, _ = pair.differences(start.transform(horizontal))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(difference - np.median(difference))))
    covariance = np.diag([spread**2, MAX_TILT**2 / 9, MAX_TILT**2 / 9])
    return replace(
        start, covariance=covariance, kept=1.0, note="too little common ground to measure tilt"
    )
