"""The records that flow through meshreg. Metres and radians; x east, y north, z up.

Rasters are (row, col) with row 0 in the north. Arrays in a record are read-only. "Absolute"
coordinates are those after a file's axes, unit and shift have been applied; geometry is kept as
float64 relative to a survey's `origin`, because float32 at UTM size steps by half a metre.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import UsageError

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]
Status = Literal["ok", "weak", "failed"]
Verdict = Literal["accepted", "review", "rejected"]
# of places (N, 2): how far the ground there must go [m], (N, 2)
OffsetAt = Callable[[Float64], Float64]

_NOTHING: Mapping[Any, Any] = MappingProxyType({})


def _frozen(array: Any, dtype: Any, shape: tuple[int | None, ...], name: str) -> Any:
    """Return `array` as a read-only view of the stated type, or say which shape was expected."""
    array = np.ascontiguousarray(array, dtype=dtype)
    fits = array.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        want = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
        raise UsageError(f"{name} has shape {array.shape}; expected {want}.")
    array = array.view()
    array.flags.writeable = False
    return array


def ends(points: Float64) -> Float64:
    """(2, 3) float64: lowest and highest coordinates; by columns, which is ten times as fast."""
    columns = points.T
    return np.array([[c.min() for c in columns], [c.max() for c in columns]])


def _put(record: Any, name: str, value: Any) -> None:
    object.__setattr__(record, name, value)


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
        through PROJ after the shift (`meshreg.io.frames`).
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
        _put(self, "axes", _frozen(self.axes, np.float64, (3, 3), "Frame.axes"))
        _put(self, "shift", _frozen(self.shift, np.float64, (3,), "Frame.shift"))

    @property
    def is_linear(self) -> bool:
        """Whether no change of CRS is involved."""
        return self.file_crs == self.crs


@dataclass(frozen=True)
class SourceFile:
    """One file that a survey came from, as `meshreg.io` needs it to rewrite it.

    `companions` are the files it refers to (MTL, texture pages), in the order of reference;
    `fingerprint` is (size in bytes, mtime in ns) when it was read. `copies` names the copies of
    those companions that cannot keep their names beside the moved file (`meshreg.io.naming`).
    """

    path: Path
    format: str
    frame: Frame = field(default_factory=Frame)
    companions: tuple[Path, ...] = ()
    sidecar: Path | None = None
    sha256: str = ""
    fingerprint: tuple[int, int] = (0, 0)
    counts: Mapping[str, int] = field(default_factory=lambda: _NOTHING)
    copies: Mapping[Path, str] = field(default_factory=lambda: _NOTHING)


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
        channel values under 128 mean "no colour here".
    clamp : bool
        Texture coordinates outside 0-1 take the edge's colour (else they wrap).
    """

    name: str
    size: tuple[int, int]
    load: Callable[[], UInt8]
    clamp: bool = False


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with colour per vertex, texture pages, both or none.

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
        _put(self, "vertices", _frozen(self.vertices, np.float64, (None, 3), "Mesh.vertices"))
        _put(self, "faces", _frozen(self.faces, np.int32, (None, 3), "Mesh.faces"))
        n_vertices, n_faces = len(self.vertices), len(self.faces)
        if n_faces and not (self.faces.min() >= 0 and self.faces.max() < n_vertices):
            raise UsageError(
                f"Mesh.faces refers to vertices {self.faces.min()} to {self.faces.max()} "
                f"of a mesh of {n_vertices}."
            )
        if self.colors is not None:
            _put(self, "colors", _frozen(self.colors, np.uint8, (n_vertices, 3), "Mesh.colors"))
        if (self.uv is None) != (self.face_texture is None):
            raise UsageError("Mesh.uv and Mesh.face_texture go together; one of them is None.")
        if self.uv is not None:
            _put(self, "uv", _frozen(self.uv, np.float32, (n_faces, 3, 2), "Mesh.uv"))
            pages = _frozen(self.face_texture, np.int32, (n_faces,), "Mesh.face_texture")
            if n_faces and not (pages.min() >= -1 and pages.max() < len(self.textures)):
                raise UsageError(
                    f"Mesh.face_texture spans {pages.min()} to {pages.max()}, "
                    f"but there are {len(self.textures)} texture pages."
                )
            _put(self, "face_texture", pages)

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
        _put(self, "points", _frozen(self.points, np.float64, (None, 3), "PointCloud.points"))
        if self.colors is not None:
            shape = (len(self.points), 3)
            _put(self, "colors", _frozen(self.colors, np.uint8, shape, "PointCloud.colors"))


@dataclass(frozen=True)
class Grid:
    """A north-up raster lattice. This class is the only place where the half cell is written.

    Attributes
    ----------
    west, north : float
        Outer north-west corner (of the cell, not its centre), absolute [m].
    cell : float
        Side of a cell [m].
    shape : (rows, cols)
    crs : str or None
    """

    west: float
    north: float
    cell: float
    shape: tuple[int, int]
    crs: str | None = None

    def __post_init__(self) -> None:
        if not (self.cell > 0 and np.isfinite([self.west, self.north, self.cell]).all()):
            raise UsageError(
                f"Grid needs finite corners and a positive cell; got west {self.west}, "
                f"north {self.north}, cell {self.cell}."
            )
        rows, cols = self.shape
        if rows < 1 or cols < 1:
            raise UsageError(f"Grid.shape is {self.shape}; it needs at least one row and column.")
        _put(self, "shape", (int(rows), int(cols)))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Outer edges: west, south, east, north [m]."""
        rows, cols = self.shape
        return (
            self.west,
            self.north - rows * self.cell,
            self.west + cols * self.cell,
            self.north,
        )

    def row_col(self, east: Any, north: Any) -> tuple[Float64, Float64]:
        """Fractional row and column of absolute points; whole numbers are cell centres."""
        row = (self.north - np.asarray(north, float)) / self.cell - 0.5
        col = (np.asarray(east, float) - self.west) / self.cell - 0.5
        return row, col

    def east_north(self, row: Any, col: Any) -> tuple[Float64, Float64]:
        """Absolute coordinates [m] of fractional rows and columns (inverse of `row_col`)."""
        east = self.west + (np.asarray(col, float) + 0.5) * self.cell
        north = self.north - (np.asarray(row, float) + 0.5) * self.cell
        return east, north

    def divided(self, times: int) -> Grid:
        """Return the same extent in cells `times` smaller."""
        rows, cols = self.shape
        return replace(self, cell=self.cell / times, shape=(rows * times, cols * times))


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
        _put(self, "height", _frozen(self.height, np.float32, (rows, cols), "Maps.height"))
        parts = (self.color, self.color_valid, self.color_grid)
        if any(part is None for part in parts):
            if not all(part is None for part in parts):
                raise UsageError("Maps.color, color_valid and color_grid go together.")
        else:
            assert self.color_grid is not None
            rows, cols = self.color_grid.shape
            _put(self, "color", _frozen(self.color, np.uint8, (rows, cols, 3), "Maps.color"))
            valid = _frozen(self.color_valid, np.bool_, (rows, cols), "Maps.color_valid")
            _put(self, "color_valid", valid)


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
        _put(self, "origin", _frozen(self.origin, np.float64, (3,), "Survey.origin"))

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


@dataclass(frozen=True, eq=False)
class SurveyRaster:
    """A survey seen from above on a grid: area means per cell.

    Attributes
    ----------
    grid : Grid
    height : (H, W) float32
        Metres up, absolute minus `datum`, NaN where there is no surface.
    color : (H, W, 3) uint8
        Zero where `color_valid` is False.
    valid : (H, W) bool
        Where `height` is a number.
    color_valid : (H, W) bool
        Where `color` was seen.
    samples : (H, W) uint16
        Fine samples (mesh) or points (cloud) behind each height.
    datum : float
        Metres to add to `height` for absolute heights, so that float32 keeps its millimetres.
    masked : mapping
        Counts of what was left out: "floaters", "flat colour", "mask", ...
    """

    grid: Grid
    height: Float32
    color: UInt8
    valid: Bool
    color_valid: Bool
    samples: NDArray[np.uint16]
    datum: float = 0.0
    masked: Mapping[str, int] = field(default_factory=lambda: _NOTHING)

    def __post_init__(self) -> None:
        shape = self.grid.shape
        _put(self, "height", _frozen(self.height, np.float32, shape, "SurveyRaster.height"))
        _put(self, "color", _frozen(self.color, np.uint8, (*shape, 3), "SurveyRaster.color"))
        _put(self, "valid", _frozen(self.valid, np.bool_, shape, "SurveyRaster.valid"))
        seen = _frozen(self.color_valid, np.bool_, shape, "SurveyRaster.color_valid")
        _put(self, "color_valid", seen)
        _put(self, "samples", _frozen(self.samples, np.uint16, shape, "SurveyRaster.samples"))


@dataclass(frozen=True, eq=False)
class Transform:
    """Similarity ``reference = pivot + offset + scale * rotation @ (moving - pivot)``.

    Attributes
    ----------
    rotation : (3, 3) float64
        Proper rotation.
    scale : float
    offset : (3,) float64
        East, north, up [m] by which the pivot moves.
    pivot : (3,) float64
        Absolute point [m] about which rotation and scale act.
    """

    rotation: Float64 = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    offset: Float64 = field(default_factory=lambda: np.zeros(3))
    pivot: Float64 = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        _put(self, "rotation", _frozen(self.rotation, np.float64, (3, 3), "Transform.rotation"))
        _put(self, "offset", _frozen(self.offset, np.float64, (3,), "Transform.offset"))
        _put(self, "pivot", _frozen(self.pivot, np.float64, (3,), "Transform.pivot"))
        error = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        if not (error < 1e-6 and np.linalg.det(self.rotation) > 0):
            raise UsageError(
                f"Transform.rotation is not a proper rotation (|R R' - 1| up to {error:.3g}, "
                f"determinant {np.linalg.det(self.rotation):.6g})."
            )
        if not self.scale > 0:
            raise UsageError(f"Transform.scale is {self.scale}; it must be positive.")

    @property
    def linear(self) -> Float64:
        """(3, 3) float64: scale times rotation."""
        return self.scale * self.rotation

    @property
    def matrix(self) -> Float64:
        """(4, 4) float64 acting on absolute column vectors."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.linear
        matrix[:3, 3] = self.pivot + self.offset - self.linear @ self.pivot
        return matrix

    @classmethod
    def from_matrix(cls, matrix: Any, pivot: Any = (0.0, 0.0, 0.0)) -> Transform:
        """Read a 4×4 similarity; its `offset` is stated at `pivot`."""
        matrix = np.asarray(matrix, float)
        if matrix.shape != (4, 4) or not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise UsageError(f"Expected a 4×4 matrix ending in 0 0 0 1; got {matrix.tolist()}.")
        pivot = np.asarray(pivot, float)
        determinant = np.linalg.det(matrix[:3, :3])
        if not determinant > 0:
            raise UsageError(f"The matrix mirrors or flattens (determinant {determinant:.6g}).")
        scale = float(np.cbrt(determinant))
        offset = matrix[:3, :3] @ pivot + matrix[:3, 3] - pivot
        return cls(matrix[:3, :3] / scale, scale, offset, pivot)

    def apply(self, points: Any) -> Float64:
        """Move absolute points (..., 3) [m]."""
        points = np.asarray(points, float)
        return np.asarray((points - self.pivot) @ self.linear.T + (self.pivot + self.offset))

    def inverse(self) -> Transform:
        """Return the transform that takes reference back to moving."""
        rotation, scale = self.rotation.T, 1.0 / self.scale
        return Transform(rotation, scale, -self.offset, self.pivot + self.offset)

    def at(self, pivot: Any) -> Transform:
        """Return the same transform with its `offset` stated at another pivot."""
        pivot = np.asarray(pivot, float)
        return Transform(self.rotation, self.scale, self.apply(pivot) - pivot, pivot)

    def __matmul__(self, first: Transform) -> Transform:
        """Chain two transforms: ``(a @ b).apply(x) == a.apply(b.apply(x))``."""
        middle = first.pivot + first.offset
        offset = first.offset + self.apply(middle) - middle
        return Transform(
            self.rotation @ first.rotation, self.scale * first.scale, offset, first.pivot
        )


def cubic_weights(fraction: Any, derivative: bool = False) -> Float64:
    """(..., 4) weights of the four uniform cubic B-splines over an interval, at 0-1 within it.

    With `derivative` their slopes per interval. De Boor, A Practical Guide to Splines, chapter X.
    """
    t = np.asarray(fraction, float)
    u = 1.0 - t
    if derivative:
        parts = (-3 * u**2, 9 * t**2 - 12 * t, -9 * t**2 + 6 * t + 3, 3 * t**2)
    else:
        parts = (u**3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    return np.stack(parts, axis=-1) / 6.0


@dataclass(frozen=True, eq=False)
class Warp:
    """A smooth bend that follows the rigid transform: ``reference = p + d(p)``, ``p = T(moving)``.

    The displacement d depends on east and north alone. Every model is kept in one form, bicubic
    B-splines on a box (a polynomial of degree 3 or less is one interval of it). Outside the box d
    is held at the value of the nearest place on its edge.

    Attributes
    ----------
    horizontal, vertical : str
        Names of the models: "rigid", "similarity", "dome", "quadratic" or "spline".
    low, high : (2,) float64
        South-west and north-east corner of the box, east and north [m], absolute in the reference.
    coefficients : (R, C, 3) float64
        East, north, up [m]; R - 3 equal intervals from south to north, C - 3 from west to east.
    """

    horizontal: str
    vertical: str
    low: Float64
    high: Float64
    coefficients: Float64

    def __post_init__(self) -> None:
        _put(self, "low", _frozen(self.low, np.float64, (2,), "Warp.low"))
        _put(self, "high", _frozen(self.high, np.float64, (2,), "Warp.high"))
        table = _frozen(self.coefficients, np.float64, (None, None, 3), "Warp.coefficients")
        _put(self, "coefficients", table)
        if min(table.shape[:2]) < 4 or not np.isfinite(table).all():
            raise UsageError(
                f"Warp.coefficients of shape {table.shape} must be finite, and at least (4, 4, 3)."
            )
        if not (self.high > self.low).all():
            raise UsageError(f"Warp's box from {self.low} to {self.high} is empty.")

    def displacement(self, points: Any) -> Float64:
        """East, north, up (N, 3) [m] by which points (N, 2 or 3) after the transform move."""
        points = np.asarray(points, float)
        moved = np.empty((len(points), 3))
        for start in range(0, len(points), 1 << 16):  # a block's weights stay in the cache
            part = slice(start, start + (1 << 16))
            moved[part] = self._sum(points[part], (False, False))
        return moved

    def gradient(self, points: Any) -> Float64:
        """(N, 3, 2): slopes of the displacement along east and north, inside the box."""
        points = np.asarray(points, float)
        slopes = [self._sum(points, (along == 1, along == 0)) for along in (0, 1)]
        return np.asarray(np.stack(slopes, axis=-1) / self._steps)

    def apply(self, points: Any) -> Float64:
        """Bend absolute points (N, 3) [m] that the transform has moved."""
        points = np.asarray(points, float)
        return np.asarray(points + self.displacement(points))

    def inverse(self, points: Any) -> Float64:
        """Undo `apply`, by fixed-point iteration: ``p = q - d(p)``, as d is a contraction.

        Raises
        ------
        UsageError
            If it does not settle, because the warp folds the ground.
        """
        points = np.asarray(points, float)
        found = points
        tolerance = 1e-11 + 4 * float(np.spacing(np.abs(points).max(initial=1.0)))
        for _ in range(100):
            before, found = found, points - self.displacement(found)
            if np.abs(found - before).max(initial=0.0) <= tolerance:
                return np.asarray(found)
        raise UsageError("The warp cannot be inverted: it folds the ground.")

    @property
    def _steps(self) -> Float64:
        """Length of an interval along east and north [m]."""
        rows, cols = self.coefficients.shape[:2]
        return np.asarray((self.high - self.low) / [cols - 3, rows - 3])

    def _sum(self, points: Float64, slope: tuple[bool, bool]) -> Float64:
        """Sum the splines; `slope` asks for the derivative along north, east (per interval)."""
        place = (np.clip(points[:, :2], self.low, self.high) - self.low) / self._steps
        rows, cols = self.coefficients.shape[:2]
        first = np.minimum(np.nan_to_num(place).astype(int), [cols - 4, rows - 4])
        along_east = cubic_weights(place[:, 0] - first[:, 0], slope[1])
        along_north = cubic_weights(place[:, 1] - first[:, 1], slope[0])
        total = np.zeros((len(points), 3))
        for i in range(4):
            for j in range(4):
                weight = along_north[:, i] * along_east[:, j]
                total += weight[:, None] * self.coefficients[first[:, 1] + i, first[:, 0] + j]
        return total


@dataclass(frozen=True, eq=False)
class OffsetEstimate:
    """One method's answer: how far the moving survey must go east and north.

    Attributes
    ----------
    method : str
        Key in `meshreg.offsets.ESTIMATORS`.
    status : "ok", "weak" or "failed"
    reason : str
        Why not ok; empty when ok.
    east, north : float
        Offset [m] to ADD to moving coordinates to lay them on the reference; NaN when failed.
    sigma : (2, 2) float64 or None
        Mean square error of (east, north) [m²], given that it is the right peak
        (`meshreg.offsets.error_bars`).
    score : float
        The method's own measure at its best offset.
    gap : float
        How far the best peak stands above the second, in robust deviations of the surface.
    overlap : float
        Share of the smaller survey's cells that overlap at the offset.
    seconds : float
    evidence : mapping
        Arrays for the report: the score surface, matches, and so on.
    manual : bool
        Whether a person found it (`meshreg.ties`), not a method.
    """

    method: str
    status: Status
    reason: str = ""
    east: float = float("nan")
    north: float = float("nan")
    sigma: Float64 | None = None
    score: float = float("nan")
    gap: float = float("nan")
    overlap: float = 0.0
    seconds: float = 0.0
    evidence: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)
    manual: bool = False

    def __post_init__(self) -> None:
        if self.sigma is not None:
            _put(self, "sigma", _frozen(self.sigma, np.float64, (2, 2), "OffsetEstimate.sigma"))


@dataclass(frozen=True)
class Layer:
    """A second surface in a survey.

    Attributes
    ----------
    cells : float
        Share of the cells that hold a second surface.
    common : float
        Share of the cells whose second surface lies at the one offset that most share.
    where_seen : float
        The same, of the cells where a copy at that offset would stand off the first surface.
    offset : (east, north, up)
        That offset [m].
    """

    cells: float
    common: float = 0.0
    where_seen: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Finding:
    """One thing that speaks against accepting a pair: a short code and a sentence for people."""

    code: str
    said: str


@dataclass(frozen=True, eq=False)
class Registration:
    """What was decided about a pair of surveys, with everything needed to check it.

    Attributes
    ----------
    verdict : "accepted", "review" or "rejected"
    reason : str
    transform : Transform or None
        `reference_from_moving` in absolute coordinates, pivot at the centre of the moving
        survey's bounding box; None when rejected, the best hypothesis when in review.
    covariance : (7, 7) float64 or None
        Of (east, north, up [m], tilt_east, tilt_north, yaw [rad], scale [-]) at the transform's
        pivot; the angles are right-handed turns about the east, north and up axes. A scale that
        was not fitted has the variance of what it may be off by. The internal bending of the
        models is not in it. None unless accepted: an answer that is not proven has no error bar.
    estimates : tuple of OffsetEstimate
    hypotheses : tuple of mappings
        Ranked candidates with their neutral scores.
    before, after : mapping
        Overlap, height median, NMAD, RMSE [m], image similarity.
    reference, moving : mapping
        path, sha256, counts, shift, crs of each survey.
    settings, versions, seconds : mapping
    notes : tuple of str
    registration_error : mapping or None
        Standard deviations x, y, z and the largest in any direction, `isotropic` [m], at `at`, the
        centroid of the overlap in the reference (`meshreg.statistics.registration_error`).
    internal : mapping or None
        The internal error: `said` in words, whether a warp was `applied`, and numbers of the
        `horizontal` and `vertical` model (`meshreg.warp`); None where it was not measured.
    false_alarm : float or None
        Chance that unrelated ground would make the best hypothesis stand out as much, measured on
        the pair itself (`meshreg.judge`).
    findings : tuple of Finding
        What later stages found against accepting the pair (`meshreg.verdict`), in the order of the
        reason; empty where nothing was.
    heights_gain : mapping or None
        How many times as high the moving survey's relief is as the reference's: `value`, and
        `sigma` of its natural logarithm (`meshreg.gain`), both None with the `reason` where that
        could not be told; None where it was not looked for.
    warp : Warp or None
        The bend that was applied after the transform, where one was asked for and found.
    evidence : mapping
        In memory only: rasters before and after, residual field; for figures.
    schema : str
    """

    verdict: Verdict
    reason: str
    transform: Transform | None
    covariance: Float64 | None
    estimates: tuple[OffsetEstimate, ...]
    hypotheses: tuple[Mapping[str, Any], ...]
    before: Mapping[str, Any]
    after: Mapping[str, Any]
    reference: Mapping[str, Any]
    moving: Mapping[str, Any]
    settings: Mapping[str, Any]
    versions: Mapping[str, str]
    seconds: Mapping[str, float]
    notes: tuple[str, ...] = ()
    evidence: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)
    schema: str = "meshreg.registration/1"
    registration_error: Mapping[str, Any] | None = None
    internal: Mapping[str, Any] | None = None
    warp: Warp | None = None
    false_alarm: float | None = None
    findings: tuple[Finding, ...] = ()
    heights_gain: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.covariance is not None:
            covariance = _frozen(self.covariance, np.float64, (7, 7), "Registration.covariance")
            _put(self, "covariance", covariance)
        if (self.transform is None) != (self.verdict == "rejected"):
            raise UsageError(
                f"A registration that is {self.verdict} "
                + ("cannot carry a transform." if self.transform else "needs a transform.")
            )
