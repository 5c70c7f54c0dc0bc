"""TIES: points that a person picked in both surveys, and what they say of a registration.

`table` keeps them as CSV, `formats` reads those of other programs, `hand` turns them into the
paper's hand registration, `validate` holds a registration against it. `session`, `tiles` and
`server` are the page on which they are picked.
"""

from __future__ import annotations

from meshreg.ties.hand import Hand, hand_registration, ties_estimate
from meshreg.ties.records import TiePair, TiePoints
from meshreg.ties.table import read_ties, write_ties

__all__ = [
    "Hand",
    "TiePair",
    "TiePoints",
    "hand_registration",
    "read_ties",
    "ties_estimate",
    "write_ties",
]
