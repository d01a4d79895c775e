import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from recorded import DATA
from scipy.spatial.transform import Rotation
from told import told

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
from stario.sequences.clean_samples import clean_samples
from stario.sequences.inspection.magnetic import assess_magnetometer
from stario.sequences.simulation.imu import PERFECT_IMU
from stario.sequences.simulation.walks import WalkStyle, generate_walk

IRON = (15.0, -6.0, 9.0)


@cache
def walk(magnetic_field: MagneticField, carry: str = "handheld") -> ImuSequence:
    style = WalkStyle(carry=carry, mount_rotvec=(0.3, -0.5, 0.4))
    track = generate_walk(9, 60.0, style=style)
    return simulate_imu(track, 100.0, PERFECT_IMU, 1, magnetic_field=magnetic_field)


def test_correlation_lag_hard_iron_dip_and_drift_are_recovered():
    sequence = walk(MagneticField(hard_iron=IRON, lag=0.04))
    drift = np.radians(0.5)
    truth = sequence.truth
    up_B = truth.attitude_WB.apply([0.0, 0.0, 1.0], inverse=True)
    found = assess_magnetometer(replace(sequence, gyro=sequence.gyro + drift * up_B))
    assert found.figures["verdict"] == "good"
    assert found.figures["correlation_with_gyroscope"] > 0.87  # its own noise and lag leave that
    assert found.figures["lag_s"] == pytest.approx(0.04, abs=0.01)
    np.testing.assert_allclose(found.figures["hard_iron_uT"], IRON, atol=3.0)
    assert found.figures["dip_rad"] == pytest.approx(math.radians(63.0), abs=0.1)
    assert found.figures["gyroscope_drift_rad_s"] == pytest.approx(drift, rel=0.15)
    assert "hard iron" in str(found.findings[0])


@pytest.mark.parametrize("iron", [IRON, (197.0, 165.0, -591.0)], ids=["small", "of ADVIO's phone"])
@pytest.mark.parametrize("per_uT", [1.0, 10.0], ids=["uT", "mg"])
def test_hard_iron_is_not_taken_for_another_unit(iron, per_uT):
    sequence = walk(MagneticField(hard_iron=iron))
    field = sequence.magnetometer
    found = assess_magnetometer(
        replace(sequence, magnetometer=Magnetometer(field.time, per_uT * field.field))
    ).findings
    wrong_unit = [str(one) for one in found if one.code == "field_size"]
    assert len(wrong_unit) == (per_uT != 1.0)
    assert all("if in mg, give 0.1 * field" in text for text in wrong_unit)
    assert any(one.code == "hard_iron" for one in found)


def test_a_short_recording_gives_no_verdict_and_its_span_is_named():
    whole = walk(MagneticField())
    for end, verdict, words in (
        (30.0, "too short to tell", "over 30 s: steady to"),
        (45.0, "good", "over 45 s: steady to"),
    ):
        found = assess_magnetometer(whole.slice(0.0, end))
        assert found.figures["assessed_s"] == pytest.approx(end, abs=0.5)
        assert found.figures["verdict"] == verdict
        (line,) = (line for line in found.lines if words in line)
        assert "within a minute" not in line


def test_a_field_that_ends_halfway_is_said_to():
    sequence = walk(MagneticField())
    field = sequence.magnetometer
    half = field.time < sequence.time[0] + 30.0
    part = replace(sequence, magnetometer=Magnetometer(field.time[half], field.field[half]))
    assert any("in 30 of 60 s" in line for line in assess_magnetometer(part).lines)
    assert not any("of 60 s" in line for line in assess_magnetometer(sequence).lines)


@pytest.mark.parametrize("lag", [-0.08, 0.2])
def test_a_lag_outside_the_search_range_is_not_reported_as_measured(lag):
    inspected = inspect_recording(walk(MagneticField(hard_iron=IRON, lag=lag)))
    found = inspected.figures["magnetometer"]
    assert found["lag_s"] is None
    assert found["hard_iron_uT"] is None
    report = "\n".join(inspected.lines())
    assert "lag outside -50 to +150 ms" in report
    assert "constant field" not in report
    assert found["correlation_with_gyroscope"] is not None


def test_magnets_wrong_axes_apples_sign_and_wrong_units_are_detected():
    good = walk(MagneticField(), "in-front")
    time, field = good.magnetometer.time, good.magnetometer.field
    near = field + np.outer((time % 8.0 < 4.0) * np.sign(np.sin(time)), [150.0, 0.0, 0.0])
    disturbed = assess_magnetometer(replace(good, magnetometer=Magnetometer(time, near)))
    assert disturbed.figures["verdict"] == "not usable"
    turned = Magnetometer(good.magnetometer.time, good.magnetometer.field[:, [1, 2, 0]])
    wrong = assess_magnetometer(replace(good, magnetometer=turned))
    assert wrong.figures["verdict"] == "not usable"
    assert "does not follow the gyroscope" in " ".join(map(str, wrong.findings))
    lines = told(replace(good, truth=None, accel=-good.accel))
    assert any("points up by" in line and "--accel-sign apple" in line for line in lines)
    unit = Magnetometer(good.magnetometer.time, 1e3 * good.magnetometer.field)
    assert "if in nT, give 0.001" in " ".join(told(replace(good, magnetometer=unit)))


def test_a_field_extrapolated_by_the_device_is_detected_and_zeros_at_the_start_are_not():
    measured = walk(MagneticField())
    time, field = measured.magnetometer.time, measured.magnetometer.field
    size = np.linalg.norm(field, axis=1, keepdims=True)
    extrapolated = replace(measured, magnetometer=Magnetometer(time, 44.0 * field / size))
    report = [" ".join(inspect_recording(one).lines()) for one in (measured, extrapolated)]
    assert "extrapolated by the device's own gyroscope" not in report[0]
    assert "extrapolated by the device's own gyroscope 100%" in report[1]
    late = walk(MagneticField())
    field = late.magnetometer.field.copy()
    field[:100] = 0.0
    with np.errstate(all="raise"):
        found = assess_magnetometer(
            replace(late, magnetometer=Magnetometer(late.magnetometer.time, field))
        )
    assert found.figures["held_share"] < 0.5


def test_inspection_reports_a_good_magnetometer_and_a_missing_one():
    good = inspect_recording(walk(MagneticField()))
    assert not good.findings
    assert any(line.startswith("magnetometer: ") and "dip 63 deg" in line for line in good.lines())
    report = good.as_dict()["magnetometer"]
    assert report["verdict"] == "good"
    bare = inspect_recording(replace(walk(MagneticField()), magnetometer=None))
    assert bare.as_dict()["magnetometer"] is None


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="the development recordings are not here")
@pytest.mark.parametrize(
    ("name", "verdict", "tolerance"),
    [
        ("imu3", "good", 0.06),
        # The bearing scatters by 18 deg, which limits the accuracy of its slope over a minute.
        ("imu2", "coarse", 0.15),
    ],
)
def test_recorded_magnetometers_measure_the_gyroscopes_drift(name, verdict, tolerance):
    """With its sign, against the drift of the gyroscope's yaw from the true yaw [deg/s]."""
    recording = read_recording(DATA / f"oxiod/handheld/data1/syn/{name}.csv")
    time, gyro, accel = clean_samples(recording)
    levelled = Rotation.from_matrix(levelled_attitudes(time, gyro, accel))
    known = recording.truth.covers(time)
    yaw_error = np.unwrap(yaw_of(levelled * recording.truth.at(time).attitude_WB.inv())[known])
    drift = np.polyfit(time[known], yaw_error, 1)[0]
    found = assess_magnetometer(recording)
    assert found.figures["verdict"] == verdict
    measured = math.degrees(found.figures["gyroscope_drift_rad_s"])
    assert measured == pytest.approx(math.degrees(drift), abs=tolerance)


@pytest.mark.skipif(not DATA.is_dir(), reason="the development recordings are not here")
def test_a_magnetometer_next_to_magnets_is_not_usable():
    name = "archives/tyrex.h5:Thibaud_Nexus5_Dist_Texting"
    magnets = assess_magnetometer(read_recording(DATA / name))
    assert magnets.figures["verdict"] == "not usable"
