"""Magnetic bearings in a stream's graph: what they say about yaw and bias, as in the filter."""

from dataclasses import replace

import numpy as np
from initial_ekf import Driven
from support import GRAPH as CONFIG

from stario.fusion import Navigator, NavState
from stario.fusion.filter.gained import gained_information
from stario.fusion.filter.magnetic import with_field
from stario.sequences.attitude.so3 import log_so3
from stario.sequences.sequence import ImuSequence
from stario.sequences.simulation.imu import simulate_imu
from stario.sequences.simulation.magnetometer import MagneticField

Z = [0, 1, 2, 9, 10, 11]
FIELD_B = np.array([15.0, -8.0, -40.0])


def ekf_with_field() -> Driven:
    """A filter with an azimuth, whose yaw and bias are correlated and known to a few degrees."""
    ekf = Driven(slots=0)
    P = 0.01 * np.eye(15)
    P[2, 11] = P[11, 2] = 2e-4
    P[9:12, 9:12] = 1e-5 * np.eye(3)
    zero = np.zeros(3)
    ekf.initialise(NavState(0.0, np.eye(3), zero, zero, zero, zero, P))
    ekf.state = with_field(ekf.state, FIELD_B)
    P = ekf.P.copy()
    P[-5:, -5:] = np.diag([0.04**2, 0.05**2, 1.0, 1.0, 1.0])  # a field known from before
    ekf.P = P
    return ekf


def test_the_information_gained_gives_the_filters_covariance_and_mean():
    ekf = ekf_with_field()
    before = ekf.state
    turned_B = np.array([15.5, -4.0, -40.0])
    assert ekf.update_bearing(turned_B, 0.05**2, gate=1e9).accepted
    after = ekf.state
    gained = gained_information(before, after)
    assert gained is not None
    u, value, variance, *_ = gained
    P = before.P[np.ix_(Z, Z)]
    gain = P @ u / (u @ P @ u + variance)
    np.testing.assert_allclose(P - np.outer(gain, u @ P), after.P[np.ix_(Z, Z)], atol=1e-10)
    # Relative to the estimate after the bearing, the one before it is off by minus the change.
    turned = log_so3(after.R_WB @ before.R_WB.T)
    change = np.concatenate([turned, after.b_g - before.b_g])
    assert abs(turned[2]) > 0.01
    np.testing.assert_allclose(gain * (value + u @ change), change, rtol=0.02, atol=1e-6)


def test_an_update_without_yaw_and_bias_gains_nothing():
    ekf = Driven(slots=0)
    zero = np.zeros(3)
    ekf.initialise(NavState(0.0, np.eye(3), zero, zero, zero, zero, 0.01 * np.eye(15)))
    before = ekf.state
    ekf.update_position_W(np.ones(3), 0.01 * np.eye(3))
    assert gained_information(before, ekf.state) is None


def last_state(navigator: Navigator, walk: ImuSequence) -> NavState:
    field = walk.magnetometer
    state, due = None, 0
    for time, gyro, accel in zip(walk.time, walk.gyro, walk.accel, strict=True):
        while due < len(field.time) and field.time[due] <= time:
            navigator.push_magnetometer(field.time[due], field.field[due])
            due += 1
        state = navigator.push(time, gyro, accel) or state
    assert state is not None
    return state


def test_the_field_bounds_the_yaw_of_a_stream(make_walk, make_oracle):
    """A gyroscope as noisy as this is lost by 0.54 rad after 20 s, but for the magnetic field."""
    truth = make_walk(3, 20.0).truth
    walk = simulate_imu(truth, 50.0, magnetic_field=MagneticField(), seed=3)
    noisy = replace(CONFIG, noise=replace(CONFIG.noise, gyro_noise=0.12))
    oracle = make_oracle(walk, truth, noisy, noise=0.03, sigma=0.03)
    graph, ekf = (
        np.sqrt(last_state(Navigator(oracle, noisy, backend=backend), walk).covariance[2, 2])
        for backend in ("graph", "ekf")
    )
    assert ekf < 0.45
    assert 0.9 * ekf < graph < 1.1 * ekf
