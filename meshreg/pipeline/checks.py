"""What is asked of a pair before anything is rasterized."""

from __future__ import annotations

import numpy as np

from meshreg.deformation import check_model
from meshreg.errors import InputError, UsageError
from meshreg.offsets import ESTIMATORS, search_radius
from meshreg.pipeline.levels import pair_grids
from meshreg.pipeline.postures import in_degrees, other_axes
from meshreg.pipeline.search_cost import require_search
from meshreg.raster.grid import choose_cells
from meshreg.records import Finding, Survey
from meshreg.refine import check_surfaces
from meshreg.settings import Settings


def in_no_metres(reference: Survey, moving: Survey) -> list[Finding]:
    """Say which surveys seem to be in degrees; empty for none."""
    said = "; ".join(filter(None, map(in_degrees, (reference, moving))))
    return [Finding("degrees", said, "rejected")] if said else []


def prepared(
    reference: Survey, moving: Survey, settings: Settings
) -> tuple[Settings, float, list[str]]:
    """Check the call and what it costs; return the settings with cells and radius, that, notes."""
    _check(reference, moving, settings)
    cells = choose_cells(reference, moving, settings.raster)
    radius = search_radius(settings, cells.dem)
    settings = settings.changed(
        {
            "search.radius": radius,
            "raster.dem_cell": cells.dem,
            "raster.ortho_cell": cells.ortho,
            "raster.sift_cell": cells.sift,
        }
    )
    require_search(pair_grids(reference, moving, settings), settings, radius)
    return settings, radius, list(cells.notes)


def require_different(reference: Survey, moving: Survey) -> None:
    """Refuse a survey that is compared with itself: a slip in a list of pairs, most often.

    Raises
    ------
    InputError
        If every file of both surveys has the same SHA-256, whatever their shifts.
    """
    if reference.checksums and reference.checksums == moving.checksums:
        names = " and ".join(dict.fromkeys(s.source[0].path.name for s in (reference, moving)))
        raise InputError(
            f"Both surveys are the same file{'s' if len(reference.source) > 1 else ''} ({names}; "
            "SHA-256), so that they can only lie on each other.",
            remedy="Give the repeat survey's own files; --allow-same (in Python allow_same=True) "
            "where a survey is to be compared with itself.",
        )


def _check(reference: Survey, moving: Survey, settings: Settings) -> None:
    check_model(settings.warp.model)
    check_surfaces(settings.refine.surfaces)
    for method in settings.methods:
        if method not in ESTIMATORS:
            raise UsageError(
                f"Unknown method {method!r}.", remedy=f"There are: {', '.join(ESTIMATORS)}."
            )
    if reference.crs != moving.crs:
        raise UsageError(
            f"The surveys' CRS differ: {reference.crs} and {moving.crs}.",
            remedy="Bring the moving one to the other's with meshreg.io.frames.common_crs.",
        )
    if reference.scale_known != moving.scale_known:
        which = moving if reference.scale_known else reference
        raise UsageError(
            f"The scale of {which.name!r} is not known, that of the other survey is.",
            remedy="Give its camera positions (--positions) or scale bars (--scale).",
        )


def surveys_apart(reference: Survey, moving: Survey, radius: float) -> list[Finding]:
    """Say that no offset within `radius` [m] can bring the surveys together; empty if one may."""
    a, b = reference.bounds, moving.bounds
    gaps = np.maximum(a[0, :2] - b[1, :2], b[0, :2] - a[1, :2])
    away = float(gaps.max())
    if away <= radius:
        return []
    said = f"the surveys lie {away:.4g} m apart, beyond the search radius of {radius:g} m"
    if rival := other_axes(reference, moving, radius):
        return [Finding("apart", said, "rejected"), Finding("axes", rival, "rejected")]
    # as far as brings the whole of the smaller one on the other, and a tenth
    whole = away + float(np.minimum(np.ptp(a[:, :2], axis=0), np.ptp(b[:, :2], axis=0)).max())
    power = 10.0 ** np.floor(np.log10(1.1 * whole))
    further = 0.5 * power * np.ceil(2.2 * whole / power)
    said += (
        "; check "
        "their shifts (--reference-shift, --moving-shift) and CRS, or search further "
        f"(--search-radius {further:g})"
    )
    return [Finding("apart", said, "rejected", {"apart": away, "search_radius": radius})]
