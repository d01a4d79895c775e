"""Skeleton of a ROS 2 node around StarIO; ROS is needed only to run it as a node.

    subscribes  imu/data   sensor_msgs/Imu in the IMU's frame (REP 103: x forward, z up; any
                           mounting works, as the device is levelled by gravity)
                imu/mag    sensor_msgs/MagneticField in the same frame, optional
                fix        geometry_msgs/PoseWithCovarianceStamped, a position in `map`, optional
    publishes   odometry   nav_msgs/Odometry, pose in `odom`, twist in `base_link`
                tf         map -> odom -> base_link (REP 105)

`odom` is continuous (`Navigator.continuous`): its position drifts, but neither updates nor fixes
make it jump, so that controllers may use it; its attitude is the corrected one, whose yaw a fix may
turn by some degrees. The position jumps only after a gap in the samples, during which the motion is
unknown, and starts again where the clock was set back, as in a bag that is played again.
Corrections by fixes go into map -> odom. Metres, radians, quaternions x y z w
(REP 103). `base_link` is the IMU's frame here; if yours differs, publish the static transform
between them and use the IMU's frame name instead.

With ROS 2 sourced, `python examples/ros2_node.py --node` spins the node. Without ROS, the same code
runs on a bag (`pip install '.[bags]'`) or, with no argument, on the bundled demonstration:

    python examples/ros2_node.py [BAG]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stario.fusion import ContinuousPose, Navigator, NavState, demonstration
from stario.network import load_model
from stario.sequences import InputError, ReadError, StarioError, about_z, yaw_of

GYRO_NOISE = 0.01
"""Standard deviation of one rate sample [rad/s], for the twist's covariance."""


@dataclass(frozen=True)
class Transform:
    """Transform of points from the child frame to the parent: x -> R x + p."""

    R: Rotation
    p: np.ndarray

    def __matmul__(self, other: Transform) -> Transform:
        return Transform(self.R * other.R, self.R.apply(other.p) + self.p)

    def inverse(self) -> Transform:
        """Return the transform from parent to child."""
        return Transform(self.R.inv(), -self.R.inv().apply(self.p))


@dataclass(frozen=True)
class Odometry:
    """Data published at one time: the fields of nav_msgs/Odometry and of both transforms.

    Attributes:
        stamp_ns: time of the state [ns].
        odom_base: pose of base_link in odom.
        map_odom: pose of odom in map, which fixes and updates correct.
        pose_covariance: (6, 6) covariance of x, y, z and the rotations about odom's axes.
        linear, angular: twist in base_link [m/s], [rad/s].
        twist_covariance: (6, 6) covariance of both.
    """

    stamp_ns: int
    odom_base: Transform
    map_odom: Transform
    pose_covariance: np.ndarray
    linear: np.ndarray
    angular: np.ndarray
    twist_covariance: np.ndarray


class OdometryBridge:
    """Conversion of the numbers in messages to odometry, without ROS.

    Args:
        navigator: navigator that processes the stream.
    """

    def __init__(self, navigator: Navigator) -> None:
        self._navigator = navigator
        self._first_ns: int | None = None
        self._begin()

    def _begin(self) -> None:
        self._frame = Transform(Rotation.identity(), np.zeros(3))  # of odom; follows the map
        self._last: ContinuousPose | None = None

    def imu(self, message: Any) -> Odometry | None:
        """Process a sensor_msgs/Imu; return odometry if it completes a state.

        Raises:
            InputError: as for `Navigator.push`, which then starts again.
        """
        if self._first_ns is None:
            self._first_ns = _stamp_ns(message)
        rate, force = message.angular_velocity, message.linear_acceleration
        gyro = (rate.x, rate.y, rate.z)
        try:
            state = self._navigator.push(self._seconds(message), gyro, (force.x, force.y, force.z))
        except InputError:
            self._begin()
            raise
        if state is None:
            return None
        if self._last is not None and self._last.map_frame != state.map_frame:
            # A fix that waited for its time moved the map: base_link kept moving as before.
            dt = state.time - self._last.time
            turned = _attitude(self._last) * Rotation.from_rotvec(dt * np.array(gyro))
            self._follow(Transform(turned, self._last.p_W + dt * self._last.v_W), state)
        self._last = self._navigator.continuous
        return self._odometry(state, np.array(gyro))

    def field(self, message: Any) -> None:
        """Process a sensor_msgs/MagneticField, which makes the vertical gyroscope bias known."""
        if self._first_ns is not None:
            tesla = message.magnetic_field
            field = [1e6 * axis for axis in (tesla.x, tesla.y, tesla.z)]
            self._navigator.push_magnetometer(self._seconds(message), field)

    def fix(self, message: Any) -> None:
        """Apply the position of a geometry_msgs/PoseWithCovarianceStamped in map."""
        before, continuous = self._navigator.state, self._navigator.continuous
        if before is None or continuous is None:
            return
        at = message.pose.pose.position
        covariance = np.reshape(message.pose.covariance, (6, 6))[:3, :3]
        self._navigator.update_position(self._seconds(message), [at.x, at.y, at.z], covariance)
        after = self._navigator.state
        if after.map_frame == before.map_frame:
            return  # an ordinary correction, which is applied gradually
        self._follow(Transform(_attitude(before), continuous.p_W), after)
        self._last = self._navigator.continuous

    def _seconds(self, message: Any) -> float:
        """Return a message's time since the first one: a float cannot hold ns since 1970."""
        return (_stamp_ns(message) - (self._first_ns or 0)) / 1e9

    def _follow(self, before: Transform, after: NavState) -> None:
        """Keep base_link where it was in odom after the map moved; odom stays level (REP 105)."""
        stays = (self._frame.inverse() @ before).p
        turn = about_z(float(yaw_of(_attitude(after) * before.R.inv())[0]))
        R = turn * self._frame.R
        self._frame = Transform(R, after.p_W - R.apply(stays))

    def _odometry(self, state: NavState, gyro: np.ndarray) -> Odometry:
        continuous, P = self._navigator.continuous, state.covariance
        correction = Transform(Rotation.identity(), continuous.correction_W)
        to_odom = self._frame.R.inv().as_matrix()
        pose = np.zeros((6, 6))
        pose[:3, :3], pose[3:, 3:] = P[6:9, 6:9], P[:3, :3]
        pose[:3, 3:], pose[3:, :3] = P[6:9, :3], P[:3, 6:9]
        twist = np.zeros((6, 6))
        twist[:3, :3] = state.R_WB.T @ P[3:6, 3:6] @ state.R_WB
        twist[3:, 3:] = P[9:12, 9:12] + GYRO_NOISE**2 * np.eye(3)
        turn = np.kron(np.eye(2), to_odom)
        return Odometry(
            stamp_ns=(self._first_ns or 0) + round(state.time * 1e9),
            odom_base=self._frame.inverse() @ Transform(_attitude(continuous), continuous.p_W),
            map_odom=correction @ self._frame,
            pose_covariance=turn @ pose @ turn.T,
            linear=_attitude(state).inv().apply(state.v_W),
            angular=gyro - state.b_g,
            twist_covariance=twist,
        )


def _stamp_ns(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def _attitude(pose: NavState | ContinuousPose) -> Rotation:
    return Rotation.from_matrix(pose.R_WB)


def bag_messages(path: Path) -> Iterator[Any]:
    """Yield the Imu messages of a ROS 1 or 2 bag, read without ROS."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not path.exists():
        raise ReadError(path, "path", "no such file or folder", "a bag")
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        connections = [c for c in reader.connections if c.msgtype == "sensor_msgs/msg/Imu"]
        for connection, _, raw in reader.messages(connections[:1]):
            yield reader.deserialize(raw, connection.msgtype)


def demonstration_messages(seconds: float) -> Iterator[Any]:
    """Yield the bundled demonstration as Imu messages."""
    recording = demonstration()
    for time, gyro, accel in zip(recording.time, recording.gyro, recording.accel, strict=True):
        if time > seconds:
            return
        sec, nanosec = divmod(1_700_000_000 * 10**9 + round(time * 1e9), 10**9)
        vectors = [SimpleNamespace(x=v[0], y=v[1], z=v[2]) for v in (gyro, accel)]
        stamp = SimpleNamespace(sec=sec, nanosec=nanosec)
        yield SimpleNamespace(
            header=SimpleNamespace(stamp=stamp),
            angular_velocity=vectors[0],
            linear_acceleration=vectors[1],
        )


def main(path: Path | None = None, seconds: float = 20.0) -> list[Odometry]:
    """Return the odometry of a bag, or of the demonstration's first seconds."""
    bridge = OdometryBridge(Navigator(load_model("default")))
    messages = demonstration_messages(seconds) if path is None else bag_messages(path)
    return [odometry for message in messages if (odometry := bridge.imu(message)) is not None]


def spin() -> None:
    """Run as a ROS 2 node until it is shut down."""
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
    from nav_msgs.msg import Odometry as OdometryMessage
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Imu, MagneticField
    from tf2_ros import TransformBroadcaster

    class StarIONode(Node):
        def __init__(self) -> None:
            super().__init__("stario")
            model = self.declare_parameter("model", "default").value
            self.bridge = OdometryBridge(Navigator(load_model(model)))
            self.odometry = self.create_publisher(OdometryMessage, "odometry", 10)
            self.transforms = TransformBroadcaster(self)
            self.create_subscription(Imu, "imu/data", self.on_imu, qos_profile_sensor_data)
            self.create_subscription(
                MagneticField, "imu/mag", self.bridge.field, qos_profile_sensor_data
            )
            self.create_subscription(PoseWithCovarianceStamped, "fix", self.bridge.fix, 10)

        def on_imu(self, message: Imu) -> None:
            try:
                found = self.bridge.imu(message)
            except InputError as error:
                self.get_logger().error(str(error))
                return
            if found is None:
                return
            output = OdometryMessage()
            stamp = rclpy.time.Time(nanoseconds=found.stamp_ns).to_msg()
            output.header.stamp, output.header.frame_id = stamp, "odom"
            output.child_frame_id = "base_link"
            place(found.odom_base, output.pose.pose.position, output.pose.pose.orientation)
            output.pose.covariance = found.pose_covariance.ravel().tolist()
            output.twist.covariance = found.twist_covariance.ravel().tolist()
            for vector, values in (
                (output.twist.twist.linear, found.linear),
                (output.twist.twist.angular, found.angular),
            ):
                vector.x, vector.y, vector.z = values.tolist()
            self.odometry.publish(output)
            for parent, child, where in (
                ("map", "odom", found.map_odom),
                ("odom", "base_link", found.odom_base),
            ):
                transform = TransformStamped()
                transform.header.stamp, transform.header.frame_id = stamp, parent
                transform.child_frame_id = child
                place(where, transform.transform.translation, transform.transform.rotation)
                self.transforms.sendTransform(transform)

    def place(where: Transform, position: Any, orientation: Any) -> None:
        position.x, position.y, position.z = where.p.tolist()
        orientation.x, orientation.y, orientation.z, orientation.w = where.R.as_quat().tolist()

    rclpy.init()
    node = StarIONode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Odometry of a bag, or as a ROS 2 node.")
    parser.add_argument("bag", nargs="?", type=Path, help="default: the demonstration")
    parser.add_argument("--node", action="store_true", help="run as a node until it is shut down")
    options = parser.parse_args()
    if options.node:
        spin()
    else:
        try:
            outputs = main(options.bag)
        except StarioError as error:
            parser.exit(2, f"{error}\n")
        for found in outputs[::20]:
            sigma = np.sqrt(np.diag(found.pose_covariance)[:3])
            seconds = (found.stamp_ns - outputs[0].stamp_ns) / 1e9
            print(
                f"{seconds:6.1f} s  odom {found.odom_base.p.round(2)} m  sigma {sigma.round(2)} m"
            )
