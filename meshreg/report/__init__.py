"""REPORT: pictures and the page of a finished registration. Nothing here computes a result."""

from __future__ import annotations

from meshreg.report.figures import draw_figures
from meshreg.report.keeping import keep
from meshreg.report.page import report_page
from meshreg.report.result import Result, gather
from meshreg.report.view import open_view

__all__ = ["Result", "draw_figures", "gather", "keep", "open_view", "report_page"]
