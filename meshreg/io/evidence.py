"""`evidence.npz`: what the report's pictures are made from, beside the record."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError

NAME = "evidence.npz"
_MAX_BYTES = 128_000_000  # unpacked; a real one has some 5 MB


def write_evidence(kept: Mapping[str, Any], folder: Path) -> Path:
    """Write named arrays to `folder`/evidence.npz, whole or not at all.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    from meshreg.io.atomic import atomic_file

    path = Path(folder) / NAME
    with atomic_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **kept)
    return path


def read_evidence(folder: Path) -> dict[str, Any]:
    """Read what `write_evidence` wrote; nothing in it is executed.

    Returns
    -------
    dict
        Arrays by name, "meta" as a dictionary; empty where there is no such file.

    Raises
    ------
    InputError
        If the file is damaged, of a newer meshreg, or unpacks to more than it may.
    """
    path = Path(folder) / NAME
    if not path.is_file():
        return {}
    remedy = "Run `meshreg register` again, or delete it for a report without pictures."
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _MAX_BYTES:
            raise InputError(f"unpacks to {size} bytes; that is no evidence.", file=path)
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        if not arrays:
            return {}
        meta = json.loads(bytes(arrays.pop("meta")))
        known = isinstance(meta, dict) and meta.get("schema") == "meshreg.evidence/1"
    except (OSError, ValueError, KeyError, EOFError, RecursionError, zipfile.BadZipFile) as error:
        raise InputError(f"cannot be read: {error}", file=path, remedy=remedy) from error
    if not known:
        raise InputError("is no evidence that this meshreg knows.", file=path, remedy=remedy)
    return {**arrays, "meta": meta}
