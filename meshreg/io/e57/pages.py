"""The pages of an E57 file: 1024 bytes each, the last four the CRC-32C of the others.

A 48-byte header says where the XML section lies. "Physical" offsets count all bytes of the file,
"logical" ones leave the checksums out (ASTM E2807 section 8.2).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from meshreg.errors import InputError, ResourceLimitError

PAGE = 1024
PAYLOAD = PAGE - 4
MAX_XML = 100_000_000
AGAIN = "The file is cut off or damaged; export or copy it again."
_HEADER = struct.Struct("<8sIIQQQQ")
HEADER_SIZE = _HEADER.size


def check_header(data: bytes, n_bytes: int, path: Path) -> tuple[int, int]:
    """Return the XML section's physical offset and logical length.

    `data` is the file's first `HEADER_SIZE` bytes of `n_bytes`.
    """

    def refuse(message: str, remedy: str = AGAIN) -> InputError:
        return InputError(message, file=path, place="header", remedy=remedy)

    if len(data) < HEADER_SIZE or data[:8] != b"ASTM-E57":
        raise refuse("is not an E57 file (it does not start with ASTM-E57).")
    _, major, _, size, start, length, page = _HEADER.unpack(data)
    if major != 1:
        raise refuse(f"is E57 version {major}; version 1 is known.", "Export it as E57 1.0.")
    if page != PAGE:
        raise refuse(f"declares pages of {page} bytes; E57 1.0 has {PAGE}.")
    if size != n_bytes or size % PAGE:
        raise refuse(f"declares {size} bytes, but the file has {n_bytes}.")
    if start < _HEADER.size or start >= size or start % PAGE >= PAYLOAD:
        raise refuse(f"places its XML section at byte {start} of {size}.")
    if length > MAX_XML:
        raise ResourceLimitError(
            f"declares an XML section of {length} bytes; {MAX_XML} are the limit.", file=path
        )
    if to_logical(start) + length > size // PAGE * PAYLOAD:
        raise refuse(f"declares an XML section of {length} bytes, which runs past its end.")
    return start, length


def to_logical(physical: int) -> int:
    """Return the offset among the payload bytes of an offset in the file."""
    return physical // PAGE * PAYLOAD + physical % PAGE


def to_physical(logical: int) -> int:
    """Return the offset in the file of an offset among the payload bytes."""
    return logical // PAYLOAD * PAGE + logical % PAYLOAD


def logical_bytes(stream: BinaryIO, start: int, length: int) -> bytes:
    """Return payload bytes, checksums left out; fewer than `length` where the file ends."""
    first, last = start // PAYLOAD, (start + length + PAYLOAD - 1) // PAYLOAD
    stream.seek(first * PAGE)
    pages = stream.read((last - first) * PAGE)
    payload = b"".join(pages[at : at + PAYLOAD] for at in range(0, len(pages), PAGE))
    return payload[start - first * PAYLOAD :][:length]


_CRC_TABLE = []
for _byte in range(256):
    for _ in range(8):
        _byte = _byte >> 1 ^ (0x82F63B78 if _byte & 1 else 0)
    _CRC_TABLE.append(_byte)


def page_checksum(payload: bytes) -> bytes:
    """Return the CRC-32C of a page's payload as E57 stores it (big-endian)."""
    crc = 0xFFFFFFFF
    for byte in payload:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return struct.pack(">I", crc ^ 0xFFFFFFFF)


def paged(payload: bytes) -> bytes:
    """Return payload bytes as whole pages with their checksums, the last one filled up."""
    payload += b" " * (-len(payload) % PAYLOAD)
    parts = (payload[at : at + PAYLOAD] for at in range(0, len(payload), PAYLOAD))
    return b"".join(part + page_checksum(part) for part in parts)


def header_page(first_page: bytes, size: int, xml_start: int, xml_length: int) -> bytes:
    """Return the file's first page with new lengths (file, XML offset, XML length) and checksum."""
    signature, major, minor, _, _, _, page = _HEADER.unpack(first_page[: _HEADER.size])
    header = _HEADER.pack(signature, major, minor, size, xml_start, xml_length, page)
    return paged(header + first_page[_HEADER.size : PAYLOAD])
