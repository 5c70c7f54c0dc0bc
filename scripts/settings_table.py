"""Write docs/settings.md from the fields of the settings, their ranges and defaults."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from meshreg.checked import Limits, wanted  # noqa: E402
from meshreg.settings import Settings  # noqa: E402

PAGE = ROOT / "docs" / "settings.md"
_HEAD = """# Settings

Made by `python scripts/settings_table.py`; not written by hand.

`--set NAME=VALUE` sets one, `--config FILE.toml` reads many, `OUT/settings.toml` lists what was
used. A value of another type or outside its range is refused (exit code 2). NaN and infinity are
no numbers here. The defaults are those of `--preset robust`.

"""


def page() -> str:
    """Return the text of docs/settings.md."""
    return _HEAD + _table(_rows(Settings()))


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
