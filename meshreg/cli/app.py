"""The command line: arguments in, exit codes out. Nothing else in the package prints.

Exit codes: 0 accepted or done, 1 a bug, 2 usage, 3 bad input, 4 review or rejected, 5 resource
limit, 6 output not written, 130 and 143 stopped by a signal.
"""

from __future__ import annotations

import atexit
import errno
import gc
import io
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import typer

from meshreg import __version__
from meshreg.cli.arguments import (
    AllowSameOption,
    AxesOption,
    ConfigOption,
    DebugOption,
    DemCellOption,
    GeometryOnlyOption,
    JsonOption,
    MaskOption,
    MaybeOutOption,
    OrthoCellOption,
    OutOption,
    OverwriteOption,
    PositionsListOption,
    PositionsOption,
    Preset,
    ReferenceArgument,
    ResultArgument,
    ScaleOption,
    ScalesOption,
    SetOption,
    ShiftOption,
    SurveyArgument,
    UnitOption,
    UpOption,
    WarpModel,
)
from meshreg.cli.options import join_settings, survey_request, survey_requests
from meshreg.errors import MeshregError, OutputError, UsageError

if TYPE_CHECKING:
    from meshreg.cli.console import Terminal
    from meshreg.cli.guard import Unfinished

Result = TypeVar("Result")
# Typer carries its own click or uses the installed one; this is the root of its errors either way.
_ClickError = typer.BadParameter.__mro__[2]
_UNWRITABLE = (errno.ENOSPC, errno.EPIPE, errno.EBADF, errno.EIO, errno.EDQUOT)

app = typer.Typer(
    name="meshreg",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="Register repeat surveys of the seafloor straight from structure-from-motion exports.",
)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        typer.echo(f"meshreg {__version__}")
        raise typer.Exit(0)
    del context


@app.command()
def register(
    reference: ReferenceArgument,
    moving: Annotated[str, typer.Argument(help="Repeat survey, laid on the reference.")],
    out: OutOption,
    reference_shift: ShiftOption = None,
    moving_shift: ShiftOption = None,
    axes: AxesOption = None,
    up: UpOption = None,
    unit: UnitOption = None,
    mask: MaskOption = None,
    search_radius: Annotated[
        float | None, typer.Option(help="Largest offset east or north in metres; 10.")
    ] = None,
    dem_cell: DemCellOption = None,
    ortho_cell: OrthoCellOption = None,
    sift_cell: Annotated[
        float | None, typer.Option(help="SIFT cell in metres; from the data.")
    ] = None,
    methods: Annotated[
        str | None, typer.Option(help="Some of sift,terrain,mutual_information.")
    ] = None,
    preset: Annotated[Preset | None, typer.Option(help="robust, or paper as published.")] = None,
    warp: Annotated[
        WarpModel | None,
        typer.Option(help="Bend the moving survey too, where its tiles show it: none, or auto."),
    ] = None,
    config: ConfigOption = None,
    changes: SetOption = None,
    seed: Annotated[int | None, typer.Option(help="Seed of every random draw; 0.")] = None,
    scale: ScalesOption = None,
    positions: PositionsListOption = None,
    geometry_only: GeometryOnlyOption = False,
    ties: Annotated[
        str | None, typer.Option(metavar="FILE", help="Points picked by hand, one more method.")
    ] = None,
    allow_same: AllowSameOption = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Lay the MOVING (repeat) survey on the REFERENCE (original) one.

    OUT receives the registered survey in its own format, the record with the verdict, both
    surveys' maps on one grid, figures and log. Exit code 0: accepted; 4: review or rejected.

    --axes, --up and --unit hold for both surveys; where they differ, say so in a
    NAME.survey.toml beside each file.
    """
    del debug
    from meshreg.cli import registering, result
    from meshreg.io.result.document import registration_document

    settings = join_settings(
        preset,
        config,
        changes,
        {
            "search.radius": search_radius,
            "raster.dem_cell": dem_cell,
            "raster.ortho_cell": ortho_cell,
            "raster.sift_cell": sift_cell,
            "methods": methods,
            "warp.model": None if warp is None else str(warp),
            "seed": seed,
        },
    )
    surveys = survey_requests(
        (reference, moving),
        (reference_shift, moving_shift),
        scale,
        positions,
        axes=axes,
        up=up,
        unit=unit,
        geometry_only=geometry_only,
    )
    request = registering.RegisterRequest(
        *surveys,
        out,
        tuple(mask or ()),
        settings,
        overwrite,
        ties,
        config,
        allow_same,
    )
    registration = _done(
        as_json,
        lambda voice, unfinished: registering.register(request, voice, unfinished),
        lambda registration, voice: result.show(registration, out, voice),
        registration_document,
    )
    return 0 if registration.verdict == "accepted" else 4


@app.command()
def report(
    out: ResultArgument,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Make report.html of a result again, from what was saved in its folder."""
    del debug
    from meshreg.cli import reporting

    _done(
        as_json,
        lambda voice, unfinished: reporting.remake_report(out),
        reporting.show,
        reporting.document,
    )
    return 0


@app.command()
def view(
    out: ResultArgument,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Show both surfaces of a result in a window, to turn about."""
    del as_json, debug
    from meshreg.cli import reporting
    from meshreg.cli.guard import run_stoppable

    run_stoppable(lambda unfinished: reporting.view(out))
    return 0


@app.command()
def rasterize(
    survey: SurveyArgument,
    out: OutOption,
    shift: ShiftOption = None,
    axes: AxesOption = None,
    up: UpOption = None,
    unit: UnitOption = None,
    mask: MaskOption = None,
    dem_cell: DemCellOption = None,
    ortho_cell: OrthoCellOption = None,
    scale: ScaleOption = None,
    positions: PositionsOption = None,
    geometry_only: GeometryOnlyOption = False,
    config: ConfigOption = None,
    changes: SetOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Turn a survey into a DEM and an orthomosaic (GeoTIFF, cloud-optimized)."""
    del debug
    from meshreg.cli import mapping

    cells = {"raster.dem_cell": dem_cell, "raster.ortho_cell": ortho_cell}
    settings = join_settings(None, config, changes, cells)
    named = survey_request(
        survey,
        shift,
        axes=axes,
        up=up,
        unit=unit,
        scale=scale,
        positions=positions,
        geometry_only=geometry_only,
    )
    request = mapping.RasterizeRequest(named, out, tuple(mask or ()), settings, overwrite, config)
    _done(
        as_json,
        lambda voice, unfinished: mapping.rasterize(request, voice, unfinished),
        mapping.show_maps,
    )
    return 0


@app.command()
def apply(
    registration: Annotated[Path, typer.Argument(help="registration.json, or its folder.")],
    survey: Annotated[str, typer.Argument(help="Any further file of the same moving survey.")],
    out: OutOption,
    shift: ShiftOption = None,
    axes: AxesOption = None,
    up: UpOption = None,
    unit: UnitOption = None,
    geometry_only: GeometryOnlyOption = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Move any further file of the same survey by a registration that was found."""
    del debug
    from meshreg.cli import applying

    named = survey_request(survey, shift, axes=axes, up=up, unit=unit, geometry_only=geometry_only)
    request = applying.ApplyRequest(registration, named, out, overwrite)
    _done(
        as_json,
        lambda voice, unfinished: applying.apply(request, voice, unfinished),
        applying.show_applied,
    )
    return 0


@app.command()
def info(
    survey: SurveyArgument,
    shift: ShiftOption = None,
    axes: AxesOption = None,
    up: UpOption = None,
    unit: UnitOption = None,
    scale: ScaleOption = None,
    positions: PositionsOption = None,
    geometry_only: GeometryOnlyOption = False,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Say what is in a survey: counts, bounds, spacing, textures, CRS, up axis and unit."""
    del debug
    from meshreg.cli import info as describing
    from meshreg.cli.common import read

    request = survey_request(
        survey,
        shift,
        axes=axes,
        up=up,
        unit=unit,
        scale=scale,
        positions=positions,
        geometry_only=geometry_only,
    )
    _done(as_json, lambda voice, unfinished: describing.describe(read(request)), describing.show)
    return 0


@app.command()
def doctor(as_json: JsonOption = False, debug: DebugOption = False) -> int:
    """Say what this machine lacks, and the command that brings it."""
    del debug
    from meshreg.cli import machine
    from meshreg.doctor import examine

    checks = _done(as_json, lambda voice, unfinished: examine(), machine.show, machine.document)
    return 0 if all(check.state != "missing" for check in checks) else 5


@app.command()
def demo(
    out: OutOption = Path("meshreg_demo"),
    real: Annotated[
        bool, typer.Option("--real", help="Two drone surveys of a beach instead of a made reef.")
    ] = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Make two surveys of a reef, do the main job on them, and compare with the truth."""
    del debug
    from meshreg.cli import demonstrating

    demonstrating.introduce(real, _voice(as_json))
    job = demonstrating.real if real else demonstrating.made
    done = _done(
        as_json,
        lambda voice, unfinished: job(out, overwrite, voice, unfinished),
        lambda done, voice: demonstrating.show(done, out, voice),
        demonstrating.document,
    )
    return 0 if done.registration.verdict == "accepted" else 4


@app.command()
def synth(
    scenario: Annotated[str, typer.Argument(help="A scenario's name, or a recipe's TOML file.")],
    out: OutOption,
    kind: Annotated[
        str | None,
        typer.Option("--format", help="obj, ply, ply-cloud, laz, glb, colmap or images."),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="Another seed is another seafloor.")
    ] = 0,
    size: Annotated[
        float | None, typer.Option(help="Side of the patch in metres, 1 to 1000.")
    ] = None,
    changes: SetOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Make a pair of surveys of a seafloor that is known, with the truth beside them."""
    del debug
    from meshreg.cli import making

    request = making.SynthRequest(
        scenario, out, kind, seed, size, making.parse_changes(changes), overwrite
    )
    _done(as_json, lambda voice, unfinished: making.synth(request, voice), making.show)
    return 0


@app.command()
def selftest(
    reference: ReferenceArgument,
    moving: Annotated[str, typer.Argument(help="Repeat survey, into which shifts are put.")],
    out: MaybeOutOption = None,
    count: Annotated[int, typer.Option("--shifts", min=1, max=1000, help="How many shifts.")] = 8,
    reference_shift: ShiftOption = None,
    moving_shift: ShiftOption = None,
    axes: AxesOption = None,
    up: UpOption = None,
    unit: UnitOption = None,
    mask: MaskOption = None,
    config: ConfigOption = None,
    changes: SetOption = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the shifts; 0.")] = None,
    scale: ScalesOption = None,
    positions: PositionsListOption = None,
    geometry_only: GeometryOnlyOption = False,
    allow_same: AllowSameOption = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Put known shifts into the MOVING survey, recover them blind, say what can be resolved.

    Exit code 0: the pair itself is accepted; 4: review or rejected.
    """
    del debug
    from meshreg.cli import selftesting

    settings = join_settings(None, config, changes, {"seed": seed})
    surveys = survey_requests(
        (reference, moving),
        (reference_shift, moving_shift),
        scale,
        positions,
        axes=axes,
        up=up,
        unit=unit,
        geometry_only=geometry_only,
    )
    request = selftesting.SelftestRequest(
        *surveys,
        out,
        tuple(mask or ()),
        settings,
        count,
        overwrite,
        config,
        allow_same,
    )
    document = _done(
        as_json,
        lambda voice, unfinished: selftesting.selftest(request, voice, unfinished),
        selftesting.show,
    )
    return 0 if document["verdict"] == "accepted" else 4


@app.command()
def benchmark(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for pairs, tables, page.")],
    scenarios: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Some of the scenarios; all.")
    ] = None,
    repeats: Annotated[
        int | None, typer.Option(help="Pairs of each ground and interval; 21.")
    ] = None,
    elsewhere: Annotated[
        int | None, typer.Option(metavar="N", help="Pairs of different places; 1000.")
    ] = None,
    size: Annotated[float | None, typer.Option(help="Side of the patches in metres; 12.")] = None,
    workers: Annotated[int, typer.Option(min=0, max=1024, help="Processes.")] = 2,
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**31 - 1, help="Seed of every pair; 0.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where it stopped.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Start afresh.")] = False,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Repeat the paper's experiment on pairs with known truth. Exit code 4: not as expected."""
    del debug
    from meshreg.cli import benchmarking
    from meshreg.cli.guard import StoppedError

    request = benchmarking.BenchmarkRequest(
        out, scenarios, repeats, elsewhere, size, seed, workers, resume, overwrite
    )
    try:
        summary = _done(
            as_json,
            lambda voice, unfinished: benchmarking.benchmark(request, voice, unfinished),
            lambda summary, voice: benchmarking.show(summary, out, voice),
        )
    except StoppedError as stopped:
        stopped.add_note("what is done is kept, --resume goes on.")
        raise
    return 4 if summary["unmet"] else 0


@app.command()
def pick(
    reference: Annotated[str, typer.Argument(help="Original survey, or a registration's folder.")],
    moving: Annotated[str | None, typer.Argument(help="Repeat survey.")] = None,
    ties: Annotated[Path, typer.Option("--out", "-o", help="The pairs, as CSV; resumed.")] = Path(
        "ties.csv"
    ),
    registration: Annotated[
        Path | None, typer.Option(metavar="OUT", help="Pan together by a registration.")
    ] = None,
    reference_shift: ShiftOption = None,
    moving_shift: ShiftOption = None,
    axes: AxesOption = None,
    up: UpOption = None,
    unit: UnitOption = None,
    scale: ScalesOption = None,
    positions: PositionsListOption = None,
    cell: Annotated[float | None, typer.Option(help="Cell of the pictures; from the data.")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser", help="Open the page there.")] = False,
    allow_same: AllowSameOption = False,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Pick tie points by hand, on a page that this machine alone can open.

    Give the two surveys as to `register`, or the folder that it wrote. Each pair is saved at once;
    Ctrl-C ends, the same command goes on.
    """
    del debug
    from meshreg.cli import picking

    if moving is None and registration is not None:
        raise UsageError("--registration goes with two surveys; a folder has its own.")
    surveys = survey_requests(
        (reference, moving or ""),
        (reference_shift, moving_shift),
        scale,
        positions,
        axes=axes,
        up=up,
        unit=unit,
    )
    request = picking.PickRequest(
        surveys[0],
        surveys[1] if moving else None,
        ties,
        registration,
        cell,
        port,
        browser,
        allow_same=allow_same,
    )
    picking.pick(request, _voice(as_json))
    return 0


@app.command()
def validate(
    out: Annotated[Path, typer.Argument(help="Folder of a registration.")],
    ties: Annotated[
        str, typer.Argument(help="Pairs: ties.csv, Metashape or TagLab; or REFERENCE,MOVING files.")
    ],
    reference_ortho: Annotated[
        Path | None, typer.Option(help="Orthomosaic that TagLab's pixels are of; OUT's own.")
    ] = None,
    moving_ortho: Annotated[
        Path | None, typer.Option(help="The same of the moving survey as delivered.")
    ] = None,
    radius: Annotated[float, typer.Option(help="Pairs within this distance agree; metres.")] = 0.20,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the RANSAC.")] = 0,
    as_json: JsonOption = False,
    debug: DebugOption = False,
) -> int:
    """Hold a registration against points picked by hand. Exit code 4: they do not confirm it.

    As in the paper: the pairs' own translation by RANSAC, their mean residual, and the distance of
    each method's offset and of the result from it. Written to OUT/validation.json and .html.
    """
    del debug
    from meshreg.cli import validating

    request = validating.ValidateRequest(out, ties, reference_ortho, moving_ortho, radius, seed)
    document, _ = _done(
        as_json,
        lambda voice, unfinished: validating.validate(request),
        lambda done, voice: validating.show(*done, out, voice),
        lambda done: done[0],
    )
    return 0 if document["confirmed"] else 4


def _done(
    as_json: bool,
    job: Callable[[Terminal, Unfinished], Result],
    show: Callable[[Result, Terminal], None],
    document: Callable[[Result], Any] | None = None,
) -> Result:
    """Do a job, then print what came of it: for people, or as one JSON document."""
    from meshreg.cli.guard import run_stoppable

    voice = _voice(as_json)
    result = run_stoppable(lambda unfinished: job(voice, unfinished))
    try:
        if as_json:
            voice.document(result if document is None else document(result))
        else:
            show(result, voice)
        sys.stdout.flush()
    except BrokenPipeError:
        pass  # nobody listens any more; what was done is done, and the exit code tells of it
    return result


def _voice(as_json: bool) -> Terminal:
    from meshreg.cli.console import Terminal

    return Terminal(as_json)


def run(arguments: Sequence[str]) -> int:
    """Run one command; return its exit code."""
    as_json, debug = "--json" in arguments, "--debug" in arguments
    try:
        code = app(list(arguments), prog_name="meshreg", standalone_mode=False)
    except BrokenPipeError:
        return 0  # nobody listens any more
    except BaseException as error:
        try:
            return _failed(error, as_json, debug)
        except OSError:  # where it would be said cannot be written either
            return getattr(error, "exit_code", OutputError.exit_code)
    if code == 130:  # Ctrl-C before or after the job itself
        return _failed(KeyboardInterrupt(), as_json, debug)
    return int(code or 0)


def _failed(error: BaseException, as_json: bool, debug: bool) -> int:
    """Say what went wrong in one line; the traceback only where it was asked for."""
    from meshreg.cli.common import out_of_memory
    from meshreg.cli.guard import StoppedError

    if isinstance(error, SystemExit) and isinstance(error.__context__, BrokenPipeError):
        return 0  # how rich ends when nobody listens to a help page
    if isinstance(error, OSError) and error.filename is None and error.errno in _UNWRITABLE:
        why = os.strerror(error.errno)
        error = OutputError(f"cannot be written: {why}.", file="standard output")
    if isinstance(error, SystemExit | typer.Exit | typer.Abort):
        code = getattr(error, "exit_code", getattr(error, "code", 1))
        return code if isinstance(code, int) else 1
    voice = _voice(as_json)
    if isinstance(error, KeyboardInterrupt | StoppedError):
        kept = getattr(error, "__notes__", ["nothing was written."])
        voice.err.print(f"Stopped; {kept[0]}")
        return error.exit_code if isinstance(error, StoppedError) else 130
    if debug and not isinstance(error, _ClickError):
        voice.err.print("".join(traceback.format_exception(error)), markup=False)
    if isinstance(error, MemoryError):
        error = out_of_memory(error)
    if isinstance(error, MeshregError):
        voice.error(error)
        return error.exit_code
    if isinstance(error, _ClickError):
        return _usage(error, voice)
    bug = MeshregError(
        f"internal error: {type(error).__name__}: {error}",
        remedy="This is a bug in meshreg. Please report it with what --debug shows.",
    )
    voice.error(bug)
    return 1


def _usage(error: Any, voice: Terminal) -> int:
    if voice.as_json:
        voice.error(UsageError(error.format_message(), remedy="See meshreg --help."))
    else:
        from typer import rich_utils

        rich_utils.rich_format_error(error)
    return int(error.exit_code)


def main() -> NoReturn:
    """Entry point of the command `meshreg`."""
    gc.set_threshold(50_000, 20, 100)  # arrays make no cycles; the search for some took 0.4 s
    _mend_streams()
    code = run(sys.argv[1:])
    # What Python does at its end takes half a second where kernels were used, and nothing of ours
    # waits for it: what has to be done is done here.
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (BrokenPipeError, ValueError):
        pass  # nobody listens any more
    except OSError:
        code = code or OutputError.exit_code
    os._exit(code)


def _mend_streams() -> None:
    """Let nothing fail for closed standard streams, or for letters that a terminal lacks."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:  # closed: else the next file that is opened would get its number
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


if __name__ == "__main__":
    main()
