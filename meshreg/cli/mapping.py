"""`meshreg rasterize`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rich.markup import escape

from meshreg.cli.common import (
    LOG,
    NewFolder,
    SurveyRequest,
    named_files,
    new_folder,
    read,
    read_masks,
    require_disk,
)
from meshreg.cli.console import Progress, Terminal, logging_to
from meshreg.cli.guard import Unfinished
from meshreg.settings import Settings


@dataclass(frozen=True)
class RasterizeRequest:
    """Everything that `meshreg rasterize` was asked."""

    survey: SurveyRequest
    out: Path
    masks: tuple[str, ...] = ()
    settings: Settings = field(default_factory=Settings)
    overwrite: bool = False
    config: Path | None = None


def rasterize(request: RasterizeRequest, voice: Terminal, unfinished: Unfinished) -> dict[str, Any]:
    """Write dem.tif and ortho.tif of one survey; say what they are."""
    from meshreg.io.maps.pair import local_crs, write_raster
    from meshreg.io.result.manifest import require_apart, survey_files
    from meshreg.raster import rasterize as make_raster
    from meshreg.raster.grid import choose_cells, survey_grid

    inputs = named_files((request.survey,), request.masks, others=(request.config,))
    new = NewFolder(request.out, request.overwrite, "rasterize", "dem.tif", inputs)
    with (
        new_folder(new, unfinished) as folder,
        logging_to(voice, folder / "log.txt"),
        Progress(voice) as progress,
    ):
        progress("read", 0.0)
        survey = read(request.survey)
        require_apart(request.out, survey_files(survey))
        require_disk(folder, None)
        mask = read_masks(request.masks, {"reference": survey})["reference"]
        options = request.settings.raster
        cells = choose_cells(survey, survey, options)
        maps: dict[str, Any] = {}
        plan: tuple[tuple[str, float, Literal["height", "color"]], ...] = (
            ("dem", cells.dem, "height"),
            ("ortho", cells.ortho, "color"),
        )
        for done, (name, cell, what) in enumerate(plan):
            progress("rasterize", done / 2)
            raster = make_raster(survey, survey_grid(survey, cell, cell), options, mask=mask)
            seen = raster.valid if what == "height" else raster.color_valid
            if what == "color" and not seen.any():
                LOG.warning("%s has no color; no orthomosaic is written.", survey.name)
                continue
            write_raster(raster, folder / f"{name}.tif", what, local_crs(survey))
            maps[name] = {
                "file": str(request.out / f"{name}.tif"),
                "cell": raster.grid.cell,
                "rows": raster.grid.shape[0],
                "columns": raster.grid.shape[1],
                "bounds": list(raster.grid.bounds),
                "covered": float(seen.mean()),
                "masked": dict(raster.masked),
            }
        progress("rasterize", 1.0)
    return {
        "schema": "meshreg.maps/1",
        "survey": survey.name,
        "crs": survey.crs,
        "maps": maps,
        "notes": list(survey.notes),
    }


def show_maps(document: dict[str, Any], voice: Terminal) -> None:
    """Print what `rasterize` wrote."""
    for one in document["maps"].values():
        size = f"{one['rows']} × {one['columns']} cells of {one['cell']:g} m"
        voice.say(f"{escape(one['file'])}: {size}, {one['covered']:.0%} covered")
        for what, count in one["masked"].items():
            if count:
                voice.say(f"  left out: {escape(what)} {count:,}")
    for note in document["notes"]:
        voice.say(f"[dim]note:[/] {escape(note)}")
