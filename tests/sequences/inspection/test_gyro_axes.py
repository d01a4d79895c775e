from dataclasses import replace

import numpy as np
import pytest

from stario.sequences import ImuSequence, InputError, check_units, inspect_recording
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk

RAW = np.array([0.09, -0.02, 0.01])
"""Bias of an iPhone 5 [rad/s]."""


def walk(carry: str) -> ImuSequence:
    style = WalkStyle(carry=carry, mount_rotvec=(0.4, -0.7, 1.1))
    return simulate_imu(generate_walk(3, 30.0, style=style), 100.0, PHONE_IMU, 3).without_truth()


@pytest.mark.parametrize("carry", ["handheld", "pocket"])
@pytest.mark.parametrize(
    ("axes", "named"), [("yzx", "z, x, y"), ("xyZ", "x, y, -z"), ("Xyz", "-x, y, z")]
)
def test_other_axes_and_signs_are_refused_and_the_right_ones_named(carry, axes, named):
    carried = walk(carry)
    columns = ["xyz".index(name.lower()) for name in axes]
    signs = [-1.0 if name.isupper() else 1.0 for name in axes]
    turned = replace(carried, gyro=carried.gyro[:, columns] * signs)
    with pytest.raises(InputError, match=f"gyroscope: .* its {named}$"):
        check_units(turned)
    check_units(turned.slice(0.0, 5.0))  # so little of a good walk may seem to be wrong as well
    (told,) = [found for found in inspect_recording(turned).findings if found.code == "refused"]
    assert f"its {named}" in told.advice


@pytest.mark.parametrize("carry", ["handheld", "pocket", "swinging", "trolley"])
def test_a_raw_bias_is_no_wrong_axis(carry):
    carried = walk(carry)
    check_units(carried)
    check_units(replace(carried, gyro=carried.gyro + RAW))


def test_a_raw_bias_on_a_table_and_a_ride_are_no_wrong_axis():
    """About the vertical it would turn gravity least."""
    rng, time = np.random.default_rng(0), 0.01 * np.arange(2000)
    noise = 2e-3 * rng.standard_normal((2, 2000, 3))
    check_units(ImuSequence("table", time, RAW + noise[0], np.array([0.0, 0.0, 9.81]) + noise[1]))
    # The car accelerates and brakes and turns: no axes of the gyroscope explain the force.
    time = 0.01 * np.arange(6000)
    noise = 0.01 * np.random.default_rng(0).standard_normal((2, 6000, 3))
    along, turn = 1.5 * np.sin(0.9 * time), 0.3 * np.sin(0.5 * time + 1.0)
    accel = np.column_stack([along, 8.0 * turn, np.full(6000, 9.81)])
    gyro = np.outer(turn, [0.0, 0.0, 1.0])
    check_units(ImuSequence("ride", time, gyro + noise[0], accel + 5.0 * noise[1]))
