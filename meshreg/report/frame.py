"""The axes of a chart in SVG: where a value lies, ticks, marks and their legend."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from meshreg.report.markup import number, say

WIDTH = 460


@dataclass(frozen=True)
class Frame:
    """A chart's axes: what the box shows, and where it lies in the picture."""

    x: tuple[float, float]
    y: tuple[float, float]
    left: float = 64.0
    top: float = 12.0
    wide: float = 390.0
    tall: float = 300.0

    @classmethod
    def equal(cls, x: tuple[float, float], y: tuple[float, float], tallest: float = 420.0) -> Frame:
        """Return axes of one scale; a box that would be too tall is narrowed by showing more."""
        wide, tall = x[1] - x[0], y[1] - y[0]
        height = 390.0 * tall / wide
        if height > tallest:
            more = (tall * 390.0 / tallest - wide) / 2
            return cls((x[0] - more, x[1] + more), y, tall=tallest)
        return cls(x, y, tall=height)

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Place of a value in the picture."""
        across = (x - self.x[0]) / (self.x[1] - self.x[0])
        up = (y - self.y[0]) / (self.y[1] - self.y[0])
        return self.left + across * self.wide, self.top + (1 - up) * self.tall

    @property
    def scale(self) -> float:
        """Picture units per unit of x."""
        return self.wide / (self.x[1] - self.x[0])

    def drawn(self, x_name: str, y_name: str, *, grid: bool = True) -> str:
        """Axes with ticks and names."""
        right, bottom = self.left + self.wide, self.top + self.tall
        parts = []
        for value, said in ticks(*self.x, 6):
            px = self.at(value, self.y[0])[0]
            if grid:
                parts.append(line("grid", px, self.top, px, bottom))
            parts.append(text(px, bottom + 16, said, "tick", "middle"))
        for value, said in ticks(*self.y, max(2, round(self.tall / 60))):
            py = self.at(self.x[0], value)[1]
            if grid:
                parts.append(line("grid", self.left, py, right, py))
            parts.append(text(self.left - 7, py + 4, said, "tick", "end"))
        frame = f'<rect class="axis" x="{self.left}" y="{self.top}" width="{self.wide}" '
        parts.append(f'{frame}height="{self.tall:.2f}"/>')
        parts.append(text(self.left + self.wide / 2, bottom + 35, x_name, "", "middle"))
        turn = f'transform="translate(12 {self.top + self.tall / 2:.1f}) rotate(-90)"'
        parts.append(f'<text {turn} text-anchor="middle">{say(y_name)}</text>')
        return "".join(parts)

    def picture(self, body: str, title: str) -> str:
        """Return the whole SVG, named for those who cannot see it."""
        height = self.top + self.tall + 44
        return (
            f'<svg viewBox="0 0 {WIDTH} {height:.0f}" role="img" aria-label="{say(title)}">'
            f"<title>{say(title)}</title>{body}</svg>"
        )


def ticks(low: float, high: float, count: int) -> list[tuple[float, str]]:
    """Round values between two ends, with their text."""
    rough = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(s * power for s in (1, 2, 5, 10) if s * power >= rough * 0.999)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(k * step, number(k * step + 0.0, f".{digits}f")) for k in range(first, last + 1)]


def line(name: str, x1: float, y1: float, x2: float, y2: float) -> str:
    """Draw a straight line between two places of the picture."""
    return f'<line class="{name}" x1="{x1:.2f}" y1="{y1:.2f}" x2="{x2:.2f}" y2="{y2:.2f}"/>'


def text(x: float, y: float, words: str, name: str = "", anchor: str = "start") -> str:
    """Write words at a place of the picture."""
    named = f' class="{name}"' if name else ""
    return f'<text{named} x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{say(words)}</text>'


SHAPES = {
    "sift": '<circle r="5"/>',
    "terrain": '<rect x="-4.5" y="-4.5" width="9" height="9"/>',
    "mutual_information": '<path d="M0 -6.5L6.5 0L0 6.5L-6.5 0Z"/>',
    "result": '<path d="M-9 0H9M0 -9V9"/>',
    # open in the middle, so that the peak itself is seen
    "best": '<path d="M-9 0H-4M4 0H9M0 -9V-4M0 4V9"/>',
    "second": '<path d="M-7 -7L-3 -3M3 3L7 7M-7 7L-3 3M3 -3L7 -7"/>',
}


def mark(kind: str, x: float, y: float, *, hollow: bool = False) -> str:
    """Draw the mark of a method, of the result, or of a peak."""
    shape = SHAPES.get(kind, '<path d="M0 -6L6 5H-6Z"/>')
    name = kind if kind in SHAPES else "other"
    look = "mark hollow" if hollow else "mark"
    shape = shape.replace("/>", f' class="{look}"/>')
    return f'<g class="{name}" transform="translate({x:.2f} {y:.2f})">{shape}</g>'


def key(items: Iterable[tuple[str, str, bool]]) -> str:
    """Return a legend: kind of mark, text, hollow or not."""
    lines = (
        f'<li><svg viewBox="-9 -9 18 18" aria-hidden="true">{mark(kind, 0, 0, hollow=hollow)}</svg>'
        f"{say(text)}</li>"
        for kind, text, hollow in items
    )
    return f'<ul class="key">{"".join(lines)}</ul>'
