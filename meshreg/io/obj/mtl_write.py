"""Let an OBJ file and its MTL files refer to copies that could not keep their names."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path, PurePosixPath

from meshreg.errors import InputError, OutputError
from meshreg.io.files.atomic import atomic_file, copy_file
from meshreg.io.files.rewriting import copy_name
from meshreg.io.files.safe import (
    MissingReferenceError,
    decode_name,
    open_regular,
    resolve_reference,
)
from meshreg.io.obj.mtl import name_start
from meshreg.io.obj.udim import has_token, tile_pages
from meshreg.records import SourceFile

_LIBRARY = re.compile(rb"(?m)^([ \t]*mtllib[ \t]+)([^\r\n]*?)([ \t]*\r?)$")
_MAP = re.compile(
    rb"(?mi)^([ \t]*(?:map_\w+|bump|disp|decal|refl|norm)[ \t]+)([^\r\n]*?)([ \t]*\r?)$"
)


def new_libraries(source: SourceFile) -> Callable[[bytes], bytes] | None:
    """Return what gives a block of an OBJ file the new names of its MTL files; None: all stay."""
    if not source.copies:
        return None
    folder = source.path.parent

    def replaced(found: re.Match[bytes]) -> bytes:
        try:
            # one name that may hold blanks, as the reader takes it first
            new = _new_name(source, folder, found[2])
        except MissingReferenceError:
            new = b" ".join(_or_same(source, folder, word) for word in found[2].split())
        return found[1] + new + found[3]

    def work(text: bytes) -> bytes:
        return _LIBRARY.sub(replaced, text) if b"mtllib" in text else text

    return work


def write_libraries(source: SourceFile, path: Path) -> None:
    """Write the copies of an OBJ file's MTL files beside `path`, which name the pages' copies.

    Raises
    ------
    OutputError
        A file of that name and other content is there.
    """
    for library in source.companions if source.copies else ():
        if library.suffix.lower() != ".mtl":
            continue
        folder = library.parent
        with open_regular(library) as stream:
            before = stream.read()
        after = _MAP.sub(
            lambda found, folder=folder: _new_map(source, folder, found),  # type: ignore[misc]
            before,
        )
        target = path.parent / copy_name(source, library)
        if after == before:
            copy_file(library, target)
            continue
        if target.exists() and target.read_bytes() != after:
            raise OutputError(
                "exists already with other content.", file=target, remedy="Choose another folder."
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(target) as temporary:
            temporary.write_bytes(after)


def _new_map(source: SourceFile, folder: Path, found: re.Match[bytes]) -> bytes:
    start = name_start(found[1].strip(), found[2])
    name = found[2][start:]
    new = _new_pattern(source, folder, name) or _or_same(source, folder, name)
    return found[1] + found[2][:start] + new + found[3]


def _new_pattern(source: SourceFile, folder: Path, name: bytes) -> bytes | None:
    """Return a name that stands for many pages (<UDIM>) as their copies are called, or None."""
    if not has_token(text := decode_name(name)):
        return None
    for page in tile_pages(folder, text, source.path.parent).values():
        if (new := source.copies.get(page)) is not None:
            before = PurePosixPath(new).name.removesuffix(page.name)
            cut = max(name.rfind(b"/"), name.rfind(b"\\")) + 1
            return name[:cut] + os.fsencode(before) + name[cut:]
    return None


def _or_same(source: SourceFile, folder: Path, name: bytes) -> bytes:
    with suppress(InputError):  # it names nothing that is there
        return _new_name(source, folder, name)
    return name


def _new_name(source: SourceFile, folder: Path, name: bytes) -> bytes:
    """Return a reference as it is to be written, the same unless its file's copy is renamed."""
    new = source.copies.get(resolve_reference(folder, name, root=source.path.parent))
    if new is None:
        return name
    cut = max(name.rfind(b"/"), name.rfind(b"\\")) + 1
    return name[:cut] + os.fsencode(PurePosixPath(new).name)
