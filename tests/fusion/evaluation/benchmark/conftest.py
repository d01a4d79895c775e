"""A walk with exact sensors, for judging."""

import pytest

from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk

STYLE = WalkStyle(carry="trolley")  # without sway, which windows that overlap smooth


@pytest.fixture(scope="session")
def walk():
    return simulate_imu(generate_walk(9, 75.0, style=STYLE), 100.0, PERFECT_IMU, 3, name="walk")


@pytest.fixture(scope="session")
def stepping():
    """A person's walk, whose steps can be seen."""
    return simulate_imu(generate_walk(9, 75.0), 100.0, PERFECT_IMU, 3, name="steps")
