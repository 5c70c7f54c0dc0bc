"""What hints at a place on Earth, but has no agreed meaning: named, never applied."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshreg.io.files.safe import decode_name, open_regular
from meshreg.records import Float64, Frame

_HEAD = 1 << 13  # bytes looked at
_FEW = 3  # notes on one file
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SHIFT = re.compile(
    rf"(?i)(?:shift|offset|origin|translat\w*|cent(?:er|re)|georef\w*)\b[^\d+\-.]*?"
    rf"(?<![\w.])({_NUMBER})[\s,;xyzXYZ:=]+({_NUMBER})[\s,;xyzXYZ:=]+({_NUMBER})"
)
_CRS = re.compile(r"(?i)\bEPSG\s*[:=]*\s*(\d{4,6})\b|\bUTM\s+(?:zone\s+)?(\d{1,2}\s*[NS])\b")
_EARTH = (6.33e6, 6.40e6)  # radii [m] of places at the surface; the deep sea and peaks included
_HIGHEST = 2e4  # no height or depth is that large [m]


def unapplied_notes(path: Path, frame: Frame, centre: Float64) -> tuple[str, ...]:
    """Name what a file of local coordinates hints at.

    Parameters
    ----------
    path : Path
        A file of text, or with a header of text, whose comments are looked at.
    frame : Frame
        That it was read in; without a shift.
    centre : (3,) float64
        Of its coordinates, as stored.

    Returns
    -------
    tuple of str
        One sentence each: a shift or a CRS in a comment, coordinates that look geocentric.
    """
    notes = []
    if frame.file_crs is None and _looks_geocentric(centre):
        notes.append(
            "The coordinates look geocentric (x, y, z from the Earth's centre), but no CRS says "
            'so: they were taken as east, north, up. If they are, say crs = "EPSG:4978".'
        )
    for text in _comments(path):
        if found := _SHIFT.search(text):
            values = [float(word) for word in found.groups()]
            if max(map(abs, values)) >= 1:
                notes.append(
                    f"A comment in its header says {text[:100]!r}; it is not applied. If that was "
                    "taken off the coordinates, give it as the shift."
                )
        elif frame.file_crs is None and _CRS.search(text):
            notes.append(f"A comment in its header says {text[:100]!r}; it is not applied.")
    return tuple(notes[:_FEW])


def _looks_geocentric(centre: Float64) -> bool:
    radius = float(np.linalg.norm(centre))
    return _EARTH[0] < radius < _EARTH[1] and abs(float(centre[2])) > _HIGHEST


def _comments(path: Path) -> list[str]:
    """Return the comments at the head of a text file or of a PLY, without their marks."""
    if path.suffix.lower() not in (".obj", ".off", ".ply", ".xyz", ".txt", ".csv", ".asc", ".pts"):
        return []
    if not path.is_file():  # points from elsewhere, as under this name
        return []
    with open_regular(path) as stream:
        head = stream.read(_HEAD)
    if head.startswith(b"ply"):
        lines = head.split(b"end_header")[0].splitlines()
        marked = [re.sub(rb"^\s*(?:comment|obj_info)\s", b"#", line) for line in lines]
    else:
        marked = [line.lstrip() for line in head.splitlines()]
    texts = [line.lstrip(b"#/ \t") for line in marked if line.startswith((b"#", b"//"))]
    return [" ".join(decode_name(text).split()) for text in texts]
