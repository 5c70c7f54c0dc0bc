"""The interactive 3-D window of a result, in a child process.

VTK kills the process that runs it where OpenGL or the screen is missing, so it never runs in ours.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import ResourceLimitError, UsageError
from meshreg.report.keeping import NO_HEIGHT

_REMEDY = "Open report.html instead: it shows both surfaces in the browser."
_CHILD = """
import sys
import numpy as np, pyvista as pv
folder, target = sys.argv[1:]
data = dict(np.load(folder + "/view.npz"))
plotter = pv.Plotter(off_screen=bool(target), window_size=(1400, 900), title="meshreg")
plotter.set_background("white", top="lightsteelblue")
actors = {}
for name in ("reference", "before", "after"):
    if name not in data:
        continue
    east, north = np.meshgrid(data["east"], data["north"])
    seen = np.isfinite(data[name])
    surface = pv.StructuredGrid(east, north, np.where(seen, data[name], 0.0))
    surface["seen"] = seen.ravel(order="F").astype(np.uint8)
    uv = [(east - data["west"]) / data["wide"], 1 - (data["top"] - north) / data["tall"]]
    look = {"color": "steelblue" if name == "reference" else "sandybrown"}
    if name + "_picture" in data:
        surface.active_texture_coordinates = np.column_stack([x.ravel(order="F") for x in uv])
        look = {"texture": pv.Texture(data[name + "_picture"])}
    surface = surface.threshold(0.5, scalars="seen", all_scalars=True).extract_surface()
    surface.clear_data() if "color" in look else surface.set_active_scalars(None)
    if surface.n_points:
        actors[name] = plotter.add_mesh(surface, ambient=0.25, specular=0.0, **look)
shown = ["reference", "after" if "after" in actors else "before"]

def show(*names):
    for name, actor in actors.items():
        actor.SetVisibility(name in names)
    plotter.render()

last = shown[-1]
plotter.add_key_event("1", lambda: show("reference"))
plotter.add_key_event("2", lambda: show(last))
plotter.add_key_event("3", lambda: show("before"))
plotter.add_key_event("4", lambda: show("reference", last))
plotter.add_text(
    "1 reference   2 moving, registered   3 moving, as delivered   4 both   q close",
    font_size=9, color="black",
)
plotter.add_axes(xlabel="east", ylabel="north", zlabel="up", color="black")
plotter.view_vector((-0.45, -1.0, 0.9), viewup=(0, 0, 1))
for name, actor in actors.items():
    actor.SetVisibility(name in shown)
if target:
    np.save(target, plotter.screenshot(return_img=True))
else:
    plotter.show()
"""


def open_view(kept: Mapping[str, Any], folder: Path) -> None:
    """Open the window and wait until it is closed.

    Parameters
    ----------
    kept : mapping
        What `meshreg.report.keep` kept, "meta" as a dictionary.
    folder : Path
        The result's folder, named in errors.

    Raises
    ------
    UsageError
        If the result has no surfaces, or this session has no screen.
    ResourceLimitError
        If the machine cannot open the window.
    """
    arrays = _arrays(kept)
    if arrays is None:
        raise UsageError(
            "holds no surfaces to show (no evidence.npz with heights).",
            file=folder,
            remedy="Run `meshreg register` again.",
        )
    if not _has_display():
        raise UsageError("There is no screen here (DISPLAY is not set).", remedy=_REMEDY)
    code, said = _run(arrays)
    if code != 0:
        raise ResourceLimitError(
            f"The window could not be opened ({said}); see `meshreg doctor`.", remedy=_REMEDY
        )


def _has_display() -> bool:
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _run(arrays: Mapping[str, Any], target: Path | None = None) -> tuple[int, str]:
    """Run the child; with `target` it draws there (a NumPy array) instead of opening a window."""
    environment = {**os.environ, "PYTHONWARNINGS": "ignore"}
    with tempfile.TemporaryDirectory(prefix="meshreg-") as folder:
        np.savez(Path(folder, "view.npz"), **arrays)
        done = subprocess.run(
            [sys.executable, "-c", _CHILD, folder, str(target or "")],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
            text=True,
            errors="replace",
            env=environment,
            check=False,
        )
    if done.returncode < 0:
        return done.returncode, f"killed by signal {-done.returncode}"
    return done.returncode, (done.stderr.strip().splitlines() or ["no reason given"])[-1]


def _arrays(kept: Mapping[str, Any]) -> dict[str, Any] | None:
    """Heights in local metres and the orthomosaics as pictures; None without a pair."""
    about = kept.get("meta", {}).get("height")
    stages = [s for s in ("reference", "before", "after") if f"height_{s}" in kept]
    if about is None or "reference" not in stages or len(stages) < 2:
        return None
    rows, cols = kept["height_reference"].shape
    cell, (west, _, _, north) = float(about["cell"]), about["bounds"]
    arrays: dict[str, Any] = {
        "east": (np.arange(cols) + 0.5) * cell,
        "north": -(np.arange(rows) + 0.5) * cell,
    }
    for stage in stages:
        level = kept[f"height_{stage}"]
        arrays[stage] = np.where(level == NO_HEIGHT, np.nan, level * float(about["step"]))
    if "ortho" in kept["meta"]:
        left, bottom, right, top = kept["meta"]["ortho"]["bounds"]
        arrays |= {"west": left - west, "wide": right - left}
        arrays |= {"top": top - north, "tall": top - bottom}
        for stage in stages:
            if f"ortho_{stage}" in kept:
                arrays[f"{stage}_picture"] = _decoded(kept[f"ortho_{stage}"])
    else:
        arrays |= {"west": 0.0, "wide": 1.0, "top": 0.0, "tall": 1.0}
    return arrays


def _decoded(picture: Any) -> Any:
    from PIL import Image

    with Image.open(io.BytesIO(bytes(picture))) as image:
        return np.asarray(image.convert("RGB"))
