import pytest

from stario.sequences import PERFECT_IMU, WalkStyle, generate_walk, simulate_imu


@pytest.fixture(scope="session")
def walk():
    style = WalkStyle(carry="handheld", preferred_speed=1.0, mount_rotvec=(0.3, -0.5, 0.4))
    return simulate_imu(generate_walk(4, 15.0, style=style), 100.0, PERFECT_IMU)
