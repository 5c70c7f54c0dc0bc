"""What meshreg raises: one root, one child an exit code.

A registration that fails for its data is a value (`OffsetEstimate.status`, `Registration.verdict`).
Exceptions are for misuse and bad input. Each names the thing, its present value and the remedy.
"""

from __future__ import annotations

from pathlib import Path


class MeshregError(Exception):
    """Root of everything that meshreg raises on purpose.

    Parameters
    ----------
    message : str
        What is wrong, with the present value.
    file : path, optional
        The file concerned.
    place : str, optional
        Where in the file: "line 12", "byte 4096", "face 7".
    remedy : str, optional
        What the user can do about it.
    """

    exit_code = 1

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        place: str | None = None,
        remedy: str | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.file = None if file is None else str(file)
        self.place = place
        self.remedy = remedy

    def __str__(self) -> str:
        where = ", ".join(part for part in (self.file, self.place) if part)
        text = f"{where}: {self.message}" if where else self.message
        return f"{text} {self.remedy}" if self.remedy else text


class UsageError(MeshregError):
    """A call or command line that cannot be meant (exit code 2)."""

    exit_code = 2


class InputError(MeshregError):
    """A survey file that cannot be read as what it claims to be (exit code 3)."""

    exit_code = 3


class UnsafeReferenceError(InputError):
    """A file that points outside its own folder, or at something not a regular file."""


class ResourceLimitError(MeshregError):
    """The job needs more memory than it may have (exit code 5)."""

    exit_code = 5


class OutputError(MeshregError):
    """The result could not be written; what was there before is intact (exit code 6)."""

    exit_code = 6
