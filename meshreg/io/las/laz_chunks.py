"""Check the chunks of a LAZ file before lazrs sees them.

lazrs (0.8) takes the number of chunks and their sizes as they stand, and a failed allocation in
Rust ends the process. LASzip: M. Isenburg, "LASzip: lossless compression of LiDAR data", 2013.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshreg.errors import InputError, MeshregError
from meshreg.io.files.decoding import Decoder
from meshreg.io.files.safe import open_regular, require

DAMAGED = "The file is cut off or damaged; export or copy it again."
_VARIABLE = 0xFFFFFFFF  # chunk size of COPC: each chunk has its own
_LAYERED = 10  # items of this kind and later are compressed in layers, one of them ...
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # ... or several; extra bytes (14) have one each
_LARGEST = 1_000_000  # points a chunk that the file does not fill


@dataclass(frozen=True)
class Vlr:
    """One variable length record: whose, which, and where its `length` bytes start."""

    user: bytes
    record: int
    start: int
    length: int


@contextlib.contextmanager
def las_errors(path: Path, error_type: type[MeshregError] = InputError) -> Iterator[None]:
    """Turn whatever laspy, lazrs or a panic of lazrs raises into one error that names the file."""
    try:
        yield
    except (MeshregError, KeyboardInterrupt, SystemExit, GeneratorExit, MemoryError):
        raise
    except BaseException as error:  # a Rust panic is no Exception
        kind, text = type(error).__name__, " ".join(str(error).split())
        reading = issubclass(error_type, InputError)
        raise error_type(
            f"cannot be {'read' if reading else 'written'}: {kind}: {text[:200]}.",
            file=path,
            remedy=DAMAGED if reading else "Free space, or choose another folder.",
        ) from error


def check_chunks(
    path: Path, vlrs: list[Vlr], start: int, size: int, count: int, record: int
) -> None:
    """Make sure that a LAZ file's chunks have the points and the bytes that are there.

    Parameters
    ----------
    path : Path
    vlrs : list of Vlr
    start, size : int
        First byte of the points and size of the file.
    count, record : int
        Points declared and bytes of each, uncompressed.

    Raises
    ------
    InputError
    """
    laszip = [item for item in vlrs if item.user == b"laszip encoded" and item.record == 22204]
    if not laszip or laszip[0].length < 34:
        raise InputError("has no LASzip record.", file=path, remedy=DAMAGED)
    with open_regular(path) as stream:
        stream.seek(laszip[0].start)
        data = stream.read(laszip[0].length)
        (n_items,) = struct.unpack_from("<H", data, 32)
        require(n_items, 6, len(data) - 34, path, "LASzip record", "items")
        items = [struct.unpack_from("<HH", data, 34 + 6 * k) for k in range(n_items)]
        if sum(length for _, length in items) != record:
            raise InputError(
                f"has points of {record} bytes, but compresses others: {items}.",
                file=path,
                place="LASzip record",
                remedy=DAMAGED,
            )
        (chunk,) = struct.unpack_from("<I", data, 12)
        table = _table_start(stream.fileno(), start, size)
        if not start + 8 <= table <= size - 8:
            raise InputError(f"has its chunk table at byte {table}.", file=path, remedy=DAMAGED)
        stream.seek(table + 4)
        (n_chunks,) = struct.unpack("<I", stream.read(4))
        require(n_chunks, record, table - start - 8, path, f"byte {table}", "chunks")
        _check_size(path, chunk, n_chunks, count)
    with Decoder("laz", path, start=start, laszip=data.hex()) as decoder:
        decoder.place = f"byte {table}"
        chunks = decoder.ask("table")["chunks"]
    held = sum(n_bytes for _, n_bytes in chunks)
    points = sum(n for n, _ in chunks)
    if held > table - start - 8 or (chunk == _VARIABLE and points != count):
        raise InputError(
            f"has chunks of {points} points in {held} bytes, where there are {count} points in "
            f"{table - start - 8} bytes.",
            file=path,
            place=f"byte {table}",
            remedy=DAMAGED,
        )
    layers = sum(_LAYERS.get(kind, length) for kind, length in items if kind >= _LAYERED)
    if layers:
        _check_layers(path, start + 8, [n_bytes for _, n_bytes in chunks], record, layers)


def _check_layers(path: Path, start: int, sizes: list[int], record: int, layers: int) -> None:
    """Compare the layers of each chunk (point formats 6 to 10) with the chunk's bytes.

    A chunk starts with one whole point, the number of its points and the size of each layer.
    """
    head = record + 4 + 4 * layers
    with open_regular(path) as stream:
        handle = stream.fileno()
        starts = start + np.cumsum([0, *sizes[:-1]])
        heads = [os.pread(handle, 4 * layers, at + record + 4) for at in starts.tolist()]
    for number, (size, part) in enumerate(zip(sizes, heads, strict=True)):
        whole = size >= head and len(part) == 4 * layers
        inside = int(np.frombuffer(part, "<u4").sum(dtype="u8")) if whole else size
        if head + inside > size > 0:
            raise InputError(
                f"has {inside} bytes of layers in chunk {number + 1} of {size} bytes.",
                file=path,
                place=f"byte {start}",
                remedy=DAMAGED,
            )
        start += size


def _table_start(handle: int, start: int, size: int) -> int:
    """Return where the chunk table is; a file that was written as a stream says it at its end."""
    place = struct.unpack("<q", os.pread(handle, 8, start).ljust(8, b"\0"))[0]
    if place == -1:
        place = struct.unpack("<q", os.pread(handle, 8, size - 8).ljust(8, b"\0"))[0]
    return int(place)


def _check_size(path: Path, chunk: int, n_chunks: int, count: int) -> None:
    if chunk == _VARIABLE:
        return
    fits = 0 < chunk <= max(count, _LARGEST) and (n_chunks - 1) * chunk < count <= n_chunks * chunk
    if not fits:
        raise InputError(
            f"has {n_chunks} chunks of {chunk} points for {count} points.",
            file=path,
            place="LASzip record",
            remedy=DAMAGED,
        )
