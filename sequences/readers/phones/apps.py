"""The app that wrote a logger's files, if they reveal it; for display only."""

from __future__ import annotations

from stario.sequences.readers.phones.files import PhoneFiles
from stario.sequences.readers.text import head_lines

_BY_HEADER = {
    "seconds_elapsed": "Sensor Logger",
    "Time since start in ms": "AndroSensor",
    '"Time (s)"': "phyphox",
    "loggingTime(txt)": "SensorLog",
    "gFx": "Physics Toolbox",
}
"""Text in the headers of an app's files."""

_BY_FILE = {
    "record.properties": "SensLogs on Android",
    "description.txt": "SensLogs on iOS",
    "arposes.txt": "iOS Logger",
    "motmagnfull.txt": "iOS Logger",
    "acce_uncalib.txt": "RoNIN-style logger",
    "game_rv.txt": "RoNIN-style logger",
}
"""Files that an app writes alongside its sensor files."""


def app_of(files: PhoneFiles) -> str:
    """Return the app's name, or else the kind of logger."""
    header = "\n".join(head_lines(files.gyro)[:8])
    for words, app in _BY_HEADER.items():
        if words in header:
            return app
    names = {file.name.lower() for file in files.gyro.parent.iterdir()}
    for name, app in _BY_FILE.items():
        if name in names:
            return app
    accel = files.first("accel") or files.first("linear")
    one = accel is not None and accel.file == files.gyro
    return "logger with all sensors in one file" if one else "logger with one file per sensor"
