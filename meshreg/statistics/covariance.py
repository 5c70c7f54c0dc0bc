"""The covariance of a transform, carried to any place."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.errors import UsageError
from meshreg.records import Float64, Registration, Transform


def lever(arm: Float64) -> Float64:
    """(..., 7, 7) Jacobian that carries a covariance of a transform over an arm (..., 3) [m].

    For parameters in the order of `Registration.covariance`, a place at `arm` from the pivot (both
    after the move) is displaced by ``t + w × arm + s arm``; angles and scale stay as they are.
    """
    arm = np.asarray(arm, np.float64)
    east, north, up = arm[..., 0], arm[..., 1], arm[..., 2]
    carry = np.zeros((*arm.shape[:-1], 7, 7))
    carry[...] = np.eye(7)
    carry[..., 0, 4], carry[..., 0, 5] = up, -north
    carry[..., 1, 3], carry[..., 1, 5] = -up, east
    carry[..., 2, 3], carry[..., 2, 4] = north, -east
    carry[..., :3, 6] = arm
    return carry


def registration_sigma(
    registration: Registration, east: Any, north: Any, up: Any = None
) -> Float64:
    """Return the registration's standard deviation at any place: it grows with the lever arm.

    Parameters
    ----------
    registration : Registration
        Not rejected.
    east, north : float or arrays of one shape
        Absolute coordinates in the reference [m].
    up : float or array, optional
        Height [m]; it matters only where the tilt is uncertain. Default: the pivot's.

    Returns
    -------
    (..., 3) float64
        Of east, north and up [m], by the first-order law ``J C J'`` (`lever`). The internal
        bending of the models is not in it: that is in the residuals.

    Raises
    ------
    UsageError
        If the registration has no covariance.
    """
    transform, covariance = registration.transform, registration.covariance
    if transform is None or covariance is None:
        raise UsageError(
            f"The registration is {registration.verdict} and states no covariance.",
            remedy="Only a registration that is accepted or in review has one.",
        )
    home = transform.pivot + transform.offset
    place = np.stack(np.broadcast_arrays(east, north, home[2] if up is None else up), axis=-1)
    carry = lever(place.astype(np.float64) - home)
    carried = carry @ covariance @ np.swapaxes(carry, -1, -2)
    return np.sqrt(np.clip(np.diagonal(carried, axis1=-2, axis2=-1)[..., :3], 0.0, None))


def registration_error(
    covariance: Float64, transform: Transform, place: Float64
) -> dict[str, Any] | None:
    """x, y, z and the largest standard deviation [m] at `place`, absolute in the reference.

    `isotropic` is what to give software that takes one number for all directions (the
    `registration_error` of M3C2 in py4dgeo and CloudCompare, Lague et al. 2013, equation 1): the
    square root of the largest eigenvalue, never too small in any direction. None where a part of
    the covariance is not known.
    """
    carry = lever(place - (transform.pivot + transform.offset))
    whole = (carry @ covariance @ carry.T)[:3, :3]
    if not np.isfinite(whole).all():
        return None
    x, y, z = (float(value) for value in np.sqrt(np.clip(np.diag(whole), 0.0, None)))
    largest = float(np.sqrt(max(np.linalg.eigvalsh(whole)[-1], 0.0)))
    return {"x": x, "y": y, "z": z, "isotropic": largest, "at": [float(v) for v in place]}
