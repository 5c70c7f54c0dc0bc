"""Figures drawn with a second process are those that this one would draw."""

from __future__ import annotations

import dataclasses
import logging
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from made_registration import made_registration
from PIL import Image

from meshreg.cli import drawing
from meshreg.report import draw_figures

SMALL = str(Path(__file__).parents[2] / "meshreg" / "demo_data" / "beach_2018.obj")


@pytest.fixture
def apart(monkeypatch):
    monkeypatch.setattr(drawing, "LARGE", 0)


def test_a_small_pair_gets_no_process_of_its_own():
    with drawing.figure_worker(SMALL, SMALL) as begin:
        finish = begin("registration", "folder")
    assert finish.func is draw_figures
    assert finish.args == ("registration", "folder")


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize("patient", [0, 3, 8])
def test_both_processes_draw_the_same(tmp_path: Path, patient: int) -> None:
    """Whether this one helps from the beginning, with the rest, or hardly at all."""
    registration = made_registration("accepted")
    with drawing.figure_worker(SMALL, SMALL) as begin:
        finish = begin(registration, tmp_path / "there")
        while patient and len(list((tmp_path / "there").glob("*.png"))) < patient:
            time.sleep(0.02)
        finish()
    draw_figures(registration, tmp_path / "here")
    here, there = (sorted((tmp_path / name).glob("*.png")) for name in ("here", "there"))
    assert [path.name for path in there] == [path.name for path in here]
    assert len(there) >= 8
    for one, other in zip(here, there, strict=True):
        np.testing.assert_array_equal(np.asarray(Image.open(one)), np.asarray(Image.open(other)))


@pytest.mark.usefixtures("apart")
def test_what_it_says_is_logged_here(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A figure that cannot be drawn is a warning, wherever it was drawn."""
    accepted = made_registration("accepted")
    evidence = {**accepted.evidence, "residuals": {"east": np.zeros(2)}}
    broken = dataclasses.replace(accepted, evidence=evidence)
    with caplog.at_level(logging.INFO, "meshreg"), drawing.figure_worker(SMALL) as begin:
        begin(broken, tmp_path)()
    assert any("residuals was not drawn" in message for message in caplog.messages)
    assert not (tmp_path / "residuals.png").exists()
    assert (tmp_path / "extents.png").is_file()


@pytest.mark.usefixtures("apart")
def test_an_error_there_is_an_error_here(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("a file where the folder should be")
    with drawing.figure_worker(SMALL) as begin, pytest.raises(FileExistsError):
        begin(made_registration("rejected"), taken)()


@pytest.mark.usefixtures("apart")
def test_if_it_dies_the_figures_are_drawn_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = []
    context = drawing.multiprocessing.get_context("spawn")
    process = context.Process

    def noted(*args, **kwargs):
        started.append(process(*args, **kwargs))
        return started[-1]

    monkeypatch.setattr(context, "Process", noted)
    with drawing.figure_worker(SMALL) as begin:
        os.kill(started[0].pid, signal.SIGKILL)
        started[0].join(10)
        begin(made_registration("rejected"), tmp_path)()
    assert (tmp_path / "extents.png").is_file()
