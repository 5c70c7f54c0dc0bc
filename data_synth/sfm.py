"""What structure from motion does to a survey: where it lands, how it bends, where it fails.

The heart is `Distortion`: the exact function `reference_from_moving` of a pair, smooth and
invertible, from which every truth is taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Drawn = float | tuple[float, float]  # a number, or the range that it is drawn from


@dataclass(frozen=True)
class Sfm:
    """Errors of the moving survey's reconstruction and defects of both. A pair is a range.

    Lengths in metres, angles in degrees. `offset_length` (0: not used) replaces `offset_east` and
    `offset_north`, its direction is drawn. `follows_offset` is the share of the offset by which
    the area surveyed moved along (1: both surveys claim the same coordinates; 0: both cover the
    same ground). `overlap` (0: not used) places the second area so that this share is common.
    """

    offset_length: Drawn = 0.0
    offset_east: Drawn = (-5.0, 5.0)
    offset_north: Drawn = (-5.0, 5.0)
    offset_up: Drawn = (-0.05, 0.05)
    yaw: Drawn = (-0.5, 0.5)
    tilt: Drawn = (0.0, 0.3)
    scale: Drawn = (-0.0005, 0.0005)  # relative to 1
    scale_drift: Drawn = (-0.002, 0.002)  # change of scale across the patch
    doming: Drawn = (-0.01, 0.01)  # height of the middle above the patch's corners
    warp: Drawn = 0.08  # horizontal root mean square after the best rigid fit
    warp_up: Drawn = 0.03
    follows_offset: float = 0.5
    overlap: float = 0.0
    mirrored: bool = False
    mesh_spacing: float = 0.025
    smoothing: float = 0.6  # of the mesh against the texture, sigma in mesh spacings
    vertex_noise: float = 0.004
    holes: float = 0.003  # share of the area
    ragged: float = 0.35  # depth of the edge's bays
    floaters: float = 2.0  # blobs in the water per 100 square metres
    uneven: float = 0.3  # 0 even sampling .. 1 very uneven
    nav_noise: float = 0.03  # of camera positions, per axis


@dataclass(frozen=True, eq=False)
class Distortion:
    """`reference_from_moving`, exactly: ``q = linear @ (m - start)``; ``centre + q + bend(q)``.

    Attributes
    ----------
    centre : (3,) float64
        Reference coordinates of the patch's centre, absolute [m].
    start : (3,) float64
        The moving survey's coordinates of the same point, up to ``bend(0)`` [m].
    linear : (3, 3) float64
        Scale times rotation (times a reflection in a mirrored survey).
    poly : (3, 6) float64
        Polynomial part of the warp: coefficients of 1, x, y, xx, xy, yy [m].
    waves : (M, 2), cosines, sines : (M, 3) float64
        ``bend(q) = poly @ (1, x, y, xx, xy, yy) + sum_k cosines_k cos(waves_k . q) + sines_k sin``.
    """

    centre: Float64
    start: Float64
    linear: Float64
    poly: Float64 = field(default_factory=lambda: np.zeros((3, 6)))
    waves: Float64 = field(default_factory=lambda: np.zeros((0, 2)))
    cosines: Float64 = field(default_factory=lambda: np.zeros((0, 3)))
    sines: Float64 = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def warp(self) -> tuple[Float64, Float64, Float64, Float64]:
        """The arguments that describe the warp, for the kernels."""
        return self.poly, self.waves, self.cosines, self.sines

    def reference_from_moving(self, points: Float64) -> Float64:
        """Lay absolute points (N, 3) of the moving survey on the reference."""
        q = (np.atleast_2d(points) - self.start) @ self.linear.T
        return q + self.displacement(q) + self.centre

    def moving_from_reference(self, points: Float64) -> Float64:
        """Inverse of `reference_from_moving`, to about 1e-12 m."""
        from data_synth.sfm_kernels import from_world

        world = np.atleast_2d(points) - self.centre
        x, y = (np.ascontiguousarray(world[:, k]) for k in (0, 1))
        q = world - from_world(x, y, *self.warp)
        moved: Float64 = q @ np.linalg.inv(self.linear).T
        return moved + self.start

    def displacement(self, points: Float64) -> Float64:
        """Warp (N, 3) [m] at points q (N, 2 or 3), the patch's centre being (0, 0)."""
        from data_synth.sfm_kernels import bend_many

        x, y = (np.ascontiguousarray(points[:, k]) for k in (0, 1))
        bent: Float64 = bend_many(x, y, *self.warp)
        return bent

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for `truth.json`."""
        return {
            "formula": (
                "q = linear @ (moving - start); d = poly @ [1, x, y, x*x, x*y, y*y] + "
                "sum_k(cosines[k] * cos(waves[k] . q_xy) + sines[k] * sin(waves[k] . q_xy)); "
                "reference = centre + q + d"
            ),
            **{
                name: getattr(self, name).tolist()
                for name in ("centre", "start", "linear", "poly", "waves", "cosines", "sines")
            },
        }


def identity(centre: Float64) -> Distortion:
    """Return the distortion of the reference survey: none."""
    return Distortion(centre=centre, start=centre, linear=np.eye(3))


def draw(value: Drawn, rng: np.random.Generator) -> float:
    """Return a number, drawn uniformly where `value` is a range. Always uses one draw."""
    u = rng.random()
    if isinstance(value, tuple):
        return value[0] + u * (value[1] - value[0])
    return float(value)


def rotation(yaw: float, tilt: float, heading: float) -> Float64:
    """Return a rotation: `tilt` about the horizontal axis at `heading`, then `yaw` (all rad)."""
    ax, ay = math.cos(heading), math.sin(heading)
    c, s = math.cos(tilt), math.sin(tilt)
    lean = np.array(
        [
            [c + ax * ax * (1 - c), ax * ay * (1 - c), ay * s],
            [ax * ay * (1 - c), c + ay * ay * (1 - c), -ax * s],
            [-ay * s, ax * s, c],
        ]
    )
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ lean


def make_distortion(sfm: Sfm, rng: np.random.Generator, centre: Float64, size: float) -> Distortion:
    """Draw the distortion of one moving survey.

    Parameters
    ----------
    sfm : Sfm
    rng : numpy Generator
        Consumed in a fixed order: two recipes that differ in one number share the other draws.
    centre : (3,) float64
        Absolute reference coordinates of the patch's centre [m].
    size : float
        Side of the patch [m].
    """
    heading = rng.random() * 2.0 * math.pi
    length = draw(sfm.offset_length, rng)
    east, north = draw(sfm.offset_east, rng), draw(sfm.offset_north, rng)
    if length > 0.0:
        east, north = length * math.cos(heading), length * math.sin(heading)
    offset = np.array([east, north, draw(sfm.offset_up, rng)])
    yaw, tilt = math.radians(draw(sfm.yaw, rng)), math.radians(draw(sfm.tilt, rng))
    linear = rotation(yaw, tilt, rng.random() * 2.0 * math.pi)
    linear = linear * (1.0 + draw(sfm.scale, rng))
    if sfm.mirrored:
        linear = linear @ np.diag([-1.0, 1.0, 1.0])
    drift, dome = draw(sfm.scale_drift, rng), draw(sfm.doming, rng)
    flat, up = draw(sfm.warp, rng), draw(sfm.warp_up, rng)
    poly, waves, cosines, sines = _draw_warp(rng, size, flat, up)
    poly = poly + _drift(drift, rng.random() * 2.0 * math.pi, size)
    radius = size / math.sqrt(2.0)
    poly[2, [3, 5]] -= dome / radius**2
    poly[2, 0] += dome / 3.0  # mean of (r / radius)^2 over the square
    return Distortion(centre, centre - offset, linear, poly, waves, cosines, sines)


def _drift(share: float, heading: float, size: float) -> Float64:
    """Conformal quadratic whose scale changes by `share` over `size` along `heading`."""
    poly = np.zeros((3, 6))
    a = share / (2.0 * size) * np.array([math.cos(heading), -math.sin(heading)])
    # f(z) = (a_x + i a_y) z^2: real part into x, imaginary part into y
    poly[0, 3:] = [a[0], -2.0 * a[1], -a[0]]
    poly[1, 3:] = [a[1], 2.0 * a[0], -a[1]]
    return poly


def _draw_warp(
    rng: np.random.Generator, size: float, flat: float, up: float
) -> tuple[Float64, Float64, Float64, Float64]:
    """Draw waves of a third to twice the patch, long ones strongest, free of any rigid motion.

    The root mean square over the patch is exactly `flat` (horizontal vector) and `up`.
    """
    count = 12
    wavelength = size * np.exp(rng.uniform(math.log(1 / 3), math.log(2.0), count))
    heading = rng.uniform(0.0, 2.0 * math.pi, count)
    waves = (2.0 * math.pi / wavelength)[:, None] * np.stack(
        [np.cos(heading), np.sin(heading)], axis=1
    )
    strength = ((wavelength / size) ** 1.5)[:, None]
    cosines, sines = (strength * rng.standard_normal((count, 3)) for _ in range(2))
    side = (np.arange(41) + 0.5) / 41.0 * size - size / 2.0
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    phase = np.stack([x, y], axis=1) @ waves.T
    field_ = np.cos(phase) @ cosines + np.sin(phase) @ sines
    rigid, poly = _rigid_part(x, y, field_)
    rest = field_ - rigid
    have_flat = math.sqrt(float((rest[:, :2] ** 2).sum(axis=1).mean()))
    have_up = math.sqrt(float((rest[:, 2] ** 2).mean()))
    gain = np.array([flat / have_flat, flat / have_flat, up / have_up])
    return -poly * gain[:, None], waves, cosines * gain, sines * gain


def _rigid_part(x: Float64, y: Float64, field_: Float64) -> tuple[Float64, Float64]:
    """Least-squares shift, turn about the vertical and tilt in a displacement field (N, 3)."""
    one, zero = np.ones_like(x), np.zeros_like(x)
    design = np.stack(
        [
            np.stack([one, zero, zero, -y, zero, zero], axis=1),
            np.stack([zero, one, zero, x, zero, zero], axis=1),
            np.stack([zero, zero, one, zero, x, y], axis=1),
        ],
        axis=1,
    ).reshape(-1, 6)
    (e, n, u, turn, tx, ty), *_ = np.linalg.lstsq(design, field_.ravel(), rcond=None)
    poly = np.zeros((3, 6))
    poly[0, [0, 2]] = [e, -turn]
    poly[1, [0, 1]] = [n, turn]
    poly[2, [0, 1, 2]] = [u, tx, ty]
    return (design @ np.array([e, n, u, turn, tx, ty])).reshape(-1, 3), poly
