"""An accelerometer logged in other axes than the gyroscope is rotated to the gyroscope's."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences.conventions import axes_matrix
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence, Trajectory
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.truth.accel_axes import accel_axes


@pytest.fixture(scope="module")
def walk() -> ImuSequence:
    style = WalkStyle(mount_rotvec=(0.3, -0.2, 0.9))
    return simulate_imu(generate_walk(2, 20.0, style=style), 100.0, PERFECT_IMU)


@pytest.mark.parametrize("axes", ["z,x,y", "x,-z,y", "-z,-y,-x"])
def test_another_order_of_the_axes_is_undone(
    walk: ImuSequence, axes: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert walk.truth is not None
    logged = replace(walk, accel=walk.accel @ axes_matrix(axes).T)
    np.testing.assert_allclose(accel_axes(logged, walk.truth).accel, walk.accel, atol=1e-9)
    assert "axes are not the gyroscope's" in caplog.text


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["up", "apple"])
def test_the_gyroscopes_own_axes_are_kept_with_either_sign(walk: ImuSequence, sign: float) -> None:
    assert walk.truth is not None
    signed = replace(walk, accel=sign * walk.accel)
    assert accel_axes(signed, walk.truth) is signed


def test_axes_that_a_device_at_rest_cannot_tell_apart_are_kept() -> None:
    time = np.arange(500) / 100.0
    truth = Trajectory(time, np.zeros((500, 3)), Rotation.identity(500))
    sideways = np.tile([STANDARD_GRAVITY, 0.0, 0.0], (500, 1))
    still = ImuSequence("still", time, np.zeros((500, 3)), sideways)
    assert accel_axes(still, truth) is still
