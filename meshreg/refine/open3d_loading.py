"""Open3D, loaded with the libusb of a wheel: the only way to it.

Open3D's wheel for Linux is linked against libusb (for RealSense cameras), OpenGL and X11, and
brings none of them. The `libusb-package` wheel brings the one that most machines lack. Once a
library of the same name is in the process the dynamic linker takes that one, so it is loaded first;
before the system's own, so that every machine runs what the barest one runs. OpenGL and X11 are the
system's: `meshreg doctor` tells where they are missing.
"""

from __future__ import annotations

import ctypes
import sys
from typing import Any

LIBUSB = "libusb-1.0.so.0"


def load_libusb() -> str:
    """Load libusb into this process; return the path or the name that was loaded.

    Raises
    ------
    OSError
        If neither the package's copy nor the system's can be loaded.
    """
    try:
        import libusb_package

        path = libusb_package.get_library_path()
    except ImportError:
        path = None
    if path is not None:
        try:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
        except OSError:  # made for a newer machine; the system's may do
            pass
        else:
            return str(path)
    ctypes.CDLL(LIBUSB, mode=ctypes.RTLD_GLOBAL)
    return LIBUSB


def load_open3d() -> Any:
    """Return the module `open3d`.

    Raises
    ------
    ImportError, OSError
        If it is not installed, or a library that it needs is missing.
    """
    if sys.platform == "linux":
        load_libusb()
    import open3d

    return open3d
