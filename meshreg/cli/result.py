"""The result of a registration as a person reads it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.panel import Panel
from rich.table import Table

from meshreg.cli.console import Terminal
from meshreg.records import OffsetEstimate, Registration
from meshreg.report.words import next_steps

_COLORS = {"accepted": "green", "review": "yellow", "rejected": "red"}
_STATUS_COLORS = {"ok": "green", "weak": "yellow", "failed": "red"}
_DASH = "–"


def show(registration: Registration, out: Path, voice: Terminal) -> None:
    """Print the verdict, the offset, each method's answer, and where the files are."""
    color = _COLORS[registration.verdict]
    reason = registration.reason.strip()
    voice.say(f"[bold {color}]{registration.verdict.upper()}[/]: {escape(reason)}")
    if registration.findings:
        voice.say(f"findings: {', '.join(finding.code for finding in registration.findings)}")
    if registration.transform is not None:
        _print_offset(registration, voice)
    voice.out.print(_methods(registration))
    for estimate in registration.estimates:
        if estimate.reason:
            voice.say(f"  {escape(estimate.method)}: {escape(estimate.reason)}")
    if statistics := _statistics(registration):
        voice.out.print(statistics)
    for note in registration.notes:
        voice.say(f"[dim]note:[/] {escape(note)}")
    voice.say(f"Written to [bold]{escape(str(out))}[/]: {escape(_contents(out))}")
    if (out / "report.html").is_file():
        voice.say(f"Open [bold]{escape(str(out / 'report.html'))}[/] in a browser.")
    for step in next_steps(registration):
        voice.say(f"[yellow]next:[/] {escape(step)}")


def _print_offset(registration: Registration, voice: Terminal) -> None:
    transform, covariance = registration.transform, registration.covariance
    assert transform is not None
    sigmas: list[float] = [math.nan] * 7
    if covariance is not None:
        sigmas = [math.sqrt(max(float(covariance[k, k]), 0.0)) for k in range(7)]
    table = Table(box=None, show_header=False, pad_edge=False)
    names = ("east", "north", "up")
    for name, value, sigma in zip(names, transform.offset.tolist(), sigmas[:3], strict=True):
        table.add_row(f"{name}", f"{value:+.4f} m", _plus_minus(sigma, "m", 4))
    yaw = math.degrees(transform.yaw)
    table.add_row("yaw", f"{yaw:+.4f}°", _plus_minus(math.degrees(sigmas[5]), "°", 4))
    tilt = math.degrees(transform.tilt)
    if tilt >= 5e-5:  # what four decimals show
        table.add_row("tilt", f"{tilt:.4f}°", _plus_minus(math.degrees(max(sigmas[3:5])), "°", 4))
    title = "add to the moving survey"
    if registration.verdict == "review":
        title += " (best hypothesis)"
    voice.out.print(Panel(table, title=title, title_align="left", expand=False))


def _plus_minus(sigma: float, unit: str, digits: int) -> str:
    if not math.isfinite(sigma):
        return ""
    return f"± {sigma:.{digits}f}{'' if unit == '°' else ' '}{unit}"


def _methods(registration: Registration) -> Table:
    table = Table(title="methods", title_justify="left", title_style="bold")
    for column in ("method", "status"):
        table.add_column(column)
    for column in ("east [m]", "north [m]", "sigma [m]", "gap", "seconds"):
        table.add_column(column, justify="right")
    for estimate in registration.estimates:
        color = _STATUS_COLORS[estimate.status]
        table.add_row(
            escape(estimate.method),
            f"[{color}]{estimate.status}[/]",
            _number(estimate.east, "+.3f"),
            _number(estimate.north, "+.3f"),
            _sigma(estimate),
            _number(estimate.gap, ".1f"),
            _number(estimate.seconds, ".1f"),
        )
    return table


def _number(value: Any, form: str) -> str:
    return format(value, form) if value is not None and math.isfinite(value) else _DASH


def _sigma(estimate: OffsetEstimate) -> str:
    """Return the larger axis of the one-sigma ellipse, so that no direction looks too sure."""
    if estimate.sigma is None:
        return _DASH
    a, b, c = (float(estimate.sigma[i, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    largest = (a + c) / 2 + math.hypot((a - c) / 2, b)
    return _number(math.sqrt(max(largest, 0.0)), ".3f")


def _statistics(registration: Registration) -> Table | None:
    rows = (
        ("overlap", "overlap", ".1%"),
        ("height median [m]", "height_median", "+.3f"),
        ("height NMAD [m]", "height_nmad", ".3f"),
        ("height RMSE [m]", "height_rmse", ".3f"),
        ("image similarity", "image_similarity", "+.3f"),
    )
    before, after = registration.before, registration.after
    if not before and not after:
        return None
    table = Table(title="both surveys compared", title_justify="left", title_style="bold")
    table.add_column("")
    table.add_column("before", justify="right")
    table.add_column("after", justify="right")
    for name, key, form in rows:
        table.add_row(name, _number(before.get(key), form), _number(after.get(key), form))
    return table


def _contents(out: Path) -> str:
    names = sorted(path.name + ("/" if path.is_dir() else "") for path in out.iterdir())
    return ", ".join(names)
