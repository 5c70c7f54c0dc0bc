"""Find the files that a survey's path stands for, and know their format by suffix and content."""

from __future__ import annotations

import glob
import os
import re
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from meshreg.errors import InputError, UsageError
from meshreg.io.files.safe import open_regular, require_inside
from meshreg.io.formats import MAGIC, READERS
from meshreg.io.frames.sidecar import is_sidecar

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
_TILED, _TILESET = (".b3dm", ".i3dm", ".pnts", ".cmpt", ".3tz"), "tileset.json"  # 3D Tiles
_UNTILED = "Export the model as .obj or .glb, or the cloud as .las or .ply, and give that."
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


_BELOW = 2  # levels of folders that tiles are looked for in
_DEEPEST = 5  # levels looked through to say where the files are
_MOST_FOLDERS = 10_000


@dataclass(frozen=True)
class Block:
    """One file, pair of maps or model folder, and the reader's entry for it.

    `maps` are the two files of a pair; `below` says that it was found in a folder of the folder
    that was named; `note` is what is to be said of the choice.
    """

    path: Path
    reader: str
    maps: tuple[Path, ...] = ()
    below: bool = False
    note: str = ""


def find_blocks(path: str | Path | Sequence[str | Path]) -> tuple[Block, ...]:
    """Return the files that one survey's path stands for, each with its reader.

    What exists under the name as written wins over what commas and glob characters would mean.

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
    text = _as_on_disk(str(path))
    if os.path.lexists(text):
        here = Path(text)
        return _folder_blocks(here) if here.is_dir() else (_file_block(here),)
    if maps := split_maps(text):
        for part in maps:
            _file_block(part)
        return (Block(Path(text), READERS[".tif"], maps),)
    if glob.has_magic(text):
        found = [Path(item) for item in sorted(glob.glob(_pattern(text), recursive=True))]
        files = [item for item in found if _is_survey(item)]
        if not files:
            raise InputError(
                f"fits no survey file ({len(found)} files fit at all).",
                file=text,
                remedy="Check the pattern, and quote it.",
            )
        return _one_format(files, Path(text))
    raise InputError("does not exist.", file=text, remedy="Check the path.")


def _as_on_disk(text: str) -> str:
    """Return a path in the Unicode normal form in which it exists, else as it is."""
    forms = (text, unicodedata.normalize("NFC", text), unicodedata.normalize("NFD", text))
    return next((form for form in forms if os.path.lexists(form)), text)


def _pattern(text: str) -> str:
    """Return a glob whose leading folders, where they exist as written, are taken literally."""
    parts = Path(text).parts
    for number in range(len(parts) - 1, 0, -1):
        if (base := Path(*parts[:number])).is_dir():
            return os.path.join(glob.escape(str(base)), *parts[number:])
    return text


def split_pair(text: str) -> tuple[Path, ...]:
    """Split "one,two" where both parts exist, folders with commas in their names included.

    Where no such place is found the text is split at every comma.
    """
    places = [at for at, letter in enumerate(text) if letter == ","]
    for at in places:
        pair = Path(text[:at].strip()), Path(text[at + 1 :].strip())
        if all(os.path.lexists(part) for part in pair):
            return pair
    return tuple(Path(part.strip()) for part in text.split(","))


def split_maps(text: str) -> tuple[Path, ...]:
    """Return the two GeoTIFFs of "dem.tif,ortho.tif"; () for what is no such pair.

    Raises
    ------
    UsageError
        More than two.
    """
    pair = split_pair(text)
    if len(pair) != 2 or not all(_is_tiff(part) for part in pair):
        # not there: a comma ends a map only behind its suffix
        pair = tuple(Path(part.strip()) for part in re.split(r"(?i)(?<=\.tif|tiff)\s*,", text))
    if len(pair) < 2 or not all(_is_tiff(part) for part in pair):
        return ()
    if len(pair) > 2:
        raise UsageError(
            f"{len(pair)} maps were given; a survey has two.",
            remedy='Give both as "dem.tif,ortho.tif".',
        )
    return pair


def _is_tiff(path: Path) -> bool:
    return path.suffix.lower() in (".tif", ".tiff")


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
    known = [(name, suffixes) for magic, name, suffixes in MAGIC if _starts(head, magic)]
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
    if suffix in _TILED or path.name.lower() == _TILESET:
        raise InputError("is a part of 3D Tiles, which are not read.", file=path, remedy=_UNTILED)
    if not suffix or suffix not in READERS:
        raise InputError(
            f"has a suffix {path.suffix!r} that is not known.",
            file=path,
            remedy=f"Surveys are read as {', '.join(key for key in READERS if key)}.",
        )
    wanted = [name for _, name, suffixes in MAGIC if suffix in suffixes]
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
    for number, rank in enumerate(_FOLDER_RANKS):
        if fits := _of_rank(files, rank):
            blocks = _one_format(_inside(fits, folder), folder)
            # tables and notes in .csv and .txt are too common beside a survey to be worth a word
            others = _of_rank(
                files, ((".tif", ".tiff"), (".xyz",), (".pts",)) if number < 1 else ()
            )
            note = (
                f"{_listed(others)} beside it {'is' if len(others) == 1 else 'are'} not part of "
                f"the survey, which was read from {_listed(fits)}."
            )
            return (replace(blocks[0], note=note if others else ""), *blocks[1:])
    if tiles := _tiles_below(folder):
        return tuple(
            replace(block, below=True) for block in _one_format(_inside(tiles, folder), folder)
        )
    if (folder / _TILESET).is_file():
        raise InputError("holds 3D Tiles, which are not read.", file=folder, remedy=_UNTILED)
    raise InputError(
        "is a folder without a survey file in it.",
        file=folder,
        remedy=_deeper(folder)
        or f"Surveys are read as {', '.join(key for key in READERS if key)}.",
    )


def _inside(files: list[Path], folder: Path) -> list[Path]:
    for path in files:
        require_inside(path, folder)
    return files


def _of_rank(files: Sequence[Path], rank: Sequence[tuple[str, ...]]) -> list[Path]:
    return [entry for entry in files if any(entry.suffix.lower() in group for group in rank)]


def _listed(files: Sequence[Path]) -> str:
    more = f" and {len(files) - 3} more" if len(files) > 3 else ""
    return ", ".join(path.name for path in files[:3]) + more


def _levels(folder: Path, deepest: int) -> Iterator[list[Path]]:
    """Give the files below a folder level by level, links left out; the search has its bound."""
    level = [folder]
    for _ in range(deepest):
        entries = [entry for place in level for entry in sorted(place.iterdir())]
        plain = [entry for entry in entries if not entry.name.startswith(".")]
        level = [entry for entry in plain if entry.is_dir() and not entry.is_symlink()]
        if not level or len(level) > _MOST_FOLDERS:
            return
        yield [file for place in level for file in sorted(place.iterdir()) if _is_survey(file)]


def _tiles_below(folder: Path) -> list[Path]:
    """Return the files of the first level below that holds any, as Data/Tile_1/Tile_1.obj."""
    for files in _levels(folder, _BELOW):
        for rank in _FOLDER_RANKS[:2]:  # text in a folder of a folder may be anything
            if fits := _of_rank(files, rank):
                return fits
    return []


def _deeper(folder: Path) -> str:
    """Return a remedy that names the pattern of survey files further down; "" for none."""
    try:
        for files in _levels(folder, _DEEPEST):
            if found := _of_rank(files, _FOLDER_RANKS[0]):
                group = next(g for g in _FOLDER_RANKS[0] if found[0].suffix.lower() in g)
                same = [path for path in found if path.suffix.lower() in group]
                rows = zip(*(path.relative_to(folder).parts[:-1] for path in same), strict=True)
                places = [row[0] if len(set(row)) == 1 else "*" for row in rows]
                pattern = Path(folder, *places, "*" + same[0].suffix)
                return f'There are some further down: give "{pattern}" (quoted).'
    except OSError:
        pass
    return ""


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
            return (Block(Path(pair), READERS[".tif"], tuple(files)),)
        raise InputError(
            f"holds {len(files)} GeoTIFFs.", file=where, remedy='Give two as "dem.tif,ortho.tif".'
        )
    return blocks
