"""The figures of a registration, drawn from the finished record only."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.records import Registration
from meshreg.report import evidence, overlays, residuals, scene, style

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
    registration: Registration,
    folder: str | Path,
    *,
    scene_seconds: float = 120.0,
    renderer: scene.Renderer | None = None,
    claim: Callable[[int], bool] | None = None,
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
    renderer : scene.Renderer, optional
        That child process, where one has been started already (`scene.renderer`).
    claim : callable, optional
        ``claim(k)`` says whether to draw the k-th figure here: another process may have begun it.

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
    if scene_seconds <= 0:
        return tuple(_drawn(jobs, folder, claim))
    with ThreadPoolExecutor(1) as beside:  # its child works while the others are drawn here
        still = beside.submit(
            scene.draw_scene, registration, folder / "scene.png", scene_seconds, renderer
        )
        written = _drawn(jobs, folder, claim)
    return tuple(written + [path for path in (still.result(),) if path])


def _drawn(
    jobs: Mapping[str, Callable[[], Any]], folder: Path, claim: Callable[[int], bool] | None
) -> list[Path]:
    """Draw and save; a figure that cannot be drawn is a warning in the log.

    One that cannot be saved is an OSError: on a full disk the rest of a result is not whole either.
    """
    written = []
    for number, (name, draw) in enumerate(jobs.items()):
        if claim is not None and not claim(number):
            continue
        path = folder / f"{name}.png"
        try:
            figure = draw()
            picture = None if figure is None else _picture(figure)
        except Exception as error:
            _LOG.warning("The figure %s was not drawn: %s: %s", name, type(error).__name__, error)
            _LOG.debug("why", exc_info=True)
            continue
        if picture is not None:
            _save(picture, path)
            written.append(path)
    return written


def _picture(figure: Any) -> Any:
    """Draw once, without transparency: half the time of `savefig`, smaller files."""
    from PIL import Image

    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])


def _save(picture: Any, path: Path) -> None:
    """Write a picture as PNG, whole or not at all."""
    from PIL.PngImagePlugin import PngInfo

    about = PngInfo()
    about.add_text("Software", "meshreg")
    partial_path = path.with_name(f".{path.name}.tmp")
    try:
        picture.save(partial_path, "PNG", pnginfo=about, compress_level=2, dpi=2 * (style.DPI,))
        os.replace(partial_path, path)
    finally:
        partial_path.unlink(missing_ok=True)
