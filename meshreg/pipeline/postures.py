"""How a survey lies in space, and which other axes would make two surveys agree.

A file whose axes are not what they are taken for lies on its side, upside down, or with east and
north exchanged. That is told by bounds and slopes alone, so that it can be tried before it is told.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from meshreg.records import Float64, Frame, Maps, Survey

AXES = MappingProxyType(
    {
        'up = "z"': np.eye(3),
        'axes = "ned"': np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
        'up = "y"': np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
        "axes = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]": np.eye(3)[[1, 0, 2]],  # north, east, up
        "axes = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]": np.diag([1.0, 1.0, -1.0]),  # depths
    }
)  # what a .survey.toml may say of a file, and the axes that it then has
UPRIGHT = 60.0  # degrees
ALIKE = 15.0  # degrees between the planes of two surveys of one place
LEVELS = 1.0  # m; farther above each other than this, and than they are high, surveys do not meet
ELONGATED, MATCHED = 0.5, 0.8  # common part of the two outlines, one laid on the other's middle
SAMPLE = 20_000  # points
NEIGHBOURS = 16
LINE = 1e-4  # of a piece's largest variance: what spreads less across than this has no plane
DEGREES_WIDE = 0.2  # 22 km along a meridian
DEGREES_TALL = 20.0  # times as high as wide, as no ground is


@dataclass(frozen=True, eq=False)
class Posture:
    """How a survey lies.

    Attributes
    ----------
    low, high : (3,) float64
        East, north, up of its bounds [m]; one point in a hundred lies beyond each.
    normal : (3,) float64
        Unit vector normal to its own plane, its largest component positive.
    """

    low: Float64
    high: Float64
    normal: Float64

    @property
    def dip(self) -> float:
        """Angle between its plane and the level [degrees], 0 to 90."""
        return math.degrees(math.acos(min(1.0, abs(float(self.normal[2])))))

    @property
    def thin(self) -> str:
        """Axis that its plane is most nearly normal to."""
        return "xyz"[int(np.argmax(np.abs(self.normal)))]


def posture(survey: Survey) -> Posture:
    """Measure how a survey lies, from some of its points."""
    return _of_points(_sample(survey))


def _sample(survey: Survey) -> Float64:
    """(N, 3) float64: some of its points, absolute [m]; at random, as every n-th lie in lines."""
    geometry = survey.geometry
    if isinstance(geometry, Maps):
        some = np.flatnonzero(np.isfinite(geometry.height))
        if len(some) > SAMPLE:
            some = some[np.random.default_rng(0).integers(len(some), size=SAMPLE)]
        row, col = np.unravel_index(some, geometry.height.shape)
        east, north = geometry.height_grid.east_north(row, col)
        return np.column_stack([east, north, geometry.height.ravel()[some]]).astype(np.float64)
    points = geometry.points
    if len(points) > SAMPLE:
        points = points[np.random.default_rng(0).integers(len(points), size=SAMPLE)]
    return np.asarray(points + survey.origin)


def _of_points(points: Float64) -> Posture:
    """Measure bounds and plane of points.

    The plane is normal to most of the surface's pieces; how it dips, a robust fit then tells. The
    axis along which the points reach least would be that of a narrow strip across it. The
    normals of pieces (plane through some neighbours: Hoppe et al., SIGGRAPH 1992, section 3.2) are
    those of the ground, whatever its outline.
    """
    if len(points) < NEIGHBOURS:
        at = points if len(points) else np.zeros((1, 3))
        return Posture(at.min(axis=0), at.max(axis=0), np.array([0.0, 0.0, 1.0]))
    from scipy.spatial import cKDTree

    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    local = points - np.median(points, axis=0)
    _, near = cKDTree(local).query(local, NEIGHBOURS)
    pieces = local[near] - local[near].mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", pieces, pieces))
    planar = spread[:, 1] > LINE * spread[:, 2]
    if not planar.any():
        return Posture(low, high, np.array([0.0, 0.0, 1.0]))
    normals = axes[planar][:, :, 0]
    frame = np.linalg.eigh(normals.T @ normals)[1]  # last: what most of them point along
    u, v, w = (local @ frame).T
    design = np.column_stack([np.ones(len(u)), u, v])
    away = np.linalg.norm(local, axis=1)
    kept = away <= np.quantile(away, 0.9)  # points that float far off have too long a lever
    slope = np.zeros(3)
    for _ in range(5):
        slope = np.linalg.lstsq(design[kept], w[kept], rcond=None)[0]
        rest = np.abs(w - design @ slope)
        kept = rest <= 4 * max(float(np.median(rest)), 1e-12)
    normal = frame @ [-slope[1], -slope[2], 1.0]
    normal /= np.linalg.norm(normal)
    return Posture(low, high, normal * np.sign(normal[np.argmax(np.abs(normal))]))


def in_degrees(survey: Survey) -> str:
    """Say that coordinates without a CRS look like longitude and latitude; '' where they do not.

    They lie in the range of degrees, and the survey would be many times as high as wide: its
    heights are metres.
    """
    if survey.crs is not None:
        return ""
    low, high = survey.bounds
    wide, tall = float((high - low)[:2].max()), float((high - low)[2])
    inside = np.abs(survey.bounds[:, 0]).max() <= 180 and np.abs(survey.bounds[:, 1]).max() <= 90
    if not (inside and 0 < wide < DEGREES_WIDE and tall > DEGREES_TALL * wide):
        return ""
    return (
        f"the coordinates of {survey.name!r} look like degrees (east {low[0]:.6g} to "
        f"{high[0]:.6g}, north {low[1]:.6g} to {high[1]:.6g}, heights over {tall:.3g} m) and no "
        f'CRS is stated: write crs = "EPSG:4326" into {survey.name}.survey.toml beside it'
    )


def other_axes(reference: Survey, moving: Survey, radius: float) -> str:
    """Name the axes that would make bounds and slopes agree, where those in force do not.

    Parameters
    ----------
    reference, moving : Survey
        Only surveys from files are read in another way; not maps, which are level by nature.
    radius : float
        Half width of the search window [m].

    Returns
    -------
    str
        '' where bounds and slopes agree as they are, or would not in any other way.
    """
    surveys = (reference, moving)
    points = [_sample(survey) for survey in surveys]
    as_read = (_of_points(points[0]), _of_points(points[1]))
    lying = _disagreement(as_read[0], as_read[1], radius)
    outline = _outlines(as_read[0], as_read[1])
    if not lying and outline >= ELONGATED:
        return ""
    tried = [dict(_read_again(survey, part)) for survey, part in zip(surveys, points, strict=True)]
    fits = []
    for rank, name in enumerate(AXES):
        there, here = (others.get(name) for others in tried)
        trials = [("moving", as_read[0], here), ("reference", there, as_read[1])]
        trials += [("both", there, here)]
        for which, first, second in trials:
            if first is None or second is None or _disagreement(first, second, radius):
                continue
            if not lying and _outlines(first, second) < MATCHED:
                continue
            like = _outlines(first, second)
            # a seafloor lies below the sea's level: of two ways that agree, that one
            above = float((first.low + first.high)[2]) > 2 * float((first.high - first.low)[2])
            plain = rank < 3  # what has a word of its own comes before a matrix
            order = (which == "both", above, -round(5 * like), not plain, which == "reference")
            fits.append(((*order, rank), which, name))
    if not fits:
        return ""
    _, which, name = min(fits)
    return _said(which, name, surveys)


def axes_after(reference: Survey, moving: Survey, change: Float64, what: str) -> str:
    """Name the axes that a file has if its east, north, up are to be changed as the data ask.

    Parameters
    ----------
    reference, moving : Survey
    change : (3, 3) float64
        What the east, north and up of one of them are to be multiplied by for both to agree: an
        exchange of axes, its own inverse.
    what : str
        What showed it: "the image", "the relief".

    Returns
    -------
    str
        '' where the file cannot be read in that way.
    """
    surveys = (reference, moving)
    lying = [survey.bounds[:, 2] for survey in surveys]
    above = [low + high > 2 * (high - low) for low, high in lying]
    # a seafloor lies below the sea's level: where heights are negated, one that does not is wrong
    which = "reference" if change[2, 2] < 0 and above[0] and not above[1] else "moving"
    frame = _frame(reference if which == "reference" else moving)
    now = "" if frame is None else _name(frame.axes)
    name = _name(change @ AXES[now]) if now else ""
    return _said(which, name, surveys, what) if name else ""


def _said(
    which: str, name: str, surveys: tuple[Survey, Survey], what: str = "bounds and slopes"
) -> str:
    key, value = name.replace('"', "").split(" = ")
    matrix = value.startswith("[")
    option = f"--{key} {value}"
    if which == "both":
        how = f"{name} in a .survey.toml beside each" if matrix else option
        return f"both surveys would lie level and agree if they were read with {how}: try it"
    survey, other = surveys if which == "reference" else surveys[::-1]
    frame = _frame(other)
    # the option holds for both files: it may be given where it leaves the other as it is
    alone = matrix or frame is None or _name(frame.axes) != name
    how = option if not alone else f"{name} in {survey.name}.survey.toml beside it"
    return f"{what} would agree if the {which} survey were read with {how}: try it"


def _frame(survey: Survey) -> Frame | None:
    """Return the frame that all files of a survey share; None where there is no such one."""
    if isinstance(survey.geometry, Maps):
        return None
    frames = [source.frame for source in survey.source] or [Frame(shift=survey.origin)]
    if not all(frame.is_linear for frame in frames):
        return None
    first = frames[0]
    same = all((f.axes == first.axes).all() and (f.shift == first.shift).all() for f in frames)
    return first if same else None


def _name(axes: Float64) -> str:
    """Name what the axes are, whatever their unit; '' for any others."""
    unit = abs(float(np.linalg.det(axes))) ** (1 / 3)
    return next((n for n, known in AXES.items() if np.allclose(axes, unit * known)), "")


def _read_again(survey: Survey, points: Float64) -> Iterator[tuple[str, Posture]]:
    """Give how the survey would lie with each of the axes that it was not read with."""
    frame = _frame(survey)
    now = "" if frame is None else _name(frame.axes)
    if frame is None or not now:
        return
    turn = {name: axes @ AXES[now].T for name, axes in AXES.items() if name != now}
    measured = _of_points(points)
    for name, rotation in turn.items():
        corners = np.stack([measured.low, measured.high]) - frame.shift
        corners = corners @ rotation.T + frame.shift
        low, high = corners.min(axis=0), corners.max(axis=0)
        yield name, replace(measured, low=low, high=high, normal=rotation @ measured.normal)


def _disagreement(first: Posture, second: Posture, radius: float) -> bool:
    """Whether two surveys cannot show the same ground: too far apart, on edge, or inclined."""
    gap = np.maximum(first.low - second.high, second.low - first.high)
    tall = max(LEVELS, *(float((part.high - part.low)[2]) for part in (first, second)))
    inclined = math.degrees(math.acos(min(1.0, abs(float(first.normal @ second.normal)))))
    return bool(
        gap[:2].max() > radius
        or gap[2] > tall
        or max(first.dip, second.dip) >= UPRIGHT
        or inclined > ALIKE
    )


def _outlines(first: Posture, second: Posture) -> float:
    """Intersection over union of the two outlines, one laid on the middle of the other."""
    sides = np.maximum(np.stack([(p.high - p.low)[:2] for p in (first, second)]), 1e-9)
    common = float(sides.min(axis=0).prod())
    return common / (float(sides.prod(axis=1).sum()) - common)


def level_axes(survey: Survey) -> str:
    """Name the option with which one survey's file would lie level; '' where there is none."""
    points = _sample(survey)
    for name, lying in _read_again(survey, points):
        if lying.dip <= 90.0 - UPRIGHT and name.startswith("up"):
            return f"--up {name[-2]}"
    return ""
