"""Open3D loads with the libusb of a wheel."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from meshreg.refine import open3d_loading
from meshreg.refine.open3d_loading import LIBUSB, load_libusb

ROOT = Path(__file__).parents[2]
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere Open3D brings its own libusb")


@LINUX
@pytest.mark.needs("open3d")
def test_libusb_is_the_packages_also_where_the_system_has_one():
    """So the developers' machines and CI run what a machine without libusb runs."""
    code = (
        "from meshreg.refine.open3d_loading import load_open3d\n"
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
