from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stario.network.training.made import moment_streams
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.walks import generate_walk

WALK = simulate_imu(generate_walk(5, 50.0), 100.0, PHONE_IMU, 5, name="walk")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "walk.csv"
    path.write_text("read by the test")
    return path


def test_a_moment_turns_the_device_and_moves_it_by_no_more_than_a_hand_reaches(recording, tmp_path):
    found = moment_streams([recording] * 8, lambda path: WALK, {}, 3, tmp_path / "cache")
    assert found
    rates = [np.linalg.norm(stream.imu_W[:, :3], axis=1).max() for stream in found]
    assert max(rates) > 12.0 > np.linalg.norm(WALK.gyro, axis=1).max()
    for stream in found:
        middle = len(stream) // 2
        inside = stream.position_W[middle - 400 : middle + 400]
        assert np.ptp(inside[:, :2], axis=0).max() < 1.0
        force = np.linalg.norm(stream.imu_W[:, 3:], axis=1)
        assert force.mean() == pytest.approx(STANDARD_GRAVITY, rel=0.2)


def test_the_last_fifth_of_a_recording_is_left_to_judge(recording, tmp_path):
    def only_the_end_is_known(path: Path):
        start = WALK.time[0] + 0.8 * (WALK.time[-1] - WALK.time[0])
        return replace(WALK, truth=WALK.truth.select(WALK.truth.time > start))

    assert not moment_streams([recording], only_the_end_is_known, {}, 3, tmp_path / "cache")


def test_a_recording_without_poses_has_no_moments(recording, tmp_path):
    read = replace(WALK, truth=None)
    assert not moment_streams([recording], lambda path: read, {}, 3, tmp_path / "cache")
