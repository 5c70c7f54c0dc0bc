"""`evidence.npz`: what the report's pictures are made from, beside the record."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.io.files.checked_json import LARGEST, parse_json, require_schema

NAME = "evidence.npz"
_REMEDY = "Run `meshreg register` again, or delete it for a report without pictures."
_PICTURES = (b"\x89PNG", b"RIFF", b"\xff\xd8\xff")
# Of each array: its name, kinds of dtype, dimensions, and how many columns it may have.
_ARRAYS: tuple[tuple[str, str, int, tuple[int, ...]], ...] = (
    (r"(ortho|small|relief|tone)_[a-z]+|difference|ground|(surface|near)_[a-z_]+", "u", 1, ()),
    (r"height_[a-z]+", "i", 2, ()),
    (r"difference_counts", "iu", 1, ()),
    (r"difference_edges", "f", 1, ()),
    (r"residuals", "f", 2, (5, 7)),
    (r"residual_ups", "f", 2, (4, 5)),
    (r"matches", "f", 2, (5,)),
)
_MAX_BYTES = 128_000_000  # unpacked; a real one has some 5 MB


def write_evidence(kept: Mapping[str, Any], folder: Path) -> Path:
    """Write named arrays to `folder`/evidence.npz, whole or not at all.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    from meshreg.io.files.atomic import atomic_file

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
        If the file is damaged, has an array or a value of another kind than the page shows, is of
        a newer meshreg, or unpacks to more than it may.
    """
    from meshreg.io.files.safe import beside, open_regular

    path = beside(Path(folder), NAME)
    if path is None:
        return {}
    try:
        with open_regular(path) as stream:
            with zipfile.ZipFile(stream) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
            if size > _MAX_BYTES:
                raise InputError(
                    f"unpacks to {size} bytes; that is not the evidence of a result.", file=path
                )
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
    except InputError:
        raise
    except (Exception, MemoryError) as error:  # zipfile, zlib and numpy raise what they like
        raise InputError(f"cannot be read: {error}", file=path, remedy=_REMEDY) from error
    if not arrays:
        return {}
    meta = _meta(arrays.pop("meta", None), path)
    for name, array in arrays.items():
        _require_array(name, array, path)
    missing = [name for name in _wanted(meta, arrays) if name not in arrays and name not in meta]
    if missing:
        raise InputError(f"lacks {missing[0]!r}.", file=path, remedy=_REMEDY)
    return {**arrays, "meta": meta}


def _meta(array: Any, path: Path) -> dict[str, Any]:
    if array is None or array.dtype != np.uint8 or array.ndim != 1:
        raise InputError("has no text 'meta'.", file=path, remedy=_REMEDY)
    meta = parse_json(array.tobytes(), path)
    require_schema(meta, "evidence.schema.json", path, _REMEDY)
    return dict(meta)


def _require_array(name: str, array: Any, path: Path) -> None:
    """Refuse an array of another type or shape than its name says, or numbers that are none."""
    known = next((rule for rule in _ARRAYS if re.fullmatch(rule[0], name)), None)
    why = ""
    if known is None:
        why = "is not known"
    elif array.dtype.kind not in known[1] or array.ndim != known[2] or not array.size:
        why = f"has type {array.dtype} and shape {array.shape}"
    elif known[3] and array.shape[-1] not in known[3]:
        why = f"has shape {array.shape}"
    elif array.dtype.kind == "f" and not (np.abs(array[np.isfinite(array)]) <= LARGEST).all():
        why = f"has a number over {LARGEST:g}"
    elif known[1] == "u" and not array[:12].tobytes().startswith(_PICTURES):
        why = "is not a picture"
    if why:
        raise InputError(
            f"has an array that is none: {why}.", file=path, place=name, remedy=_REMEDY
        )


def _wanted(meta: dict[str, Any], arrays: dict[str, Any]) -> Iterator[str]:
    """Give what the page needs beside what is there."""
    for name in arrays:
        yield from {
            "difference": ("difference_counts", "difference_edges", "difference"),
            "ground": ("ground", "dem"),
            "residuals": ("dem",),
            "residual_ups": ("dem",),
            "matches": ("small_reference", "small_before", "ortho", "matches"),
        }.get(name, ())
        if (start := name.partition("_")[0]) in ("ortho", "relief", "height"):
            yield {"relief": "dem"}.get(start, start)
    for name, about in meta.get("surfaces", {}).items():
        yield f"surface_{name}"
        if about.get("near"):
            yield f"near_{name}"
