"""Writers of phone apps' exports, with their own spelling.

Each imitates an app's file names, headers, units and conventions; the walk is simulated, so that
values, signs and axes are known.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from phone_files import field, gravity, ns, save, zyx
from scipy.spatial.transform import Rotation

from stario.sequences import ImuSequence
from stario.sequences.sequence import STANDARD_GRAVITY

Y_UP = Rotation.from_euler("x", -90.0, degrees=True)


def sensor_logger(folder: Path, walk: ImuSequence) -> None:
    """Columns z, y, x; a linear acceleration that must not be mistaken for the total one."""
    zyx(
        folder, walk, TotalAcceleration=walk.accel, Accelerometer=walk.accel - gravity(walk),
        Gyroscope=walk.gyro, GyroscopeUncalibrated=walk.gyro + 1.0,
        Magnetometer=field(walk), MagnetometerUncalibrated=field(walk) + 99,
    )  # fmt: skip
    save(folder / "Metadata.csv", "version,device name,platform", [["3", "Pixel 8", "android"]])
    save(folder / "Annotation.csv", "time,seconds_elapsed,text", ns(walk)[:2], [[0.1, 2], [0.2, 3]])


def sensor_logger_ios(folder: Path, walk: ImuSequence) -> None:
    """No total acceleration, Apple's sign."""
    zyx(
        folder, walk, Accelerometer=gravity(walk) - walk.accel, Gravity=-gravity(walk),
        Gyroscope=walk.gyro, Magnetometer=field(walk),
    )  # fmt: skip
    header = "version,device name,platform,standardisation"
    save(folder / "Metadata.csv", header, [["3", "iPhone 14", "ios", "false"]])


def sensor_logger_attitude(folder: Path, walk: ImuSequence) -> None:
    """The same without metadata: the phone's own attitude determines the sign."""
    sensor_logger_ios(folder, walk)
    (folder / "Metadata.csv").unlink()
    header = "time,seconds_elapsed,qz,qy,qx,qw,roll,pitch,yaw"
    columns = walk.time, walk.truth.quat_xyzw[:, [2, 1, 0, 3]], np.zeros((len(walk), 3))
    save(folder / "Orientation.csv", header, ns(walk), *columns)


def phyphox(folder: Path, walk: ImuSequence) -> None:
    """Semicolons and decimal commas, as exported for a German spreadsheet."""
    for name, unit, values in (
        ("Accelerometer", "m/s^2", walk.accel), ("Gyroscope", "rad/s", walk.gyro),
        ("Magnetometer", "µT", field(walk)),
        ("Linear Accelerometer", "m/s^2", walk.accel - gravity(walk)),
    ):  # fmt: skip
        header = f'"Time (s)";"X ({unit})";"Y ({unit})";"Z ({unit})"'
        save(folder / f"{name}.csv", header, walk.time, values, sep=";", decimal=",")
    save(folder / "meta/time.csv", '"event","experiment time"', [["START", 0.0]])


def senslogs_ios(folder: Path, walk: ImuSequence) -> None:
    """No header; g and Apple's sign without any mention; attitude with w first."""
    t = 55687.0 + walk.time
    save(folder / "accelerometer.txt", "", t, -walk.accel / STANDARD_GRAVITY, sep=" ")
    save(folder / "gyroscope.txt", "", t, walk.gyro, sep=" ")
    save(folder / "magnetometer.txt", "", t, field(walk) + 200.0, sep=" ")
    accuracy = np.full(len(walk), 2)
    save(folder / "magnetometer-calibrated.txt", "", t, field(walk), accuracy, sep=" ")
    save(folder / "attitude.txt", "", t, walk.truth.quat_xyzw[:, [3, 0, 1, 2]], sep=" ")


def senslogs_android(folder: Path, walk: ImuSequence) -> None:
    """Only uncalibrated rows, each followed by the bias that the phone estimates."""
    for name, values, bias in (("gyroscope", walk.gyro, 0.02), ("magnetometer", field(walk), 60.0)):
        biases = np.tile([bias, -bias, 2.0 * bias], (len(walk), 1))
        save(folder / f"{name}.txt", "", walk.time, values + biases, biases, sep=" ")
    save(folder / "accelerometer.txt", "", walk.time, walk.accel, sep=" ")


def two_clocks(folder: Path, walk: ImuSequence) -> None:
    """The app's milliseconds next to the sensor's nanoseconds."""
    millis = (1_539_940_408_606 + np.round(1e3 * walk.time)).astype(np.int64)
    for name, values in (("Accelerometer", walk.accel), ("Gyroscope", walk.gyro),
                         ("MagneticField", field(walk))):  # fmt: skip
        save(folder / f"{name}.csv", "timeMillis,timeNanos,x,y,z", millis, ns(walk), values)


def prefixed(folder: Path, walk: ImuSequence) -> None:
    """Milliseconds in scientific notation, no header."""
    for name, values in (("acc", walk.accel), ("gyr", walk.gyro), ("mag", field(walk))):
        rows = np.column_stack([1.606391908305e12 + 1e3 * walk.time, values])
        folder.mkdir(exist_ok=True)
        np.savetxt(folder / f"Eight_{name}.csv", rows)


def androsensor(folder: Path, walk: ImuSequence) -> None:
    names = (("ACCELEROMETER", "m/s²"), ("GRAVITY", "m/s²"), ("LINEAR ACCELERATION", "m/s²"),
             ("GYROSCOPE", "rad/s"), ("MAGNETIC FIELD", "μT"))  # fmt: skip
    header = ";".join(f"{name} {axis} ({unit})" for name, unit in names for axis in "XYZ")
    header += ";ORIENTATION Z (azimuth °);Time since start in ms ;YYYY-MO-DD HH-MI-SS_SSS"
    clock = ["2015-10-30 10:13:40:921"] * len(walk)
    linear = walk.accel - gravity(walk)
    forces = walk.accel, gravity(walk), linear
    rest = walk.gyro, field(walk), np.zeros(len(walk)), np.round(1e3 * walk.time).astype(int)
    save(folder / "log_AndroSensor.csv", header, *forces, *rest, clock, sep=";")


def physics_toolbox(folder: Path, walk: ImuSequence) -> None:
    """`ax` is the linear acceleration; the specific force is `gFx` in g."""
    header = "time,gFx,gFy,gFz,ax,ay,az,wx,wy,wz,Bx,By,Bz"
    columns = [walk.accel / STANDARD_GRAVITY, walk.accel - gravity(walk), walk.gyro, field(walk)]
    save(folder / "toolbox.csv", header, walk.time, *columns)


def sensor_log(folder: Path, walk: ImuSequence) -> None:
    """An iPhone app's wide file: g, Apple's sign, text among the columns."""
    header = (
        "loggingTime(txt),loggingSample(N),identifierForVendor(txt),"
        "accelerometerTimestamp_sinceReboot(s),accelerometerAccelerationX(G),"
        "accelerometerAccelerationY(G),accelerometerAccelerationZ(G),gyroTimestamp_sinceReboot(s),"
        "gyroRotationX(rad/s),gyroRotationY(rad/s),gyroRotationZ(rad/s),magnetometerX(µT),"
        "magnetometerY(µT),magnetometerZ(µT),motionYaw(rad),motionUserAccelerationX(G),"
        "motionUserAccelerationY(G),motionUserAccelerationZ(G),motionRotationRateX(rad/s),"
        "motionRotationRateY(rad/s),motionRotationRateZ(rad/s),motionQuaternionX(R),"
        "motionQuaternionY(R),motionQuaternionZ(R),motionQuaternionW(R),label(N)"
    )
    n, t = len(walk), 55_687.0 + walk.time
    linear = -(walk.accel - gravity(walk)) / STANDARD_GRAVITY
    save(
        folder / "my_iOS_device.csv", header, ["2020-01-01 10:00:00.123 +0100"] * n, np.arange(n),
        ["A-B"] * n, t, -walk.accel / STANDARD_GRAVITY, t, walk.gyro, field(walk), np.zeros(n),
        linear, walk.gyro + 0.001, walk.truth.quat_xyzw, np.zeros(n, dtype=int),
    )  # fmt: skip


def raw_g_iphone(folder: Path, walk: ImuSequence) -> None:
    """ADVIO's layout, in g."""
    for name, values in (("accelerometer", -walk.accel / STANDARD_GRAVITY), ("gyro", walk.gyro),
                         ("magnetometer", field(walk))):  # fmt: skip
        save(folder / f"advio-01/iphone/{name}.csv", "", walk.time, values)
    poses = np.hstack(
        [Y_UP.apply(walk.truth.position_W), (Y_UP * walk.truth.attitude_WB).as_quat()]
    )
    save(folder / "advio-01/ground-truth/pose.csv", "", walk.time, poses[:, [0, 1, 2, 6, 3, 4, 5]])


def trace(folder: Path, walk: ImuSequence) -> None:
    """Lines by type, with waypoints; one line break is missing."""
    lines = ["#\tstartTime:1560828400000"]
    for k, t in enumerate(walk.time.tolist()):
        stamp = 1_560_828_400_000 + round(1e3 * t)
        for kind, values in (("ACCELEROMETER", walk.accel), ("GYROSCOPE", walk.gyro),
                             ("MAGNETIC_FIELD", field(walk))):  # fmt: skip
            lines.append("\t".join([str(stamp), f"TYPE_{kind}", *map(str, values[k]), "3"]))
        if k in (200, 700):
            lines.append(f"{stamp}\tTYPE_WAYPOINT\t{k}.5\t7.25")
    folder.mkdir()
    text = "\n".join(lines)
    (folder / "5d07.txt").write_text(text.replace("\t3\n", "\t3", 1))


def get_sensor_data(folder: Path, walk: ImuSequence) -> None:
    lines = ["% LogFile created by the 'GetSensorData' App"]
    for k, t in enumerate(walk.time.tolist()):
        for code, values in (("ACCE", walk.accel), ("GYRO", walk.gyro), ("MAGN", field(walk))):
            lines.append(";".join([code, f"{t + 5.0:.3f}", f"{t:.4f}", *map(str, values[k]), "3"]))
    for t in (5.5, 6.5):
        lines.append(f"PRES;{t};{t + 900.0};{1013.0 + 0.01 * t};3")
        lines.append(f"GNSS;{t + 0.25};1690000000.0;40.0;-3.0;{t};90.0;4.5;1.25;9;0")
    lines.append("POSI;7.000;1;40.0;-3.0;0;0")
    lines.append("POSI;9.000;2;40.0001;-3.0;-1;0")
    folder.mkdir()
    (folder / "log.txt").write_text("\n".join(lines) + "\n")


APPS: dict[str, Callable[[Path, ImuSequence], None]] = {
    write.__name__: write
    for write in (
        sensor_logger, sensor_logger_ios, sensor_logger_attitude, phyphox, senslogs_ios,
        senslogs_android, sensor_log, raw_g_iphone, two_clocks, prefixed, androsensor,
        physics_toolbox, trace, get_sensor_data,
    )
}  # fmt: skip
