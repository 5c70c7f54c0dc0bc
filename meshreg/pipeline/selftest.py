"""What a plot can resolve: known shifts put into the user's own data and recovered blind.

The moving survey itself (its points, triangles or cells) is moved, rasterized and registered anew,
as if nothing were known; only the reference is rasterized once. The truth of each trial is exact,
whatever the two surveys' own offset is. Interpolation, cells, noise and peak finding are tested;
what change on the ground does to all trials alike is not: that is in the registration's error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshreg.errors import UsageError
from meshreg.heading import Pairs, Turn, turning
from meshreg.pipeline.checks import prepared, require_different, surveys_apart
from meshreg.pipeline.decision import Decision, completed, decide
from meshreg.pipeline.levels import rasterize_pair
from meshreg.pipeline.postures import in_degrees
from meshreg.records import Float64, Survey, Transform, Verdict
from meshreg.settings import Settings

Progress = Callable[[str, float], None]
SCHEMA = "meshreg.selftest/1"
SHORTEST, LONGEST = 0.1, 5.0  # of the injected shifts, in DEM cells
UP = 5.0  # DEM cells
YAW = math.radians(0.3)
BOUND = 0.95


@dataclass(frozen=True, eq=False)
class Trial:
    """One known motion, and what was found of it.

    Attributes
    ----------
    shift : (3,) float64
        East, north, up [m] put into the moving survey.
    yaw : float
        Anticlockwise turn about the survey's centre put into it [rad].
    verdict : str
    reason : str
    error : (3,) float64
        Motion recovered less motion put in, at the overlap's centroid [m]; NaN where rejected.
    yaw_error : float
        [rad]
    """

    shift: Float64
    yaw: float
    verdict: Verdict
    reason: str
    error: Float64
    yaw_error: float


@dataclass(frozen=True, eq=False)
class SelfTest:
    """What was put in, what was found, and what that means for this plot.

    Attributes
    ----------
    verdict, reason : str
        Of the pair as it is.
    cell : float
        Of the DEM [m].
    trials : tuple of Trial
        None where the pair as it is was rejected: nothing could be compared.
    registration_error : mapping or None
        x, y, z sigma [m] of the pair as it is, change included.
    """

    verdict: Verdict
    reason: str
    cell: float
    trials: tuple[Trial, ...] = ()
    registration_error: Mapping[str, Any] | None = None

    @property
    def lost(self) -> int:
        """Trials that were rejected."""
        return sum(trial.verdict == "rejected" for trial in self.trials)

    @property
    def rms(self) -> dict[str, float]:
        """Root mean square error: horizontal, up [m], yaw [rad]; NaN without trials."""
        errors = self._errors()
        if not len(errors):
            return dict.fromkeys(("horizontal", "up", "yaw"), float("nan"))
        turns = np.array([t.yaw_error for t in self.trials if t.verdict != "rejected"])
        return {
            "horizontal": float(np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean())),
            "up": float(np.sqrt((errors[:, 2] ** 2).mean())),
            "yaw": float(np.sqrt((turns**2).mean())),
        }

    @property
    def resolved(self) -> dict[str, float]:
        """Smallest shift that this plot can resolve: horizontal and up [m].

        Every two answers, that for the data as they are among them, differ by the motion put in
        between them and an error. The length of that error stays under this bound for 95 % of the
        pairs of answers, so a smaller shift cannot be told from none. NaN where a trial was lost.
        """
        errors = self._errors()
        if not len(errors) or self.lost:
            return {"horizontal": float("nan"), "up": float("nan")}
        errors = np.concatenate([np.zeros((1, 3)), errors])
        first, second = np.triu_indices(len(errors), 1)
        between = errors[first] - errors[second]
        return {
            "horizontal": _bound(np.hypot(between[:, 0], between[:, 1])),
            "up": _bound(np.abs(between[:, 2])),
        }

    def _errors(self) -> Float64:
        found = [trial.error for trial in self.trials if trial.verdict != "rejected"]
        return np.array(found).reshape(-1, 3)

    def document(self) -> dict[str, Any]:
        """Plain values for JSON; what is not a number is None."""
        degrees = math.degrees(1.0)
        rms = self.rms
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "reason": self.reason,
            "cell": self.cell,
            "trials": [
                {
                    "shift": trial.shift.tolist(),
                    "yaw_degrees": trial.yaw * degrees,
                    "verdict": trial.verdict,
                    "reason": trial.reason,
                    "error": [_plain(value) for value in trial.error],
                    "yaw_error_degrees": _plain(trial.yaw_error * degrees),
                }
                for trial in self.trials
            ],
            "lost": self.lost,
            "rms": {
                "horizontal": _plain(rms["horizontal"]),
                "up": _plain(rms["up"]),
                "yaw_degrees": _plain(rms["yaw"] * degrees),
            },
            "resolved": {name: _plain(value) for name, value in self.resolved.items()},
            "registration_error": None
            if self.registration_error is None
            else dict(self.registration_error),
        }


def self_test(
    reference: Survey,
    moving: Survey,
    settings: Settings | None = None,
    *,
    count: int = 8,
    reference_mask: Any = None,
    moving_mask: Any = None,
    progress: Progress | None = None,
    allow_same: bool = False,
) -> SelfTest:
    """Put known shifts and turns into the moving survey and see how well they are recovered.

    Parameters
    ----------
    reference, moving : Survey
        As for `meshreg.register_pair`.
    settings : Settings, optional
        Its `seed` draws the motions: from a tenth of a DEM cell to five, up to five cells up or
        down, and turns within 0.3°.
    count : int
        How many motions.
    reference_mask, moving_mask : callable, optional
    progress : callable, optional
        Called with "rasterize" or "trials" and the fraction done.

    allow_same : bool
        Whether both surveys may come from the very same files.

    Returns
    -------
    SelfTest
        Its `resolved` is the smallest shift that this plot can resolve; there are no trials
        where the pair as it is was rejected.

    Raises
    ------
    UsageError
        As `register_pair`, or if `count` is under 1.
    InputError
        As `register_pair`.
    """
    if count < 1:
        raise UsageError(f"A self-test of {count} shifts tests nothing.", remedy="Use 1 or more.")
    if not allow_same:
        require_different(reference, moving)
    if unread := "; ".join(filter(None, map(in_degrees, (reference, moving)))):
        return SelfTest("rejected", unread, 0.0)
    settings, radius, _ = prepared(reference, moving, settings or Settings())
    tell = progress or (lambda stage, fraction: None)
    masks = {"reference": reference_mask, "moving": moving_mask}
    cell = float(settings.raster.dem_cell or 0.0)
    if apart := surveys_apart(reference, moving, radius):
        return SelfTest("rejected", "; ".join(finding.text for finding in apart), cell)
    tell("rasterize", 0.0)
    pairs = rasterize_pair(reference, moving, settings, masks, tell)

    def registered(motion: Transform) -> Decision:
        """Register the moving survey after `motion`, knowing nothing of it."""

        def made(move: Transform) -> Pairs:
            return rasterize_pair(reference, moving, settings, masks, tell_nothing, move, pairs)

        def turned(turn: Turn) -> tuple[Pairs, Transform]:
            back = turning(turn, motion.apply(moving.centre))
            return made(back @ motion), back

        still = np.array_equal(motion.matrix, np.eye(4))
        now = pairs if still else made(motion)
        return decide(now, settings, radius, turned=turned)

    tell("trials", 0.0)
    base = registered(Transform(pivot=moving.centre))
    judged = base.judgement
    whole, _, error = completed(moving, base)
    if whole is None or base.heights is None:
        return SelfTest(judged.verdict, judged.reason, cell)
    trials = []
    for k, motion in enumerate(motions(moving.centre, whole, cell, radius, count, settings.seed)):
        tell("trials", (k + 1) / (count + 1))
        trials.append(_trial(motion, registered(motion), whole, base.heights.place))
    tell("trials", 1.0)
    return SelfTest(judged.verdict, judged.reason, cell, tuple(trials), error)


def tell_nothing(stage: str, fraction: float) -> None:
    """Report no progress."""
    del stage, fraction


def motions(
    centre: Float64, whole: Transform, cell: float, radius: float, count: int, seed: int
) -> list[Transform]:
    """Draw the motions: lengths in even ratios, headings at random, kept within the search.

    Parameters
    ----------
    centre : (3,) float64
        Of the moving survey, absolute [m]: the turns are about it.
    whole : Transform
        The registration of the data as they are.
    cell, radius : float
        Of the DEM and of the search window [m].
    count, seed : int
    """
    rng = np.random.default_rng(seed)
    lengths = cell * np.geomspace(SHORTEST, LONGEST, count)
    here = whole.apply(centre)[:2] - centre[:2]
    yaw_here = whole.yaw
    drawn = []
    for length in lengths:
        heading, up, turn = rng.uniform((0.0, -UP * cell, -YAW), (2 * math.pi, UP * cell, YAW))
        shift = length * np.array([math.cos(heading), math.sin(heading)])
        # the answer is what the pair itself asks for less what is put in: keep it in the window
        shift = np.where(np.abs(here - shift) > radius, -shift, shift)
        turn = -turn if abs(yaw_here - turn) > max(abs(yaw_here), YAW) else turn
        c, s = math.cos(turn), math.sin(turn)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        drawn.append(Transform(rotation, 1.0, np.append(shift, up), centre))
    return drawn


def _trial(motion: Transform, decision: Decision, whole: Transform, place: Float64) -> Trial:
    found, judged = decision.transform, decision.judgement
    error, yaw_error = np.full(3, np.nan), float("nan")
    if found is not None:
        # the found transform takes the motion back, then does what `whole` does
        error = found.apply(motion.apply(place)) - whole.apply(place)
        yaw_error = (found @ motion).yaw - whole.yaw
        yaw_error = math.remainder(yaw_error, 2 * math.pi)
    return Trial(motion.offset, motion.yaw, judged.verdict, judged.reason, error, yaw_error)


def _bound(lengths: Float64) -> float:
    return float(np.quantile(lengths, BOUND, method="higher"))


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
