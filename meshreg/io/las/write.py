"""WRITE LAS and LAZ: a cloud from memory, or a moved copy of a file that keeps all else."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.errors import OutputError, UsageError
from meshreg.io.files.atomic import atomic_file
from meshreg.io.files.rewriting import require_unchanged, warn
from meshreg.io.files.safe import open_regular
from meshreg.io.frames.directions import Directions, bend_note
from meshreg.io.frames.mover import Mover, is_plain
from meshreg.io.las.extra import extra_directions, turn_extra
from meshreg.io.las.header import CRS_RECORDS, check_header
from meshreg.io.las.laz_chunks import las_errors
from meshreg.io.las.read import opened
from meshreg.io.second_reader import require_las
from meshreg.records import Float64, PointCloud, SourceFile, Survey

_LOG = logging.getLogger("meshreg")
_STEP = 1e-4  # [m or ft]; in degrees 1e-9, which is as much
_CHUNK = 500_000
_LOST = np.iinfo(np.int32).min
_WAVEFORMS = 65535  # record of the waveform packets


def write(survey: Survey, path: Path) -> tuple[Path, ...]:
    """Write a point cloud as LAS 1.4 (LAZ by suffix) in absolute coordinates.

    Point format 7 with colors, 6 without; steps of 0.0001 m from the centre of the bounds; the
    CRS as WKT. Opened again and compared.

    Raises
    ------
    UsageError
        The survey is not a point cloud, or the suffix asks for COPC.
    OutputError
        Not written, or not what was meant when read back.
    """
    import laspy

    cloud = survey.geometry
    if not isinstance(cloud, PointCloud):
        kind = type(cloud).__name__
        raise UsageError(f"A LAS file holds points, not a {kind}.", file=path)
    if path.name.lower().endswith(".copc.laz"):
        raise UsageError("COPC is not written.", file=path, remedy="Use .laz.")
    header = laspy.LasHeader(version="1.4", point_format=7 if cloud.colors is not None else 6)
    header.generating_software = "meshreg"
    ends = np.stack([cloud.points.min(axis=0), cloud.points.max(axis=0)]) + survey.origin
    _set_steps(header, ends, path, survey.crs)
    _set_crs(header, survey.crs)
    steps, offset = header.scales, header.offsets

    def records() -> Iterator[NDArray[Any]]:
        for start in range(0, len(cloud.points), _CHUNK):
            part = cloud.points[start : start + _CHUNK]
            rows = np.zeros(len(part), header.point_format.dtype())
            _put(rows, np.rint((part + (survey.origin - offset)) / steps))
            # One return of one: the first of the packed fields, bits 0-3 and 4-7.
            rows["bit_fields"] = 0x11
            if cloud.colors is not None:
                for axis, name in enumerate(("red", "green", "blue")):
                    rows[name] = cloud.colors[start : start + _CHUNK, axis].astype(np.uint16) * 257
            yield rows

    _write_file(path, header, records(), [], ends)
    return (path,)


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of a LAS or LAZ file.

    Point format, extra dimensions, VLRs and EVLRs stay; X, Y, Z change, with steps of 0.0001 from
    the centre of the new bounds, and so do normals and other directions in extra dimensions.
    The CRS is replaced where it changes, and left out where the coordinates are local to a shift
    or turned (a sidecar then says it). A COPC index and waveforms inside the file do not survive.
    Every record is read back.

    Raises
    ------
    InputError
        The source is damaged or has changed since it was read.
    OutputError
        Not written, or not what was meant when read back.
    """
    require_unchanged(source, path)
    head = check_header(source.path)
    with las_errors(source.path), opened(source.path) as reader:
        header = reader.header.copy()
        extent = _Ends()
        for chunk in reader.chunk_iterator(_CHUNK):
            lost, points = _file_points(chunk)
            extent.add(move.points(points[~lost]))
    ends = extent.both
    _set_steps(header, ends, path, move.frame.file_crs)
    same = is_plain(source.frame) and move.frame.file_crs == source.frame.file_crs
    if not (same and is_plain(move.frame)):
        _set_crs(header, move.frame.file_crs if is_plain(move.frame) else None)
    evlrs = _kept(header.evlrs or [], same and is_plain(move.frame))
    header.vlrs[:] = _kept(header.vlrs, True)
    if head.inner_waveforms:
        _LOG.warning("%s: waveforms inside the file were left out.", path.name)
        evlrs = [item for item in evlrs if item.record_id != _WAVEFORMS]
        header.global_encoding.waveform_data_packets_internal = False
        header.start_of_waveform_data_packet_record = 0
    header.evlrs = None
    found = extra_directions(header.point_format)
    if note := bend_note(found, move):
        warn(path, note)

    def records() -> Iterator[NDArray[Any]]:
        with las_errors(source.path), opened(source.path) as reader:
            for chunk in reader.chunk_iterator(_CHUNK):
                yield _moved_rows(chunk, move, header, found)

    def look(written: Path) -> None:
        if not head.compressed and path.suffix.lower() != ".laz":
            require_las(source.path, written, move.points, _LOST, path)

    _write_file(path, header, records(), evlrs, ends, look)
    return (path,)


class _Ends:
    """Lowest and highest of the points that it is given."""

    def __init__(self) -> None:
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)

    def add(self, points: Float64) -> None:
        if len(points):
            self.low = np.minimum(self.low, points.min(axis=0))
            self.high = np.maximum(self.high, points.max(axis=0))

    @property
    def both(self) -> Float64:
        """(2, 3) float64; zero where there was no point."""
        both = np.stack([self.low, self.high])
        return both if np.isfinite(both).all() else np.zeros((2, 3))


def _file_points(chunk: Any) -> tuple[NDArray[np.bool_], Float64]:
    raw = np.stack([chunk["X"], chunk["Y"], chunk["Z"]], axis=1)
    return (raw == _LOST).any(axis=1), raw * chunk.scales + chunk.offsets


def _moved_rows(chunk: Any, move: Mover, header: Any, found: Directions) -> NDArray[Any]:
    rows: NDArray[Any] = chunk.array.copy()
    lost, points = _file_points(chunk)
    moved = np.full(points.shape, float(_LOST))
    moved[~lost] = np.rint((move.points(points[~lost]) - header.offsets) / header.scales)
    _put(rows, moved)
    turn_extra(found, move, chunk, rows, points)
    if "x_t" in (rows.dtype.names or ()):
        # Waveform rays: not normalised, so the linear part as it is.
        names = ("x_t", "y_t", "z_t")
        rays = np.stack([rows[name].astype(float) for name in names], axis=1)
        for name, values in zip(names, (rays @ move.matrix[:3, :3].T).T, strict=True):
            rows[name] = values
    return rows


def _put(rows: NDArray[Any], steps: Float64) -> None:
    for axis, name in enumerate("XYZ"):
        rows[name] = steps[:, axis].astype(np.int32)


def _set_steps(header: Any, ends: Float64, path: Path, crs: str | None) -> None:
    """Choose scale and offset so that the bounds fit 32-bit steps."""
    from meshreg.io.frames.crs import is_geographic

    fine = 1e-9 if crs is not None and is_geographic(crs) else _STEP
    steps = np.array([fine, fine, _STEP])
    offset = np.round((ends[0] + ends[1]) / 2, 0 if fine == _STEP else 2)
    largest = np.abs(ends - offset).max(axis=0)
    for axis in range(3):
        while largest[axis] / steps[axis] > 2_147_483_000:
            steps[axis] *= 10
    if steps[2] > _STEP or steps[0] > fine or steps[1] > fine:
        _LOG.warning("%s: its extent needs coarser steps than 0.0001: %s.", path.name, steps)
    header.scales, header.offsets = steps, offset


def _set_crs(header: Any, crs: str | None) -> None:
    """Replace all records that state a CRS."""
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header.vlrs[:] = _kept(header.vlrs, False)
    if crs is None:
        return
    header.vlrs.append(WktCoordinateSystemVlr(_las_wkt(crs)))
    if header.version.minor >= 4:
        header.global_encoding.wkt = True


def _las_wkt(crs: str) -> str:
    """Return WKT 1, which LAS wants, or WKT 2 where WKT 1 cannot say it."""
    import pyproj

    from meshreg.io.frames.crs import parse_crs

    try:
        return str(parse_crs(crs).to_wkt("WKT1_GDAL"))
    except pyproj.exceptions.CRSError:
        return str(parse_crs(crs).to_wkt())


def _kept(records: Any, keep_crs: bool) -> list[Any]:
    """Return (E)VLRs without a COPC index and, unless kept, without CRS (liblas writes it too)."""
    return [
        item
        for item in records
        if item.user_id != "copc"
        and (
            keep_crs
            or item.user_id not in ("LASF_Projection", "liblas")
            or item.record_id not in CRS_RECORDS
        )
    ]


def _write_file(
    path: Path,
    header: Any,
    records: Iterator[NDArray[Any]],
    evlrs: list[Any],
    ends: Float64,
    look: Callable[[Path], None] | None = None,
) -> None:
    """Write header, records and EVLRs; then read all back and compare."""
    import laspy
    from laspy.vlrs.vlrlist import VLRList

    compress = path.suffix.lower() == ".laz"
    sums = []
    with atomic_file(path) as temporary:
        with (
            las_errors(path, OutputError),
            open(temporary, "r+b") as stream,
            laspy.open(
                stream,
                mode="w",
                header=header,
                do_compress=compress,
                closefd=False,
                encoding_errors="surrogateescape",  # names in Latin-1 stay as they are
            ) as writer,
        ):
            for rows in records:
                sums.append((len(rows), zlib.crc32(rows.tobytes())))
                writer.write_points(
                    laspy.ScaleAwarePointRecord(
                        rows, header.point_format, header.scales, header.offsets
                    )
                )
            if evlrs:
                kept = VLRList()
                kept.extend(evlrs)
                writer.write_evlrs(kept)
        _check(temporary, path, sums, ends, len(evlrs))
        if compress:
            _look_by_laszip(temporary, path, sums[0])
        if look is not None:
            look(temporary)


def _check(
    written: Path, path: Path, sums: list[tuple[int, int]], ends: Float64, n_evlrs: int
) -> None:
    """Read every record back (lazrs once wrote damaged LAZ, laz-rs #51)."""
    head = check_header(written)
    again, extent = [], _Ends()
    with las_errors(path, OutputError), opened(written) as reader:
        for chunk in reader.chunk_iterator(_CHUNK):
            again.append((len(chunk), zlib.crc32(chunk.array.tobytes())))
            lost, points = _file_points(chunk)
            extent.add(points[~lost])
        others = len(reader.header.evlrs or [])
    off = np.abs(extent.both - ends).max(axis=0)
    if again != sums or others != n_evlrs or not (off <= np.array(head.step)).all():
        raise OutputError(
            f"does not read back as written: {sum(n for n, _ in again)} points of "
            f"{sum(n for n, _ in sums)}, bounds off by {off.max():.3g}.",
            file=path,
            remedy="Check the disk and run again.",
        )


def _look_by_laszip(written: Path, path: Path, first: tuple[int, int]) -> None:
    """Decode the first records by LASzip, which shares no code with lazrs; not where it is missing.

    All of them would take longer than the writing.
    """
    import laspy

    if not laspy.LazBackend.Laszip.is_available():
        return
    with (
        las_errors(path, OutputError),
        open_regular(written) as stream,
        laspy.open(stream, closefd=False, laz_backend=laspy.LazBackend.Laszip) as reader,
    ):
        rows = reader.read_points(first[0]).array
    if (len(rows), zlib.crc32(rows.tobytes())) != first:
        raise OutputError(
            "does not read back as written by LASzip.",
            file=path,
            remedy="Check the disk and run again.",
        )
