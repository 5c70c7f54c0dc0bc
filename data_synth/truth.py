"""The truth of a pair: from the exact distortion, never from a rendered survey."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth.scene import Scene

Float64 = NDArray[np.float64]
SCHEMA = "meshreg.truth/1"
GENERATOR = 2  # raised whenever the same recipe and seed give another pair


def make_truth(scene: Scene, step: float = 0.25) -> dict[str, Any]:
    """Return the transforms of a pair, and how well a rigid one can do at all.

    Parameters
    ----------
    scene : Scene
    step : float
        Spacing of the cells over which the best fits are taken [m].

    Returns
    -------
    dict
        As written to `truth.json`, without the change regions (`describe_change`).
    """
    d = scene.moving.distortion
    moving, reference = common_points(scene, step)
    truth: dict[str, Any] = {
        "schema": SCHEMA,
        "generator": GENERATOR,
        "scenario": scene.recipe.name,
        "severity": scene.recipe.severity,
        "seed": scene.seed,
        "size": scene.size,
        "crs": scene.recipe.place.crs,
        "same_ground": not scene.recipe.place.other_ground,
        "mirrored": scene.recipe.sfm.mirrored,
        "overlap": len(moving) * step**2 / scene.size**2,
        "warp": d.as_dict(),
        "at_centre": _at_centre(scene),
    }
    if scene.recipe.place.other_ground or scene.recipe.sfm.mirrored or len(moving) < 3:
        truth.update(
            reference_from_moving=None,
            similarity=None,
            centroid=None,
            residual_rms=None,
            offset=None,
        )
        return truth
    rigid = best_fit(moving, reference, with_scale=False)
    alike = best_fit(moving, reference, with_scale=True)
    centroid = moving.mean(axis=0)
    at_centroid = rigid[:3, :3] @ centroid + rigid[:3, 3] - centroid
    left, left_alike = (m[:3, :3] @ moving.T + m[:3, 3:] - reference.T for m in (rigid, alike))
    truth.update(
        reference_from_moving=rigid.tolist(),
        centroid=centroid.tolist(),
        offset=at_centroid.tolist(),
        yaw=float(np.arctan2(rigid[1, 0], rigid[0, 0])),
        residual_rms={
            "horizontal": float(np.sqrt((left[:2] ** 2).sum(axis=0).mean())),
            "vertical": float(np.sqrt((left[2] ** 2).mean())),
        },
        residual_mean_horizontal=float(np.hypot(left[0], left[1]).mean()),
        similarity={
            "reference_from_moving": alike.tolist(),
            "scale": float(np.cbrt(np.linalg.det(alike[:3, :3]))),
            "residual_rms": {
                "horizontal": float(np.sqrt((left_alike[:2] ** 2).sum(axis=0).mean())),
                "vertical": float(np.sqrt((left_alike[2] ** 2).mean())),
            },
        },
        warp_samples=_warp_samples(scene),
    )
    return truth


def common_points(scene: Scene, step: float) -> tuple[Float64, Float64]:
    """Return moving and reference coordinates (N, 3), absolute, of the cells both surveys see."""
    west, south, east, north = scene.reference.footprint
    x, y = np.meshgrid(
        np.arange(west + step / 2, east, step), np.arange(south + step / 2, north, step)
    )
    seen = scene.reference.covered(x, y)
    x, y = x[seen], y[seen]
    d = scene.moving.distortion
    z = scene.reference.seafloor.height(x, y, step)
    reference = np.stack([x, y, z], axis=1) + d.centre
    moving = d.moving_from_reference(reference)
    centred = moving - d.start
    both = scene.moving.covered(centred[:, 0], centred[:, 1])
    return moving[both], reference[both]


def best_fit(moving: Float64, reference: Float64, with_scale: bool) -> Float64:
    """Least-squares rigid or similarity transform (4, 4) of absolute points (N, 3).

    Umeyama, "Least-squares estimation of transformation parameters", PAMI 1991, equations 39-43.
    """
    a, b = moving.mean(axis=0), reference.mean(axis=0)
    p, q = moving - a, reference - b
    u, values, vt = np.linalg.svd(q.T @ p)
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ np.diag(flip) @ vt
    scale = float((values * flip).sum() / (p**2).sum()) if with_scale else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn
    matrix[:3, 3] = b - scale * turn @ a
    return matrix


def _at_centre(scene: Scene) -> dict[str, Any]:
    """Return the exact transform at the patch's centre: a point, its image, the Jacobian."""
    d = scene.moving.distortion
    moving = d.moving_from_reference(d.centre[None])[0]
    h = 1e-3
    jacobian = [
        (d.reference_from_moving((moving + s)[None]) - d.reference_from_moving((moving - s)[None]))[
            0
        ]
        / (2 * h)
        for s in h * np.eye(3)
    ]
    return {
        "moving": moving.tolist(),
        "reference": d.centre.tolist(),
        "offset": (d.centre - moving).tolist(),
        "jacobian": np.array(jacobian).T.tolist(),
    }


def _warp_samples(scene: Scene, count: int = 9) -> dict[str, Any]:
    """Return the exact map on a lattice over the moving survey: absolute points of both."""
    west, south, east, north = scene.moving.footprint
    x, y = np.meshgrid(np.linspace(west, east, count), np.linspace(south, north, count))
    d = scene.moving.distortion
    moving = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + d.start
    return {
        "moving": moving.tolist(),
        "reference": d.reference_from_moving(moving).tolist(),
    }
