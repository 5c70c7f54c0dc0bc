"""The points of a LAZ file for laspy, decompressed by lazrs in a process of its own.

lazrs (0.8) recurses without end on some damaged bytes; its stack overflow would end this process.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from meshreg.io.files.decoding import Decoder


class LazBackend:
    """A backend as `laspy.open` takes it (``laspy.ILazBackend``)."""

    def __init__(self, path: Path, decoders: ExitStack) -> None:
        self.path, self.decoders = path, decoders

    def is_available(self) -> bool:
        """Whether it can be used: always."""
        return True

    def create_reader(self, source: Any, header: Any, **_: Any) -> LazPoints:
        """Return the reader of a file's points; its process ends with `decoders`."""
        return LazPoints(source, header, self.path, self.decoders)


class LazPoints:
    """A reader as laspy calls it (``laspy.IPointReader``); points come in order."""

    def __init__(self, source: Any, header: Any, path: Path, decoders: ExitStack) -> None:
        self.source, self.path, self.decoders = source, path, decoders
        self.record, self.count = int(header.point_format.size), int(header.point_count)
        self.start = int(header.offset_to_point_data)
        self.laszip = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
        self.done, self.slot = 0, 0
        self.decoder: Decoder | None = None

    def read_n_points(self, n: int) -> memoryview:
        """Return the next `n` points as bytes; those before them are overwritten.

        Raises
        ------
        InputError
            The points are damaged.
        """
        n = min(n, self.count - self.done)
        if self.decoder is None:
            self.decoder = self.decoders.enter_context(
                Decoder(
                    "laz", self.path, n * self.record, start=self.start, laszip=self.laszip.hex()
                )
            )
            self.decoder.send("read", slot=0, n_bytes=n * self.record)
        self.decoder.place = f"points {self.done + 1} to {self.done + n}"
        self.decoder.receive()
        slot, self.slot = self.slot, 1 - self.slot
        self.done += n
        if after := min(n, self.count - self.done):  # while these are worked on
            self.decoder.send("read", slot=self.slot, n_bytes=after * self.record)
        return self.decoder.slot(slot)[: n * self.record]

    def close(self) -> None:
        """Close nothing: the stream is its caller's."""
