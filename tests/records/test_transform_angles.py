"""Yaw and tilt of a transform, against rotations that are made by other means."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from meshreg import Transform

ANGLES = st.floats(-3.1, 3.1)
SMALL = st.floats(1e-9, 1.5)


@given(ANGLES)
def test_yaw_is_the_turn_about_the_vertical(yaw: float) -> None:
    turn = Transform(Rotation.from_euler("z", yaw).as_matrix())
    assert turn.yaw == pytest.approx(yaw, abs=1e-12)
    assert turn.inverse().yaw == pytest.approx(-yaw, abs=1e-12)
    assert turn.tilt == 0.0


@given(SMALL, ANGLES, ANGLES)
def test_tilt_is_the_angle_of_the_vertical_however_small(
    tilt: float, about: float, yaw: float
) -> None:
    axis = np.array([math.cos(about), math.sin(about), 0.0])
    lean = Rotation.from_rotvec(tilt * axis) * Rotation.from_euler("z", yaw)
    both = Transform(lean.as_matrix())
    assert both.tilt == pytest.approx(tilt, rel=1e-6)
    assert both.inverse().tilt == pytest.approx(tilt, rel=1e-6)
