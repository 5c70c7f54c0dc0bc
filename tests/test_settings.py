"""Settings: one record a stage, in and out of TOML without loss."""

from __future__ import annotations

import pytest

from meshreg.errors import UsageError
from meshreg.settings import Settings, read_settings, write_settings


@pytest.mark.parametrize("preset", ["robust", "paper"])
def test_toml_round_trip(tmp_path, preset):
    settings = Settings.from_preset(preset).changed(
        {"search.radius": 12.5, "raster.dem_cell": 0.2, "methods": "sift,terrain", "seed": 7}
    )
    path = tmp_path / "settings.toml"
    path.write_text(write_settings(settings))
    assert read_settings(path) == settings


def test_paper_is_as_published():
    paper = Settings.from_preset("paper")
    assert paper.terrain.high_pass == ()
    assert (paper.mutual_information.bins, paper.mutual_information.direct) == (256, True)
    assert (paper.sift.sample, paper.sift.inlier_radius, paper.sift.ratio) == (10, 0.20, 1.0)
    assert not paper.sift.exhaustive_vote


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("search.radios", "3", "Unknown setting 'search.radios'.*radius"),
        ("search", "3", "does not name a single setting"),
        ("seed.more", "3", "does not name a single setting"),
        ("seed", "1.5", "seed = 1.5 is not a value of type int"),
        ("raster.fill_cells", "true", "not a value of type int"),
        ("raster.remove_floaters", "1", "not a value of type bool"),
        ("terrain.high_pass", "2.0", "not a value of type"),
        ("search.radius", "wide", "'wide' is not a value"),
    ],
)
def test_wrong_settings_are_named(key, value, words):
    with pytest.raises(UsageError, match=words):
        Settings().changed({key: value})


def test_text_is_read_as_toml():
    changed = Settings().changed(
        {"search.radius": "7", "terrain.high_pass": "[1.5, 4]", "raster.dem_cell": "auto"}
    )
    assert changed.search.radius == 7.0
    assert changed.terrain.high_pass == (1.5, 4.0)
    assert changed.raster.dem_cell is None


def test_a_broken_file_is_named(tmp_path):
    path = tmp_path / "broken.toml"
    path.write_text("search = ")
    with pytest.raises(UsageError, match=r"broken\.toml"):
        read_settings(path)
    with pytest.raises(UsageError, match=r"absent\.toml"):
        read_settings(tmp_path / "absent.toml")
