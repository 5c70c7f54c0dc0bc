"""Attributes with a direction: found by their names, turned with the survey or named in a note.

Normals and other unit vectors, quaternions, and the splats of 3D Gaussian splatting (Kerbl et al.
2023, ACM TOG 42 (4), doi:10.1145/3592433), whose files hold the orientation as ``rot_0..3``
(w, x, y, z), sizes as logarithms ``scale_0..2`` and color that depends on the view as spherical
harmonics ``f_rest_*``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshreg.io.frames.mover import Mover
from meshreg.records import Float64

_UNIT_VECTOR = re.compile(
    r"n|nr?m|nor|norm|.*normals?|.*(?:bi)?tangent|.*binormal|.*direction|dir|.*eigenvec(?:tor)?\d*|.*axis"
)
_QUATERNION = re.compile(r"q|.*quat(?:ernion)?|rot|rotation|.*orientation|orient")
_ANGLES = frozenset(
    (
        *("dip", "dipdir", "dipdirection", "strike", "trend", "plunge", "aspect"),
        *("azimuth", "azi", "bearing", "heading", "course"),
        *("yaw", "pitch", "roll", "omega", "phi", "kappa"),
    )
)
_COVARIANCE = re.compile(r"(?:c|cov|covar|covariance|var|sigma|s)(?:xx|xy|xz|yx|yy|yz|zx|zy|zz)")
_SPLAT_TURN = ("rot_0", "rot_1", "rot_2", "rot_3")
_SPLAT_SIZE = ("scale_0", "scale_1", "scale_2")
_REST = re.compile(r"f_rest_(\d{1,3})")
_BANDS = {9: 1, 24: 2, 45: 3}  # coefficients beyond the constant one, for three colors: degree


@dataclass(frozen=True)
class Directions:
    """Columns of a file that turn, scale, or ought to and cannot.

    Attributes
    ----------
    vectors : tuple of (x, y, z)
        Names of the components of unit vectors.
    quaternions : tuple of (w, x, y, z)
    sizes : tuple of str
        Natural logarithms of lengths.
    harmonics : tuple of str
        Coefficients of degree 1 and above, all of red first, then green, then blue.
    kept : tuple of str
        Names of what depends on the frame and stays as it is.
    """

    vectors: tuple[tuple[str, ...], ...] = ()
    quaternions: tuple[tuple[str, ...], ...] = ()
    sizes: tuple[str, ...] = ()
    harmonics: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all columns that change."""
        groups = [*self.vectors, *self.quaternions, self.sizes, self.harmonics]
        return tuple(name for group in groups for name in group)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader says of those that stay."""
        if not self.kept:
            return ()
        shown = ", ".join(map(repr, self.kept[:12])) + (", ..." if len(self.kept) > 12 else "")
        return (
            f"Attributes that depend on the survey's orientation are not turned with it: {shown}.",
        )


def find_directions(
    names: Iterable[str], coordinates: Collection[str] = (), fixed: Collection[str] = ()
) -> Directions:
    """Find the attributes with a direction among a file's columns.

    Parameters
    ----------
    names : iterable of str
        As the file has them; case, blanks, units in brackets and a leading "scalar" do not count.
    coordinates : collection of str
        Those of them that are the points' coordinates or colors.
    fixed : collection of str
        Those whose type cannot hold another direction (unsigned integers, text).
    """
    names = [name for name in dict.fromkeys(names) if name not in coordinates]
    found = _Found(names, fixed)
    again = find_directions(found.repeated, (), fixed) if found.repeated else Directions()
    found.splats()
    found.quaternions()
    found.vectors()
    found.others()
    order = {name: k for k, name in enumerate(names)}
    kept = tuple(sorted((*found.kept, *again.kept), key=order.__getitem__))
    vectors, quaternions = (*found.turned, *again.vectors), (*found.quats, *again.quaternions)
    return Directions(vectors, quaternions, found.sizes, found.harmonics, kept)


class _Found:
    """Goes through the names, group by group; each name belongs to one group at most."""

    def __init__(self, names: list[str], fixed: Collection[str]) -> None:
        self.left = {_bare(name): name for name in reversed(names)}
        self.repeated = [name for name in names if self.left[_bare(name)] != name]
        self.fixed = fixed
        self.turned: list[tuple[str, ...]] = []
        self.quats: list[tuple[str, ...]] = []
        self.sizes: tuple[str, ...] = ()
        self.harmonics: tuple[str, ...] = ()
        self.kept: list[str] = []

    def _take(self, keys: Iterable[str]) -> tuple[str, ...]:
        return tuple(self.left.pop(key) for key in keys)

    def _group(self, keys: Iterable[str], into: list[tuple[str, ...]]) -> None:
        group = self._take(keys)
        if any(name in self.fixed for name in group):
            self.kept += group
        else:
            into.append(group)

    def splats(self) -> None:
        turn, size = (tuple(map(_bare, group)) for group in (_SPLAT_TURN, _SPLAT_SIZE))
        if not {*turn, *size} <= self.left.keys():
            return
        self._group(turn, self.quats)
        self.sizes = self._take(size)
        rest = {int(m[1]): key for key, name in self.left.items() if (m := _REST.fullmatch(name))}
        if len(rest) in _BANDS and set(rest) == set(range(len(rest))):
            self.harmonics = self._take(rest[k] for k in range(len(rest)))
        else:
            self.kept += self._take(rest.values())

    def quaternions(self) -> None:
        for stem, part in self._stems("w0"):
            if not _QUATERNION.fullmatch(stem):
                continue
            for letters in ("wxyz", "0123"):
                keys = [part(letter) for letter in letters]
                if set(keys) <= self.left.keys():
                    self._group(keys, self.quats)

    def vectors(self) -> None:
        for stem, part in self._stems("x01"):
            if not stem:
                continue
            unit = _UNIT_VECTOR.fullmatch(stem) is not None
            for letters in ("xyz", *(("012", "123") if unit and len(stem) > 2 else ())):
                keys = [part(letter) for letter in letters]
                if not set(keys) <= self.left.keys():
                    continue
                if unit:
                    self._group(keys, self.turned)
                else:
                    self.kept += self._take(keys)

    def others(self) -> None:
        for key, name in list(self.left.items()):
            if _COVARIANCE.fullmatch(key) or any(word in _ANGLES for word in _words(name)):
                self.kept += self._take([key])

    def _stems(self, first: str) -> list[tuple[str, Callable[[str], str]]]:
        """Return what stands before or after the first component, and how names are made of it."""
        found: list[tuple[str, Callable[[str], str]]] = []
        for key in self.left:
            if key and key[-1] in first:
                found.append((key[:-1], lambda letter, stem=key[:-1]: stem + letter))  # type: ignore[misc]
            if key.startswith("x") and first[0] == "x":
                found.append((key[1:], lambda letter, stem=key[1:]: letter + stem))  # type: ignore[misc]
        return found


def _bare(name: str) -> str:
    """Return a name without case, punctuation, units in brackets and CloudCompare's "scalar_"."""
    bare = re.sub(r"[\[(].*?[\])]", "", name).lower().rpartition(":")[2]
    return re.sub(r"[^a-z0-9]", "", bare).removeprefix("scalar")


def _words(name: str) -> list[str]:
    """Return the words of a name ("DipDirection (deg)": dip, direction and both as one)."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", re.sub(r"[\[(].*?[\])]", "", name))
    words = re.findall(r"[a-z]+", spaced.lower())
    return [*words, _bare(name)]


def turn_columns(
    found: Directions, move: Mover, points: Any, columns: Mapping[str, NDArray[Any]]
) -> dict[str, Float64]:
    """Turn the columns (N,) that `found` names; returns those that change, as float64.

    Vectors keep their lengths, quaternions their norms. Where a change of axes mirrors the file's
    frame, a quaternion stands for its turn after the mirror image has been taken through the
    origin, which is the same for a splat, whose shape has that symmetry.
    """
    out: dict[str, Float64] = {}
    for names in found.vectors:
        vectors = np.stack([np.asarray(columns[name], float) for name in names], axis=1)
        out.update(zip(names, move.directions(points, vectors).T, strict=True))
    turn = move.turn
    proper = turn if np.linalg.det(turn) > 0 else -turn
    for names in found.quaternions:
        old = np.stack([np.asarray(columns[name], float) for name in names], axis=1)
        out.update(zip(names, _composed(proper, old).T, strict=True))
    growth = np.log(move.scale)
    for name in found.sizes:
        out[name] = np.asarray(columns[name], float) + growth
    if found.harmonics:
        out.update(_turned_harmonics(found.harmonics, turn, columns))
    return out


def _composed(turn: Float64, quaternions: Float64) -> Float64:
    """Return the quaternions (N, 4) w, x, y, z of `turn` after each of the given ones.

    The one of `turn` is the one with w >= 0; W. R. Hamilton's product.
    """
    from scipy.spatial.transform import Rotation

    w, x, y, z = Rotation.from_matrix(turn).as_quat(canonical=True, scalar_first=True)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.asarray(quaternions @ left.T)


def _turned_harmonics(
    names: tuple[str, ...], turn: Float64, columns: Mapping[str, NDArray[Any]]
) -> dict[str, Float64]:
    each = len(names) // 3
    matrix = _harmonics_matrix(tuple(turn.ravel().tolist()), _BANDS[len(names)])
    out: dict[str, Float64] = {}
    for channel in range(3):
        part = names[channel * each : (channel + 1) * each]
        old = np.stack([np.asarray(columns[name], float) for name in part], axis=1)
        out.update(zip(part, (old @ matrix.T).T, strict=True))
    return out


@lru_cache(maxsize=4)
def _harmonics_matrix(turn: tuple[float, ...], degree: int) -> Float64:
    """Return the matrix that takes coefficients of degrees 1 to `degree` to the turned survey's.

    The color seen along d in the turned survey is the one seen along R' d before; each degree
    turns into itself, so that its coefficients follow exactly from as many directions.
    """
    rotation = np.reshape(turn, (3, 3))
    seen = np.random.default_rng(0).normal(size=(64, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    after, before = _harmonics(seen, degree), _harmonics(seen @ rotation, degree)
    matrix = np.zeros((after.shape[1], after.shape[1]))
    for level in range(1, degree + 1):
        part = slice(level * level - 1, (level + 1) ** 2 - 1)
        matrix[part, part] = np.linalg.lstsq(after[:, part], before[:, part], rcond=None)[0]
    return matrix


def _harmonics(directions: Float64, degree: int) -> Float64:
    """Return the real spherical harmonics of degrees 1 to `degree` at unit vectors (N, 3).

    In the order and with the signs of P.-P. Sloan, Stupid spherical harmonics (SH) tricks, GDC
    2008, appendix A2. Factors that a degree has in common do not matter here and are left out.
    """
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    terms = [-y, z, -x]
    if degree >= 2:
        terms += [
            2 * x * y, -2 * y * z, (2 * zz - xx - yy) / np.sqrt(3), -2 * x * z, xx - yy,
        ]  # fmt: skip
    if degree >= 3:
        a, b, c = np.sqrt(5 / 8), np.sqrt(15), np.sqrt(3 / 8)
        terms += [
            -a * y * (3 * xx - yy), b * x * y * z, -c * y * (4 * zz - xx - yy),
            z * (2 * zz - 3 * xx - 3 * yy) / 2, -c * x * (4 * zz - xx - yy),
            b / 2 * z * (xx - yy), -a * x * (xx - 3 * yy),
        ]  # fmt: skip
    return np.stack(terms, axis=1)


def stored(values: Float64, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return values in a column's own type: rounded and within its range where it is integer."""
    if dtype.kind == "f":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(values), limits.min, limits.max).astype(dtype)


def bend_note(found: Directions, move: Mover) -> str | None:
    """Return what to say where a bend follows the move, which turns nothing; None else."""
    if move.warp is None or not found.columns:
        return None
    return (
        "its attributes with a direction (" + ", ".join(found.columns[:6]) + ") are turned with "
        "the survey as a whole, not by the bend at their place."
    )
