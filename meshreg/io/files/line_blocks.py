"""Whole lines of a text file, a block at a time, worked on side by side and given in order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from meshreg.errors import InputError, ResourceLimitError
from meshreg.io.files.safe import read_into
from meshreg.records import UInt8

BLOCK = 1 << 19  # bytes read at once
LONGEST = 1 << 20  # bytes in a line, its continuation included
PADDING = 4  # line ends behind a block
_MAX_THREADS = 4
_Result = TypeVar("_Result")


@dataclass(frozen=True, eq=False)
class Block:
    """Whole lines of a file: `data[:end]`, at most BLOCK + LONGEST, then `PADDING` line ends."""

    data: UInt8
    end: int


def line_blocks(stream: BinaryIO, path: Path, hasher: Any = None) -> Iterator[Block]:
    """Cut a text file into blocks of whole lines (LF, CRLF or CR); refuse what is no text.

    A byte order mark is dropped. A line end that a backslash hides does not end a block.

    Parameters
    ----------
    stream : binary file at its start
    path : Path
        For messages.
    hasher : optional
        Its `update` gets every byte of the file, in order.

    Raises
    ------
    InputError
        UTF-16, a NUL byte, an empty file.
    ResourceLimitError
        A line longer than `LONGEST`.
    """
    head = stream.read(3)
    if not head:
        raise InputError("is empty.", file=path, remedy="Export or copy it again.")
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError("is UTF-16 text.", file=path, remedy="Save it as UTF-8.")
    if hasher is not None:
        hasher.update(head)
    carry = np.frombuffer(b"" if head == b"\xef\xbb\xbf" else head, np.uint8)
    place = len(head) - len(carry)  # of the carry's first byte in the file
    n_read = -1
    while n_read:
        buffer = np.empty(len(carry) + BLOCK + PADDING, np.uint8)
        buffer[: len(carry)] = carry
        new = buffer[len(carry) : len(carry) + BLOCK]
        n_read = read_into(stream, new, path)
        if hasher is not None:
            hasher.update(new[:n_read].data)
        size = len(carry) + n_read
        if size and buffer[:size].min() == 0:
            raise InputError(
                "holds a NUL byte: it is not text, or damaged.",
                file=path,
                place=f"byte {place + int(buffer[:size].argmin())}",
                remedy="Export or copy it again.",
            )
        end = _last_line_end(buffer[:size]) if n_read else size
        if end == 0 and size > LONGEST:
            raise ResourceLimitError(
                f"a line is longer than {LONGEST} bytes.", file=path, place=f"from byte {place}"
            )
        carry = buffer[end:size].copy()
        place += end
        if end:
            buffer[end : end + PADDING] = 10
            yield Block(buffer, end)


def _last_line_end(data: UInt8) -> int:
    """Return the place behind the last line that is whole, 0 if there is none."""
    for length in (4096, len(data)):  # nearly always it is close to the end
        tail = data[-length:].tobytes()
        end = len(tail)
        while end > 0:
            newline, carriage = tail.rfind(b"\n", 0, end), tail.rfind(b"\r", 0, end)
            last = max(newline, carriage)
            # A carriage return at the very end may be half of a CRLF.
            split = last == carriage and last == len(tail) - 1
            before = last - (2 if last == newline and carriage == last - 1 else 1)
            hidden = before >= 0 and tail[before] == ord("\\")
            sure = last > 1 or len(tail) == len(data)
            if last >= 0 and sure and not split and not hidden:
                return len(data) - len(tail) + last + 1
            end = last
    return 0


def in_order(
    blocks: Iterator[Block], work: Callable[[Block], _Result], n_bytes: int
) -> Generator[tuple[Block, _Result]]:
    """Work on blocks in threads; give blocks and results in the order of the file.

    `work` must not depend on earlier blocks, and gains where it holds no lock. Small files
    (`n_bytes`) are worked on at once.
    """
    cores = os.cpu_count() or 1
    threads = min(_MAX_THREADS, cores + 1)  # one more, for while the file is waited for
    if cores == 1 or n_bytes <= 4 * BLOCK:
        for block in blocks:
            yield block, work(block)
        return
    with ThreadPoolExecutor(threads) as pool:
        waiting: deque[tuple[Block, Future[_Result]]] = deque()
        try:
            for block in blocks:
                waiting.append((block, pool.submit(work, block)))
                if len(waiting) > threads:
                    first, result = waiting.popleft()
                    yield first, result.result()
            while waiting:
                first, result = waiting.popleft()
                yield first, result.result()
        finally:
            for _, result in waiting:
                result.cancel()
