"""What comes from outside, held to its type and its range: settings, TOML text.

A record's fields carry their `Limits` beside their defaults (`number`, `choice`, `flag`, ...);
`Checked` holds them to these however the record is made, and docs/settings.md is written from them.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import os
import stat
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from meshreg.errors import MeshregError, UsageError

MAX_TOML = 1 << 16  # bytes; all our settings take 2 kB, and tomllib's time grows with the square
_DEEPEST = 8  # tables within tables


@dataclass(frozen=True)
class Limits:
    """What a setting may be.

    Attributes
    ----------
    what : str
        What it means, for the table of settings.
    unit : str
        "m", "degrees", "cells", "px"; empty for counts and shares.
    low, high : float or None
        Least and largest number; None is no limit but that it be finite.
    open_low, open_high : bool
        Whether the limits themselves are refused.
    choices : tuple of str
        Words to choose from; empty where any will do.
    length : (int, int)
        Least and largest number of a list's items.
    unset : str
        What None stands for.
    """

    what: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    open_low: bool = False
    open_high: bool = False
    choices: tuple[str, ...] = ()
    length: tuple[int, int] = (0, 16)
    unset: str = ""

    @property
    def said(self) -> str:
        """The range in words: "from 1e-05 to 1000 m"."""
        if self.choices:
            return "one of " + ", ".join(f'"{c}"' for c in self.choices)
        low, high = (None if v is None else f"{v:.12g}" for v in (self.low, self.high))
        if low is None and high is None:
            return ""
        unit = f" {self.unit}" if self.unit else ""
        if high is None:
            return f"{'over' if self.open_low else 'at least'} {low}{unit}"
        if low is None:
            return f"{'under' if self.open_high else 'at most'} {high}{unit}"
        if not (self.open_low or self.open_high):
            return f"from {low} to {high}{unit}"
        start = f"over {low}" if self.open_low else f"at least {low}"
        return f"{start} and {'under' if self.open_high else 'at most'} {high}{unit}"

    def allow(self, value: float) -> bool:
        """Whether a number is finite and within the range."""
        if isinstance(value, float) and not math.isfinite(value):
            return False
        low = self.low is None or (value > self.low if self.open_low else value >= self.low)
        high = self.high is None or (value < self.high if self.open_high else value <= self.high)
        return low and high


def number(
    default: Any,
    what: str,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
    unit: str = "",
    unset: str = "",
) -> Any:
    """Return a field for a number from `low` to `high`, or over `above` and under `below`."""
    limits = Limits(
        what,
        unit,
        low if above is None else above,
        high if below is None else below,
        above is not None,
        below is not None,
        unset=unset,
    )
    return field(default=default, metadata={"limits": limits})


def listed(default: Any, what: str, *, least: int = 0, most: int = 16, **said: Any) -> Any:
    """Return a field for `least` to `most` numbers, each within a range as in `number`."""
    limits: Limits = dataclasses.replace(
        number(None, what, **said).metadata["limits"], length=(least, most)
    )
    return field(default=default, metadata={"limits": limits})


def choice(default: Any, what: str, choices: Sequence[str]) -> Any:
    """Return a field for one of some words, or where the default is a tuple for some of them."""
    limits = Limits(what, choices=tuple(choices), length=(1, len(choices)))
    return field(default=default, metadata={"limits": limits})


def flag(default: bool, what: str) -> Any:
    """Return a field for true or false."""
    return field(default=default, metadata={"limits": Limits(what)})


class Checked:
    """A dataclass whose fields hold what their limits allow, however it is made.

    Raises
    ------
    UsageError
        A field has another type than its annotation says, or is out of its range.
    """

    section: ClassVar[str] = ""  # of the settings: "raster", ...

    def __post_init__(self) -> None:
        for name, value in checked_values(self, self.section).items():
            object.__setattr__(self, name, value)


def checked_values(record: Any, section: str = "") -> dict[str, Any]:
    """Return a dataclass's fields that have limits, each in its type.

    Raises
    ------
    UsageError
        A field has another type than its annotation says, or is out of its range.
    """
    found = {}
    for item in dataclasses.fields(record):
        if (limits := item.metadata.get("limits")) is not None:
            key = f"{section}.{item.name}" if section else item.name
            found[item.name] = check(key, getattr(record, item.name), str(item.type), limits)
    return found


def check(key: str, value: Any, kind: str, limits: Limits) -> Any:
    """Return `value` as the annotation `kind` wants it.

    Parameters
    ----------
    key : str
        Its name, for the message: "raster.dem_cell".
    value : object
        Numbers may be of NumPy; a list may stand for a tuple.
    kind : str
        "float", "int", "bool", "str", "tuple[float, ...]", "tuple[str, ...]", "Preset",
        'Literal["a", "b"]', each with " | None" too.
    limits : Limits

    Raises
    ------
    UsageError
        Another type or out of the range; the message has the key, the value and the range.
    """
    base = kind.removesuffix(" | None")
    if value is None and base != kind:
        return None
    if base.startswith("tuple["):
        inner = base.removeprefix("tuple[").partition(",")[0]
        if hasattr(value, "tolist"):
            value = value.tolist()
        if isinstance(value, list | tuple):
            items = tuple(_single(item, inner, limits) for item in value)
            least, most = limits.length
            distinct = not limits.choices or len(set(items)) == len(items)
            if None not in items and least <= len(items) <= most and distinct:
                return items
    elif (single := _single(value, base, limits)) is not None:
        return single
    raise UsageError(f"{key} is {shown(value)}; it must be {wanted(kind, limits)}.")


def _single(value: Any, kind: str, limits: Limits) -> Any:
    """Return one value in the type `kind`, None where it is none or out of the range."""
    is_bool = isinstance(value, bool) or type(value).__name__ == "bool_"
    if kind == "bool":
        return bool(value) if is_bool else None
    if kind == "int" and isinstance(value, numbers.Integral) and not is_bool:
        return int(value) if limits.allow(int(value)) else None
    if kind == "float" and isinstance(value, numbers.Real) and not is_bool:
        try:
            real = float(value)
        except OverflowError:  # an integer of hundreds of digits
            return None
        return real if limits.allow(real) else None
    if kind.startswith(("str", "Preset", "Literal")) and isinstance(value, str):
        return value if not limits.choices or value in limits.choices else None
    return None


def wanted(kind: str, limits: Limits) -> str:
    """Return in words what a setting may be: "a number from 1e-05 to 1000 m, or none"."""
    base = kind.removesuffix(" | None")
    nouns = {"float": "a number", "int": "a whole number", "bool": "true or false", "str": "text"}
    said = limits.said
    if base.startswith("tuple["):
        least, most = limits.length
        if limits.choices:
            text = f"a list of some of {said.removeprefix('one of ')}, none twice"
        else:
            count = f"{most}" if least == most else f"{least} to {most}"
            text = f"a list of {count} numbers, each {said}"
    elif limits.choices:
        text = said
    else:
        text = " ".join(part for part in (nouns.get(base, base), said) if part)
    return text if base == kind else f"{text}, or none"


def shown(value: Any, most: int = 60) -> str:
    """Return `value` as Python would write it, shortened for a message."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer too long to be written, or a deep list
        text = f"a {type(value).__name__} too long to be shown"
    return text if len(text) <= most else f"{text[: most - 1]}…"


def parse_toml(text: str) -> dict[str, Any]:
    """Return a TOML document.

    Raises
    ------
    ValueError
        It is no TOML, is larger than `MAX_TOML`, nests deeper than eight tables, or has a number
        that is too long.
    """
    if len(text) > MAX_TOML:
        raise ValueError(f"it has {len(text)} characters; up to {MAX_TOML} are read")
    try:
        document = tomllib.loads(text)
        depth = _depth(document)
    except RecursionError as error:
        raise ValueError("its lists or tables are nested too deeply") from error
    if depth > _DEEPEST:
        raise ValueError(f"its lists or tables are nested {depth} deep; up to {_DEEPEST} are read")
    return document


def _depth(value: Any) -> int:
    if isinstance(value, dict):
        return 1 + max((_depth(item) for item in value.values()), default=0)
    if isinstance(value, list):
        return 1 + max((_depth(item) for item in value), default=0)
    return 0


def read_toml(path: Path, what: str, error: type[MeshregError] = UsageError) -> dict[str, Any]:
    """Read a small TOML file; a pipe or a device is refused without waiting for it.

    Parameters
    ----------
    path : Path
    what : str
        What it is, for the message: "The settings".
    error : type
        What to raise.

    Raises
    ------
    MeshregError
        Of the type `error`: the file cannot be read, is no regular file, or no TOML.
    """
    try:
        return parse_toml(_small_text(path))
    except (OSError, ValueError) as why:
        reason = getattr(why, "strerror", None) or str(why).rstrip(".")
        raise error(
            f"{what} cannot be read: {reason}.",
            file=path,
            remedy="Name a TOML file.",
        ) from why


def _small_text(path: Path) -> str:
    if not stat.S_ISREG(os.stat(path).st_mode):  # before opening, which some devices act upon
        raise ValueError("it is not a regular file")
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    with os.fdopen(handle, "rb") as stream:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise ValueError("it is not a regular file")
        content = stream.read(MAX_TOML + 1)
    if len(content) > MAX_TOML:
        raise ValueError(f"it is larger than {MAX_TOML} bytes")
    return content.decode("utf-8-sig")
