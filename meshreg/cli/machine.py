"""What `meshreg doctor` found, as a table or a document."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from meshreg.cli.console import Terminal
from meshreg.doctor import Check

_MARKS = {"ok": "[green]ok[/]", "missing": "[red]MISSING[/]", "optional": "[yellow]absent[/]"}


def document(checks: Sequence[Check]) -> dict[str, Any]:
    """Return the checks as plain values."""
    return {"schema": "meshreg.doctor/1", "checks": [dataclasses.asdict(c) for c in checks]}


def show(checks: Sequence[Check], voice: Terminal) -> None:
    """Print what is there, what is not, and the commands that bring it."""
    table = Table(box=None, pad_edge=False)
    for column in ("", "what", "for", "found"):
        table.add_column(column, overflow="fold")
    for check in checks:
        table.add_row(_MARKS[check.state], escape(check.name), check.use, escape(check.detail))
    voice.out.print(table)
    remedies = _commands(checks)
    if not remedies:
        voice.out.print("[green]Nothing is missing.[/]")
        return
    voice.out.print("\nThese commands bring what is absent:")
    for remedy in remedies:
        voice.out.print(f"  {escape(remedy)}")
    if all(check.state != "missing" for check in checks):
        voice.out.print("The main job runs without them.")


def _commands(checks: Sequence[Check]) -> list[str]:
    """Return the remedies, each once, and all Debian packages in one command."""
    apt = "apt-get install "
    packages: dict[str, None] = {}
    others: dict[str, None] = {}
    for remedy in (check.remedy for check in checks if check.remedy):
        if remedy.startswith(apt):
            packages.update(dict.fromkeys(remedy.removeprefix(apt).split()))
        else:
            others[remedy] = None
    return [*([apt + " ".join(packages)] if packages else []), *others]
