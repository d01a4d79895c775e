"""Wrong arguments are refused at once, by name, with what was expected."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import (
    DeviceAttitude,
    ImuSequence,
    InputError,
    Magnetometer,
    PositionTrack,
    Trajectory,
    align,
    check_units,
    evaluate_track,
    find_recordings,
    generate_walk,
    inspect_recording,
    leg_streams,
    position_nees,
    simulate_imu,
    truth_findings,
    with_conventions,
    with_units,
    world_streams,
    write_csv,
    write_tum,
)

TIME = np.arange(200) / 100.0
SEQUENCE = ImuSequence("s", TIME, np.zeros((200, 3)), np.tile([0.0, 0.0, 9.8], (200, 1)))
ROWS = np.zeros((200, 3))
POSES = Trajectory(TIME, ROWS, Rotation.identity(200))
DATES = np.datetime64("2026-01-01") + (1e9 * TIME).astype("timedelta64[ns]")


@pytest.mark.parametrize(
    ("make", "field", "text"),
    [
        (lambda: ImuSequence(TIME, ROWS, ROWS, POSES), "name", 'ImuSequence("walk", time,'),
        (lambda: find_recordings(["a.csv"]), "path", "the path of a recording or a folder"),
        (lambda: find_recordings("a.h5", where={"person": "dan"}), "where", "'person': ['dan']"),
        (lambda: generate_walk(-1), "seed", "an integer >= 0"),
        (lambda: generate_walk(None), "seed", "an integer >= 0"),
        (lambda: simulate_imu(POSES, seed=1.5), "seed", "an integer >= 0"),
        (lambda: replace(SEQUENCE, truth=ROWS), "truth", "Trajectory"),
        (lambda: replace(SEQUENCE, magnetometer=(TIME, ROWS)), "magnetometer", "Magnetometer(...)"),
        (lambda: replace(SEQUENCE, positions=ROWS), "positions", "PositionTrack"),
        (lambda: replace(SEQUENCE, device_attitude=ROWS), "device_attitude", "DeviceAttitude"),
        (lambda: replace(SEQUENCE, time=DATES), "time", "np.timedelta64(1, 's')"),
        (lambda: replace(SEQUENCE, gyro="fast"), "gyro", "an array of numbers"),
        (lambda: replace(SEQUENCE, accel=[[1.0], [1.0, 2.0]]), "accel", "an array of numbers"),
        (lambda: PositionTrack(TIME, ROWS, "foo"), "positions' kind", "positions, waypoints"),
        (lambda: PositionTrack(DATES, ROWS, "positions"), "positions' time", "np.timedelta64"),
        (lambda: PositionTrack(TIME, ROWS, "positions", sigma=TIME), "positions' sigma", "above 0"),
        (lambda: PositionTrack(TIME, ROWS, "positions", sigma=ROWS), "positions' sigma", "(200,)"),
        (lambda: Magnetometer(TIME, "north"), "magnetometer's field", "an array of numbers"),
        (lambda: Trajectory(TIME, ROWS, np.zeros((200, 4))), "attitude_WB", "Rotation.from_quat"),
        (lambda: Trajectory(TIME, ROWS, Rotation.identity()), "attitude_WB", "200 as time"),
        (lambda: with_conventions(SEQUENCE, axes=["y", "-x", "z"]), "axes", "such as y,-x,z"),
        (lambda: DeviceAttitude(TIME, ROWS), "device attitude's attitude_WB", "Rotation"),
        (lambda: write_csv(SEQUENCE, Path("s.csv")), "sequence", "write_csv(path, sequence)"),
        (lambda: inspect_recording("x"), "sequence", "read_recording(path)"),
        (lambda: check_units("x"), "sequence", "read_recording(path)"),
        (lambda: world_streams("x"), "sequence", "read_recording(path)"),
        (lambda: world_streams(SEQUENCE, "tilted"), "attitude", "levelled, true"),
        (lambda: leg_streams("x"), "sequence", "read_recording(path)"),
        (lambda: truth_findings("x"), "sequence", "read_recording(path)"),
        (lambda: with_units("x", "deg/s"), "sequence", "read_recording(path)"),
        (lambda: with_conventions("x", axes="y,-x,z"), "sequence", "read_recording(path)"),
        (lambda: simulate_imu(SEQUENCE), "trajectory", "generate_walk(seed)"),
        (lambda: simulate_imu(POSES, 100.0, 7), "errors", "seed=7"),
        (lambda: align(SEQUENCE, POSES, "none"), "estimate", "track.trajectory"),
        (lambda: evaluate_track(SEQUENCE, POSES), "estimate", "track.trajectory"),
        (lambda: evaluate_track(POSES, SEQUENCE.truth), "truth", "recording.truth"),
        (lambda: position_nees(SEQUENCE, POSES), "estimate", "track.trajectory"),
        (lambda: write_tum("track.tum", SEQUENCE), "trajectory", "track.trajectory"),
    ],
)
def test_a_wrong_argument_is_named(make, field, text):
    with pytest.raises(InputError) as caught:
        make()
    assert caught.value.field == field
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_remedy_for_dates_gives_seconds():
    seconds = (DATES - DATES[0]) / np.timedelta64(1, "s")
    np.testing.assert_allclose(replace(SEQUENCE, time=seconds).time, TIME)
