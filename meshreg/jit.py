"""Numba with a cache that may fail: where it cannot be written, kernels compile each time.

Imported only by the modules called `*kernels.py`, and those only inside functions, so that
`import meshreg` does not pay for numba.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., Any])


def _sources_key() -> str:
    """Return a name for the present state of all kernels.

    Numba looks at the file of the function that it compiled, not at those of the functions that
    this one calls: after a change there it would go on with the old code.
    """
    here = Path(__file__).parent
    total = hashlib.sha256()
    for root in (here, here.parent / "data_synth"):
        for path in sorted(root.rglob("*kernels.py")):
            total.update(path.read_bytes())
    return total.hexdigest()[:12]


def _cache_folder() -> Path | None:
    """Return a writable per-user folder (never a shared one: a cache is code), or None."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(base) / "meshreg" / "numba" / _sources_key()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


_FOLDER = _cache_folder()
if _FOLDER is not None and not numba.config.CACHE_DIR:  # a user's own NUMBA_CACHE_DIR stays
    numba.config.CACHE_DIR = str(_FOLDER)


def jit(**options: Any) -> Callable[[_F], _F]:
    """Compile a function to machine code at its first call (`numba.njit` with our cache)."""

    def decorate(function: _F) -> _F:
        return cast(_F, numba.njit(cache=_FOLDER is not None, **options)(function))

    return decorate


prange = numba.prange
