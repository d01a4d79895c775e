"""Replay a recording against the live server, as a phone with Sensor Logger would send it.

Without --url it starts a server, replays at most half a minute at five times the true speed, and
prints where the track ended. `stario live --demo` shows a simulated walk. To watch a recording of
your own, start the server first, open its page, and replay at true speed:

    stario live
    python examples/replay_live.py [RECORDING] --url http://127.0.0.1:8000/data
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np

from stario.fusion import LiveServer, Navigator, demonstration
from stario.network import load_model
from stario.sequences import ImuSequence, StarioError, read_recording

PERIOD = 0.2
"""Time between two pushes [s]; the app offers similar settings."""


def replay(
    recording: ImuSequence, url: str, speed: float, seconds: float, device: str = "replay"
) -> int:
    """Push a recording in batches; return the number of samples that the server accepted."""
    first_ns, began, accepted = time.time_ns(), time.monotonic(), 0
    stop = min(recording.duration, seconds)
    sensors = [
        ("gyroscope", "xyz", recording.time, recording.gyro),
        ("totalacceleration", "xyz", recording.time, recording.accel),
    ]
    if recording.magnetometer is not None:
        field = recording.magnetometer
        sensors.append(("magnetometer", "xyz", field.time, field.field))
    if recording.barometer is not None:
        air = recording.barometer
        sensors.append(("barometer", ["pressure"], air.time, air.pressure_hPa[:, None]))
    if recording.satellites is not None:
        place = recording.satellites
        columns = {
            "latitude": place.latlon_deg[:, 0],
            "longitude": place.latlon_deg[:, 1],
            "horizontalAccuracy": place.radius_m,
            "speed": place.speed_m_s,
            "bearing": place.bearing_deg,
        }
        known = {title: column for title, column in columns.items() if column is not None}
        sensors.append(("location", [*known], place.time, np.column_stack([*known.values()])))
    for number in range(int(stop / PERIOD) + 1):
        begin, end = number * PERIOD, min(stop, (number + 1) * PERIOD)
        payload = []
        for name, titles, times, values in sensors:
            elapsed = times - recording.time[0]
            rows = (elapsed >= begin) & (elapsed < end)
            payload += [
                {
                    "name": name,
                    "time": first_ns + round(t * 1e9),
                    "values": dict(zip(titles, value, strict=True)),
                }
                for t, value in zip(elapsed[rows].tolist(), values[rows].tolist(), strict=True)
            ]
        time.sleep(max(0.0, end / speed - (time.monotonic() - began)))
        message = {"messageId": number, "sessionId": str(first_ns), "deviceId": device}
        body = json.dumps(message | {"payload": payload}).encode()
        request = urllib.request.Request(url, body, {"content-type": "application/json"})
        with urllib.request.urlopen(request) as answer:
            accepted += json.load(answer)["samples"]
    return accepted


def main(
    recording: ImuSequence, speed: float = 5.0, seconds: float = 30.0
) -> tuple[int, list[float], Path]:
    """Start a server and replay a recording against it.

    Returns:
        Number of samples accepted, final x, y, z [m] as drawn, and path of the recording written.
    """
    model = load_model("default")
    folder = Path(tempfile.mkdtemp(prefix="stario-live-"))
    server = LiveServer(lambda: Navigator(model), folder, port=0)
    listening = threading.Event()
    thread = threading.Thread(target=server.run, args=(listening.set,))
    thread.start()
    listening.wait()
    try:
        url = f"http://127.0.0.1:{server.port}/data"
        accepted = replay(recording, url, speed, seconds)
        session = server.hub.sessions["replay"]
        return accepted, session.track.drawn.points[-1][1:4], session.track.path
    finally:
        server.stop()
        thread.join()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Replay a recording against the live server.")
    parser.add_argument("recording", nargs="?", type=Path, help="default: the demonstration")
    parser.add_argument("--url", help="address of a running server; default: start one")
    parser.add_argument("--speed", type=float, default=1.0, help="with --url: times the true speed")
    parser.add_argument("--device", default="replay", help="name of the phone")
    options = parser.parse_args()
    if not options.speed > 0.0:
        parser.exit(2, f"--speed: found {options.speed:g}, expected more than 0\n")
    try:
        walk = read_recording(options.recording) if options.recording else demonstration()
        if options.url is None:
            taken, end, path = main(walk)
            print(f"{taken} samples, end at {end} m; recording: {path}")
        else:
            print(replay(walk, options.url, options.speed, float("inf"), options.device))
    except (StarioError, OSError) as error:  # OSError: no server at the address
        parser.exit(2, f"{error}\n")
