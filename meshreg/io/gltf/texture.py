"""Which texture page a glTF primitive wears, and how its coordinates lie on it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import InputError
from meshreg.io.files.images import open_texture, open_texture_bytes
from meshreg.io.files.safe import MissingReferenceError
from meshreg.io.gltf.document import Document, extension
from meshreg.io.options import ReadOptions
from meshreg.records import Texture

_CLAMP, _MIRROR = 33071, 33648
_Change = Callable[[NDArray[np.float32]], NDArray[np.float32]]
_NONE: tuple[int, str, _Change] = (-1, "", lambda uv: uv)


class Pages:
    """The texture pages of a document, each opened once.

    Attributes
    ----------
    textures : list of Texture
        In the order in which primitives first wear them.
    """

    def __init__(self, document: Document, options: ReadOptions, notes: list[str]) -> None:
        self.textures: list[Texture] = []
        self._document = document
        self._options = options
        self._notes = notes
        self._known: dict[int, int] = {}

    def of(self, primitive: dict[str, Any], place: str) -> tuple[int, str, _Change]:
        """Find a primitive's page.

        Returns
        -------
        page : int
            Number in `textures`, or -1.
        name : str
            The attribute that holds its texture coordinates.
        change : callable
            Turns those into coordinates with v upward.
        """
        document = self._document
        if self._options.geometry_only or primitive.get("material") is None:
            return _NONE
        material = document.item("materials", primitive["material"], place)
        info = _color_texture(material)
        if info is None:
            return _NONE
        place = f"materials[{primitive['material']}]"
        transform = _object(extension(info, "KHR_texture_transform"))
        number = transform.get("texCoord", info.get("texCoord", 0))
        if type(number) is not int or not 0 <= number < 32:
            document.fail(f"has texCoord {str(number)[:20]}.", place)
        if transform.get("rotation"):
            document.fail(
                "turns its texture (KHR_texture_transform), which is not read.",
                place,
                "Export it without that, or read it with geometry_only (--geometry-only).",
            )
        offset = document.numbers(transform, "offset", 2, place)
        scale = document.numbers(transform, "scale", 2, place)
        page = self._page(info.get("index"), place)
        return page, f"TEXCOORD_{number}", _change(offset, scale)

    def _page(self, index: Any, place: str) -> int:
        texture = self._document.item("textures", index, place)
        if index not in self._known:
            self._known[index] = self._open(texture, f"textures[{index}]")
        return self._known[index]

    def _open(self, texture: dict[str, Any], place: str) -> int:
        document = self._document
        source = _object(extension(texture, "EXT_texture_webp")).get(
            "source", texture.get("source")
        )
        if source is None:
            self._notes.append(f"{place} has no image of a kind that is read; it gives no color.")
            return -1
        clamp = False
        if texture.get("sampler") is not None:
            sampler = document.item("samplers", texture["sampler"], place)
            wrap = (sampler.get("wrapS"), sampler.get("wrapT"))
            clamp = _CLAMP in wrap
            if _MIRROR in wrap:
                self._notes.append(f"{place} repeats mirrored; outside 0-1 it is plainly repeated.")
        try:
            name, where = self._image(source, place)
        except MissingReferenceError as error:
            self._notes.append(f"The image of {place} gives no color: {error.message}")
            return -1
        most = self._options.max_pixels
        try:
            if isinstance(where, Path):
                page = open_texture(where, most, clamp, self._notes)
            else:
                page = open_texture_bytes(where, name, most, clamp, self._notes)
        except InputError as error:
            self._notes.append(f"The image of {place} {error.message} It gives no color.")
            return -1
        self.textures.append(page)
        return len(self.textures) - 1

    def _image(self, index: Any, place: str) -> tuple[str, Path | bytes]:
        """Return the name of an image and where it is: a file, or its bytes."""
        document = self._document
        image = document.item("images", index, place)
        place = f"images[{index}]"
        uri = image.get("uri")
        name = str(image.get("name") or f"image_{index}")[:100]
        if isinstance(uri, str) and uri.startswith("data:"):
            return name, document.data_uri(uri, place)
        if isinstance(uri, str):
            path = document.outside(uri)
            if path.name != Path(unquote(uri)).name:
                self._notes.append(f"Image {uri[:80]!r} was found as {path.name!r}.")
            return path.name, path
        data, _ = document.view(image.get("bufferView"), place)
        return name, bytes(data)


def _color_texture(material: dict[str, Any]) -> dict[str, Any] | None:
    """Return the reference to the texture that gives a material its color, or None."""
    for info in (
        _object(material.get("pbrMetallicRoughness")).get("baseColorTexture"),
        _object(extension(material, "KHR_materials_pbrSpecularGlossiness")).get("diffuseTexture"),
        material.get("emissiveTexture"),  # some exporters draw unlit surveys so
    ):
        if isinstance(info, dict):
            return info
    return None


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _change(offset: Any, scale: Any) -> _Change:
    """Apply KHR_texture_transform's offset and scale, then turn v upward."""

    def change(uv: NDArray[np.float32]) -> NDArray[np.float32]:
        if scale is not None or offset is not None:
            moved = uv * (1.0 if scale is None else scale) + (0.0 if offset is None else offset)
            uv = moved.astype(np.float32)
        return np.stack([uv[:, 0], np.float32(1) - uv[:, 1]], axis=1)

    return change
