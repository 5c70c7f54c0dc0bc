"""Height and tilt, once east, north and yaw are known.

Robust against change, yet uniform over the ground: growth, loss and loose things are left out
inside each block of cells, and a block that says nothing is told by its neighbours, but the slow
bending of the models is kept with equal weight everywhere. So the answer is the best rigid fit
over all ground that both surveys see, not the fit to where the models happen to agree.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from meshreg.ground import (
    BLOCK_CUT,
    MAD_TO_SIGMA,
    ROUNDING,
    Index,
    block_grounds,
    least_squares,
    neighbours,
    numbered,
    slow_bending,
)
from meshreg.sandwich import block_sandwich
from meshreg.types import Bool, Float64, Grid, SurveyRaster, Transform, UInt8, Warp

MAX_TILT = np.deg2rad(3.0)
MIN_BLOCKS = 12
# What a cell of ground was for the height and the tilt: not compared; changed against the ground
# around it; in a block that changed as a whole, which is told by its neighbours; counted.
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
        return replace(self, tilt=np.zeros(2), note=note)


def rotation(tilt: Float64) -> Float64:
    """(3, 3) rotation by the vector (tilt about east, tilt about north, 0) [rad] (Rodrigues)."""
    a, b = float(tilt[0]), float(tilt[1])
    angle = float(np.hypot(a, b))
    k = np.array([[0.0, 0.0, b], [0.0, 0.0, -a], [-b, a, 0.0]])
    # sin(x)/x and (1 - cos x)/x², which np.sinc gives without dividing by a small angle
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * k @ k
    )


def fit_heights(reference: SurveyRaster, moving: SurveyRaster, horizontal: Transform) -> Heights:
    """Lift and tilt of the moving survey, from raw height differences.

    The difference ``dz = reference - moving`` at a moved cell is modelled as
    ``up + tilt_east * (n - n0) - tilt_north * (e - e0)``. Each block's ground is the trimmed mean
    around the centre of its shortest half (least trimmed squares: Rousseeuw and Leroy 1987,
    chapter 4), a block that departs from its neighbours by over four deviations is told by them,
    and the plane is the least-squares fit with a weight of one for each common cell. Since the
    moved cells are looked up anew after each step, relief does not bias a large tilt.

    The covariance is the block sandwich of the blocks' departures from a slow bending (a cubic in
    east and north), over parcels at least two correlation lengths of these departures wide: the
    slow bending itself moves the best fit over all ground as much as this one. Added to the
    variance of `up` is the square of how much it changes if nothing is left out (median of all
    cells): when much has changed, what counts as stable ground is a choice.

    Parameters
    ----------
    reference, moving : SurveyRaster
        DEMs as delivered, each on its own grid.
    horizontal : Transform
        `reference_from_moving` in east, north and yaw.

    Returns
    -------
    Heights
        With the tilt at zero unless Hotelling's T² calls it significant at three sigmas (0.27 %).
    """
    surface = _Surface.of(reference)
    place = _centroid(surface, moving, horizontal)
    if place is None:
        return Heights(horizontal.pivot, note="no heights in common; up is not known")
    start = Heights(place)
    start = replace(start, up=_median_step(surface, moving, start.transform(horizontal)))
    free, plane = _settled(surface, moving, horizontal, start, tilted=True)
    if plane is None:
        return _unblocked(surface, moving, horizontal, start)
    tilt = float(np.hypot(*free.tilt))
    if _significant(free.tilt, plane) and tilt > MAX_TILT:
        degrees = np.rad2deg(tilt)
        doubt = f"the surveys are tilted against each other by {degrees:.1f}°, beyond 3°"
        level, _ = _settled(surface, moving, horizontal, start, tilted=False)
        return replace(level, covariance=_covariance(plane), doubt=doubt)
    if not _significant(free.tilt, plane):
        level, found = _settled(surface, moving, horizontal, start, tilted=False)
        free, plane = (level, found) if found is not None else (free, plane)
    return replace(free, covariance=_covariance(plane), kept=plane.kept, sigma=plane.sigma)


@dataclass(frozen=True, eq=False)
class _Surface:
    """The reference's heights as a cubic spline, and where its cells can be trusted."""

    raster: SurveyRaster
    spline: Float64
    base: float
    inner: Bool

    @classmethod
    def of(cls, raster: SurveyRaster) -> _Surface:
        from scipy.ndimage import binary_erosion, distance_transform_edt, spline_filter

        if not raster.valid.any():
            return cls(raster, np.zeros(raster.grid.shape), 0.0, raster.valid)
        # empty cells take their nearest neighbour's height, lest the spline ring at the edges
        near = distance_transform_edt(~raster.valid, return_distances=False, return_indices=True)
        height = raster.height.astype(np.float64)[tuple(near)]
        base = float(np.median(height))
        inner = binary_erosion(raster.valid, np.ones((3, 3)), border_value=1)
        return cls(raster, spline_filter(height - base, 3), base + raster.datum, inner)

    def differences(
        self, moving: SurveyRaster, transform: Transform
    ) -> tuple[Float64, Float64, Index, Index]:
        """Return reference less moved height [m], the moved points (N, 3), their row and column."""
        from scipy.ndimage import map_coordinates

        row, col = np.nonzero(moving.valid)
        points = transform.apply(_points(moving, row, col))
        at = np.stack(self.raster.grid.row_col(points[:, 0], points[:, 1]))
        near = np.rint(at).astype(int)
        rows, cols = self.raster.grid.shape
        inside = (near[0] >= 0) & (near[0] < rows) & (near[1] >= 0) & (near[1] < cols)
        inside[inside] = self.inner[near[0, inside], near[1, inside]]
        at, points = at[:, inside], points[inside]
        height = map_coordinates(self.spline, at, order=3, prefilter=False, mode="mirror")
        return height + self.base - points[:, 2], points, row[inside], col[inside]


@dataclass(frozen=True, eq=False)
class _Plane:
    """One weighted plane through the blocks: its step, and what its covariance is made of."""

    step: Float64  # (3,) up [m], tilt about east and north [rad]
    design: Float64  # (B, 3)
    cells: Float64  # (B,) common cells: the weights
    depart: Float64  # (B,) from the neighbours [m]; 0 where a block was not believed
    lattice: tuple[Index, Index]  # (B,) row and column of the blocks
    terms: int  # of the bending that `depart` is free of
    choice: float  # change of up if nothing is left out [m]
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


def _centroid(surface: _Surface, moving: SurveyRaster, horizontal: Transform) -> Float64 | None:
    _, _, row, col = surface.differences(moving, horizontal)
    return _points(moving, row, col).mean(axis=0) if len(row) else None


def _median_step(surface: _Surface, moving: SurveyRaster, transform: Transform) -> float:
    return float(np.median(surface.differences(moving, transform)[0]))


def _settled(
    surface: _Surface,
    moving: SurveyRaster,
    horizontal: Transform,
    start: Heights,
    *,
    tilted: bool,
) -> tuple[Heights, _Plane | None]:
    """Step until the plane lies still; None where the blocks are too few."""
    answer, plane = start, None
    for _ in range(8):
        whole = answer.transform(horizontal)
        plane = _plane(surface, moving, whole, tilted=tilted)
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


def _plane(
    surface: _Surface, moving: SurveyRaster, transform: Transform, *, tilted: bool
) -> _Plane | None:
    difference, points, row, col = surface.differences(moving, transform)
    if len(row) == 0:
        return None
    span = min(np.ptp(row), np.ptp(col)) + 1
    side = int(np.clip(span // 20, 8, 16))
    block, number = numbered(row // side, col // side)
    ground, cells, kept, held = block_grounds(difference, number, block.shape[0])
    known = cells >= 0.25 * side**2
    if known.sum() < MIN_BLOCKS:
        return None
    middle = np.stack(
        [np.bincount(number, points[:, k], len(cells)) / cells for k in (0, 1)], axis=1
    )
    centre = (middle * cells[:, None]).sum(axis=0) / cells.sum()
    arm = (middle - centre)[known]
    design = np.stack([np.ones(len(arm)), arm[:, 1], -arm[:, 0]], axis=1)
    value, weight = ground[known], cells[known].astype(np.float64)
    bent, terms = slow_bending(arm, weight, value)
    rest = value - bent
    wild = np.abs(rest) > BLOCK_CUT * MAD_TO_SIGMA * float(np.median(np.abs(rest))) + ROUNDING
    lattice = block[known] - block[known].min(axis=0)
    around = neighbours(lattice, np.where(wild, np.nan, rest))
    depart = rest - around
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(depart[~wild])))
    wild |= np.abs(depart) > BLOCK_CUT * sigma + ROUNDING
    value = np.where(wild, bent + around, value)
    step = least_squares(design, weight, value) if tilted else np.zeros(3)
    step[0] = np.average(value, weights=weight)
    believed = np.full(len(cells), UNKNOWN, np.uint8)
    believed[known] = np.where(wild, SET_ASIDE, STABLE)
    state = np.zeros(moving.grid.shape, np.uint8)
    state[row, col] = np.where((believed[number] == STABLE) & ~held, CHANGED, believed[number])
    flat = difference - step[0]
    if tilted:
        flat = flat - step[1] * (points[:, 1] - centre[1]) + step[2] * (points[:, 0] - centre[0])
    return _Plane(
        step,
        design,
        weight,
        np.where(wild, 0.0, rest),
        (lattice[:, 0], lattice[:, 1]),
        terms,
        float(np.median(flat)),
        float((kept[known] * weight)[~wild].sum() / weight.sum()),
        sigma,
        state,
    )


def _covariance(plane: _Plane) -> Float64:
    """Covariance of (up, tilt_east, tilt_north)."""
    covariance, _ = _sandwich(plane)
    covariance[0, 0] += plane.choice**2
    return covariance


def _sandwich(plane: _Plane) -> tuple[Float64, int]:
    """Return the sandwich, and over how many parcels it was taken."""
    _, parcel = numbered(*(a // _parcel_side(plane) for a in plane.lattice))
    curvature = (plane.design * plane.cells[:, None]).T @ plane.design
    scores = plane.design * (plane.cells * plane.depart)[:, None]
    return block_sandwich(curvature, scores, parcel, plane.terms), int(parcel.max()) + 1


def _parcel_side(plane: _Plane) -> int:
    """Blocks to a parcel's side: two correlation lengths (to 1/e) of the departures, rounded up."""
    row, col = plane.lattice
    table = np.full((int(row.max()) + 1, int(col.max()) + 1), np.nan)
    table[row, col] = plane.depart
    variance = float(np.nanmean(table**2))
    length = 1
    for lag in range(1, max(2, min(table.shape) // 3)):
        pairs = [table[lag:] * table[:-lag], table[:, lag:] * table[:, :-lag]]
        products = np.concatenate([p[np.isfinite(p)] for p in pairs])
        length = lag
        if products.size == 0 or products.mean() < variance / np.e:
            break
    return max(1, min(2 * length, min(table.shape) // 3))


def _significant(tilt: Float64, plane: _Plane) -> bool:
    """Hotelling's T² at three sigmas, since the parcels may be few."""
    from scipy.special import fdtri

    covariance, parcels = _sandwich(plane)
    freedom = max(parcels - 3, 1)
    limit = 2 * (freedom + 1) / freedom * float(fdtri(2, freedom, 0.9973))
    squared = covariance[1:, 1:]
    if np.hypot(*tilt) < 1e-9:  # rounding
        return False
    return bool(tilt @ np.linalg.pinv(squared, hermitian=True) @ tilt > limit)


def _unblocked(
    surface: _Surface, moving: SurveyRaster, horizontal: Transform, start: Heights
) -> Heights:
    """Too little ground for blocks: the median, as uncertain as a single cell."""
    difference = surface.differences(moving, start.transform(horizontal))[0]
    spread = MAD_TO_SIGMA * float(np.median(np.abs(difference - np.median(difference))))
    covariance = np.diag([spread**2, MAX_TILT**2 / 9, MAX_TILT**2 / 9])
    return replace(
        start, covariance=covariance, kept=1.0, note="too little common ground to measure tilt"
    )
