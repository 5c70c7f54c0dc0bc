"""Move a survey in memory. Files are rewritten by `meshreg.io.rewrite_survey`."""

from __future__ import annotations

import dataclasses

from meshreg.errors import UsageError
from meshreg.records import Maps, Mesh, PointCloud, Survey, Transform, Warp


def apply_transform(
    survey: Survey, reference_from_moving: Transform, warp: Warp | None = None
) -> Survey:
    """Return the survey laid on the reference; the one given is untouched.

    Parameters
    ----------
    survey : Survey
        With a mesh or point cloud.
    reference_from_moving : Transform
        Acts on absolute coordinates [m].
    warp : Warp, optional
        Bends the survey where the transform has put it.

    Returns
    -------
    Survey
        Its `origin` moves along, so that the local coordinates stay small; `source` is dropped,
        because the files hold the old place.

    Raises
    ------
    UsageError
        For `Maps`: pixels are re-gridded, not moved (`meshreg.rasterize` with `transform`).
    """
    geometry = survey.geometry
    if isinstance(geometry, Maps):
        raise UsageError(
            f"Survey {survey.name!r} is a DEM with an orthomosaic, which cannot be moved in place.",
            remedy="Use meshreg.rasterize(survey, grid, transform=...) to lay it on a grid.",
        )
    # p -> linear p + (T(origin) - new origin): the rotation acts on small numbers only
    origin = reference_from_moving.apply(survey.origin)
    points = geometry.points @ reference_from_moving.linear.T
    if warp is not None:
        points = points + warp.displacement(points + origin)
    moved: Mesh | PointCloud
    if isinstance(geometry, Mesh):
        moved = dataclasses.replace(geometry, vertices=points)
    else:
        moved = dataclasses.replace(geometry, points=points)
    return dataclasses.replace(survey, geometry=moved, origin=origin, source=())
