"""The files of a COLMAP model: found, checked against their size, and then read by pycolmap.

pycolmap sets memory aside for as many items as a file claims to hold (2 GB for a lying one), so
every count is compared with the bytes first. https://colmap.github.io/format.html
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshreg.errors import InputError, UsageError
from meshreg.io.files.safe import decode_name, file_bytes, open_regular, require_inside
from meshreg.records import Float64, UInt8

PARTS = ("cameras", "images", "points3D")
_OPTIONAL = ("rigs", "frames")
_AGAIN = "The file is cut off or damaged; export or copy the model again."
_MAX_TEXT_LINE = 1 << 26
# Parameters of each camera model, by its number (COLMAP src/colmap/sensor/models.h).
_PARAMETERS = dict(enumerate((3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16)))


@dataclass(frozen=True)
class ModelFiles:
    """A model folder and whether its ".bin" or its ".txt" files are read."""

    folder: Path
    suffix: str

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files that there are, the three needed ones first."""
        files = [self.folder / f"{part}{self.suffix}" for part in (*PARTS, *_OPTIONAL)]
        return tuple(file for file in files if file.exists())


@dataclass(frozen=True, eq=False)
class Model:
    """What a survey takes from a COLMAP model, in the model's own frame.

    Attributes
    ----------
    points : (N, 3) float64
    colors : (N, 3) uint8
    errors : (N,) float64
        Reprojection error [px]; negative where it was not computed.
    tracks : (N,) int
        Images that see each point.
    names : tuple of str
        Of the M images that have a pose.
    centres : (M, 3) float64
        Where their cameras stood.
    views : (M, 3) float64
        Unit directions in which they looked.
    """

    points: Float64
    colors: UInt8
    errors: Float64
    tracks: Any
    names: tuple[str, ...]
    centres: Float64
    views: Float64


def find_model(root: Path) -> ModelFiles:
    """Find the one model in a folder, in its `sparse` folder or in a numbered one below.

    Raises
    ------
    UsageError
        Several models; it lists their sizes.
    InputError
        No model, or one with files missing, which it names; files that are links out of the
        folder.
    """
    if not root.is_dir():
        raise InputError("is not a folder of a COLMAP model.", file=root, remedy="Name its folder.")
    for place in (root, root / "sparse"):
        if any(_present(place, suffix) for suffix in (".bin", ".txt")):
            return _complete(place, root)
        numbered = sorted(
            (f for f in place.glob("[0-9]*") if f.is_dir() and f.name.isdigit()),
            key=lambda folder: int(folder.name),
        )
        models = [f for f in numbered if _present(f, ".bin") or _present(f, ".txt")]
        if len(models) > 1:
            sizes = "; ".join(f"{folder.name}: {_size(folder)}" for folder in models)
            raise UsageError(
                f"holds {len(models)} models ({sizes}).",
                file=place,
                remedy=f"Name the one that is meant, e.g. {models[0]}.",
            )
        if models:
            return _complete(models[0], root)
    raise InputError(
        f"holds no COLMAP model ({', '.join(PARTS)} as .bin or .txt).",
        file=root,
        remedy="Name the folder that holds these files.",
    )


def _present(folder: Path, suffix: str) -> list[str]:
    return [part for part in PARTS if (folder / f"{part}{suffix}").exists()]


def _complete(folder: Path, root: Path) -> ModelFiles:
    """Choose the .bin files, else the .txt files; name what is missing where neither is whole."""
    for suffix in (".bin", ".txt"):
        if len(_present(folder, suffix)) == len(PARTS):
            files = ModelFiles(folder, suffix)
            for path in files.paths:
                require_inside(path, root)
            return files
    suffix = max((".bin", ".txt"), key=lambda s: len(_present(folder, s)))
    missing = [f"{part}{suffix}" for part in PARTS if part not in _present(folder, suffix)]
    raise InputError(
        f"is not a whole COLMAP model: {' and '.join(missing)} missing.",
        file=folder,
        remedy="Copy all of the model's files.",
    )


def _size(folder: Path) -> str:
    """Return "18 images, 5098 points" from what the files declare."""
    counts = []
    for part in PARTS[1:]:
        binary, text = folder / f"{part}.bin", folder / f"{part}.txt"
        count: int | None = None
        if binary.exists():
            with open_regular(binary) as stream:
                head = stream.read(8)
            count = struct.unpack("<Q", head)[0] if len(head) == 8 else None
        elif text.exists():
            count = _declared(text)
        counts.append("?" if count is None else str(count))
    return f"{counts[0]} images, {counts[1]} points"


def read_model(files: ModelFiles) -> tuple[Model, Any]:
    """Check the files, read them and return the model and pycolmap's reconstruction.

    Raises
    ------
    InputError
        A file cut off or damaged, or a model without points or posed images.
    """
    for path in files.paths:
        if files.suffix == ".bin":
            _check_binary(path)
        else:
            _check_text(path)
    import pycolmap

    model = pycolmap.Reconstruction()
    try:
        (model.read_binary if files.suffix == ".bin" else model.read_text)(files.folder)
    except (ValueError, IndexError, RuntimeError, TypeError, MemoryError) as error:
        raise InputError(
            f"cannot be read as a COLMAP model: {str(error).splitlines()[0]}.",
            file=files.folder,
            remedy=_AGAIN,
        ) from error
    posed = [image for _, image in sorted(model.images.items()) if image.has_pose]
    if not model.num_points3D() or not posed:
        raise InputError(
            f"holds {model.num_points3D()} points and {len(posed)} images with a pose.",
            file=files.folder,
            remedy="Give a model that was reconstructed.",
        )
    if files.suffix == ".txt":
        _check_text_counts(files, model)
    return _plain(files, model, posed), model


def _plain(files: ModelFiles, model: Any, posed: list[Any]) -> Model:
    points = [point for _, point in sorted(model.points3D.items())]
    poses = [camera_from_world(image) for image in posed]
    turns = np.array([pose.rotation.matrix() for pose in poses])
    shifts = np.array([pose.translation for pose in poses])
    with np.errstate(all="ignore"):
        sound = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) < 1e-3
        sound &= np.isfinite(shifts).all(axis=1)
    if not sound.all():
        raise InputError(
            f"holds an image whose pose is none: {_image_name(posed[int(np.argmin(sound))])!r}.",
            file=files.folder / f"images{files.suffix}",
            remedy=_AGAIN,
        )
    names = _text_names(files.folder / "images.txt") if files.suffix == ".txt" else {}
    return Model(
        points=np.array([point.xyz for point in points], float).reshape(-1, 3),
        colors=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        errors=np.array([point.error for point in points], float),
        tracks=np.array([point.track.length() for point in points]),
        names=tuple(names.get(image.image_id) or _image_name(image) for image in posed),
        centres=-np.einsum("nji,nj->ni", turns, shifts),  # C = -R' t
        views=turns[:, 2],  # the camera's z axis, seen from the world
    )


def _text_names(path: Path) -> dict[int, str]:
    """Return the images' names by their numbers: all that follows the ninth word of a line.

    pycolmap (as of 4.2) cuts a name at its first blank.
    """
    names = {}
    with open_regular(path) as stream:
        lines = iter(stream)
        for line in lines:
            words = line.strip().split(None, 9)
            if len(words) == 10 and not words[0].startswith(b"#"):
                names[int(words[0])] = decode_name(words[9])
                next(lines, b"")  # what it saw
    return names


def _image_name(image: Any) -> str:
    try:
        return str(image.name)
    except UnicodeDecodeError:  # pycolmap takes every name for UTF-8
        return f"image {image.image_id}"


def camera_from_world(image: Any) -> Any:
    """Return an image's pose; it is a property up to pycolmap 3.11 and a method since 3.12."""
    pose = image.cam_from_world
    return pose() if callable(pose) else pose


def _check_binary(path: Path) -> None:
    """Walk through a file of the binary format; all counts must fit what is there."""
    binary_places(path)


def binary_places(path: Path) -> list[int]:
    """Return the bytes at which the poses (7 doubles) or points (3 doubles) of a file stand.

    Raises
    ------
    InputError
        The counts in the file do not fit its size.
    """
    data = file_bytes(path)
    walker = {
        "cameras": _walk_cameras,
        "images": _walk_images,
        "points3D": _walk_points,
        "rigs": _walk_rigs,
        "frames": _walk_frames,
    }[path.stem]
    place, places = 8, []  # type: ignore[var-annotated]
    try:
        count = struct.unpack("<Q", data[:8].tobytes())[0]
        if count > data.size:
            raise InputError(
                f"declares {count} items, but has {data.size} bytes.", file=path, remedy=_AGAIN
            )
        place = walker(memoryview(data), count, places)  # type: ignore[arg-type]
    except (struct.error, _CutOffError) as error:
        raise InputError(
            f"ends early: it has {data.size} bytes.", file=path, remedy=_AGAIN
        ) from error
    if place != data.size:
        raise InputError(
            f"has {data.size} bytes; its {count} items take {place}.", file=path, remedy=_AGAIN
        )
    return places


class _CutOffError(Exception):
    """The data end inside an item."""


def _within(place: int, data: memoryview) -> int:
    if place > len(data):
        raise _CutOffError
    return place


def _walk_cameras(data: memoryview, count: int, places: list[int]) -> int:
    del places
    place = 8
    for _ in range(count):
        kind = struct.unpack_from("<i", data, place + 4)[0]
        if kind not in _PARAMETERS:
            return len(data)  # a newer kind, of unknown length: pycolmap knows
        place = _within(place + 24 + 8 * _PARAMETERS[kind], data)
    return place


def _walk_images(data: memoryview, count: int, places: list[int]) -> int:
    place = 8
    for _ in range(count):
        places.append(place + 4)
        place = _within(place + 64, data)  # id, 7 doubles of the pose, camera
        for start in range(place, len(data), 256):
            end = bytes(data[start : start + 256]).find(b"\0")
            if end >= 0:
                place = start + end + 1
                break
        else:
            raise _CutOffError
        place = _within(place + 8 + 24 * struct.unpack_from("<Q", data, place)[0], data)
    return place


def _walk_points(data: memoryview, count: int, places: list[int]) -> int:
    place, length = 8, struct.Struct("<Q")
    for _ in range(count):
        places.append(place + 8)
        place = place + 51 + 8 * length.unpack_from(data, place + 43)[0]
        if place > len(data):
            raise _CutOffError
    return place


def _walk_rigs(data: memoryview, count: int, places: list[int]) -> int:
    place = 8
    for _ in range(count):
        sensors = struct.unpack_from("<I", data, place + 4)[0]
        place = _within(place + 8 + (8 if sensors else 0), data)
        for _ in range(sensors - 1):
            posed = struct.unpack_from("<B", data, place + 8)[0]
            places += [place + 9] * bool(posed)
            place = _within(place + 9 + (56 if posed else 0), data)
    return place


def _walk_frames(data: memoryview, count: int, places: list[int]) -> int:
    place = 8
    for _ in range(count):
        places.append(place + 8)
        place = _within(place + 68 + 16 * struct.unpack_from("<I", data, place + 64)[0], data)
    return place


def _check_text(path: Path) -> None:
    """Look for what pycolmap would pass over: bytes that are no text, a last line cut off."""
    with open_regular(path) as stream:
        last = b"\n"
        while block := stream.read(_MAX_TEXT_LINE):
            if b"\0" in block:
                raise InputError("is not text: it holds NUL bytes.", file=path, remedy=_AGAIN)
            last = block[-1:]
    if last != b"\n":
        raise InputError("ends within a line.", file=path, remedy=_AGAIN)


def _declared(path: Path) -> int | None:
    """Return the count that a text file's comment declares ("# Number of points: 5098, ...")."""
    with open_regular(path) as stream:
        head = stream.read(1000)
    found = re.search(rb"^#\s*Number of \w+\s*:\s*(\d+)", head, re.MULTILINE)
    return int(found.group(1)) if found else None


def _check_text_counts(files: ModelFiles, model: Any) -> None:
    found = (model.num_cameras(), model.num_images(), model.num_points3D())
    for part, count in zip(PARTS, found, strict=True):
        path = files.folder / f"{part}.txt"
        declared = _declared(path)
        if declared is not None and declared != count:
            raise InputError(
                f"declares {declared} {part}, but holds {count}.", file=path, remedy=_AGAIN
            )
