"""The last word on a pair: an ordered list of rules over everything that was measured.

The place is judged first, by evidence alone (`meshreg.judge`). What the stages after it find, on
the scale, the heights, the tilt, the layers or the tears of a model, is gathered in one record, and
each rule here says in a sentence why, in view of it, the pair cannot be accepted. No rule makes
anything better than it was.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshreg.judge.judging import Judgement
from meshreg.records import Finding, Gain, Layer, Tear

STEEPEST = 10.0  # degrees of tilt that may be applied
WALL = 60.0  # degrees from which a survey cannot be looked at from above
APART = 0.10  # m between the parts of a model that is torn
MOST_UNDECIDED = 0.5  # cells: peaks farther apart than this are not one peak that leans
SECOND_SURFACE = 0.10  # of the cells
LEAST_UP = 0.14  # m: sigma of up, or the relief, below which neither is absurd
WHERE_SEEN = 0.5  # of those where a copy could be seen, were it there
FEET = 0.3048
LEAST_STRETCH = 0.003  # a scale nearer to 1 than this is within what cameras and scale bars do
# A scale that explains less than so many times what it leaves may be internal distortion; where it
# moves the corners by more than that does, less is asked for.
PLAIN_RATIO, FAR_RATIO = 3.0, 1.5
WARP_AT_MOST = 0.5  # m


@dataclass(frozen=True)
class Stretch:
    """Scale by which the moving survey's lengths would have to be multiplied to fit best.

    Attributes
    ----------
    value, sigma : float
    moves : float
        How far that moves the corners of the overlap [m].
    ratio : float
        Displacement of the tiles that the scale explains, over what it leaves (root mean squares).
    fitted : bool
        Whether it is part of the answer.
    """

    value: float
    sigma: float
    moves: float
    ratio: float
    fitted: bool = False


@dataclass(frozen=True)
class Found:
    """What the stages have measured; None where one has not.

    Attributes
    ----------
    turned : Finding or None
        Why the tiles give no answer of their own (`meshreg.refine`).
    tilted : str
        Why the heights give none (`height`).
    scaled : str
        Which scale was applied though nobody asked for it (`meshreg.heading`).
    stretch : Stretch or None
    gain : Gain or None
    tear, step : Tear or None
        Two populations of the tiles' horizontal offsets, and of their heights.
    dips : (float, float) or None
        Tilt of each survey's own surface [degrees].
    axes : str
        Which axes would make the surveys agree, where they do not and others were tried.
    far : Finding or None
        At which turn or scale, beyond those that are searched, the surveys would fit.
    tilt : float
        Applied [degrees].
    layers : pair of Layer or None
    sigma_up : float
        Of up at the centroid of the overlap [m].
    relief : float
        Range of 98 % of the reference's heights [m].
    undecided : float
        What tones and edges of the image disagree by, in cells, where it alone tells the place.
    surfaces : str
        Where both surfaces ask to lie instead (`refine.surfaces`).
    ties : str
        In what hand-picked points contradict the answer.
    """

    turned: Finding | None = None
    tilted: str = ""
    scaled: str = ""
    stretch: Stretch | None = None
    gain: Gain | None = None
    tear: Tear | None = None
    step: Tear | None = None
    dips: tuple[float, float] | None = None
    axes: str = ""
    far: Finding | None = None
    tilt: float = 0.0
    layers: tuple[Layer | None, Layer | None] = (None, None)
    sigma_up: float = 0.0
    relief: float = float("inf")
    undecided: float = 0.0
    surfaces: str = ""
    ties: str = ""


def _upright(found: Found) -> str:
    if found.dips is None or min(found.dips) < WALL:
        return ""
    first, second = found.dips
    return (
        f"both surveys stand upright (their surfaces dip by {first:.0f}° and {second:.0f}°), and "
        "from above a wall cannot be compared"
    )


def _lean(found: Found) -> str:
    if found.dips is not None and max(found.dips) >= WALL > min(found.dips):
        which = "reference" if found.dips[0] > found.dips[1] else "moving"
        return (
            f"the {which} survey stands upright (its surface dips by {max(found.dips):.0f}°), "
            "the other does not"
        )
    if found.tilt > STEEPEST:
        return f"the answer tilts the moving survey by {found.tilt:.1f}°, beyond {STEEPEST:g}°"
    return ""


def _upside_down(found: Found) -> str:
    if found.gain is None or not found.gain.inverted:
        return ""
    return (
        "the relief recurs upside down, as where one survey's heights are depths: what rises "
        "in one falls in the other"
    )


def _heights(found: Found) -> str:
    gain = found.gain
    if gain is None or gain.inverted or not gain.departs:
        return ""
    value = gain.value
    times = value if value > 1 else 1 / value
    who = "moving" if value > 1 else "reference"
    sigma = gain.sigma * times
    said = (
        f"the heights of the {who} survey are {times:.2f} ± {sigma:.2f} times those of the other "
        "where the same relief recurs"
    )
    if abs(np.log(times * FEET)) < max(2 * gain.sigma, 0.03):
        return f"{said}: are they in feet?"
    return f"{said}: a vertical exaggeration of {times:.2g}, or another unit?"


def _stretched(found: Found) -> str:
    part = found.stretch
    if part is None or part.fitted:
        return ""
    off = abs(part.value - 1)
    if off <= 3 * part.sigma or off < LEAST_STRETCH:
        return ""
    far = part.moves >= WARP_AT_MOST  # further than internal distortion reaches
    if part.ratio < (FAR_RATIO if far else PLAIN_RATIO):
        return ""
    way = "small" if part.value > 1 else "large"
    return (
        f"the moving survey is {100 * abs(1 / part.value - 1):.2f} ± {100 * part.sigma:.2f} % too "
        f"{way}, which moves its corners by {part.moves:.2g} m: check the scale bars"
    )


def _layered(found: Found) -> str:
    said = []
    for name, layer in zip(("reference", "moving"), found.layers, strict=True):
        if layer is not None and (layer.common >= SECOND_SURFACE or layer.where_seen >= WHERE_SEEN):
            east, north, up = layer.offset
            said.append(
                f"the {name} survey holds a second copy of its surface, seen in {layer.common:.0%} "
                f"of its cells, about ({east:+.2f}, {north:+.2f}, {up:+.2f}) m beside the first"
            )
    return " and ".join(said)


def _torn(found: Found) -> str:
    said = []
    for tear, name in ((found.tear, "horizontally"), (found.step, "in height")):
        if tear is not None and tear.size > APART:
            said.append(
                f"a part of one model in the {tear.side} ({tear.share:.0%} of the tiles) lies "
                f"{100 * tear.size:.0f} ± {100 * tear.sigma:.0f} cm {name} from where the rest "
                "has it"
            )
    return " and ".join(said) + (": torn, or slid as one piece" if said else "")


def _uncertain_up(found: Found) -> str:
    if not found.sigma_up > max(found.relief, LEAST_UP):
        return ""
    return (
        f"up is known to ± {found.sigma_up:.2g} m only, more than the whole relief of "
        f"{found.relief:.2g} m"
    )


def _undecided(found: Found) -> str:
    if not found.undecided > MOST_UNDECIDED:
        return ""
    return (
        "the image alone tells the place, and its tones and its edges disagree on it by "
        f"{found.undecided:.1f} cells: was the light from another side?"
    )


Rule = Callable[[Found], str | Finding | None]
# In the order in which they are told: what explains other findings comes first. A rule gives the
# text of a finding with its code, or a finding.
RULES: tuple[tuple[str, Rule], ...] = (
    ("axes", lambda found: found.axes),
    ("", lambda found: found.far),
    ("upright", _upright),
    ("lean", _lean),
    ("layers", _layered),
    ("tear", _torn),
    ("upside_down", _upside_down),
    ("heights", _heights),
    ("scale", lambda found: found.scaled or _stretched(found)),
    ("tilt", lambda found: found.tilted),
    ("", lambda found: found.turned),
    ("light", _undecided),
    ("surfaces", lambda found: found.surfaces),
    ("up", _uncertain_up),
    ("ties", lambda found: found.ties),
)


# The numbers of a finding, by its code.
VALUES: Mapping[str, Callable[[Found], Mapping[str, float]]] = {
    "upright": lambda found: _numbers(reference=_dip(found, 0), moving=_dip(found, 1)),
    "lean": lambda found: _numbers(tilt_degrees=found.tilt),
    "tear": lambda found: _numbers(horizontal=_size(found.tear), vertical=_size(found.step)),
    "heights": lambda found: (
        _numbers(gain=found.gain.value, sigma_log=found.gain.sigma) if found.gain else {}
    ),
    "scale": lambda found: (
        _numbers(scale=part.value, sigma=part.sigma, moves=part.moves)
        if (part := found.stretch)
        else {}
    ),
    "light": lambda found: _numbers(cells=found.undecided),
    "up": lambda found: _numbers(sigma_up=found.sigma_up, relief=found.relief),
}
# Codes of findings that are not made by the rules above.
PLACED = ("mirrored", "contradiction", "flat", "chance", "overlap", "border", "weak", "alone")
BEFORE = ("degrees", "apart", "nothing", "turned", "resized", "heading", "pieces")
CODES = (*BEFORE, *(code for code, _ in RULES if code), *PLACED)
FAR = ("turned", "resized")
# What a survey that stands upright, seen from above, brings with it.
OF_UPRIGHT = frozenset(
    (
        "layers",
        "tear",
        "upside_down",
        "heights",
        "scale",
        "tilt",
        "heading",
        "pieces",
        "light",
        "surfaces",
        "up",
    )
)


def _dip(found: Found, which: int) -> float | None:
    return None if found.dips is None else found.dips[which]


def _size(tear: Tear | None) -> float | None:
    return None if tear is None else tear.size


def _numbers(**values: float | None) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in values.items()
        if value is not None and np.isfinite(value)
    }


def findings(found: Found) -> tuple[Finding, ...]:
    """Return what speaks against accepting the pair, each with its code."""
    upright = found.dips is not None and max(found.dips) >= WALL
    told = []
    for code, rule in RULES:
        said = rule(found)
        if isinstance(said, str) and said:
            said = Finding(code, said, values=VALUES[code](found) if code in VALUES else {})
        if isinstance(said, Finding) and not (upright and said.code in OF_UPRIGHT):
            told.append(said)
    return tuple(told)


def last_word(judgement: Judgement, against: Sequence[Finding]) -> Judgement:
    """Return the judgement of the place, no better than "review" where anything speaks against."""
    said = judgement.downgraded(against)
    if any(finding.code in FAR for finding in against):  # it explains why nothing was found
        return replace(said, reason="; ".join(finding.text for finding in against))
    return said
