"""COLMAP models: a point cloud whose frame is arbitrary until the ground and positions fix it.

Without camera positions a model is levelled, but its unit, its place and its heading stay
arbitrary; `Survey.scale_known` says so.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, MeshregError, OutputError, UsageError
from meshreg.io.colmap.files import PARTS, Model, ModelFiles, find_model, read_model
from meshreg.io.colmap.positions import Positions, exif_positions, match_names, read_positions
from meshreg.io.colmap.similarity import (
    MAX_TILT,
    Similarity,
    ground_up,
    robust_similarity,
    scale_sigma,
    tilt_sigma,
    turn_up,
)
from meshreg.io.colmap.write import ModelMove, check_moved, text_kept, write_moved
from meshreg.io.files.safe import FARTHEST, fingerprint, open_regular
from meshreg.io.frames.bridge import bridge
from meshreg.io.frames.crs import crs_name, crs_text, is_geographic, metric_crs
from meshreg.io.frames.mover import Mover
from meshreg.io.frames.place import Placed, place, require_near
from meshreg.io.frames.sidecar import SidecarInfo, find_sidecar
from meshreg.io.options import ReadOptions
from meshreg.io.result.folders import atomic_folder
from meshreg.records import Float64, Frame, PointCloud, SourceFile, Survey

log = logging.getLogger("meshreg")

MAX_ERROR = 4.0  # px
MIN_TRACK = 3
_WGS84 = "EPSG:4326"
_POSITIONS = "Give positions as a CSV of image,east,north,up (--positions)."
# Positions must know the tilt better than this to overrule the ground [rad].
_TILT_KNOWN = np.radians(0.5)


def read(path: Path, options: ReadOptions) -> Survey:
    """Read a COLMAP model (cameras, images, points3D; .bin before .txt) as a point cloud.

    Up is the normal of the ground (or the cameras' mean up, where the two differ by more than
    30°). Scale, place and heading come from `options.positions` or from the GPS in photographs
    that lie in the folder; positions spread wide enough give the tilt as well. An axis option or
    a sidecar that states axes says that the model is level already.

    Parameters
    ----------
    path : Path
        The model's folder, or one that holds it as `sparse` or `sparse/0`.
    options : ReadOptions
        `scale` is metres per unit of the model, without positions.

    Returns
    -------
    Survey
        Points of a reprojection error up to 4 px in three images or more. The frame in its
        source holds rotation times scale as `axes`.

    Raises
    ------
    InputError
        A file missing, cut off or damaged; positions that fit no image.
    UsageError
        Several models in the folder; options that contradict each other.
    """
    path = Path(path)
    _require_consistent(options)
    files = find_model(path)
    model, _ = read_model(files)
    sidecar = find_sidecar(path, shared=False, given=options)
    notes: list[str] = []
    kept = _kept(model, notes)
    try:
        placed, scale_known = _place(path, model, kept, options, sidecar, notes)
    except MeshregError as error:
        error.file = error.file or str(path)
        raise
    colors = model.colors[kept]
    if not colors.any():
        notes.append("All points are black: the model holds no colors.")
    for note in notes:
        log.warning("%s: %s", path.name, note)
    source = SourceFile(
        path=files.folder,
        format="colmap",
        frame=placed.frame,
        sidecar=placed.sidecar,
        sha256=_checksum(files),
        companions=files.paths,
        fingerprint=fingerprint(files.folder, files.paths),
        counts={"points": len(model.points), "images": len(model.names)},
    )
    return Survey(
        name=placed.name or _name(files.folder, path),
        geometry=PointCloud(placed.points, colors if colors.any() else None),
        origin=placed.origin,
        crs=placed.frame.crs,
        date=placed.date,
        scale_known=scale_known,
        source=(source,),
        notes=(*notes, *placed.notes),
    )


def _require_consistent(options: ReadOptions) -> None:
    names = ("scale", "unit", "shift", "axes", "up")
    given = [name for name in names if getattr(options, name) is not None]
    if options.positions is not None and given:
        raise UsageError(f"positions and {given[0]} were both given.", remedy="Give one of them.")
    if options.scale is not None and options.unit is not None:
        raise UsageError("scale and unit were both given.", remedy="Give one of them.")
    if options.scale is not None and not (np.isfinite(options.scale) and options.scale > 0):
        raise UsageError(f"scale is {options.scale}; it must be positive (metres per unit).")


def _kept(model: Model, notes: list[str]) -> Any:
    """Return which points are sound; all of them where few would be left."""
    finite = (np.abs(model.points) < FARTHEST).all(axis=1)
    poor = finite & ((model.errors > MAX_ERROR) | (model.tracks < MIN_TRACK))
    kept = finite & ~poor
    if kept.sum() < max(100, 0.25 * finite.sum()):
        kept, poor = finite, np.zeros_like(finite)
    if not kept.all():
        notes.append(
            f"{int((~kept).sum())} of {len(kept)} points were left out: seen in fewer than "
            f"{MIN_TRACK} images, off by more than {MAX_ERROR:g} px, or not finite."
        )
    return kept


def _place(
    path: Path,
    model: Model,
    kept: Any,
    options: ReadOptions,
    sidecar: SidecarInfo | None,
    notes: list[str],
) -> tuple[Placed, bool]:
    """Return the points in place, and whether their scale is known."""
    points = model.points[kept]
    said = sidecar or SidecarInfo()
    stated = _stated(options, said)
    if stated:
        level = np.eye(3)
        notes.append(f"Taken to be level already, as {' and '.join(stated)} is stated.")
    else:
        level = _level(model, kept, notes)
    positions = _positions(path, model, options, stated)
    if positions is not None:
        frame = _frame_by_positions(model, positions, level, options, notes)
        origin = np.round(points.mean(axis=0) @ frame.axes.T + frame.shift)
        moved = points @ frame.axes.T + (frame.shift - origin)
        require_near(moved + origin)
        return Placed(moved, origin, frame, (), said.path, said.name, said.date), True
    known = bool({"unit", "shift"} & set(stated))
    scale = options.scale or 1.0
    if options.scale is not None:
        notes.append(f"One unit of the model was stated to be {scale:g} m.")
    elif not known:
        notes.append("The model's unit, place and heading are arbitrary (no camera positions).")
    return place(path, points, options, None, scale * level, georeferenced=True), known


def _stated(options: ReadOptions, said: SidecarInfo) -> list[str]:
    """Return what options or a sidecar state that an arbitrary frame could not have."""
    return [
        name
        for name in ("shift", "axes", "up", "unit")
        if getattr(options, name) is not None or getattr(said, name) is not None
    ]


def _level(model: Model, kept: Any, notes: list[str]) -> Float64:
    """Return the rotation that brings the model's up to z; its heading stays as it is."""
    camera_up = -model.views.mean(axis=0)
    agreement = float(np.linalg.norm(camera_up))
    if agreement < 0.5:
        notes.append("The cameras look in all directions; which way is up may be wrong.")
    up = ground_up(model.points[kept], camera_up)
    angle = np.arccos(np.clip(up @ camera_up / agreement, -1, 1))
    degrees = f"{np.degrees(angle):.1f}°"
    if angle <= MAX_TILT:
        notes.append(f"Levelled by the ground, {degrees} from the cameras' mean up.")
        return turn_up(up)
    notes.append(
        f"Levelled by the cameras' mean up; the main plane of the points lies {degrees} off, "
        "so this may be no view from above."
    )
    return turn_up(camera_up)


def _positions(
    path: Path, model: Model, options: ReadOptions, stated: list[str]
) -> Positions | None:
    """Return the stated positions, else those of the photographs; None where nothing says."""
    if options.positions is not None:
        return read_positions(options.positions)
    if stated or options.scale is not None:
        return None
    found = exif_positions(path, model.names)
    return found if len(found.names) >= 3 else None


def _frame_by_positions(
    model: Model, positions: Positions, level: Float64, options: ReadOptions, notes: list[str]
) -> Frame:
    """Fit the model's camera centres to their positions; return the frame that follows."""
    file = options.positions
    pairs = match_names(model.names, positions.names)
    if len(pairs) < 3:
        raise InputError(
            f"fits {len(pairs)} of {len(model.names)} images; three are needed. The model has "
            f"{model.names[0]!r}, the table {positions.names[0]!r}.",
            file=file,
            remedy="Use the images' file names.",
        )
    images, rows = (list(column) for column in zip(*pairs, strict=True))
    of = model.centres[images]
    to, crs = _metric(positions, rows, options)
    fit = robust_similarity(of, to)
    tilt = tilt_sigma(fit, of)
    how = "heading, tilt"
    if not tilt < _TILT_KNOWN:
        levelled = robust_similarity(of @ level.T, to, level=True)
        fit = replace(levelled, rotation=levelled.rotation @ level)
        how = "heading (tilt is the ground's)"
    _require_sound(fit, of, to, file)
    relative = scale_sigma(fit, of)
    spread = (
        "no position to spare" if np.isnan(fit.sigma) else f"off by {fit.sigma:.3g} m (1 sigma)"
    )
    notes += positions.notes
    notes.append(
        f"Scale {fit.scale:.6g} m per unit, place, {how} were fitted to "
        f"{int(fit.inliers.sum())} of {len(pairs)} camera positions, {spread}"
        + ("" if np.isnan(relative) else f"; scale known to {relative:.1%}")
        + "."
    )
    return Frame(fit.scale * fit.rotation, fit.shift, crs, crs)


def _require_sound(fit: Similarity, of: Float64, to: Float64, file: Path | None) -> None:
    used = of[fit.inliers]
    size = fit.scale * float(np.linalg.norm(used - used.mean(axis=0), axis=1).max(initial=0))
    if not (np.isfinite(size) and size > 0 and not fit.sigma > size / 3):
        raise InputError(
            f"gives positions that do not fit the model: {int(fit.inliers.sum())} of {len(to)} "
            f"agree, off by {fit.sigma:.3g} m where the cameras spread over {size:.3g} m.",
            file=file,
            remedy="Check names, order of columns and CRS.",
        )


def _metric(
    positions: Positions, rows: list[int], options: ReadOptions
) -> tuple[Float64, str | None]:
    """Return positions as absolute metres, and their CRS."""
    xyz = positions.xyz[rows]
    crs = crs_text(options.crs) if options.crs else None
    if not positions.degrees and crs is None:
        return xyz, None
    stated = crs is not None and (is_geographic(crs) or not positions.degrees)
    own = crs if stated and crs is not None else _WGS84
    target = metric_crs(own, xyz.mean(axis=0)) if stated or crs is None else crs
    if target is None or is_geographic(target):
        raise UsageError(f"{crs_name(crs)} has no metres.", remedy=_POSITIONS)
    return (xyz if own == target else bridge(own, target).forward(xyz)), target


def _name(folder: Path, path: Path) -> str:
    """Return a name for the survey: the folder's that says most ("reef" for reef/sparse/0)."""
    names = [path.resolve().name, *(p.name for p in folder.resolve().parents)]
    return next((n for n in names if n and not n.isdigit() and n != "sparse"), folder.name)


def _checksum(files: ModelFiles) -> str:
    digest = hashlib.sha256()
    for path in files.paths[: len(PARTS)]:
        with open_regular(path) as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())  # type: ignore[arg-type]
    return digest.hexdigest()


def rewrite(source: SourceFile, move: Mover, path: Path) -> tuple[Path, ...]:
    """Write a moved copy of a COLMAP model, in the kind (.bin or .txt) that was read.

    Poses and points pass through the move as a similarity; every other byte is kept.

    Parameters
    ----------
    source : SourceFile
    move : Mover
    path : Path
        The new folder.

    Raises
    ------
    InputError
        The model has changed since it was read, or a file is damaged.
    OutputError
        Not written; or the move is no similarity to within a millimetre.
    """
    files = find_model(source.path)
    if source.fingerprint not in ((0, 0), fingerprint(files.folder, files.paths)):
        raise InputError("has changed since it was read.", file=source.path)
    before, _ = read_model(files)
    linear, shift = move.matrix[:3, :3], move.matrix[:3, 3]
    require_writable(source, move, before.points[:: max(1, len(before.points) // 1000)])
    moving = ModelMove(float(np.cbrt(np.linalg.det(linear))), _rotation(linear), shift)
    unit = float(np.cbrt(abs(np.linalg.det(move.frame.axes))))
    with atomic_folder(path) as folder:
        write_moved(files, moving, folder)
        new = ModelFiles(folder, files.suffix)
        after, _ = read_model(new)  # by pycolmap, which has not written it
        check_moved(before, after, move.points, moving.rotation, unit, path)
        if files.suffix == ".txt" and not text_kept(files, new):
            raise OutputError("does not read back as written: other words differ.", file=path)
    return tuple(path / file.name for file in ModelFiles(path, files.suffix).paths)


def require_writable(source: SourceFile, move: Mover, sample: Float64) -> None:
    """Refuse a move that is no similarity, which is all that a model can make, before the work.

    Raises
    ------
    OutputError
        It would have to be mirrored, sheared, or bent by over a millimetre by a change of CRS.
    """
    linear = move.matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    similar = scale > 0 and np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() <= 1e-4
    moved = sample @ linear.T + move.matrix[:3, 3]
    unit = float(np.cbrt(abs(np.linalg.det(move.frame.axes))))
    off = float(np.abs(move.points(sample) - moved).max(initial=0)) * unit if len(sample) else 0.0
    if not similar or not off < 1e-3:
        what = f"bend the model by {off:.3g} m" if similar else "mirror or shear the model"
        raise OutputError(
            f"would have to {what} to be written in the reference's coordinates.",
            file=source.path,
            remedy="Give positions in the reference's CRS, or register the model's points (.ply).",
        )


def _rotation(linear: Float64) -> Float64:
    left, _, right = np.linalg.svd(linear)
    return np.asarray(left @ right)
