"""Arguments and options that several commands share, each declared once."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Axes(StrEnum):
    """What a file's x, y, z are."""

    enu = "enu"
    ned = "ned"


class Up(StrEnum):
    """Which axis of a file points up."""

    y = "y"
    z = "z"


class Preset(StrEnum):
    """Methods as they work best, or exactly as published."""

    robust = "robust"
    paper = "paper"


class WarpModel(StrEnum):
    """How the moving survey may be bent after its rigid move."""

    none = "none"
    auto = "auto"
    similarity = "similarity"
    dome = "dome"
    quadratic = "quadratic"
    spline = "spline"


# surveys and folders
SurveyArgument = Annotated[str, typer.Argument(help="File, folder or quoted glob.")]
ReferenceArgument = Annotated[
    str, typer.Argument(help="Original survey: file, folder or quoted glob.")
]
ResultArgument = Annotated[Path, typer.Argument(help="Folder that `register` wrote.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the result.")]
MaybeOutOption = Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the result.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace a former result.")]

# what the files do not say themselves
ShiftOption = Annotated[
    str | None,
    typer.Option(
        metavar="E,N,U", help="Add to its coordinates in metres; replaces a sidecar's shift."
    ),
]
AxesOption = Annotated[Axes | None, typer.Option(help="Axes of the file(s): enu, or ned (ACFR).")]
UpOption = Annotated[Up | None, typer.Option(help="Axis of the file(s) that points up.")]
UnitOption = Annotated[str | None, typer.Option(help="Unit of the file(s): m, cm, mm, ft, us-ft.")]
ScaleOption = Annotated[float | None, typer.Option(help="Metres per unit of a COLMAP model.")]
ScalesOption = Annotated[
    list[float] | None,
    typer.Option(help="Metres per unit of a COLMAP model; give twice for reference and moving."),
]
PositionsOption = Annotated[
    Path | None, typer.Option(help="Camera positions of a COLMAP model (CSV).")
]
PositionsListOption = Annotated[
    list[Path] | None,
    typer.Option(help="Camera positions of a COLMAP model (CSV); twice for reference and moving."),
]
GeometryOnlyOption = Annotated[
    bool,
    typer.Option("--geometry-only", help="Leave out textures, however broken they are."),
]
AllowSameOption = Annotated[
    bool,
    typer.Option("--allow-same", help="Both surveys may be the very same files."),
]
MaskOption = Annotated[
    list[str] | None,
    typer.Option(
        "--mask",
        metavar="[reference:|moving:][not:]FILE",
        help="Raster or polygons of what to use, or not; repeatable.",
    ),
]

# settings
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="STAGE.NAME=VALUE", help="Any other setting; repeatable."),
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", metavar="FILE.toml", help="Settings from a file.")
]
DemCellOption = Annotated[float | None, typer.Option(help="DEM cell in metres; from the data.")]
OrthoCellOption = Annotated[
    float | None, typer.Option(help="Mosaic cell in metres; from the data.")
]

# what is printed
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document, nothing else.")]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
