import dataclasses

import numpy as np
import published_formats as formats
import pytest
from alike import max_angle
from scipy.spatial.transform import Rotation

from stario.sequences import STANDARD_GRAVITY, check_units, read_recording, with_conventions
from stario.sequences.errors import InputError, ReadError


@pytest.mark.parametrize(
    "kind",
    [
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
    ],
)
def test_each_type_of_pose_message_is_read_as_truth(tmp_path, kind):
    walk = formats.walk_of(100.0, 3.0)
    path = formats.bag(tmp_path / "b", walk, "sqlite3", pose_topics=(("/pose", kind),))
    read = read_recording(path)
    assert np.abs(read.truth.position_W - walk.truth.position_W).max() < 1e-9
    assert max_angle(read.truth.attitude_WB, walk.truth.attitude_WB) < 1e-9
    assert np.abs(read.truth.time - walk.time).max() < 2e-9


@pytest.mark.parametrize("version", ["ros1", "mcap"])
def test_pressure_and_satellites_of_a_bag_are_read(tmp_path, version):
    walk = formats.walk_of(100.0, 3.0)
    topics = (("/air", "sensor_msgs/msg/FluidPressure"), ("/fix", "sensor_msgs/msg/NavSatFix"))
    read = read_recording(formats.bag(tmp_path / "b", walk, version, other_topics=topics))
    rows = np.arange(len(walk))
    assert read.truth is not None
    np.testing.assert_allclose(read.barometer.pressure_hPa, 1013.25 - 0.01 * rows)
    np.testing.assert_allclose(read.barometer.time, walk.time, atol=2e-9)
    found = read.satellites
    place = np.stack([np.full(len(rows), 48.0), 11.0 + 1e-5 * rows], axis=1)
    np.testing.assert_allclose(found.latlon_deg, place)
    np.testing.assert_array_equal(found.altitude_m, 500.0)
    np.testing.assert_allclose(found.radius_m, 1.51 * 3.0)


def test_several_topics_are_named_with_the_option_that_selects_one(tmp_path):
    walk = formats.walk_of(100.0, 1.0)
    poses = [(topic, "geometry_msgs/msg/PoseStamped") for topic in ("/mocap", "/vio")]
    path = formats.bag(tmp_path / "b", walk, imu_topics=("/imu", "/imu_old"), pose_topics=poses)
    for bag, options, words in (
        (path, {}, r"found /imu, /imu_old, .*--imu-topic /imu"),
        (path, {"imu_topic": "/imu"}, r"found /mocap, /vio, .*--truth-topic /mocap, or .*none"),
        (path, {"imu_topic": "/vio"}, "imu topic: found '/vio', expected one of /imu, /imu_old"),
        (
            formats.bag(tmp_path / "n", walk, imu_topics=()),
            {},
            r"/odom \(Odometry\), /mag .* topic",
        ),
    ):
        with pytest.raises(ReadError, match=words):
            read_recording(bag, **options)
    read = read_recording(path, imu_topic="/imu_old", truth_topic="/vio")
    assert np.array_equal(read.gyro, walk.gyro)
    assert read.truth is not None
    assert read_recording(path, imu_topic="/imu", truth_topic="none").truth is None
    (tmp_path / "a.csv").write_text("t,gx,gy,gz,ax,ay,az\n")
    with pytest.raises(InputError, match=r"imu_topic: .* format csv"):
        read_recording(tmp_path / "a.csv", imu_topic="/imu")


def test_a_bag_without_gravity_keeps_the_attitude_that_restores_it(tmp_path):
    """As drivers of the BNO055 publish it: linear acceleration beside the sensor's own attitude."""
    walk = formats.walk_of(100.0, 20.0)
    up_B = walk.truth.at(walk.time).attitude_WB.apply([0.0, 0.0, STANDARD_GRAVITY], inverse=True)
    linear = dataclasses.replace(walk, accel=walk.accel - up_B)
    read = read_recording(formats.bag(tmp_path / "b", linear, pose_topics=()))
    with pytest.raises(InputError, match="`--gravity removed`"):
        check_units(read)
    restored = with_conventions(read, gravity="removed")
    check_units(restored)
    np.testing.assert_allclose(restored.accel, walk.accel, atol=1e-6)
    identity = Rotation.identity(len(walk.truth))
    blank = dataclasses.replace(walk, truth=dataclasses.replace(walk.truth, attitude_WB=identity))
    assert (
        read_recording(formats.bag(tmp_path / "c", blank, pose_topics=())).device_attitude is None
    )
