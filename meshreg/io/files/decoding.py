"""Native decoders in a process of their own, where a crash is an error and not the end.

Decoders in C, C++ and Rust may overflow their stack or touch memory that is not theirs on bytes
that no writer ever made. `Decoder` runs one beside this process; what it decodes comes through
shared memory, the next part while the last one is worked on, so that nothing is copied and little
is waited for.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

from meshreg.errors import InputError, ResourceLimitError
from meshreg.io.files.safe import open_regular

_DAMAGED = "The file is cut off or damaged; export or copy it again."
_MEMORY = 768 << 20  # bytes a decoder may hold, beside what is in proportion to its file
_PER_BYTE = 16  # ... which is this many for each byte of the file
_PROGRAM = Path(__file__).with_name("decoder_process.py")


class Decoder:
    """A decoder of one file, in a process of its own; a context manager.

    Parameters
    ----------
    kind : str
        Key in `meshreg.io.files.decoder_process.KINDS`.
    path : Path or None
        A regular file.
    slot : int
        Size of each of the two parts of the shared memory [bytes].
    data : bytes, optional
        What is decoded, where it is no file of its own.
    **setup
        Plain values for the decoder.

    Raises
    ------
    InputError
        By every method: the file cannot be decoded, or the decoder crashed.
    ResourceLimitError
        No process can be started.
    """

    def __init__(
        self, kind: str, path: Path | None, slot: int = 0, data: bytes | None = None, **setup: Any
    ) -> None:
        self.path, self.place = path, ""
        self._slot = slot
        if path is not None:
            with open_regular(path) as stream:
                size = os.fstat(stream.fileno()).st_size
        else:
            size = len(data or b"")
        self._block = self._shared(2 * slot) if slot else None
        given = None if path is not None else self._shared(size, data or b"")
        handles = [handle for handle in (self._block, given) if handle is not None]
        arguments = {
            "kind": kind,
            "file": f"/dev/fd/{given}" if path is None else str(path.resolve()),
            "memory": _MEMORY + _PER_BYTE * size + slot,
            "search": [*(entry for entry in sys.path if entry), str(_PROGRAM.parents[2])],
            "block": self._block,
            "slot": slot,
            **setup,
        }
        try:
            self._map = None if self._block is None else mmap.mmap(self._block, 2 * slot)
            self._process = subprocess.Popen(
                # Isolated and without site: it starts in some hundredths of a second.
                [sys.executable, "-I", "-S", str(_PROGRAM), json.dumps(arguments)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                pass_fds=handles,
            )
        except OSError as error:
            raise self._limit("its decoder cannot be started", error) from error
        finally:
            for handle in handles:
                os.close(handle)

    def __enter__(self) -> Decoder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):  # what it was sent last it never read
                    pipe.close()

    def slot(self, number: int) -> memoryview:
        """Return one of the two parts of the shared memory; it is written again by and by."""
        assert self._map is not None
        return memoryview(self._map)[number * self._slot : (number + 1) * self._slot]

    def ask(self, do: str, **values: Any) -> dict[str, Any]:
        """Send a request and wait for its answer."""
        self.send(do, **values)
        return self.receive()

    def send(self, do: str, **values: Any) -> None:
        """Send a request; answers come in the order of the requests."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has crashed, which `receive` says
            self._process.stdin.write(json.dumps({"do": do, **values}).encode() + b"\n")
            self._process.stdin.flush()

    def receive(self) -> dict[str, Any]:
        """Wait for the next answer."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line.endswith(b"\n"):
            self._fail(f"the decoder crashed ({_ending(self._process.wait())})")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            self._fail(str(answer["error"]).rstrip("."))
        return answer

    def _shared(self, size: int, data: bytes = b"") -> int:
        try:
            handle = _shared(size)
            if data:
                with open(handle, "wb", closefd=False) as out:
                    out.write(data)
        except OSError as error:
            raise self._limit("memory for its decoder is not to be had", error) from error
        return handle

    def _limit(self, what: str, error: OSError) -> ResourceLimitError:
        return ResourceLimitError(
            f"{what}: {error.strerror}.", file=self.path, remedy="Close other programs."
        )

    def _fail(self, why: str) -> None:
        raise InputError(
            f"cannot be decoded: {why}.", file=self.path, place=self.place or None, remedy=_DAMAGED
        )


def _shared(size: int) -> int:
    """Return a handle of memory that processes may share and that ends with them."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("meshreg", os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as stream:
            handle = os.dup(stream.fileno())
    try:
        os.ftruncate(handle, size)
    except BaseException:
        os.close(handle)
        raise
    return handle


def _ending(code: int) -> str:
    if code < 0:
        return signal.Signals(-code).name
    return f"exit {code}"
