"""What this machine lacks, and the command that brings it.

Every probe runs in a child process: a library without its OpenGL may kill the process that
imports it, and the main program must live to say so.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

State = Literal["ok", "missing", "optional"]

_APT = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libudev.so.1": "libudev1",
    "libXrender.so.1": "libxrender1",
    "libexpat.so.1": "libexpat1",
}
_SMALL_GICP = """
import small_gicp, importlib.metadata as m
tree = small_gicp.KdTree(small_gicp.PointCloud([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
assert tree.nearest_neighbor_search([0.9, 0.0, 0.0])[1] == 1
print("small_gicp", m.version("small_gicp"))
"""
_OPEN3D = """
from meshreg.refine.open3d_loading import load_open3d
open3d = load_open3d()
cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector([[0.0, 0, 0], [1.0, 0, 0]]))
assert open3d.geometry.KDTreeFlann(cloud).search_knn_vector_3d([0.9, 0, 0], 1)[1][0] == 1
print("Open3D", open3d.__version__)
"""
_OPENGL = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pyvista.Sphere(), color="white")
image = plotter.screenshot(return_img=True)
assert image.std() > 1, "the rendered picture is blank"
print("pyvista", pyvista.__version__)
"""
_PROJ = """
import pyproj
to_utm = pyproj.Transformer.from_crs(4326, 32754, always_xy=True, allow_ballpark=False)
east, north = to_utm.transform(141.0, -38.0, errcheck=True)
assert abs(east - 500000) < 1e-3, east
import rasterio.crs
assert rasterio.crs.CRS.from_epsg(32754).is_projected
print("PROJ", pyproj.proj_version_str)
"""
_PYE57 = "import pye57, importlib.metadata as m; print('pye57', m.version('pye57'))"
_NUMBA = """
import meshreg.jit, numba
assert meshreg.jit._FOLDER is not None, "no writable cache folder; kernels compile at each start"
print("numba", numba.__version__, "cache", meshreg.jit._FOLDER)
"""
_GEOTIFF = """
import rasterio, rasterio.io
with rasterio.io.MemoryFile() as file:
    file.open(driver="GTiff", width=1, height=1, count=1, dtype="float32").close()
print("GDAL", rasterio.__gdal_version__)
"""


@dataclass(frozen=True)
class Check:
    """One thing that the machine has or lacks.

    Attributes
    ----------
    name : str
    state : "ok", "missing" or "optional"
        "missing" stops the main job; "optional" is absent but only needed for what `use` says.
    use : str
        What it is for.
    detail : str
        A version, or what went wrong.
    remedy : str
        The command that brings it; empty when there is nothing to bring.
    """

    name: str
    state: State
    use: str
    detail: str
    remedy: str = ""


def run_probe(code: str, *, seconds: float = 90.0) -> tuple[bool, str]:
    """Run Python code in a child; return whether it succeeded and the last line it said."""
    environment = {**os.environ, "PYTHONWARNINGS": "ignore", "PYTHONFAULTHANDLER": ""}
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=seconds,
            env=environment,
            stdin=subprocess.DEVNULL,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer within {seconds:.0f} s"
    except OSError as error:
        return False, f"no child process: {error}"
    said = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    if done.returncode < 0:
        return False, f"killed by signal {-done.returncode}"
    return done.returncode == 0, said[-1].strip() if said else f"exit code {done.returncode}"


def has(what: str) -> tuple[bool, str]:
    """Return whether the machine has "open3d", "opengl", ... and why not."""
    probes = {
        "open3d": _OPEN3D,
        "small_gicp": _SMALL_GICP,
        "opengl": _OPENGL,
        "pye57": _PYE57,
        "pycolmap": "import pycolmap; print(pycolmap.__version__)",
    }
    return run_probe(probes[what])


def _apt_for(message: str) -> str:
    found = [package for library, package in _APT.items() if library in message]
    return f"apt-get install {' '.join(found)}" if found else ""


def _library(name: str, use: str) -> Check:
    found, said = run_probe(f"import ctypes; ctypes.CDLL({name!r})\nprint('found')")
    remedy = "" if found else f"apt-get install {_APT[name]}"
    return Check(name, "ok" if found else "optional", use, said, remedy)


def _probe(name: str, use: str, code: str, *, needed: bool, remedy: str) -> Check:
    found, said = run_probe(code)
    if found:
        return Check(name, "ok", use, said)
    state: State = "missing" if needed else "optional"
    return Check(name, state, use, said, _apt_for(said) or remedy)


def _python() -> Check:
    version = ".".join(str(part) for part in sys.version_info[:3])
    new_enough = sys.version_info >= (3, 11)
    return Check("Python", "ok" if new_enough else "missing", "everything", version)


def _proj() -> Check:
    """Probe PROJ as it is; where the environment misleads it, meshreg ignores that and says so."""
    use = "coordinate systems"
    found, said = run_probe(_PROJ)
    misled = [name for name in ("PROJ_DATA", "PROJ_LIB") if name in os.environ]
    if found or not misled:
        return Check(
            "PROJ",
            "ok" if found else "missing",
            use,
            said,
            "" if found else _reinstall("pyproj rasterio"),
        )
    clean = "import os\nfor n in ('PROJ_DATA', 'PROJ_LIB'): os.environ.pop(n, None)\n"
    state: State = "optional" if run_probe(clean + _PROJ)[0] else "missing"
    return Check("PROJ", state, use, f"{' and '.join(misled)} lead astray: {said}", _UNSET)


def _writable(name: str, folder: Path, use: str) -> Check:
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"meshreg")
        free = shutil.disk_usage(folder).free / 1e9
    except OSError as error:
        return Check(name, "missing", use, f"{folder}: {error.strerror}", f"chmod u+w {folder}")
    few = free < 1.0
    detail = f"{folder}: {free:.1f} GB free"
    return Check(name, "missing" if few else "ok", use, detail, "free some disk" if few else "")


def _pip(package: str) -> str:
    python = os.path.relpath(sys.executable)
    python = sys.executable if python.startswith("..") else python
    return f"{shlex.quote(python)} -m pip install {package}"


def _reinstall(package: str) -> str:
    return _pip(f"--force-reinstall {package}")


_UNSET = "unset PROJ_DATA PROJ_LIB"


def examine() -> tuple[Check, ...]:
    """Probe the machine; the probes run in child processes, a few at a time (about 10 s)."""
    jobs = [
        lambda: _library("libGL.so.1", "3-D pictures"),
        lambda: _library("libEGL.so.1", "3-D pictures without a screen"),
        lambda: _probe(
            "numba", "kernels", _NUMBA, needed=False, remedy="export XDG_CACHE_HOME=~/.cache"
        ),
        lambda: _probe(
            "SIFT",
            "the image method",
            "import cv2; cv2.SIFT_create(); print('OpenCV', cv2.__version__)",
            needed=True,
            remedy=_reinstall("opencv-python-headless"),
        ),
        _proj,
        lambda: _probe(
            "GeoTIFF", "maps in and out", _GEOTIFF, needed=True, remedy=_reinstall("rasterio")
        ),
        lambda: _probe(
            "LAZ",
            "LAS, LAZ, COPC",
            "import laspy, lazrs; print('laspy', laspy.__version__)",
            needed=False,
            remedy=_pip("'laspy[lazrs]'"),
        ),
        lambda: _probe(
            "COLMAP",
            "COLMAP model folders",
            "import pycolmap; print('pycolmap', pycolmap.__version__)",
            needed=False,
            remedy=_pip("pycolmap"),
        ),
        lambda: _probe(
            "E57",
            "E57 scans",
            _PYE57,
            needed=False,
            remedy=_pip("pye57"),
        ),
        lambda: _probe(
            "small_gicp",
            "refine.surfaces=gicp",
            _SMALL_GICP,
            needed=False,
            remedy=_reinstall("small_gicp"),
        ),
        lambda: _probe(
            "Open3D",
            "refine.surfaces=icp",
            _OPEN3D,
            needed=False,
            remedy="apt-get install libgl1 libegl1 libx11-6",
        ),
        lambda: _probe(
            "3-D rendering",
            "the 3-D still among the figures",
            _OPENGL,
            needed=False,
            remedy="apt-get install libgl1 libegl1",
        ),
    ]
    with ThreadPoolExecutor(max_workers=max(1, min(4, os.cpu_count() or 1))) as pool:
        probed = list(pool.map(lambda job: job(), jobs))
    here = _writable("this folder", Path.cwd(), "results written here")
    temporary = _writable("temporary folder", Path(tempfile.gettempdir()), "unpacking")
    return (_python(), here, temporary, *probed)
