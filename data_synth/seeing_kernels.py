"""Light and water between the seafloor and the mosaic, per texel."""

# ruff: noqa: PLR0913, PLR0917 - compiled loops take their arrays one by one

from __future__ import annotations

import math

import numpy as np

from data_synth.noise_kernels import gradient_noise, hash01, hash2, octaves_into
from meshreg.jit import jit, prange


@jit(nogil=True, error_model="numpy")
def nearest_camera(x, y, plan):
    """Return offset from the camera whose image was used here, its number pair and altitude.

    Cameras stand on a lattice of tracks and exposures, strewn by navigation; the mosaic takes
    each texel from the nearest one.
    """
    c, s = plan.heading_cos, plan.heading_sin
    along, across = (c * x + s * y) / plan.image_spacing, (c * y - s * x) / plan.track_spacing
    stray = plan.seam_noise * gradient_noise(x * 3.0, y * 3.0, plan.seed + 1)
    across += stray
    along += plan.seam_noise * gradient_noise(x * 3.0, y * 3.0, plan.seed + 2)
    # cameras stray by a quarter of their spacing at most: the nearest one is of four
    ia, ic = math.floor(along - 0.5), math.floor(across - 0.5)
    best, dx, dy, na, nc = 1e30, 0.0, 0.0, 0, 0
    for j in range(2):
        for i in range(2):
            h = hash2(ia + i, ic + j, plan.seed + 3)
            ca = ia + i + 0.25 + 0.5 * np.float64(h & 0xFFFF) / 65536.0
            cc = ic + j + 0.325 + 0.35 * np.float64((h >> 16) & 0xFFFF) / 65536.0
            da, dc = (along - ca) * plan.image_spacing, (across - cc) * plan.track_spacing
            d2 = da * da + dc * dc
            if d2 < best:
                best, dx, dy, na, nc = d2, da, dc, ia + i, ic + j
    high = plan.altitude * (1.0 + 0.04 * (hash01(na, nc, plan.seed + 5) - 0.5))
    high *= 1.0 + 0.10 * gradient_noise(0.4 * na, 3.7 * nc, plan.seed + 6)
    return dx, dy, na, nc, high


@jit(nogil=True, error_model="numpy")
def shadow(z, i, j, step, east, north, rise):
    """Share of a lamp's light that reaches sample (i, j): 0 in shadow, 1 in the open.

    The lamp stands towards (`east`, `north`), a unit vector, at slope `rise`; the way is tried at
    growing distances, which is enough for soft shadows up to half a metre long.
    """
    rows, cols = z.shape
    here, light, far = z[i, j], 1.0, 1.5
    while far * step < 0.6:
        a, b = int(i - north * far + 0.5), int(j + east * far + 0.5)
        if a < 0 or b < 0 or a >= rows or b >= cols:
            break
        length = far * step
        over = (z[a, b] - here - length * rise) / (0.15 * length + 0.004)
        light = min(light, 1.0 - over)
        if light <= 0.0:
            return 0.0
        far *= 1.75
    return light


@jit(nogil=True, error_model="numpy")
def light_at(z, soft, wide, i, j, step, x, y, mirror, away, high, image, plan):
    """Light on sample (i, j) at centred (x, y): sky, sun and the lamps beside the camera.

    `away` is the sample's (east, north) from the camera [m], `high` the camera's height above the
    ground around, `image` a number pair that tells images apart.
    """
    rows, cols = z.shape
    up, down, left, right = max(i - 1, 0), min(i + 1, rows - 1), max(j - 1, 0), min(j + 1, cols - 1)
    gx = (z[i, right] - z[i, left]) / ((right - left) * step)
    gy = (z[up, j] - z[down, j]) / ((down - up) * step)
    norm = 1.0 / math.sqrt(1.0 + gx * gx + gy * gy)
    # crevices and hollows see less of the sky
    near = min(1.2, max(0.28, 1.0 + plan.crevice * (z[i, j] - soft[i, j])))
    around = min(1.15, max(0.4, 1.0 + 0.2 * plan.crevice * (z[i, j] - wide[i, j])))
    light = plan.ambient * near * around * (0.5 + 0.5 * norm)
    if plan.sun > 0.0:
        sx, sy, rise = plan.sun_east * mirror, plan.sun_north, plan.sun_up
        sun = (rise - gx * sx - gy * sy) * norm
        lie = math.sqrt(sx * sx + sy * sy) + 1e-9
        if sun > 0.0:
            sun *= shadow(z, i, j, step, sx / lie, sy / lie, rise / lie)
            light += plan.sun * sun * min(1.0, near + 0.2)
    if plan.caustics > 0.0:
        salt = plan.seed + 31 * image[0] + 17 * image[1]
        a = abs(gradient_noise(x * 5.0, y * 5.0, salt))
        b = abs(gradient_noise(x * 7.7 + 3.0, y * 7.7, salt + 9))
        light *= 1.0 + plan.caustics * (1.5 * math.exp(-22.0 * min(a, b)) - 0.45)
    if plan.strobe > 0.0:
        # a pair of lamps fore and aft of the camera and a little to one side
        c, s = plan.heading_cos, plan.heading_sin
        flash = 0.0
        for k in range(2):
            along = plan.strobe_arm if k == 0 else -plan.strobe_arm
            across = 0.25 * along
            ex, ey = c * along - s * across - away[0], s * along + c * across - away[1]
            ez = high - (z[i, j] - wide[i, j])
            far = math.sqrt(ex * ex + ey * ey + ez * ez)
            face = (ez - gx * ex - gy * ey) * norm / far
            if face <= 0.0:
                continue
            power = face if k == 0 else plan.strobe_balance * face
            flat = math.sqrt(ex * ex + ey * ey)
            if flat > 0.05:
                power *= shadow(z, i, j, step, ex / flat, ey / flat, ez / flat)
            flash += power * (ez / far) ** 4 * (high / far) ** 2
        light += plan.strobe * flash * min(1.0, near + 0.2)
    return light


@jit(nogil=True, error_model="numpy")
def image_gains(image, plan):
    """Return for each channel the exposure of one image, and the mean loss that is put back."""
    gain = 1.0 + plan.seams * (2.0 * hash01(image[0], image[1], plan.seed + 7) - 1.0)
    back = plan.altitude * plan.corrected
    return (
        gain * (1.0 + 0.5 * plan.seams * (hash01(image[0], image[1], plan.seed + 8) - 0.5)),
        gain * (1.0 + 0.5 * plan.seams * (hash01(image[0], image[1], plan.seed + 9) - 0.5)),
        gain * (1.0 + 0.5 * plan.seams * (hash01(image[0], image[1], plan.seed + 10) - 0.5)),
        math.exp(plan.attenuation_red * back),
        math.exp(plan.attenuation_green * back),
        math.exp(plan.attenuation_blue * back),
    )


@jit(nogil=True, error_model="numpy")
def through_water(albedo, light, view, high, gains, plan, out):
    """Put what a camera at distance `view` [m] sees of a lit spot into `out` (3,)."""
    edge = (high / view) ** (4.0 * plan.vignette)
    attenuation = (plan.attenuation_red, plan.attenuation_green, plan.attenuation_blue)
    haze = (plan.haze_red, plan.haze_green, plan.haze_blue)
    for k in range(3):
        left = math.exp(-attenuation[k] * view)
        veil = haze[k] * (1.0 - left)
        out[k] = (albedo[k] * light * left * gains[3 + k] + veil) * edge * gains[k]


@jit(parallel=True, nogil=True, error_model="numpy")
def radiance(z, soft, wide, albedo, step, west, north, mirror, plan):
    """Linear color (H, W, 3) f32 that the cameras saw of a lattice of the seafloor.

    Parameters
    ----------
    z, soft, wide : (H, W) f32
        Height [m] and its means nearby and further around, for the dimness of crevices and hollows.
    albedo : (H, W, 3) f32
    step, west, north : float
        Spacing and first sample's centre in the survey's centred frame [m].
    mirror : float
        -1 where the lattice's columns run westward in the world, else 1.
    plan : Plan
    """
    rows, cols = z.shape
    out = np.empty((rows, cols, 3), np.float32)
    c, s = plan.heading_cos, plan.heading_sin
    for i in prange(rows):
        y = north - i * step
        last_na, last_nc, gains = 0, 0, image_gains((0, 0), plan)
        for j in range(cols):
            x = west + j * step
            da, dc, na, nc, high = nearest_camera(x, y, plan)
            if na != last_na or nc != last_nc:
                last_na, last_nc, gains = na, nc, image_gains((na, nc), plan)
            away = (c * da - s * dc, s * da + c * dc)
            light = light_at(z, soft, wide, i, j, step, x, y, mirror, away, high, (na, nc), plan)
            view = math.sqrt(da * da + dc * dc + high * high)
            color = (albedo[i, j, 0], albedo[i, j, 1], albedo[i, j, 2])
            through_water(color, light, view, high, gains, plan, out[i, j])
    return out


@jit(parallel=True, nogil=True, error_model="numpy")
def encode(linear, scale, gamma, noise, seed, west, north, step):
    """Linear color to 8 bits: exposure per channel `scale` (3,), gamma, sensor noise [counts]."""
    rows, cols, _ = linear.shape
    out = np.empty((rows, cols, 3), np.uint8)
    first_row, first_col = math.floor(-north / step), math.floor(west / step)
    for i in prange(rows):
        for j in range(cols):
            grey = hash01(first_col + j, first_row + i, seed) + hash01(
                first_col + j, first_row + i, seed + 1
            )
            grey = noise * 2.4 * (grey - 1.0)
            for k in range(3):
                value = max(0.0, linear[i, j, k] * scale[k])
                if value > 0.8:  # the film's shoulder
                    value = 0.8 + 0.2 * (1.0 - math.exp(-(value - 0.8) / 0.2))
                own = noise * 1.7 * (hash01(first_col + j, first_row + i, seed + 2 + k) - 0.5)
                out[i, j, k] = np.uint8(
                    min(255.0, max(0.0, 255.0 * value ** (1.0 / gamma) + grey + own + 0.5))
                )
    return out


@jit(parallel=True, nogil=True, error_model="numpy")
def blotches(x, y, seed, wavelength, count):
    """Noise of standard deviation about 1 at points (N,), for holes, edges and height noise."""
    out = np.zeros(x.size)
    block = 4096
    for part in prange((x.size + block - 1) // block):
        a, b = part * block, min(x.size, (part + 1) * block)
        octaves_into(x[a:b], y[a:b], seed, wavelength, 0.0, 0.65, count, 1.0, out[a:b])
    return out


@jit(parallel=True, nogil=True, error_model="numpy")
def bilinear(raster, row, col):
    """Values (N,) of a raster (H, W) between its samples; beyond the border the border's."""
    rows, cols = raster.shape
    out = np.empty(row.size)
    for k in prange(row.size):
        r = min(max(row[k], 0.0), rows - 1.000001)
        c = min(max(col[k], 0.0), cols - 1.000001)
        i, j = int(r), int(c)
        u, v = r - i, c - j
        above = raster[i, j] * (1.0 - v) + raster[i, j + 1] * v
        below = raster[i + 1, j] * (1.0 - v) + raster[i + 1, j + 1] * v
        out[k] = above * (1.0 - u) + below * u
    return out
