"""`meshreg synth`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.markup import escape

from meshreg.cli.console import Progress, Terminal
from meshreg.errors import UsageError


@dataclass(frozen=True)
class SynthRequest:
    """Everything that `meshreg synth` was asked."""

    scenario: str
    out: Path
    format: str | None = None
    seed: int = 0
    size: float | None = None
    changes: Mapping[str, str] = field(default_factory=dict)
    overwrite: bool = False


def parse_changes(changes: Sequence[str] | None) -> dict[str, str]:
    """Split each "part.name=value"."""
    found = {}
    for change in changes or ():
        key, equals, value = change.partition("=")
        if not equals:
            raise UsageError(f"--set {change!r} has no '='.", remedy="Write part.name=value.")
        found[key.strip()] = value.strip()
    return found


def synth(request: SynthRequest, voice: Terminal) -> dict[str, Any]:
    """Make the pair and its truth; say where they are and what the truth is."""
    import json

    from data_synth.make import write_pair
    from data_synth.recipe import load

    recipe = load(request.scenario, request.changes)
    with Progress(voice) as progress:
        files = write_pair(
            recipe,
            request.out,
            request.seed,
            request.size,
            request.format,
            progress,
            request.overwrite,
        )
    truth = json.loads((request.out / "truth.json").read_text(encoding="utf-8"))
    return {
        "schema": "meshreg.synth/1",
        "scenario": truth["scenario"],
        "seed": truth["seed"],
        "files": [str(path) for path in files],
        "reference_from_moving": truth["reference_from_moving"],
        "centroid": truth["centroid"],
    }


def show(document: Mapping[str, Any], voice: Terminal) -> None:
    """Print what was made."""
    names = ", ".join(Path(file).name for file in document["files"][:12])
    more = len(document["files"]) - 12
    voice.say(
        f"Made {escape(document['scenario'])}, seed {document['seed']}: {escape(names)}"
        + (f" and {more} more" if more > 0 else "")
    )
    matrix, centroid = document["reference_from_moving"], document["centroid"]
    if matrix is None:
        voice.say("The surveys show different places: there is no true offset.")
        return
    offset = [
        sum(matrix[i][j] * centroid[j] for j in range(3)) + matrix[i][3] - centroid[i]
        for i in range(3)
    ]
    said = ", ".join(f"{o:+.4f}" for o in offset)
    voice.say(f"True offset at the overlap's centroid (east, north, up): {said} m")
