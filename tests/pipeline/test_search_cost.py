"""What a search takes is reckoned before it begins, and refused where it is too much."""

from __future__ import annotations

import re

import numpy as np
import pytest

from meshreg import PointCloud, Settings, Survey, register_pair
from meshreg.errors import ResourceLimitError
from meshreg.pipeline.levels import pair_grids
from meshreg.pipeline.search_cost import require_search, search_cost
from meshreg.records import Grid


def grids(large, small, cell=0.1):
    return {
        name: tuple(Grid(0.0, s, c, (round(s / c), round(s / c))) for s in (large, small))
        for name, c in (("dem", cell), ("ortho", cell / 2))
    }


def test_cost_grows_with_the_radius_until_it_is_looked_at_coarsely():
    """12 m in 300 m, 0.1 and 0.05 m: 3,119² offsets would take 10 GB, coarse cells under 2 GB."""
    pair = grids(300, 12)
    costs = [search_cost(pair, Settings(), radius) for radius in (5, 10, 20, 300)]
    assert [cost.coarse > 1 for cost in costs] == [False, False, False, True]
    assert costs[0].offsets == 101**2
    assert costs[0].memory < costs[1].memory < costs[2].memory
    assert costs[3].offsets == (3000 + 120 - 1) ** 2
    assert costs[3].memory < 2e9
    assert costs[3].large


def test_methods_that_are_not_asked_cost_nothing():
    pair = grids(50, 50)
    plain = search_cost(pair, Settings(), 10.0)
    without = search_cost(pair, Settings().changed({"methods": "terrain"}), 10.0)
    assert 0.5 * plain.memory < without.memory < 0.75 * plain.memory


def test_the_radius_that_the_refusal_names_is_the_largest_that_fits(monkeypatch):
    pair = grids(30, 30, 0.03)
    monkeypatch.setattr("meshreg.io.files.safe.free_memory", lambda: 6e9)
    with pytest.raises(ResourceLimitError, match=r"search\.radius 30 m") as caught:
        require_search(pair, Settings(), 30.0)
    radius = float(re.search(r"--search-radius ([\d.]+)", str(caught.value))[1])
    assert 0 < radius < 30
    assert require_search(pair, Settings(), radius).memory <= 6e9
    with pytest.raises(ResourceLimitError):
        require_search(pair, Settings(), 1.3 * radius)


@pytest.mark.parametrize("free", [2e9, 8e9, 3e10])
def test_what_the_refusal_names_fits(free, monkeypatch):
    """A hundred metres on both sides at 1 cm, sought to 100 m: the remedies are true ones."""
    pair = grids(100, 100, 0.01)
    monkeypatch.setattr("meshreg.io.files.safe.free_memory", lambda: free)
    with pytest.raises(ResourceLimitError, match=r"search\.radius 100 m") as caught:
        require_search(pair, Settings(), 100.0)
    assert caught.value.exit_code == 5
    assert "--search-radius" not in str(caught.value), "no radius fits"
    ortho, dem = (
        float(re.search(rf"--{name}-cell ([\d.e-]+)", str(caught.value))[1])
        for name in ("ortho", "dem")
    )
    coarser = {"dem": grids(100, 100, dem)["dem"], "ortho": grids(100, 100, 2 * ortho)["ortho"]}
    assert require_search(coarser, Settings(), 100.0).memory <= free
    monkeypatch.setattr("meshreg.io.files.safe.free_memory", lambda: None)
    require_search(pair, Settings(), 100.0)


def test_a_refused_search_has_not_begun(monkeypatch):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 20, (4000, 2)), rng.normal(0, 0.1, 4000)])
    pair = Survey("a", PointCloud(points)), Survey("b", PointCloud(points + 0.5))
    begun = []
    monkeypatch.setattr("meshreg.io.files.safe.free_memory", lambda: 1_000_000)
    with pytest.raises(ResourceLimitError, match=r"0\.0 GB are free"):
        register_pair(*pair, progress=lambda stage, fraction: begun.append(stage))
    assert not begun
    settings = Settings().changed(
        {"raster.dem_cell": 0.5, "raster.ortho_cell": 0.5, "raster.sift_cell": 0.5}
    )
    laid = pair_grids(*pair, settings)
    assert set(laid) == {"dem", "ortho", "sift"}
    assert all(still.cell == 0.5 for still, _ in laid.values())
