"""Every number that a user may change: one frozen dataclass a stage, in metres.

`robust` is the default preset; `paper` is Bryson et al. (IROS 2013) as published. Each setting has
its range beside it (`meshreg.settings.checked`); after a change run `scripts/settings_table.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from meshreg.errors import UsageError
from meshreg.settings.checked import (
    Checked,
    Limits,
    check,
    choice,
    flag,
    listed,
    number,
    parse_toml,
    read_toml,
    shown,
    wanted,
)

Preset = Literal["robust", "paper"]
PRESETS = ("robust", "paper")
METHODS = ("sift", "terrain", "mutual_information")
WARPS = ("none", "auto", "similarity", "dome", "quadratic", "spline")


@dataclass(frozen=True)
class RasterSettings(Checked):
    """Rasterizing (`meshreg.raster`).

    `None` for a cell means: the paper's 0.10 m (DEM) and 0.05 m (orthomosaic), coarser or finer
    as the data's own spacing tells; SIFT at the texture's spacing, not finer than 0.01 to 0.02 m.
    """

    section: ClassVar[str] = "raster"
    dem_cell: float | None = number(
        None, "side of a cell of the DEM", low=1e-5, high=1000, unit="m", unset="from the data"
    )
    ortho_cell: float | None = number(
        None, "of the orthomosaic", low=1e-5, high=1000, unit="m", unset="from the data"
    )
    sift_cell: float | None = number(
        None, "of the image for SIFT", low=1e-5, high=1000, unit="m", unset="from the data"
    )
    fill_cells: int = number(
        1, "holes up to this wide are closed, never wider", low=0, high=100, unit="cells"
    )
    remove_floaters: bool = flag(True, "leave out blobs that float over the ground")
    mask_flat_color: bool = flag(True, "leave out colors of areas of one flat color")
    max_cells: int = number(
        400_000_000, "per raster; more ends with exit code 5", low=1, high=1e12, unit="cells"
    )


@dataclass(frozen=True)
class SearchSettings(Checked):
    """The window of offsets, shared by the methods."""

    section: ClassVar[str] = "search"
    radius: float | None = number(
        None,
        "largest offset east or north",
        above=0,
        high=1e6,
        unit="m",
        unset="10 m, more where the DEM is coarser than 0.10 m",
    )
    min_overlap: float = number(
        0.10, "of the largest in the window (paper: 0.30); less is not scored", low=0, high=1
    )
    max_yaw: float = number(
        8.0,
        "turn either way; with `max_scale` 0 too, offsets alone are searched",
        low=0,
        high=15,
        unit="degrees",
    )
    max_scale: float = number(0.03, "scale either way from 1", low=0, high=0.2)
    free_scale: bool = flag(
        False, "true: fit the scale too; otherwise it stays 1 unless plainly wrong"
    )


@dataclass(frozen=True)
class SiftSettings(Checked):
    """III-B. Paper: nearest neighbour, RANSAC of 10 pairs, inliers within 0.20 m."""

    section: ClassVar[str] = "sift"
    inlier_radius: float = number(
        0.20, "matches this near the consensus agree", above=0, high=1000, unit="m"
    )
    sample: int = number(10, "pairs in a sample of RANSAC", low=1, high=1000)
    inlier_share: float = number(
        0.5, "w of RANSAC: share of inliers that is reckoned with", above=0, below=1
    )
    confidence: float = number(
        0.99, "p of RANSAC: that a sample without outliers is drawn", above=0, below=1
    )
    max_features: int = number(20_000, "features of an image", low=10, high=1_000_000)
    tile: int = number(2048, "larger images are worked in tiles", low=64, high=32_768, unit="px")
    max_false_alarms: float = number(
        1e-3, "robust: a-contrario number of false alarms", above=0, high=1e6
    )
    exhaustive_vote: bool = flag(True, "robust; false is the paper's RANSAC")
    ratio: float = number(
        0.9,
        "robust: nearest over second nearest descriptor distance; 1.0 keeps all",
        above=0,
        high=1,
    )


@dataclass(frozen=True)
class TerrainSettings(Checked):
    """III-C. Paper: mean squared height difference over the product of spreads."""

    section: ClassVar[str] = "terrain"
    high_pass: tuple[float, ...] = listed(
        (2.0, 5.0),
        "sigma of the smoothing that is taken off the heights; empty is the paper's raw height",
        most=8,
        above=0,
        high=1000,
        unit="cells",
    )


@dataclass(frozen=True)
class MutualInformationSettings(Checked):
    """III-D. Paper: 256 grey values, direct count."""

    section: ClassVar[str] = "mutual_information"
    bins: int = number(
        8, "grey values of the histogram; more find no more and take longer", low=2, high=256
    )
    high_pass: float = number(
        0.5,
        "sigma of the local mean and spread that are removed; 0 is raw grey",
        low=0,
        high=1000,
        unit="m",
    )
    direct: bool = flag(False, "the paper's direct count over all bins")


@dataclass(frozen=True)
class JudgeSettings(Checked):
    """Accept, review or reject (`meshreg.judge`)."""

    section: ClassVar[str] = "judge"
    agree_distance: float = number(
        0.25,
        "answers this near agree; 1/20 of a smaller plot's side, or 2.5 DEM cells where more",
        above=0,
        high=1000,
        unit="m",
    )
    min_overlap: float = number(
        0.25, "of the smaller survey's cells; less goes to review", low=0, high=1
    )
    support_gap: float = number(
        1.5, "a channel that puts a place first by this much supports it", low=0, high=1000
    )
    accept_gap: float = number(4.0, "by this much, it is believed", low=0, high=1000)
    overwhelming_gap: float = number(
        7.0, "by this much, one channel alone is believed", low=0, high=1000
    )
    max_false_alarm: float = number(1e-6, "more is not accepted", low=0, high=1)
    chance_false_alarm: float = number(1e-3, "more is chance: rejected", low=0, high=1)
    # What depths good to 5 cm feign. Where a survey is flatter and no offset stands out, that is
    # not taken for another place.
    flat_relief: float = number(
        0.10,
        "of 98 % of the heights about their surroundings; less may be any place",
        low=0,
        high=1000,
        unit="m",
    )


@dataclass(frozen=True)
class RefineSettings(Checked):
    """From a cell to a millimetre (`meshreg.refine`, `heights`, `surfaces`)."""

    section: ClassVar[str] = "refine"
    surfaces: str = choice(
        "none",
        "a last step on the 3-D surfaces: generalized or robust point-to-plane ICP",
        ("none", "gicp", "icp"),
    )


@dataclass(frozen=True)
class WarpSettings(Checked):
    """The non-rigid answer (`deformation`); the internal error is measured whatever this says."""

    section: ClassVar[str] = "warp"
    model: str = choice("none", "the bend that is applied", WARPS)
    max_strain: float = number(
        0.01,
        "a bend that changes lengths across the survey by more (rms) is not applied",
        low=0,
        high=1,
    )


@dataclass(frozen=True)
class Settings(Checked):
    """All stages together."""

    preset: Preset = choice("robust", "more robust methods, or exactly as published", PRESETS)
    methods: tuple[str, ...] = choice(METHODS, "that look for the offset", METHODS)
    seed: int = number(0, "of every random draw", low=0, high=2**31 - 1)
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
        raise UsageError(f"Unknown preset {shown(preset)}.", remedy='Use "robust" or "paper".')

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
        If the file is no TOML, a key is unknown, or a value is of another type or out of range.
    """
    path = Path(path)
    document = read_toml(path, "Settings")
    try:
        preset = document.pop("preset", None)
        if preset is not None:
            base = Settings.from_preset(preset)
        return (base or Settings()).changed(_flat(document))
    except UsageError as error:
        raise UsageError(error.message, file=path, remedy=error.remedy) from error


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
            f"Unknown setting {shown(key)}.", remedy=f"Here there are: {', '.join(sorted(names))}."
        )
    present = getattr(record, path[0])
    if is_dataclass(present) != (len(path) > 1):
        raise UsageError(
            f"{shown(key)} does not name a single setting.", remedy="Use stage.name=value."
        )
    if len(path) > 1:
        value = _set(present, key, path[1:], value)
    else:
        item = names[path[0]]
        value = _coerce(key, value, str(item.type), item.metadata["limits"])
    return dataclasses.replace(record, **{path[0]: value})


def _coerce(key: str, value: Any, kind: str, limits: Limits) -> Any:
    """Fit a TOML value (or its text) to the annotation `kind` and the range."""
    base = kind.removesuffix(" | None")
    if isinstance(value, str) and base not in ("str", "Preset"):
        if base != kind and value.lower() in ("none", "auto", ""):
            return None
        if base == "tuple[str, ...]" and not value.startswith("["):
            value = tuple(part.strip() for part in value.split(",") if part.strip())
        else:
            try:
                value = parse_toml(f"v = {value}")["v"]
            except ValueError as error:
                said = f"{key} is {shown(value)}; it must be {wanted(kind, limits)}."
                raise UsageError(said) from error
    return check(key, value, kind, limits)
