"""Sections on where it comes from: methods to paste, surveys, settings, log, files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from meshreg.report import charts, words
from meshreg.report import markup as m
from meshreg.report.markup import number, say
from meshreg.report.result import Result, name_of

_LOG_CHARACTERS = 60_000
_FILES = (
    (r"registration\.json", "everything that was found, for programs"),
    (r"transform_inverse\w*\.txt", "4 × 4 matrix, the way back"),
    (r"transform_global\.txt", "4 × 4 matrix in absolute coordinates"),
    (r"transform\w*\.txt", "4 × 4 matrix, moving file to reference file"),
    (r"reference_dem\.tif", "elevation of the reference"),
    (r"reference_ortho\.tif", "orthomosaic of the reference"),
    (r"moving_dem\.tif", "elevation of the registered survey, on the same cells"),
    (r"moving_ortho\.tif", "orthomosaic of the registered survey, on the same cells"),
    (r"settings\.toml", "all settings, to do it again"),
    (r"evidence\.npz", "what this page is drawn from"),
    (r"log\.txt", "what was done, step by step"),
    (r"validation\..*", "held against tie points picked by hand"),
    (r"figures/.*", "a figure of this page, to print"),
    (r".*_registered\.survey\.toml", "how to read the registered survey"),
    (r".*_registered_offset\.xyz", "what to add to the registered survey's coordinates"),
    (r".*_registered\.[a-z0-9]+", "the moving survey, registered"),
)


def methods(result: Result) -> str:
    """Return the paragraph to paste into a paper."""
    text = say(words.methods_paragraph(result.registration))
    button = '<button type="button" class="js-only screen-only" data-copy="paste">Copy</button>'
    return m.section(
        "methods", "Methods, ready to paste", "", f'<p class="paste" id="paste">{text}</p>', button
    )


def surveys(result: Result) -> str:
    """Return what went in: files, counts, checksums, and where both surveys lie."""
    r = result.registration
    rows = []
    for label, entry in (("reference", r.reference), ("moving", r.moving)):
        counts = ", ".join(f"{v:,} {k}" for k, v in (entry.get("counts") or {}).items() if v)
        shift = ", ".join(f"{float(v) + 0.0:.10g}" for v in entry.get("shift") or ())
        sums = " ".join(entry.get("sha256") or ())
        rows.append(
            (label, entry.get("name", ""), ", ".join(entry.get("path") or ()), counts,
             entry.get("crs") or "local", shift, sums)
        )  # fmt: skip
    head = ("", "name", "files", "counts", "CRS", "shift [m]", "SHA-256")
    upright = [(head[k], *(row[k] for row in rows)) for k in range(1, len(head))]
    table = m.table(("", "reference", "moving"), upright, look="upright")
    notes = [
        *r.notes,
        *(f"{name_of(e)}: {n}" for e in (r.reference, r.moving) for n in e.get("notes") or ()),
    ]
    listed = "".join(f"<li>{say(note)}</li>" for note in notes)
    said = f'<h3>Notes</h3><ul class="notes">{listed}</ul>' if listed else ""
    said = f"<div>{said}</div>" if said else ""
    return m.section("surveys", "The surveys", "", table, m.columns(_extents(result), said))


def _extents(result: Result) -> str:
    r = result.registration
    boxes: list[tuple[str, str, Any]] = []
    for name, entry in (("reference", r.reference), ("before", r.moving)):
        bounds = np.array(entry.get("bounds") or np.nan, float)
        if bounds.shape != (2, 3) or not np.isfinite(bounds).all():
            return ""
        boxes.append((name, name, bounds))
    if r.transform is not None:
        corners = np.stack(np.meshgrid(*boxes[1][2].T, indexing="ij"), axis=-1).reshape(-1, 3)
        moved = r.transform.apply(corners)
        boxes.append(("after", "after", np.stack([moved.min(axis=0), moved.max(axis=0)])))
    caption = "Bounding boxes: reference blue, moving survey grey as delivered"
    caption += ", orange registered." if r.transform is not None else "."
    return m.figure(f"<h3>Where the surveys lie</h3>{charts.extents(boxes)}", caption)


def record(result: Result) -> str:
    """Return settings, versions, times, log and files."""
    r = result.registration
    settings = "".join(f"{key} = {value}\n" for key, value in _flat(r.settings))
    versions = m.table(("", "version"), [(k, v) for k, v in r.versions.items()])
    seconds = m.table(
        ("", "seconds"),
        [(k.replace("_", " "), number(v, ".2f")) for k, v in r.seconds.items()],
        (1,),
    )
    files = m.table(
        ("file", "size"),
        [(_file(name), _size(size)) for name, size in result.files],
        (1,),
        "files",
    )
    log = result.log
    if len(log) > _LOG_CHARACTERS:
        log = "…\n" + log[-_LOG_CHARACTERS:]
    parts = [
        f"<h3>Files of this result</h3>{files}" if result.files else "",
        f"<details data-print><summary>Settings</summary><pre>{say(settings)}</pre></details>",
        "<details data-print><summary>Versions and times</summary>"
        f"{m.columns(versions, seconds)}</details>",
        f"<details><summary>Log</summary><pre>{say(log)}</pre></details>" if log else "",
    ]
    return m.section("record", "Record", "", *parts)


def _file(name: str) -> m.Markup:
    """Return a link to a file of the result, and what it is where that is known."""
    said = next((said for pattern, said in _FILES if re.fullmatch(pattern, name)), "")
    return m.Markup(m.link(name) + (f" <small>{say(said)}</small>" if said else ""))


def _flat(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    lines: list[tuple[str, Any]] = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            lines += _flat(value, f"{prefix}{key}.")
        else:
            lines.append((f"{prefix}{key}", value))
    return lines


def _size(size: int) -> str:
    for unit, times in (("MB", 1e6), ("kB", 1e3)):
        if size >= times:
            return f"{size / times:.1f} {unit}"
    return f"{size} B"
