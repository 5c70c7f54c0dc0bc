"""From a pair of surveys to a registration: the way data flows.

Rasters of both (`levels`), the methods' proposals of Bryson et al. (2013) judged and refined
(`decision`), and the record (`register`); a check on the user's own data (`selftest`).
"""

from meshreg.pipeline.checks import require_different
from meshreg.pipeline.decision import (
    Decision,
    Manual,
    covariance_of,
    decide,
)
from meshreg.pipeline.postures import (
    in_degrees,
    level_axes,
    posture,
)
from meshreg.pipeline.recording import versions
from meshreg.pipeline.register import register_pair
from meshreg.pipeline.selftest import (
    self_test,
)

__all__ = [
    "Decision",
    "Manual",
    "covariance_of",
    "decide",
    "in_degrees",
    "level_axes",
    "posture",
    "register_pair",
    "require_different",
    "self_test",
    "versions",
]
