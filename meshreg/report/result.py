"""What a page is made from: the finished record, what was kept, and what lies in its folder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from meshreg.records import Registration

PAGE = "report.html"
MANIFEST = "manifest.json"  # keeps the sums of the page too, so that it is not a part of it


@dataclass(frozen=True)
class Result:
    """A finished registration as the page's sections see it.

    Attributes
    ----------
    registration : Registration
        As it was read; its own evidence is not looked at.
    kept : mapping
        What `meshreg.report.keep` kept, "meta" as a dictionary; may be empty.
    files : sequence of (name, bytes)
        What lies beside the page, by its relative path.
    log : str
    still : bytes
        A PNG of the 3-D scene; may be empty.
    validation : mapping
        `validation.json`, where tie points picked by hand were compared; may be empty.
    """

    registration: Registration
    kept: Mapping[str, Any]
    files: Sequence[tuple[str, int]] = ()
    log: str = ""
    still: bytes = b""
    validation: Mapping[str, Any] = field(default_factory=dict)


def gather(registration: Registration, kept: Mapping[str, Any], folder: Path) -> Result:
    """Collect what lies in a result's folder: its files, its log, its 3-D still."""
    folder = Path(folder)
    files = sorted(
        (path.relative_to(folder).as_posix(), path.stat().st_size)
        for path in folder.rglob("*")
        if path.is_file() and path.name not in (PAGE, MANIFEST) and not path.name.startswith(".")
    )
    log, still = folder / "log.txt", folder / "figures" / "scene.png"
    text = log.read_text(encoding="utf-8", errors="replace") if log.is_file() else ""
    picture = still.read_bytes() if still.is_file() else b""
    return Result(registration, kept, files, text, picture, _validation(folder))


def _validation(folder: Path) -> Mapping[str, Any]:
    """Return what `meshreg validate` said, if its page lies there; damaged, it says nothing."""
    try:
        said = json.loads((folder / "validation.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return said if isinstance(said, dict) and (folder / "validation.html").is_file() else {}


def name_of(entry: Mapping[str, Any]) -> str:
    """How a survey is called."""
    return str(entry.get("name") or "a survey")
