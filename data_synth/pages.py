"""Texture pages, encoded once and in parallel with nothing else to wait for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import OutputError
from meshreg.records import Texture

QUALITY = 92


def encode_jpeg(pixels: NDArray[np.uint8], quality: int = QUALITY) -> bytes:
    """Return (H, W, 3) uint8 RGB as a JPEG file's bytes."""
    import cv2

    done, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    if not done:
        raise OutputError(f"An image of {pixels.shape} pixels could not be encoded as JPEG.")
    return bytes(data)


def encode_page(pixels: NDArray[np.uint8], name: str) -> Texture:
    """Return a texture page that holds its JPEG."""
    from meshreg.io.files.images import open_texture_bytes

    return open_texture_bytes(encode_jpeg(pixels), f"{name}.jpg", pixels.shape[0] * pixels.shape[1])
