from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import (
    Barometer,
    DeviceAttitude,
    ImuSequence,
    InputError,
    MagneticField,
    Magnetometer,
    PositionTrack,
    Satellites,
    Trajectory,
    WalkStyle,
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
from stario.sequences.accuracy.nees import nees
from stario.sequences.clean_samples import clean_samples
from stario.sequences.datasets.convert import convert
from stario.sequences.datasets.splits import random_split
from stario.sequences.drawing.plan import plan_view
from stario.sequences.drawing.plots import error_over_time
from stario.sequences.geodesy import Georeference
from stario.sequences.readers.archive import write_archive
from stario.sequences.simulation.house import simulate_house
from stario.sequences.simulation.imu import ImuErrors
from stario.sequences.truth.fit import fit_truth

TIME = np.arange(200) / 100.0
SEQUENCE = ImuSequence("s", TIME, np.zeros((200, 3)), np.tile([0.0, 0.0, 9.8], (200, 1)))
ROWS = np.zeros((200, 3))
POSES = Trajectory(TIME, ROWS, Rotation.identity(200))
LOST = replace(POSES, valid=np.zeros(200, dtype=bool))
FEW = POSES.slice(0.0, 0.04)
BACK = np.where(TIME == 0.07, 0.06, TIME)
BAD = np.where(np.arange(200)[:, None] == 5, np.nan, ROWS)
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
        (lambda: Trajectory(BACK, ROWS, POSES.attitude_WB), "time", "at row 7"),
        (lambda: Trajectory(np.nan * TIME, ROWS, POSES.attitude_WB), "time", "not finite"),
        (lambda: Trajectory(TIME, BAD, POSES.attitude_WB), "position_W", "at row 5"),
        (lambda: Trajectory(TIME, ROWS[:, :2], POSES.attitude_WB), "position_W", "(200, 2)"),
        (lambda: Trajectory(TIME, ROWS, Rotation.identity(199)), "attitude_WB", "199 rotations"),
        (lambda: replace(POSES, valid=np.ones(3, dtype=bool)), "valid", "(200,)"),
        (lambda: POSES.slice(3.0, 4.0), "time", "at least one sample"),
        (lambda: SEQUENCE.slice(100.0, 200.0), "slice", "within the recording's"),
        (lambda: LOST.at(TIME), "trajectory", "0 valid samples"),
        (lambda: replace(SEQUENCE, gyro=ROWS[1:]), "gyro", "(200, 3) as time"),
        (lambda: replace(SEQUENCE, accel=ROWS[:, :2]), "accel", "(200, 3)"),
        (lambda: ImuSequence("s", [], np.empty((0, 3)), np.empty((0, 3))), "time", ""),
        (
            lambda: Satellites([0.0], [[99.0, 9.0]]),
            "satellites' latlon_deg, row 0",
            "latitude first",
        ),
        (lambda: Barometer([0.0, 1.0], [1013.2, np.nan]), "barometer's pressure_hPa", "not finite"),
        (lambda: Georeference(91.0, 0.0), "georeference: latitude_deg", "degrees"),
        (lambda: Georeference(np.nan, 0.0), "georeference: latitude_deg", "degrees"),
        (lambda: Georeference(0.0, 361.0), "georeference: longitude_deg", "degrees"),
        (lambda: Georeference(0.0, 0.0, 500.0), "georeference: yaw", "radians"),
        (lambda: Georeference(48.0, 11.0).xy("a"), "latlon_deg", "(N, 2)"),
        (lambda: Georeference(48.0, 11.0).latlon_deg([[[0.0]]]), "position_W", "(N, 2)"),
        (lambda: with_conventions(SEQUENCE, gravity="gone"), "gravity", "included, removed"),
        (lambda: with_conventions(SEQUENCE, accel_sign="left"), "accel_sign", "'left'"),
        (lambda: with_conventions(SEQUENCE, gyro_unit="rpm"), "gyro_unit", "deg/s"),
        (lambda: align(POSES, POSES, "sim3"), "alignment", "'sim3'"),
        (lambda: evaluate_track(POSES, POSES, convention="median"), "convention", "'median'"),
        (lambda: evaluate_track(POSES, POSES, rte_interval=0.0), "rte_interval", "0"),
        (lambda: evaluate_track(LOST, POSES), "estimate", "no valid pose"),
        (lambda: position_nees(POSES, POSES), "estimate.position_covariance_W", ""),
        (lambda: nees(ROWS[:2], np.stack([np.eye(3), -np.eye(3)])), "covariance", "row 1"),
        (lambda: plan_view({"track": LOST}, None, ""), "tracks", "no valid pose"),
        (lambda: error_over_time({}, POSES), "tracks", "at least one track"),
        (lambda: simulate_imu(FEW), "trajectory", "at least 6"),
        (lambda: simulate_imu(POSES, 0.0), "rate", ""),
        (lambda: simulate_imu(POSES, gravity=np.nan), "gravity", ""),
        (lambda: ImuErrors(gyro_scale=-1.0), "gyro_scale", ""),
        (lambda: ImuErrors(accel_range=0.0), "accel_range", ""),
        (lambda: MagneticField(length=-1.0), "length", ""),
        (lambda: MagneticField(noise=-1.0), "noise", ""),
        (lambda: MagneticField(hard_iron=(np.nan, 0, 0)), "hard_iron", ""),
        (lambda: WalkStyle(carry="on a hat"), "carry", ""),
        (lambda: WalkStyle(height=17.5), "height", ""),
        (lambda: WalkStyle(mount_rotvec=(0.0, 0.0, np.nan)), "mount_rotvec", ""),
        (lambda: generate_walk(0, duration=0.0), "duration", ""),
        (lambda: generate_walk(0, rate=10.0), "rate", ""),
        (lambda: simulate_house(0, 30.0), "duration", "at least 120 s"),
        (lambda: simulate_house(0, style=WalkStyle(carry="trolley")), "carry", "trolley"),
        (lambda: random_split([Path("a"), Path("b")], seed=0), "recordings", "at least 3"),
        (lambda: world_streams(SEQUENCE), "s: truth", "found none"),
        (
            lambda: world_streams(replace(SEQUENCE, time=99 * TIME, truth=POSES)),
            "s: rate",
            "second",
        ),
        (lambda: clean_samples(replace(SEQUENCE, time=1e-3 * TIME)), "s: rate", "seconds"),
        (lambda: clean_samples(replace(SEQUENCE, gyro=np.nan * ROWS)), "s: samples", "0 usable"),
        (lambda: leg_streams(SEQUENCE), "s: positions", "found none"),
        (lambda: fit_truth(SEQUENCE), "s: truth", ""),
        (lambda: fit_truth(replace(SEQUENCE, truth=POSES)), "recording", "10 s"),
        (lambda: convert(SEQUENCE, Path("r"), "bag"), "layout", "csv, euroc"),
        (lambda: write_archive(Path("walks.csv"), [SEQUENCE]), "path", "walks.csv"),
        (lambda: write_archive(Path("walks.h5"), []), "walks.h5", "no recording"),
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
