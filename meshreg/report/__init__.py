"""REPORT: pictures of a finished registration. Nothing here computes a result."""

from __future__ import annotations

from meshreg.report.figures import draw_figures

__all__ = ["draw_figures"]
