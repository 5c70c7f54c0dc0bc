"""Textured or vertex-colored triangles to a raster: the top surface, area mean per cell."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from meshreg.raster.finish import Layers, empty_layers
from meshreg.raster.floaters import faces_to_keep
from meshreg.raster.grid import LEAST_SHARE
from meshreg.raster.placing import Placing
from meshreg.raster.spacing import Spacing
from meshreg.records import Bool, Float64, Grid, Int32, Mesh
from meshreg.settings import RasterSettings

if TYPE_CHECKING:
    from meshreg.raster.kernels import BandFaces
    from meshreg.raster.shade_kernels import ColorArrays, ColorSums, MeshArrays, Pages

log = logging.getLogger("meshreg")

_MOST_FOR_HEIGHT = 16  # samples along a cell's side
_MOST_FOR_COLOR = 8  # texels finer than that are averaged beforehand
_BAND_BYTES = 2 << 20  # depth and face of a band's samples: what stays in a core's cache
_SLAB_CELLS = 32_000_000  # cells whose color sums are in memory together (18 B each)


def samples_per_side(cell: float, spacing: Spacing) -> int:
    """How many samples to take along a cell's side: at the mesh's and the texture's spacing.

    At least 2. At most 16 for the mesh, and 8 for the texture: from there on its texels are
    averaged beforehand (`textures.plan_pages`).
    """
    mesh = min(cell / spacing.points, _MOST_FOR_HEIGHT)
    color = min(cell / spacing.texels, _MOST_FOR_COLOR) if spacing.texels else 0.0
    return max(2, math.ceil(max(mesh, color) - 0.05))


def draw_mesh(
    mesh: Mesh,
    placing: Placing,
    grid: Grid,
    spacing: Spacing,
    settings: RasterSettings,
    times: int | None = None,
) -> Layers:
    """Draw the mesh's top surface, straight from above, with `times`² samples to a cell.

    Each sample takes the highest face over its place, of equal ones the first. A cell's height
    and color are the means over its samples; a cell where fewer than half of the samples have
    one stays empty. Vertical faces have no area from above and are not drawn.

    `spacing` and `placing` speak of the mesh as moved; `times` overrides the number of samples
    that the spacing asks for (1: point samples at cell centres).
    """
    from meshreg.raster import kernels

    times = samples_per_side(grid.cell, spacing) if times is None else times
    rows, cols = grid.shape
    points = kernels.placed(mesh.vertices, *placing.on_lattice(grid.cell / times))
    masked: dict[str, int] = {}
    keep = np.empty(0, bool)
    if settings.remove_floaters:
        keep = faces_to_keep(mesh, placing.linear[2], spacing.points / placing.scale)
        masked["floaters"] = int(np.count_nonzero(~keep))
    band_rows = _band_rows(rows, cols, times)
    bands, sums = kernels.face_bands(
        points, mesh.faces, keep, (rows * times, cols * times), band_rows * times
    )
    faces_of = kernels.band_members(bands, -(-rows // band_rows))
    layers = empty_layers(grid)
    drawing = _Drawing(mesh, points, faces_of, layers, times, band_rows)
    drawing.run(_used_pages(mesh, bands), grid.cell / times, masked)
    masked["not finite"] = int(sums[:, 0].sum())
    covered = int(layers.samples.sum(dtype=np.int64))
    masked["beneath"] = max(0, round((float(sums[:, 1].sum()) - covered) / times**2))
    if masked["beneath"] < 1e-3 * rows * cols:
        del masked["beneath"]  # the difference of two sums, of which one is a count of samples
    _drop_thin_cells(layers, times)
    layers.masked = masked
    return layers


def _band_rows(rows: int, cols: int, times: int) -> int:
    fits = _BAND_BYTES // (8 * cols * times * times)
    return max(1, min(fits, -(-rows // 64)))


def _used_pages(mesh: Mesh, bands: Int32) -> Int32:
    if mesh.face_texture is None or mesh.uv is None:
        return np.empty(0, np.int32)
    used = np.zeros(len(mesh.textures) + 1, bool)
    used[mesh.face_texture[bands[:, 0] >= 0]] = True  # -1 marks the last, which is none
    return np.flatnonzero(used[:-1]).astype(np.int32)


class _Drawing:
    """The loops over slabs of rows and groups of pages; only they keep the memory bounded."""

    def __init__(
        self,
        mesh: Mesh,
        points: Float64,
        faces_of: BandFaces,
        layers: Layers,
        times: int,
        band_rows: int,
    ) -> None:
        self.mesh, self.points, self.faces_of = mesh, points, faces_of
        self.layers, self.times, self.band_rows = layers, times, band_rows

    def run(self, used: Int32, step: float, masked: dict[str, int]) -> None:
        """Draw everything; `step` [m] lies between samples."""
        from meshreg.raster.shade_kernels import color_means, no_sums
        from meshreg.raster.textures import load_pages, plan_pages

        groups = plan_pages(self.mesh, used, step) if len(used) else []
        rows, cols = self.layers.height.shape
        # With one group the kernel makes means at once; sums are needed to add up over several.
        apart = len(groups) > 1
        per_slab = max(1, _SLAB_CELLS // (cols * self.band_rows)) * self.band_rows
        loaded, pages = -1, no_pages()
        missing: set[int] = set()
        if groups or self.mesh.colors is not None:
            self.layers.still = np.zeros((rows, cols), bool)
        for first in range(0, rows, per_slab):
            last = min(first + per_slab, rows)
            sums = no_sums(last - first if apart else 0, cols)
            for number in range(max(1, len(groups))):
                if groups and number != loaded:
                    pages = no_pages()  # let go of the last group before decoding the next
                    pages, failed = load_pages(self.mesh, groups[number])
                    loaded = number
                    missing.update(failed)
                self._render(first, last, number == 0, pages, sums)
            if apart:
                color_means(sums, least_samples(self.times), self._colors(), first)
        if missing:
            assert self.mesh.face_texture is not None
            gone = np.isin(self.mesh.face_texture, list(missing))
            masked["missing page"] = int(np.count_nonzero(gone))

    def _colors(self) -> ColorArrays:
        from meshreg.raster.shade_kernels import ColorArrays

        still = self.layers.still
        if still is None:
            still = np.empty((0, 0), bool)
        return ColorArrays(self.layers.color, self.layers.color_valid, still)

    def _render(self, first: int, last: int, is_first: bool, pages: Pages, sums: ColorSums) -> None:
        from meshreg.raster import kernels

        height = self.layers.height if is_first else np.empty((0, 0), np.float32)
        arrays = mesh_arrays(self.mesh, self.points, with_colors=is_first)
        least = least_samples(self.times)
        lattice = kernels.Lattice(first, last, self.band_rows, self.times, least)
        samples = self.layers.samples
        kernels.render(arrays, self.faces_of, lattice, height, samples, pages, sums, self._colors())


def least_samples(times: int) -> int:
    """How many of a cell's samples must have a surface, or a color."""
    return max(1, math.ceil(LEAST_SHARE * times * times))


def _drop_thin_cells(layers: Layers, times: int) -> None:
    thin: Bool = layers.samples < least_samples(times)
    layers.height[thin] = np.nan
    layers.samples[thin] = 0


def mesh_arrays(mesh: Mesh, points: Float64, *, with_colors: bool) -> MeshArrays:
    """Gather what the kernels need of a mesh, with empty arrays for what it lacks."""
    from meshreg.raster.shade_kernels import MeshArrays

    def or_empty(array: Any, dtype: Any, *shape: int) -> Any:
        if array is not None:
            return array
        empty = np.empty(shape, dtype)
        empty.flags.writeable = False  # as the records' arrays: another type is compiled anew
        return empty

    return MeshArrays(
        points,
        mesh.faces,
        or_empty(mesh.uv, np.float32, 0, 3, 2),
        or_empty(mesh.face_texture, np.int32, 0),
        or_empty(mesh.colors if with_colors else None, np.uint8, 0, 3),
    )


def no_pages() -> Pages:
    """Return an empty set of pages."""
    from meshreg.raster.shade_kernels import Pages

    return Pages(np.empty((0, 6)), np.empty(0, np.uint32))
