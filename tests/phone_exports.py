"""Exports of phone apps and other loggers, with their own spelling.

Each imitates an app's file names, headers, units and conventions; the walk is simulated, so that
values, signs and axes are known. Most are lists of files: name, header and columns. In a header `*`
stands for X, Y and Z and `@` for x, y and z; one without titles is only the separator of the cells.
"""

import csv
import json
import zipfile
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences import ImuSequence
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray

FIELD_W = [18.0, 5.0, -43.0]
START_NS = 1_718_030_736_872_695_300
ZYX = "time,seconds_elapsed,z,y,x"
Y_UP = Rotation.from_euler("x", -90.0, degrees=True)


def in_body(walk: ImuSequence, vector_W: list[float]) -> FloatArray:
    return np.asarray(walk.truth.attitude_WB.apply(vector_W, inverse=True))


def field(walk: ImuSequence) -> FloatArray:
    return in_body(walk, FIELD_W)


def gravity(walk: ImuSequence) -> FloatArray:
    return in_body(walk, [0.0, 0.0, STANDARD_GRAVITY])


def ns(walk: ImuSequence) -> list[int]:
    return [START_NS + round(t * 1e9) for t in walk.time.tolist()]


def save(path: Path, header: str, *columns: object, sep: str = ",", decimal: str = ".") -> None:
    parts = [np.asarray(c).reshape(len(np.asarray(c)), -1).tolist() for c in columns]
    rows = [
        sep.join(str(x).replace(".", decimal) for part in row for x in part)
        for row in zip(*parts, strict=True)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *rows] if header else rows) + "\n", encoding="utf-8")


def save_zyx(folder: Path, walk: ImuSequence, **sensors: FloatArray) -> None:
    """Write one file for each sensor as Sensor Logger does, columns z, y, x."""
    for name, values in sensors.items():
        save(folder / f"{name}.csv", ZYX, ns(walk), walk.time, values[:, ::-1])


class Walk:
    """Columns of a walk: time `t` [s], `a`, `w`, gravity `g`, `lin` without it, `_g` in g."""

    def __init__(self, walk: ImuSequence) -> None:
        self.walk, self.t, self.a, self.w = walk, walk.time, walk.accel, walk.gyro
        self.g = gravity(walk)
        self.lin = self.a - self.g
        self.a_g, self.g_g, self.lin_g = (x / STANDARD_GRAVITY for x in (self.a, self.g, self.lin))
        self.w_deg = np.degrees(self.w)
        self.q_xyzw, self.q_wxyz = walk.truth.quat_xyzw, walk.truth.quat_xyzw[:, [3, 0, 1, 2]]
        self.ns, self.ms = np.array(ns(walk)), np.round(1e3 * self.t).astype(int)
        self.us, self.none = 1_000_000 + np.round(1e6 * self.t).astype(int), np.zeros_like(self.a)
        self.measures_field = False

    @property
    def rotation_vector(self) -> FloatArray:
        """x, y and z of a quaternion whose w is not negative."""
        return np.asarray(self.q_xyzw[:, :3] * np.sign(self.q_xyzw[:, 3:]))

    @property
    def m(self) -> FloatArray:
        self.measures_field = True
        return field(self.walk)

    def all(self, *cells: object) -> list[list[object]]:
        return [list(cells)] * len(self.t)

    def dates(self, form: str) -> list[list[str]]:
        """Dates and times of day, across midnight."""
        start = datetime(2024, 5, 1, 23, 59, 55)
        return [[(start + timedelta(seconds=t)).strftime(form)] for t in self.t.tolist()]


File = tuple[Any, ...]
Export = Callable[[Path, Walk], None]


def write(folder: Path, *files: File) -> None:
    for name, header, *columns in files:
        line = header.rsplit("\n", 1)[-1]
        sep = next((mark for mark in "\t;," if mark in line), " ")
        titles = [
            title.replace("*", axis).replace("@", axis.lower())
            for title in line.split(sep)
            for axis in ("XYZ" if {"*", "@"} & {*title} else "X")
        ]
        header = header.removesuffix(line) + ("" if line == sep else sep.join(titles))
        save(folder / name, header, *columns, sep=sep)


def alike(form: str, header: str, *times: object, **sensors: FloatArray) -> list[File]:
    """Files with the same header, called after the sensors: `{}` in their names."""
    return [(form.format(name), header, *times, values) for name, values in sensors.items()]


def zyx(w: Walk, **sensors: FloatArray) -> list[File]:
    backward = {name: values[:, ::-1] for name, values in sensors.items()}
    return alike("{}.csv", ZYX, w.ns, w.t, **backward)


def metadata(system: str, standardised: str = "") -> File:
    header = "version,device name,recording epoch time,platform,standardisation"
    return "Metadata.csv", header, [[3, '"Ana\'s phone, blue"', 17e11, system, standardised]]


def linear(w: Walk, sign: float = 1.0, **sensors: FloatArray) -> list[File]:
    """Files of a phone that logged gravity apart."""
    return zyx(w, Accelerometer=sign * w.lin, Gyroscope=w.w, **sensors)


_ANDROSENSOR = "ACCELEROMETER * (m/s²);GYROSCOPE * (rad/s);MAGNETIC FIELD * (μT);"
_WATCH = "time,seconds_elapsed,rotationRate*,gravity*,acceleration*,"
_WATCH += "quaternionX,quaternionY,quaternionZ,quaternionW"


def by_rows(names: str, header: str = "", form: str = "{:.4f}") -> Export:
    """A table whose rows name their sensors: gyroscope, accelerometer and magnetometer."""
    sep = ";" if ";" in header else ","

    def write_file(folder: Path, w: Walk) -> None:
        sensors = list(zip(names.split(), (w.w, w.a, w.m), strict=True))
        lines = [
            sep.join([form.format(t), name, *map(repr, values[k].tolist())])
            for k, t in enumerate(w.t.tolist())
            for name, values in sensors
        ]
        (folder / "own.csv").write_text("\n".join([header, *lines] if header else lines) + "\n")

    return write_file


_ANDROID = "android.sensor.gyroscope android.sensor.accelerometer android.sensor.magnetic_field"

EXPORTS: dict[str, Export] = {
    "rows_by_sensor": by_rows("gyroscope accelerometer magnetometer", "time,sensor,x,y,z"),
    "rows_by_short_names": by_rows("GYR ACC MAG", "timestamp;sensor_name;v_x;v_y;v_z"),
    "rows_without_titles": by_rows(_ANDROID),
    "rows_with_times_of_day": by_rows("gyro acc mag", "Clock time,sensor,x,y,z", "12:00:{:07.4f}"),
    "sensor_logger": lambda f, w: write(
        f, *zyx(w, TotalAcceleration=w.a, Accelerometer=w.lin, Gyroscope=w.w,
                GyroscopeUncalibrated=w.w + 1.0, Magnetometer=w.m,
                MagnetometerUncalibrated=w.m + 99.0), metadata("android"),
        ("Annotation.csv", "time,seconds_elapsed,text", w.ns[:2], [[0.1, "a, b"], [0.2, 3]]),
    ),
    "sensor_logger_ios": lambda f, w: write(
        f, *linear(w, -1.0, Gravity=-w.g, Magnetometer=w.m), metadata("ios", "false")
    ),
    # Without metadata: the phone's own attitude determines the sign.
    "sensor_logger_attitude": lambda f, w: write(
        f, *linear(w, -1.0, Gravity=-w.g, Magnetometer=w.m),
        ("Orientation.csv", "time,seconds_elapsed,qz,qy,qx,qw,roll,pitch,yaw", w.ns, w.t,
         w.q_xyzw[:, [2, 1, 0, 3]], w.none),
    ),
    "sensor_logger_standardised": lambda f, w: write(
        f, *linear(w, Gravity=w.g), metadata("ios", "true")
    ),
    # Gravity was not logged, but the raw accelerometer was, in g.
    "sensor_logger_uncalibrated": lambda f, w: write(
        f, *linear(w, -1.0, AccelerometerUncalibrated=-w.a_g), metadata("ios", "false")
    ),
    "sensor_logger_readable_times": lambda f, w: write(
        f, *alike("{}.csv", "time,human_readable_time,seconds_elapsed,@", w.ns,
                  w.all("2024-06-10 14:45:36.872"), w.t, TotalAcceleration=w.a, Gyroscope=w.w,
                  Magnetometer=w.m),
    ),
    # An Apple Watch only: everything in one file, in g and with Apple's sign.
    "sensor_logger_watch": lambda f, w: write(
        f, ("WristMotion.csv", _WATCH, w.ns, w.t, w.w, -w.g_g, -w.lin_g, w.q_xyzw)
    ),
    "phyphox_with_and_without_g": lambda f, w: write(
        f, *alike("Acceleration {} g.csv", '"Time (s)","* (m/s^2)"', w.t, **{"with": w.a},
                  without=w.lin),
        ("Gyroscope.csv", '"Time (s)","* (rad/s)"', w.t, w.w),
    ),
    # No header; g and Apple's sign without any mention; attitude with w first.
    "senslogs_ios": lambda f, w: write(
        f, *alike("{}.txt", " ", 55_687.0 + w.t, accelerometer=-w.a_g, gyroscope=w.w,
                  magnetometer=w.m + 200.0, attitude=w.q_wxyz),
        ("magnetometer-calibrated.txt", " ", 55_687.0 + w.t, w.m, w.all(2)),
    ),
    # Without its attitude; the description file indicates the operating system.
    "senslogs_ios_described": lambda f, w: write(
        f, *alike("{}.txt", " ", w.t, accelerometer=-w.a_g, gyroscope=w.w),
        ("description.txt", "[Time]", [["BootTime = 55687.0793"]]),
    ),
    # Only uncalibrated rows, each followed by the bias that the phone estimates.
    "senslogs_android": lambda f, w: write(
        f, ("accelerometer.txt", " ", w.t, w.a),
        *((f"{name}.txt", " ", w.t, values + bias, w.all(*bias)) for name, values, bias in (
            ("gyroscope", w.w, [0.02, -0.02, 0.04]), ("magnetometer", w.m, [60.0, -60.0, 120.0]))),
    ),
    # Text above the rows, two clocks, and the bias in separate columns.
    "senslogs_first_version": lambda f, w: write(
        f, *alike("{}.txt", "a.txt\n\nAll values are in SI units.\n\nelapsed-time-system "
                  "elapsed-time-sensor @", w.t + 0.003, w.t,
                  **{"accelerometer": w.a, "magnetometer-calibrated": w.m}),
        ("gyroscope.txt", "gyroscope.txt\n\nelapsed-time-system elapsed-time-sensor @ "
         "estimated-drift-@", w.t + 0.003, w.t, w.w + 0.01, w.all(0.01, 0.01, 0.01)),
    ),
    "two_clocks_and_no_header": lambda f, w: write(
        f, *alike("{}.txt", " ", w.t + 0.003, w.t, accelerometer=w.a, gyroscope=w.w,
                  magnetometer=w.m),
    ),
    # The app's milliseconds next to the sensor's nanoseconds.
    "two_clocks": lambda f, w: write(
        f, *alike("{}.csv", "timeMillis,timeNanos,@", 1_539_940_408_606 + w.ms, w.ns,
                  Accelerometer=w.a, Gyroscope=w.w, MagneticField=w.m),
    ),
    "time_behind_the_values": lambda f, w: write(
        f, ("accel.csv", ",", w.a, w.t), ("gyro.csv", ",", w.w, w.t)
    ),
    # Milliseconds in scientific notation, no header.
    "prefixed": lambda f, w: write(
        f, *alike("Eight_{}.csv", " ", [f"{x:.18e}" for x in 1.606391908305e12 + 1e3 * w.t],
                  acc=w.a, gyr=w.w, mag=w.m),
    ),
    "androsensor": lambda f, w: write(
        f, ("log_AndroSensor.csv", f"{_ANDROSENSOR}GRAVITY * (m/s²);LINEAR ACCELERATION * (m/s²);"
            "ORIENTATION Z (azimuth °);Time since start in ms ;YYYY-MO-DD HH-MI-SS_SSS", w.a, w.w,
            w.m, w.g, w.lin, w.all(0.0), w.ms, w.all("2015-10-30 10:13:40:921")),
    ),
    # Unit symbols decoded with another encoding and saved again, or lost.
    "androsensor_garbled": lambda f, w: write(
        f, ("a.csv", _ANDROSENSOR.replace("²", "Â²").replace("μ", "Î¼") + "Time since start in ms",
            w.a, w.w, w.m, w.ms),
    ),
    "androsensor_lost_symbols": lambda f, w: write(
        f, ("a.csv", _ANDROSENSOR.replace("²", "\ufffd").replace("μ", "\ufffd")
            + "Time since start in ms", w.a, w.w, w.m, w.ms),
    ),
    # `ax` is the linear acceleration; the specific force is `gFx` in g.
    "physics_toolbox": lambda f, w: write(
        f, ("toolbox.csv", "time,gF@,a@,w@,B@", w.t, w.a_g, w.lin, w.w, w.m)
    ),
    # An iPhone app's wide file: g, Apple's sign, text among the columns.
    "sensor_log": lambda f, w: write(
        f, ("my_iOS_device.csv", "loggingTime(txt),loggingSample(N),identifierForVendor(txt),"
            "accelerometerTimestamp_sinceReboot(s),accelerometerAcceleration*(G),"
            "gyroTimestamp_sinceReboot(s),gyroRotation*(rad/s),magnetometer*(µT),motionYaw(rad),"
            "motionUserAcceleration*(G),motionRotationRate*(rad/s),motionQuaternion*(R),"
            "motionQuaternionW(R),label(N)", w.all("2020-01-01 10:00:00.123 +0100", 1, "A-B"),
            55_687.0 + w.t, -w.a_g, 55_687.0 + w.t, w.w, w.m, w.all(0.0), -w.lin_g, w.w + 0.001,
            w.q_xyzw, w.all(0)),
    ),
    # The same without an attitude: columns as Core Motion names them tell the sign.
    "sensor_log_without_attitude": lambda f, w: write(
        f, ("a.csv", "loggingTime(txt),accelerometerAcceleration*(G),gyroRotation*(rad/s)",
            w.dates("%Y-%m-%d %H:%M:%S.%f +0200"), -w.a_g, w.w),
    ),
    # In g, Apple's sign; `Motion.txt` is the attitude, w first; `MotMagnFull` is calibrated.
    "ios_logger": lambda f, w: write(
        f, *alike("{}.txt", ",", 1.6e9 + w.t, Accel=-w.a_g, Gyro=w.w, Magnet=w.m + 300.0,
                  Motion=w.q_wxyz),
        ("MotMagnFull.txt", ",", 1.6e9 + w.t, w.m, w.all(2)),
        ("Frames.txt", ",", 1.6e9 + w.t, w.all(1, 1, 1, 1, 1)),
    ),
    "ios_logger_with_poses": lambda f, w: write(
        f, *alike("{}.txt", ",", 1.6e9 + w.t, Accel=-w.a_g, Gyro=w.w),
        ("ARposes.txt", ",", 1.6e9 + w.t, Y_UP.apply(w.walk.truth.position_W),
         (Y_UP * w.walk.truth.attitude_WB).as_quat()[:, [3, 0, 1, 2]]),
    ),
    # ADVIO's layout, in g.
    "raw_g_iphone": lambda f, w: write(
        f, *alike("advio-01/iphone/{}.csv", ",", w.t, accelerometer=-w.a_g, gyro=w.w,
                  magnetometer=w.m),
        ("advio-01/ground-truth/pose.csv", ",", w.t, Y_UP.apply(w.walk.truth.position_W),
         (Y_UP * w.walk.truth.attitude_WB).as_quat()[:, [3, 0, 1, 2]]),
    ),
    # A line for spreadsheets, units below the titles, and a tab at the end of each line.
    "shimmer": lambda f, w: write(
        f, ("a.csv", '"sep=\t"\n' + "\t".join(f"Shimmer_A_{name}_CAL" for name in (
            "Timestamp_Unix", *(f"{sensor}_{axis}" for sensor in ("Accel_LN", "Accel_WR", "Gyro")
                                for axis in "XYZ")))
            + "\t\nms\t" + "m/(s^2)\t" * 6 + "deg/s\t" * 3, 1.7e12 + 1e3 * w.t, w.a, w.a + 1.0,
            w.w_deg, w.all("")),
    ),
    "units_below_the_titles": lambda f, w: write(
        f, ("acc.csv", "time,x,y,z\n(us),(g),(g),(g)", w.us, w.a_g),
        ("gyr.csv", "time,x,y,z\n(us),(deg/s),(deg/s),(deg/s)", w.us, w.w_deg),
    ),
    "matlab_mobile": lambda f, w: write(  # names of months
        f, *alike("{}.csv", "Timestamp,*", w.dates("%d-%b-%Y %H:%M:%S.%f"), Acceleration=w.a,
                  AngularVelocity=w.w),
    ),
    "metawear": lambda f, w: write(
        f, *((f"MetaWear_C8_{name}.csv", f"epoc (ms),timestamp (+0200),elapsed (s),@-axis ({unit})",
              1_700_000_000_000 + w.ms, w.dates("%Y-%m-%dT%H.%M.%S.%f"), w.t, values)
             for name, unit, values in (("Accelerometer", "g", w.a_g),
                                        ("Gyroscope", "deg/s", w.w_deg))),
    ),
    "polar": lambda f, w: write(
        f, *((f"Polar_Sense_{name}.txt", f"Phone timestamp;sensor timestamp [ns];* [{unit}]",
              w.dates("%Y-%m-%dT%H:%M:%S.%f"), w.ns, values)
             for name, unit, values in (("ACC", "mg", 1e3 * w.a_g), ("GYRO", "dps", w.w_deg))),
    ),
    # Times of day; only the unit tells that `As` is the gyroscope.
    "witmotion": lambda f, w: write(
        f, ("a.txt", "time\tDeviceName\tAcc*(g)\tAs*(°/s)\tAngle*(°)", w.dates("%H:%M:%S.%f"),
            w.all("WT901"), w.a_g, w.w_deg, w.none),
    ),
    "vectornav": lambda f, w: write(
        f, ("vn.csv", "TimeStartup,Ypr*,Accel*,AngularRate*,Mag*", 1000 * w.us, w.none, w.a, w.w,
            w.m),
    ),
    "movella": lambda f, w: write(  # `FreeAcc` lacks gravity
        f, ("dot.csv", "sep=,\nDeviceTag:,Movella DOT 1\nOutputRate:,100Hz\n\nPacketCounter,"
            "SampleTimeFine,FreeAcc_*,Acc_*,Gyr_*", w.ms, w.us, w.lin, w.a, w.w),
    ),
    # Names of chips, which differ between the sensors of one phone.
    "hyperimu": lambda f, w: write(
        f, ("a.csv", "Timestamp,LSM6 Accelerometer.*,AK09918 Magnetometer.*,LSM6 Gyroscope.*,"
            "Linear Acc.*", w.ns, w.a, w.m, w.w, w.lin),
    ),
    # Milliseconds without a unit, dates next to them, and titles of no axis.
    "gopro": lambda f, w: write(
        f, *((f"GX010001-{name}.csv", f'"cts","date","{title}","1","2"', 1e3 * w.t,
              w.dates("%Y-%m-%dT%H:%M:%S.%fZ"), values)
             for name, title, values in (("ACCL", "Accelerometer [m/s2]", w.a),
                                         ("GYRO", "Gyroscope [rad/s]", w.w))),
    ),
    # The column of times is called like its unit.
    "microcontroller": lambda f, w: write(f, ("a.csv", "micros,a*,g*", w.us, w.a, w.w)),
    "date_and_time": lambda f, w: write(
        f, ("a.csv", "Date,Time,Acc *,Gyro *", w.dates("%d/%m/%Y"), w.dates("%I:%M:%S.%f %p"), w.a,
            w.w),
    ),
    "titles_in_a_comment": lambda f, w: write(
        f, ("imu.txt", "# time acc_@ gyr_@", w.t, w.a, w.w)
    ),
    # Ticks of 100 us, where Xsens' DOTs count microseconds.
    "xsens": lambda f, w: write(
        f, ("MT_0.txt", "// Update Rate: 100.0Hz\nPacketCounter\tSampleTimeFine\tAcc_*\tGyr_*",
            w.ms, w.us // 100, w.a, w.w),
    ),
    "xsens_utc": lambda f, w: write(  # without a date; the hour turns over
        f, ("MT_0.csv", "UTC_Nano,UTC_Minute,UTC_Second,Gyr_*,Acc_*", w.ns % 10**9,
            (3595 + (w.ns // 10**9 - w.ns[0] // 10**9)) // 60 % 60,
            (3595 + (w.ns // 10**9 - w.ns[0] // 10**9)) % 60, w.w, w.a),
    ),
    "seconds_and_nanoseconds": lambda f, w: write(
        f, ("a.csv", "sec,nanosec,gyro_@,accel_@", w.ns // 10**9, w.ns % 10**9, w.w, w.a)
    ),
    "ros2_topic_echo": lambda f, w: write(
        f, ("echo.csv", ",", w.ns // 10**9, w.ns % 10**9, w.all("imu_link", 0, 0, 0, 1),
            w.all(*[0.0] * 9), w.w, w.all(*[0.0] * 9), w.a, w.all(*[0.0] * 9)),
    ),
    "times_in_a_file": lambda f, w: write(
        f, *alike("{}.csv", "x,y,z", **{"gyro-0": w.w, "accel-0": w.a}),
        ("time.csv", "time (sec)", w.t),
    ),
    "timestamps_in_a_file": lambda f, w: write(
        f, *alike("{}.csv", "x,y,z", gyr=w.w, acc=w.a), ("timestamps.csv", "time (sec)", w.t)
    ),
    # Clocks of unknown names, before the values, with a column between, behind them.
    "unknown_clock": lambda f, w: write(
        f, ("Gyroscope.csv", "Uhrzeit,z (deg/s),y (deg/s),x (deg/s)", w.t, w.w_deg[:, ::-1]),
        ("Accelerometer.csv", "ts,accuracy,z (m/s^2),y (m/s^2),x (m/s^2)", w.t, w.all(3),
         w.a[:, ::-1]),
    ),
    "unknown_clock_behind": lambda f, w: write(
        f, ("Gyroscope.csv", "z (deg/s),y (deg/s),x (deg/s),ticks", w.w_deg[:, ::-1], w.t),
        ("Accelerometer.csv", "z (m/s^2),y (m/s^2),x (m/s^2),ticks", w.a[:, ::-1], w.t),
    ),
    "german": lambda f, w: write(
        f, ("Beschleunigungssensor.csv", "Zeit (s),Beschleunigung @", w.t, w.a),
        ("Gyroskop.csv", "Zeit (s),Drehrate @", w.t, w.w),
    ),
    "quoted_titles_with_commas": lambda f, w: write(
        f, ("a.csv", ",".join(['"Time, s"', *(f'"{name} {axis}, {unit}"' for name, unit in (
            ("Acc", "g"), ("Gyro", "deg/s")) for axis in "XYZ")]), w.t, w.a_g, w.w_deg),
    ),
}  # fmt: skip


def export(name: str, folder: Path, walk: ImuSequence) -> bool:
    """Write a walk as an app does; return whether with the magnetic field."""
    columns = Walk(walk)
    folder.mkdir(parents=True, exist_ok=True)
    EXPORTS[name](folder, columns)
    return columns.measures_field


def add(write_files: Export) -> Export:
    EXPORTS[write_files.__name__] = write_files
    return write_files


@add
def phyphox(folder: Path, w: Walk) -> None:
    """Semicolons and decimal commas, as exported for a German spreadsheet."""
    for name, unit, values in (
        ("Accelerometer", "m/s^2", w.a), ("Gyroscope", "rad/s", w.w), ("Magnetometer", "µT", w.m),
        ("Linear Accelerometer", "m/s^2", w.lin),
    ):  # fmt: skip
        header = f'"Time (s)";"X ({unit})";"Y ({unit})";"Z ({unit})"'
        save(folder / f"{name}.csv", header, w.t, values, sep=";", decimal=",")
    save(folder / "meta/time.csv", '"event","experiment time"', [["START", 0.0]])


@add
def phyphox_one_table(folder: Path, w: Walk) -> None:
    """Each sensor has its own clock; the last rows of the shorter one are blank."""
    header = '"Time (s)","Acceleration x (m/s^2)","Acceleration y (m/s^2)"'
    header += ',"Acceleration z (m/s^2)","Gyroscope time (s)","Gyroscope x (rad/s)"'
    header += ',"Gyroscope y (rad/s)","Gyroscope z (rad/s)"'
    longer = np.append(w.t, w.t[-1] + 0.01 * np.arange(1, 6))
    gyro = np.column_stack([longer, np.vstack([w.w, np.ones((5, 3))])])
    accel = np.column_stack([w.t, w.a]).tolist()
    save(folder / "Raw Data.csv", header, [*accel, *[[""] * 4] * 5], gyro)


@add
def sensor_logger_with_other_sensors(folder: Path, w: Walk) -> None:
    """With a watch's motion, other sensors and the files that macOS adds to folders."""
    EXPORTS["sensor_logger"](folder, w)
    EXPORTS["sensor_logger_watch"](folder, w)
    few = w.ns[:9], w.t[:9], w.none[:9, :2]
    write(
        folder,
        ("Barometer.csv", "time,seconds_elapsed,relativeAltitude,pressure", *few),
        ("Location.csv", "time,seconds_elapsed,longitude,latitude", *few),
        *zyx(w, WatchMagnetometer=w.m + 300.0),
    )
    (folder / "._Gyroscope.csv").write_bytes(b"\0\5\26\7" * 20)
    (folder / ".DS_Store").write_bytes(b"\0\0")
    (folder / "Microphone.csv").write_text("time,seconds_elapsed,dBFS\n")


@add
def json_export(folder: Path, w: Walk) -> None:
    sensors = {"Accelerometer": w.lin, "Gravity": w.g, "Gyroscope": w.w, "Magnetometer": w.m}
    rows = [
        {"sensor": name, "time": str(stamp), "z": str(z), "y": str(y), "x": str(x)}
        for name, values in sensors.items()
        for stamp, (x, y, z) in zip(w.ns.tolist(), values.tolist(), strict=True)
    ]
    first = {"sensor": "Metadata", "device name": "Pixel 8", "platform": "android"}
    (folder / "2024-06-10.json").write_text(json.dumps([first, *rows]))


@add
def json_export_of_a_watch(folder: Path, w: Walk) -> None:
    EXPORTS["sensor_logger_watch"](folder, w)
    with (folder / "WristMotion.csv").open() as file:
        rows = [{"sensor": "WristMotion", **row} for row in csv.DictReader(file)]
    (folder / "WristMotion.csv").unlink()
    (folder / "2024-06-10.json").write_text(json.dumps(rows))


@add
def zip_in_a_zip(folder: Path, w: Walk) -> None:
    inside = folder / "unpacked"
    EXPORTS["sensor_logger"](inside, w)
    with zipfile.ZipFile(folder / "inner.zip", "w") as file:
        for one in inside.iterdir():
            file.write(one, f"2024-06-10/{one.name}")
            file.writestr(f"__MACOSX/2024-06-10/._{one.name}", b"\0\5\26\7")
            one.unlink()
    inside.rmdir()
    with zipfile.ZipFile(folder / "outer.zip", "w") as file:
        file.write(folder / "inner.zip", "inner.zip")
    (folder / "inner.zip").unlink()


@add
def trace(folder: Path, w: Walk) -> None:
    """Lines by type, with waypoints; one line break is missing."""
    lines = ["#\tstartTime:1560828400000"]
    sensors = {"ACCELEROMETER": w.a, "GYROSCOPE": w.w, "MAGNETIC_FIELD": w.m,
               "ROTATION_VECTOR": w.rotation_vector}  # fmt: skip
    for k, stamp in enumerate((1_560_828_400_000 + w.ms).tolist()):
        for kind, values in sensors.items():
            lines.append("\t".join([str(stamp), f"TYPE_{kind}", *map(str, values[k]), "3"]))
        if k in (200, 700):
            lines.append(f"{stamp}\tTYPE_WAYPOINT\t{k}.5\t7.25")
    (folder / "5d07.txt").write_text("\n".join(lines).replace("\t3\n", "\t3", 1))


@add
def get_sensor_data(folder: Path, w: Walk) -> None:
    lines = ["% LogFile created by the 'GetSensorData' App"]
    sensors = {"ACCE": w.a, "GYRO": w.w, "MAGN": w.m}
    for k, t in enumerate(w.t.tolist()):
        for code, values in sensors.items():
            lines.append(";".join([code, f"{t + 5.0:.3f}", f"{t:.4f}", *map(str, values[k]), "3"]))
        vector = ";".join(map(str, w.rotation_vector[k]))
        lines.append(f"AHRS;{t + 5.0:.3f};{t:.4f};1;2;3;{vector};3")
    for t in (5.5, 6.5):
        lines.append(f"PRES;{t};{t + 900.0};{1013.0 + 0.01 * t};3")
        lines.append(f"GNSS;{t + 0.25};1690000000.0;40.0;-3.0;{t};90.0;4.5;1.25;9;0")
    lines.append("POSI;7.000;1;40.0;-3.0;0;0")
    lines.append("POSI;9.000;2;40.0001;-3.0;-1;0")
    (folder / "log.txt").write_text("\n".join(lines) + "\n")
