"""The top of the page: the verdict in words and numbers, and what to do next."""

from __future__ import annotations

import math
import re

from meshreg.report import words
from meshreg.report.markup import link, number, say
from meshreg.report.result import Result

_WORDS = {"accepted": "Accepted", "review": "Review", "rejected": "Rejected"}
_ICONS = {
    "accepted": '<path d="M14 25l7 7 14-15"/>',
    "review": '<path d="M24 13v14M24 34v1"/>',
    "rejected": '<path d="M16 16l16 16M32 16l-16 16"/>',
}


def verdict(result: Result) -> str:
    """Return the answer in words and numbers, and what to do next."""
    r = result.registration
    reason = r.reason.strip()
    reason = reason[:1].upper() + reason[1:].rstrip(".") + "."
    icon = (
        '<svg viewBox="0 0 48 48" aria-hidden="true" fill="none" stroke="currentColor" '
        f'stroke-width="4" stroke-linecap="round"><circle cx="24" cy="24" r="21"/>'
        f"{_ICONS[r.verdict]}</svg>"
    )
    codes = ", ".join(f"<code>{say(finding.code)}</code>" for finding in r.findings)
    found = f'<p class="soft">Findings: {codes}</p>' if codes else ""
    said = f"<strong>{_WORDS[r.verdict]}</strong><p>{say(reason)}</p>{found}"
    head = f'<div class="word">{icon}<div>{said}'
    body = _numbers(result) + _next(result) + _validated(result)
    return (
        f'<section id="verdict" class="verdict {r.verdict}">{head}</div></div>'
        f'<div class="body">{body}</div></section>'
    )


def _numbers(result: Result) -> str:
    r = result.registration
    rows: list[tuple[str, str, str]] = []
    if r.transform is not None:
        sigmas = words.sigmas(r)
        for name, value, sigma in zip(
            ("East", "North", "Up"), r.transform.offset.tolist(), sigmas[:3], strict=True
        ):
            rows.append((name, f"{number(value)} m", _within(number(sigma, ".3f"), " m")))
        yaw = f"{number(words.yaw_degrees(r), '+.3f')}°"
        error = _within(number(sigmas[3], ".3f"), "°")
        rows.append(("Yaw", yaw, f"{error}, anticlockwise" if error else "anticlockwise"))
        if (tilt := words.tilt_degrees(r)) > 0:
            rows.append(("Tilt", f"{number(tilt, '.3f')}°", "from the vertical"))
        if (scale := f"{r.transform.scale:.5f}") != f"{1:.5f}":
            rows.append(("Scale", scale, "times the moving survey's lengths"))
    compared = r.after or r.before
    if compared.get("overlap") is not None:
        more = "of the smaller survey" + ("" if r.after else ", as delivered")
        rows.append(("Overlap", number(compared["overlap"], ".0%"), more))
    if r.after.get("height_nmad") is not None:
        before = f"{number(r.before.get('height_nmad'), '.3f')} m before"
        rows.append(("Height NMAD", f"{number(r.after['height_nmad'], '.3f')} m", before))
    rows += _internal(result)
    alarm = r.false_alarm
    if alarm is not None:
        rows.append(("Chance of a false alarm", _chance(float(alarm)), "were the ground unrelated"))
    cells = "".join(
        f"<div><dt>{say(name)}</dt><dd>{say(value)}<small>{say(more)}</small></dd></div>"
        for name, value, more in rows
    )
    note = ""
    if r.transform is not None:
        best = "The best hypothesis, not accepted. " if r.verdict == "review" else ""
        stated = "; ± is one sigma of the rigid move"
        if r.covariance is None:
            stated = "; an answer that is not accepted has no stated error"
        note = (
            f'<p class="soft">{best}What is added to the moving survey, at the centre of its '
            f"bounding box{stated}.</p>"
        )
    return f'{note}<dl class="numbers">{cells}</dl>' if rows else ""


def _internal(result: Result) -> list[tuple[str, str, str]]:
    """Say what the models' bending leaves, which no rigid move undoes and no sigma above holds."""
    internal = result.registration.internal or {}
    applied = bool(internal.get("applied"))
    left = [
        number((internal.get(part) or {}).get("held_out" if applied else "held_out_rigid"), ".3f")
        for part in ("horizontal", "vertical")
    ]
    if left[0] == number(None):
        return []
    more = "after the warp" if applied else "the models' bending, not in ±"
    up = "" if left[1] == number(None) else f", {left[1]} m up"
    return [("Left in the tiles, rms", f"{left[0]} m", f"horizontally{up}: {more}")]


def _within(sigma: str, unit: str) -> str:
    """Return "± sigma", or nothing where none is stated."""
    return "" if sigma == number(None) else f"± {sigma}{unit}"


def _chance(alarm: float) -> str:
    if alarm >= 0.01:
        return f"{alarm:.0%}"
    power = math.floor(math.log10(max(alarm, 1e-12)))
    raised = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"under 10{raised}" if alarm < 1e-12 else f"{alarm / 10.0**power:.0f} · 10{raised}"


def _next(result: Result) -> str:
    steps = words.next_steps(result.registration)
    if not steps:
        return ""
    here = [  # the same sentences are printed where there is no page
        step.replace("in report.html", "on this page").replace("report.html", "this page")
        for step in steps
    ]
    lines = "".join(f"<li>{_with_code(step)}</li>" for step in here)
    return f'<div class="next"><h3>What to do next</h3><ul>{lines}</ul></div>'


def _validated(result: Result) -> str:
    """Return what tie points that were picked make of it, and the way to that page."""
    if "validation.html" not in {name for name, _ in result.files}:
        return ""
    way = link("validation.html", "the comparison in full")
    yes, said = (result.validation.get(key) for key in ("confirmed", "said"))
    if not isinstance(said, str):
        return f"<p>Compared with tie points picked by hand: {way}</p>"
    word = "Confirmed" if yes is True else "Not confirmed"
    return f"<p><strong>{word} by tie points picked by hand</strong>: {say(said)}; {way}.</p>"


def _with_code(text: str) -> str:
    """Escape a sentence, its options and commands set as code."""
    return re.sub(r"`([^`]+)`|(--[a-z][a-z-]*(?: not:FILE)?)",
                  lambda found: f"<code>{found[1] or found[2]}</code>", say(text))  # fmt: skip
