import pytest
from walked import walked

from stario.sequences import PERFECT_IMU


@pytest.fixture(scope="session")
def walk():
    return walked(
        4, 15.0, PERFECT_IMU, carry="handheld", preferred_speed=1.0, mount_rotvec=(0.3, -0.5, 0.4)
    )
