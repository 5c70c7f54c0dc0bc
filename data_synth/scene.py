"""A pair before any file is made: two epochs of a seafloor, and a survey's view of each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data_synth.change import Event, apply_change
from data_synth.recipe import Recipe
from data_synth.seafloor import Bounds, Seafloor, make_seafloor
from data_synth.seeing import Lattice, Plan, Seeing, make_plan, see
from data_synth.sfm import Distortion, Sfm, identity, make_distortion
from meshreg.errors import UsageError
from meshreg.settings.checked import shown

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
UInt8 = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class View:
    """A lattice of one survey, without holes or noise.

    Attributes
    ----------
    lattice : Lattice
        Centred coordinates.
    up : (H, W) float32
        Height in the survey's own frame, centred [m].
    color : (H, W, 3) uint8
    winner : (H, W) int32
        Number of the feature on top, -1 for the ground.
    """

    lattice: Lattice
    up: Float32
    color: UInt8
    winner: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Take:
    """One survey: what lay there, how it was seen, how the reconstruction placed it.

    "Centred" coordinates are the survey's absolute ones minus ``distortion.start``.

    Attributes
    ----------
    name : "reference" or "moving"
    seafloor : Seafloor
    seeing : Seeing
    plan : Plan
    sfm : Sfm
    distortion : Distortion
        The identity for the reference.
    footprint : Bounds
        Of the area surveyed, centred [m], before its edge was frayed.
    seed : int
        Of holes, edges, noise.
    """

    name: str
    seafloor: Seafloor
    seeing: Seeing
    plan: Plan
    sfm: Sfm
    distortion: Distortion
    footprint: Bounds
    seed: int

    def world(self, east: Float64, north: Float64) -> tuple[Float64, Float64, Float64]:
        """World x, y and the warp's upward part of the surface above a lattice.

        Parameters
        ----------
        east, north : (W,), (H,) float64
            Centred coordinates [m].

        Returns
        -------
        x, y, lift : (H, W) float64 [m]
        """
        from data_synth.sfm_kernels import lattice_to_world

        linear, warp = self.distortion.linear, self.distortion.warp
        if np.abs(linear[:2, 2]).max() > 0:
            guess = self._coarse_height(east, north)
        else:
            guess = np.zeros((len(north), len(east)))
        x, y, lift = lattice_to_world(east, north, guess, linear, *warp)
        return x, y, lift

    def _coarse_height(self, east: Float64, north: Float64) -> Float64:
        """Surface height, linear between points 0.1 m apart: it only steers the tilt's parallax."""
        from scipy.ndimage import map_coordinates

        from data_synth.sfm_kernels import lattice_height, lattice_to_world

        step = 0.10
        # whole multiples of the step, so that the strips of one survey meet without a seam
        e = np.arange(math.floor(east.min() / step) - 1, math.ceil(east.max() / step) + 2) * step
        n = (
            np.arange(math.ceil(north.max() / step) + 1, math.floor(north.min() / step) - 2, -1)
            * step
        )
        guess = np.zeros((len(n), len(e)))
        linear, warp = self.distortion.linear, self.distortion.warp
        for _ in range(2):
            x, y, lift = lattice_to_world(e, n, guess, linear, *warp)
            height = self.seafloor.height(x, y, 2 * step)
            guess = lattice_height(height, lift, e, n, linear)
        rows, cols = (n[0] - north) / step, (east - e[0]) / step
        fine: Float64 = map_coordinates(
            guess, np.meshgrid(rows, cols, indexing="ij"), order=1, mode="nearest"
        )
        return fine

    def sample(self, lattice: Lattice, progress: Callable[[float], None] | None = None) -> View:
        """Return what the survey shows of a lattice: worked in strips, to spare memory."""
        from data_synth.sfm_kernels import lattice_height

        rows, cols = lattice.shape
        east, north = lattice.east, lattice.norths
        up, height = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
        albedo = np.empty((rows, cols, 3), np.float32)
        winner = np.empty((rows, cols), np.int32)
        strip = max(1, 1_000_000 // cols)
        for top in range(0, rows, strip):
            part = slice(top, min(rows, top + strip))
            x, y, lift = self.world(east, north[part])
            z, albedo[part], winner[part] = self.seafloor.evaluate(x, y, 1.5 * lattice.step)
            height[part] = z
            up[part] = lattice_height(z, lift, east, north[part], self.distortion.linear)
            if progress is not None:
                progress(part.stop / rows)
        mirror = bool(np.linalg.det(self.distortion.linear) < 0)
        color = see(height, albedo, lattice, self.seeing, self.plan, mirror)
        return View(lattice, up, color, winner)

    def margin(self, east: Float64, north: Float64) -> Float64:
        """How far centred points (any one shape) are inside what was reconstructed.

        Negative beyond the frayed edge and in holes; metres near the edge, a smooth measure near
        holes.
        """
        from data_synth.seeing_kernels import blotches

        west, south, right, top = self.footprint
        x, y = np.ascontiguousarray(east).ravel(), np.ascontiguousarray(north).ravel()
        inside = np.minimum(np.minimum(x - west, right - x), np.minimum(y - south, top - y))
        if self.sfm.ragged > 0:
            bay = np.clip(0.5 + 0.35 * blotches(x, y, self.seed, 1.8, 4), 0.0, 1.0)
            inside = inside - self.sfm.ragged * bay
        if self.sfm.holes > 0:
            whole = self._hole_level - blotches(x, y, self.seed + 1, 1.2, 4)
            inside = np.minimum(inside, 0.1 * whole)
        kept: Float64 = inside.reshape(np.shape(east))
        return kept

    def covered(self, east: Float64, north: Float64) -> Bool:
        """Whether centred points were reconstructed: inside the frayed edge, and in no hole."""
        return self.margin(east, north) > 0

    def margin_lattice(self, lattice: Lattice) -> Float32:
        """`margin` of a lattice, linear between points about 0.04 m apart."""
        import cv2

        rows, cols = lattice.shape
        times = max(1, round(0.04 / lattice.step))
        if times == 1:
            return self.margin(*np.meshgrid(lattice.east, lattice.norths)).astype(np.float32)
        half = (times - 1) / 2.0
        e = lattice.west + lattice.step * (half + times * np.arange(-(-cols // times)))
        n = lattice.north - lattice.step * (half + times * np.arange(-(-rows // times)))
        coarse = self.margin(*np.meshgrid(e, n)).astype(np.float32)
        size = (len(e) * times, len(n) * times)
        fine: Float32 = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)[:rows, :cols]
        return fine

    @cached_property
    def _hole_level(self) -> float:
        from data_synth.seeing_kernels import blotches

        west, south, east, north = self.footprint
        x, y = np.meshgrid(np.linspace(west, east, 80), np.linspace(south, north, 80))
        noise = blotches(x.ravel(), y.ravel(), self.seed + 1, 1.2, 4)
        return float(np.quantile(noise, 1.0 - self.sfm.holes))

    def height_noise(self, east: Float64, north: Float64) -> Float64:
        """Error of the reconstructed height [m]: smooth over a few mesh spacings."""
        from data_synth.seeing_kernels import blotches

        x, y = np.ascontiguousarray(east).ravel(), np.ascontiguousarray(north).ravel()
        grown: Float64 = blotches(x, y, self.seed + 2, 10.0 * self.sfm.mesh_spacing, 3)
        return (self.sfm.vertex_noise / 1.2 * grown).reshape(np.shape(east))


@dataclass(frozen=True, eq=False)
class Scene:
    """Two surveys of one place (or of two, when `other_ground`) and what changed between them."""

    recipe: Recipe
    seed: int
    size: float
    reference: Take
    moving: Take
    events: tuple[Event, ...]


def make_scene(recipe: Recipe, seed: int = 0, size: float | None = None) -> Scene:
    """Draw a pair: seafloor, change, light, distortion. Nothing is rendered yet.

    Parameters
    ----------
    recipe : Recipe
    seed : int
        Two scenes of one recipe and seed are equal to the last bit.
    size : float, optional
        Side of the patch [m]; the recipe's own by default.
    """
    size = recipe.output.size if size is None else float(size)
    if not 1 <= size <= 1000:
        raise UsageError(f"size is {size}; it must be a number from 1 to 1000 m.")
    if not 0 <= seed < 2**31:
        raise UsageError(f"seed is {shown(seed)}; it must be a whole number from 0 to {2**31 - 1}.")
    rng = np.random.default_rng([seed, 3])
    place = recipe.place
    centre = np.array([place.east, place.north, place.up])
    distortion = make_distortion(recipe.sfm, rng, centre, size)
    plans = [make_plan(seeing, rng) for seeing in (recipe.reference, recipe.moving)]
    shift = _footprint_shift(recipe.sfm, distortion, size, rng)
    seeds = [int(v) for v in rng.integers(0, 2**30, 3)]
    half = size / 2.0
    pad = 1.5 + 0.02 * size
    reach = half + pad + float(np.abs(shift).max())
    bounds = (-reach, -reach, reach, reach)
    world_seed = seeds[2]
    before = make_seafloor(recipe.site, world_seed, bounds)
    ground = make_seafloor(recipe.site, world_seed + 77, bounds) if place.other_ground else before
    after, events = apply_change(
        ground, recipe.site, world_seed + 77 * place.other_ground, recipe.change
    )
    if place.other_ground:
        distortion = _same_depth(distortion, before, after, half)
    reference = Take(
        "reference", before, recipe.reference, plans[0], recipe.sfm, identity(centre),
        (-half, -half, half, half), seeds[0],
    )  # fmt: skip
    moving = Take(
        "moving", after, recipe.moving, plans[1], recipe.sfm, distortion,
        (shift[0] - half, shift[1] - half, shift[0] + half, shift[1] + half), seeds[1],
    )  # fmt: skip
    return Scene(recipe, seed, size, reference, moving, events)


def _same_depth(distortion: Distortion, one: Seafloor, other: Seafloor, half: float) -> Distortion:
    """Lift the second survey so that its mean depth is the first one's."""
    side = np.linspace(-half, half, 100)
    x, y = np.meshgrid(side, side)
    rise = float(one.height(x, y, 0.1).mean() - other.height(x, y, 0.1).mean())
    return replace(distortion, start=distortion.start + np.array([0.0, 0.0, rise]))


def _footprint_shift(
    sfm: Sfm, distortion: Distortion, size: float, rng: np.random.Generator
) -> Float64:
    """Where the moving survey's area lies in its own centred frame [m]."""
    offset = (distortion.centre - distortion.start)[:2]
    heading = rng.random() * 2.0 * math.pi
    if sfm.overlap <= 0.0:
        shift: Float64 = sfm.follows_offset * offset
        return shift
    # (1 - a)(1 - b) = overlap along the drawn direction, by bisection
    way = np.abs([math.cos(heading), math.sin(heading)])
    low, high = 0.0, 1.5
    for _ in range(60):
        middle = 0.5 * (low + high)
        common = float(np.prod(np.maximum(0.0, 1.0 - middle * way)))
        low, high = (middle, high) if common > sfm.overlap else (low, middle)
    return low * size * np.array([math.cos(heading), math.sin(heading)])
