"""Wavefront OBJ with MTL: read one as a `Survey`.

The format: http://paulbourke.net/dataformats/obj/ (geometry) and .../mtl/ (materials). Lines,
points, curves and normals of the file are not used; normals are turned when it is rewritten.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, UnsafeReferenceError
from meshreg.io.assemble import (
    Found,
    RawGeometry,
    assemble_survey,
    eight_bit_colors,
    require_pages_near,
)
from meshreg.io.files.images import open_texture
from meshreg.io.files.safe import MissingReferenceError, resolve_reference
from meshreg.io.masks.polygons import Triangles, triangulate, usable_faces
from meshreg.io.obj import udim
from meshreg.io.obj.mtl import Material, read_mtl
from meshreg.io.obj.scan import Scan, line_of_face, scan
from meshreg.io.options import ReadOptions
from meshreg.records import Float32, Int32, Survey, Texture, UInt8

_MOST_NOTES = 20  # on materials and pages, of which there may be thousands


def read(path: Path, options: ReadOptions) -> Survey:
    """Read a Wavefront OBJ file with its materials and texture pages.

    Polygons are cut into triangles; vertices without faces are a point cloud. Where the material
    file or a texture page is missing the faces concerned have no texture, and a note says so.

    Parameters
    ----------
    path : Path
    options : ReadOptions
        With `geometry_only` no material is looked at.

    Returns
    -------
    Survey
        Of a `Mesh` or a `PointCloud`.

    Raises
    ------
    InputError
        With the file and the line: no text, a line that is cut off, a decimal comma, an index of
        0 or out of range, more than 1 % of the vertices not finite.
    UnsafeReferenceError
        A material file or texture page outside the file's folder.
    ResourceLimitError
        A line over 1 MiB, a texture page over `options.max_pixels`.
    """
    found = scan(path)
    if not len(found.points):
        raise InputError("holds no vertices.", file=path, remedy="Is it a Wavefront OBJ file?")
    notes = _notes(found)
    raw, companions = _geometry(path, found, options, notes)
    counts = {**found.counts, "triangles": 0 if raw.faces is None else len(raw.faces)}
    about = Found("obj", tuple(notes), companions, counts, sha256=found.sha256)
    del found  # what is left of it takes as much memory as the result
    return assemble_survey(path, raw, about, options)


def _geometry(
    path: Path, found: Scan, options: ReadOptions, notes: list[str]
) -> tuple[RawGeometry, tuple[Path, ...]]:
    """Return points, triangles and texture, and the files that were referred to."""
    colors = _colors(found, notes)
    _require_range(path, found, found.vertex, 0, len(found.points), "vertex")
    if not len(found.vertex):
        if len(found.uvs) or found.materials:
            notes.append("There are texture coordinates or materials, but no faces: cut off?")
        return RawGeometry(found.points, colors=colors), ()
    triangles = _triangles(path, found)
    notes += triangles.notes()
    faces = np.ascontiguousarray(triangles.pick_corners(found.vertex), np.int32)
    drape = _Drape(path, options)
    with ThreadPoolExecutor(1) as other:  # a second core finds the idle faces meanwhile
        usable = other.submit(usable_faces, found.points, faces)
        if not options.geometry_only:
            drape.open(found)
        uv, pages = drape.lay(found, triangles)
    notes += drape.notes[:_MOST_NOTES]
    if len(drape.notes) > _MOST_NOTES:
        notes.append(f"{len(drape.notes) - _MOST_NOTES} more notes on materials were left out.")
    textures = tuple(drape.textures)
    raw = RawGeometry(found.points, faces, colors, uv, pages, textures, usable.result())
    return raw, drape.companions


def _notes(found: Scan) -> list[str]:
    """Return what is left out of the file, one sentence each."""
    notes = []
    counts = found.counts
    if counts["elements"]:
        notes.append(f"{counts['elements']} lines and points (statements l and p) were left out.")
    if counts["others"]:
        notes.append(
            f"{counts['others']} lines are statements of other kinds (curves, surfaces, display) "
            "and were left out."
        )
    if counts["weighted"]:
        notes.append(f"The fourth number of {counts['weighted']} vertices was left out.")
    if not found.ends_whole:
        notes.append("The last line has no line end: if the file was cut off, the rest is missing.")
    return notes


def _colors(found: Scan, notes: list[str]) -> UInt8 | None:
    if found.colors is None:
        if found.counts["colored"]:
            notes.append(
                f"Only {found.counts['colored']} of {len(found.points)} vertices have a color; "
                "all vertex colors were left out."
            )
        return None
    values: Any = found.colors
    if np.isfinite(values).all() and values.max() > 1 and (values == np.rint(values)).all():
        values = values.astype(np.int64)
    colors, more = eight_bit_colors(values)
    notes += more
    return colors


def _require_range(
    path: Path, found: Scan, corners: Int32, lowest: int, count: int, what: str
) -> None:
    """Refuse corners that are not in lowest ... count - 1, naming the face and its line."""
    if not len(corners) or (corners.min() >= lowest and corners.max() < count):
        return
    first = int(np.argmax((corners < lowest) | (corners >= count)))
    if found.sizes is None:
        face = first // 3
    else:
        face = int(np.searchsorted(np.cumsum(found.sizes, dtype=np.int64), first, side="right"))
    named = f"{what} {corners[first] + 1}" if corners[first] >= 0 else f"a {what} before the first"
    remedy = "Export the file again"
    if what != "vertex":
        remedy += ", or read it as geometry only (--geometry-only), without texture"
    raise InputError(
        f"a face refers to {named}, but the file has {count}.",
        file=path,
        place=f"line {line_of_face(path, face)} (face {face + 1})",
        remedy=remedy + ".",
    )


def _triangles(path: Path, found: Scan) -> Triangles:
    if found.sizes is None:
        empty = {"empty": 0, "polygons": 0, "concave": 0, "bent": 0}
        return Triangles(None, len(found.vertex) // 3, empty)
    return triangulate(found.points, found.sizes, found.vertex, path)


@dataclass(frozen=True)
class Tiles:
    """Pages of a material by tile (u, v); `first` is its page among the textures, or -1."""

    pages: Mapping[tuple[int, int], Path]
    first: int


@dataclass
class _Drape:
    """Finds the texture pages of a file's materials and lays them on its faces."""

    path: Path
    options: ReadOptions
    textures: list[Texture] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    _companions: dict[Path, None] = field(default_factory=dict)
    _pages: dict[tuple[Path, bool], int] = field(default_factory=dict)
    _slots: dict[str, int] = field(default_factory=dict)  # material -> row of the two below
    _page: list[int] = field(default_factory=list)
    _tiles: list[Tiles | None] = field(default_factory=list)  # where a page has several
    _change: list[tuple[float, float, float, float]] = field(default_factory=list)

    @property
    def companions(self) -> tuple[Path, ...]:
        """Files that the OBJ and its MTL refer to, in the order of reference."""
        return tuple(self._companions)

    def open(self, found: Scan) -> None:
        """Read the material files, and the headers of all texture pages that faces use."""
        materials: dict[str, tuple[Material, Path]] = {}
        for name in found.libraries:
            for library in self._libraries(name):
                self._companions[library] = None
                for material in read_mtl(library).values():
                    materials.setdefault(material.name, (material, library))
        used = dict.fromkeys(name for _, name in found.materials)
        for material, library in materials.values():
            page = self._page_of(material, library, material.name in used)
            if material.name in used:
                self._slots[material.name] = len(self._page)
                self._page.append(page)
                self._tiles.append(self._tiles_of(material, library, page))
                self._change.append(material.change)
        unknown = [name for name in used if name not in materials]
        if unknown and found.libraries:
            self.notes.append(
                f"{_listed('Material', unknown)} not defined: faces of it have no texture."
            )
        elif not found.libraries and (unknown or len(found.uvs)):
            self.notes.append("The file names no material file (mtllib): there is no texture.")

    def _libraries(self, name: str) -> list[Path]:
        """Resolve an `mtllib` line: one name that may hold blanks, or several names."""
        folder = self.path.parent
        try:
            return [self._noted(resolve_reference(folder, name, root=folder), name)]
        except UnsafeReferenceError as error:
            error.file = str(self.path)
            raise
        except MissingReferenceError:
            found = []
            for word in name.split():
                try:
                    found.append(self._noted(resolve_reference(folder, word, root=folder), word))
                except MissingReferenceError as error:
                    self.notes.append(
                        f"The material file cannot be used ({error.message[:-1]}): the faces that "
                        "use its materials have NO TEXTURE, only their geometry."
                    )
            return found

    def _noted(self, path: Path, name: str) -> Path:
        if path.name != name.replace("\\", "/").rsplit("/", 1)[-1].strip():
            self.notes.append(f"The file {name!r} was found as {path.name!r}.")
        return path

    def _page_of(self, material: Material, library: Path, used: bool) -> int:
        """Return the number of a material's texture page, -1 for none that can be used."""
        for name in (*material.others, material.page or ""):
            if udim.has_token(name):  # copied whether a face needs them or not
                pages = udim.tile_pages(library.parent, name, self.path.parent)
                self._companions.update(dict.fromkeys(pages.values()))
                continue
            if name not in material.others:
                continue  # the page itself, of which below
            try:
                other = resolve_reference(library.parent, name, root=self.path.parent)
            except InputError:  # never opened, so not worth a word
                continue
            self._companions[other] = None
        if material.page is None or udim.has_token(material.page):
            return -1
        try:
            path = resolve_reference(library.parent, material.page, root=self.path.parent)
            self._companions[path] = None
            if not used:
                return -1
            self._noted(path, material.page)
            return self._opened(path, material.clamp)
        except UnsafeReferenceError as error:
            error.file, error.place = str(library), material.place
            raise
        except InputError as error:
            self.notes.append(
                f"Texture page {material.page!r} cannot be used ({error.message[:-1]}): the faces "
                "of its material have NO TEXTURE."
            )
            return -1

    def _opened(self, path: Path, clamp: bool) -> int:
        """Return the number of a texture page; its header is read the first time."""
        key = (path, clamp)
        if key not in self._pages:
            texture = open_texture(path, self.options.max_pixels, clamp, self.notes)
            self._pages[key] = len(self.textures)
            self.textures.append(texture)
        return self._pages[key]

    def _tiles_of(self, material: Material, library: Path, page: int) -> Tiles | None:
        """Find the pages of a material that has one for each tile of texture coordinates."""
        name = material.page
        if name is None or not (udim.has_token(name) or udim.first_tile(name)):
            return None
        pages = udim.tile_pages(library.parent, name, self.path.parent)
        if not udim.has_token(name) and len(pages) < 2:
            return None
        if not pages:
            self.notes.append(
                f"Texture page {name!r} cannot be used (no page of that pattern is there): the "
                "faces of its material have NO TEXTURE."
            )
        return Tiles(pages, page)

    def _lay_tiles(self, slot: Int32, uv: Float32, page: Int32) -> bool:
        """Give faces the page of their tile, and coordinates within it; in place.

        Returns
        -------
        bool
            Whether there were any such faces: some pages may be without a face then.
        """
        laid = False
        for number, tiles in enumerate(self._tiles):
            faces = np.flatnonzero(slot == number) if tiles is not None else ()
            if tiles is None or not len(faces):
                continue
            middle = uv[faces].mean(axis=1)
            finite = np.isfinite(middle).all(axis=1) & (np.abs(middle) < 1e6).all(axis=1)
            tile = np.floor(np.where(finite[:, None], middle, 0)).astype(np.int64)
            if tiles.first >= 0 and not tile.any():
                continue  # one page, whatever lies beside it
            laid = True
            self._companions.update(dict.fromkeys(tiles.pages.values()))
            bare: set[tuple[int, int]] = set()
            for u, v in np.unique(tile, axis=0).tolist():
                here = faces[(tile == (u, v)).all(axis=1)]
                found = self._page_of_tile(tiles, (u, v))
                page[here] = found
                uv[here] -= np.array([u, v], np.float32)
                if found < 0:
                    bare.add((u, v))
            if bare:
                shown = ", ".join(map(str, sorted(bare)[:5]))
                self.notes.append(
                    f"There is no texture page for {len(bare)} tiles of texture coordinates "
                    f"({shown}{', ...' if len(bare) > 5 else ''}): their faces have NO TEXTURE."
                )

        return laid

    def _page_of_tile(self, tiles: Tiles, tile: tuple[int, int]) -> int:
        path = tiles.pages.get(tile)
        if path is None:
            return -1
        try:
            return self._opened(path, True)
        except InputError as error:
            self.notes.append(
                f"Texture page {path.name!r} cannot be used ({error.message[:-1]}): the faces of "
                "its tile have NO TEXTURE."
            )
            return -1

    def lay(self, found: Scan, triangles: Triangles) -> tuple[Float32 | None, Int32 | None]:
        """Return uv (F, 3, 2) and page (F,) of all triangles; None where nothing has a page."""
        tiled = any(tiles is not None and tiles.pages for tiles in self._tiles)
        if not (self.textures or tiled) or found.uv is None:
            if self.textures or tiled:
                self.notes.append("No face has texture coordinates: there is no texture.")
                self.textures = []
            return None, None
        from meshreg.io.files.faces_kernels import place_uvs

        _require_range(self.path, found, found.uv, -1, len(found.uvs), "texture coordinate")
        n_faces = triangles.n_polygons
        require_pages_near(self.path, found.uvs)
        starts = [at for at, _ in found.materials]
        slots = [self._slots.get(name, -1) for _, name in found.materials]
        slots = [
            slot if slot >= 0 and (self._page[slot] >= 0 or self._tiles[slot] is not None) else -1
            for slot in slots
        ]
        runs = np.diff([0, *starts, n_faces])
        slot = triangles.pick_faces(np.repeat(np.array([-1, *slots], np.int32), runs))
        corners = np.ascontiguousarray(triangles.pick_corners(found.uv))
        uv = np.empty((len(corners), 3, 2), np.float32)
        without = place_uvs(found.uvs, corners, slot, np.array(self._change), uv)
        if without:
            self.notes.append(
                f"{without} faces of a textured material have no usable texture coordinates."
            )
        page = np.array([*self._page, -1], np.int32)[slot]
        if self._lay_tiles(slot, uv, page):
            used, numbers = np.unique(page, return_inverse=True)
            self.textures = [self.textures[number] for number in used if number >= 0]
            page = numbers.astype(np.int32) - np.int32(used[0] < 0)
            if not self.textures:
                return None, None
        return uv, page


def _listed(what: str, names: list[str]) -> str:
    shown = ", ".join(repr(name) for name in names[:5])
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"{what}s {shown}{more} are" if len(names) > 1 else f"{what} {shown} is"
