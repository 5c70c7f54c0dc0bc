"""Two DEMs, compared at any lift and tilt of the moving one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from meshreg.height.ground import Index, recurring
from meshreg.records import Bool, Float64, OffsetAt, SurveyRaster, Transform

LEAST_RECURRING = 0.1  # share of the common cells; with less, all of them are asked
BEND_STEP = 8  # cells between the places at which the bending is computed


@dataclass(frozen=True, eq=False)
class DemPair:
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
    ) -> DemPair:
        """Prepare the moving cells that a horizontal motion lays on trusted reference cells."""
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
        there = horizontal.apply(points_of(moving, row, col))[:, :2] + bend
        at = np.rint(np.stack(reference.grid.row_col(*there.T))).astype(int)
        inside = np.all((at >= 0) & (at < np.array(inner.shape)[:, None]), axis=0)
        inside[inside] = inner[tuple(at[:, inside])]
        spline, row, col = spline_filter(height - base, 3), row[inside], col[inside]
        base, everything = base + reference.datum, np.ones(len(row), bool)
        return cls(reference, moving, spline, base, row, col, bend[inside], everything)

    @cached_property
    def points(self) -> Float64:
        """(N, 3) [m] as the moving survey was delivered."""
        return points_of(self.moving, self.row, self.col)

    def differences(self, transform: Transform) -> tuple[Float64, Float64]:
        """Return reference less moved height [m] of each cell, and the moved points (N, 3)."""
        from scipy.ndimage import map_coordinates

        points = transform.apply(self.points)
        there = points[:, :2] + self.bend
        at = np.stack(self.reference.grid.row_col(*there.T))
        height = map_coordinates(self.spline, at, order=3, prefilter=False, mode="mirror")
        return height + self.base - points[:, 2], points

    def where_detail_recurs(self, transform: Transform, least: float = LEAST_RECURRING) -> DemPair:
        """Return the pair that counts only recurring ground; none where that is under `least`."""
        difference, points = self.differences(transform)
        known = np.zeros(self.moving.grid.shape, bool)
        known[self.row, self.col] = True
        heights = np.zeros((2, *known.shape))
        heights[:, self.row, self.col] = points[:, 2] + difference, points[:, 2]
        counts = recurring(heights[0], heights[1], known)[self.row, self.col]
        return replace(self, counts=counts & (counts.mean() >= least))


def points_of(raster: SurveyRaster, row: Index, col: Index) -> Float64:
    """(N, 3) float64: the absolute places [m] of a raster's cells."""
    east, north = raster.grid.east_north(row, col)
    up = raster.height[row, col].astype(np.float64) + raster.datum
    return np.stack([east, north, up], axis=1)


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
