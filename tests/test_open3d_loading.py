"""Open3D loads without any package of the operating system: with the libusb of its wheel."""

from __future__ import annotations

import ctypes
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from seafloor import Seafloor

from meshreg import open3d_loading
from meshreg.open3d_loading import LIBUSB, load_libusb

ROOT = Path(__file__).parent.parent
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere Open3D brings its own libusb")


@LINUX
@pytest.mark.needs("open3d")
def test_libusb_is_the_packages_also_where_the_system_has_one():
    """So the developers' machines and CI run what a machine without libusb runs."""
    code = (
        "from meshreg.open3d_loading import load_open3d\n"
        "print(load_open3d().__version__)\n"
        "maps = [line.split()[-1] for line in open('/proc/self/maps') if 'libusb' in line]\n"
        "print(*sorted(set(maps)), sep='\\n')\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        capture_output=True, text=True, cwd=ROOT, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    _, *loaded = done.stdout.splitlines()
    assert [Path(path).parent.name for path in loaded] == ["libusb_package"]


@pytest.mark.parametrize("packaged", ["/nowhere/libusb.so", None])
def test_the_systems_libusb_where_the_package_has_none_that_loads(monkeypatch, packaged):
    asked = []

    def load(name, mode):
        asked.append((name, mode))
        if name != LIBUSB:
            raise OSError("GLIBC_9.99 not found")

    monkeypatch.setitem(
        sys.modules, "libusb_package", SimpleNamespace(get_library_path=lambda: packaged)
    )
    monkeypatch.setattr(open3d_loading.ctypes, "CDLL", load)
    assert load_libusb() == LIBUSB
    assert [name for name, _ in asked] == [name for name in (packaged, LIBUSB) if name]
    assert {mode for _, mode in asked} == {ctypes.RTLD_GLOBAL}


def test_without_any_libusb_the_library_is_named(monkeypatch):
    def load(name, mode):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setitem(sys.modules, "libusb_package", None)
    monkeypatch.setattr(open3d_loading.ctypes, "CDLL", load)
    with pytest.raises(OSError, match=LIBUSB):
        load_libusb()


@pytest.mark.needs("open3d")
def test_the_command_polishes_on_surfaces_in_a_process_of_its_own(tmp_path):
    """`refine.surfaces=gicp` as a user runs it; what it is worth is asserted in test_surfaces."""
    floor = Seafloor.random(11, size=12.0)
    files = []
    for name, ground, seed in (("old", floor, 1), ("new", floor.moved(0.337, -0.412), 2)):
        raster = ground.raster(0.04, 2.5, noise=0.001, seed=seed)
        east, north = raster.grid.east_north(*np.indices(raster.grid.shape))
        points = np.stack([east, north, raster.height], axis=-1).reshape(-1, 3)
        rows = np.hstack([points, raster.color.reshape(-1, 3)])
        files.append(tmp_path / f"{name}.csv")
        head, form = "x,y,z,r,g,b", "%.4f,%.4f,%.4f,%d,%d,%d"
        np.savetxt(files[-1], rows, form, header=head, comments="")
    command = [
        sys.executable, "-m", "meshreg", "register", *files, "-o", tmp_path / "out", "--json",
        "--search-radius", "2", "--set", "refine.surfaces=gicp",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    document = json.loads(done.stdout)
    offset = [document["offset"][axis] for axis in ("east", "north")]
    assert offset == pytest.approx([-0.337, 0.412], abs=0.004)
    (note,) = [note for note in document["notes"] if note.startswith("polish")]
    millimetres = re.search(r"([\d.]+) mm to ([\d.]+) mm rms", note)
    assert millimetres or "does not bring them closer" in note  # both say that Open3D was there
