"""Pedestrian dead reckoning: number, length and direction of known steps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import DATA

from stario.fusion.evaluation.pedestrian import (
    WEINBERG_CONSTANT,
    pedestrian_path,
    pedestrian_track,
    steps_of,
)
from stario.sequences.accuracy.metrics import evaluate_track
from stario.sequences.attitude.rotations import about_z, yaw_of
from stario.sequences.levelled_stream import TICK_SAMPLES, LevelledStream
from stario.sequences.readers import read_recording
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence
from stario.sequences.windows import WINDOW_RATE

RIDI = DATA / "archives/ridi.h5"
RATE, SIZE = 1.8, 2.0


def walking_stream(course: np.ndarray, mount: float = 0.0) -> LevelledStream:
    """Return a stream at 200 Hz of steps at 1.8 Hz, 4 m/s^2 from crest to trough.

    The acceleration along the course lags by a quarter of a step, as in real walking.

    Args:
        course: (N,) direction of walking [rad].
        mount: yaw of the device relative to the course [rad].
    """
    time = np.arange(len(course)) / WINDOW_RATE
    phase = 2.0 * np.pi * RATE * time
    imu = np.zeros((len(course), 6), np.float32)
    imu[:, 3] = -np.sin(phase) * np.cos(course)
    imu[:, 4] = -np.sin(phase) * np.sin(course)
    imu[:, 5] = STANDARD_GRAVITY + SIZE * np.cos(phase)
    heading = course + mount
    facing = np.stack([np.cos(heading), np.sin(heading)], axis=1).astype(np.float32)
    return LevelledStream(0.0, imu, facing, about_z(heading[::TICK_SAMPLES]).as_matrix())


@pytest.mark.parametrize("course", [0.0, 2.0, -2.5])
@pytest.mark.parametrize("mount", [0.0, 1.3, 3.0])
def test_straight_steps_add_up_to_a_straight_path(course: float, mount: float) -> None:
    stream = walking_stream(np.full(6000, course), mount)
    _, ends, displacements = steps_of(stream)
    lengths = np.abs(displacements)
    assert len(ends) == pytest.approx(30.0 * RATE, abs=2)
    np.testing.assert_allclose(lengths[3:-3], WEINBERG_CONSTANT * (2.0 * SIZE) ** 0.25, rtol=0.02)
    end = pedestrian_path(stream)[-1]
    assert np.angle(end * np.exp(-1j * course)) == pytest.approx(0.0, abs=0.03)
    assert abs(end) == pytest.approx(lengths.sum(), rel=0.01)


def test_a_turn_is_followed_by_the_heading_of_the_device() -> None:
    course = np.where(np.arange(8000) < 4000, 0.0, np.pi / 2.0)
    path = pedestrian_path(walking_stream(course, mount=-0.7))
    for part, direction in ((path[:3800], 1.0), (path[4200:], 1j)):
        moved = (part[-1] - part[0]) / direction
        assert np.angle(moved) == pytest.approx(0.0, abs=0.1)
        assert moved.real > 15.0


def test_a_standing_pedestrian_does_not_move() -> None:
    stream = walking_stream(np.zeros(4000))
    rng = np.random.default_rng(0)
    still = 0.05 * rng.standard_normal(stream.imu_N.shape).astype(np.float32)
    still[:, 5] += STANDARD_GRAVITY
    assert np.abs(pedestrian_path(replace(stream, imu_N=still))).max() == 0.0


@pytest.mark.skipif(not RIDI.exists(), reason=f"no recordings at {RIDI}")
def test_a_real_walk_is_reproduced_within_4_percent_of_its_length() -> None:
    sequence = read_recording(Path(f"{RIDI}:hang_body_normal1"))
    assert sequence.truth is not None
    found = evaluate_track(pedestrian_track(sequence).trajectory, sequence.truth, alignment="yaw")
    assert found.ate_m < 0.04 * found.path_m


def test_position_and_heading_are_kept_across_a_gap() -> None:
    """A straight, a quarter turn and another straight; the gap lies in the second straight."""
    time = np.arange(0.0, 40.0, 0.01)
    rate = np.where((time > 10.0) & (time < 12.0), 0.25 * np.pi, 0.0)
    phase = 2.0 * np.pi * RATE * time
    accel = np.stack([-np.sin(phase), 0.0 * phase, STANDARD_GRAVITY + SIZE * np.cos(phase)], axis=1)
    gyro = np.stack([0.0 * rate, 0.0 * rate, rate], axis=1)
    kept = (time < 19.0) | (time > 23.0)
    track = pedestrian_track(ImuSequence("g", time[kept], gyro[kept], accel[kept])).trajectory
    for start, stop in ((14.0, 18.0), (25.0, 39.0)):
        inside = (track.time > start) & (track.time < stop)
        moved = np.ptp(track.position_W[inside], axis=0)
        assert moved[1] > 0.7 * (stop - start)
        assert moved[0] < 0.2 * moved[1]
        np.testing.assert_allclose(yaw_of(track.attitude_WB[inside]), 0.5 * np.pi, atol=0.05)
    before, after = track.position_W[track.time < 19.0][-1], track.position_W[track.time > 23.0][0]
    assert np.linalg.norm(after - before) < 1.0
