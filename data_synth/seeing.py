"""How a survey saw the seafloor: lamps, sun, water, cameras, exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_synth.sfm import Drawn, draw

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Seeing:
    """Light, water and cameras of one survey. Lengths in metres, angles in degrees.

    `sun` and `strobe` (the vehicle's lamps) come from one side, `ambient` from all: daylight, and
    what is left of the lamps where a texture blends several images and its light was evened out.
    `attenuation` is per metre of water for red, green and blue; `corrected` the share of the mean
    loss that was removed by the operator; `cast` multiplies the channels afterwards. `seams` is
    the spread of exposure between neighbouring images, `noise` the sensor's in grey values,
    `blur` a sigma on the ground.
    """

    altitude: float = 2.0
    sun: float = 0.15
    sun_azimuth: Drawn = (0.0, 360.0)
    sun_elevation: Drawn = (50.0, 80.0)
    ambient: float = 0.9
    strobe: float = 0.25
    strobe_arm: float = 0.6
    strobe_balance: float = 0.6
    crevice: float = 3.0  # dimming per metre below the surroundings
    attenuation: tuple[float, float, float] = (0.40, 0.09, 0.06)
    haze: tuple[float, float, float] = (0.10, 0.14, 0.14)
    corrected: float = 0.9
    cast: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exposure: float = 0.07  # mean linear brightness of the mosaic
    gamma: float = 2.2
    vignette: float = 0.2
    seams: float = 0.04
    caustics: float = 0.0
    particles: float = 0.5  # per square metre
    noise: float = 0.5
    blur: float = 0.004
    heading: Drawn = (0.0, 180.0)
    track_spacing: float = 1.0
    image_spacing: float = 0.8


class Plan(NamedTuple):
    """One survey's seeing with everything drawn: one flat tuple for the kernels."""

    seed: int
    heading_cos: float
    heading_sin: float
    track_spacing: float
    image_spacing: float
    seam_noise: float
    altitude: float
    sun_east: float  # of the unit vector towards the sun
    sun_north: float
    sun_up: float
    sun: float
    ambient: float
    strobe: float
    strobe_arm: float
    strobe_balance: float
    crevice: float
    attenuation_red: float
    attenuation_green: float
    attenuation_blue: float
    haze_red: float
    haze_green: float
    haze_blue: float
    corrected: float
    vignette: float
    seams: float
    caustics: float


def make_plan(seeing: Seeing, rng: np.random.Generator) -> Plan:
    """Draw the headings and lights of one survey."""
    seed = int(rng.integers(2**30))
    heading = math.radians(draw(seeing.heading, rng))
    azimuth = math.radians(draw(seeing.sun_azimuth, rng))
    elevation = math.radians(draw(seeing.sun_elevation, rng))
    red, green, blue = seeing.attenuation
    haze_red, haze_green, haze_blue = seeing.haze
    return Plan(
        seed=seed,
        heading_cos=math.cos(heading),
        heading_sin=math.sin(heading),
        track_spacing=seeing.track_spacing,
        image_spacing=seeing.image_spacing,
        seam_noise=0.25,
        altitude=seeing.altitude,
        sun_east=math.cos(elevation) * math.sin(azimuth),
        sun_north=math.cos(elevation) * math.cos(azimuth),
        sun_up=math.sin(elevation),
        sun=seeing.sun,
        ambient=seeing.ambient,
        strobe=seeing.strobe,
        strobe_arm=seeing.strobe_arm,
        strobe_balance=seeing.strobe_balance,
        crevice=seeing.crevice,
        attenuation_red=red,
        attenuation_green=green,
        attenuation_blue=blue,
        haze_red=haze_red,
        haze_green=haze_green,
        haze_blue=haze_blue,
        corrected=seeing.corrected,
        vignette=seeing.vignette,
        seams=seeing.seams,
        caustics=seeing.caustics,
    )


@dataclass(frozen=True)
class Lattice:
    """Regular samples in a survey's centred frame: the first one's centre, and the step [m]."""

    west: float
    north: float
    step: float
    shape: tuple[int, int]

    @property
    def east(self) -> NDArray[np.float64]:
        """East of each column [m]."""
        return self.west + np.arange(self.shape[1]) * self.step

    @property
    def norths(self) -> NDArray[np.float64]:
        """North of each row [m], falling."""
        return self.north - np.arange(self.shape[0]) * self.step


def see(
    height: Float32, albedo: Float32, lattice: Lattice, seeing: Seeing, plan: Plan, mirror: bool
) -> UInt8:
    """Return the mosaic (H, W, 3) uint8 of a lattice whose surface and reflectance are known."""
    import cv2

    from data_synth.seeing_kernels import encode, radiance

    soft = local_mean(height, 0.04 / lattice.step)
    wide = local_mean(height, 0.25 / lattice.step)
    place = (lattice.step, lattice.west, lattice.north, -1.0 if mirror else 1.0)
    linear = radiance(height, soft, wide, albedo, *place, plan)
    if seeing.particles > 0:
        _strew_particles(linear, lattice, seeing, plan)
    if seeing.blur > 0.3 * lattice.step:
        linear = cv2.GaussianBlur(linear, (0, 0), seeing.blur / lattice.step)
    thin = linear[:: max(1, linear.shape[0] // 400), :: max(1, linear.shape[1] // 400)]
    mean = thin.reshape(-1, 3).mean(axis=0, dtype=np.float64)
    # a grey world half way: operators white-balance, yet a trace of the water's color stays
    scale = seeing.exposure * np.array(seeing.cast) / (mean**0.6 * mean.mean() ** 0.4)
    mosaic: UInt8 = encode(
        linear,
        scale,
        seeing.gamma,
        seeing.noise,
        plan.seed + 50,
        lattice.west,
        lattice.north,
        lattice.step,
    )
    return mosaic


def local_mean(height: Float32, sigma: float) -> Float32:
    """Gaussian mean of a raster, worked on a coarser one where sigma [samples] allows it."""
    import cv2

    rows, cols = height.shape
    times = max(1, int(sigma / 3.0))
    if times == 1:
        mean: Float32 = cv2.GaussianBlur(height, (0, 0), sigma)
        return mean
    small = cv2.resize(
        height, (max(1, cols // times), max(1, rows // times)), interpolation=cv2.INTER_AREA
    )
    small = cv2.GaussianBlur(small, (0, 0), sigma / times)
    large: Float32 = cv2.resize(small, (cols, rows), interpolation=cv2.INTER_LINEAR)
    return large


def _strew_particles(linear: Float32, lattice: Lattice, seeing: Seeing, plan: Plan) -> None:
    """Brighten specks of drifting matter, in place; they are nowhere the same twice."""
    rows, cols = lattice.shape
    rng = np.random.default_rng([plan.seed, 60])
    count = rng.poisson(seeing.particles * rows * cols * lattice.step**2)
    level = float(linear[::7, ::7].mean())
    at_row, at_col = rng.uniform(0, rows, count), rng.uniform(0, cols, count)
    size = rng.uniform(0.002, 0.006, count) / lattice.step
    for row, col, sigma in zip(at_row, at_col, size, strict=True):
        reach = math.ceil(3 * max(sigma, 0.5))
        top, left = max(0, int(row) - reach), max(0, int(col) - reach)
        part = linear[top : int(row) + reach + 1, left : int(col) + reach + 1]
        y, x = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
        glow = np.exp(-0.5 * ((x - col) ** 2 + (y - row) ** 2) / max(sigma, 0.4) ** 2)
        part += (1.5 * level * min(1.0, sigma / 0.4) * glow)[..., None].astype(np.float32)
