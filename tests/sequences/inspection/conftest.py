import pytest
from walked import walked


@pytest.fixture(scope="module")
def walk():
    return walked(4, 30.0, rate=200.0, mount_rotvec=(0.0, 0.0, 0.0))
