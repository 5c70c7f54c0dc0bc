"""JUDGE: score all candidates by one neutral measure, fuse those that agree, give the verdict.

The methods propose; two independent channels, terrain and image, dispose (`offsets.neutral`).
A wrong registration marked accepted is the worst that can happen here, so a candidate is accepted
only when both channels put it first by more than chance could, or one does so overwhelmingly and
the other does not contradict. Chance is measured on the pair itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from meshreg.offsets import neutral
from meshreg.offsets.channels import smooth
from meshreg.offsets.correlate import Correlator, Window
from meshreg.offsets.surface import Peak, find_peak, gap_at
from meshreg.records import (
    RASTER_OF,
    Channel,
    Finding,
    Float64,
    OffsetEstimate,
    Severity,
    SurveyRaster,
    Verdict,
)
from meshreg.settings import JudgeSettings, Settings

EXCHANGES = ((True, False), (False, True), (True, True))  # down, across
_OF_PLOT = 0.05  # of the shorter side: what is further apart is another place on any plot
TURNS = tuple((turn, flip) for turn in range(4) for flip in (False, True))[1:]
SCORED_OVERLAP = 0.10  # of the largest: the neutral measure is fair to small overlaps
EXCHANGED = "with east and north exchanged"
TURN_NAMES = {
    (0, True): "mirrored east-west",
    (2, True): "mirrored north-south",
    (1, False): "turned by 90°",
    (2, False): "turned by 180°",
    (3, False): "turned by 270°",
    (1, True): EXCHANGED,
    (3, True): "with east and north exchanged and reversed",
}


@dataclass(frozen=True)
class ChannelMap:
    """One channel's evidence for every offset, and what chance does to it.

    Attributes
    ----------
    name : "terrain" or "image"
    window : Window
    surface : (K, L) float64
        Evidence in deviations of chance (`neutral.surface`).
    counts : (K, L) float64
        Cells in the overlap.
    cells : int
        Cells of the smaller survey.
    peak : Peak or None
    null_gap : float
        Mean gap of the maps that have no true match: the moving survey mirrored or turned, or its
        halves exchanged; the scale on which gaps are exponential.
    turned : mapping
        Gap of each mirrored or turned map, by its name.
    exchanged : tuple of float
        Gaps of the maps whose tiles lie beside the wrong ones.
    """

    name: Channel
    window: Window
    surface: Float64
    counts: Float64
    cells: int
    peak: Peak | None
    null_gap: float
    turned: Mapping[str, float]
    exchanged: tuple[float, ...] = ()

    def false_alarm(self, gap: float) -> float:
        """Chance that a wrong peak stands out by `gap`: exponential in units of the null gap."""
        return math.exp(-max(gap, 0.0) / self.null_gap)


@dataclass(frozen=True)
class Hypothesis:
    """A candidate offset with the neutral scores that it got in each channel.

    `gaps` and `values` are by channel; `methods` names who proposed it.
    """

    east: float
    north: float
    sigma: Float64
    gaps: Mapping[str, float]
    values: Mapping[str, float]
    methods: tuple[str, ...]
    overlap: float

    @property
    def score(self) -> float:
        """Sum of the channels' evidence over sqrt(channels): the order of the hypotheses."""
        finite = [v for v in self.values.values() if math.isfinite(v)]
        return sum(finite) / math.sqrt(len(finite)) if finite else -math.inf


@dataclass(frozen=True)
class Judgement:
    """The verdict, and what speaks against accepting the pair.

    The reason is the text of the findings; of an accepted pair, what speaks for it.
    """

    verdict: Verdict
    reason: str
    best: Hypothesis | None
    hypotheses: tuple[Hypothesis, ...] = ()
    false_alarm: float = 1.0
    maps: Mapping[str, ChannelMap] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def downgraded(self, against: Sequence[Finding]) -> Judgement:
        """Return the same judgement, no better than "review" where anything speaks against."""
        if not against:
            return self
        verdict: Verdict = "review" if self.verdict == "accepted" else self.verdict
        reason = "; ".join(finding.text for finding in against)
        return replace(
            self,
            verdict=verdict,
            reason=f"{reason} ({self.reason})",
            findings=(*against, *self.findings),
        )


def channel_maps(
    rasters: Mapping[str, tuple[SurveyRaster, SurveyRaster]],
    radius: float,
    fields: neutral.FieldsOf = neutral.pair_fields,
    *,
    chance: bool = True,
) -> dict[str, ChannelMap]:
    """Compute the evidence of each channel, "terrain" and "image", that has any.

    Parameters
    ----------
    rasters : mapping
        "dem" and "ortho" to (reference, moving).
    radius : float
        Half width of the search window [m].
    fields : callable, optional
        Instead of `neutral.pair_fields`, where their fields are known already.
    chance : bool
        False: what chance does is not measured, which takes ten times as long.
    """
    maps: dict[str, ChannelMap] = {}
    for channel, raster in RASTER_OF.items():
        pair = rasters[raster]
        found = channel_map(*pair, channel, radius, SCORED_OVERLAP, fields, chance=chance)
        if found is not None:
            maps[channel] = found
    return maps


def judge(
    estimates: Sequence[OffsetEstimate],
    rasters: Mapping[str, tuple[SurveyRaster, SurveyRaster]],
    settings: Settings,
    radius: float,
    trials: int = 1,
    maps: Mapping[str, ChannelMap] | None = None,
    rivals: Mapping[str, float] | None = None,
) -> Judgement:
    """Weigh the methods' candidates against the evidence of terrain and image.

    Parameters
    ----------
    estimates : sequence of OffsetEstimate
    rasters : mapping
        "dem" and "ortho" to (reference, moving).
    settings : Settings
    radius : float
        Half width of the search window [m].
    trials : int
        How many turns and scales of the moving survey these rasters were chosen from: chance is
        so many times more likely.
    maps : mapping, optional
        The `channel_maps` of these rasters, where they have been computed already.
    rivals : mapping, optional
        The highest evidence of each channel at places that these rasters do not show.
    """
    if maps is None:
        maps = channel_maps(rasters, radius)
    if not maps:
        said = "the surveys do not overlap within the search window"
        return Judgement("rejected", said, None, findings=(Finding("nothing", said, "rejected"),))
    reach = agree_distance(settings.judge, rasters["dem"])
    candidates = _candidates(estimates, maps)
    hypotheses = tuple(
        sorted(_merge(candidates, maps, reach, rivals or {}), key=lambda h: h.score, reverse=True)
    )
    if not hypotheses:
        none = Finding("nothing", "no method found a candidate", "rejected")
        return Judgement("rejected", none.text, None, maps=maps, findings=(none,))
    reliefs = [relief_of(raster) for raster in rasters["dem"]]
    flat = _flat(reliefs, settings.judge.flat_relief)
    return _verdict(hypotheses, maps, settings.judge, radius, reach, trials, flat)


def relief_of(raster: SurveyRaster) -> float:
    """Return the range [m] of 98 % of the heights about their surroundings (5 cells)."""
    rows, cols = np.nonzero(raster.valid)
    if len(rows) < 3:
        return 0.0
    # without its plane a slope would show as relief at the survey's rim
    design = np.stack([np.ones(len(rows)), rows, cols], axis=1)
    found = raster.height[raster.valid].astype(np.float64)
    found -= design @ np.linalg.lstsq(design, found, rcond=None)[0]
    height = np.zeros(raster.valid.shape)
    height[raster.valid] = found
    found -= smooth(height, raster.valid, 5.0)[raster.valid]
    return float(np.subtract(*np.quantile(found, (0.99, 0.01))))


def _flat(reliefs: Sequence[float], limit: float) -> str:
    """Name the surveys, reference and moving, that have no relief to be known by; or ''."""
    flat = [
        f"the {name} survey is flat (98 % of it within {relief * 100:.1f} cm)"
        for name, relief in zip(("reference", "moving"), reliefs, strict=True)
        if relief < limit
    ]
    return " and ".join(flat)


def agree_distance(settings: JudgeSettings, dem: tuple[SurveyRaster, SurveyRaster]) -> float:
    """Candidates nearer than this [m] are one: 0.25 m, 1/20 of a smaller plot, or 2.5 DEM cells."""
    shorter = min(min(raster.grid.shape) * raster.grid.cell for raster in dem)
    return max(min(settings.agree_distance, _OF_PLOT * shorter), 2.5 * dem[0].grid.cell)


def channel_map(
    reference: SurveyRaster,
    moving: SurveyRaster,
    channel: Channel,
    radius: float,
    min_overlap: float,
    fields: neutral.FieldsOf = neutral.pair_fields,
    *,
    chance: bool = True,
) -> ChannelMap | None:
    """Compute a channel's evidence and its null; None where there is nothing to compare."""
    valid = reference.mask_of(channel), moving.mask_of(channel)
    if min(int(mask.sum()) for mask in valid) < 100:
        return None
    first, second = fields(reference, moving, channel)
    transformed: dict[tuple[int, int], neutral.Spectra] = {}

    def look(
        other: neutral.Fields, turn: int = 0, apart: Sequence[tuple[float, float]] = ()
    ) -> tuple[Window, Float64, Float64, Peak | None] | None:
        """Evidence and its peak, for a changed moving survey; none within reach of `apart`."""
        window = Window.around(reference.grid, neutral.turned_grid(moving.grid, turn), radius)
        if window.empty:
            return None
        correlator = Correlator(window, single=True, workers=1)  # SIFT runs beside it
        if window.padded not in transformed:
            transformed[window.padded] = neutral.spectra(first, correlator)
        changed = neutral.spectra(other, correlator)
        surface, counts = neutral.surface(
            transformed[window.padded], changed, correlator, min_overlap
        )
        exclusion = window.exclusion(5)
        for east, north in apart:
            away = np.hypot(window.east[None, :] - east, window.north[:, None] - north)
            surface[away < 3 * exclusion] = np.nan
        return window, surface, counts, find_peak(surface, window.east, window.north, exclusion)

    seen = look(second)
    if seen is None:
        return None
    window, surface, counts, peak = seen
    if peak is None:
        return None
    turned: dict[str, float] = {}
    for turn, flip in TURNS if chance else ():
        null = look(second.turned(turn, flip), turn)
        if null is not None and null[3] is not None:
            turned[TURN_NAMES[turn, flip]] = null[3].gap
    exchanged: list[float] = []
    for down, across in EXCHANGES if chance else ():
        other, steps = second.exchanged(down, across)
        # what was moved down and right matches the reference that much further up and left
        true = [
            (peak.east - col * window.cell, peak.north + row * window.cell) for row, col in steps
        ]
        null = look(other, apart=true)
        if null is not None and null[3] is not None:
            exchanged.append(null[3].gap)
    # The theory of extremes gives 1/sqrt(2 ln M) for M independent offsets: about 0.3. A map
    # that matches by chance of symmetry (or because the survey IS mirrored) must not widen the
    # scale for the rest, hence the median; ln 2 turns an exponential's median into its mean.
    gaps = [*turned.values(), *exchanged]
    null_gap = max(float(np.median(gaps)) / math.log(2) if gaps else 0.0, 0.3)
    smaller = min(int(mask.sum()) for mask in valid)
    return ChannelMap(
        channel, window, surface, counts, smaller, peak, null_gap, turned, tuple(exchanged)
    )


def _candidates(
    estimates: Sequence[OffsetEstimate], maps: Mapping[str, ChannelMap]
) -> list[tuple[float, float, Float64 | None, str]]:
    """Every method's answer and each channel's own first and second peak."""
    found: list[tuple[float, float, Float64 | None, str]] = [
        (e.east, e.north, e.sigma, e.method) for e in estimates if e.status != "failed"
    ]
    for name, channel in maps.items():
        assert channel.peak is not None
        # how sharp a peak is does not tell how far warp has moved it: no sigma of its own
        found.append((channel.peak.east, channel.peak.north, None, f"{name} channel"))
        if channel.peak.second is not None:
            found.append((*channel.peak.second, None, f"{name} channel's second"))
    return found


def _merge(
    candidates: list[tuple[float, float, Float64 | None, str]],
    maps: Mapping[str, ChannelMap],
    reach: float,
    rivals: Mapping[str, float],
) -> list[Hypothesis]:
    """Score each candidate, then let those within `reach` of a better one join it."""
    scored = []
    for east, north, _, method in candidates:
        gaps, values, places = {}, {}, []
        for name, channel in maps.items():
            window = channel.window
            gaps[name], values[name], place = gap_at(
                channel.surface, window.east, window.north, (east, north), reach
            )
            if name in rivals:  # evidence and gaps are in deviations of chance both
                gaps[name] = min(gaps[name], values[name] - rivals[name])
            places.append(place)
        overlap = max(_overlap_at(channel, (east, north)) for channel in maps.values())
        scored.append(Hypothesis(east, north, np.eye(2), gaps, values, (method,), overlap))
    scored.sort(key=lambda h: h.score, reverse=True)
    groups: list[list[Hypothesis]] = []
    for hypothesis in scored:
        for group in groups:
            lead = group[0]
            if math.hypot(lead.east - hypothesis.east, lead.north - hypothesis.north) <= reach:
                group.append(hypothesis)
                break
        else:
            groups.append([hypothesis])
    answers = {(east, north): sigma for east, north, sigma, _ in candidates}
    return [_fused(group, maps, answers) for group in groups]


def _fused(
    group: list[Hypothesis],
    maps: Mapping[str, ChannelMap],
    answers: Mapping[tuple[float, float], Float64 | None],
) -> Hypothesis:
    """Join the members of a group, each by the inverse of its variance.

    One number a member, not its whole covariance: two long, slanted ellipses (a beach, a ridge)
    cross far outside both of their centres, and the joined offset must lie among its members.
    One further from the most certain member than three of its own sigmas is named as a supporter
    but does not pull the mean. The sum of weights is not trusted as a covariance: the members look
    at the same ground, so the best single one's is kept.
    """
    lead = group[0]
    place = np.array([lead.east, lead.north])
    best = max(channel.window.cell for channel in maps.values()) ** 2 * np.eye(2)
    known = [(np.array([m.east, m.north]), answers[m.east, m.north]) for m in group]
    told = sorted(
        ((at, sigma) for at, sigma in known if sigma is not None), key=lambda a: np.trace(a[1])
    )
    if told:
        anchor, best = told[0]
        total, weights = np.zeros(2), 0.0
        for at, sigma in told:
            step = at - anchor
            if step @ np.linalg.solve(sigma + np.eye(2) * 0.02**2, step) <= 3**2:
                weight = 1.0 / float(np.trace(sigma))
                total, weights = total + weight * at, weights + weight
        place = total / weights
    methods = tuple(dict.fromkeys(m for member in group for m in member.methods))
    return Hypothesis(
        float(place[0]), float(place[1]), best, lead.gaps, lead.values, methods, lead.overlap
    )


def _overlap_at(channel: ChannelMap, at: tuple[float, float]) -> float:
    """Overlap at an offset as a share of the smaller survey's cells."""
    col = int(np.argmin(np.abs(channel.window.east - at[0])))
    row = int(np.argmin(np.abs(channel.window.north - at[1])))
    return float(channel.counts[row, col] / channel.cells)


def _verdict(
    hypotheses: tuple[Hypothesis, ...],
    maps: Mapping[str, ChannelMap],
    settings: JudgeSettings,
    radius: float,
    reach: float,
    trials: int,
    flat: str,
) -> Judgement:
    best = hypotheses[0]
    alarm = min(1.0, trials * _false_alarm(best, maps, radius, reach))

    def accept(reason: str) -> Judgement:
        return Judgement("accepted", reason, best, hypotheses, alarm, maps)

    def say(severity: Severity, code: str, text: str) -> Judgement:
        values = {f"{name}_gap": gap for name, gap in best.gaps.items()}
        values |= {"false_alarm": alarm, "overlap": best.overlap}
        values = {name: value for name, value in values.items() if math.isfinite(value)}
        against = (Finding(code, text, severity, values),)
        return Judgement(severity, text, best, hypotheses, alarm, maps, against)

    support = {name: gap for name, gap in best.gaps.items() if gap >= settings.support_gap}
    leader = max(best.gaps, key=lambda name: best.gaps[name])
    contradicting = {
        name: channel.peak.gap
        for name, channel in maps.items()
        if best.gaps[name] < 0
        and channel.peak is not None
        and channel.false_alarm(channel.peak.gap) < settings.max_false_alarm
    }
    turned = turned_map(maps, settings)
    how = turned if turned.startswith("with") else f"when {turned}"
    words = ", ".join(f"{name} gap {gap:.1f}" for name, gap in best.gaps.items())
    if turned and max(best.gaps.values()) < settings.accept_gap:
        return say("rejected", "mirrored", f"the moving survey fits only {how}: check its axes")
    if contradicting:
        where = " and ".join(contradicting)
        said = f"the channels contradict each other: {where} fits elsewhere ({words})"
        return say("review", "contradiction", said)
    if alarm > settings.chance_false_alarm and flat:
        return say(
            "review",
            "flat",
            f"{flat}: too little to know the place by, or to tell it from another ({words})",
        )
    if alarm > settings.chance_false_alarm:
        return say(
            "rejected",
            "chance",
            f"no offset within ±{radius:g} m stands out from chance ({words}); "
            "another place, too much change, or beyond the search radius",
        )
    if best.overlap < settings.min_overlap:
        return say("review", "overlap", f"the surveys overlap by only {best.overlap:.0%}")
    edge = radius - max(abs(best.east), abs(best.north))
    if edge < 2 * max(channel.window.cell for channel in maps.values()):
        said = "the best offset is at the search border; try a larger --search-radius"
        return say("review", "border", said)
    if turned:
        return say("review", "mirrored", f"the moving survey fits just as well {how}")
    if alarm > settings.max_false_alarm:
        said = f"chance could do as well once in {1 / alarm:.3g} ({words})"
        return say("review", "weak", said)
    if len(support) >= 2 and max(support.values()) >= settings.accept_gap / 2:
        return accept(f"terrain and image agree ({words})")
    if best.gaps[leader] >= settings.overwhelming_gap:
        others = [name for name in best.gaps if name != leader]
        silent = f"; {others[0]} is silent" if others else f"; there is no {_missing(maps)}"
        return accept(f"{leader} is overwhelming ({words}){silent}")
    said = f"only {leader} stands out, and not overwhelmingly ({words})"
    return say("review", "alone", said)


def _false_alarm(
    best: Hypothesis, maps: Mapping[str, ChannelMap], radius: float, reach: float
) -> float:
    """Chance that unrelated ground makes a candidate this good.

    Each channel's gap has an exponential tail; where both put the same place first, two
    unrelated maps would do that only as often as the agreement disc fills the window.
    """
    alarm, first = 1.0, True
    for name, channel in maps.items():
        gap = best.gaps[name]
        if gap <= 0:
            continue
        alarm *= channel.false_alarm(gap)
        if not first:
            area = min((2 * radius) ** 2, channel.window.area)
            alarm *= min(1.0, math.pi * reach**2 / max(area, 1e-12))
        first = False
    return alarm


def turned_map(maps: Mapping[str, ChannelMap], settings: JudgeSettings) -> str:
    """Return the name of a mirrored or turned map that fits far better than chance, or ''."""
    worst, name = 0.0, ""
    for channel in maps.values():
        for turn, gap in channel.turned.items():
            if gap >= settings.accept_gap and gap > worst:
                worst, name = gap, turn
    return name


def _missing(maps: Mapping[str, Any]) -> str:
    return "color" if "image" not in maps else "relief"
