"""ROS 1 and ROS 2 bags: Imu messages and, if present, poses as ground truth and other sensors.

Reads `.bag` files, rosbag2 folders, `.mcap` and `.db3` files with `rosbags`, without ROS. Only the
numbers of a message are decoded: a message of the types below ends with a fixed number of doubles
(in NavSatFix, a byte follows them), whatever precedes them, and has the stamp at byte 4, both in
ROS 1's serialisation and in CDR. This is fast and needs no type definitions, which older `.db3`
files lack.

Time is the header's stamp, or the bag's time if a driver left all stamps zero. Poses are assumed to
be those of the IMU in a world with z up; `stario inspect` reports if they are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from posixpath import commonpath
from typing import Any

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.lazy import optional_package
from stario.sequences.readers import checked
from stario.sequences.readers.clocks import Samples, resample_to_gyro
from stario.sequences.readers.phones.attitude import agreeing_attitude, device_attitude
from stario.sequences.readers.text import first_bytes, seconds
from stario.sequences.sequence import ImuSequence
from stario.sequences.units import MAGNETIC_UNITS

_IMU = "sensor_msgs/msg/Imu"
_MAGNETIC = "sensor_msgs/msg/MagneticField"
_PRESSURE, _SATELLITES = "sensor_msgs/msg/FluidPressure", "sensor_msgs/msg/NavSatFix"
_OTHERS = (_MAGNETIC, _PRESSURE, _SATELLITES)
_APART = "accelerometer"
"""Key of a force that has a topic of its own, as RealSense writes it."""
_DOUBLES = {
    _IMU: 37,  # orientation, gyroscope and accelerometer, each with its covariance
    _MAGNETIC: 12,  # the field [T] and its covariance
    _PRESSURE: 2,  # the pressure [Pa] and its variance
    _SATELLITES: 12,  # latitude, longitude [deg], altitude [m], covariance east, north, up [m^2]
    "geometry_msgs/msg/PoseStamped": 7,  # position xyz, quaternion xyzw
    "geometry_msgs/msg/TransformStamped": 7,
    "geometry_msgs/msg/PoseWithCovarianceStamped": 7 + 36,
    "nav_msgs/msg/Odometry": 7 + 36 + 6 + 36,
}
_ORIENTATION, _GYRO, _ACCEL = slice(0, 4), slice(13, 16), slice(25, 28)
_STAMP = slice(4, 12)

_MEND = (
    "is the download complete? `rosbag reindex`, `ros2 bag reindex` or `mcap recover` mend the bag "
    "of a recorder that was killed"
)

NO_TRUTH = "none"
"""Value of `truth_topic` that disables ground truth."""


def read_bag(path: Path, imu_topic: str = "", truth_topic: str = "") -> ImuSequence:
    """Read a bag.

    Args:
        path: a `.bag`, `.mcap` or `.db3` file, or a rosbag2 folder.
        imu_topic: a topic with sensor_msgs/Imu; optional if there is only one.
        truth_topic: a topic with PoseStamped, PoseWithCovarianceStamped, Odometry or
            TransformStamped; optional if there is one or none, "none" to read no ground truth.

    Raises:
        ReadError: the bag is damaged, a topic is missing, or several match and none was named.
        InputError: rosbags is not installed.
    """
    messages = _messages(path, imu_topic, truth_topic)
    imu = messages.pop(_IMU)
    gyro = Samples(imu.stamps_ns, imu.values[:, _GYRO])
    stamps, rate, force = gyro.stamps_ns, gyro.values, imu.values[:, _ACCEL]
    parts = dict[str, Any]()
    if (apart := messages.pop(_APART, None)) is not None:
        accel = Samples(apart.stamps_ns, apart.values[:, _ACCEL])
        stamps, rate, force, parts["alone_s"] = resample_to_gyro(path, gyro, accel)
    start_ns = stamps[0]
    for kind, others in messages.items():
        time, values, topic = others.seconds(start_ns), others.values, others.topic
        if kind == _MAGNETIC:
            parts["magnetometer"] = checked.magnetometer(time, values[:, :3] * MAGNETIC_UNITS["T"])
        elif kind == _PRESSURE:
            parts["barometer"] = checked.barometer(path, topic, time, values[:, 0], "Pa")
        elif kind == _SATELLITES:
            variance = 0.5 * (values[:, 3] + values[:, 7])  # zero if unknown
            radius = checked.RADIUS_PER_SIGMA * np.sqrt(np.maximum(variance, 0.0))
            rest = {"altitude_m": values[:, 2], "radius_m": radius}
            parts["satellites"] = checked.satellites(time, values[:, :2], rest)
        else:
            rows = checked.finite_rows(path, topic, values[:, :7])
            field, quat = f"{topic}, quaternion", values[rows, 3:7]
            attitude_WB = checked.rotations(path, field, quat, "xyzw", rows)
            parts["truth"] = checked.trajectory(path, time[rows], values[rows, :3], attitude_WB)
    own = agreeing_attitude(imu.stamps_ns, imu.values[:, _ORIENTATION], gyro)
    attitude, time = device_attitude(own, start_ns), seconds(stamps, start_ns)
    return ImuSequence(path.resolve().stem, time, rate, force, device_attitude=attitude, **parts)


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag, by its first bytes or its folder's `metadata.yaml`."""
    if path.is_dir():
        return b"rosbag2_bagfile_information" in first_bytes(path / "metadata.yaml", 200)
    head = first_bytes(path)
    return head.startswith((b"#ROSBAG V2", b"\x89MCAP0\r\n")) or (
        path.suffix == ".db3" and head.startswith(b"SQLite format 3")
    )


@dataclass(frozen=True, kw_only=True)
class _Messages(Samples):
    """A topic's messages: the doubles at their ends (N, K)."""

    topic: str


def _messages(path: Path, imu_topic: str, truth_topic: str) -> dict[str, _Messages]:
    """Return the messages of the IMU and, if present, ground truth and other sensors, by type."""
    version = "1" if first_bytes(path).startswith(b"#ROSBAG") else "2"
    reader_type: Any = optional_package(f"rosbags.rosbag{version}", "bags").Reader
    try:
        with reader_type(path) as reader:
            topics = {c.topic: c.msgtype for c in reader.connections if c.msgcount}
            imus = _imu_topics(path, topics, imu_topic)
            chosen = imus + _truth_topic(path, topics, truth_topic)
            for kind in _OTHERS:
                chosen += _nearest_topic(topics, kind, chosen[0])
            connections = [c for c in reader.connections if c.topic in chosen]
            received: dict[str, list[tuple[int, bytes]]] = {topic: [] for topic in chosen}
            for connection, time, raw in reader.messages(connections):
                received[connection.topic].append((time, bytes(raw)))
        little_endian = version == "1"
        decoded = [_decoded(path, t, topics[t], received[t], little_endian) for t in chosen]
        kinds = [_APART if topic in imus[1:] else topics[topic] for topic in chosen]
        return dict(zip(kinds, decoded, strict=True))
    except ReadError:
        raise
    except Exception as error:  # any error of the library means a damaged file
        found = " ".join(f"{type(error).__name__} {error}".split())[:120]
        raise ReadError(path, "file", found, "an intact bag", _MEND) from None


def _imu_topics(path: Path, topics: dict[str, str], wanted: str) -> list[str]:
    """Return the IMU's topic, or those of gyroscope and accelerometer if there is one of each."""
    imus = [topic for topic, kind in topics.items() if kind == _IMU]
    if len(imus) == 2 and not wanted:
        pair = [next((t for t in imus if word in t.lower()), "") for word in ("gyro", "accel")]
        if set(pair) == set(imus):
            return pair
    candidates = _named(path, "imu topic", wanted, sorted(imus))
    if len(candidates) != 1:
        others = [f"{t} ({k.split('/')[-1]})" for t, k in topics.items()][:8]
        found = ", ".join(candidates or others)
        fix = f"name one: --imu-topic {candidates[0]}" if candidates else ""
        raise ReadError(path, "topics", found or "none", "one topic with sensor_msgs/Imu", fix)
    return candidates


def _truth_topic(path: Path, topics: dict[str, str], wanted: str) -> list[str]:
    if wanted == NO_TRUTH:
        return []
    sensors = (_IMU, *_OTHERS)
    poses = [t for t, k in sorted(topics.items()) if k in _DOUBLES and k not in sensors]
    candidates = _named(path, "truth topic", wanted, poses)
    if len(candidates) > 1:
        fix = f"name one: --truth-topic {candidates[0]}, or --truth-topic {NO_TRUTH}"
        raise ReadError(path, "topics", ", ".join(candidates), "one topic with poses", fix)
    return candidates


def _nearest_topic(topics: dict[str, str], wanted: str, imu_topic: str) -> list[str]:
    """Return the topic of a kind of sensor; of several, the one nearest to the IMU's by name."""
    candidates = [topic for topic, kind in sorted(topics.items()) if kind == wanted]
    shared = [len(commonpath([f"/{imu_topic}", f"/{topic}"])) for topic in candidates]
    return [candidates[shared.index(max(shared))]] if candidates else []


def _named(path: Path, field: str, wanted: str, candidates: list[str]) -> list[str]:
    """Return the candidate that the user wants, or all of them."""
    if wanted and wanted not in candidates:
        known = f"one of {', '.join(candidates) or '(none in this bag)'}"
        raise ReadError(path, field, repr(wanted), known)
    return [wanted] if wanted else candidates


def _decoded(
    path: Path, topic: str, kind: str, received: list[tuple[int, bytes]], little_endian: bool
) -> _Messages:
    """Return the stamps and doubles of messages; CDR states its byte order in the second byte."""
    raws = [raw for _, raw in received]
    size = 8 * _DOUBLES[kind]
    shortest = min(map(len, raws), default=0)
    if shortest < _STAMP.stop + size:
        raise ReadError(path, topic, f"a message of {shortest} bytes", f"a complete {kind}")
    endian = "<" if little_endian or raws[0][1] & 1 else ">"
    times = np.frombuffer(b"".join(raw[_STAMP] for raw in raws), f"{endian}u4").reshape(-1, 2)
    stamps = times.astype(np.int64) @ np.array([10**9, 1])
    if not stamps.any():
        stamps = np.array([time for time, _ in received], dtype=np.int64)
    # A NavSatFix ends with a byte; ROS 2 aligns doubles to eight after a head of four bytes.
    after = 0 if kind != _SATELLITES else 1 if little_endian else (len(raws[0]) - 4) % 8
    parts = [raw[len(raw) - after - size : len(raw) - after] for raw in raws]
    doubles = np.frombuffer(b"".join(parts), f"{endian}f8")
    values = doubles.astype(np.float64).reshape(-1, _DOUBLES[kind])
    if kind != _IMU:  # whose order is reported and mended for all formats
        order = np.argsort(stamps, kind="stable")
        stamps, values = stamps[order], values[order]
    return _Messages(stamps, values, topic=topic)
