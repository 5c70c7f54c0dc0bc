"""The figures of a registration, drawn from the finished record only."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from meshreg.report import evidence, overlays, residuals, scene, style
from meshreg.types import Registration

_LOG = logging.getLogger("meshreg")

# File name and how it is drawn; a function returns None where the record has nothing to show.
FIGURES: dict[str, Callable[[Registration], Any]] = {
    "extents": overlays.draw_extents,
    "orthos": overlays.draw_orthos,
    "relief": overlays.draw_relief,
    "section": overlays.draw_section,
    "matches": evidence.draw_matches,
    "offsets": evidence.draw_offsets,
    "residuals": residuals.draw_residuals,
    "height_difference": residuals.draw_height_difference,
}


def draw_figures(
    registration: Registration, folder: str | Path, *, scene_seconds: float = 120.0
) -> tuple[Path, ...]:
    """Draw every figure that the registration has evidence for, as PNG files.

    Parameters
    ----------
    registration : Registration
        With its evidence (one that was read from JSON has none, and gets offsets and extents only).
    folder : path
        Made if absent.
    scene_seconds : float
        Time allowed for the 3-D still, which is rendered in a child process; 0 leaves it out.

    Returns
    -------
    tuple of Path
        The files written. A figure that cannot be drawn is left out with a warning in the log:
        a picture is never a reason to lose a result.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    jobs: dict[str, Callable[[], Any]] = {
        name: partial(draw, registration) for name, draw in FIGURES.items()
    }
    for estimate in registration.estimates:
        jobs[f"scores_{estimate.method}"] = partial(evidence.draw_surface, estimate)
    written = []
    for name, draw in jobs.items():
        path = folder / f"{name}.png"
        try:
            figure = draw()
            if figure is not None:
                _save(figure, path)
                written.append(path)
        except Exception as error:
            _LOG.warning("The figure %s was not drawn: %s: %s", name, type(error).__name__, error)
            _LOG.debug("why", exc_info=True)
    if scene_seconds > 0:
        still = scene.draw_scene(registration, folder / "scene.png", scene_seconds)
        written += [still] if still else []
    return tuple(written)


def _save(figure: Any, path: Path) -> None:
    partial_path = path.with_name(f".{path.name}.tmp")
    try:
        figure.savefig(partial_path, format="png", dpi=style.DPI, metadata={"Software": "meshreg"})
        os.replace(partial_path, path)
    finally:
        partial_path.unlink(missing_ok=True)
