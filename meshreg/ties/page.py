"""`validation.html`: one self-contained page; nothing in it is fetched or executed."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from meshreg.report.style import method_name

_STYLE = """
:root { --paper: #fff; --ink: #1c2126; --soft: #5a646e; --line: #d5dbe1; --card: #f5f7f9;
  --good: #00795a; --bad: #b84a00; color-scheme: light dark; }
@media (prefers-color-scheme: dark) { :root { --paper: #14181c; --ink: #e7ebee; --soft: #a3adb6;
  --line: #343c44; --card: #1c2227; --good: #3fc89d; --bad: #ff9a57; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 76rem; margin: 0 auto; padding: 1.2rem 1rem 3rem; }
h1 { font-size: 1.5rem; margin: 0 0 .6rem; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
.verdict { border-left: 6px solid var(--bad); background: var(--card); padding: .8rem 1.1rem;
  border-radius: 6px; margin: 0 0 1rem; }
.verdict.yes { border-color: var(--good); }
.verdict strong { color: var(--bad); } .verdict.yes strong { color: var(--good); }
a { color: inherit; } a:focus-visible { outline: 3px solid var(--good); outline-offset: 2px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .92rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .25rem .9rem .25rem 0; border-bottom: 1px solid var(--line);
  white-space: nowrap; } td:first-child { white-space: normal; }
th { font-weight: 500; color: var(--soft); } .n { text-align: right; }
tr.no td { color: var(--bad); }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(20rem, 1fr)); gap: 1rem; }
figure { margin: 0; } figure img { width: 100%; height: auto; background: #fff; border-radius: 6px;
  display: block; }
p.note, figcaption { color: var(--soft); font-size: .9rem; }
@media print { body { max-width: none; } .verdict { border: 1px solid; } }
"""


def validation_page(
    document: Mapping[str, Any], figures: Mapping[str, bytes], names: tuple[str, str]
) -> str:
    """Return the page as HTML text.

    Parameters
    ----------
    document : mapping
        `validation.json`.
    figures : mapping
        PNG of `draw_validation`'s figures, by name.
    names : (str, str)
        Of the reference and the moving survey.
    """
    digest = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'"
    title = f"Validation: {names[1]} on {names[0]}"
    parts = [
        '<p class="note"><a href="report.html">Report of the registration</a></p>'
        f"<h1>{escape(title)}</h1>",
        _verdict(document),
        f'<div class="figures">{"".join(_figure(*item) for item in figures.items())}</div>',
        f"<h2>Hand registration</h2>{_hand(document)}",
        f"<h2>Each answer against it</h2>{_answers(document)}",
        f"<h2>Where the pairs are</h2>{_cover(document)}",
        f"<h2>Pairs</h2>{_pairs(document['pairs'])}",
        f"<h2>Methods</h2><p>{escape(methods_text(document))}</p>",
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


_CAPTIONS = {
    "validation_errors": "Distance of each answer from the hand registration.",
    "validation_offsets": "The offset that each pair asks for, and each method's.",
    "validation_residuals": "Arrows from each pair's reference point; wrong pairs are orange.",
}


def _figure(name: str, png: bytes) -> str:
    caption, data = escape(_CAPTIONS.get(name, name)), base64.b64encode(png).decode()
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def sentence(document: Mapping[str, Any]) -> str:
    """Say in one sentence what the pairs make of the registration."""
    said = _compared(document)
    if document["ties"].get("independent", True):
        return said
    return f"{said}; but these pairs took part in the registration and do not check it"


def _compared(document: Mapping[str, Any]) -> str:
    hand, fused = document["hand"], document["fused"]
    agree = f"{hand['inliers']} of {hand['pairs']} pairs agree within {hand['radius']:g} m"
    if document["turned_first"] is not None:
        agree += f" once they are turned by {document['turned_first']:+.2f}°"
    if hand["contradictory"]:
        return f"the pairs contradict one another: only {agree}"
    if fused["error"] is None:
        return f"there is no registered survey to compare; {agree}"
    sigmas = "" if fused["sigmas"] is None else f", {fused['sigmas']:.1f} sigma"
    if fused["error"] <= hand["radius"] and 2 * fused["within"] <= hand["inliers"]:
        return (
            f"the result lies {fused['error']:.3f} m from the hand registration in their middle, "
            f"but only {fused['within']} of the {hand['inliers']} pairs that agree are within "
            f"{hand['radius']:g} m after registration: its turn is wrong"
        )
    return (
        f"the result lies {fused['error']:.3f} m from the hand registration{sigmas}; {agree}, "
        f"with a mean residual of {fused['residual_inliers']:.3f} m after registration"
    )


def methods_text(document: Mapping[str, Any]) -> str:
    """Return a paragraph for a methods section."""
    hand = document["hand"]
    first = ""
    if document["turned_first"] is not None:
        first = (
            f", after the turn of {document['turned_first']:+.2f}° and the scale of "
            f"{document['scaled_first']:.4f} about their middle that they share,"
        )
    return (
        f"The registration was checked against {hand['pairs']} points picked by hand in both "
        f"surveys. Their common translation{first} was found by RANSAC (Bryson et al., 2013, "
        f"section III-B: {hand['draws']} draws of {hand['sample']} pairs, inliers within "
        f"{hand['radius']:g} m): {hand['east']:+.3f} m east and {hand['north']:+.3f} m north, "
        f"with {hand['inliers']} inliers and a mean residual of {hand['residual']:.3f} m over all "
        f"pairs ({hand['residual_inliers']:.3f} m over the inliers)."
    )


def _verdict(document: Mapping[str, Any]) -> str:
    yes = document["confirmed"]
    word = "Confirmed" if yes else "Not confirmed"
    kind = "verdict yes" if yes else "verdict"
    return f'<p class="{kind}"><strong>{word}</strong>: {escape(sentence(document))}.</p>'


def _hand(document: Mapping[str, Any]) -> str:
    hand, one = document["hand"], document["table_one"]
    rows = [
        ("offset east", f"{hand['east']:+.4f} ± {hand['sigma'][0]:.4f} m"),
        ("offset north", f"{hand['north']:+.4f} ± {hand['sigma'][1]:.4f} m"),
        ("length (Table I)", f"{one['offset']:.4f} m"),
        ("mean residual (Table I)", f"{one['mean_residual']:.4f} m"),
        ("mean residual of those that agree", f"{hand['residual_inliers']:.4f} m"),
        ("pairs that agree", f"{hand['inliers']} of {hand['pairs']}"),
    ]
    note = "".join(
        f'<p class="note">{escape(str(note))}</p>' for note in document["ties"].get("notes", ())
    )
    if document["turned_first"] is not None:
        note += (
            '<p class="note">One translation does not fit these pairs: the moving points were '
            f"turned by {document['turned_first']:+.2f}° and scaled by "
            f"{document['scaled_first']:.4f} about their middle first, as the pairs themselves "
            "say. The offset is of the middle.</p>"
        )
    return _table((), rows) + note


def _answers(document: Mapping[str, Any]) -> str:
    rows = []
    for method, entry in document["methods"].items():
        rows.append((method_name(method), entry["status"], *_offset(entry)))
    rows.append(("result", document["fused"]["verdict"], *_offset(document["fused"])))
    head = ("answer", "says", "east [m]", "north [m]", "difference east", "north", "error [m]")
    note = (
        '<p class="note">All answers are taken at the middle of the agreeing pairs, the turn of '
        "the result included. The methods know no turn of their own and state one offset for the "
        "whole overlap"
    )
    if document["methods_turned"] is not None:
        note += (
            f"; they looked at the moving survey turned by {document['methods_turned']:+.2f}° "
            "about its centre, which is undone here"
        )
    note += ".</p>"
    return _table(head, rows) + note


def _offset(entry: Mapping[str, Any]) -> tuple[str, ...]:
    if entry["error"] is None:
        return ("–",) * 5
    signed = [f"{value:+.3f}" for value in (*entry["offset"], *entry["difference"])]
    return (*signed, f"{entry['error']:.3f}")


def _cover(document: Mapping[str, Any]) -> str:
    parts, weak = document["sectors"], document["weak_spots"]
    if not parts:
        return '<p class="note">The result holds no maps to tell the common ground from.</p>'
    rows = [[str(part["pairs"]) for part in parts[k : k + 3]] for k in (0, 3, 6)]
    text = f"No pairs in the {', '.join(weak)}." if weak else "There are pairs in every part."
    return f"<p>{escape(text)} North is up.</p>" + _table((), rows)


def _pairs(pairs: Sequence[Mapping[str, Any]]) -> str:
    rows = [
        (
            str(pair["id"]),
            pair["name"],
            *(f"{value:.3f}" for value in (*pair["reference"], *pair["moving"])),
            f"{pair['residual']:.3f}",
            "–" if pair["residual_after"] is None else f"{pair['residual_after']:.3f}",
            "yes" if pair["agrees"] else "no",
        )
        for pair in pairs
    ]
    head = ("id", "name", "reference east", "north", "moving east", "north", "residual [m]",
            "after [m]", "agrees")  # fmt: skip
    return _table(head, rows, [not pair["agrees"] for pair in pairs])


def _table(
    head: Sequence[str], rows: Iterable[Sequence[str]], bad: Sequence[bool] | None = None
) -> str:
    rows, lines = list(rows), []
    if head:
        sides = [_side(cell) for cell in rows[0]] if rows else [""] * len(head)
        names = zip(head, sides, strict=True)
        lines.append(
            f"<tr>{''.join(f'<th{side}>{escape(name)}</th>' for name, side in names)}</tr>"
        )
    for k, row in enumerate(rows):
        cells = "".join(f"<td{_side(cell)}>{escape(cell)}</td>" for cell in row)
        lines.append(f'<tr class="no">{cells}</tr>' if bad and bad[k] else f"<tr>{cells}</tr>")
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def _side(cell: str) -> str:
    return ' class="n"' if cell.lstrip("+−-")[:1].isdigit() and len(cell) < 14 else ""
