"""Every number that a user may change: one frozen dataclass a stage, in metres.

`robust` is the default preset; `paper` is Bryson et al. (IROS 2013) as published.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

from meshreg.errors import UsageError

Preset = Literal["robust", "paper"]
METHODS = ("sift", "terrain", "mutual_information")


@dataclass(frozen=True)
class RasterSettings:
    """Rasterizing (`meshreg.raster`).

    `None` for a cell means: the paper's 0.10 m (DEM) and 0.05 m (orthomosaic), coarser or finer
    as the data's own spacing tells; SIFT at the texture's spacing, not finer than 0.01 to 0.02 m.
    """

    dem_cell: float | None = None
    ortho_cell: float | None = None
    sift_cell: float | None = None
    fill_cells: int = 1  # holes up to this many cells wide are closed, never more
    remove_floaters: bool = True
    mask_flat_color: bool = True
    max_cells: int = 400_000_000  # per raster; more is a ResourceLimitError


@dataclass(frozen=True)
class SearchSettings:
    """The window of offsets, shared by the methods."""

    radius: float | None = (
        None  # per axis [m]; None: 10 m, more where the DEM is coarser than 0.10 m
    )
    min_overlap: float = 0.10  # of the largest in the window (paper: 0.30); less is not scored
    max_yaw: float = 8.0  # [degrees] either way; with max_scale 0 too, offsets alone are searched
    max_scale: float = 0.03  # either way from 1
    free_scale: bool = False  # True: fit the scale too; otherwise it stays 1 unless plainly wrong


@dataclass(frozen=True)
class SiftSettings:
    """III-B. Paper: nearest neighbour, RANSAC of 10 pairs, inliers within 0.20 m."""

    inlier_radius: float = 0.20
    sample: int = 10
    inlier_share: float = 0.5  # w
    confidence: float = 0.99  # p
    max_features: int = 20_000
    tile: int = 2048  # px; larger images are worked in tiles
    max_false_alarms: float = 1e-3  # robust: a-contrario number of false alarms
    exhaustive_vote: bool = True  # robust; False is the paper's RANSAC
    ratio: float = 0.9  # robust: nearest over second nearest descriptor distance; 1.0 keeps all


@dataclass(frozen=True)
class TerrainSettings:
    """III-C. Paper: mean squared height difference over the product of spreads."""

    high_pass: tuple[float, ...] = (2.0, 5.0)  # sigma in DEM cells; empty is the paper's raw height


@dataclass(frozen=True)
class MutualInformationSettings:
    """III-D. Paper: 256 grey values, direct count."""

    bins: int = 8  # a finer histogram finds no more and takes longer
    high_pass: float = 0.5  # sigma [m] of the local mean and spread that are removed; 0 is raw grey
    direct: bool = False  # the paper's direct count over all bins


@dataclass(frozen=True)
class JudgeSettings:
    """Accept, review or reject (`meshreg.judge`)."""

    agree_distance: float = 0.25  # [m], or 2.5 DEM cells where that is more
    min_overlap: float = 0.25  # of the smaller survey's cells; less goes to review
    support_gap: float = 1.5  # a channel that puts a place first by this much supports it
    accept_gap: float = 4.0
    overwhelming_gap: float = 7.0
    max_false_alarm: float = 1e-6  # more is not accepted
    chance_false_alarm: float = 1e-3  # more is chance: rejected
    # [m], of 98 % of the heights about their surroundings: what depths good to 5 cm feign. Where a
    # survey is flatter and no offset stands out, that is not taken for another place.
    flat_relief: float = 0.10


@dataclass(frozen=True)
class RefineSettings:
    """From a cell to a millimetre (`meshreg.refine`, `heights`, `surfaces`)."""

    surfaces: str = "none"  # "gicp": a last step on the 3-D surfaces, with Open3D


@dataclass(frozen=True)
class WarpSettings:
    """The non-rigid answer (`meshreg.warp`); the internal error is measured whatever this says."""

    model: str = "none"  # "auto", or one of "similarity", "dome", "quadratic", "spline"
    # a bend that changes lengths across the survey by more (rms, `ladder.strain`) is not applied
    max_strain: float = 0.01


@dataclass(frozen=True)
class Settings:
    """All stages together."""

    preset: Preset = "robust"
    methods: tuple[str, ...] = METHODS
    seed: int = 0
    raster: RasterSettings = field(default_factory=RasterSettings)
    search: SearchSettings = field(default_factory=SearchSettings)
    sift: SiftSettings = field(default_factory=SiftSettings)
    terrain: TerrainSettings = field(default_factory=TerrainSettings)
    mutual_information: MutualInformationSettings = field(default_factory=MutualInformationSettings)
    judge: JudgeSettings = field(default_factory=JudgeSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    warp: WarpSettings = field(default_factory=WarpSettings)

    @classmethod
    def from_preset(cls, preset: str) -> Settings:
        """Return the settings called "robust" or "paper"."""
        if preset == "robust":
            return cls()
        if preset == "paper":
            return cls(
                preset="paper",
                search=SearchSettings(min_overlap=0.30, max_yaw=0.0, max_scale=0.0),
                sift=SiftSettings(exhaustive_vote=False, ratio=1.0),
                terrain=TerrainSettings(high_pass=()),
                mutual_information=MutualInformationSettings(bins=256, high_pass=0.0, direct=True),
            )
        raise UsageError(f"Unknown preset {preset!r}.", remedy='Use "robust" or "paper".')

    def changed(self, changes: Mapping[str, Any]) -> Settings:
        """Return a copy with `{"stage.name": value}` set; strings are read as TOML values."""
        settings = self
        for key, value in changes.items():
            settings = _set(settings, key, key.split("."), value)
        return settings

    def as_dict(self) -> dict[str, Any]:
        """Plain nested dictionaries, for TOML and JSON (None is left out)."""
        return dict(_without_none(dataclasses.asdict(self)))


def read_settings(path: str | Path, base: Settings | None = None) -> Settings:
    """Read a TOML file written by `write_settings` or by hand.

    Its `preset`, if any, is applied first; every other key changes one value.

    Raises
    ------
    UsageError
        If the file is no TOML, or a key or a value's type is unknown.
    """
    path = Path(path)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"Settings cannot be read: {error}.", file=path) from error
    preset = document.pop("preset", None)
    settings = (
        base if base is not None and preset is None else Settings.from_preset(preset or "robust")
    )
    return settings.changed(_flat(document))


def write_settings(settings: Settings) -> str:
    """Return the settings as TOML text that `read_settings` reads back to the same record."""
    import tomli_w

    return str(tomli_w.dumps(settings.as_dict()))


def _flat(document: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in document.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return list(value) if isinstance(value, tuple) else value


def _set(record: Any, key: str, path: list[str], value: Any) -> Any:
    names = {f.name: f for f in fields(record)}
    if path[0] not in names:
        raise UsageError(
            f"Unknown setting {key!r}.", remedy=f"Here there are: {', '.join(sorted(names))}."
        )
    present = getattr(record, path[0])
    if is_dataclass(present) != (len(path) > 1):
        raise UsageError(f"{key!r} does not name a single setting.", remedy="Use stage.name=value.")
    if len(path) > 1:
        value = _set(present, key, path[1:], value)
    else:
        value = _coerce(key, value, str(names[path[0]].type))
    return dataclasses.replace(record, **{path[0]: value})


def _coerce(key: str, value: Any, kind: str) -> Any:
    """Fit a TOML value (or its text) to the annotation `kind`; the annotation is the one schema."""
    optional = kind.endswith(" | None")
    base = kind.removesuffix(" | None")
    if isinstance(value, str) and base not in ("str", "Preset"):
        if optional and value.lower() in ("none", "auto", ""):
            return None
        if base == "tuple[str, ...]" and not value.startswith("["):
            return tuple(part.strip() for part in value.split(",") if part.strip())
        try:
            value = tomllib.loads(f"v = {value}")["v"]
        except tomllib.TOMLDecodeError as error:
            raise UsageError(f"{key} = {value!r} is not a value of type {kind}.") from error
    if value is None and optional:
        return None
    if base == "float" and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if base == "int" and isinstance(value, int) and not isinstance(value, bool):
        return value
    if base == "bool" and isinstance(value, bool):
        return value
    if base in ("str", "Preset") and isinstance(value, str):
        return value
    if base == "tuple[float, ...]" and isinstance(value, list | tuple):
        return tuple(float(item) for item in value)
    if base == "tuple[str, ...]" and isinstance(value, list | tuple):
        return tuple(str(item) for item in value)
    raise UsageError(f"{key} = {value!r} is not a value of type {kind}.")
