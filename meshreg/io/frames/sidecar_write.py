"""Write beside a survey what its coordinates do not say: shift, axes, unit, CRS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import OutputError
from meshreg.io.files.atomic import atomic_file
from meshreg.io.frames.axes import ENU, NED, UNITS, Y_UP
from meshreg.records import Frame


def write_shift(path: Path, frame: Frame, *, carries_crs: bool = False) -> tuple[Path, ...]:
    """Write beside `path` what its coordinates do not say themselves.

    `<stem>_offset.xyz` (as Pix4D, three numbers with 17 digits) where a shift is all there is to
    add; `<stem>.survey.toml` where axes, unit or CRS need saying too. Older ones of that name are
    replaced or removed, so that nothing stale is left to disagree.

    Parameters
    ----------
    path : Path
        The survey file.
    frame : Frame
    carries_crs : bool
        The format states its CRS itself.

    Returns
    -------
    tuple of Path
        Files written, perhaps none.
    """
    import tomli_w

    path = Path(path)
    stem = path.name[: -len(".copc.laz")] if path.name.endswith(".copc.laz") else path.stem
    offset, survey = path.with_name(f"{stem}_offset.xyz"), path.with_name(f"{stem}.survey.toml")
    said = _frame_words(frame)
    plain = not said
    if not carries_crs and (crs := frame.file_crs or frame.local) is not None:
        said["crs"] = crs
    shift = [float(value) for value in frame.shift]
    written = []
    if plain and any(shift):
        with atomic_file(offset) as temporary:
            temporary.write_text(" ".join(f"{value:.17g}" for value in shift) + "\n", "ascii")
        written.append(offset)
    else:
        _remove(offset)
    if said:
        with atomic_file(survey) as temporary:
            temporary.write_text(tomli_w.dumps({"shift": shift, **said}), "utf-8")
        written.append(survey)
    else:
        _remove(survey)
    return tuple(written)


def write_metadata(path: Path, frame: Frame) -> tuple[Path, ...]:
    """Write a metadata.xml beside `path`, as ContextCapture and DJI Terra read it.

    Programs that know no other side file open the survey where it lies by it.

    Parameters
    ----------
    path : Path
        The survey file.
    frame : Frame

    Returns
    -------
    tuple of Path
        Nothing where the file's axes or unit are others than that one may say, or its CRS is not
        known.
    """
    from xml.sax.saxutils import escape

    if frame.file_crs is None or _frame_words(frame):
        return ()
    origin = ",".join(f"{value:.17g}" for value in frame.shift)
    beside = path.with_name("metadata.xml")
    with atomic_file(beside) as temporary:
        temporary.write_text(
            '<?xml version="1.0" encoding="utf-8"?>\n<ModelMetadata version="1">\n'
            f"  <SRS>{escape(frame.file_crs)}</SRS>\n"
            f"  <SRSOrigin>{origin}</SRSOrigin>\n</ModelMetadata>\n",
            "utf-8",
        )
    return (beside,)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot be removed: {error.strerror}.", file=path) from error


def _frame_words(frame: Frame) -> dict[str, Any]:
    """Return `axes`, `up` and `unit` of a frame as a .survey.toml says them; empty if plain."""
    from meshreg.io.frames.crs import metres_per_unit

    length = float(np.cbrt(abs(np.linalg.det(frame.axes))))
    words: dict[str, Any] = {}
    for axes, word in ((ENU, {}), (NED, {"axes": "ned"}), (Y_UP, {"up": "y"})):
        if np.allclose(frame.axes, length * axes, rtol=1e-12, atol=0):
            words |= word
            break
    else:
        length = 1.0
        words["axes"] = [[float(value) for value in row] for row in frame.axes]
    metres = length * (metres_per_unit(frame.file_crs) if frame.file_crs else 1.0)
    if abs(length - 1) > 1e-12:
        names = [name for name, value in UNITS.items() if abs(value / metres - 1) < 1e-12]
        words["unit"] = names[0] if names else metres
    return words
