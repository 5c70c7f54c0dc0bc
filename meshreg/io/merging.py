"""Join the blocks that one survey was exported in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from meshreg.errors import InputError
from meshreg.io.frames.place import reframe
from meshreg.records import Maps, Mesh, PointCloud, Survey


def merge(surveys: Sequence[Survey], path: Any) -> Survey:
    """Join blocks into one survey, in one local origin and the first block's CRS.

    Raises
    ------
    InputError
        Blocks with and without CRS, of known and unknown scale, or of different kinds.
    """
    first = surveys[0]
    names = [survey.source[0].path.name if survey.source else survey.name for survey in surveys]
    for survey, name in zip(surveys, names, strict=True):
        for what in ("crs", "scale_known"):
            one, other = getattr(first, what), getattr(survey, what)
            if (one is None or one is False) != (other is None or other is False):
                raise InputError(
                    f"{names[0]} and {name} cannot be blocks of one survey: {what} is "
                    f"{one} and {other}.",
                    file=str(path),
                )
        if type(survey.geometry) is not type(first.geometry) or isinstance(survey.geometry, Maps):
            kinds = [type(item.geometry).__name__ for item in (first, survey)]
            raise InputError(
                f"{names[0]} ({kinds[0]}) and {name} ({kinds[1]}) cannot be merged.",
                file=str(path),
                remedy="Name blocks of one kind; maps are merged beforehand (gdalbuildvrt).",
            )
    if first.crs is not None:
        surveys = [reframe(survey, first.crs) for survey in surveys]
    ends = np.array([survey.bounds for survey in surveys])
    origin = np.round((ends[:, 0].min(axis=0) + ends[:, 1].max(axis=0)) / 2)
    notes: list[str] = []
    geometry = _joined(surveys, origin, notes)
    for survey, name in zip(surveys, names, strict=True):
        notes += [f"{name}: {note}" for note in survey.notes]
    dates = {survey.date for survey in surveys}
    return Survey(
        name=_common_name(surveys, path),
        geometry=geometry,
        origin=origin,
        crs=first.crs,
        date=dates.pop() if len(dates) == 1 else None,
        scale_known=first.scale_known,
        source=tuple(source for survey in surveys for source in survey.source),
        notes=tuple(notes),
    )


def require_apart(surveys: Sequence[Survey], path: Any) -> None:
    """Make sure that blocks found in folders of a folder lie beside each other.

    Two surveys of one place in the folders of a project are not blocks of one survey.

    Raises
    ------
    InputError
        Two of them cover the same ground: more than half of the smaller one's bounds.
    """
    ends = np.array([survey.bounds for survey in surveys])
    order = np.argsort(ends[:, 0, 0], kind="stable")
    for place, one in enumerate(order):
        low, high = ends[one]
        for other in order[place + 1 :]:
            if ends[other, 0, 0] >= high[0]:
                break
            both = np.minimum(high, ends[other, 1]) - np.maximum(low, ends[other, 0])
            sizes = np.minimum(high - low, ends[other, 1] - ends[other, 0])
            if (
                (both[:2] > 0).all()
                and both[2] >= 0
                and (both / np.fmax(sizes, 1e-9))[:2].prod() > 0.5
            ):
                names = [_place_of(surveys[index], path) for index in (one, other)]
                raise InputError(
                    f"holds folders with surveys of the same ground ({names[0]} and {names[1]}), "
                    "which are not blocks of one survey.",
                    file=str(path),
                    remedy="Name the one that is meant, or its tiles by a quoted pattern.",
                )


def _place_of(survey: Survey, path: Any) -> str:
    """Return where a block's file lies below the folder that was named."""
    file = survey.source[0].path
    try:
        return str(file.relative_to(path))
    except (ValueError, TypeError):
        return file.name


def _common_name(surveys: Sequence[Survey], path: Any) -> str:
    if isinstance(path, str | Path) and Path(path).is_dir():
        return Path(path).resolve().name
    same = 0
    for letters in zip(*(survey.name for survey in surveys), strict=False):
        if len(set(letters)) > 1:
            break
        same += 1
    return surveys[0].name[:same].rstrip("_-. ") or surveys[0].name


def _joined(surveys: Sequence[Survey], origin: Any, notes: list[str]) -> Mesh | PointCloud:
    parts = [cast(Mesh | PointCloud, survey.geometry) for survey in surveys]
    points = np.concatenate(
        [part.points + (s.origin - origin) for part, s in zip(parts, surveys, strict=True)]
    )
    colors = [part.colors for part in parts if part.colors is not None]
    if 0 < len(colors) < len(parts):
        notes.append(f"Colors were left out: only {len(colors)} of {len(parts)} files have them.")
    joined = np.concatenate(colors) if len(colors) == len(parts) else None
    if isinstance(parts[0], PointCloud):
        return PointCloud(points, joined)
    return _joined_mesh(cast(list[Mesh], parts), points, joined)


def _joined_mesh(parts: Sequence[Mesh], points: Any, colors: Any) -> Mesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    if starts[-1] > np.iinfo(np.int32).max:
        raise InputError(f"the blocks have {starts[-1]} vertices together; 2^31 are too many.")
    faces = np.concatenate(
        [part.faces + np.int32(start) for part, start in zip(parts, starts, strict=False)]
    )
    textures = tuple(texture for part in parts for texture in part.textures)
    if all(part.uv is None for part in parts):
        return Mesh(points, faces, colors)
    uv, pages, count = [], [], 0
    for part in parts:
        if part.uv is None or part.face_texture is None:
            uv.append(np.zeros((len(part.faces), 3, 2), np.float32))
            pages.append(np.full(len(part.faces), -1, np.int32))
        else:
            uv.append(part.uv)
            pages.append(np.where(part.face_texture >= 0, part.face_texture + np.int32(count), -1))
        count += len(part.textures)
    return Mesh(points, faces, colors, np.concatenate(uv), np.concatenate(pages), textures)
