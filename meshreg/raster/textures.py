"""Texture pages: decoded group by group, and averaged where their texels are finer than samples."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from meshreg.errors import InputError
from meshreg.raster.spacing import median_texel, texel_sizes
from meshreg.records import Int32, Mesh, Texture, UInt8

if TYPE_CHECKING:
    from meshreg.raster.shade_kernels import Pages

log = logging.getLogger("meshreg")
_GROUP_BYTES = 1 << 30  # decoded pages that are in memory together, at most
_GROUP_LEAST = 1 << 28  # ... and at least, however few bytes they were
_EXPANDED = 400  # ... and for each of these
_SMALL_PAGE = 1 << 25  # texels


@dataclass(frozen=True)
class PagePlan:
    """How one texture page will be kept: `times` × `times` texels averaged to one, or as it is."""

    index: int
    texture: Texture
    times: int
    wraps: bool

    @property
    def stored(self) -> tuple[int, int]:
        """(width, height) in memory."""
        width, height = self.texture.size
        return -(-width // self.times), -(-height // self.times)


def plan_pages(mesh: Mesh, used: Int32, sample: float) -> list[list[PagePlan]]:
    """Decide how to keep the pages `used`, and which are in memory together.

    A page whose texels are finer than the distance `sample` [m] between samples is averaged over
    blocks of texels as wide as that; else bilinear samples would skip texels, and alias.
    """
    from meshreg.raster.page_kernels import page_spans

    assert mesh.uv is not None
    assert mesh.face_texture is not None
    page, texel, area = texel_sizes(mesh)
    spans = page_spans(mesh.uv, mesh.face_texture, len(mesh.textures))
    groups: list[list[PagePlan]] = []
    free = 0
    # Pages in memory have no encoded size; they are there already.
    stored = sum(getattr(mesh.textures[index].load, "n_bytes", _GROUP_BYTES) for index in used)
    room = min(_GROUP_BYTES, _GROUP_LEAST + _EXPANDED * stored)
    for index in used:
        texture, mine = mesh.textures[index], page == index
        size = median_texel(texel[mine], area[mine])
        times = 1 if size is None else max(1, round(min(sample / size, max(texture.size))))
        low, high = spans[index]
        wraps = not texture.clamp and bool((low < -1e-4).any() or (high > 1 + 1e-4).any())
        if wraps:  # blocks must fit the period
            period = math.gcd(*texture.size)
            times = max(k for k in range(1, min(times, period) + 1) if period % k == 0)
        plan = PagePlan(int(index), texture, times, wraps)
        need = 4 * plan.stored[0] * plan.stored[1]
        if not groups or need > free:
            groups.append([])
            free = room
        groups[-1].append(plan)
        free -= need
    return groups


def load_pages(mesh: Mesh, group: list[PagePlan]) -> tuple[Pages, list[int]]:
    """Decode a group of pages; also return the pages that could not be, which stay uncolored."""
    from meshreg.raster.page_kernels import packed, shrunk
    from meshreg.raster.shade_kernels import Pages

    table = np.full((len(mesh.textures), 6), -1.0)
    sizes = [plan.stored[0] * plan.stored[1] for plan in group]
    texels = np.empty(sum(sizes), np.uint32)
    missing, offset = [], 0
    with closing(_decoding(group)) as pages:
        for plan, size, decoded in zip(group, sizes, pages, strict=True):
            try:
                image = decoded.result()
            except InputError as error:
                log.warning("Texture page %s is left out: %s", plan.texture.name, error)
                missing.append(plan.index)
                continue
            if plan.times == 1:
                packed(image, texels[offset : offset + size])
            else:
                shrunk(image, _used(mesh, plan), plan.times, texels[offset : offset + size])
            width, height = plan.texture.size
            scale = width / plan.times, height / plan.times
            table[plan.index] = (offset, *plan.stored, plan.wraps, *scale)
            offset += size
    return Pages(table, texels), missing


def _decoding(group: list[PagePlan]) -> Generator[Future[UInt8], None, None]:
    """Decode pages while those before them are packed: two at once, large ones one by one."""
    largest = max((plan.texture.size[0] * plan.texture.size[1] for plan in group), default=0)
    several = 2 if largest <= _SMALL_PAGE else 1
    ahead: deque[Future[UInt8]] = deque()
    with ThreadPoolExecutor(several) as beside:
        for plan in group:
            ahead.append(beside.submit(_decoded, plan.texture))
            if len(ahead) > several:
                yield ahead.popleft()
        while ahead:
            yield ahead.popleft()


def _decoded(texture: Texture) -> UInt8:
    """Load a page; check it against its header."""
    image = texture.load()
    width, height = texture.size
    if image.dtype != np.uint8 or image.shape not in ((height, width, 3), (height, width, 4)):
        raise InputError(
            f"The page decodes to {image.dtype} of shape {image.shape}; its header promises "
            f"{width} × {height} pixels of three or four bytes.",
            file=texture.name,
            remedy="Export the texture again.",
        )
    image = np.ascontiguousarray(image).view()
    image.flags.writeable = False  # one type for the kernels, whoever decoded it
    return image


def _used(mesh: Mesh, plan: PagePlan) -> UInt8:
    """Say which texels of a page the mesh uses, (height, width); all, where the page wraps.

    Averaged over any others, a block at the edge of a chart would take in the filling beside it.
    """
    import numba

    from meshreg.raster.page_kernels import covered

    assert mesh.uv is not None
    assert mesh.face_texture is not None
    width, height = plan.texture.size
    if plan.wraps:
        return np.ones((height, width), np.uint8)
    workers = numba.get_num_threads()
    return covered(mesh.uv, mesh.face_texture, plan.index, (height, width), workers)
