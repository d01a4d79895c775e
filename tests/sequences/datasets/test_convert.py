import logging
from dataclasses import replace

import numpy as np
import pytest
from alike import assert_same
from scipy.spatial.transform import Rotation

from stario.sequences import Barometer, DeviceAttitude, Magnetometer, Satellites, find_recordings
from stario.sequences.datasets.convert import convert
from stario.sequences.errors import InputError
from stario.sequences.readers import read_recording
from stario.sequences.readers.archive import write_archive
from stario.sequences.sequence import STANDARD_GRAVITY, PositionTrack
from stario.sequences.simulation.imu import simulate_imu
from stario.sequences.simulation.walks import generate_walk


@pytest.fixture(scope="module")
def walk():
    """Uneven nanosecond timestamps; the ground truth has its own, starts earlier and has gaps."""
    rng = np.random.default_rng(4)
    sequence = simulate_imu(generate_walk(5, 12.0), 200.0, seed=3, name="walk").slice(2.0, 10.0)
    truth = sequence.truth
    jitter_ns = np.sort(rng.choice(8 * 10**9, len(sequence), replace=False))
    truth_ns = np.sort(rng.choice(9 * 10**9, len(truth), replace=False)) - 10**9
    return replace(
        sequence,
        time=(jitter_ns - jitter_ns[0]) * 1e-9,
        truth=replace(truth, time=truth_ns * 1e-9, valid=rng.random(len(truth)) > 0.1),
    )


@pytest.mark.parametrize("layout", ["csv", "euroc"])
def test_conversion_loses_nothing(walk, tmp_path, layout):
    gyro = walk.gyro.copy()
    gyro[17, 1] = np.nan
    given = replace(walk, gyro=gyro)
    path = tmp_path / ("walk.csv" if layout == "csv" else "walk")
    written = convert(given, path)
    assert all(file.exists() for file in written)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    found, truth = read_recording(path, layout), given.truth.select(given.truth.valid)
    if layout == "csv":
        truth = replace(truth, velocity_W=None)
    expected = replace(given, truth=truth)
    but = {"source", "converted", "device_attitude"}
    assert_same(found, expected, 0.5e-9 if layout == "euroc" else 0.0, but)


def test_the_euroc_layout_is_that_of_its_authors(walk, tmp_path):
    """Unsigned whole nanoseconds, quaternions with w first."""
    imu, truth = (file.read_text().splitlines() for file in convert(walk, tmp_path / "r"))
    for lines in (imu, truth):
        assert lines[0].startswith("#timestamp")
        assert all(line.split(",")[0].isdecimal() for line in lines[1:])
    row = [float(cell) for cell in truth[1].split(",")]
    first = int(np.argmax(walk.truth.valid))
    np.testing.assert_allclose(row[4:8], walk.truth.quat_xyzw[first, [3, 0, 1, 2]], atol=1e-10)


def test_a_known_velocity_is_kept_in_euroc_and_dropped_with_a_warning_in_csv(
    walk, tmp_path, caplog
):
    truth = walk.truth
    velocity_W = np.gradient(truth.position_W, truth.time, axis=0)
    moving = replace(walk, truth=replace(truth, velocity_W=velocity_W))
    convert(moving, tmp_path / "r")
    found = read_recording(tmp_path / "r").truth
    np.testing.assert_array_equal(found.velocity_W, velocity_W[truth.valid])
    with caplog.at_level(logging.WARNING):
        convert(moving, tmp_path / "r.csv")
    assert "csv has no place for the truth's velocity: write .h5" in caplog.text


@pytest.mark.parametrize(
    ("kind", "interval", "count", "message"),
    [
        ("positions", 5.0, 2, "takes positions at such intervals for waypoints"),
        ("waypoints", 1.0, 4, "takes waypoints at such intervals for positions"),
        ("waypoints", 5.0, 1, "needs two waypoints"),
        ("waypoints", 5.0, 2, ""),
        ("positions", 1.0, 4, ""),
    ],
)
def test_positions_that_a_csv_would_change_give_a_warning(
    walk, tmp_path, caplog, kind, interval, count, message
):
    known = PositionTrack(interval * np.arange(count), np.ones((count, 2)), kind)
    with caplog.at_level(logging.WARNING):
        convert(replace(walk, truth=None, positions=known), tmp_path / "r.csv")
    assert message in caplog.text
    kept = read_recording(tmp_path / "r.csv").positions
    assert bool(message) == (kept is None or kept.kind != kind)
    caplog.clear()
    convert(replace(walk, positions=known, attributes={"person": "x"}), tmp_path / "both.csv")
    assert f", {kind} alongside true poses, its attributes: write .h5" in caplog.text


def test_short_recordings_without_truth_are_converted(walk, tmp_path):
    """Too short to check their units."""
    for path in (tmp_path / "a.csv", tmp_path / "a"):
        convert(walk.without_truth().slice(0.0, 0.5), path)
        assert read_recording(path).truth is None
        assert read_recording(path).duration < 0.5


def test_what_cannot_be_converted_is_refused_with_the_reason(walk, tmp_path):
    time = np.where(np.arange(len(walk)) == 3, np.nan, walk.time)
    in_g = replace(walk, accel=walk.accel / STANDARD_GRAVITY)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").touch()
    for recording, name, words in (
        (replace(walk.without_truth(), time=time), "r", r"time of sample 3: .*convert to csv"),
        (walk, "no/r", "existing folder"),
        (walk, "full", "file, which would be lost"),
        (in_g, "a.csv", r"give 9\.80665 \* accel"),
    ):
        with pytest.raises(InputError, match=words):
            convert(recording, tmp_path / name)
    assert [p.name for p in tmp_path.rglob("*")] == ["full", "file"]


@pytest.fixture(scope="module")
def hall():
    """A recording with everything: lost samples, ground truth with gaps, velocity, magnetometer."""
    rng = np.random.default_rng(1)
    sequence = simulate_imu(generate_walk(5, 6.0), 100.0, seed=3, name="hall/walk")
    truth, gyro, time = sequence.truth, sequence.gyro.copy(), sequence.time[::3]
    gyro[17, 1] = np.nan
    covariance = np.tile(np.eye(3), (len(truth), 1, 1))
    latlon_deg = np.array([[48.1, 11.5], [48.1, 11.6]])
    return replace(
        sequence,
        gyro=gyro,
        truth=replace(
            truth, valid=rng.random(len(truth)) > 0.1, position_covariance_W=covariance
        ),
        magnetometer=Magnetometer(time + 1e-3, rng.normal(0.0, 40.0, (len(time), 3))),
        positions=PositionTrack(
            [0.5, 3.0], [[1.0, 2.0], [3.0, 4.0]], "waypoints",
            latlon_deg=latlon_deg, floor=np.array([0.0, np.nan]),
        ),
        barometer=Barometer(time, rng.normal(980.0, 0.1, len(time))),
        satellites=Satellites(np.array([1.0, 2.0]), latlon_deg, radius_m=np.array([4.0, np.nan])),
        attributes={"person": "ann", "minutes": 0.1},
        device_attitude=DeviceAttitude(time, Rotation.random(len(time), random_state=2)),
    )  # fmt: skip


def test_recordings_are_read_back_as_written(hall, tmp_path):
    path = tmp_path / "walks.h5"
    sigma = np.where(hall.time > 1.0, 2.0 + hall.time, np.nan)
    known = PositionTrack(hall.time, hall.accel, "positions", hall.time > 1.0, sigma)
    tracked = replace(hall, truth=None, positions=known)
    others = ("positions", "magnetometer", "device_attitude", "barometer", "satellites")
    bare = replace(tracked, attributes={}, **dict.fromkeys(others))
    given = [hall, tracked, bare]
    names = write_archive(path, given)
    assert names == ["hall-walk", "hall-walk-2", "hall-walk-3"]
    found = [read_recording(one) for one in find_recordings(path)]
    for read_back, original in zip(found, given, strict=True):
        assert_same(read_back, original, but={"name", "source", "converted"})


def test_an_archive_is_written_whole_or_not_at_all(hall, tmp_path):
    path = tmp_path / "walks.h5"
    write_archive(path, [hall])
    before = path.read_bytes()

    def failing():
        yield hall
        raise InputError("recording", "a broken one", "a whole one")

    with pytest.raises(InputError, match="broken"):
        write_archive(path, failing())
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
