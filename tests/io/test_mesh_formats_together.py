"""PLY, GLB, STL and OFF through the front door: tables, sidecars, registered copies."""

from __future__ import annotations

import numpy as np
import pytest

from meshreg.io import read_survey, rewrite_survey, write_survey
from meshreg.records import Mesh, Survey, Transform

ORIGIN = np.array([512345.25, 6012345.5, -20.0])
MOVE = Transform(offset=(13.4, -8.7, 1.25))


def made():
    x, y = np.meshgrid(np.arange(12.0), np.arange(9.0))
    points = np.stack([x, y, np.sin(x) * np.cos(y)], axis=-1).reshape(-1, 3)
    i = np.arange(len(points)).reshape(x.shape)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Survey("made", Mesh(points, faces), ORIGIN, crs="EPSG:32755")


def corners(survey):
    return (survey.geometry.points + survey.origin)[survey.geometry.faces]


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".stl", ".off"])
@pytest.mark.parametrize("reference_suffix", [".ply", ".glb"])
def test_written_read_and_registered(tmp_path, suffix, reference_suffix):
    survey = made()
    written = write_survey(survey, tmp_path / f"reef{suffix}")
    again = read_survey(written[0])
    assert again.crs == "EPSG:32755"
    np.testing.assert_allclose(corners(again), corners(survey), atol=2e-6)
    reference = read_survey(write_survey(survey, tmp_path / f"first{reference_suffix}")[0])
    files = rewrite_survey(again, MOVE, tmp_path / "out", reference)
    assert files[0].name == f"reef_registered{suffix}"
    moved = read_survey(files[0])
    assert moved.crs == "EPSG:32755"
    np.testing.assert_allclose(corners(moved), corners(survey) + MOVE.offset, atol=2e-5)
