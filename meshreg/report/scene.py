"""A 3-D still of both surveys, rendered in a child process.

VTK kills the process that runs it where OpenGL is missing, so it never runs in ours.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from meshreg.records import Registration
from meshreg.report import style

Renderer: TypeAlias = "subprocess.Popen[str]"
_LOG = logging.getLogger("meshreg")
_SIDE = 350  # grid points along the longer side

# VTK itself: pyvista, which wraps it, takes a second to import.
# A trial picture is made before there is anything to show: its shaders take longer than the rest.
_CHILD = """
import json, os, sys
import numpy as np
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkRenderingCore import (
    vtkActor, vtkCamera, vtkLightKit, vtkPolyDataMapper, vtkRenderer, vtkRenderWindow,
    vtkWindowToImageFilter,
)
window = vtkRenderWindow()
window.SetOffScreenRendering(True)
window.SetSize(2000, 1000)
window.SetMultiSamples(0)

def picture(data):
    east, north = np.meshgrid(data["east"], data["north"])
    lights, camera, ends, renderers = vtkLightKit(), vtkCamera(), [], []
    camera.SetPosition(-0.45, -1.0, 0.9)
    camera.SetViewUp(0, 0, 1)
    for column, name in enumerate(("reference", "moving")):
        height = data[name]
        node = np.arange(height.size).reshape(height.shape)
        corners = np.stack([node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]], axis=-1)
        seen = np.isfinite(height.ravel()[corners]).all(axis=-1)
        used, corners = np.unique(corners[seen], return_inverse=True)
        points = np.column_stack([x.ravel()[used] for x in (east, north, height)])
        points[:, 2] *= data["exaggeration"]
        place, faces, surface = vtkPoints(), vtkCellArray(), vtkPolyData()
        place.SetData(numpy_to_vtk(points, deep=True))
        faces.SetData(4, numpy_to_vtk(corners.ravel(), deep=True))
        surface.SetPoints(place)
        surface.SetPolys(faces)
        colors = data[name + "_color"].reshape(-1, 3)[used]
        surface.GetPointData().SetScalars(numpy_to_vtk(colors, deep=True))
        mapper, actor, renderer = vtkPolyDataMapper(), vtkActor(), vtkRenderer()
        mapper.SetInputData(surface)
        actor.SetMapper(mapper)
        actor.GetProperty().SetInterpolationToFlat()
        actor.GetProperty().SetAmbient(0.25)
        renderer.AddActor(actor)
        renderer.SetBackground(1, 1, 1)
        renderer.SetViewport(column / 2, 0, (column + 1) / 2, 1)
        renderer.UseFXAAOn()
        lights.AddLightsToRenderer(renderer)
        renderer.SetActiveCamera(camera)
        window.AddRenderer(renderer)
        renderers.append(renderer)
        if used.size:
            ends += [points.min(axis=0), points.max(axis=0)]
    lights.Update()
    renderer.ResetCamera(np.column_stack([np.min(ends, axis=0), np.max(ends, axis=0)]).ravel())
    reader = vtkWindowToImageFilter()
    reader.SetInput(window)
    reader.ReadFrontBufferOff()
    reader.Update()
    image = reader.GetOutput()
    for renderer in renderers:
        window.RemoveRenderer(renderer)
    wide, tall, _ = image.GetDimensions()
    return vtk_to_numpy(image.GetPointData().GetScalars()).reshape(tall, wide, 3)[::-1]

square, grey = np.array([[0.0, 0.1], [0.0, 0.0]]), np.full((2, 2, 3), 128, np.uint8)
trial = {"east": np.arange(2.0), "north": np.arange(2.0), "exaggeration": 1.0}
trial |= {name: square for name in ("reference", "moving")}
picture(trial | {name: grey for name in ("reference_color", "moving_color")})
asked = sys.stdin.readline()
if not asked:
    os._exit(0)
source, target = json.loads(asked)
np.save(target, picture(dict(np.load(source))))
os._exit(0)  # VTK takes a tenth of a second to go
"""


@contextmanager
def renderer() -> Iterator[Renderer]:
    """Start the process that renders; it loads VTK while the caller goes on.

    Raises
    ------
    OSError
        If no process can be started.
    """
    pipe = subprocess.PIPE
    environment = {**os.environ, "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, "-c", _CHILD]
    with subprocess.Popen(
        command, stdin=pipe, stdout=pipe, stderr=pipe, env=environment, text=True, errors="replace"
    ) as child:
        try:
            yield child
        finally:
            child.kill()


def draw_scene(
    registration: Registration, path: Path, seconds: float, ready: Renderer | None = None
) -> Path | None:
    """Render both surveys side by side to `path`; None, with a line in the log, if it cannot be.

    `ready` is a `renderer` that waits for its one picture; without it one is started.
    """
    arrays = _arrays(registration)
    if arrays is None:
        return None
    with tempfile.TemporaryDirectory(prefix="meshreg-") as folder:
        source, picture = Path(folder, "scene.npz"), Path(folder, "scene.npy")
        np.savez(source, **arrays)
        asked = json.dumps([str(source), str(picture)]) + "\n"
        try:
            with nullcontext(ready) if ready is not None else renderer() as child:
                _, said = child.communicate(asked, timeout=seconds)
        except (OSError, subprocess.TimeoutExpired) as error:
            _LOG.info("No 3-D still: %s", error)
            return None
        if child.returncode != 0 or not picture.exists():
            _LOG.info(
                "No 3-D still: this machine cannot render it (%s); see `meshreg doctor`.",
                _death(child.returncode, said),
            )
            return None
        _save(np.load(picture), path, float(arrays["exaggeration"]))
    return path


def _death(code: int, said: str) -> str:
    if code < 0:
        return f"the child was killed by signal {-code}"
    return (said.strip().splitlines() or [f"exit code {code}"])[-1]


def _save(picture: Any, path: Path, exaggeration: float = 1.0) -> None:
    """Crop both halves alike to what they show, and write them side by side with their names."""
    from PIL import Image, ImageDraw

    half = picture.shape[1] // 2
    halves = [picture[:, :half], picture[:, half : 2 * half]]
    shown = (np.minimum(*halves) < 250).any(axis=-1)
    rows, cols = (np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0))
    if rows.size == 0:
        return
    margin = 30
    top, left = max(rows[0] - margin, 0), max(cols[0] - margin, 0)
    parts = [part[top : rows[-1] + margin, left : cols[-1] + margin] for part in halves]
    image = Image.fromarray(np.hstack(parts))
    image.thumbnail((style.MAX_PIXELS, style.MAX_PIXELS))
    canvas = Image.new("RGB", (image.width, image.height + 44), "white")
    canvas.paste(image, (0, 44))
    draw = ImageDraw.Draw(canvas)
    raised = f", heights x {exaggeration:.1f}" if exaggeration > 1.0 else ""
    for column, name in enumerate((f"reference{raised}", f"registered{raised}")):
        draw.text((12 + column * image.width // 2, 8), name, fill="black", font_size=28)
    canvas.save(path, format="PNG", compress_level=2)


def _arrays(registration: Registration) -> dict[str, Any] | None:
    """Both heights with their colors on one coarse grid, local metres; None without a result."""
    evidence = registration.evidence
    reference, moving = evidence.get("reference_dem"), evidence.get("moving_dem")
    if reference is None or moving is None:
        return None
    height, grid = style.reduced_height(reference, _SIDE)
    moved, _ = style.reduced_height(moving, _SIDE)
    if not (np.isfinite(height).any() and np.isfinite(moved).any()):
        return None
    base = float(np.nanmedian(height))
    rows, cols = grid.shape
    low, high = np.nanpercentile(height - base, [2, 98])
    relief = max(float(high - low), 1e-6)
    # Flat ground would show as a plate: relief is raised to a part of the width, never lowered.
    exaggeration = max(1.0, min(20.0, 0.04 * max(rows, cols) * grid.cell / relief))
    colors = [
        _color_at(evidence.get(key), relief_map, grid)
        for key, relief_map in (("reference_ortho", height), ("moving_ortho", moved))
    ]
    return {
        "east": (np.arange(cols) + 0.5) * grid.cell,
        "north": -(np.arange(rows) + 0.5) * grid.cell,
        "reference": height - base,
        "moving": moved - base,
        "reference_color": colors[0],
        "moving_color": colors[1],
        "exaggeration": exaggeration,
    }


def _color_at(ortho: Any, height: Any, grid: Any) -> Any:
    """(rows, cols, 3) uint8 from the orthomosaic; grey relief where there is no color."""
    shade = np.nan_to_num(style.hillshade(height, grid.cell), nan=0.7)
    grey = np.repeat((60 + 180 * np.clip(shade, 0, 1)).astype(np.uint8)[..., None], 3, axis=-1)
    if ortho is None or not ortho.color_valid.any():
        return grey
    row, col = np.mgrid[: grid.shape[0], : grid.shape[1]]
    at_row, at_col = ortho.grid.row_col(*grid.east_north(row, col))
    at_row, at_col = np.rint(at_row).astype(int), np.rint(at_col).astype(int)
    rows, cols = ortho.grid.shape
    inside = (at_row >= 0) & (at_row < rows) & (at_col >= 0) & (at_col < cols)
    at_row, at_col = np.clip(at_row, 0, rows - 1), np.clip(at_col, 0, cols - 1)
    seen = inside & ortho.color_valid[at_row, at_col]
    return np.where(seen[..., None], ortho.color[at_row, at_col], grey)
