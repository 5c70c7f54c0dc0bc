"""Points picked with other programs: Metashape and ReefShape markers, TagLab tables and projects.

One file holds both surveys, or two are given as "reference.csv,moving.csv" and matched by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from meshreg.errors import InputError, UsageError
from meshreg.io.finding import split_pair
from meshreg.ties.foreign import KNOWN, Context, Named
from meshreg.ties.markers import is_markers, read_markers
from meshreg.ties.records import MAX_NAME, Point, TiePair, TiePoints
from meshreg.ties.table import is_ours, read_table, ties_from_rows
from meshreg.ties.taglab import is_taglab, read_annotations, read_project


def read_points(path: str | Path, context: Context | None = None) -> TiePoints:
    """Read pairs from any file that is known, or from two joined by a comma.

    Raises
    ------
    InputError
        A file that is none of these, or that has no two points of one name.
    UsageError
        More than two files, or pixels whose orthomosaic is not known.
    """
    context = context or Context()
    paths = (Path(path),) if Path(path).is_file() else split_pair(str(path))
    if len(paths) > 2:
        raise UsageError(f"{len(paths)} files of points were given.", remedy=KNOWN)
    if len(paths) == 2:
        return _from_two(paths[0], paths[1], context)
    return _from_one(paths[0], context)


def _from_one(path: Path, context: Context) -> TiePoints:
    if path.suffix.lower() == ".json":
        found = read_project(path, context)
        return _joined(path, found.first, found.second, context, found.notes)
    header, rows = read_table(path, is_ours)
    if header:
        return ties_from_rows(path, rows)
    found = _named(path, context, alone=True)
    if not found.second:
        raise InputError(
            "has the points of one survey only.",
            file=path,
            remedy='Give "reference.csv,moving.csv".',
        )
    return _joined(path, found.first, found.second, context, found.notes)


def _from_two(reference: Path, moving: Path, context: Context) -> TiePoints:
    first = _named(reference, context, side="reference")
    second = _named(moving, context, side="moving")
    notes = (*first.notes, *second.notes)
    return _joined(moving, first.first, second.first, context, notes)


def _joined(
    path: Path,
    reference: Mapping[str, Point],
    moving: Mapping[str, Point],
    context: Context,
    notes: tuple[str, ...],
) -> TiePoints:
    both = [name for name in reference if name in moving]
    if not both:
        some = ", ".join(sorted(set(reference) | set(moving))[:5])
        raise InputError(
            f"shares no name with the reference's points ({some} ...).", file=path, remedy=KNOWN
        )
    alone = len(set(reference) ^ set(moving))
    if alone:
        notes = (*notes, f"{alone} points have no partner of the same name and are left out.")
    pairs = (
        TiePair(k, name[:MAX_NAME], reference[name], moving[name]) for k, name in enumerate(both, 1)
    )
    return TiePoints(tuple(pairs), context.crs, notes)


def _named(path: Path, context: Context, side: str = "reference", alone: bool = False) -> Named:
    header, rows = read_table(path, is_taglab)
    if header:
        return read_annotations(path, header, rows, context, side, alone)
    header, rows = read_table(path, is_markers)
    if header:
        return read_markers(path, header, rows, context, alone)
    raise InputError("holds no points that are known here.", file=path, remedy=KNOWN)
