"""How a device turns in a gap without samples."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import GRAPH, swivelled

from stario.fusion import Navigator
from stario.fusion.imu.gap import INTERPOLATED, gap_rotation, yaw_variance
from stario.fusion.imu.intervals import ImuInterval, Start
from stario.fusion.recording import cut_recording
from stario.sequences.attitude.rotations import yaw_of

RATE, BIAS = np.array([0.3, -0.2, 2.0]), np.array([0.01, 0.02, -0.03])


def ends(seconds: float, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return np.array([[5.0, *before, 0.0, 0.0, 0.0], [5.0 + seconds, *after, 0.0, 0.0, 0.0]])


def test_a_short_gap_is_turned_through_at_the_rates_of_its_ends() -> None:
    table = ends(0.4, RATE + BIAS, RATE + BIAS)
    expected = Rotation.from_rotvec(0.4 * RATE).as_matrix()
    np.testing.assert_allclose(gap_rotation(table, 0.4, BIAS), expected, atol=1e-9)
    about = ends(0.4, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 3.0]))
    turned = Rotation.from_matrix(gap_rotation(about, 0.4, np.zeros(3))).as_rotvec()
    np.testing.assert_allclose(turned, [0.0, 0.0, 0.8], atol=1e-9)


def test_a_long_gap_keeps_the_attitude() -> None:
    length = INTERPOLATED + 0.1
    np.testing.assert_array_equal(gap_rotation(ends(length, RATE, RATE), length, BIAS), np.eye(3))


def gap_of(length: float, turn_rate: float) -> ImuInterval:
    """Return a gap before a second in which the device turns at a rate [rad/s]."""
    after = Start(np.eye(3), False, 9.81, turn_rate, time=length, rate=100.0)
    ends = np.zeros((2, 7))
    ends[1, 0] = length
    return ImuInterval(ends, True, np.eye(3), levelled=after)


@pytest.mark.parametrize("length", [0.3, 0.9, 3.0])
def test_the_yaw_is_ever_less_certain_until_it_is_unknown(length: float) -> None:
    gap = gap_of(length, 0.5)
    sigma = np.sqrt([yaw_variance(s, gap) for s in np.linspace(0.0, length, 20)])
    assert sigma[0] == 0.0
    assert (np.diff(sigma) > 0.0).all()
    assert yaw_variance(length, gap_of(length, 3.0)) > 1.4 * sigma[-1] ** 2
    unknown = yaw_variance(9.0, gap_of(9.0, 0.5))
    assert unknown == yaw_variance(9.0, gap_of(9.0, 3.0)) < np.pi**2


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_the_yaw_is_kept_through_gaps_while_the_device_turns(
    make_walk: Callable[..., Any], make_oracle: Any, without: Any, backend: Any
) -> None:
    """A kept attitude would lose 20 degrees in each of these four gaps, and know as much."""
    walk = swivelled(make_walk(3, 32.0), 1.0)
    gone = (walk.time > 10.0) & (walk.time < 28.0) & (walk.time % 5.0 < 0.35)
    holed = without(walk, gone)
    track = Navigator(make_oracle(holed, walk.truth, GRAPH), GRAPH, backend=backend).run(holed)
    rows = [0, int(np.searchsorted(track.time, 29.5))]
    errors = yaw_of(track.trajectory.attitude_WB[rows])
    errors -= yaw_of(walk.truth.at(track.time[rows]).attitude_WB)
    off = abs(np.angle(np.exp(1j * (errors[1] - errors[0]))))
    sigma = np.sqrt(track.covariance[rows[1], 2, 2])
    assert off < np.radians(20.0)
    assert off < 3.0 * sigma
    assert 0.15 < sigma < 0.35


def test_the_network_sees_the_same_turn(make_walk: Callable[..., Any], without: Any) -> None:
    """The levelled frame, along which a network's displacements are chained, keeps its yaw."""
    walk = swivelled(make_walk(3, 20.0), 1.0)
    holed = without(walk, (walk.time > 10.0) & (walk.time < 10.4))
    intervals, _ = cut_recording(holed, GRAPH)
    (k,) = [k for k, each in enumerate(intervals) if each.gap]
    ends = np.array([intervals[k - 1].stop, intervals[k].stop])
    R_NB = Rotation.from_matrix([intervals[k - 1].R_NB, intervals[k].R_NB])
    turn = np.diff(yaw_of(R_NB)) - np.diff(yaw_of(walk.truth.at(ends).attitude_WB))
    assert np.abs(np.angle(np.exp(1j * turn)))[0] < np.radians(8.0)


def test_gravity_determines_the_tilt_even_if_the_recording_ends_soon_after_a_gap(
    make_walk: Callable[..., Any], make_oracle: Any, without: Any
) -> None:
    walk = make_walk(1, 19.2)
    holed = without(walk, (walk.time > 15.0) & (walk.time < 18.0))
    oracle = make_oracle(holed, walk.truth, GRAPH)
    for backend in ("ekf", "graph"):
        track = Navigator(oracle, GRAPH, backend=backend).run(holed)
        row = int(np.searchsorted(track.time, 18.05))
        true_WB = walk.truth.at(track.time[row : row + 1]).attitude_WB
        off = (track.trajectory.attitude_WB[row] * true_WB.inv()).apply([0.0, 0.0, 1.0])
        sigma = np.sqrt(np.diag(track.covariance[row])[:2])
        assert np.linalg.norm(off[:, :2]) < 3.0 * np.linalg.norm(sigma)
        assert (sigma < 0.06).all()
