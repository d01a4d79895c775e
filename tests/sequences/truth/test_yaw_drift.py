"""The scale and bias applied to the gyroscope are recovered from its yaw drift."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from told import told

from stario.sequences import ImuSequence, inspect_recording
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.truth.fit import fit_truth
from stario.sequences.truth.yaw_drift import yaw_drift


@pytest.fixture(scope="module")
def walk() -> ImuSequence:
    style = WalkStyle(carry="handheld", mount_rotvec=(0.3, -0.5, 0.4))
    return simulate_imu(generate_walk(5, 90.0, style=style), 100.0, PERFECT_IMU, 1)


@pytest.mark.parametrize("scale", [0.0, 0.023, -0.015])
@pytest.mark.parametrize("bias", [0.0, 0.004])
def test_scale_and_bias_are_recovered(walk: ImuSequence, scale: float, bias: float) -> None:
    truth = walk.truth
    up_B = truth.at(walk.time).attitude_WB.apply([0.0, 0.0, 1.0], inverse=True)
    turned = replace(walk, gyro=(1.0 + scale) * walk.gyro + bias * up_B)
    found = yaw_drift(turned, fit_truth(turned))
    assert found.scale == pytest.approx(scale, abs=2e-3)
    assert found.bias == pytest.approx(bias, abs=5e-4)
    assert found.residual_rms < np.radians(1.0)


@pytest.mark.parametrize("carry", ["pocket", "swinging", "rig"])
def test_scale_is_recovered_from_a_device_that_tilts_with_a_bias(carry: str) -> None:
    """Neither its tilting nor a bias about its own axes is taken for a scale error."""
    track = generate_walk(5, 120.0, style=WalkStyle(carry=carry))
    tilting = simulate_imu(track, 100.0, PERFECT_IMU)
    off = replace(tilting, gyro=1.03 * tilting.gyro + [0.03, -0.02, 0.04])
    found = yaw_drift(off, fit_truth(off))
    assert found.scale == pytest.approx(0.03, abs=2e-3)
    assert found.residual_rms < np.radians(0.3)


def test_the_report_states_the_scale_error(walk: ImuSequence) -> None:
    too_high, too_low = (
        "\n".join(inspect_recording(replace(walk, gyro=scale * walk.gyro)).lines())
        for scale in (1.03, 0.97)
    )
    assert re.search(r"the gyroscope reads (2\.9|3\.[01]) % too high", too_high)
    assert re.search(r"the gyroscope reads (2\.9|3\.[01]) % too low", too_low)


def test_without_rotation_no_yaw_drift_is_estimated(walk: ImuSequence) -> None:
    truth = walk.truth
    until = walk.time < walk.time[0] + 12.0
    short = ImuSequence(
        walk.name, walk.time[until], 1e-3 * walk.gyro[until], walk.accel[until], truth
    )
    still = replace(truth, attitude_WB=truth.attitude_WB[np.zeros(len(truth.time), dtype=int)])
    unturned = replace(short, truth=still)
    assert yaw_drift(unturned, fit_truth(unturned)) is None


@pytest.mark.parametrize(
    ("scale", "words"),
    [(1.3, r"(29|30)\.\d % too high"), (1 / 57.3, r"98\.\d % too low"), (1.04, "")],
)
def test_an_implausible_scale_is_a_problem(walk: ImuSequence, scale: float, words: str) -> None:
    reported = "\n".join(told(replace(walk, gyro=scale * walk.gyro)))
    assert ("gyroscope: reads" in reported) is bool(words)
    assert re.search(words, reported)
