"""A survey as it was read: geometry about a local origin, and where it came from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from meshreg.errors import UsageError
from meshreg.records.arrays import NOTHING, Bool, Float32, Float64, Int32, UInt8, ends, frozen, put
from meshreg.records.grid import Grid


@dataclass(frozen=True, eq=False)
class Frame:
    """How one file's coordinates become absolute ones: ``absolute = axes @ file + shift``.

    Attributes
    ----------
    axes : (3, 3) float64
        Signed permutation of the axes times the unit's length in metres (`enu` in metres is the
        identity; north, east, down is ``[[0, 1, 0], [1, 0, 0], [0, 0, -1]]``). For a COLMAP model
        any rotation times its scale; for maps the height's unit alone.
    shift : (3,) float64
        East, north, up [m, in `file_crs`], added after the axes.
    file_crs : str or None
        The CRS that ``axes @ file + shift`` is in ("EPSG:32754" or WKT), if known.
    crs : str or None
        The metric CRS of absolute coordinates. Where it differs from `file_crs`, points pass
        through PROJ after the shift (`meshreg.io.frames.place`).
    local : str or None
        WKT of a local (engineering) CRS that the file states. It says nothing about the place on
        Earth and is used for nothing but to be written again.
    """

    axes: Float64 = field(default_factory=lambda: np.eye(3))
    shift: Float64 = field(default_factory=lambda: np.zeros(3))
    file_crs: str | None = None
    crs: str | None = None
    local: str | None = None

    def __post_init__(self) -> None:
        put(self, "axes", frozen(self.axes, np.float64, (3, 3), "Frame.axes"))
        put(self, "shift", frozen(self.shift, np.float64, (3,), "Frame.shift"))

    @property
    def is_linear(self) -> bool:
        """Whether no change of CRS is involved."""
        return self.file_crs == self.crs


@dataclass(frozen=True)
class SourceFile:
    """One file that a survey came from, as `meshreg.io` needs it to rewrite it.

    `companions` are the files it refers to (MTL, texture pages), in the order of reference;
    `fingerprint` is (size in bytes, mtime in ns) when it was read. `copies` names the copies of
    those companions that cannot keep their names beside the moved file (`meshreg.io.files.naming`).
    """

    path: Path
    format: str
    frame: Frame = field(default_factory=Frame)
    companions: tuple[Path, ...] = ()
    sidecar: Path | None = None
    sha256: str = ""
    fingerprint: tuple[int, int] = (0, 0)
    counts: Mapping[str, int] = field(default_factory=lambda: NOTHING)
    copies: Mapping[Path, str] = field(default_factory=lambda: NOTHING)


@dataclass(frozen=True, eq=False)
class Texture:
    """One texture page, decoded when asked.

    Attributes
    ----------
    name : str
        File name, for messages.
    size : (width, height)
        From the image's header; nothing is decoded to know it.
    load : callable
        Returns (height, width, 3) or (height, width, 4) uint8, row 0 at the top; in the fourth
        channel values under 128 mean "no color here".
    clamp : bool
        Texture coordinates outside 0-1 take the edge's color (else they wrap).
    """

    name: str
    size: tuple[int, int]
    load: Callable[[], UInt8]
    clamp: bool = False


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with color per vertex, texture pages, both or none.

    Attributes
    ----------
    vertices : (V, 3) float64
        East, north, up from the survey's origin [m].
    faces : (F, 3) int32
    colors : (V, 3) uint8 or None
    uv : (F, 3, 2) float32 or None
        Texture coordinates of each corner, u to the right, v upward, (0, 0) the page's lower left.
    face_texture : (F,) int32 or None
        Index into `textures`, -1 where a face has none. Present exactly when `uv` is.
    textures : tuple of Texture
    """

    vertices: Float64
    faces: Int32
    colors: UInt8 | None = None
    uv: Float32 | None = None
    face_texture: Int32 | None = None
    textures: tuple[Texture, ...] = ()

    def __post_init__(self) -> None:
        put(self, "vertices", frozen(self.vertices, np.float64, (None, 3), "Mesh.vertices"))
        put(self, "faces", frozen(self.faces, np.int32, (None, 3), "Mesh.faces"))
        n_vertices, n_faces = len(self.vertices), len(self.faces)
        if n_faces and not (self.faces.min() >= 0 and self.faces.max() < n_vertices):
            raise UsageError(
                f"Mesh.faces refers to vertices {self.faces.min()} to {self.faces.max()} "
                f"of a mesh of {n_vertices}."
            )
        if self.colors is not None:
            put(self, "colors", frozen(self.colors, np.uint8, (n_vertices, 3), "Mesh.colors"))
        if (self.uv is None) != (self.face_texture is None):
            raise UsageError("Mesh.uv and Mesh.face_texture go together; one of them is None.")
        if self.uv is not None:
            put(self, "uv", frozen(self.uv, np.float32, (n_faces, 3, 2), "Mesh.uv"))
            pages = frozen(self.face_texture, np.int32, (n_faces,), "Mesh.face_texture")
            if n_faces and not (pages.min() >= -1 and pages.max() < len(self.textures)):
                raise UsageError(
                    f"Mesh.face_texture spans {pages.min()} to {pages.max()}, "
                    f"but there are {len(self.textures)} texture pages."
                )
            put(self, "face_texture", pages)

    @property
    def points(self) -> Float64:
        """The vertices, under the name that a point cloud uses."""
        return self.vertices


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points (N, 3) float64 from the survey's origin [m], with colors (N, 3) uint8 or None."""

    points: Float64
    colors: UInt8 | None = None

    def __post_init__(self) -> None:
        put(self, "points", frozen(self.points, np.float64, (None, 3), "PointCloud.points"))
        if self.colors is not None:
            shape = (len(self.points), 3)
            put(self, "colors", frozen(self.colors, np.uint8, shape, "PointCloud.colors"))


@dataclass(frozen=True, eq=False)
class Maps:
    """A ready DEM with its orthomosaic, each on its own north-up grid.

    Attributes
    ----------
    height : (H, W) float32
        Metres up, absolute, NaN where there is none.
    height_grid : Grid
    color : (h, w, 3) uint8 or None
    color_valid : (h, w) bool or None
    color_grid : Grid or None
    """

    height: Float32
    height_grid: Grid
    color: UInt8 | None = None
    color_valid: Bool | None = None
    color_grid: Grid | None = None

    def __post_init__(self) -> None:
        rows, cols = self.height_grid.shape
        put(self, "height", frozen(self.height, np.float32, (rows, cols), "Maps.height"))
        parts = (self.color, self.color_valid, self.color_grid)
        if any(part is None for part in parts):
            if not all(part is None for part in parts):
                raise UsageError("Maps.color, color_valid and color_grid go together.")
        else:
            assert self.color_grid is not None
            rows, cols = self.color_grid.shape
            put(self, "color", frozen(self.color, np.uint8, (rows, cols, 3), "Maps.color"))
            valid = frozen(self.color_valid, np.bool_, (rows, cols), "Maps.color_valid")
            put(self, "color_valid", valid)


@dataclass(frozen=True, eq=False)
class Survey:
    """One survey of a piece of seafloor, in metres, x east, y north, z up.

    Attributes
    ----------
    name : str
    geometry : Mesh, PointCloud or Maps
    origin : (3,) float64
        Absolute coordinates [m] of the geometry's (0, 0, 0). `Maps` are absolute already in their
        grids; their origin is zero.
    crs : str or None
        CRS of absolute coordinates; None is a local frame.
    date : str or None
        ISO 8601, if known.
    scale_known : bool
        False for a COLMAP model without positions: its unit is arbitrary.
    source : tuple of SourceFile
        The files it came from; empty for a survey made in memory.
    notes : tuple of str
        What was dropped, repaired or guessed while reading, one plain sentence each.
    """

    name: str
    geometry: Mesh | PointCloud | Maps
    origin: Float64 = field(default_factory=lambda: np.zeros(3))
    crs: str | None = None
    date: str | None = None
    scale_known: bool = True
    source: tuple[SourceFile, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        put(self, "origin", frozen(self.origin, np.float64, (3,), "Survey.origin"))

    @property
    def checksums(self) -> frozenset[str]:
        """SHA-256 of the files it came from; empty where that of one of them is not known."""
        sums = frozenset(source.sha256 for source in self.source)
        return frozenset() if "" in sums else sums

    @cached_property
    def bounds(self) -> Float64:
        """(2, 3) float64: lowest and highest absolute east, north, up [m]."""
        bounds = self._bounds()
        bounds.flags.writeable = False
        return bounds

    def _bounds(self) -> Float64:
        if isinstance(self.geometry, Maps):
            west, south, east, north = self.geometry.height_grid.bounds
            height = self.geometry.height
            low, high = float(np.nanmin(height)), float(np.nanmax(height))
            return np.array([[west, south, low], [east, north, high]])
        points = self.geometry.points
        if isinstance(self.geometry, Mesh) and len(self.geometry.faces):
            used = np.zeros(len(points), bool)
            used[self.geometry.faces.ravel()] = True
            points = points if used.all() else points[used]
        return np.asarray(ends(points) + self.origin)

    @property
    def centre(self) -> Float64:
        """(3,) float64: centre of `bounds`, absolute [m]."""
        return np.asarray(self.bounds.mean(axis=0))
