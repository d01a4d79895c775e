"""A table of one device is read back in whatever layout people and programs write it.

Names, units and where they stand, order of the columns, separators, decimal marks, quotes,
encodings and lines above the titles are drawn at random, all at once.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stario.sequences.readers import find_recordings, read_recording
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray

COUNT = 60
TIME = 0.01 * np.arange(COUNT)
RNG = np.random.default_rng(5)
GYRO, ACCEL = RNG.normal(0.0, 1.0, (COUNT, 3)), RNG.normal([0.0, 0.0, 9.8], 3.0, (COUNT, 3))
FIELD = RNG.normal(0.0, 20.0, (COUNT, 3))

NAMES = {
    "csv": (
        ("t", "time", "Timestamp", "times"),
        ("g#", "w#", "gyro_#", "gyr_#", "gyroscope_#", "angular_velocity_#", "w_RS_S_#"),
        ("a#", "acc_#", "acce_#", "accel#", "accelerometer_#", "a_RS_S_#"),
        ("m#", "mag_#", "magnetic_field_#"),
    ),
    "wide": (
        ("Time", "timestamp", "Elapsed time", "Zeit", "uptime"),
        ("Gyroscope #", "GYROSCOPE_#", "gyroscope.#", "IMU(0):gyro#", "Angular Rate #", "giro#"),
        ("Acc #", "ACCELEROMETER_#", "accelerometer.#", "IMU(0):acc#", "Aceleración #", "accel.#"),
        ("Magnetometer #", "MAGNETIC FIELD_#", "mag.#", "IMU(0):mag#"),
    ),
}
"""Names of the clock and of the axes `#` of the sensors, of our own format and of others."""

SECONDS = {"s": 1.0, "ms": 1e3, "us": 1e6, "µs": 1e6, "ns": 1e9}
RATES = {
    1.0: ("", "rad/s", "rad s^-1", "radians per second", "RAD/S"),
    np.degrees(1.0): ("deg/s", "dps", "°/s", "degrees per second", "deg/second", "°·s⁻¹"),
    np.degrees(1e3): ("mdps", "mdeg/s"),
}
FORCES = {
    1.0: ("", "m/s^2", "m/s²", "m/s2", "m s^-2", "m·s⁻²", "meters per second squared"),
    1.0 / STANDARD_GRAVITY: ("g", "G"),
    1e3 / STANDARD_GRAVITY: ("mg",),
    -1.0 / STANDARD_GRAVITY: ("-g",),
    -1.0: ("-m/s^2",),
}
FIELDS = {1.0: ("", "uT", "µT", "microtesla"), 1e-6: ("T",), 1e3: ("nT",), 0.01: ("gauss", "G")}
"""Units by their number in one SI unit (uT for fields)."""


@st.composite
def tables(draw: st.DrawFn, names: str) -> tuple[bytes, bool]:
    """The content of a table, and whether it has a magnetic field."""

    def one_of(choices):
        return draw(st.sampled_from(list(choices)))

    clocks, *sensors = NAMES[names]
    unit = one_of(SECONDS)
    columns = [(one_of(clocks), unit, [f"{SECONDS[unit] * t:.3f}" for t in TIME.tolist()])]
    given_units = [RATES, FORCES, FIELDS][: draw(st.integers(2, 3))]
    measured = zip(sensors, given_units, (GYRO, ACCEL, FIELD), strict=False)
    for titles, units, values in measured:
        factor = one_of(units)
        unit, title = one_of(units[factor]), one_of(titles)
        for axis, column in zip("xyz", factor * values.T, strict=True):
            name = title.replace("#", one_of([axis, axis.upper()]))
            columns.append((name, unit, list(map(repr, column.tolist()))))
    if draw(st.booleans()):
        columns.append(("note", "", ["left hand"] * COUNT))
    separator, quote, place = one_of([",", ";", "\t"]), one_of(["", '"']), one_of(["[]", "()", ""])
    decimal = one_of([".", ","]) if quote or separator != "," else "."
    titles, units, cells = map(list, zip(*draw(st.permutations(columns)), strict=True))
    if names == "csv" and not quote and place:
        titles[0] = one_of(["", "#", "# "]) + titles[0]
    rows = [titles, units]
    if place:  # else below the titles
        opening, closing = place
        titled = zip(titles, units, strict=True)
        rows = [[title + (f" {opening}{u}{closing}" if u else "") for title, u in titled]]
    rows += [[cell.replace(".", decimal) for cell in row] for row in zip(*cells, strict=True)]
    lines = [separator.join(f"{quote}{cell}{quote}" for cell in row) for row in rows]
    lines = [*one_of([(), ("# left hand", "", "# again"), (f"sep={separator}",)]), *lines, ""]
    text = one_of(["\n", "\r\n"]).join(lines)
    encoding = one_of(["utf-8", "utf-8-sig", "utf-16", "latin-1"])
    try:
        return text.encode(encoding), len(given_units) == 3
    except UnicodeEncodeError:  # Latin-1 has few signs
        return text.encode(), len(given_units) == 3


def close(read: FloatArray, written: FloatArray) -> None:
    np.testing.assert_allclose(read, written, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("names", NAMES)
def test_a_table_is_read_back(names, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")

    @settings(max_examples=40, deadline=None)
    @given(tables(names))
    def check(table):
        path = folder / "own.csv"
        path.write_bytes(table[0])
        assert find_recordings(path) == [path]
        read = read_recording(path)
        close(read.time, TIME)
        close(read.gyro, GYRO)
        close(read.accel, ACCEL)
        if read.magnetometer is not None:
            close(read.magnetometer.field, FIELD)
        assert (read.magnetometer is not None) == table[1]

    check()
