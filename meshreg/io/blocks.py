"""Find the files of a survey, know their format, read and rewrite them one by one."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from meshreg.errors import InputError, OutputError, UsageError
from meshreg.io import READERS, REWRITERS, load
from meshreg.io.frames import make_mover, registered_frame, to_file
from meshreg.io.mover import is_plain
from meshreg.io.options import ReadOptions
from meshreg.io.safe import fingerprint, open_regular, sha256
from meshreg.io.sidecar import is_sidecar, write_shift
from meshreg.types import SourceFile, Survey, Transform, Warp

_MAGIC = (
    (b"ply", "PLY", (".ply",)),
    (b"glTF", "binary glTF", (".glb",)),
    (b"LASF", "LAS", (".las", ".laz")),
    (b"ASTM-E57", "E57", (".e57",)),
    (b"II*\0", "TIFF", (".tif", ".tiff")),
    (b"MM\0*", "TIFF", (".tif", ".tiff")),
    (b"II+\0", "TIFF", (".tif", ".tiff")),
    (b"MM\0+", "TIFF", (".tif", ".tiff")),
)
_FOREIGN = (
    (b"PK\x03\x04", "a ZIP archive (.zip, .npz, .kmz)"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"7z\xbc\xaf", "a 7z archive"),
    (b"Rar!", "a RAR archive"),
    (b"\x93NUMPY", "a NumPy array"),
    (b"\x80\x04", "a Python pickle"),
    (b"\x80\x05", "a Python pickle"),
    (b"%PDF", "a PDF"),
    (b"\x89PNG", "a PNG picture"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"Kaydara FBX", "FBX"),
    (b"<", "XML (COLLADA, X3D, VRT or the like)"),
)
_UNPACK = "Unpack or convert it, and give the survey file itself."
# What a folder is taken for: the first row with a file in it; mixtures within a row are refused.
_FOLDER_RANKS = (
    (
        (".obj",),
        (".ply",),
        (".glb", ".gltf"),
        (".stl",),
        (".off",),
        (".las", ".laz"),
        (".e57",),
    ),
    ((".tif", ".tiff"),),
    ((".xyz",), (".pts",), (".asc",), (".csv",)),
    ((".txt",),),
)
_COLMAP = ("cameras", "images", "points3D")


@dataclass(frozen=True)
class Block:
    """One file, pair of maps or model folder, and the reader's entry for it."""

    path: Path
    reader: str


def find_blocks(path: str | Path | Sequence[str | Path]) -> tuple[Block, ...]:
    """Return the files that one survey's path stands for, each with its reader.

    Raises
    ------
    InputError
        Nothing there, an unknown or foreign format, several formats in one folder.
    """
    if not isinstance(path, str | Path):
        items = list(path)
        if not items:
            raise UsageError("an empty list of survey files was given.")
        return tuple(block for item in items for block in find_blocks(item))
    text = str(path)
    if os.path.lexists(text):
        here = Path(text)
        return _folder_blocks(here) if here.is_dir() else (_file_block(here),)
    parts = [part.strip() for part in text.split(",")]
    if len(parts) > 1 and all(part.lower().endswith((".tif", ".tiff")) for part in parts):
        for part in parts:
            _file_block(Path(part))
        return (Block(Path(text), READERS[".tif"]),)
    if glob.has_magic(text):
        found = [Path(item) for item in sorted(glob.glob(text, recursive=True))]
        files = [item for item in found if _is_survey(item)]
        if not files:
            raise InputError(
                f"fits no survey file ({len(found)} files fit at all).",
                file=text,
                remedy="Check the pattern, and quote it.",
            )
        return _one_format(files, Path(text))
    raise InputError("does not exist.", file=text, remedy="Check the path.")


def _is_survey(path: Path) -> bool:
    return (
        path.is_file()
        and path.suffix.lower() in READERS
        and not path.name.startswith(".")
        and not is_sidecar(path)
    )


def _file_block(path: Path) -> Block:
    """Choose a file's reader by its suffix; its first bytes must not contradict."""
    suffix = path.suffix.lower()
    with open_regular(path) as stream:
        head = stream.read(16)
    if not head:
        raise InputError("is empty.", file=path, remedy="Export or copy it again.")
    known = [(name, suffixes) for magic, name, suffixes in _MAGIC if _starts(head, magic)]
    for name, suffixes in known:
        if suffix not in suffixes:
            called = f"is called {path.suffix}" if suffix else "has no suffix"
            raise InputError(
                f"is {name}, but {called}.", file=path, remedy=f"Name it {path.stem}{suffixes[0]}."
            )
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    for magic, name in _FOREIGN:
        if start.startswith(magic):
            raise InputError(f"is {name}, which is not read.", file=path, remedy=_UNPACK)
    if not suffix or suffix not in READERS:
        raise InputError(
            f"has a suffix {path.suffix!r} that is not known.",
            file=path,
            remedy=f"Surveys are read as {', '.join(key for key in READERS if key)}.",
        )
    wanted = [name for _, name, suffixes in _MAGIC if suffix in suffixes]
    if wanted and not known:
        raise InputError(
            f"is called {suffix}, but does not start as {wanted[0]} does.",
            file=path,
            remedy="It is damaged or of another format; export it again.",
        )
    return Block(path, READERS[suffix])


def _starts(head: bytes, magic: bytes) -> bool:
    # The word "ply" stands on a line of its own.
    return head.startswith(magic) and (magic != b"ply" or head[3:4] in (b"\r", b"\n", b" "))


def _folder_blocks(folder: Path) -> tuple[Block, ...]:
    names = {entry.name.lower() for entry in folder.iterdir()}
    parts = [part for part in _COLMAP if {f"{part}.bin".lower(), f"{part}.txt".lower()} & names]
    if len(parts) >= 2 or (not parts and _model_folders(folder)):
        return (Block(folder, READERS[""]),)
    files = sorted(entry for entry in folder.iterdir() if _is_survey(entry))
    for rank in _FOLDER_RANKS:
        fits = [entry for entry in files if any(entry.suffix.lower() in group for group in rank)]
        if fits:
            return _one_format(fits, folder)
    raise InputError(
        "is a folder without a survey file in it.",
        file=folder,
        remedy=f"Surveys are read as {', '.join(key for key in READERS if key)}.",
    )


def _model_folders(folder: Path) -> bool:
    """Whether COLMAP models lie below: sparse/, sparse/0, 0, 1 and so on."""
    below = [folder / "sparse", *folder.glob("sparse/[0-9]*"), *folder.glob("[0-9]*")]
    return any(
        (place / f"cameras{suffix}").is_file() for place in below for suffix in (".bin", ".txt")
    )


def _one_format(files: Sequence[Path], where: Path) -> tuple[Block, ...]:
    """Return the blocks of files that are all of one format, or refuse the mixture."""
    groups = [group for rank in _FOLDER_RANKS for group in rank]
    kinds = {next(g for g in groups if path.suffix.lower() in g): path for path in files}
    if len(kinds) > 1:
        names = ", ".join(path.name for path in kinds.values())
        raise InputError(
            f"holds surveys of several formats, among them {names}.",
            file=where,
            remedy="Name the one that is meant.",
        )
    blocks = tuple(_file_block(path) for path in files)
    if files[0].suffix.lower() in (".tif", ".tiff") and len(files) > 1:
        if len(files) == 2:
            pair = ",".join(str(path) for path in files)
            return (Block(Path(pair), READERS[".tif"]),)
        raise InputError(
            f"holds {len(files)} GeoTIFFs.", file=where, remedy='Give two as "dem.tif,ortho.tif".'
        )
    return blocks


def read_block(block: Block, options: ReadOptions) -> Survey:
    """Read one block; record its files' checksums and make sure that none changed meanwhile."""
    for name in ("scale", "positions") if block.reader != READERS[""] else ():
        if getattr(options, name) is not None:
            raise UsageError(
                f"{name} is for COLMAP models.",
                file=block.path,
                remedy="Give the unit, as a name or as its length in metres."
                if name == "scale"
                else None,
            )
    is_file = block.path.is_file()
    before = fingerprint(block.path) if is_file else None
    survey = cast(Survey, load(block.reader)(block.path, options))
    if is_file and fingerprint(block.path) != before:
        raise InputError("changed while it was read.", file=block.path, remedy="Read it again.")
    return replace(survey, source=tuple(_recorded(source) for source in survey.source))


def _recorded(source: SourceFile) -> SourceFile:
    if not source.path.is_file() or (source.sha256 and source.fingerprint != (0, 0)):
        return source
    mark = fingerprint(source.path, source.companions)
    return replace(source, sha256=sha256(source.path), fingerprint=mark)


def require_warpable(survey: Survey) -> None:
    """Do `meshreg.io.require_warpable`."""
    for source in survey.source:
        if source.format in ("glb", "gltf", "colmap"):
            kind = "COLMAP models are" if source.format == "colmap" else "glTF files are"
            raise UsageError(
                f"cannot be warped: {kind} moved as a whole.",
                file=source.path,
                remedy="Export the survey as .obj, .ply or .laz, or register with --warp none.",
            )


def rewrite(
    survey: Survey,
    transform: Transform,
    folder: Path,
    reference: Survey | None,
    suffix: str,
    warp: Warp | None = None,
) -> tuple[Path, ...]:
    """Do `meshreg.io.rewrite_survey`."""
    if warp is not None:
        require_warpable(survey)
    if not survey.source:
        raise UsageError(f"survey {survey.name!r} was made in memory; it has no files to rewrite.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot be made: {error.strerror}.", file=folder) from error
    centre = transform.apply(survey.centre)
    home = reference.source[0] if reference is not None and reference.source else None
    written: list[Path] = []
    taken: set[str] = set()
    for source in survey.source:
        target = registered_frame(home or source, source, centre=centre)
        start = source.frame
        if start.crs is not None and survey.crs is not None and start.crs != survey.crs:
            start = replace(start, crs=survey.crs)
        local = to_file(start, survey.centre[None])[0]
        mover = make_mover(source, transform, target, centre=local, warp=warp)
        path = folder / _free_name(source.path, suffix, taken)
        written += load(REWRITERS[source.format])(source, mover, path)
        if source.format != "maps":
            in_file = source.format == "e57" or (source.format == "las" and is_plain(target))
            written += write_shift(path, target, carries_crs=in_file)
    return tuple(dict.fromkeys(written))


def _free_name(path: Path, suffix: str, taken: set[str]) -> str:
    """Return a name for the moved file that no earlier block has."""
    copc = path.name.lower().endswith(".copc.laz")  # its index does not survive; it becomes LAZ
    stem, end = (path.name[: -len(".copc.laz")], ".laz") if copc else (path.stem, path.suffix)
    name = f"{stem}{suffix}{end}"
    for number in range(2, len(taken) + 3):
        if name.lower() not in taken:
            break
        name = f"{stem}{suffix}_{number}{end}"
    taken.add(name.lower())
    return name
