"""Settings: one record a stage, in and out of TOML without loss."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshreg.errors import UsageError
from meshreg.settings import Settings, TerrainSettings, read_settings, write_settings
from meshreg.settings.checked import wanted

ROOT = Path(__file__).parents[2]


def every_setting() -> Iterator[tuple[str, str, Any]]:
    """Give each setting's key, annotation and limits."""
    for item in dataclasses.fields(Settings):
        if "limits" in item.metadata:
            yield item.name, str(item.type), item.metadata["limits"]
            continue
        for part in dataclasses.fields(getattr(Settings(), item.name)):
            yield f"{item.name}.{part.name}", str(part.type), part.metadata["limits"]


def get(settings: Settings, key: str) -> Any:
    value: Any = settings
    for part in key.split("."):
        value = getattr(value, part)
    return value


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
        ("seed", "1.5", r"seed is 1\.5; it must be a whole number from 0 to 2147483647\."),
        ("seed", -1, r"seed is -1; it must be a whole number from 0"),
        ("seed", "1" * 5000, r"seed is '1{58}…; it must be a whole number"),
        ("seed", "0x" + "f" * 5000, r"seed is a int too long to be shown; it must be"),
        ("raster.fill_cells", "true", "is True; it must be a whole number from 0 to 100 cells"),
        ("raster.remove_floaters", "1", "is 1; it must be true or false"),
        ("raster.dem_cell", "1e-320", r"dem_cell is 1e-320; it must be a number from 1e-05 to"),
        ("raster.dem_cell", "1e400", "dem_cell is inf; it must be a number from 1e-05 to 1000 m"),
        ("raster.max_cells", -1, "is -1; it must be a whole number from 1 to"),
        ("terrain.high_pass", "2.0", "is 2.0; it must be a list of 0 to 8 numbers, each over 0"),
        ("terrain.high_pass", ["a"], r"is \['a'\]; it must be a list of 0 to 8 numbers"),
        ("terrain.high_pass", "[1, nan]", r"is \[1, nan\]; it must be a list"),
        ("search.radius", "wide", "is 'wide'; it must be a number over 0 and at most 1000000 m"),
        ("search.radius", "[" * 5000, "search.radius is .*…; it must be a number"),
        ("search.radius", 10**400, "search.radius is 10+…; it must be a number"),
        ("sift.tile", 0, "sift.tile is 0; it must be a whole number from 64 to 32768 px"),
        ("mutual_information.bins", 0, "bins is 0; it must be a whole number from 2 to 256"),
        ("judge.min_overlap", "nan", "judge.min_overlap is nan; it must be a number from 0 to 1"),
        ("methods", "[]", r"methods is \[\]; it must be a list of some of \"sift\""),
        ("methods", "sift,sift", r"methods is \('sift', 'sift'\); .* none twice"),
        ("methods", "magic", r"methods is \('magic',\); it must be a list of some of"),
        ("warp.model", "affine", 'warp.model is \'affine\'; it must be one of "none", "auto"'),
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


NUMBERS = [(key, kind, limits) for key, kind, limits in every_setting() if limits.high is not None]


@pytest.mark.parametrize(("key", "kind", "limits"), NUMBERS, ids=[key for key, *_ in NUMBERS])
def test_each_number_is_held_to_its_range(key, kind, limits):
    """Both ends, what lies just beyond them, and what is not a number at all."""
    whole = kind.startswith("int")
    step = 1 if whole else 1e-9

    def given(value):
        return [value] if kind.startswith("tuple") else value

    def set_to(value):
        found = get(Settings().changed({key: given(value)}), key)
        return found[0] if kind.startswith("tuple") else found

    for end, is_open, out in (
        (limits.low, limits.open_low, -1),
        (limits.high, limits.open_high, 1),
    ):
        end = int(end) if whole else float(end)
        inside, outside = end - out * step * max(1, abs(end)), end + out * step * max(1, abs(end))
        if whole:
            inside, outside = end - out, end + out
        assert set_to(inside) == inside
        if is_open:
            with pytest.raises(UsageError, match=f"{key} is "):
                set_to(end)
        else:
            assert set_to(end) == end
        with pytest.raises(UsageError, match=f"{key} is .*{limits.said[:5]}"):
            set_to(outside)
    for wrong in (math.nan, math.inf, -math.inf, True, "one", {}, [[1]], 10**5000):
        with pytest.raises(UsageError, match=f"{key} is ") as caught:
            set_to(wrong)
        assert caught.value.exit_code == 2


def test_every_setting_has_a_range_or_choices():
    for key, kind, limits in every_setting():
        assert limits.what, key
        assert kind.startswith("bool") or limits.choices or None not in (limits.low, limits.high), (
            key
        )


def test_records_made_in_python_are_checked_too():
    with pytest.raises(UsageError, match=r"terrain\.high_pass is \('a',\)"):
        TerrainSettings(high_pass=("a",))  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"seed is 0\.0"):
        Settings(seed=0.0)  # type: ignore[arg-type]
    made = Settings(seed=np.int64(3), methods=["sift"]).changed({"search.radius": np.float32(2)})  # type: ignore[arg-type]
    assert (type(made.seed), made.methods) == (int, ("sift",))
    assert (type(made.search.radius), made.search.radius) == (float, 2.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v = " + "[" * 5000, "nested too deeply"),
        ("seed = " + "1" * 5000, "cannot be read: Exceeds the limit"),
        ("a" + ".a" * 20 + " = 1", "nested 21 deep; up to 8"),
        ("#" * 70_000, "larger than 65536 bytes"),
        ("search.radius = 1e400", "search.radius is inf"),
        ("preset = 3", "Unknown preset 3"),
        ("seed = 1\nseed = 2", "cannot be read: Cannot overwrite a value"),
        ("seed = '\0'", "cannot be read: Found invalid character"),
    ],
)
def test_hostile_toml_is_refused_and_named(tmp_path, text, words):
    path = tmp_path / "hostile.toml"
    path.write_text(text)
    with pytest.raises(UsageError, match=words) as caught:
        read_settings(path)
    assert caught.value.file == str(path)


def test_a_pipe_or_a_device_is_refused_without_waiting(tmp_path):
    pipe = tmp_path / "pipe.toml"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero"), tmp_path):
        with pytest.raises(UsageError, match="not a regular file"):
            read_settings(path)


def test_the_table_in_the_docs_is_current():
    page = runpy.run_path(str(ROOT / "scripts" / "settings_table.py"))["page"]()
    assert (ROOT / "docs" / "settings.md").read_text(encoding="utf-8") == page, (
        "run python scripts/settings_table.py"
    )
    for key, kind, limits in every_setting():
        assert f"| `{key}` |" in page
        assert wanted(kind, limits) in page


def test_a_recipe_takes_what_the_table_says_and_nothing_beyond():
    from data_synth.recipe import RANGES, load

    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    for key, (low, high) in RANGES.items():
        assert f"| `{key}` |" in page
        for end, step in ((low, -1), (high, 1)):
            load("flat_sand", {key: end})
            with pytest.raises(UsageError, match=re.escape(f"from {low:g} to {high:g}")):
                load("flat_sand", {key: end + step * max(1.0, 1e-3 * abs(end))})
