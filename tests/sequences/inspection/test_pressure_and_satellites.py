from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import Georeference, inspect_recording
from stario.sequences.findings import Finding
from stario.sequences.inspection.outside_sensors import assess_barometer, assess_satellites
from stario.sequences.sequence import Barometer, FloatArray, Trajectory
from stario.sequences.simulation.house import simulate_house
from stario.sequences.simulation.outside_sensors import simulate_barometer, simulate_satellites

CALM = {"weather": 0.0, "door": 0.0, "noise": 0.05}


def climbing(height: FloatArray) -> Trajectory:
    """Return a device that is carried about at 1.2 m/s, at these heights each tenth of a second."""
    time = 0.1 * np.arange(len(height))
    angle = 0.05 * time
    place = np.stack([24.0 * np.sin(angle), 24.0 * np.cos(angle), height], axis=1)
    return Trajectory(time, place, Rotation.identity(len(time)))


LEVEL = climbing(np.zeros(600))


def codes(findings: list[Finding]) -> list[str]:
    return [finding.code for finding in findings]


@pytest.fixture(scope="module")
def house():
    return simulate_house(1, 120.0, rate=50.0).sequence


def test_a_house_is_inspected_in_a_line_for_each_sensor(house):
    inspection = inspect_recording(house)
    lines = inspection.lines()
    assert sum(line.startswith("barometer: ") for line in lines) == 1
    assert sum(line.startswith("satellites: ") for line in lines) == 1
    told_as_data = inspection.as_dict()
    assert told_as_data["barometer"]["rate_hz"] == pytest.approx(8.0)
    assert told_as_data["satellites"]["stale"][0]["length_s"] > 40.0


def test_a_barometer_that_never_changes_is_a_warning(house):
    air = house.barometer
    constant = Barometer(air.time, np.full(len(air), 1000.0))
    [finding] = assess_barometer(constant).findings
    assert (finding.code, finding.level) == ("pressure_constant", "warning")


@pytest.mark.parametrize("noise", [0.05, 0.2])
def test_noise_is_measured_on_stairs_as_well(noise):
    stairs = climbing(np.cumsum(np.full(600, 0.035)))
    found = assess_barometer(simulate_barometer(stairs, **CALM | {"noise": noise, "rate": 5.0}))
    assert found.figures["noise_m"] == pytest.approx(noise, rel=0.2)
    assert found.figures["height_range_m"] == pytest.approx(21.0, rel=0.1)


def test_a_door_is_a_step_and_stairs_or_a_lift_are_none():
    doors = np.array([20.0])
    stepped = assess_barometer(simulate_barometer(LEVEL, doors, 1, **CALM | {"door": 0.8}))
    [step] = stepped.figures["steps"]
    assert step["time_s"] == pytest.approx(20.0, abs=1.0)
    assert abs(step["rise_m"]) > 0.35
    speed = np.zeros(600)
    speed[100:240] = 0.35  # stairs
    speed[400:480] = 1.0  # a lift
    lifted = assess_barometer(simulate_barometer(climbing(np.cumsum(0.1 * speed)), **CALM))
    assert lifted.figures["steps"] == []


def test_a_jump_that_is_no_height_is_a_problem_and_repeats_and_wind_are_good_to_know():
    calm = simulate_barometer(LEVEL, **CALM)
    hPa = calm.pressure_hPa - 2.0 * (calm.time > 30.0)
    found = assess_barometer(replace(calm, pressure_hPa=hPa)).findings
    assert codes(found) == ["pressure_jump"]
    assert found[0].values["rise_m"] == pytest.approx(16.9, abs=0.2)
    assert found[0].values["time_s"] == pytest.approx(30.0, abs=1.0)
    calm = simulate_barometer(LEVEL, **CALM)
    held = replace(calm, pressure_hPa=np.repeat(calm.pressure_hPa[::4], 4)[: len(calm)])
    found = assess_barometer(held)
    assert found.figures["repeated_share"] == pytest.approx(0.75, abs=0.02)
    assert [(f.code, f.level) for f in found.findings] == [("pressure_held", "note")]
    windy = assess_barometer(simulate_barometer(LEVEL, **CALM | {"noise": 0.6}))
    assert [(f.code, f.level) for f in windy.findings] == [("pressure_noise", "note")]


@pytest.mark.parametrize(
    ("factor", "offset", "words"),
    [
        (100.0, 0.0, "found 101325, expected 300 to 1100 hPa: it seems to be in Pa"),
        (0.1, 0.0, "found 101.325, expected 300 to 1100 hPa: it seems to be in kPa"),
        (1.0 / 33.8639, 0.0, "it seems to be in inHg"),
        (0.0, 12.0, "found 12, expected 300 to 1100 hPa: is it an altitude?"),
    ],
)
def test_pressure_in_another_unit_is_a_problem(house, factor, offset, words):
    still = Barometer(house.time[::10], np.full(len(house.time[::10]), 1013.25 * factor + offset))
    [finding] = assess_barometer(still).findings
    assert words in str(finding)


def test_exchanged_degrees_and_minutes_for_decimals_contradict_the_speed():
    reported = simulate_satellites(LEVEL, Georeference(48.0, 11.0, 0.6), sigma=1.0)
    right = assess_satellites(reported)
    assert right.findings == []
    assert right.figures["doppler"]["correlation"] > 0.9
    assert right.figures["doppler"]["scale"] == pytest.approx(1.0, abs=0.1)
    wrong = assess_satellites(replace(reported, latlon_deg=reported.latlon_deg[:, ::-1]))
    assert codes(wrong.findings) == ["satellites_exchanged"]
    east = simulate_satellites(LEVEL, Georeference(48.0, 118.9), sigma=1.0)
    assert assess_satellites(east).findings == []  # cannot be exchanged
    # 48 degrees 7.038 minutes as 48.07038.
    reported = simulate_satellites(LEVEL, Georeference(48.3, 11.3), sigma=1.0)
    whole, part = np.divmod(reported.latlon_deg, 1.0)
    found = assess_satellites(replace(reported, latlon_deg=whole + 0.6 * part)).findings
    assert codes(found) == ["satellites_scale"]
    assert found[0].values["scale"] == pytest.approx(0.6, abs=0.05)


def test_stale_positions_and_jumps_are_good_to_know():
    reported = simulate_satellites(LEVEL, sigma=1.0)
    place = reported.latlon_deg.copy()
    place[20:40] = place[20]
    place[50] += 0.01
    found = assess_satellites(replace(reported, latlon_deg=place))
    assert [(f.code, f.level) for f in found.findings] == [
        ("satellites_stale", "note"),
        ("satellites_jump", "note"),
    ]
    [stale] = found.figures["stale"]
    assert stale == {"start_s": pytest.approx(20.0), "length_s": pytest.approx(19.0)}
    assert max(found.figures["jumps_m"]) > 1000.0
