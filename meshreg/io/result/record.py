"""The folder of a result: `registration.json`, transforms, maps, the registered survey."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.io.result.document import read_registration, registration_document, to_json
from meshreg.records import (
    Frame,
    PointCloud,
    Registration,
    SourceFile,
    Survey,
    Transform,
)

__all__ = [
    "matrix_text",
    "read_registration",
    "reference_stand_in",
    "registration_document",
    "to_json",
    "with_frames",
    "write_record_files",
    "write_registration",
]


def write_registration(
    registration: Registration,
    folder: str | Path,
    *,
    reference: Survey | None = None,
    moving: Survey | None = None,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write a result's folder, whole or not at all: record, transforms, maps, registered survey.

    Parameters
    ----------
    registration : Registration
    folder : path
        Must not exist, unless `overwrite` and it holds a former result and nothing else.
    reference, moving : Survey, optional
        As read from their files. Without them there are no transforms between file coordinates,
        and no registered survey.
    overwrite : bool

    Returns
    -------
    tuple of Path
        The files written.

    Raises
    ------
    UsageError
        If the folder exists and may not be replaced.
    OutputError
        If a file could not be written or did not read back as it should.
    """
    from meshreg.io.result.folders import atomic_folder
    from meshreg.io.result.manifest import NAME, require_apart, survey_files

    folder = Path(folder)
    require_apart(folder, survey_files(*(s for s in (reference, moving) if s is not None)))
    with atomic_folder(folder, overwrite, command="register") as partial:
        files = write_record_files(registration, partial, reference=reference, moving=moving)
        names = [path.relative_to(partial) for path in files]
    return (*(folder / name for name in names), folder / NAME)


def write_record_files(
    registration: Registration,
    folder: Path,
    *,
    reference: Survey | None = None,
    moving: Survey | None = None,
    moved: Callable[[], tuple[Path, ...]] | None = None,
) -> tuple[Path, ...]:
    """Write what `write_registration` does into a folder that is there (and not yet final).

    `moved` waits for the files of the registered survey, where they are being written already.
    """
    import tomli_w

    registration = with_frames(registration, reference, moving)
    written = [_write_text(folder / "settings.toml", tomli_w.dumps(dict(registration.settings)))]
    written += _write_maps(registration, folder, reference)
    transform = registration.transform
    if transform is not None:
        text = matrix_text(transform.matrix)
        written.append(_write_text(folder / "transform_global.txt", text))
        if reference is not None and moving is not None:
            written += _write_file_transforms(transform, folder, reference, moving)
        if moving is not None and moving.source:
            from meshreg.io.blocks import rewrite

            warp = registration.warp
            moved = moved or partial(
                rewrite, moving, transform, folder, reference, "_registered", warp
            )
            written += moved()
    text = to_json(registration_document(registration))
    written.append(_write_text(folder / "registration.json", text))
    return tuple(written)


def with_frames(
    registration: Registration, reference: Survey | None, moving: Survey | None
) -> Registration:
    """Return the record with the axes and the CRS of both surveys' first files.

    Without them `meshreg apply` could not write a further file in the reference's coordinates.
    """

    def entry(said: Mapping[str, Any], survey: Survey | None) -> dict[str, Any]:
        if survey is None or not survey.source:
            return dict(said)
        frame = survey.source[0].frame
        return {**said, "axes": frame.axes.tolist(), "file_crs": frame.file_crs}

    return replace(
        registration,
        reference=entry(registration.reference, reference),
        moving=entry(registration.moving, moving),
    )


def _write_text(path: Path, text: str) -> Path:
    from meshreg.io.files.atomic import as_output_error

    with as_output_error(path):
        path.write_text(text, encoding="utf-8")
    return path


def _write_maps(registration: Registration, folder: Path, reference: Survey | None) -> list[Path]:
    """Write both surveys after registration, on one grid; a rejected pair has none to show."""
    from meshreg.io.maps.pair import local_crs, write_raster

    written: list[Path] = []
    if registration.transform is None:
        return written
    for name in ("reference_dem", "moving_dem", "reference_ortho", "moving_ortho"):
        raster = registration.evidence.get(name)
        is_height = name.endswith("dem")
        if raster is None or not (is_height or raster.color_valid.any()):
            continue
        path = folder / f"{name}.tif"
        write_raster(raster, path, "height" if is_height else "color", local_crs(reference))
        written.append(path)
    return written


def _write_file_transforms(
    transform: Transform, folder: Path, reference: Survey, moving: Survey
) -> list[Path]:
    """Write `transform.txt` and its inverse: the moving FILE's coordinates to the reference's.

    A warp is not in them: four lines of four numbers cannot say it.

    Blocks of one survey share their frame; where they do not, each other frame gets a pair of
    files of its own, named after its first block.
    """
    from meshreg.io.frames.place import make_mover, to_file

    if not reference.source or not moving.source:
        return []
    home = reference.source[0].frame
    written: list[Path] = []
    done: list[Any] = []
    for source in moving.source:
        start = source.frame
        key = (start.axes.tolist(), start.shift.tolist(), start.file_crs)
        if key in done:
            continue
        end = f"_{source.path.stem}" if done else ""
        done.append(key)
        if start.crs is not None and moving.crs is not None and start.crs != moving.crs:
            start = replace(start, crs=moving.crs)
        centre = to_file(start, moving.centre[None])[0]
        matrix = make_mover(source, transform, home, centre=centre).matrix
        for name, rows in (("transform", matrix), ("transform_inverse", np.linalg.inv(matrix))):
            written.append(_write_text(folder / f"{name}{end}.txt", matrix_text(rows)))
    return written


def matrix_text(matrix: Any) -> str:
    """Return a 4×4 matrix as CloudCompare reads it: four lines of four numbers, fixed notation.

    15 decimals: a rotation's 12th decimal is 6 µm at a UTM northing.
    """
    rows = np.asarray(matrix, float) + 0.0  # no negative zeros
    return "".join(" ".join(f"{value:.15f}" for value in row) + "\n" for row in rows)


def reference_stand_in(registration: Registration) -> Survey | None:
    """Return a survey of one point with the frame of the reference file, for `rewrite_survey`.

    None for a record that does not tell the frame: moved files then keep their own.
    """
    entry = registration.reference
    shift, axes = entry.get("shift"), entry.get("axes")
    if shift is None or axes is None:
        return None
    frame = Frame(axes, shift, entry.get("file_crs"), entry.get("crs"))
    name = (entry.get("path") or ["reference"])[0]
    source = SourceFile(Path(name), "reference", frame)
    return Survey(
        entry.get("name") or "reference",
        PointCloud(np.zeros((1, 3))),
        crs=entry.get("crs"),
        source=(source,),
    )
