"""A table of one device is read back in whatever layout people and programs write it.

Names, units and where they stand, order of the columns, separators, decimal marks, quotes,
encodings and lines above the titles are drawn at random, all at once.
"""

from dataclasses import dataclass, field
from pathlib import Path

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


@dataclass(frozen=True)
class Quantity:
    """A column's title, its unit and its text in each row."""

    title: str
    unit: str
    cells: list[str] = field(repr=False)


@dataclass(frozen=True)
class Text:
    """How a table is written: see the module."""

    columns: list[Quantity]
    units: str
    separator: str
    decimal: str
    quote: str
    encoding: str
    line_end: str
    above: tuple[str, ...]
    comment: str

    def write(self, path: Path) -> Path:
        def row(cells: list[str]) -> str:
            return self.separator.join(f"{self.quote}{cell}{self.quote}" for cell in cells)

        opening, closing = self.units[:1], self.units[1:]
        units = [column.unit for column in self.columns]
        titles = [column.title for column in self.columns]
        titles[0] = self.comment + titles[0]
        lines = [*self.above, row(titles), row(units)]
        if self.units != "below":
            titled = zip(titles, units, strict=True)
            lines[-2:] = [row([t + (f" {opening}{u}{closing}" if u else "") for t, u in titled])]
        for cells in zip(*(column.cells for column in self.columns), strict=True):
            lines.append(row([cell.replace(".", self.decimal) for cell in cells]))
        content = self.line_end.join(lines) + self.line_end
        try:
            path.write_bytes(content.encode(self.encoding))
        except UnicodeEncodeError:  # Latin-1 has few signs
            path.write_bytes(content.encode())
        return path


@st.composite
def texts(draw: st.DrawFn, names: str) -> Text:
    clocks, *sensors = NAMES[names]
    unit = draw(st.sampled_from(list(SECONDS)))
    time = [f"{SECONDS[unit] * t:.3f}" for t in TIME.tolist()]
    columns = [Quantity(draw(st.sampled_from(clocks)), unit, time)]
    given_units = [RATES, FORCES, FIELDS][: draw(st.integers(2, 3))]
    measured = zip(sensors, given_units, (GYRO, ACCEL, FIELD), strict=False)
    for titles, units, values in measured:
        factor = draw(st.sampled_from(list(units)))
        unit, title = draw(st.sampled_from(units[factor])), draw(st.sampled_from(titles))
        for axis, column in zip("xyz", factor * values.T, strict=True):
            name = title.replace("#", draw(st.sampled_from([axis, axis.upper()])))
            columns.append(Quantity(name, unit, list(map(repr, column.tolist()))))
    if draw(st.booleans()):
        columns.append(Quantity("note", "", ["left hand"] * COUNT))
    separator, quote = draw(st.sampled_from([",", ";", "\t"])), draw(st.sampled_from(["", '"']))
    units = draw(st.sampled_from(["[]", "()", "below"]))
    commented = names == "csv" and not quote and units != "below"
    return Text(
        columns=draw(st.permutations(columns)),
        units=units,
        separator=separator,
        decimal=draw(st.sampled_from([".", ","])) if quote or separator != "," else ".",
        quote=quote,
        encoding=draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "latin-1"])),
        line_end=draw(st.sampled_from(["\n", "\r\n"])),
        above=draw(st.sampled_from([(), ("# left hand", "", "# again"), (f"sep={separator}",)])),
        comment=draw(st.sampled_from(["", "#", "# "])) if commented else "",
    )


def close(read: FloatArray, written: FloatArray) -> None:
    np.testing.assert_allclose(read, written, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("names", NAMES)
def test_a_table_is_read_back(names, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")

    @settings(max_examples=40, deadline=None)
    @given(texts(names))
    def check(text):
        path = text.write(folder / "own.csv")
        assert find_recordings(path) == [path]
        read = read_recording(path)
        close(read.time, TIME)
        close(read.gyro, GYRO)
        close(read.accel, ACCEL)
        if read.magnetometer is not None:
            close(read.magnetometer.field, FIELD)
        assert (read.magnetometer is None) == (len(text.columns) < 10)

    check()
