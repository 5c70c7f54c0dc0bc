"""Every setting, with its type, range and default; presets; TOML in and out.

`stages` has one frozen record a stage of the registration; `checked` is what such a record is made
of, and reads TOML within bounds.
"""

from meshreg.settings.stages import (
    METHODS,
    PRESETS,
    WARPS,
    JudgeSettings,
    MutualInformationSettings,
    RasterSettings,
    RefineSettings,
    SearchSettings,
    Settings,
    SiftSettings,
    TerrainSettings,
    WarpSettings,
    read_settings,
    write_settings,
)

__all__ = [
    "METHODS",
    "PRESETS",
    "WARPS",
    "JudgeSettings",
    "MutualInformationSettings",
    "RasterSettings",
    "RefineSettings",
    "SearchSettings",
    "Settings",
    "SiftSettings",
    "TerrainSettings",
    "WarpSettings",
    "read_settings",
    "write_settings",
]
