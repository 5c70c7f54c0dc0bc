"""The internal error: how the two models bend against each other once a rigid move has laid them.

Measured for every pair, from the offsets of tiles (`refine.tiles`) and the heights of tiles, and
named in words. The bend that predicts held-out tiles best (`models`) can be applied as a
`Warp`: after the transform, at the place where the transform has put a point.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from meshreg.deformation.models import MODELS, Sample, Step, choose, fit_models
from meshreg.deformation.warp_rasters import LEAST_TILES, height_tiles
from meshreg.errors import UsageError
from meshreg.records import Float64, SurveyRaster, Transform, Warp
from meshreg.refine import TileOffsets
from meshreg.settings import WarpSettings

CHOICES = ("none", "auto", *MODELS[1:])
_MANY = 0.1  # of the tiles: worth saying


@dataclass(frozen=True, eq=False)
class Deformation:
    """The internal error of a pair.

    Attributes
    ----------
    summary : str
        In words.
    record : mapping
        For the document: models, tiles, held-out errors, amplitudes, strains.
    warp : Warp or None
        The bend within the allowed strain; None where a rigid move is enough, or none is allowed.
    evidence : mapping
        For the figure, arrays: places and offsets of tiles (`east`, `north`, `d_east`, `d_north`),
        what the named model says there (`model_east`, `model_north`), weights; the same of heights.
    """

    summary: str
    record: Mapping[str, Any] = field(default_factory=dict)
    warp: Warp | None = None
    evidence: Mapping[str, Any] = field(default_factory=dict)

    def applied(self) -> Deformation:
        """Return the same, saying that its warp was applied."""
        assert self.warp is not None
        models = (("horizontally", self.warp.horizontal), ("in height", self.warp.vertical))
        parts = [f"{where} by the {model} model" for where, model in models if model != "rigid"]
        names = " and ".join(parts)
        said = (
            f"{self.summary}; the registered survey is warped ({names}), which transform.txt, the "
            "rigid part alone, does not say"
        )
        return dataclasses.replace(self, summary=said, record={**self.record, "applied": True})


@dataclass(frozen=True, eq=False)
class _Part:
    """One half of the answer, horizontal or vertical: the named step and the one allowed."""

    sample: Sample
    rigid: Step
    named: Step
    allowed: Step

    @classmethod
    def of(cls, sample: Sample, options: WarpSettings) -> _Part:
        steps = fit_models(sample)
        asked = steps
        if options.model not in ("none", "auto"):
            asked = tuple(s for s in steps if s.model in ("rigid", options.model))
        named = choose(steps, sample, np.inf)
        return cls(sample, steps[0], named, choose(asked, sample, options.max_strain))


def check_model(model: str) -> None:
    """Refuse a `warp.model` that there is not.

    Raises
    ------
    UsageError
    """
    if model not in CHOICES:
        raise UsageError(f"Unknown warp {model!r}.", remedy=f"There are: {', '.join(CHOICES)}.")


def measure(
    tiles: TileOffsets | None,
    transform: Transform,
    reference: SurveyRaster,
    moving: SurveyRaster,
    options: WarpSettings,
) -> Deformation:
    """Measure the internal error of a pair that a transform has laid down.

    Parameters
    ----------
    tiles : TileOffsets or None
        In moving coordinates, as measured before the transform.
    transform : Transform
        `reference_from_moving`.
    reference, moving : SurveyRaster
        DEMs on one grid, the moving one laid down by the transform.
    options : WarpSettings

    Returns
    -------
    Deformation
    """
    check_model(options.model)
    if tiles is None or len(np.unique(tiles.block)) < LEAST_TILES:
        return Deformation("the internal error is not known: too few tiles match on their own")
    places, left = _left_over(tiles, transform, moving)
    side = _tile_side(places, tiles.channel)
    low, high = places.min(axis=0) - 0.5 * side, places.max(axis=0) + 0.5 * side
    flat = _Part.of(Sample(places, left, tiles.block, tiles.channel, side, low, high), options)
    bend = _warp(flat.named, None, flat.sample)
    up = None
    found = height_tiles(reference, moving, bend, side, low, high)
    if found is not None:
        single = np.arange(len(found[0])), np.zeros(len(found[0]), int)
        up = _Part.of(Sample(found[0], found[1][:, None], *single, side, low, high), options)
    return _told(flat, up, options)


def _left_over(
    tiles: TileOffsets, transform: Transform, moving: SurveyRaster
) -> tuple[Float64, Float64]:
    """Where the transform puts each tile, and how far from there it belongs (M, 2) [m]."""
    level = np.full((len(tiles.places), 1), transform.pivot[2])
    points = np.hstack([tiles.places, level])
    row, col = moving.grid.row_col(*transform.apply(points)[:, :2].T)
    rows, cols = moving.grid.shape
    row = np.clip(np.rint(row).astype(int), 0, rows - 1)
    col = np.clip(np.rint(col).astype(int), 0, cols - 1)
    # a tilt moves a tile sideways by its height; where none is known, the ground's middle stands
    above = moving.height[row, col].astype(np.float64) + moving.datum
    middle = np.median(above[np.isfinite(above)]) if np.isfinite(above).any() else 0.0
    above = np.where(np.isfinite(above), above, middle)
    points[:, 2] += above - transform.apply(points)[:, 2]
    places = transform.apply(points)[:, :2]
    return places, tiles.places + tiles.offsets - places


def _tile_side(places: Float64, channel: np.ndarray) -> float:
    """Side of the larger channel's tiles [m]: they lie side by side."""
    from scipy.spatial import cKDTree

    sides = []
    for name in np.unique(channel):
        own = places[channel == name]
        if len(own) > 1:
            sides.append(float(np.median(cKDTree(own).query(own, k=2)[0][:, 1])))
    return max(sides)


# ---- what is told -----------------------------------------------------------------------------


def _warp(flat: Step | None, up: Step | None, sample: Sample) -> Warp:
    """Join both parts, which share the box and its intervals, in one record.

    Where a rigid move is enough, the transform's stands: that part does not move at all.
    """
    present = flat or up
    assert present is not None
    table = np.zeros((*present.coefficients.shape[:2], 3))
    if flat is not None and flat.model != "rigid":
        table[..., :2] = flat.coefficients
    if up is not None and up.model != "rigid":
        table[..., 2:] = up.coefficients
    names = ["rigid" if step is None else step.model for step in (flat, up)]
    return Warp(names[0], names[1], sample.low, sample.high, table)


def _told(flat: _Part, up: _Part | None, options: WarpSettings) -> Deformation:
    named = _warp(flat.named, None if up is None else up.named, flat.sample)
    allowed = _warp(flat.allowed, None if up is None else up.allowed, flat.sample)
    parts = {"horizontal": _part_record(flat, named)}
    if up is not None:
        parts["vertical"] = _part_record(up, named)
    phrases = [p for p in (_flat_phrase(parts), _up_phrase(parts)) if p]
    if phrases:
        said = f"translation is not enough: {' and '.join(phrases)}"
        for name, part in parts.items():
            if part["strain"] > options.max_strain:
                said += (
                    f"; the {name} bend strains the survey by {part['strain']:.1%}, over the "
                    f"{options.max_strain:.1%} (warp.max_strain) up to which a warp is applied"
                )
                if part["allowed"] != "rigid":
                    said += f": the {part['allowed']} model is within it"
                elif len(parts) > 1:
                    said += f": that part ({name}) stays as it is"
    else:
        rms = [_length(part["held_out_rigid"]) for part in parts.values()]
        also = f" and {rms[1]} in height" if len(rms) > 1 else ""
        said = f"a rigid move is enough: its tiles agree to {rms[0]} rms{also}"
        for name, part in parts.items():
            if part["set_aside"] >= _MANY * part["tiles"]:
                said += (
                    f"; {part['set_aside']} of {part['tiles']} tiles lie apart ({name}), "
                    "as changed ground does"
                )
    bent = (allowed.horizontal, allowed.vertical) != ("rigid", "rigid")
    record: dict[str, Any] = {"said": said, "applied": False, "horizontal": None, "vertical": None}
    evidence = _tile_evidence(said, named, flat, up)
    return Deformation(said, record | parts, allowed if bent else None, evidence)


def _part_record(part: _Part, warp: Warp) -> dict[str, Any]:
    """Numbers of one half: held-out errors over the tiles that count, and the bend alone."""
    sample, named = part.sample, part.named
    used = named.weights > 0
    axes = slice(0, 2) if sample.values.shape[1] == 2 else slice(2, 3)
    bend = _without_rigid(warp.displacement(sample.places)[:, axes], sample.places)[used]
    length = np.linalg.norm(bend, axis=1)
    return {
        "model": named.model,
        "tiles": len(sample.places),
        "set_aside": int((~used).sum()),
        "held_out_rigid": float(np.sqrt(np.mean(part.rigid.held[used] ** 2))),
        "held_out": float(np.sqrt(np.mean(named.held[used] ** 2))),
        "bend_rms": 0.0 if named.model == "rigid" else float(np.sqrt(np.mean(length**2))),
        "bend_largest": 0.0 if named.model == "rigid" else float(length.max()),
        "doming": _doming(warp) if named.model == "dome" and axes.start == 2 else None,
        "strain": named.strain,
        "allowed": part.allowed.model,
    }


def _doming(warp: Warp) -> float:
    """Height of the moving model's middle above the corners of the box, too much [m]."""
    (west, south), (east, north) = warp.low, warp.high
    corners = np.array([[west, south], [west, north], [east, south], [east, north]])
    up = warp.displacement(np.vstack([corners.mean(axis=0), corners]))[:, 2]
    return float(up[1:].mean() - up[0])


def _without_rigid(values: Float64, places: Float64) -> Float64:
    """Displacements (M, K) less their least-squares rigid part (K = 2) or plane (K = 1)."""
    arm = places - places.mean(axis=0)
    if values.shape[1] == 2:
        rest = values - values.mean(axis=0)
        turn = (arm[:, 0] * rest[:, 1] - arm[:, 1] * rest[:, 0]).sum() / (arm**2).sum()
        return np.asarray(rest - turn * np.stack([-arm[:, 1], arm[:, 0]], axis=1))
    plane = np.column_stack([np.ones(len(arm)), arm])
    return np.asarray(values - plane @ np.linalg.lstsq(plane, values, rcond=None)[0])


def _flat_phrase(parts: Mapping[str, Any]) -> str:
    flat = parts["horizontal"]
    if flat["model"] == "rigid":
        return ""
    if flat["model"] == "similarity":
        return f"the scales differ by {flat['strain']:.2%} (similarity)"
    return f"the models bend by {_length(flat['bend_rms'])} rms ({flat['model']})"


def _up_phrase(parts: Mapping[str, Any]) -> str:
    up = parts.get("vertical")
    if up is None or up["model"] == "rigid":
        return ""
    if up["model"] == "dome":
        return f"doming {_length(abs(up['doming']))}"
    return f"the heights bend by {_length(up['bend_rms'])} rms ({up['model']})"


def _length(metres: float) -> str:
    if metres < 0.01:
        return f"{1000 * metres:.0f} mm" if metres >= 0.0005 else "under 1 mm"
    return f"{100 * metres:.1f} cm" if metres < 0.095 else f"{100 * metres:.0f} cm"


def _tile_evidence(said: str, warp: Warp, flat: _Part, up: _Part | None) -> dict[str, Any]:
    """Tiles as arrays for the figure: places, what they say, what the named model says there."""

    def of(part: _Part, axes: slice) -> tuple[Float64, ...]:
        places = part.sample.places
        said = warp.displacement(places)[:, axes]
        return (*places.T, *part.sample.values.T, *said.T, part.named.weights)

    names = ["east", "north", "d_east", "d_north", "model_east", "model_north", "weight"]
    found: dict[str, Any] = {"said": said, **dict(zip(names, of(flat, slice(0, 2)), strict=True))}
    if up is not None:
        names = ["up_east", "up_north", "up", "model_up", "up_weight"]
        found |= dict(zip(names, of(up, slice(2, 3)), strict=True))
    return found
