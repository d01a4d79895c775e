"""Recordings written to an archive are read back unchanged, whatever they contain."""

from __future__ import annotations

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
    Magnetometer,
    PositionTrack,
    Satellites,
    find_recordings,
    read_recording,
    simulate_imu,
)
from stario.sequences.datasets.archive_writer import write_archive
from stario.sequences.simulation.walks import generate_walk


@pytest.fixture(scope="module")
def walk() -> ImuSequence:
    """A recording with everything: lost samples, ground truth with gaps, velocity, magnetometer."""
    rng = np.random.default_rng(1)
    sequence = simulate_imu(generate_walk(5, 6.0), 100.0, seed=3, name="hall/walk")
    truth = sequence.truth
    assert truth is not None
    gyro = sequence.gyro.copy()
    gyro[17, 1] = np.nan
    time = sequence.time[::3]
    waypoints = np.array([[1.0, 2.0], [3.0, 4.0]])
    latlon_deg = np.array([[48.1, 11.5], [48.1, 11.6]])
    return replace(
        sequence,
        gyro=gyro,
        truth=replace(
            truth,
            valid=rng.random(len(truth)) > 0.1,
            position_covariance_W=np.tile(np.eye(3), (len(truth), 1, 1)),
        ),
        magnetometer=Magnetometer(time + 1e-3, rng.normal(0.0, 40.0, (len(time), 3))),
        positions=PositionTrack(
            np.array([0.5, 3.0]),
            waypoints,
            "waypoints",
            latlon_deg=latlon_deg,
            floor=np.array([0.0, np.nan]),
        ),
        barometer=Barometer(time, rng.normal(980.0, 0.1, len(time))),
        satellites=Satellites(np.array([1.0, 2.0]), latlon_deg, radius_m=np.array([4.0, np.nan])),
        attributes={"person": "ann", "minutes": 0.1},
        device_attitude=DeviceAttitude(time, Rotation.random(len(time), random_state=2)),
    )


def assert_equal(found: ImuSequence, given: ImuSequence) -> None:
    for name in ("time", "gyro", "accel"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name))
    assert (found.truth is None) == (given.truth is None)
    if found.truth is not None and given.truth is not None:
        for name in ("time", "position_W", "velocity_W", "position_covariance_W", "valid"):
            np.testing.assert_array_equal(getattr(found.truth, name), getattr(given.truth, name))
        np.testing.assert_allclose(found.truth.quat_xyzw, given.truth.quat_xyzw, rtol=0, atol=1e-10)
    for part, columns in (
        ("magnetometer", ("time", "field")),
        ("positions", ("time", "position_W", "valid", "sigma", "latlon_deg", "floor")),
        ("barometer", ("time", "pressure_hPa")),
        ("satellites", ("time", "latlon_deg", "radius_m", "speed_m_s")),
    ):
        read_back, original = getattr(found, part), getattr(given, part)
        assert (read_back is None) == (original is None)
        for name in columns if original is not None else ():
            np.testing.assert_equal(getattr(read_back, name), getattr(original, name))
    assert dict(found.attributes) == dict(given.attributes)
    if given.device_attitude is not None:
        assert found.device_attitude is not None
        error = found.device_attitude.attitude_WB.inv() * given.device_attitude.attitude_WB
        assert error.magnitude().max() < 1e-9


def test_recordings_are_read_back_as_written(walk: ImuSequence, tmp_path: Path) -> None:
    path = tmp_path / "walks.h5"
    sigma = np.where(walk.time > 1.0, 2.0 + walk.time, np.nan)
    known = PositionTrack(walk.time, walk.accel, "positions", walk.time > 1.0, sigma)
    tracked = replace(walk, truth=None, positions=known)
    others = ("positions", "magnetometer", "device_attitude", "barometer", "satellites")
    bare = replace(tracked, attributes={}, **dict.fromkeys(others))
    given = [walk, tracked, bare]
    names = write_archive(path, given)
    assert names == ["hall-walk", "hall-walk-2", "hall-walk-3"]
    found = [read_recording(one) for one in find_recordings(path)]
    for read_back, original in zip(found, given, strict=True):
        assert_equal(read_back, original)
    assert found[1].positions is not None
    assert found[1].positions.kind == "positions"


def test_an_archive_is_written_whole_or_not_at_all(walk: ImuSequence, tmp_path: Path) -> None:
    path = tmp_path / "walks.h5"
    write_archive(path, [walk])
    before = path.read_bytes()

    def failing():
        yield walk
        raise InputError("recording", "a broken one", "a whole one")

    with pytest.raises(InputError, match="broken"):
        write_archive(path, failing())
    with pytest.raises(InputError, match="no recording"):
        write_archive(path, [])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(InputError, match=r"walks\.csv"):
        write_archive(tmp_path / "walks.csv", [walk])
