"""`register_pair`: the way data flows, on one page.

Bryson, Johnson-Roberson, Pizarro and Williams (IROS 2013) are followed section by section: both
surveys are rasterized on one lattice, SIFT on the mosaics (III-B), the terrain scan (III-C) and
mutual information (III-D) each propose an offset, and, beyond the paper, the proposals are judged
by one neutral measure, refined on tiles, and given a verdict. A survey whose heading or scale is
off by more than the methods bear is turned first, as its tiles vote.
"""

from __future__ import annotations

import dataclasses
import platform
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from meshreg import judge as judging
from meshreg.deformation import Internal, check_model, measure, warped_raster
from meshreg.errors import InputError, UsageError
from meshreg.heading import Pairs, Turn, turning
from meshreg.height import STABLE, Heights, stable_ground
from meshreg.judge import Found, findings, last_word, second_surface
from meshreg.offsets import ESTIMATORS, search_radius
from meshreg.pipeline.compare import APART, compare
from meshreg.pipeline.decision import Clock, Decision, Manual, Progress, completed, decide
from meshreg.pipeline.far_pose import far_pose
from meshreg.pipeline.levels import lay_down, pair_grids, rasterize_pair
from meshreg.pipeline.postures import axes_after, in_degrees, other_axes, posture
from meshreg.pipeline.search_cost import require_search
from meshreg.raster.grid import choose_cells
from meshreg.records import (
    Float64,
    Gain,
    Layer,
    Maps,
    OffsetEstimate,
    Registration,
    Survey,
    SurveyRaster,
    Transform,
    Warp,
)
from meshreg.refine import Polished, Refined, check_surfaces, polish
from meshreg.settings import Settings
from meshreg.statistics import lever, registration_error


def register_pair(  # noqa: PLR0913
    reference: Survey,
    moving: Survey,
    settings: Settings | None = None,
    *,
    reference_mask: Any = None,
    moving_mask: Any = None,
    manual: Manual | None = None,
    progress: Progress | None = None,
    settled: Callable[[Transform], object] | None = None,
    allow_same: bool = False,
) -> Registration:
    """Lay the moving (repeat) survey on the reference (original) one, and say how sure that is.

    Parameters
    ----------
    reference, moving : Survey
        In the same CRS, or both in local frames (`meshreg.io.frames.common_crs` brings them there).
    settings : Settings, optional
    reference_mask, moving_mask : callable, optional
        What to use of each survey (`meshreg.io.masks.read_mask`).
    manual : callable, optional
        ``manual(motion)`` is a person's proposal (`meshreg.ties.ties_estimate`), of the moving
        survey as `motion` turned it first, if that is not None. It is judged like the methods'.
    progress : callable, optional
        Called with a stage's name and the fraction of it that is done.
    settled : callable, optional
        Called with the transform once it stands, before the surveys are laid down and compared, if
        that is all by which the moving survey will be moved: not where a warp is asked for.

    allow_same : bool
        Whether both surveys may come from the very same files.

    Returns
    -------
    Registration
        A failed registration is a value too: its verdict is "rejected" or "review".

    Raises
    ------
    UsageError
        If the surveys' CRS differ, or only one of them has a known scale.
    InputError
        If every file of both surveys is the same, and that is not allowed.
    ResourceLimitError
        If the search would take more memory than is free.
    """
    settings = settings or Settings()
    if not allow_same:
        require_different(reference, moving)
    if unread := "; ".join(filter(None, map(in_degrees, (reference, moving)))):
        return _unlike(reference, moving, settings, unread, {}, [])
    settings, radius, notes = prepared(reference, moving, settings)
    tell = progress or (lambda stage, fraction: None)
    clock = Clock(tell)
    masks = {"reference": reference_mask, "moving": moving_mask}
    if apart := surveys_apart(reference, moving, radius):
        return _unlike(reference, moving, settings, apart, clock.seconds, notes)
    with clock.stage("rasterize"):
        pairs = rasterize_pair(reference, moving, settings, masks, tell)

    def turned(turn: Turn) -> tuple[Pairs, Transform]:
        motion = turning(turn, moving.centre)
        return rasterize_pair(reference, moving, settings, masks, tell, motion, pairs), motion

    decision = decide(pairs, settings, radius, tell, manual, turned)
    clock.seconds.update(decision.seconds)
    notes += decision.notes
    refined, found = decision.refined, decision.found
    if isinstance(moving.geometry, Maps) and decision.heights is not None:
        decision = dataclasses.replace(decision, heights=decision.heights.levelled())
    notes += [part.note for part in (refined, decision.heights) if part is not None and part.note]
    transform, covariance, error = completed(moving, decision)
    if (
        transform is not None
        and decision.heights is not None
        and settings.refine.surfaces != "none"
    ):
        with clock.stage("surfaces"):
            place, ground = decision.heights.place, decision.heights.ground
            stable = None if ground is None else (ground == STABLE, pairs["dem"][1].grid)
            kind, seed = settings.refine.surfaces, settings.seed
            said = polish(reference, moving, transform, place, error, stable, seed, kind=kind)
        if said.accepted and covariance is not None:
            covariance = _after_polishing(covariance, transform, said)
            error = registration_error(covariance, said.transform, said.transform.apply(place))
        transform, notes = said.transform, [*notes, said.note]
        found = dataclasses.replace(found, surfaces=said.doubt)
    if settled is not None and transform is not None and settings.warp.model == "none":
        settled(transform)
    with clock.stage("apply"):
        rasters = lay_down(moving, transform, settings, masks, pairs)
    with clock.stage("internal"):
        internal, rasters = _internal(refined, transform, rasters, settings)
    notes += [internal.said] if internal.said else []
    layers = (
        second_surface(reference, pairs["dem"][0], settings.seed),
        second_surface(moving, pairs["dem"][1], settings.seed),
    )
    dips = (posture(reference).dip, posture(moving).dip)
    found = dataclasses.replace(found, layers=layers, dips=dips, tilt=_tilt(transform))
    notes += _counted(layers)
    if last_word(decision.placed, findings(found)).verdict != "accepted":
        found = _explained(found, reference, moving, decision, settings, radius, pairs)
    against = findings(found)
    judgement = last_word(decision.placed, against)
    if judgement.verdict != "accepted":  # how far off it may be is not known
        covariance = error = None
    return Registration(
        verdict=judgement.verdict,
        reason=judgement.reason,
        transform=transform,
        covariance=covariance,
        estimates=decision.estimates,
        hypotheses=tuple(_plain(h) for h in judgement.hypotheses[:5]),
        before=compare(
            rasters["reference_dem"],
            rasters["moving_dem_before"],
            rasters["reference_ortho"],
            rasters["moving_ortho_before"],
        )
        if "moving_dem_before" in rasters
        else dict(APART),
        after={}
        if transform is None
        else compare(
            rasters["reference_dem"],
            rasters["moving_dem"],
            rasters["reference_ortho"],
            rasters["moving_ortho"],
        ),
        reference=_about(reference),
        moving=_about(moving),
        settings=settings.as_dict(),
        versions=versions(),
        seconds=clock.seconds,
        notes=tuple(notes),
        registration_error=error,
        internal=internal.record or None,
        warp=internal.warp,
        false_alarm=judgement.false_alarm,
        findings=against,
        heights_gain=_gain(found.gain),
        evidence=rasters
        | {
            "residuals": internal.evidence or _residuals(refined, transform),
            "stable": _stable(decision.heights, transform, pairs["dem"][1], rasters, internal.warp),
            "motion": decision.motion,
            "channels": judgement.maps,
            "masked": {
                which: dict(pairs["dem"][i].masked)
                for i, which in enumerate(("reference", "moving"))
            },
        },
    )


def _counted(layers: Sequence[Layer | None]) -> list[str]:
    """Say where a survey holds more than one surface in a share of its cells worth saying."""
    return [
        f"{layer.cells:.0%} of the {which} survey's cells hold more than one surface (overhangs, "
        "plants, or points off the ground); the top one is compared"
        for which, layer in zip(("reference", "moving"), layers, strict=True)
        if layer is not None and layer.cells >= 0.01
    ]


def _tilt(transform: Transform | None) -> float:
    """Return the angle by which a transform tilts the vertical [degrees]."""
    if transform is None:
        return 0.0
    # the sine keeps a small angle that the cosine loses
    up = transform.rotation[:, 2]
    return float(np.rad2deg(np.arctan2(np.hypot(up[0], up[1]), up[2])))


def _axes(
    reference: Survey, moving: Survey, decision: Decision, settings: Settings, radius: float
) -> str:
    """Name the axes with which image, relief, or bounds and slopes would agree; '' for none.

    Bounds come last: they alone cannot tell depths from north, east and down.
    """
    gain, maps, limit = (
        decision.found.gain,
        decision.judgement.maps,
        settings.judge.accept_gap,
    )
    said = ""
    if gain is not None and gain.inverted:
        said = axes_after(reference, moving, np.diag([1.0, 1.0, -1.0]), "the relief")
    elif judging.turned_map(maps, settings.judge) == judging.EXCHANGED:
        exchange = np.eye(3)[[1, 0, 2]]
        agree = [n for n, part in maps.items() if part.turned.get(judging.EXCHANGED, 0.0) >= limit]
        if "terrain" not in agree:  # its heights are negated too, as north, east and down are
            exchange[2, 2] = -1.0
        said = axes_after(reference, moving, exchange, f"the {agree[0]}")
    return said or other_axes(reference, moving, radius)


def _explained(
    found: Found,
    reference: Survey,
    moving: Survey,
    decision: Decision,
    settings: Settings,
    radius: float,
    pairs: Pairs,
) -> Found:
    """Try other axes on a pair that is not accepted, and a far turn or scale on a rejected one."""
    axes = _axes(reference, moving, decision, settings, radius)
    lost = decision.placed.verdict == "rejected" and not axes
    far = far_pose(pairs, radius, settings.search) if lost else ""
    return dataclasses.replace(found, axes=axes, far=far)


def _gain(gain: Gain | None) -> dict[str, Any] | None:
    """Return the gain of the heights for the record; None where it was not looked for."""
    if gain is None:
        return None
    if gain.unknown:
        return {"value": None, "sigma": None, "reason": gain.unknown}
    return {"value": gain.value, "sigma": gain.sigma}


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


def surveys_apart(reference: Survey, moving: Survey, radius: float) -> str:
    """Say that no offset within `radius` [m] can bring the surveys together; empty if one may."""
    a, b = reference.bounds, moving.bounds
    gaps = np.maximum(a[0, :2] - b[1, :2], b[0, :2] - a[1, :2])
    away = float(gaps.max())
    if away <= radius:
        return ""
    said = f"the surveys lie {away:.4g} m apart, beyond the search radius of {radius:g} m"
    if rival := other_axes(reference, moving, radius):
        return f"{said}; {rival}"
    # as far as brings the whole of the smaller one on the other, and a tenth
    whole = away + float(np.minimum(np.ptp(a[:, :2], axis=0), np.ptp(b[:, :2], axis=0)).max())
    power = 10.0 ** np.floor(np.log10(1.1 * whole))
    further = 0.5 * power * np.ceil(2.2 * whole / power)
    return (
        f"{said}; check "
        "their shifts (--reference-shift, --moving-shift) and CRS, or search further "
        f"(--search-radius {further:g})"
    )


def _internal(
    refined: Refined | None,
    transform: Transform | None,
    rasters: Mapping[str, Any],
    settings: Settings,
) -> tuple[Internal, dict[str, Any]]:
    """Measure how the models bend; where a warp is asked for and found, bend the moving maps."""
    rasters = dict(rasters)
    if refined is None or transform is None:
        return Internal(""), rasters
    dems = rasters["reference_dem"], rasters["moving_dem"]
    internal = measure(refined.tiles, transform, *dems, settings.warp)
    if internal.warp is not None and settings.warp.model != "none":
        for name in ("moving_dem", "moving_ortho"):
            rasters[name] = warped_raster(rasters[name], internal.warp)
        return internal.applied(), rasters
    return dataclasses.replace(internal, warp=None), rasters


def _after_polishing(covariance: Float64, before: Transform, polished: Polished) -> Float64:
    """(7, 7) at the polished transform's pivot, from that of the one before at its own."""
    to = lever(polished.home - (before.pivot + before.offset))
    wide = polished.widened(to @ covariance @ to.T)
    back = lever(polished.transform.pivot + polished.transform.offset - polished.home)
    return np.asarray(back @ wide @ back.T)


def _stable(
    heights: Heights | None,
    transform: Transform | None,
    delivered: SurveyRaster,
    rasters: Mapping[str, Any],
    warp: Warp | None,
) -> Any:
    """Return which ground told the height and the tilt, as the registered DEM lies."""
    if heights is None or heights.ground is None or transform is None:
        return None
    return stable_ground(heights.ground, delivered.grid, transform, rasters["moving_dem"], warp)


def _residuals(refined: Refined | None, transform: Transform | None) -> dict[str, Float64]:
    if refined is None or refined.tiles is None or refined.residuals is None or transform is None:
        return {}
    assert refined.weights is not None
    level = np.full(len(refined.tiles.places), transform.pivot[2])
    places = transform.apply(np.column_stack([refined.tiles.places, level]))
    return {
        "east": places[:, 0],
        "north": places[:, 1],
        "d_east": refined.residuals[:, 0],
        "d_north": refined.residuals[:, 1],
        "weight": refined.weights,
    }


def _unlike(
    reference: Survey,
    moving: Survey,
    settings: Settings,
    reason: str,
    seconds: Mapping[str, float],
    notes: list[str],
) -> Registration:
    estimates = tuple(
        OffsetEstimate(m, "failed", "the surveys do not overlap") for m in settings.methods
    )
    return Registration(
        "rejected",
        reason,
        None,
        None,
        estimates,
        (),
        {},
        {},
        _about(reference),
        _about(moving),
        settings.as_dict(),
        versions(),
        dict(seconds),
        tuple(notes),
    )


def _plain(hypothesis: judging.Hypothesis) -> dict[str, Any]:
    """One candidate as plain values for the record."""
    return {
        "east": hypothesis.east,
        "north": hypothesis.north,
        "score": hypothesis.score,
        "channels": list(hypothesis.gaps),
        "methods": list(hypothesis.methods),
        "overlap": hypothesis.overlap,
    } | {f"{name}_gap": gap for name, gap in hypothesis.gaps.items()}


def _about(survey: Survey) -> dict[str, Any]:
    """Return what the record says of a survey."""
    geometry = survey.geometry
    counts: dict[str, int] = {}
    for source in survey.source:
        for key, count in source.counts.items():
            counts[key] = counts.get(key, 0) + count
    if not counts:
        for key in ("points", "faces", "textures"):
            if hasattr(geometry, key):
                counts[key] = len(getattr(geometry, key))
    shift = survey.source[0].frame.shift if survey.source else survey.origin
    return {
        "name": survey.name,
        "path": [source.path.name for source in survey.source],
        "sha256": [source.sha256 for source in survey.source],
        "counts": counts,
        "shift": shift.tolist(),
        "crs": survey.crs,
        "bounds": survey.bounds.tolist(),
        "notes": list(survey.notes),
    }


def versions() -> dict[str, str]:
    """Versions of meshreg, Python and the packages that the numbers depend on."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in (
        "meshreg",
        "numpy",
        "scipy",
        "numba",
        "opencv-python-headless",
        "rasterio",
        "pyproj",
    ):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
