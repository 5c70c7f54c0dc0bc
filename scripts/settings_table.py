"""Write docs/settings.md from the fields of the settings, their ranges and defaults."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from data_synth.recipe import LARGEST, RANGES, Recipe  # noqa: E402
from meshreg.settings import Settings  # noqa: E402
from meshreg.settings.checked import Limits, wanted  # noqa: E402

PAGE = ROOT / "docs" / "settings.md"
_HEAD = """# Settings

Made by `python scripts/settings_table.py`; not written by hand.

`--set NAME=VALUE` sets one, `--config FILE.toml` reads many, `OUT/settings.toml` lists what was
used. A value of another type or outside its range is refused (exit code 2). NaN and infinity are
no numbers here. The defaults are those of `--preset robust`.

"""

_RECIPES = f"""
## Recipes

`meshreg synth` takes a recipe's keys by `--set` or from a TOML file. `severity` is a number from 0
to 1, `settings.…` are as above, and a number that is not listed here is one from -{LARGEST:g}
to {LARGEST:g}, of the kind that the scenarios show.

"""


def page() -> str:
    """Return the text of docs/settings.md."""
    return _HEAD + _table(_rows(Settings())) + _recipes()


def _recipes() -> str:
    """Return the ranges of the recipes of `meshreg synth`."""
    lines = ["| key | default | may be |", "|---|---|---|"]
    for key, (low, high) in RANGES.items():
        section, name = key.split(".")
        default = getattr(getattr(Recipe(), section), name)
        whole = "a whole number" if isinstance(default, int) else "a number"
        if isinstance(default, tuple):
            whole = "a number, or a list of two between which it is drawn,"
        lines.append(f"| `{key}` | {default} | {whole} from {low:g} to {high:g} |")
    return _RECIPES + "\n".join(lines) + "\n"


def _table(rows: list[tuple[str, ...]]) -> str:
    lines = ["| name | default | may be | what |", "|---|---|---|---|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def _rows(record: Any, prefix: str = "") -> list[tuple[str, ...]]:
    rows = []
    for item in dataclasses.fields(record):
        value = getattr(record, item.name)
        if dataclasses.is_dataclass(value):
            rows += _rows(value, f"{prefix}{item.name}.")
        else:
            limits: Limits = item.metadata["limits"]
            name = f"`{prefix}{item.name}`"
            rows.append(
                (name, _default(value, limits), wanted(str(item.type), limits), limits.what)
            )
    return rows


def _default(value: Any, limits: Limits) -> str:
    if value is None:
        return f"none: {limits.unset}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(str(item) for item in value)
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else str(value)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
