from dataclasses import replace

import numpy as np
import pytest

from stario.sequences import ImuSequence, LegStream, WalkStyle, generate_walk, leg_streams
from stario.sequences.sequence import FloatArray, PositionTrack
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu

TIME = np.arange(1.0, 38.0)


@pytest.fixture(scope="module")
def recording():
    walk = generate_walk(3, 40.0, style=WalkStyle(preferred_speed=1.3))
    return simulate_imu(walk, 100.0, PERFECT_IMU, 0, name="walk")


def legs_of(
    recording: ImuSequence, time: FloatArray, kind: str, sigma: object, valid: object = ()
) -> LegStream:
    position = recording.truth.at(time).position_W
    known = PositionTrack(time, position, kind, valid, sigma)
    [legs] = leg_streams(replace(recording, truth=None, positions=known))
    return legs


def test_the_ends_of_a_leg_are_as_certain_as_their_positions_on_another_device(recording):
    """Those of satellites share most of their error, which a displacement does not contain."""
    known = TIME > 4.0
    stated = np.where(known, 3.0 + 0.1 * TIME, 99.0)
    track = PositionTrack(TIME, np.zeros((len(TIME), 2)), "positions", known, stated)
    assert track.typical_sigma == pytest.approx(np.median(stated[known]))
    legs = legs_of(recording, TIME, "positions", stated, known)
    ends = np.stack([legs.start, legs.stop], axis=1)
    relative = legs.sigma / np.interp(ends, TIME, stated)
    np.testing.assert_allclose(relative, relative[0, 0])
    assert 0.1 < relative[0, 0] < 0.4
    precise = legs_of(recording, TIME, "positions", np.full(len(TIME), 0.01))
    unstated = legs_of(recording, TIME, "positions", None)
    np.testing.assert_allclose(precise.sigma, unstated.sigma)


def test_the_time_of_a_tap_is_uncertain_wherever_the_waypoint_is(recording):
    time = TIME[::6]
    surveyed = legs_of(recording, time, "waypoints", np.full(len(time), 0.01))
    by_eye = legs_of(recording, time, "waypoints", None)
    speed = np.linalg.norm(surveyed.displacement, axis=1) / (surveyed.stop - surveyed.start)
    assert speed.max() > 1.0
    np.testing.assert_allclose(surveyed.sigma, np.hypot(0.01, 0.3 * speed[:, None]) * [[1.0, 1.0]])
    assert (by_eye.sigma > surveyed.sigma).all()


@pytest.mark.parametrize(("time", "kind"), [(TIME[::4], "positions"), ([5.0, 15.0], "waypoints")])
def test_positions_seconds_apart_and_a_single_leg_are_not_used(recording, time, kind):
    """Between positions a pedestrian may have turned, and one leg is no more than its length."""
    position = recording.truth.at(np.array(time)).position_W
    known = PositionTrack(np.array(time), position, kind)
    assert leg_streams(replace(recording, truth=None, positions=known)) == []


def test_a_part_has_the_legs_that_lie_within_it(recording):
    legs = legs_of(recording, TIME, "positions", None)
    part = legs.part(1000, 3000)
    inside = (legs.start >= 5.0) & (legs.stop <= 15.0)
    assert 2 < inside.sum() < len(legs.start) - 2
    np.testing.assert_allclose(part.start, legs.start[inside] - 5.0)
    np.testing.assert_allclose(part.stop, legs.stop[inside] - 5.0)
    np.testing.assert_allclose(part.displacement, legs.displacement[inside], atol=1e-5)
    np.testing.assert_allclose(part.imu_N, legs.imu_N[1000:3000], atol=1e-5)
    assert len(legs.part(3000, 1000)) == 0
