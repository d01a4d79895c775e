import sys

import numpy as np
import published_formats as formats
import pytest
from alike import max_angle
from scipy.spatial.transform import Rotation

from stario.sequences import InputError, find_recordings, read_recording


def assert_truth_is_read(recording: formats.Written) -> None:
    truth, expected = read_recording(recording.path).truth, recording.expected.truth
    assert np.abs(truth.position_W - expected.position_W).max() < 1e-6
    assert max_angle(truth.attitude_WB, expected.attitude_WB) < 1e-6


@pytest.mark.parametrize(
    ("errors", "source"),
    [
        ({"grv_ori_error": 19.9, "ekf_ori_error": 1.0}, "game_rv"),
        ({"grv_ori_error": 20.1, "ekf_ori_error": 5.0}, "ekf"),
        ({"grv_ori_error": 25.0, "ekf_ori_error": 30.0, "gyro_integration_error": 40.0}, "game_rv"),
        ({"grv_ori_error": 25.0, "ekf_ori_error": 30.0, "gyro_integration_error": 10.0}, "gyro"),
    ],
)
def test_ronin_uses_the_attitude_source_that_its_authors_use(tmp_path, walks, errors, source):
    walk = walks(200.0)
    recording = formats.ronin(tmp_path / "a000_1", walk, **errors)
    attitude = read_recording(recording.path).truth.attitude_WB
    true = walk.truth.attitude_WB
    if source == "ekf":  # the writer makes it drift about the vertical
        drift = Rotation.from_rotvec(np.outer(walk.time, [0.0, 0.0, 0.01]))
        true = drift * true
    limit = 2e-3 if source == "gyro" else 1e-6
    assert max_angle(attitude, true[100:]) < limit
    if source == "gyro":
        turned, true = (one[0].inv() * one for one in (attitude, true[100:]))
        assert max_angle(turned, true) > 1e-9


def test_ronin_without_an_ekf_uses_the_other_sources(tmp_path, walks):
    h5py = pytest.importorskip("h5py")
    recording = formats.ronin(tmp_path / "a", walks(200.0), grv_ori_error=30.0)
    with h5py.File(recording.path / "data.hdf5", "a") as data:
        del data["pose/ekf_ori"]
    read = read_recording(recording.path / "data.hdf5")
    assert max_angle(read.truth.attitude_WB, recording.expected.truth.attitude_WB) < 2e-3


def test_poses_of_the_odometry_and_those_in_a_world_with_z_up_are_read(tmp_path, walks):
    recording = formats.rnin(tmp_path, walks(200.0), captured=False)
    assert_truth_is_read(recording)
    csv = recording.path / "SenseINS.csv"
    csv.write_text(csv.read_text().replace("times,", "time,", 1))
    assert np.array_equal(read_recording(csv).gyro, read_recording(recording.path).gyro)
    # RIDI's raw folders contain IMUNet's files, from a Tango.
    recording = formats.imunet_raw(tmp_path / "seq", walks(200.0), world=Rotation.identity())
    assert_truth_is_read(recording)


def test_tlio_quaternion_order_is_that_of_the_column_name(tmp_path, walks):
    recording = formats.tlio(tmp_path / "7", walks(200.0), order="wxyz")
    read = read_recording(recording.path)
    assert max_angle(read.truth.attitude_WB, recording.expected.truth.attitude_WB) < 1e-6
    assert np.abs(read.accel - recording.expected.accel).max() < 1e-9


def test_tlio_raw_poses_are_in_the_imus_axes(tmp_path, walks):
    """The calibration rotates a pose of the device, but not a pose of the IMU."""
    R_DI = Rotation.from_euler("zyx", [90.0, 10.0, -170.0], degrees=True)
    recording = formats.tlio_raw(tmp_path / "7", walks(1000.0), R_DI)
    assert_truth_is_read(recording)
    (recording.path.parent / "imu0_resampled.npy").unlink()
    alone = read_recording(recording.path.parent)
    assert alone.truth is None
    assert np.abs(alone.accel - recording.expected.accel).max() < 1e-9


def test_a_processed_recording_is_preferred_to_the_raw_files_next_to_it(tmp_path, walks):
    walk = walks(200.0)
    formats.imunet_raw(tmp_path / "seq", walk)
    formats.ridi(tmp_path / "seq", walk)
    assert len(read_recording(tmp_path / "seq")) == len(walk)
    assert len(read_recording(tmp_path / "seq", format="imunet")) == len(walk)
    assert find_recordings(tmp_path) == [tmp_path / "seq"]


def test_a_missing_package_is_named_with_what_installs_it(tmp_path, walks, monkeypatch):
    recording = formats.ronin(tmp_path / "a", walks(200.0))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"h5py: found not installed.*pip install 'h5py"):
        read_recording(recording.path)
