"""The block sandwich against loops, and against how often it holds what it promises."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshreg.records import Grid
from meshreg.statistics.kriging import overlap_ground
from meshreg.statistics.sandwich import block_sandwich


def by_loops(curvature, scores, block, lost):
    names = sorted(set(block.tolist()))
    sums = [sum(scores[i] for i in range(len(block)) if block[i] == name) for name in names]
    middle = sum(sums) / len(sums)
    meat = sum(np.outer(g - middle, g - middle) for g in sums)
    inverse = np.linalg.inv(curvature)
    return inverse @ meat @ inverse * len(sums) / max(len(sums) - lost, 0.2 * len(sums))


@given(st.integers(0, 10_000), st.integers(3, 12), st.integers(0, 20))
def test_it_is_the_sum_over_blocks(seed, blocks, lost):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) + 3 * np.eye(3)
    scores, block = rng.normal(size=(60, 3)), 7 * rng.integers(0, blocks, 60)
    curvature = root @ root.T
    found = block_sandwich(curvature, scores, block, lost)
    np.testing.assert_allclose(found, by_loops(curvature, scores, block, lost), rtol=1e-9)
    np.testing.assert_allclose(block_sandwich(-curvature, scores, block, lost), found, rtol=1e-9)


@pytest.mark.parametrize("alike", [1, 16])
def test_the_slope_of_a_line_scatters_as_promised(alike):
    """Residuals that are alike in runs of 16: told by blocks of 16, not one by one."""
    rng = np.random.default_rng(alike)
    x = np.linspace(-1, 1, 960)
    design = np.stack([np.ones_like(x), x], axis=1)
    curvature = design.T @ design
    found, told, naive = [], [], []
    for _ in range(400):
        noise = np.repeat(rng.normal(size=len(x) // alike), alike)
        answer = np.linalg.lstsq(design, noise, rcond=None)[0]
        scores = design * (noise - design @ answer)[:, None]
        found.append(answer[1])
        told.append(block_sandwich(curvature, scores, np.arange(len(x)) // 16, 2)[1, 1])
        naive.append(block_sandwich(curvature, scores, np.arange(len(x)), 2)[1, 1])
    assert np.mean(told) == pytest.approx(np.var(found), rel=0.2)
    assert np.mean(naive) * alike == pytest.approx(np.var(found), rel=0.2)


@given(st.integers(0, 10_000), st.integers(1, 3))
def test_the_ground_is_the_overlap(seed, step):
    """Shares are the cells of each place; their mean place is that of all common cells."""
    rng = np.random.default_rng(seed)
    grids = Grid(100.0, 50.0, 0.5, (24, 31)), Grid(101.0, 51.0, 0.5, (20, 27))
    masks = tuple(rng.random(grid.shape) < 0.7 for grid in grids)
    offset = np.array([rng.integers(-6, 7), rng.integers(-6, 7)]) * 0.5
    ground = overlap_ground(masks, grids, offset, 5, step)
    common = []
    for row in range(0, 20, step):
        for col in range(0, 27, step):
            place = np.array(grids[1].east_north(row, col)).ravel()
            r, c = (round(float(i)) for i in grids[0].row_col(*(place + offset)))
            if 0 <= r < 24 and 0 <= c < 31 and masks[1][row, col] and masks[0][r, c]:
                common.append(place)
    assert ground is not None
    assert len(ground.places) <= 36
    assert ground.share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(ground.share @ ground.places, np.mean(common, axis=0), atol=1e-9)
    assert overlap_ground(masks, grids, (100.0, 0.0), 5, step) is None
