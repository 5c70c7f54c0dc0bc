"""One answer said in another frame: where the methods measured, or as a survey was delivered."""

from __future__ import annotations

from typing import Any

import numpy as np

from meshreg.records import Float64, Registration, Transform

Answer = tuple[tuple[float, float], Float64 | None]


def delivered(points: Any, motion: Transform | None) -> Float64:
    """East and north (N, 2) [m] in the moving survey as delivered, of points in the turned one."""
    places: Float64 = np.asarray(points, float)
    if motion is None:
        return places
    level = np.full((len(places), 1), motion.pivot[2])
    return np.asarray(motion.inverse().apply(np.hstack([places, level]))[:, :2])


def among_methods(registration: Registration) -> Answer | None:
    """Return the result as a method would say it: its offset in the middle of the overlap.

    A method knows no turn, so that it finds the offset of the overlap's middle; the record states
    the result's at the pivot, from which it may differ by the turn times the distance.

    Returns
    -------
    offset : (east, north) [m]
        To add to the moving survey, turned first where the search turned it.
    sigma : (2, 2) float64 or None
        Its covariance [m²], ``J C J'`` with the lever of the turn about the vertical.
    """
    transform = registration.transform
    if transform is None:
        return None
    home = transform.pivot + transform.offset
    error = registration.registration_error
    place = np.asarray(error["at"], float) if error else home
    start = transform.inverse().apply(place)
    motion: Transform | None = registration.evidence.get("motion")
    offset = place - (start if motion is None else motion.apply(start))
    sigma = None
    if registration.covariance is not None:
        east, north = (place - home)[:2]
        carry = np.array([[1.0, 0.0, -north], [0.0, 1.0, east]])
        known = [0, 1, 5]
        sigma = carry @ registration.covariance[np.ix_(known, known)] @ carry.T
    return (float(offset[0]), float(offset[1])), sigma
