"""What the whole suite shares: tests that need something of the machine, and made records."""

from __future__ import annotations

import functools
import os

import pytest

from meshreg import doctor

# Where the figures are drawn nothing may open a window.
os.environ.setdefault("MPLBACKEND", "Agg")


@functools.cache
def _has(what: str) -> tuple[bool, str]:
    return doctor.has(what)


def _required(what: str) -> bool:
    wanted = os.environ.get("MESHREG_REQUIRE", "")
    return wanted == "all" or what in wanted.split(",")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test whose need the machine lacks, or fail it under MESHREG_REQUIRE=all."""
    for mark in item.iter_markers("needs"):
        for what in mark.args:
            found, why = _has(what)
            if found:
                continue
            if _required(what):
                pytest.fail(f"MESHREG_REQUIRE asks for {what}, which fails: {why}", pytrace=False)
            pytest.skip(f"needs {what}: {why}")
