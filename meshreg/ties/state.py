"""What the page shows: two pictures, how one lies on the other, and what the pairs say so far."""

from __future__ import annotations

import math
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from meshreg.records import Float64, Transform
from meshreg.settings import SiftSettings
from meshreg.ties.cover import sectors, weak_spots
from meshreg.ties.hand import (
    PAIRS,
    Hand,
    free_hand,
    hand_document,
    moved,
    turn_degrees,
)
from meshreg.ties.placing import Placing
from meshreg.ties.records import TiePoints
from meshreg.ties.session import Session, as_place
from meshreg.ties.tiles import TileSource, overlap_points

SCHEMA = "meshreg.pick/1"
Move = Callable[[Any], Float64]


@dataclass(frozen=True)
class Link:
    """How the moving picture is laid on the reference's: a turn about one place and a shift.

    ``reference = centre + R(angle) (shown - shown_centre)``; angle in radians, counterclockwise.
    """

    angle: float
    shown: tuple[float, float]
    centre: tuple[float, float]

    def to_shown(self, points: Any) -> Float64:
        """Take reference points (N, 2) [m] to the moving picture's coordinates."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        away = np.asarray(points, float).reshape(-1, 2) - self.centre
        return np.asarray(away @ np.array([[c, -s], [s, c]]) + self.shown)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for the page."""
        return {"angle": self.angle, "shown": list(self.shown), "reference": list(self.centre)}


@dataclass(eq=False)
class PickState:
    """Everything that the page works on.

    Attributes
    ----------
    reference, moving : TileSource
    names : (str, str)
    session : Session
    placing : Placing, optional
        A registration that is known already.
    registered : bool
        The moving picture is of the registered survey (a result's own orthomosaic): its points
        are taken back to where the survey was delivered.
    settings : SiftSettings
        Of the RANSAC.
    """

    reference: TileSource
    moving: TileSource
    names: tuple[str, str]
    session: Session
    placing: Placing | None = None
    registered: bool = False
    settings: SiftSettings = field(default_factory=SiftSettings)

    def __post_init__(self) -> None:
        self.version = secrets.token_hex(4)  # a later run's tiles must not come from a cache
        self._lock = threading.Lock()
        self._state: dict[str, Any] | None = None
        self._said: tuple[Any, tuple[Hand | None, Transform | None]] | None = None
        self._overlaps: dict[Link, Float64] = {}

    def to_moving(self, shown: Any) -> Float64:
        """Take points (N, 2) [m] of the moving picture to the survey as delivered."""
        if self.registered and self.placing is not None:
            return self.placing.to_moving(shown)
        return np.asarray(shown, float).reshape(-1, 2)

    def to_shown(self, moving: Any) -> Float64:
        """Undo `to_moving`."""
        if self.registered and self.placing is not None:
            return self.placing.to_reference(moving)
        return np.asarray(moving, float).reshape(-1, 2)

    def job(self) -> dict[str, Any]:
        """Return what does not change: both pictures' names, cells and levels."""
        pictures = {}
        for side, source, name in (
            ("reference", self.reference, self.names[0]),
            ("moving", self.moving, self.names[1]),
        ):
            rows, cols = source.grid.shape
            pictures[side] = {
                "name": name,
                "west": source.grid.west,
                "north": source.grid.north,
                "cell": source.grid.cell,
                "rows": rows,
                "columns": cols,
                "resolutions": source.resolutions,
            }
        return {
            "schema": SCHEMA,
            "version": self.version,
            "pictures": pictures,
            "file": self.session.path.name,
            "crs": self.session.crs,
            "wanted": PAIRS,
        }

    def state(self) -> dict[str, Any]:
        """Return what changes: pairs with residuals, the hand registration, weak spots."""
        with self._lock:
            revision = self.session.revision
            if self._state is None or self._state["revision"] != revision:
                self._state = self._make_state(revision)
            return self._state

    def change(self, revision: int, what: str, values: dict[str, Any]) -> None:
        """Pass a change to the session, points of the moving picture taken to its survey."""
        if values.get("side") == "moving" and self.registered and {"x", "y"} <= set(values):
            x, y = self.to_moving([as_place(values)])[0].tolist()
            values = {**values, "x": x, "y": y}
        self.session.change(revision, what, values)

    def _make_state(self, revision: int) -> dict[str, Any]:
        ties = self.session.ties
        hand, turn = self._hand(ties)
        links = self._links(hand, turn)
        order = {pair.id: k for k, pair in enumerate(ties.complete)}
        pairs = []
        for pair in ties.pairs:
            k = order.get(pair.id)
            judged = hand is not None and k is not None
            pairs.append(
                {
                    "id": pair.id,
                    "name": pair.name,
                    "reference": pair.reference,
                    "moving": None
                    if pair.moving is None
                    else self.to_shown([pair.moving])[0].tolist(),
                    "residual": float(hand.residuals[k]) if judged else None,  # type: ignore[union-attr]
                    "inlier": bool(hand.inliers[k]) if judged else None,  # type: ignore[union-attr]
                }
            )
        reference, _ = ties.arrays()
        agreeing = reference if hand is None else reference[hand.inliers]
        best = links.get("registration") or links.get("pairs") or links["delivered"]
        parts = sectors(agreeing, self._overlap(best))
        return {
            "revision": revision,
            "pairs": pairs,
            "hand": None if hand is None else hand_document(hand),
            "turned": turn_degrees(turn),
            "sectors": [{"name": s.name, "share": s.share, "pairs": s.pairs} for s in parts],
            "weak": list(weak_spots(parts)),
            "links": {name: link.as_dict() for name, link in links.items()},
            "saved": self.session.saved,
            "can_undo": self.session.can_undo,
            "can_redo": self.session.can_redo,
        }

    def _hand(self, ties: TiePoints) -> tuple[Hand | None, Transform | None]:
        """Register by hand; again only where a complete pair has changed."""
        if self._said is None or self._said[0] != ties.complete:
            self._said = ties.complete, free_hand(ties, self.settings)
        return self._said[1]

    def _links(self, hand: Hand | None, turn: Transform | None = None) -> dict[str, Link]:
        links = {"delivered": self._link(self.to_moving)}
        if self.placing is not None:
            placing = self.placing
            links["registration"] = self._link(lambda p: placing.to_reference(self.to_moving(p)))
        if hand is not None:
            shift = np.array([hand.east, hand.north])
            links["pairs"] = self._link(lambda p: moved(self.to_moving(p), turn) + shift)
        return links

    def _link(self, to_reference: Move) -> Link:
        """Lay the picture down by what happens to its middle and to a metre east of that."""
        west, south, east, north = self.moving.grid.bounds
        middle = np.array([(west + east) / 2, (south + north) / 2])
        east_a_metre = np.array([1.0, 0.0])
        first, second = to_reference(np.array([middle, middle + east_a_metre]))
        angle = math.atan2(second[1] - first[1], second[0] - first[0])
        angle = 0.0 if abs(angle) < 1e-9 else angle
        return Link(angle, (float(middle[0]), float(middle[1])), (float(first[0]), float(first[1])))

    def _overlap(self, link: Link) -> Float64:
        if link not in self._overlaps:
            found = overlap_points(self.reference, self.moving, link.to_shown)
            self._overlaps = {link: found}  # the link by pairs moves with every click
        return self._overlaps[link]
