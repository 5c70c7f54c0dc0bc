"""TagLab's tables of annotations, and the markers in its projects.

Annotations (`TagLab Centroid x`, in pixels of the orthomosaic) are matched by Genet Id, else by the
note. A project file holds the markers of the alignment tool, in millimetres from the image's corner
by the scale that the project states.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError
from meshreg.ties.foreign import KNOWN, Context, Named, first_of, metres, place
from meshreg.ties.records import MAX_PAIRS, Point
from meshreg.ties.table import read_text

_TAGLAB = ("taglab centroid x", "taglab centroid y")
_GENET = ("taglab genet id", "taglab genet")
_MAX_PROJECT = 256_000_000  # bytes; TagLab's projects hold the outline of every colony


def is_taglab(names: Sequence[str]) -> bool:
    """Whether a line's names are those of a table of annotations."""
    return set(_TAGLAB) <= set(names)


def read_annotations(
    path: Path,
    header: Sequence[str],
    rows: Sequence[Any],
    context: Context,
    side: str,
    alone: bool,
) -> Named:
    """Read annotations; in one file the first image named is the reference's."""
    genet, note = first_of(header, _GENET), first_of(header, ("taglab note",))
    images = list(dict.fromkeys(row.get("image name", "") for _, row in rows))
    if alone and len(images) != 2:
        raise InputError(
            f"has the annotations of {len(images)} image(s), not of two.",
            file=path,
            remedy='Give "reference.csv,moving.csv".',
        )
    found: list[dict[str, Point]] = [{}, {}]
    doubled: set[str] = set()
    for line, row in rows:
        name = _taglab_name(row, genet, note)
        point = place(path, line, row, _TAGLAB)
        if not name or point is None:
            continue
        target = found[images.index(row.get("image name", "")) if alone else 0]
        if name in target:
            doubled.add(name)
        target[name] = point
    notes: tuple[str, ...] = ()
    if doubled:  # a colony that split: which part is meant is not said
        notes = (f"{path.name}: {len(doubled)} names stand twice and are left out.",)
    sides = ("reference", "moving") if alone else (side, side)
    first, second = (
        metres({n: p for n, p in points.items() if n not in doubled}, which, context)
        for points, which in zip(found, sides, strict=True)
    )
    return Named(first, second, notes)


def _taglab_name(row: Mapping[str, str], genet: str | None, note: str | None) -> str:
    number_ = row[genet].strip().removesuffix(".0") if genet else ""
    if number_ not in ("", "0", "-1", "nan"):
        return f"genet {number_}"
    return row[note].strip() if note else ""


def read_project(path: Path, context: Context) -> Named:
    """Read the markers that TagLab's alignment tool keeps in its project, if of one pair only."""
    text = read_text(path, _MAX_PROJECT)
    try:
        document = json.loads(text)
        found = [
            (names, entry["markers"])
            for first, others in document["markers"].items()
            for names, entry in (((first, second), entry) for second, entry in others.items())
        ]
        if len(found) != 1:
            raise InputError(f"holds the markers of {len(found)} pairs of images.", file=path)
        names, markers = found[0]
        sides = []
        for side, name in zip(("ref", "coreg"), names, strict=True):
            size = _pixel_size(document, name)
            places = [(float(p["x"]) / size, float(p["y"]) / size) for p in markers[side]]
            if not np.isfinite(np.array(places)).all():
                raise ValueError("a marker is nowhere")
            sides.append({f"marker {k}": place for k, place in enumerate(places, 1)})
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        OverflowError,
        RecursionError,
    ) as error:
        raise InputError(
            f"is not a TagLab project with markers ({error}).", file=path, remedy=KNOWN
        ) from error
    if max(map(len, sides)) > MAX_PAIRS:
        raise InputError(f"has {len(sides[0])} markers; {MAX_PAIRS} are the limit.", file=path)
    reference, moving = (
        metres(points, side, context)
        for points, side in zip(sides, ("reference", "moving"), strict=True)
    )
    note = (
        f"{path.name}: {names[0]!r} is taken as the reference, {names[1]!r} as the moving survey."
    )
    return Named(reference, moving, (note,))


def _pixel_size(document: Mapping[str, Any], name: str) -> float:
    """Millimetres of a pixel of an image of TagLab's project, in which its markers are counted."""
    for image in document["images"]:
        if name in (image.get("id"), image.get("name")):
            size = float(image.get("map_px_to_mm_factor", 1.0))
            if not 0 < size < math.inf:
                raise ValueError(f"the pixels of {name!r} have a size of {size} mm")
            return size
    raise ValueError(f"there is no image {name!r}")
