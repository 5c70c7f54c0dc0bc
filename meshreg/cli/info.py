"""What is in a survey file, and what of it had to be guessed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from meshreg.io.assemble import texel_size
from meshreg.pipeline import level_axes, posture
from meshreg.records import Float64, Maps, Mesh, PointCloud, Survey

if TYPE_CHECKING:
    from meshreg.cli.console import Terminal

LEVEL = 10.0  # degrees of tilt from which a survey is said not to be level
_SAMPLE = 500_000


def describe(survey: Survey) -> dict[str, Any]:
    """Return counts, bounds, spacing, texture pages, CRS, and the guesses, as plain values."""
    low, high = survey.bounds
    geometry = survey.geometry
    tilt, thin = plane(survey)
    document: dict[str, Any] = {
        "schema": "meshreg.info/1",
        "name": survey.name,
        "date": survey.date,
        "kind": {Mesh: "mesh", PointCloud: "point cloud", Maps: "maps"}[type(geometry)],
        "files": [
            {
                "path": str(source.path),
                "format": source.format,
                "sha256": source.sha256,
                "counts": dict(source.counts),
                "shift": source.frame.shift.tolist(),
                "axes": source.frame.axes.tolist(),
                "sidecar": None if source.sidecar is None else str(source.sidecar),
            }
            for source in survey.source
        ],
        "counts": _counts(geometry),
        "bounds": {"low": low.tolist(), "high": high.tolist()},
        "size": (high - low).tolist(),
        "spacing": _spacing(survey),
        "textures": _textures(geometry),
        "crs": survey.crs,
        "scale_known": survey.scale_known,
        "up": {"guess": thin, "tilt_degrees": tilt, "level": bool(tilt <= LEVEL)},
        "unit": _unit(survey),
        "notes": [*survey.notes, *remarks(survey, tilt, thin)],
    }
    return document


def _counts(geometry: Mesh | PointCloud | Maps) -> dict[str, int]:
    if isinstance(geometry, Maps):
        counts = {"cells with height": int(np.isfinite(geometry.height).sum())}
        if geometry.color_valid is not None:
            counts["cells with color"] = int(geometry.color_valid.sum())
        return counts
    if isinstance(geometry, PointCloud):
        return {"points": len(geometry.points)}
    return {
        "vertices": len(geometry.vertices),
        "faces": len(geometry.faces),
        "texture pages": len(geometry.textures),
    }


def _textures(geometry: Mesh | PointCloud | Maps) -> list[dict[str, Any]]:
    if not isinstance(geometry, Mesh):
        return []
    faces = np.zeros(len(geometry.textures), int)
    if geometry.face_texture is not None and len(geometry.textures):
        used = geometry.face_texture[geometry.face_texture >= 0]
        faces = np.bincount(used, minlength=len(geometry.textures))
    return [
        {"name": page.name, "width": page.size[0], "height": page.size[1], "faces": int(count)}
        for page, count in zip(geometry.textures, faces, strict=True)
    ]


def _spacing(survey: Survey) -> dict[str, float | None]:
    """Typical distance between neighbours [m]: mesh edges, points of a cloud, cells, texels."""
    geometry = survey.geometry
    if isinstance(geometry, Maps):
        color = None if geometry.color_grid is None else geometry.color_grid.cell
        return {"height cell": geometry.height_grid.cell, "color cell": color}
    if isinstance(geometry, PointCloud):
        return {"points": _point_spacing(geometry.points)}
    if len(geometry.faces) == 0:
        return {"edges": None}
    faces = geometry.faces[:: max(1, len(geometry.faces) // _SAMPLE)]
    corners = geometry.vertices[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    spacing: dict[str, float | None] = {"edges": float(np.median(edges))}
    if geometry.uv is not None and geometry.face_texture is not None and geometry.textures:
        spacing["texels"] = texel_size(geometry)
    return spacing


def _point_spacing(points: Float64) -> float | None:
    """Side of the square that each point has to itself, seen from above."""
    if len(points) < 2:
        return None
    low, high = np.percentile(points[:, :2], [1, 99], axis=0)  # floaters lie far off
    side = float(np.sqrt(np.prod(np.maximum(high - low, 1e-9)) / len(points)))
    # Holes and ragged edges: count only the ground that has points, in fields of some 16 points.
    field = 4 * side
    index = np.floor((points[:, :2] - low) / field).astype(np.int64)
    index -= index.min(axis=0)
    occupied = len(np.unique(index[:, 0] * (index[:, 1].max() + 1) + index[:, 1]))
    return float(np.sqrt(occupied * field**2 / len(points)))


def plane(survey: Survey) -> tuple[float, str]:
    """Return the tilt [degrees] of the plane that fits best, and the axis it is most normal to."""
    if isinstance(survey.geometry, Maps):
        return 0.0, "z"
    lying = posture(survey)
    return lying.dip, lying.thin


def _unit(survey: Survey) -> str:
    if not survey.scale_known:
        return "arbitrary (scale unknown)"
    return "m (stated by the CRS)" if survey.crs else "m (assumed; --unit says otherwise)"


def remarks(survey: Survey, tilt: float, thin: str) -> list[str]:
    """Say what the tilt (if over `LEVEL`, first of all) and the coordinates make doubtful."""
    said = []
    if tilt > LEVEL:
        remark = f"Not level: the plane that fits best is tilted by {tilt:.1f} degrees."
        if remedy := level_axes(survey):
            remark += f" It would lie level if it were read with {remedy}: try it."
        else:
            remark += " Level it, or place it by camera positions, before registering."
        said.append(remark)
    if survey.crs is None and float(np.abs(survey.bounds[:, :2]).max()) > 1e5:
        said.append("Coordinates look projected (UTM or the like), but no CRS is stated.")
    return said


def show(document: dict[str, Any], voice: Terminal) -> None:
    """Print the description as a table."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")

    def row(name: str, text: str) -> None:
        table.add_row(name, escape(text))

    row("survey", f"{document['name']} ({document['kind']})")
    if document["date"]:
        row("date", document["date"])
    for file in document["files"]:
        counts = ", ".join(
            f"{number:,} {name}" for name, number in file["counts"].items() if number
        )
        row("file", f"{file['path']} ({file['format']}{': ' + counts if counts else ''})")
        if any(file["shift"]):
            origin = f" from {file['sidecar']}" if file["sidecar"] else ""
            row("shift", f"{_triple(file['shift'])}{origin}")
    row("counts", ", ".join(f"{number:,} {name}" for name, number in document["counts"].items()))
    row("lowest", _triple(document["bounds"]["low"]))
    row("highest", _triple(document["bounds"]["high"]))
    row("size", _triple(document["size"]))
    spacing = (f"{k} {v:.4g} m" for k, v in document["spacing"].items() if v is not None)
    row("spacing", ", ".join(spacing) or "unknown")
    for page in document["textures"]:
        size = f"{page['width']} × {page['height']}"
        row("texture", f"{page['name']} {size}, {page['faces']:,} faces")
    row("CRS", _first_line(document["crs"]) if document["crs"] else "none stated: a local frame")
    row("unit", document["unit"])
    up = document["up"]
    level = "level" if up["level"] else "NOT level"
    row(
        "up axis",
        f"{up['guess']} (thinnest that way), tilted by {up['tilt_degrees']:.1f}°: {level}",
    )
    for note in document["notes"]:
        row("note", note)
    voice.out.print(table)


def _triple(values: Any) -> str:
    east, north, up = (float(value) for value in values)
    return f"east {east:.3f}, north {north:.3f}, up {up:.3f} m"


def _first_line(text: str) -> str:
    return text.splitlines()[0] if text else text
