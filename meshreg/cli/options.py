"""From the words of the command line to settings and read options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from meshreg.errors import UsageError
from meshreg.io.options import FARTHEST, ReadOptions
from meshreg.settings import Settings, read_settings
from meshreg.settings.checked import shown

if TYPE_CHECKING:
    from meshreg.cli.common import SurveyRequest


def join_settings(
    preset: str | None,
    config: Path | None,
    changes: Sequence[str] | None,
    named: Mapping[str, Any],
) -> Settings:
    """Join preset, then file, then named options, then --set."""
    settings = Settings.from_preset(preset or "robust")
    if config is not None:
        settings = read_settings(config, settings)
        if preset is not None and settings.preset != preset:
            raise UsageError(
                f"--preset is {preset}, but the file says {settings.preset}.", file=config
            )
    said = {key: value for key, value in named.items() if value is not None}
    for change in changes or ():
        key, equals, value = change.partition("=")
        if not equals:
            raise UsageError(f"--set {change!r} has no '='.", remedy="Write stage.name=value.")
        said[key.strip()] = value.strip()
    return settings.changed(said)


def read_options(shift: str | None, name: str, **said: Any) -> ReadOptions:
    """Return what the user says of a survey; `name` is the option that gave the shift."""
    plain: dict[str, Any] = {
        key: str(value) if isinstance(value, StrEnum) else value for key, value in said.items()
    }
    said_shift = None if shift is None else _triple(shift, name)
    return ReadOptions(shift=said_shift, **plain).checked()


def survey_request(path: str, shift: str | None, **said: Any) -> SurveyRequest:
    """Return a command's only survey."""
    from meshreg.cli.common import SurveyRequest

    return SurveyRequest(path, read_options(shift, "--shift", **said))


def survey_requests(
    paths: tuple[str, str],
    shifts: tuple[str | None, str | None],
    scale: Sequence[float] | None,
    positions: Sequence[Path] | None,
    **said: Any,
) -> tuple[SurveyRequest, SurveyRequest]:
    """Return the reference and the moving survey; what is `said` holds for both."""
    from meshreg.cli.common import SurveyRequest

    scales, places = for_both("--scale", scale), for_both("--positions", positions)
    reference, moving = (
        SurveyRequest(
            paths[k],
            read_options(
                shifts[k], f"--{which}-shift", **said, scale=scales[k], positions=places[k]
            ),
        )
        for k, which in enumerate(("reference", "moving"))
    )
    return reference, moving


def _triple(text: str, name: str) -> tuple[float, float, float]:
    try:
        east, north, up = (float(part) for part in text.split(","))
        if not all(abs(value) <= FARTHEST for value in (east, north, up)):  # NaN too
            raise ValueError(text)
    except ValueError:
        raise UsageError(
            f"{name} is {shown(text)}; it needs three numbers of up to {FARTHEST:g} m.",
            remedy=f"Write {name} 731000,5705000,0 (east, north, up in metres).",
        ) from None
    return east, north, up


def for_both(name: str, values: Sequence[Any] | None) -> tuple[Any, Any]:
    """One value holds for both surveys; two are the reference's and the moving survey's."""
    if not values:
        return None, None
    if len(values) > 2:
        raise UsageError(f"{name} was given {len(values)} times; once or twice is meant.")
    return values[0], values[-1]
