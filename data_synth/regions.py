"""Where a pair changed: polygons and volumes, measured on the functions themselves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_synth.change import Event
from data_synth.scene import Scene

Float64 = NDArray[np.float64]


def describe_change(scene: Scene, step: float | None = None) -> dict[str, Any]:
    """Return every changed thing in the reference's footprint, for `truth.json`.

    Parameters
    ----------
    scene : Scene
    step : float, optional
        Spacing of the heights that volumes are summed from [m].

    Returns
    -------
    dict
        `regions`: a list of {classes, kind, id, polygon, volume_gain, volume_loss}, polygons in
        reference coordinates [m]: nothing of the thing is outside. Where things overlap their
        volumes [m3] are counted in each; `total` counts them once. `fields` names what changed
        everywhere (texture) or on the sand of either epoch (ripples, its level; with polygons).
        Unless texture changed, all outside the polygons is what it was, height and color.
    """
    if scene.recipe.place.other_ground:
        return {"regions": [], "fields": {}, "total": None}
    step = max(0.03, scene.size / 500.0) if step is None else step
    west, south, east, north = scene.reference.footprint
    x, y = np.meshgrid(
        np.arange(west + step / 2, east, step), np.arange(south + step / 2, north, step)
    )
    before = scene.reference.seafloor.height(x, y, 0.0)
    gain = (scene.moving.seafloor.height(x, y, 0.0) - before) * step**2
    centre = scene.moving.distortion.centre
    regions = []
    for event in scene.events:
        if any(
            west - r < ex < east + r and south - r < ey < north + r for ex, ey, r in event.circles
        ):
            regions.append(_region(event, gain, (west, south, step), centre))
    change = scene.recipe.change
    fields: dict[str, Any] = {}
    if change.texture > 0:
        fields["texture"] = {"strength": change.texture}
    levels = [take.seafloor.ground.sand_level for take in (scene.reference, scene.moving)]
    if levels[0] > -1e8 and (change.ripples > 0 or change.sediment > 0):
        fields["sand"] = {
            "ripples": change.ripples,
            "rise": levels[1] - levels[0],
            "polygons": _sand(scene),
        }
    total = {"gain": float(gain[gain > 0].sum()), "loss": float(-gain[gain < 0].sum())}
    return {"regions": regions, "fields": fields, "total": total}


def outline(event: Event, corners: int = 24) -> Float64:
    """Convex polygon (N, 2), counter-clockwise, around the circles of an event [m]."""
    from scipy.spatial import ConvexHull

    angle = 2.0 * math.pi * np.arange(corners) / corners
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) / math.cos(math.pi / corners)
    points = np.concatenate([np.array(c[:2]) + c[2] * ring for c in event.circles])
    if len(event.circles) == 1:
        return points
    hull: Float64 = points[ConvexHull(points).vertices]
    return hull


def _region(
    event: Event, gain: Float64, place: tuple[float, float, float], centre: Float64
) -> dict[str, Any]:
    polygon = outline(event)
    west, south, step = place
    low = np.maximum(np.floor((polygon.min(axis=0) - [west, south]) / step).astype(int), 0)
    high = np.ceil((polygon.max(axis=0) - [west, south]) / step).astype(int) + 1
    part = gain[low[1] : high[1], low[0] : high[0]]
    cols, rows = np.meshgrid(np.arange(part.shape[1]), np.arange(part.shape[0]))
    x, y = west + (low[0] + cols + 0.5) * step, south + (low[1] + rows + 0.5) * step
    inside = np.ones(part.shape, bool)
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        inside &= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) >= 0
    change = part[inside]
    return {
        "classes": list(event.classes),
        "kind": event.kind,
        "id": event.id,
        "polygon": np.round(polygon + centre[:2], 4).tolist(),
        "volume_gain": float(change[change > 0].sum()),
        "volume_loss": float(-change[change < 0].sum()),
    }


def _sand(scene: Scene) -> list[list[list[float]]]:
    """Outlines of all sand of either epoch, one cell wider than the sand.

    Sand lies in cracks that are narrower than a cell too: it is looked for with its level raised,
    which shows it at the cell's centre wherever the rock is less steep than 2 in 1.
    """
    import cv2

    from data_synth.seafloor_kernels import evaluate_ground

    step = max(0.03, scene.size / 500.0)
    west, south, east, north = (
        edge + way * 5 * step
        for edge, way in zip(scene.reference.footprint, (-1, -1, 1, 1), strict=True)
    )
    x, y = np.meshgrid(np.arange(west, east, step), np.arange(south, north, step))
    sandy = np.zeros(x.shape, bool)
    for take in (scene.reference, scene.moving):
        ground = take.seafloor.ground
        ground = ground._replace(sand_level=ground.sand_level + 1.5 * step)
        _, share = evaluate_ground(x.ravel(), y.ravel(), ground, 0.0)
        sandy |= share.reshape(x.shape) > 0
    wider = cv2.dilate(sandy.astype(np.uint8), np.ones((3, 3), np.uint8))
    rings, _ = cv2.findContours(wider, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    origin = np.array([west, south]) + scene.moving.distortion.centre[:2]
    return [np.round(ring[:, 0, :] * step + origin, 3).tolist() for ring in rings if len(ring) > 3]
