"""The other side of `files.decoding`: a program of its own, which starts without meshreg.

It reads one JSON request a line and answers with one JSON line; what it decodes goes into a block
of memory that it shares with its parent. It ends with its standard input.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import signal
import sys
from typing import Any


class Laz:
    """Points of a LAZ file by lazrs, as the bytes of its records."""

    def __init__(self, setup: dict[str, Any]) -> None:
        import lazrs

        self.lazrs, self.data = lazrs, bytes.fromhex(setup["laszip"])
        self.points: Any = None
        self.stream = open(setup["file"], "rb")  # noqa: SIM115  open as long as the process runs
        self.stream.seek(setup["start"])

    def table(self) -> Any:
        """Return (points, bytes) of each chunk."""
        return {"chunks": self.lazrs.read_chunk_table(self.stream, self.lazrs.LazVlr(self.data))}

    def read(self, slot: memoryview, n_bytes: int) -> Any:
        """Decode the next points, `n_bytes` in all."""
        if self.points is None:  # works on all cores
            self.points = self.lazrs.ParLasZipDecompressor(self.stream, self.data)
        self.points.decompress_many(slot[:n_bytes])
        return {}


class E57:
    """Fields of a scan of an E57 file by libE57Format, as float64 one after the other."""

    def __init__(self, setup: dict[str, Any]) -> None:
        from pye57 import libe57

        self.library = libe57
        self.file = libe57.ImageFile(setup["file"], "r")
        self.reader: Any = None

    def scan(self, number: int, names: list[str], capacity: int) -> Any:
        """Turn to a scan, of which `capacity` points are decoded at once."""
        import numpy as np

        if self.reader is not None:
            self.reader.close()
        self.arrays = [np.empty(capacity) for _ in names]
        buffers = self.library.VectorSourceDestBuffer()
        for name, array in zip(names, self.arrays, strict=True):
            buffers.append(
                self.library.SourceDestBuffer(self.file, name, array, capacity, True, True)
            )
        self.reader = self.file.root()["data3D"][number]["points"].reader(buffers)
        return {}

    def read(self, slot: memoryview) -> Any:
        """Decode the next points; none are left when the count is 0."""
        import numpy as np

        count = int(self.reader.read())
        out = np.frombuffer(slot, np.float64, count * len(self.arrays)).reshape(-1, count or 1)
        for row, array in zip(out, self.arrays, strict=False):
            row[:] = array[:count]
        return {"count": count}


class Page:
    """A texture page by Pillow; the conversions are meshreg's own."""

    def __init__(self, setup: dict[str, Any]) -> None:
        self.file, self.name = setup["file"], setup["name"]

    def read(self, slot: memoryview) -> Any:
        """Decode the page to the front of the slot; return its shape."""
        from meshreg.io.files.images import decode_into

        return {"shape": decode_into(self.file, self.name, slot)}


KINDS = {"laz": Laz, "e57": E57, "page": Page}


def main() -> None:
    """Serve requests until there are no more."""
    setup = json.loads(sys.argv[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when it ends
    _limit(setup["memory"])
    sys.path += setup["search"]
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever a library prints is no answer
    block = memoryview(mmap.mmap(setup["block"], 2 * setup["slot"])) if setup["slot"] else None
    decoder: Any = None
    for line in sys.stdin:
        try:
            request = json.loads(line)
            name, slot = request.pop("do"), request.pop("slot", None)
            if slot is not None and block is not None:
                request["slot"] = block[slot * setup["slot"] : (slot + 1) * setup["slot"]]
            decoder = decoder or KINDS[setup["kind"]](setup)
            answer = getattr(decoder, name)(**request)
        except BaseException as error:  # a panic of Rust is no Exception
            kind, text = type(error).__name__, " ".join(str(error).split())
            own = getattr(error, "message", None)  # of meshreg's own errors
            answer = {"error": str(own or f"{kind}: {text[:200]}")}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def _limit(memory: int) -> None:
    with contextlib.suppress(ImportError, AttributeError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        # Not the address space, of which threads reserve much that they never use.
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))


if __name__ == "__main__":
    main()
