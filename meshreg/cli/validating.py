"""`meshreg validate`: a registration against points picked by hand."""

from __future__ import annotations

import dataclasses
import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from meshreg.cli.common import LOG, in_place
from meshreg.cli.console import Terminal
from meshreg.errors import InputError, OutputError, UsageError

if TYPE_CHECKING:
    from meshreg.pipeline import Manual
    from meshreg.records import Float64, OffsetEstimate, Registration, Survey, Transform
    from meshreg.settings import Settings
    from meshreg.ties.foreign import Context, ToMetres
    from meshreg.ties.placing import Placing
    from meshreg.ties.records import TiePoints

_DASH = "–"
PAGES = ("validation.html", "validation.json")


@dataclass(frozen=True)
class ValidateRequest:
    """Everything that `meshreg validate` was asked."""

    out: Path
    ties: str
    reference_ortho: Path | None = None
    moving_ortho: Path | None = None
    radius: float = 0.20
    seed: int = 0


def validate(request: ValidateRequest) -> tuple[dict[str, Any], str]:
    """Compare, write validation.json, .html and figures into OUT, say so in its report.html."""
    from meshreg.io.result.document import read_registration, to_json
    from meshreg.io.result.manifest import require_ours, write_into
    from meshreg.ties.figure import draw_validation
    from meshreg.ties.page import sentence, validation_page
    from meshreg.ties.placing import read_placing
    from meshreg.ties.validate import validate as compare

    if not 0 < request.radius <= 1000:
        raise UsageError(f"--radius is {request.radius}; it must be over 0 and at most 1000 m.")
    if not request.out.is_dir():
        raise UsageError(
            "is not a folder.",
            file=request.out,
            remedy="Give the one that `meshreg register` wrote.",
        )
    require_ours(request.out, (*PAGES, "report.html"))
    registration = read_registration(request.out)
    placing = None if registration.transform is None else read_placing(request.out)
    ties, about = read_pairs(request, registration, placing)
    validation = compare(
        registration,
        ties,
        placing,
        radius=request.radius,
        seed=request.seed,
        overlap=_overlap(request.out),
        about=about,
        turned=_turned(request.out),
    )
    document = {**validation.document, "said": sentence(validation.document)}
    drawn = {name: _png(figure) for name, figure in draw_validation(validation).items()}
    names = tuple(
        str(getattr(registration, which).get("name") or which) for which in ("reference", "moving")
    )
    page = validation_page(document, drawn, names)  # type: ignore[arg-type]
    pictures = {f"figures/{name}.png": picture for name, picture in drawn.items()}
    require_ours(request.out, tuple(pictures))
    pages = (page.encode("utf-8"), to_json(document).encode("utf-8"))
    with in_place():
        write_into(request.out, {**pictures, **dict(zip(PAGES, pages, strict=True))})
        missing = remake_report(request.out)
    return document, missing


def read_pairs(
    request: ValidateRequest, registration: Registration, placing: Placing | None
) -> tuple[TiePoints, dict[str, Any]]:
    """Read the pairs in whatever form they come; pixels by the orthomosaics that they are of."""
    from meshreg.ties.formats import read_points

    context = _context(request, registration, placing)
    ties = read_points(request.ties, context)
    _require_crs(request.ties, ties, context.crs)
    about = about_files(request.ties)
    part = any(digest in note for digest in about["sha256"] for note in registration.notes)
    if part:  # `read_manual` noted the checksum
        note = "These pairs took part in the registration (--ties): they do not check it."
        ties = dataclasses.replace(ties, notes=(*ties.notes, note))
    return ties, {**about, "independent": not part}


def about_files(ties: str) -> dict[str, Any]:
    """Names and checksums of the files that pairs come from."""
    from meshreg.io.files.safe import sha256
    from meshreg.io.finding import split_pair

    paths = (Path(ties),) if Path(ties).is_file() else split_pair(ties)
    return {"files": [p.name for p in paths], "sha256": [sha256(p) for p in paths]}


def read_manual(
    ties: str | None, reference: Survey, settings: Settings
) -> tuple[Manual | None, list[str]]:
    """Read tie points as one more answer, marked as a person's, and say where it comes from."""
    if ties is None:
        return None, []
    from meshreg.ties import ties_estimate
    from meshreg.ties.foreign import Context
    from meshreg.ties.formats import read_points
    from meshreg.ties.validate import require_inside

    points = read_points(ties, Context(reference.crs))
    _require_crs(ties, points, reference.crs)
    require_inside("reference", reference.bounds, points.arrays()[0])
    about = about_files(ties)
    said = f"{len(points.complete)} tie points were picked by hand ({', '.join(about['files'])}"

    def manual(motion: Transform | None) -> OffsetEstimate:
        return ties_estimate(points, settings.sift, settings.seed, motion)

    return manual, [f"{said}, SHA-256 {', '.join(about['sha256'])}).", *points.notes]


def _require_crs(ties: str, points: TiePoints, crs: str | None) -> None:
    if points.pairs and points.crs != crs:
        raise UsageError(
            f"is in {points.crs or 'a local frame'}, the surveys are in {crs or 'a local frame'}.",
            file=ties,
            remedy="Give the pairs of these two surveys.",
        )


def _context(
    request: ValidateRequest, registration: Registration, placing: Placing | None
) -> Context:
    from meshreg.ties.foreign import Context

    pixels = {}
    for side, said in (("reference", request.reference_ortho), ("moving", request.moving_ortho)):
        path = said or request.out / f"{side}_ortho.tif"
        if not path.is_file() and said is None:
            continue
        flat = _pixels(path)
        own = side == "moving" and said is None
        # OUT's own moving picture is of the registered survey: back to where it was delivered
        pixels[side] = _delivered(placing, flat) if own and placing is not None else flat
    return Context(registration.reference.get("crs"), pixels)


def _delivered(placing: Placing, flat: ToMetres) -> ToMetres:
    return lambda points: placing.to_moving(flat(points))


def _pixels(path: Path) -> ToMetres:
    from meshreg.io.maps.geotiff import lattice, opened

    with opened(path, 1 << 62) as dataset:
        matrix = lattice(dataset, path)

    def to_metres(points: Float64) -> Float64:
        return np.asarray(points @ matrix[:, :2].T + matrix[:, 2])

    return to_metres


def _turned(out: Path) -> tuple[float, float] | None:
    """Degrees and scale by which the survey was turned before the methods looked at it."""
    from meshreg.io.result.evidence import read_evidence

    try:
        turned = read_evidence(out).get("meta", {}).get("turned")
        return None if turned is None else (float(turned["yaw_degrees"]), float(turned["scale"]))
    except (InputError, AttributeError, KeyError, TypeError, ValueError) as error:
        LOG.warning("the evidence is not looked at: %s", error)
        return None


def _overlap(out: Path) -> Float64 | None:
    """Places that both pictures of the result show; None where it has none."""
    from meshreg.ties.tiles import TileSource, overlap_points

    paths = [out / f"{which}_ortho.tif" for which in ("reference", "moving")]
    if not all(path.is_file() for path in paths):
        return None
    reference, moving = (TileSource(path) for path in paths)
    try:
        return overlap_points(reference, moving, lambda points: points)
    finally:
        reference.close()
        moving.close()


def remake_report(out: Path) -> str:
    """Make OUT/report.html again, so that it leads to the comparison; its failure loses nothing.

    Returns
    -------
    str
        Why it was not; empty where it was.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    from meshreg.cli.reporting import why_not, write_report

    try:
        write_report(out)
    except OutputError:
        raise
    except Exception as error:
        LOG.debug("why", exc_info=True)
        return f"report.html was not made again: {why_not(error)}"
    return ""


def _png(figure: Any) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def show(document: dict[str, Any], missing: str, out: Path, voice: Terminal) -> None:
    """Print the hand registration, each answer's distance from it, and why a page is missing."""
    from meshreg.report.style import method_name

    hand = document["hand"]
    word = "[bold green]CONFIRMED[/]" if document["confirmed"] else "[bold red]NOT CONFIRMED[/]"
    voice.say(f"{word}: {escape(document['said'])}")
    voice.say(
        f"hand registration: {hand['east']:+.4f} m east, {hand['north']:+.4f} m north; "
        f"length {document['table_one']['offset']:.4f} m, mean residual {hand['residual']:.4f} m"
    )
    table = Table(title="against the hand registration", title_justify="left", title_style="bold")
    table.add_column("answer")
    table.add_column("says")
    for column in ("east [m]", "north [m]", "error [m]"):
        table.add_column(column, justify="right")
    rows = [(method_name(name), entry) for name, entry in document["methods"].items()]
    for name, entry in [*rows, ("result", document["fused"])]:
        offset = entry["offset"]
        cells = [_DASH] * 3 if offset is None else [f"{v:+.3f}" for v in offset]
        if offset is not None:
            cells.append(f"{entry['error']:.3f}")
        table.add_row(escape(name), entry.get("status") or entry["verdict"], *cells)
    voice.out.print(table)
    if document["weak_spots"]:
        voice.say(f"No pairs in the {', '.join(document['weak_spots'])}.")
    for note in document["ties"]["notes"]:
        voice.say(f"[dim]note:[/] {escape(note)}")
    if missing:
        voice.warn(missing)
    leads = "" if missing else "; report.html leads there"
    voice.say(f"Written to [bold]{escape(str(out))}[/]: validation.html, validation.json{leads}.")
