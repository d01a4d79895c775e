import pytest

from stario.sequences import WalkStyle, generate_walk, simulate_imu


@pytest.fixture(scope="module")
def walk():
    level = WalkStyle(mount_rotvec=(0.0, 0.0, 0.0))
    return simulate_imu(generate_walk(4, 30.0, style=level), rate=200.0)
