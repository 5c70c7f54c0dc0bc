"""What meshreg knows of a file format, in one record."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Format:
    """A format of survey files.

    Functions are named as "module:function" and imported at first use.

    Attributes
    ----------
    keys : tuple of str
        Names in `SourceFile.format`.
    suffixes : tuple of str
        Of the files that are read; "" for a folder.
    read : str
        ``read(path, options) -> Survey``.
    rewrite : str
        ``rewrite(source, move, path) -> paths``: the same file, moved.
    write : str
        ``write(survey, path) -> paths``: a new file; "" where none is written.
    written : tuple of str
        Suffixes that are written.
    magic : tuple of (bytes, str, tuple of str)
        How its files begin, what that is called, and the suffixes that it may have.
    require_writable : str
        ``require_writable(source, move, points)``, asked before the work; "" for nothing to ask.
    whole : str
        Why it cannot be bent ("COLMAP models are"); "" where each point can be moved.
    """

    keys: tuple[str, ...]
    suffixes: tuple[str, ...]
    read: str
    rewrite: str
    write: str = ""
    written: tuple[str, ...] = ()
    magic: tuple[tuple[bytes, str, tuple[str, ...]], ...] = ()
    require_writable: str = ""
    whole: str = ""


def load(entry: str) -> Callable[..., Any]:
    """Import the function that "module:function" names."""
    module, _, name = entry.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function
