"""Robust statistics: scale, covariance, fits that predict what they have not seen, kriging."""

from meshreg.statistics.covariance import (
    lever,
    registration_error,
    registration_sigma,
)
from meshreg.statistics.held_out import (
    RAYLEIGH,
    groups_of,
    least_trimmed_squares,
    robust,
)
from meshreg.statistics.kriging import (
    Ground,
    best_motion,
    design,
    overlap_ground,
)
from meshreg.statistics.sandwich import (
    block_sandwich,
)
from meshreg.statistics.scale import (
    MAD_TO_SIGMA,
    densest,
    half_scale,
    nmad,
)
from meshreg.statistics.weights import biweight

__all__ = [
    "MAD_TO_SIGMA",
    "RAYLEIGH",
    "Ground",
    "best_motion",
    "biweight",
    "block_sandwich",
    "densest",
    "design",
    "groups_of",
    "half_scale",
    "least_trimmed_squares",
    "lever",
    "nmad",
    "overlap_ground",
    "registration_error",
    "registration_sigma",
    "robust",
]
