"""What is doubtful about a pair of surveys: said before the work, and where it failed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from meshreg.cli.common import SurveyRequest
from meshreg.cli.info import plane, remarks
from meshreg.errors import ResourceLimitError, UsageError
from meshreg.io.frames.axes import UNITS
from meshreg.pipeline import in_degrees
from meshreg.records import Float64, Maps, Registration, Survey
from meshreg.settings import Settings

_UNLIKE = 2.5  # ratio of two surveys' widths from which their units are looked at
_CLOSE = 0.15  # relative difference to a ratio of two units that counts as that ratio
_WORTH_SAYING = 0.01  # of the ground; a cell at every edge is counted in part
_CELL, _DRAWN = 11, 10  # bytes a cell: of a raster, and of one in the making
_AREAS = ("flat color", "beneath")  # counted in cells; the rest in triangles or points


def require_scale(
    requests: tuple[SurveyRequest, SurveyRequest], surveys: tuple[Survey, Survey]
) -> None:
    """Refuse two COLMAP models of unknown scale, unless the user states it of both.

    Raises
    ------
    UsageError
        Neither has a scale, and one of them was not stated.
    """
    if any(survey.scale_known for survey in surveys):
        return
    for request, survey in zip(requests, surveys, strict=True):
        if request.options.scale is None:
            raise UsageError(
                f"The scale of {survey.name!r} is not known, and none was stated.",
                file=request.path,
                remedy="State metres per unit (--scale, twice where the two differ), or give "
                "camera positions (--positions).",
            )


def require_memory(surveys: tuple[Survey, Survey], settings: Settings) -> None:
    """Refuse, with numbers and before the work, rasters that this machine cannot hold.

    Counted is what is surely needed at one time: both surveys' rasters, before and after on one
    grid, and one more in the making.

    Raises
    ------
    ResourceLimitError
        That is more than is free.
    """
    from meshreg.io.files.safe import free_memory
    from meshreg.raster.grid import choose_cells, survey_bounds

    cells = choose_cells(*surveys, settings.raster)
    sides = {cells.dem, cells.ortho} | ({cells.sift} if "sift" in settings.methods else set())
    areas = [float(np.prod(np.ptp(survey_bounds(one)[:, :2], axis=0))) for one in surveys]
    count = sum(areas) * sum(side**-2 for side in sides)
    finest = max(areas) * min(sides) ** -2
    needed, free = 2 * _CELL * count + _DRAWN * finest, free_memory()
    if free is not None and needed > free:
        raise ResourceLimitError(
            f"The rasters of {count:,.0f} cells take {needed / 1e9:.1f} GB at least; "
            f"{free / 1e9:.1f} GB are free.",
            remedy="Choose larger cells (--dem-cell, --ortho-cell, --sift-cell), look for stray "
            "points far away, or take a larger machine.",
        )


def same_frame(
    requests: tuple[SurveyRequest, SurveyRequest],
    surveys: tuple[Survey, Survey],
    radius: float,
) -> tuple[Survey, list[str]]:
    """Lay the moving file on the reference's shift where only one of the two has one.

    An export in local coordinates whose shift file was lost lies kilometres from its pair, while
    the numbers in both files meet. Two shifts that disagree are both taken at their word, and
    told.

    Parameters
    ----------
    requests, surveys : pairs
        Reference and moving.
    radius : float
        Farther apart than this [m] nothing would be found.

    Returns
    -------
    moving : Survey
    notes : list of str
    """
    reference, moving = surveys
    home, away = _shift(reference), _shift(moving)
    if home is None or away is None or np.allclose(home, away, rtol=0, atol=1e-3):
        return moving, []
    apart = _gap(reference.bounds, moving.bounds)
    in_files = _gap(reference.bounds - home, moving.bounds - away)
    if apart <= radius or in_files > radius:
        return moving, []
    said = (
        f"With their shifts, ({_words(home)}) for {reference.name!r} and ({_words(away)}) for "
        f"{moving.name!r}, the surveys lie {apart:.4g} m apart; their files' own coordinates meet. "
    )
    lone = not home[:2].any() or not away[:2].any()
    stated = any(request.options.shift is not None for request in requests)
    bare = moving if home[:2].any() else reference
    if not lone or stated or bare.crs is not None:
        remedy = f"If they were exported alike, give --moving-shift {_words(home, ',')}."
        return moving, [said + remedy]
    source = tuple(
        dataclasses.replace(item, frame=dataclasses.replace(item.frame, shift=home))
        for item in moving.source
    )
    moved = dataclasses.replace(moving, origin=moving.origin + (home - away), source=source)
    return moved, [
        said + "Only one of them has a shift, so the reference's was taken for both: the answer "
        "holds for the files' own coordinates."
    ]


def _shift(survey: Survey) -> Float64 | None:
    """Return the shift that all files of a survey have; None where they differ, or for maps."""
    shifts = [source.frame.shift for source in survey.source]
    if not shifts or isinstance(survey.geometry, Maps):
        return None
    return shifts[0] if all((shift == shifts[0]).all() for shift in shifts) else None


def _gap(a: Float64, b: Float64) -> float:
    """Largest empty distance [m] along east or north between two boxes; 0 if they meet."""
    return float(max(np.maximum(a[0, :2] - b[1, :2], b[0, :2] - a[1, :2]).max(), 0.0))


def _words(values: Float64, comma: str = ", ") -> str:
    return comma.join(f"{value:.12g}" for value in values)


def level_notes(surveys: tuple[Survey, Survey]) -> list[str]:
    """Say which of the surveys stand upright, as `meshreg info` does; a slope is left alone."""
    notes = []
    for survey in surveys:
        if in_degrees(survey):  # in which no slope has a meaning
            continue
        tilt, thin = plane(survey)
        if thin != "z":
            notes.append(f"{survey.name}: {remarks(survey, tilt, thin)[0]}")
    return notes


def unit_notes(surveys: tuple[Survey, Survey]) -> list[str]:
    """Say where one survey is as many times as wide as the other as two units' lengths differ."""
    if any(in_degrees(survey) for survey in surveys):
        return []
    widths = [float(np.hypot(*np.ptp(survey.bounds[:, :2], axis=0))) for survey in surveys]
    if not all(width > 0 for width in widths):
        return []
    ratio = widths[1] / widths[0]
    if 1 / _UNLIKE < ratio < _UNLIKE:
        return []
    note = f"{surveys[1].name!r} is {ratio:.3g} times as wide as {surveys[0].name!r}"
    # the wider one has the shorter unit
    wide, times = (surveys[1], ratio) if ratio > 1 else (surveys[0], 1 / ratio)
    fits = [
        (abs(np.log(times * length)), unit) for unit, length in UNITS.items() if unit != "us-ft"
    ]
    off, unit = min(fits)
    if off > np.log1p(_CLOSE):
        return [note + "."]
    return [
        note + f", which would fit if {wide.name!r} were in {unit}: say so by "
        f'unit = "{unit}" in {wide.name}.survey.toml beside it.'
    ]


def masked_notes(registration: Registration) -> list[str]:
    """Say what was left out of each survey's rasters, and what share lies under an overhang."""
    masked: Mapping[str, Any] = registration.evidence.get("masked", {})
    notes = []
    for which, counts in masked.items():
        raster = registration.evidence.get(f"{which}_dem")
        if raster is None or not counts:
            continue
        area = float(np.count_nonzero(raster.valid)) * raster.grid.cell**2
        fine = _finest_cell(registration.settings) ** 2
        said = []
        for what, count in counts.items():
            if what == "mask":
                continue  # the user's own
            name = "hidden beneath other surface (overhangs)" if what == "beneath" else what
            share = count * fine / max(area, 1e-12)
            if what not in _AREAS:
                said.append(f"{name} {count:,}")
            elif share >= _WORTH_SAYING:
                said.append(f"{name} {share:.0%} of the ground")
        if said:
            notes.append(f"Left out of the {which}'s rasters: {'; '.join(said)}.")
    return notes


def _finest_cell(settings: Mapping[str, Any]) -> float:
    """Return the cell [m] that the rasters were drawn at, in which `masked` counts."""
    raster = settings["raster"]
    names = ["dem_cell", "ortho_cell"] + ["sift_cell"] * ("sift" in settings["methods"])
    return min(float(raster[name]) for name in names)
