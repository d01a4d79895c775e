"""A walk with exact sensors, for judging."""

from __future__ import annotations

import pytest

from stario.sequences.sequence import ImuSequence
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import generate_walk


@pytest.fixture(scope="session")
def walk() -> ImuSequence:
    return simulate_imu(generate_walk(9, 75.0), 100.0, PERFECT_IMU, 3, name="walk")
