"""Recipes: everything about a pair but its seed, from TOML."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from data_synth.change import Change
from data_synth.seeing import Seeing
from data_synth.sfm import Sfm
from data_synth.sites import SITES, Site
from meshreg.errors import UsageError
from meshreg.settings import Settings
from meshreg.settings.checked import parse_toml, read_toml, shown

LARGEST = 1e9  # of any number of a recipe
RANGES = {
    "output.size": (1.0, 1000.0),
    "output.texture": (0.001, 1.0),
    "output.pages": (1, 64),
    "output.point_spacing": (0.001, 1.0),
    "output.tracks": (1, 100),
    "output.images": (1, 1000),
    "sfm.mesh_spacing": (0.001, 1.0),
    "sfm.overlap": (0.0, 1.0),
    "sfm.holes": (0.0, 1.0),
    "sfm.scale": (-0.5, 0.5),
    "sfm.tilt": (-90.0, 90.0),
    "expect.max_error": (0.0, LARGEST),
}
SCENARIOS = Path(__file__).parent / "scenarios"


@dataclass(frozen=True)
class Place:
    """Where the patch lies: the CRS and the absolute coordinates of its centre [m], the date."""

    crs: str = "EPSG:32755"
    east: float = 431200.0
    north: float = 8376500.0
    up: float = -12.0
    date: str = "2011-06-01"
    date_moving: str = "2012-06-01"
    other_ground: bool = False  # the moving survey is of another place


@dataclass(frozen=True)
class Output:
    """Size and fineness of the files. Lengths in metres."""

    size: float = 12.0
    texture: float = 0.01
    pages: int = 2  # texture pages along each side
    point_spacing: float = 0.02  # of point clouds
    format: str = "obj"
    tracks: int = 4  # of cameras, for photographs
    images: int = 5  # on each track


@dataclass(frozen=True)
class Expect:
    """What a registration of the pair must give: the verdicts allowed and the largest error [m]."""

    verdicts: tuple[str, ...] = ("accepted",)
    max_error: float = 0.25


@dataclass(frozen=True)
class Recipe:
    """Everything about a pair but its seed."""

    name: str = "unnamed"
    description: str = ""
    severity: float = 0.0
    site: Site = field(default_factory=Site)
    change: Change = field(default_factory=Change)
    reference: Seeing = field(default_factory=Seeing)
    moving: Seeing = field(default_factory=Seeing)
    sfm: Sfm = field(default_factory=Sfm)
    place: Place = field(default_factory=Place)
    output: Output = field(default_factory=Output)
    expect: Expect = field(default_factory=Expect)
    settings: Mapping[str, Any] = field(default_factory=dict)  # for the registration, by dotted key


def scenarios() -> tuple[str, ...]:
    """Return the names of all recipes that travel with the package."""
    return tuple(sorted(path.stem for path in SCENARIOS.glob("*.toml")))


def load(name: str | Path, overrides: Mapping[str, Any] | None = None) -> Recipe:
    """Read a recipe.

    Parameters
    ----------
    name : str or path
        A scenario's name, `severity_07` for the ladder's step 0.7, or the path of a TOML file.
    overrides : mapping, optional
        Values by dotted key, such as ``{"change.bleaching": 0.5}``; strings are read as TOML.

    Raises
    ------
    UsageError
        If there is no such recipe, it is no TOML, or a key or a value is unknown.
    """
    changes = dict(overrides or {})
    path = Path(name)
    step = re.fullmatch(r"severity_(\d\d)", str(name))
    if step:
        path = SCENARIOS / "severity.toml"
        changes = {"severity": int(step.group(1)) / 10.0, **changes}
    elif path.suffix != ".toml":
        path = SCENARIOS / f"{name}.toml"
    if not path.is_file():
        raise UsageError(
            f"There is no scenario {str(name)!r}.", remedy=f"Choose from {', '.join(scenarios())}."
        )
    document = read_toml(path, "The recipe")
    return _build(document, changes, path, str(name) if step else path.stem)


def _build(document: dict[str, Any], changes: dict[str, Any], path: Path, name: str) -> Recipe:
    severe = document.pop("severe", {})
    recipe = Recipe(name=name)
    base = document.get("site", {}).pop("base", None)
    if base is not None:
        if base not in SITES:
            raise UsageError(
                f"site.base is {base!r}.", file=path, remedy=f"Use one of {', '.join(SITES)}."
            )
        recipe = replace(recipe, site=SITES[base])
    settings = document.pop("settings", {})
    settings.update({k[9:]: changes.pop(k) for k in list(changes) if k.startswith("settings.")})
    severity = changes.pop("severity", document.pop("severity", 0.0))
    severity = _value(severity)
    if type(severity) not in (int, float) or not 0 <= severity <= 1:
        raise UsageError(
            f"severity is {shown(severity)}; it must be a number from 0 to 1.", file=path
        )
    severity = float(severity)
    Settings().changed(dict(_flat(settings)))
    for key, value in _flat(document):
        recipe = _set(recipe, key, key.split("."), value, path)
    for key, value in _flat(severe):  # what the ladder's top rung says
        now = _get(recipe, key, path)
        recipe = _set(recipe, key, key.split("."), now + severity * (value - now), path)
    for key, value in changes.items():
        recipe = _set(recipe, key, key.split("."), _value(value), path)
    return replace(recipe, settings=settings, severity=severity)


def _value(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return parse_toml(f"v = {value}")["v"]
    except ValueError:
        return value


def _flat(table: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    pairs = []
    for key, value in table.items():
        if isinstance(value, Mapping):
            pairs += _flat(value, f"{prefix}{key}.")
        else:
            pairs.append((prefix + key, value))
    return pairs


def _get(record: Any, key: str, path: Path) -> Any:
    for part in key.split("."):
        if part not in {f.name for f in fields(record)}:
            raise UsageError(f"Unknown recipe key {key!r}.", file=path)
        record = getattr(record, part)
    return record


def _set(record: Any, key: str, parts: list[str], value: Any, path: Path) -> Any:
    names = {f.name for f in fields(record)}
    if parts[0] not in names:
        raise UsageError(
            f"Unknown recipe key {key!r}.",
            file=path,
            remedy=f"Use one of {', '.join(sorted(names))}.",
        )
    now = getattr(record, parts[0])
    if len(parts) > 1:
        if not is_dataclass(now):
            raise UsageError(f"Recipe key {key!r} has no part {parts[1]!r}.", file=path)
        return replace(record, **{parts[0]: _set(now, key, parts[1:], value, path)})
    drawn = next(f.type for f in fields(record) if f.name == parts[0]) == "Drawn"
    return replace(record, **{parts[0]: _fitted(now, value, drawn, key, path)})


def _fitted(now: Any, value: Any, drawn: bool, key: str, path: Path) -> Any:
    """Return `value` in the type of `now` (a range too where `drawn`), or say what was expected."""
    low, high = RANGES.get(key, (-LARGEST, LARGEST))
    for item in value if isinstance(value, list | tuple) else (value,):
        if isinstance(item, int | float) and not low <= item <= high:  # NaN too
            raise UsageError(
                f"Recipe key {key!r} is {shown(value)}; it must be from {low:g} to {high:g}.",
                file=path,
            )
    number = isinstance(value, int | float) and not isinstance(value, bool)
    numbers = isinstance(value, list | tuple) and all(isinstance(v, int | float) for v in value)
    if isinstance(now, bool | str):
        if type(value) is type(now):
            return value
    elif isinstance(now, int):
        if number and float(value).is_integer():
            return int(value)
    elif drawn and numbers and len(value) == 2:
        return (float(value[0]), float(value[1]))
    elif (drawn or isinstance(now, float)) and number:
        return float(value)
    elif isinstance(now, tuple) and now and isinstance(now[0], str):
        if isinstance(value, str):
            return (value,)
        if isinstance(value, list | tuple) and all(isinstance(v, str) for v in value):
            return tuple(value)
    elif isinstance(now, tuple) and numbers and len(value) == len(now):
        return tuple(float(v) for v in value)
    raise UsageError(
        f"Recipe key {key!r} is {value!r}; expected something like {now!r}.", file=path
    )
