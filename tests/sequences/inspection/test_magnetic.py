"""What is told of a magnetometer is what the simulation put there."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from recorded import DATA
from scipy.spatial.transform import Rotation

from stario.sequences import (
    ImuSequence,
    MagneticField,
    Magnetometer,
    inspect_recording,
    read_recording,
    simulate_imu,
)
from stario.sequences.attitude.levelling import levelled_attitudes
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.inspection.magnetic import assess_magnetometer
from stario.sequences.simulation.imu import PERFECT_IMU
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.windows import clean_samples

IRON = (15.0, -6.0, 9.0)


def walk(magnetic_field: MagneticField) -> ImuSequence:
    style = WalkStyle(carry="handheld", mount_rotvec=(0.3, -0.5, 0.4))
    track = generate_walk(3, 60.0, style=style)
    return simulate_imu(track, 100.0, PERFECT_IMU, 1, magnetic_field=magnetic_field)


def test_size_dip_lag_iron_and_drift_come_back() -> None:
    sequence = walk(MagneticField(hard_iron=IRON, lag=0.04))
    drift = np.radians(0.5)
    truth = sequence.truth
    assert truth is not None
    up_B = truth.attitude_WB.apply([0.0, 0.0, 1.0], inverse=True)
    found = assess_magnetometer(replace(sequence, gyro=sequence.gyro + drift * up_B))
    assert found is not None
    assert found.verdict == "good"
    assert found.correlation is not None
    assert found.correlation > 0.89  # the sensor's own noise and its lag leave 0.90
    assert found.lag_s == pytest.approx(0.04, abs=0.01)
    np.testing.assert_allclose(found.hard_iron_uT, IRON, atol=3.0)
    assert found.dip_rad == pytest.approx(math.radians(63.0), abs=0.1)
    assert found.drift_rad_s == pytest.approx(drift, rel=0.15)
    assert "hard iron" in found.problems[0]


@pytest.mark.parametrize("lag", [-0.08, 0.2])
def test_a_lag_beyond_what_is_looked_for_is_not_told_as_measured(lag: float) -> None:
    inspected = inspect_recording(walk(MagneticField(hard_iron=IRON, lag=lag)))
    found = inspected.magnetic
    assert found is not None
    assert found.lag_s is None
    assert found.hard_iron_uT is None
    told = "\n".join(inspected.lines())
    assert "lag outside -50 to +150 ms" in told
    assert "constant field" not in told
    assert found.correlation is not None


def test_a_magnet_a_wrong_axis_and_apples_sign_are_found() -> None:
    good = walk(MagneticField())
    assert good.magnetometer is not None
    magnets = tuple((t, t + 4.0, 150.0) for t in np.arange(2.0, 56.0, 8.0).tolist())
    disturbed = assess_magnetometer(walk(MagneticField(magnets=magnets)))
    assert disturbed is not None
    assert disturbed.verdict == "not usable"
    turned = Magnetometer(good.magnetometer.time, good.magnetometer.field[:, [1, 2, 0]])
    wrong = assess_magnetometer(replace(good, magnetometer=turned))
    assert wrong is not None
    assert wrong.verdict == "not usable"
    assert "does not follow the gyroscope" in " ".join(wrong.problems)
    lines = inspect_recording(replace(good, truth=None, accel=-good.accel)).lines()
    assert any("points up by" in line and "--accel-sign apple" in line for line in lines)
    unit = Magnetometer(good.magnetometer.time, 1e3 * good.magnetometer.field)
    assert "another unit" in " ".join(inspect_recording(replace(good, magnetometer=unit)).problems)


def test_a_field_that_the_device_carries_on_itself_is_told_by_its_size() -> None:
    measured = walk(MagneticField())
    assert measured.magnetometer is not None
    time, field = measured.magnetometer.time, measured.magnetometer.field
    size = np.linalg.norm(field, axis=1, keepdims=True)
    carried = replace(measured, magnetometer=Magnetometer(time, 44.0 * field / size))
    told = [" ".join(inspect_recording(one).lines()) for one in (measured, carried)]
    assert "extrapolated by the device's own gyroscope" not in told[0]
    assert "extrapolated by the device's own gyroscope 100%" in told[1]


def test_a_sensor_that_gives_zeros_at_first_is_looked_over_all_the_same() -> None:
    late = walk(MagneticField())
    assert late.magnetometer is not None
    field = late.magnetometer.field.copy()
    field[:100] = 0.0
    with np.errstate(all="raise"):
        found = assess_magnetometer(
            replace(late, magnetometer=Magnetometer(late.magnetometer.time, field))
        )
    assert found is not None
    assert found.held < 0.5


def test_inspection_tells_of_a_good_magnetometer_and_of_none() -> None:
    good = inspect_recording(walk(MagneticField()))
    assert not good.problems
    assert any(line.startswith("magnetometer: ") and "dip 63 deg" in line for line in good.lines())
    told = good.as_dict()["magnetometer"]
    assert isinstance(told, dict)
    assert told["verdict"] == "good"
    bare = inspect_recording(replace(walk(MagneticField()), magnetometer=None))
    assert bare.as_dict()["magnetometer"] is None


@pytest.mark.skipif(not DATA.is_dir(), reason="the development recordings are not here")
@pytest.mark.parametrize(
    ("name", "verdict", "sure"),
    [
        ("imu3", "good", 0.06),
        # The bearing is unsteady by 18 deg: its slope over a minute is known to no better.
        ("imu2", "coarse", 0.15),
    ],
)
def test_recorded_magnetometers_know_the_gyroscopes_drift(
    name: str, verdict: str, sure: float
) -> None:
    """With its sign, against how the yaw by the gyroscope leaves the true one [deg/s]."""
    recording = read_recording(DATA / f"oxiod/handheld/data1/syn/{name}.csv")
    time, gyro, accel = clean_samples(recording)
    levelled = Rotation.from_matrix(levelled_attitudes(time, gyro, accel))
    known = recording.truth.covers(time)
    off = np.unwrap(yaw_of(levelled * recording.truth.at(time).attitude_WB.inv())[known])
    drift = np.polyfit(time[known], off, 1)[0]
    found = assess_magnetometer(recording)
    assert found is not None
    assert found.verdict == verdict
    assert math.degrees(found.drift_rad_s) == pytest.approx(math.degrees(drift), abs=sure)


@pytest.mark.skipif(not DATA.is_dir(), reason="the development recordings are not here")
def test_magnets_beside_a_phone_are_not_trusted() -> None:
    name = "archives/tyrex.h5:Thibaud_Nexus5_Dist_Texting"
    magnets = assess_magnetometer(read_recording(DATA / name))
    assert magnets is not None
    assert magnets.verdict == "not usable"
