"""The plane through the height differences of the ground that counts, and how sure it is.

Each block's ground is where most of its cells agree (`height.ground`). Blocks that changed as a
whole are told by their neighbours, and the plane is the least-squares fit of all with a weight of
one for each cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from meshreg.height.dem_pair import DemPair
from meshreg.height.ground import (
    BLOCK_CUT,
    ROUNDING,
    Index,
    block_grounds,
    largest_sheet,
    least_squares,
    neighbours,
    numbered,
    slow_bending,
)
from meshreg.records import Bool, Float64, Transform, UInt8
from meshreg.statistics import MAD_TO_SIGMA, block_sandwich

MIN_BLOCKS = 12
# m: algal turf is several millimetres to centimetres tall (Connell, Foster and Airoldi, Marine
# Ecology Progress Series 495, 2014, doi:10.3354/meps10513). Its mean over the ground may have
# grown or gone by 1 cm, which is our assumption, not a figure of theirs, or by anything less: the
# deviation of a rectangular distribution (Guide to the Expression of Uncertainty in Measurement,
# 4.3.7).
COVER = 0.01 / np.sqrt(3)
NODES = 300  # places that stand for the ground, seen or not
LEAST_STEP = 0.1  # cells: what parts two blocks that did not change alike is higher than that
# What a cell of ground was for the height and the tilt: not compared; changed, or without detail
# that recurs; in a block that changed as a whole, which is told by its neighbours; counted.
UNKNOWN, CHANGED, SET_ASIDE, STABLE = range(4)


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """One weighted plane through the blocks: its step, and what its covariance is made of.

    Attributes
    ----------
    step : (3,) float64
        Up [m] at the place, turns about the east and the north axis [rad].
    design : (B, 3) float64
    weight : (B,) float64
        Cells of each block.
    depart, noise : (B,) float64
        How far each block is from the slow bending, and from its neighbours [m]; 0 where it was
        not believed.
    lattice : (B, 2) int
        Row and column of each block.
    terms : int
        Of the bending that `depart` is free of.
    choice : float
        Change of up if all the ground counts whose detail recurs [m].
    unseen : float
        What the bending may do where no ground counts, to the tilt [m].
    beside : float
        Deviation of the bending's mean over all ground from that over the ground that counts [m].
    leverage : (3, 3) float64
        What an error of 1 m does to the step if it is as bad as can be.
    kept : float
        Share of the common cells that count as unchanged ground.
    sigma : float
        Robust deviation of the blocks from their neighbours' median [m].
    ground : (H, W) uint8
        What each cell of the moving DEM was.
    """

    step: Float64
    design: Float64
    weight: Float64
    depart: Float64
    noise: Float64
    lattice: Index
    terms: int
    choice: float
    unseen: float
    beside: float
    leverage: Float64
    kept: float
    sigma: float
    ground: UInt8

    def covariance(self, sheet: float = 0.0) -> Float64:
        """Covariance (3, 3) of the step; `sheet` [m] is what ground may do that nothing tells of.

        The bending's mean over all ground belongs to up; only what departs from the neighbours
        makes that err. A tilt hangs on the rim, and with it on how the models bend there. What
        covers the ground is one-sided (turf and crusts add, wear takes away), and no height
        difference tells its mean from up: what covers half the ground has a mean as large as its
        spread, and blocks show that spread; but what keeps the detail beneath it is thin (`COVER`).
        The truth is up or what up is with nothing left out, or anything between.
        """
        covariance, alone = self._bending.copy(), self._sandwich(self.noise)
        if covariance[0, 0] > alone[0, 0]:
            less = np.sqrt(alone[0, 0] / covariance[0, 0])
            covariance[0] *= less
            covariance[:, 0] *= less
        covariance[0, 0] += max(self.choice**2 / 3, min(self.sigma, COVER) ** 2)
        return covariance + self._hidden(sheet)

    def tells(self, tilt: Float64, sheet: float = 0.0) -> bool:
        """Whether a tilt (2,) [rad] is significant: Hotelling's T² at three sigmas (0.27 %)."""
        from scipy.special import fdtri

        if np.hypot(*tilt) < 1e-9:  # rounding
            return False
        freedom = max(int(self._parcels(self.depart).max()) - 2, 1)  # parcels may be few
        limit = 2 * (freedom + 1) / freedom * float(fdtri(2, freedom, 0.9973))
        covariance = (self._bending + self._hidden(sheet))[1:, 1:]
        return bool(tilt @ np.linalg.pinv(covariance, hermitian=True) @ tilt > limit)

    @cached_property
    def _bending(self) -> Float64:
        return self._sandwich(self.depart)

    def _hidden(self, sheet: float) -> Float64:
        hidden = self.unseen**2 * self.leverage
        hidden[0] = hidden[:, 0] = 0.0  # up is stated at the middle of all ground
        hidden[0, 0] = self.beside**2
        return hidden + sheet**2 * self.leverage

    def _sandwich(self, errors: Float64) -> Float64:
        curvature = (self.design * self.weight[:, None]).T @ self.design
        scores = self.design * (self.weight * errors)[:, None]
        return block_sandwich(curvature, scores, self._parcels(errors), self.terms)

    def _parcels(self, errors: Float64) -> Index:
        """Each block's parcel, from 0: two correlation lengths of the errors wide, rounded up."""
        row, col = self.lattice.T
        table = np.full((int(row.max()) + 1, int(col.max()) + 1), np.nan)
        table[row, col] = errors
        variance = float(np.nanmean(table**2))
        length = 1  # to 1/e
        for lag in range(1, max(2, min(table.shape) // 3)):
            pairs = [table[lag:] * table[:-lag], table[:, lag:] * table[:, :-lag]]
            products = np.concatenate([p[np.isfinite(p)] for p in pairs])
            length = lag
            if products.size == 0 or products.mean() < variance / np.e:
                break
        side = max(1, min(2 * length, min(table.shape) // 3))
        return numbered(row // side, col // side)[1]


@dataclass(frozen=True, eq=False)
class _Blocks:
    """The cells that count, in square blocks: B of them hold enough."""

    lattice: Index  # (B, 2) row and column, from 0
    arm: Float64  # (B, 2) east and north [m] from the place
    value: Float64  # (B,) their ground [m]
    weight: Float64  # (B,) cells
    agreed: Float64  # (B,) share of the cells on that ground
    width: float  # m
    number: Index  # (N,) block of each cell that counts, among all M
    known: Bool  # (M,) which of all are the B
    held: Bool  # (N,) whether a cell is on its block's ground

    @classmethod
    def of(cls, pair: DemPair, difference: Float64, arm: Float64) -> _Blocks | None:
        """Return None where they are too few."""
        row, col = pair.row[pair.counts], pair.col[pair.counts]
        if not row.size:
            return None
        span = min(np.ptp(pair.row), np.ptp(pair.col)) + 1
        side = int(np.clip(span // 20, 8, 16))
        lattice, number = numbered(row // side, col // side)
        count = len(lattice)
        value, cells, agreed, held = block_grounds(difference[pair.counts], number, count)
        known = cells >= 0.25 * side**2
        if known.sum() < MIN_BLOCKS:
            return None
        sums = [np.bincount(number, part, count) for part in arm[pair.counts].T]
        middle = (np.stack(sums, axis=1) / cells[:, None])[known]
        lattice = lattice[known] - lattice[known].min(axis=0)
        weight = cells[known].astype(np.float64)
        width = side * pair.moving.grid.cell
        told = value[known], weight, agreed[known]
        return cls(lattice, middle, *told, width, number, known, held)


def fit_plane(
    pair: DemPair, transform: Transform, place: Float64, *, tilted: bool
) -> GroundPlane | None:
    """Fit the plane through ``reference - moving``, the moving DEM laid down by the transform.

    Blocks that a step or four deviations part from the others are told by their neighbours.

    Parameters
    ----------
    pair : DemPair
    transform : Transform
        `reference_from_moving`.
    place : (3,) float64
        In moving coordinates, where `up` is stated.
    tilted : bool
        Whether the plane may be tilted.

    Returns
    -------
    GroundPlane or None
        None where the blocks are too few.
    """
    difference, points = pair.differences(transform)
    arm = points[:, :2] - transform.apply(place)[:2]
    blocks = _Blocks.of(pair, difference, arm)
    if blocks is None:
        return None
    lattice, weight = blocks.lattice, blocks.weight
    wild = ~largest_sheet(lattice, blocks.value, weight, LEAST_STEP * pair.moving.grid.cell)
    bent, terms = slow_bending(blocks.arm, weight, blocks.value, ~wild)
    rest = blocks.value - bent
    around = neighbours(lattice, np.where(wild, np.nan, rest))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(rest - around)[~wild]))
    wild |= np.abs(rest - around) > BLOCK_CUT * sigma + ROUNDING
    told = np.isfinite(around)  # far from all that are believed nothing tells a block's height
    weight, around = np.where(told, weight, 0.0), np.where(told, around, rest)
    value = np.where(wild, bent + around, blocks.value)
    design, everywhere = _design(blocks.arm), _design(arm)
    step = least_squares(design, weight, value)
    bending = float(np.sqrt(np.average((value - design @ step) ** 2, weights=weight)))
    left = np.where(wild, np.nan, value - design @ step)
    wider = _wider(arm, blocks.arm, weight, blocks.width)
    if not tilted:
        step = np.array([np.average(value, weights=weight), 0.0, 0.0])
    hidden = 1.0 - float(weight.sum()) / len(arm)
    leverage = np.linalg.pinv(everywhere.T @ everywhere / len(arm), hermitian=True)
    return GroundPlane(
        step=step,
        design=design,
        weight=weight,
        depart=np.where(wild, 0.0, rest),
        noise=np.where(wild, 0.0, rest - around),
        lattice=lattice,
        terms=terms,
        choice=float(np.median((difference - everywhere @ step)[pair.counts])),
        unseen=hidden * bending * float(wider.max()),
        beside=np.sqrt(wider.mean()) * _between_means(lattice, left, blocks, arm, weight),
        leverage=np.asarray(leverage, np.float64),
        kept=float((blocks.agreed * weight)[~wild].sum() / len(arm)),
        sigma=sigma,
        ground=_states(pair, blocks, wild),
    )


def _design(arm: Float64) -> Float64:
    """(N, 3): what up and the turns about east and north do to the height at an arm (N, 2) [m]."""
    return np.column_stack([np.ones(len(arm)), arm[:, 1], -arm[:, 0]])


def _wider(every: Float64, seen: Float64, weight: Float64, width: float) -> Float64:
    """By how many times all the ground is wider than the ground that counts, along two axes (2,).

    Bends grow with the width over which they are seen: rough ones by its root, a dome by its
    square. The tilt takes the width itself where the ground that counts is the narrowest beside
    all; up the root, of both axes together, since its random field is a rough one.
    """
    from scipy.linalg import eigh

    middle = np.average(seen, axis=0, weights=weight)
    every, seen = every - middle, seen - middle
    narrow = (seen * weight[:, None]).T @ seen / weight.sum() + width**2 / 12 * np.eye(2)
    ratio = eigh(every.T @ every / len(every), narrow, eigvals_only=True)
    return np.asarray(np.sqrt(np.maximum(ratio, 1.0)))


def _between_means(
    lattice: Index, left: Float64, blocks: _Blocks, arm: Float64, weight: Float64
) -> float:
    """Deviation [m] of a mean of the bending over all ground from that over the blocks' ground.

    The bending as a random field with an exponential correlation: its variance and length are those
    of what blocks and their next neighbours have in common, which their own errors are no part of
    (variance of the difference of two block means; Cressie, Statistics for Spatial Data, 1993,
    section 2.4).
    """
    from scipy.spatial.distance import cdist

    table = np.full(lattice.max(axis=0) + 1, np.nan)
    table[tuple(lattice.T)] = left
    common = []
    for lag in range(1, max(2, min(table.shape) // 2)):
        pairs = [table[lag:] * table[:-lag], table[:, lag:] * table[:, :-lag]]
        products = np.concatenate([p[np.isfinite(p)] for p in pairs])
        common.append(float(products.mean()) if products.size else 0.0)
    if not common[0] > 0:
        return 0.0
    fallen = [k for k, value in enumerate(common) if value < common[0] / np.e]
    length = (fallen[0] if fallen else len(common)) * blocks.width
    variance = common[0] * np.exp(blocks.width / length)
    every = arm[:: -(-len(arm) // NODES)]
    seen = np.flatnonzero(weight > 0)[:: -(-len(weight) // NODES)]
    share = weight[seen] / weight[seen].sum()
    mine, other = blocks.arm[seen], np.full(len(every), 1 / len(every))
    apart = (
        other @ np.exp(-cdist(every, every) / length) @ other
        + share @ np.exp(-cdist(mine, mine) / length) @ share
        - 2 * other @ np.exp(-cdist(every, mine) / length) @ share
    )
    return float(np.sqrt(max(variance * apart, 0.0)))


def _states(pair: DemPair, blocks: _Blocks, wild: Bool) -> UInt8:
    """(H, W) uint8: what each cell of the moving DEM was."""
    of_block = np.full(len(blocks.known), UNKNOWN, np.uint8)
    of_block[blocks.known] = np.where(wild, SET_ASIDE, STABLE)
    of_cell = of_block[blocks.number]
    of_cell[(of_cell == STABLE) & ~blocks.held] = CHANGED
    state = np.zeros(pair.moving.grid.shape, np.uint8)
    state[pair.row, pair.col] = CHANGED
    state[pair.row[pair.counts], pair.col[pair.counts]] = of_cell
    return state
