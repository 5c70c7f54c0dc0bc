"""What the evidence says of a place: one neutral measure for all candidates, and the verdict.

Terrain and image are each compared at every offset, whichever method proposed it; how far the best
stands above all others, in deviations of what unrelated ground reaches, is its gap. The verdict is
an ordered list of rules over that and over all that later stages find.
"""

from meshreg.judge.judging import (
    EXCHANGED,
    SCORED_OVERLAP,
    ChannelMap,
    Hypothesis,
    Judgement,
    agree_distance,
    channel_maps,
    judge,
    turned_map,
)
from meshreg.judge.layers import (
    second_surface,
)
from meshreg.judge.verdict import (
    CODES,
    Found,
    Stretch,
    findings,
    last_word,
)

__all__ = [
    "CODES",
    "EXCHANGED",
    "SCORED_OVERLAP",
    "ChannelMap",
    "Found",
    "Hypothesis",
    "Judgement",
    "Stretch",
    "agree_distance",
    "channel_maps",
    "findings",
    "judge",
    "last_word",
    "second_surface",
    "turned_map",
]
