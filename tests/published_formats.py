"""Writers of every published format for simulated walks: names, orders, units and quirks."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences.attitude.rotations import about_z
from stario.sequences.readers.checked import trajectory
from stario.sequences.sequence import FloatArray, ImuSequence, Magnetometer, Trajectory
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk

START_NS = 1520531124153717567
"""A start time that float64 cannot represent: its rounding error is up to 128 ns."""

Y_UP = Rotation.from_euler("x", -90.0, degrees=True)
"""Rotation from a world with z up to ARCore's with y up."""

FIELD_W = np.array([18.0, 5.0, -43.0])
"""Uniform magnetic field [uT]."""

GYRO_BIAS, ACCEL_BIAS = np.array([0.01, -0.02, 0.005]), np.array([0.1, 0.05, -0.2])


@dataclass(frozen=True)
class Written:
    """A recording written by a test: its path and what a reader must return."""

    path: Path
    expected: ImuSequence


Writer = Callable[[Path, ImuSequence], Written]


def walk_of(rate: float, seconds: float, carry: str = "handheld") -> ImuSequence:
    style = WalkStyle(carry=carry, preferred_speed=1.0, mount_rotvec=(0.3, -0.5, 0.4))
    return simulate_imu(generate_walk(4, seconds, style=style), rate, PERFECT_IMU)


def cut(walk: ImuSequence, rows: slice) -> ImuSequence:
    """Part of a walk as a reader returns it, with time starting at its first row."""
    truth, time = walk.truth, walk.time[rows] - walk.time[rows][0]
    return ImuSequence(
        name=walk.name,
        time=time,
        gyro=walk.gyro[rows],
        accel=walk.accel[rows],
        truth=trajectory(Path(), time, truth.position_W[rows], truth.attitude_WB[rows]),
        magnetometer=Magnetometer(time, field_of(walk)[rows]),
    )


def field_of(walk: ImuSequence) -> FloatArray:
    return np.asarray(walk.truth.attitude_WB.apply(FIELD_W, inverse=True))


def wxyz(rotation: Rotation) -> FloatArray:
    return np.asarray(rotation.as_quat()[..., [3, 0, 1, 2]])


def stamps_ns(time: FloatArray, start: int = START_NS) -> list[int]:
    return [start + round(t * 1e9) for t in time.tolist()]


def text(*columns: list[int] | list[str] | FloatArray, sep: str = ",") -> list[str]:
    """Rows with all digits of a float64."""
    parts = [
        [str(x) for x in column]
        if isinstance(column, list)
        else [sep.join(map(repr, row)) for row in column.reshape(len(column), -1).tolist()]
        for column in columns
    ]
    return [sep.join(row) for row in zip(*parts, strict=True)]


def save(path: Path, header: str, rows: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *rows] if header else rows) + "\n")


def names(stem: str, axes: str = "xyz") -> str:
    return ",".join(f"{stem}_{axis}" for axis in axes)


def euroc(folder: Path, walk: ImuSequence, velocity: bool = True) -> Written:
    """EuRoC's layout, or TUM-VI's without velocity: truth at half the rate, not from the start."""
    truth, rows = walk.truth, slice(40, -60, 2)
    axes = [f"{s}_RS_S_{axis} [{unit}]" for s, unit in (("w", "rad s^-1"), ("a", "m s^-2"))
            for axis in "xyz"]  # fmt: skip
    header = ",".join(["#timestamp [ns]", *axes])
    samples = text(stamps_ns(walk.time), walk.gyro, walk.accel)
    save(folder / "mav0/imu0/data.csv", header, samples)
    columns = [truth.position_W, wxyz(truth.attitude_WB), *([truth.velocity_W] * velocity)]
    header = "#timestamp, p_RS_R_x [m], ..." + ", v_RS_R_x [m s^-1]" * velocity
    poses = text(stamps_ns(truth.time[rows]), *(values[rows] for values in columns))
    name = "state_groundtruth_estimate0" if velocity else "mocap0"
    save(folder / f"mav0/{name}/data.csv", header, poses)
    known = Trajectory(truth.time[rows], truth.position_W[rows], truth.attitude_WB[rows],
                       truth.velocity_W[rows] if velocity else None)  # fmt: skip
    expected = replace(cut(walk, slice(None)), name=folder.name, truth=known, magnetometer=None)
    return Written(folder, expected)


def tumvi(folder: Path, walk: ImuSequence) -> Written:
    return euroc(folder, walk, velocity=False)


def ronin(folder: Path, walk: ImuSequence, **info: object) -> Written:
    h5py = pytest.importorskip("h5py")
    folder.mkdir(parents=True, exist_ok=True)
    truth, start = walk.truth, 100
    R_TB = Rotation.from_euler("zyx", [170.0, 5.0, -3.0], degrees=True)
    scale = np.array([0.998, 0.997, 0.993])
    drift = Rotation.from_rotvec(np.outer(walk.time, [0.0, 0.0, 0.01]))
    with h5py.File(folder / "data.hdf5", "w") as data:
        data["synced/time"] = 3610.94 + walk.time
        data["synced/gyro_uncalib"] = walk.gyro + GYRO_BIAS
        data["synced/gyro"] = walk.gyro
        data["synced/acce"] = walk.accel / scale + ACCEL_BIAS
        data["synced/magnet"] = field_of(walk)
        data["synced/game_rv"] = wxyz(about_z(0.7) * truth.attitude_WB)
        data["pose/tango_pos"] = truth.position_W
        data["pose/tango_ori"] = wxyz(truth.attitude_WB * R_TB.inv())
        data["pose/ekf_ori"] = wxyz(about_z(-0.4) * drift * truth.attitude_WB)
    fields = {
        "imu_init_gyro_bias": GYRO_BIAS.tolist(),
        "imu_acce_scale": scale.tolist(),
        "imu_acce_bias": ACCEL_BIAS.tolist(),
        "start_calibration": wxyz(R_TB).tolist(),
        "start_frame": start,
        "device": "pixel",
        "gyro_integration_error": 12.0,
        "grv_ori_error": 8.0,
        "ekf_ori_error": 3.0,
    }
    (folder / "info.json").write_text(json.dumps(fields | info))
    return Written(folder, replace(cut(walk, slice(start, None)), name=folder.name))


def pandas_table(folder: Path, walk: ImuSequence, ori: Rotation, rv: Rotation) -> Path:
    """RIDI's columns as pandas writes them, with an unnamed index."""
    truth = walk.truth
    header = ",time," + ",".join(map(names, ("gyro", "acce", "linacce", "grav", "magnet", "pos")))
    header += f",{names('ori', 'wxyz')},{names('rv', 'wxyz')}"
    other = np.hstack([np.zeros((len(walk), 6)), field_of(walk)])
    rows = text(
        list(range(len(walk))), stamps_ns(walk.time), walk.gyro, walk.accel, other,
        truth.position_W, wxyz(ori), wxyz(rv),
    )  # fmt: skip
    save(folder / "processed/data.csv", header, rows)
    return folder / "processed/data.csv"


def ridi(folder: Path, walk: ImuSequence) -> Written:
    attitude_WB = walk.truth.attitude_WB
    pandas_table(folder, walk, attitude_WB, about_z(1.2) * attitude_WB)
    return Written(folder, replace(cut(walk, slice(None)), name=folder.name))


def imunet(folder: Path, walk: ImuSequence) -> Written:
    """Positions are z-up as converted by its authors; attitudes remain in ARCore's world."""
    attitude_WB = walk.truth.attitude_WB
    pandas_table(folder, walk, Y_UP * attitude_WB, about_z(1.2) * attitude_WB)
    return Written(folder, replace(cut(walk, slice(None)), name=folder.name))


def imunet_raw(folder: Path, walk: ImuSequence, world: Rotation = Y_UP) -> Written:
    """Each sensor over its own time span; the pose at about 30 Hz in a world with y up."""
    truth, poses = walk.truth, slice(21, -30, 7)
    quat = (about_z(1.2) * truth.attitude_WB).as_quat()
    pose = np.hstack([world.apply(truth.position_W), (world * truth.attitude_WB).as_quat()])
    for name, values, rows in (
        ("gyro", walk.gyro, slice(5, -10)),
        ("acce", walk.accel, slice(8, -12)),
        ("orientation", quat, slice(0, None)),
        ("pose", pose, poses),
        ("magnet", field_of(walk), slice(11, None, 4)),
    ):
        stamps = stamps_ns(walk.time[rows])
        save(folder / f"{name}.txt", f"# {name}", text(stamps, values[rows], sep=" "))
    expected = cut(walk, slice(8, -12))
    time = truth.time[poses] - truth.time[8]
    known = trajectory(Path(), time, truth.position_W[poses], truth.attitude_WB[poses])
    magnetic = slice(11, None, 4)
    field = Magnetometer(walk.time[magnetic] - walk.time[8], field_of(walk)[magnetic])
    expected = replace(expected, name=folder.name, truth=known, magnetometer=field)
    return Written(folder, expected)


def rnin(folder: Path, walk: ImuSequence, captured: bool = True) -> Written:
    truth, count = walk.truth, len(walk)
    away = about_z(2.0)
    bias = np.linspace(0.0, 1.0, count)[:, None]
    good = np.hstack([wxyz(truth.attitude_WB), truth.position_W])
    other = np.hstack([wxyz(away * truth.attitude_WB), away.apply(truth.position_W) + 1.0])
    none = np.tile([1.0, 0, 0, 0, 0, 0, 0], (count, 1))
    gt, vio = (good, other) if captured else (none, good)
    header = f"times,{names('gyro')},{names('acce')},{names('vio_gyro_bias')}"
    header += f",{names('vio_acce_bias')},{names('vio_q', 'wxyz')},{names('vio_p')}"
    header += f",{names('gt_q', 'wxyz')},{names('gt_p')},{names('mag')}"
    rows = text(
        10.5 + walk.time, walk.gyro + GYRO_BIAS, walk.accel + ACCEL_BIAS,
        bias * GYRO_BIAS, bias * ACCEL_BIAS, vio, gt, field_of(walk),
    )  # fmt: skip
    save(folder / "data_train/12/SenseINS.csv", header, rows)
    expected = replace(cut(walk, slice(None)), name="data_train-12")
    return Written(folder / "data_train/12", expected)


def tlio(folder: Path, walk: ImuSequence, order: str = "xyzw") -> Written:
    truth = walk.truth
    quat = truth.quat_xyzw if order == "xyzw" else wxyz(truth.attitude_WB)
    R_WB = truth.attitude_WB
    table = np.hstack([
        3.6e9 + walk.time[:, None] * 1e6, R_WB.apply(walk.gyro), R_WB.apply(walk.accel),
        quat, truth.position_W, truth.velocity_W,
    ])  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "imu0_resampled.npy", table)
    columns = [
        "ts_us(1)", "gyr_compensated_rotated_in_World(3)", "acc_compensated_rotated_in_World(3)",
        f"q{order}_World_Device(4)", "pos_World_Device(3)", "vel_World(3)",
    ]  # fmt: skip
    description = {"columns_name(width)": columns, "num_rows": len(walk)}
    (folder / "imu0_resampled_description.json").write_text(json.dumps(description))
    expected = cut(walk, slice(None))
    known = replace(expected.truth, velocity_W=truth.velocity_W)
    expected = replace(expected, name=folder.name, magnetometer=None, truth=known)
    return Written(folder, expected)


def tlio_raw(
    folder: Path, walk: ImuSequence, R_DI: Rotation | None = None, every: int = 5
) -> Written:
    """Raw samples with a calibration; the resampled pose of a device with the IMU turned in it."""
    mount = Rotation.identity() if R_DI is None else R_DI
    lever = np.zeros(3) if R_DI is None else np.array([0.01, 0.03, -0.02])
    truth = walk.truth
    R_WD = truth.attitude_WB * mount.inv()
    device = ImuSequence(
        "device", walk.time[::every], mount.apply(walk.gyro)[::every],
        mount.apply(walk.accel)[::every],
        Trajectory(
            truth.time[::every], (truth.position_W - R_WD.apply(lever))[::every],
            R_WD[::every], truth.velocity_W[::every],
        ),
    )  # fmt: skip
    tlio(folder, device)
    matrix = np.array([[1.01, 0.002, -0.001], [0.0, 0.99, 0.003], [0.0, 0.0, 1.005]])
    raw = [(values + bias) @ matrix.T for values, bias in (
        (walk.gyro, GYRO_BIAS), (walk.accel, ACCEL_BIAS))]  # fmt: skip
    header = "#timestamp [ns],temperature [degC],w_x,w_y,w_z,a_x,a_y,a_z"
    stamps = stamps_ns(walk.time, 3_600_000_000_000)
    save(folder / "imu_samples_0.csv", header, text(stamps, 25.0 + 0.0 * walk.time, *raw))
    model = {"Model": {"RectificationMatrix": matrix.tolist()}}
    quat = wxyz(Rotation.from_rotvec([0.5, 0, 0]) if R_DI is None else R_DI).tolist()
    calibration = {
        "Gyroscope": model | {"Bias": {"Offset": GYRO_BIAS.tolist()}},
        "Accelerometer": model | {"Bias": {"Offset": ACCEL_BIAS.tolist()}},
        "T_Device_Imu": {
            "Translation": lever.tolist(), "UnitQuaternion": [quat[0], quat[1:]],
        },
    }  # fmt: skip
    (folder / "calibration.json").write_text(json.dumps(calibration))
    rows = slice(None, None, every)
    known = trajectory(Path(), *(x[rows] for x in (
        truth.time, truth.position_W, truth.attitude_WB, truth.velocity_W)))  # fmt: skip
    expected = replace(walk, name=folder.name, truth=known)
    return Written(folder / "imu_samples_0.csv", expected)


def android(folder: Path, walk: ImuSequence) -> Written:
    """Files with headers; the gyroscope's begins and ends earlier; values in z, y, x order."""
    header = "time,seconds_elapsed,z,y,x"
    for name, values, rows in (
        ("Gyroscope", walk.gyro, slice(0, -20)),
        ("Accelerometer", walk.accel, slice(15, None)),
        ("Magnetometer", field_of(walk), slice(15, -20)),
    ):
        time = walk.time[rows]
        save(folder / f"{name}.csv", header, text(stamps_ns(time), time, values[rows, ::-1]))
    expected = replace(cut(walk, slice(15, -20)), name=folder.name, truth=None)
    return Written(folder, expected)


def bag_writer(version: str) -> Writer:
    def write(folder: Path, walk: ImuSequence) -> Written:
        folder.mkdir(parents=True, exist_ok=True)
        walk = walk.slice(0.0, 6.0)
        path = bag(folder / "walk", walk, version)
        return Written(path, replace(cut(walk, slice(None)), name="walk"))

    return write


def bag(
    path: Path,
    walk: ImuSequence,
    version: str = "ros1",
    imu_topics: tuple[str, ...] = ("/imu",),
    pose_topics: tuple[tuple[str, str], ...] = (("/odom", "nav_msgs/msg/Odometry"),),
    other_topics: tuple[tuple[str, str], ...] = (("/mag", "sensor_msgs/msg/MagneticField"),),
) -> Path:
    """Write a bag with Imu topics and poses in the storage `ros1`, `sqlite3` or `mcap`."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    ros1 = version == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    pack = store.serialize_ros1 if ros1 else store.serialize_cdr
    if ros1:
        path = path.with_suffix(".bag")
        writer = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if version == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    topics = {topic: "sensor_msgs/msg/Imu" for topic in imu_topics}
    topics |= dict([*pose_topics, *other_topics])
    fields = field_of(walk)
    with writer:
        joined = {
            topic: (kind, writer.add_connection(topic, kind, typestore=store))
            for topic, kind in topics.items()
        }
        for k, stamp in enumerate(stamps_ns(walk.time)):
            seconds, rest = divmod(stamp, 10**9)
            header = {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": "base"}
            for kind, connection in joined.values():
                values = ros_values(kind, walk, k, fields[k])
                message = ros_message(store, kind, {"header": header, **values})
                writer.write(connection, stamp, pack(message, kind))
    return path


def ros_values(kind: str, walk: ImuSequence, k: int, field: FloatArray) -> dict[str, Any]:
    """Fields of the kth message of a type, by name."""

    def named(values: FloatArray) -> dict[str, float]:
        return dict(zip("xyzw", values.tolist(), strict=False))

    truth = walk.truth
    place, attitude = named(truth.position_W[k]), named(truth.quat_xyzw[k])
    pose = {"position": place, "orientation": attitude}
    gyro, accel = named(walk.gyro[k]), named(walk.accel[k])
    position = {"latitude": 48.0, "longitude": 11.0 + 1e-5 * k, "altitude": 500.0}
    return {
        "Imu": {"orientation": attitude, "angular_velocity": gyro, "linear_acceleration": accel},
        "PoseStamped": {"pose": pose},
        "TransformStamped": {"transform": {"translation": place, "rotation": attitude}},
        "PoseWithCovarianceStamped": {"pose": {"pose": pose}},
        "Odometry": {"pose": {"pose": pose}},
        "MagneticField": {"magnetic_field": named(1e-6 * field)},
        "FluidPressure": {"fluid_pressure": 101_325.0 - k},
        "NavSatFix": {**position, "position_covariance": np.diag([9.0, 9.0, 25.0]).ravel()},
    }[kind.rsplit("/", 1)[1]]


def ros_message(store: Any, kind: str, values: dict[str, Any]) -> object:
    """A message with zeros in all fields that are not given."""
    from rosbags.interfaces import Nodetype

    fields: dict[str, object] = {}
    for name, (node, of) in store.fielddefs[kind][1]:
        if node == Nodetype.NAME:
            fields[name] = ros_message(store, of, values.get(name, {}))
        elif node == Nodetype.ARRAY:
            fields[name] = values.get(name, np.zeros(of[1]))
        else:
            fields[name] = values.get(name, "" if of[0] == "string" else 0)
    return store.types[kind](**fields)


WRITERS: dict[str, tuple[str, float, Writer]] = {
    "euroc": ("euroc", 200.0, euroc),
    "tumvi": ("euroc", 200.0, tumvi),
    "ronin": ("ronin", 200.0, ronin),
    "ridi": ("ridi", 200.0, ridi),
    "imunet": ("ridi", 200.0, imunet),
    "imunet raw": ("imunet", 200.0, imunet_raw),
    "rnin": ("rnin", 200.0, rnin),
    "tlio": ("tlio", 200.0, tlio),
    "tlio raw": ("tlio", 1000.0, tlio_raw),
    "phone": ("phone", 200.0, android),
    "bag ros1": ("bag", 200.0, bag_writer("ros1")),
    "bag sqlite3": ("bag", 200.0, bag_writer("sqlite3")),
    "bag mcap": ("bag", 200.0, bag_writer("mcap")),
}
"""Writers by name, each with the format to be recognised and the rate to simulate [Hz]."""
