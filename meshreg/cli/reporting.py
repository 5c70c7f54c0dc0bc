"""`meshreg report` and `meshreg view`; the page that `meshreg register` writes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from meshreg.cli.common import LOG, in_place
from meshreg.cli.console import Terminal
from meshreg.errors import InputError, MeshregError

if TYPE_CHECKING:
    from meshreg.records import Registration

PAGE = "report.html"
_SAVED = ("registration.json", "evidence.npz")  # what the page is made from


def add_report(registration: Registration, folder: Path) -> None:
    """Save the evidence and make the page; one that fails is no reason to lose a result.

    Raises
    ------
    OutputError
        If the files cannot be written.
    """
    missing = "evidence.npz and report.html were"
    try:
        keep_evidence(registration, folder)
        missing = "report.html was"
        write_report(folder)
    except MeshregError:
        raise
    except Exception as error:
        LOG.warning("%s not made: %s", missing, why_not(error))
        LOG.debug("why", exc_info=True)


def why_not(error: Exception) -> str:
    """Say in words why a page was not made."""
    if isinstance(error, MemoryError):
        return "not enough memory"
    return f"{type(error).__name__}: {error}"


def keep_evidence(registration: Registration, folder: Path) -> None:
    """Save in a result's folder what its page needs beyond the record."""
    from meshreg.io.result.evidence import write_evidence
    from meshreg.report import keep

    if kept := keep(registration):
        write_evidence(kept, folder)


def write_report(folder: Path) -> Path:
    """Make a result's page from what is in its folder, whole or not at all.

    Raises
    ------
    InputError
        If there is no result in the folder, or its record or evidence is damaged.
    UsageError
        If the page that is there is not as meshreg wrote it.
    OutputError
        If the page cannot be written.
    """
    from meshreg.io.result.evidence import read_evidence
    from meshreg.io.result.manifest import require_ours, write_into
    from meshreg.io.result.record import read_registration
    from meshreg.report import gather, report_page

    folder = _result_folder(folder)
    require_ours(folder, (PAGE,))
    result = gather(read_registration(folder), read_evidence(folder), folder)
    write_into(folder, {PAGE: report_page(result).encode("utf-8")})
    return folder / PAGE


def remake_report(folder: Path) -> Path:
    """Do `write_report`; a saved result that was changed so that no page shows it is bad input.

    One that is byte for byte as it was written, and cannot be shown, is a bug and stays one.

    Raises
    ------
    InputError
        As `write_report`, and where record and evidence do not fit together.
    """
    try:
        with in_place():
            return write_report(folder)
    except (ArithmeticError, LookupError, TypeError, ValueError, AttributeError) as error:
        from meshreg.io.result.manifest import are_as_written

        if are_as_written(
            Path(folder), [name for name in _SAVED if (Path(folder) / name).exists()]
        ):
            raise
        raise InputError(
            f"cannot be shown: its record and its evidence do not fit ({type(error).__name__}: "
            f"{error}).",
            file=folder,
            remedy="Run `meshreg register` again.",
        ) from error


def _result_folder(folder: Path) -> Path:
    folder = Path(folder)
    if not (folder / "registration.json").is_file():
        raise InputError(
            "holds no registration.json.",
            file=folder,
            remedy="Give the folder that `meshreg register` wrote.",
        )
    return folder


def view(folder: Path) -> None:
    """Show both surfaces of a result in a window; return when it is closed."""
    from meshreg.io.result.evidence import read_evidence
    from meshreg.report import open_view

    folder = _result_folder(folder)
    open_view(read_evidence(folder), folder)


def document(page: Path) -> dict[str, Any]:
    """Return what `meshreg report --json` prints."""
    return {"schema": "meshreg.report/1", "report": str(page), "bytes": page.stat().st_size}


def show(page: Path, voice: Terminal) -> None:
    """Say where the page is."""
    size = page.stat().st_size / 1e6
    voice.say(f"Written: [bold]{escape(str(page))}[/] ({size:.1f} MB). Open it in a browser.")
