"""Intervals as preintegrated segments: motion in a gap is as uncertain as a pedestrian's."""

import numpy as np
import pytest

from stario.fusion.config import NavigatorConfig
from stario.fusion.filter.jacobians import propagated
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.imu.preintegration import segment_of
from stario.sequences.attitude.so3 import exp_so3

CONFIG = NavigatorConfig()


@pytest.mark.parametrize("seconds", [0.3, 2.0])
def test_a_gap_keeps_velocity_and_attitude_with_a_pedestrians_noise(seconds: float) -> None:
    R, zero = exp_so3(np.array([0.4, -0.7, 1.0])), np.zeros(3)
    v, p, b_g = np.array([1.0, -0.5, 0.1]), np.array([3.0, 2.0, 1.0]), np.array([0.01, 0.0, -0.02])
    ends = np.array([5.0, 5.0 + seconds])
    wild = np.full((2, 3), 7.0)  # samples next to a gap do not describe the motion in it
    gap = ImuInterval(ends, wild, wild, True, np.stack([R, R]), R)
    after = propagated(segment_of(gap, R, b_g, zero, CONFIG), R, v, p, b_g, zero)
    np.testing.assert_allclose(after.R_WB, R, atol=1e-9)
    np.testing.assert_allclose(after.v_W, v, atol=1e-9)
    np.testing.assert_allclose(after.p_W, p + seconds * v, atol=1e-9)
    variance, f = np.diag(after.noise[0]), CONFIG.filter
    np.testing.assert_allclose(variance[:3], seconds * f.gap_gyro_noise**2, rtol=0.02)
    # The velocity error of the other axes is mostly gravity turned by the attitude error.
    about_v = variance[5] - (v[0] ** 2 + v[1] ** 2) * seconds * f.gap_gyro_noise**2
    assert about_v == pytest.approx(seconds * f.gap_accel_noise**2, rel=0.15)
