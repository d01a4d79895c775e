import json
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest

from stario.fusion.live.phyphox import Phyphox
from stario.sequences import InputError, read_recording

CONFIG = {
    "inputs": [
        {"source": "gyroscope", "outputs": [{"x": "gX", "y": "gY"}, {"z": "gZ"}, {"t": "gt"}]},
        {"source": "accelerometer", "outputs": [{k: f"acc {k}"} for k in "xyzt"]},
        {"source": "light", "outputs": [{"x": "lux"}]},
    ]
}  # fmt: skip

PRESSURE = {"source": "pressure", "outputs": [{"x": "p"}, {"t": "p t"}]}
PLACE = ("lat", "lon", "z", "v", "dir", "t", "accuracy")
LOCATION = {"source": "location", "outputs": [{k: f"loc {k}"} for k in PLACE]}


class FakePhone:
    """An experiment whose buffers are requested as from phyphox: whole, last values or ends."""

    def __init__(self, walk):
        self.walk, self.count, self.measuring, self.cleared = walk, 0, True, False
        self.config, self.wrong = CONFIG, {}

    def clear(self):
        """Empty the buffers; the next answer is whole, so that this is noticed."""
        self.count, self.measuring, self.cleared = 0, False, True

    def answer(self, path):
        url = urlsplit(path)
        if url.path == "/config":
            return self.config
        columns, buffers = self._columns(), {}
        for name, asked in parse_qsl(url.query, keep_blank_values=True):
            since, _, by = asked.partition("|")
            if not since:
                mode, values = "single", columns[name][-1:].tolist() or [None]
            elif since == "full" or self.cleared:
                mode, values = "full", columns[name].tolist()
            else:
                mode = "partial"
                values = columns[name][columns[by or name] > float(since)].tolist()
            if name in self.wrong:
                values[-1] = self.wrong[name]
            buffers[name] = {"updateMode": mode, "buffer": values}
        self.cleared = False
        return {"buffer": buffers, "status": {"session": "abc", "measuring": self.measuring}}

    def _columns(self):
        known = slice(0, self.count)
        columns = dict.fromkeys(("gt", "acc t"), self.walk.time[known])
        for k, axis in enumerate("xyz"):
            columns[f"g{axis.upper()}"] = self.walk.gyro[known, k]
            columns[f"acc {axis}"] = self.walk.accel[known, k]
        columns["loc t"] = self.walk.time[known][::100]
        columns["loc lat"] = 48.1 + 1e-5 * columns["loc t"]
        columns["loc lon"] = 11.5 + 0.0 * columns["loc t"]
        for name, value in {"z": np.nan, "v": 1.0, "dir": 90.0, "accuracy": 5.0}.items():
            columns[f"loc {name}"] = np.full(len(columns["loc t"]), value)
        columns["p t"] = self.walk.time[known][::10]
        columns["p"] = 1000.0 - 0.01 * columns["p t"]
        return columns


@pytest.fixture
def fake(walk):
    """The fake phone, which answers at `address`."""
    fake = FakePhone(walk)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps(fake.answer(self.path)).encode())

        def log_message(self, *args):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as listener:
        threading.Thread(target=listener.serve_forever, daemon=True).start()
        fake.address = f"127.0.0.1:{listener.server_port}"
        yield fake
        listener.shutdown()


@pytest.fixture
def phone(fake):
    return Phyphox(fake.address)


def test_a_phone_is_polled_until_all_samples_are_recorded(serve, fake):
    server = serve(phones=[fake.address])
    stop = time.monotonic() + 20.0
    sessions, device = server.hub.sessions, f"phyphox {fake.address}"
    while device not in sessions or sessions[device].track.samples < 200:
        assert time.monotonic() < stop
        time.sleep(0.02)
        fake.count += 2
    recording = read_recording(sessions[device].track.path)
    np.testing.assert_array_equal(recording.accel, fake.walk.accel[: len(recording)])


def recorded(phone, fake, session, sensor):
    """The session, ended after five seconds of an experiment that has one more sensor."""
    fake.config = {"inputs": [*CONFIG["inputs"], sensor]}
    for fake.count in range(50, 501, 50):
        session.take(phone.fetch(), 1.7e9)
    session.close()
    return session


def test_the_pressure_of_an_experiment_that_has_it_is_recorded(phone, fake, session):
    recorded(phone, fake, session, PRESSURE)
    known = read_recording(session.track.path).barometer
    np.testing.assert_allclose(known.time, 0.1 * np.arange(50), atol=1e-6)
    np.testing.assert_allclose(known.pressure_hPa, 1000.0 - 0.001 * np.arange(50))
    assert session.status()["floor"] == "floor 0"


def test_the_places_of_an_experiment_that_has_them_are_recorded(phone, fake, session):
    """An altitude that the phone does not know ends no buffer."""
    recorded(phone, fake, session, LOCATION)
    known = read_recording(session.track.path).satellites
    np.testing.assert_allclose(known.time, np.arange(5), atol=1e-6)
    np.testing.assert_allclose(known.latlon_deg[:, 0], 48.1 + 1e-5 * np.arange(5))
    assert known.altitude_m is None
    assert set(known.radius_m) == {5.0}
    assert set(known.bearing_deg) == {90.0}
    assert session.status()["satellites"] == "5 satellite positions compared with the track"


def test_an_experiment_without_both_sensors_is_refused(phone, fake):
    fake.config = {"inputs": CONFIG["inputs"][1:]}
    with pytest.raises(InputError, match="gyroscope"):
        phone.fetch()


@pytest.mark.parametrize("lost", [False, True], ids=["noticed", "the answer after it is lost"])
def test_a_cleared_experiment_is_followed_from_its_new_start(phone, fake, lost):
    fake.count = 500
    before = phone.fetch()
    assert len(before.readings) == 1000
    fake.clear()
    if lost:
        fake.cleared = False
    assert phone.fetch().readings == []
    fake.measuring, fake.count = True, 20
    after = [phone.fetch() for _ in range(2)]
    assert sum(len(batch.readings) for batch in after) == 40
    fake.count = 40
    assert len(phone.fetch().readings) == 40
    assert after[-1].recording != before.recording


@pytest.mark.parametrize("wrong", [float("inf"), 10**400, 1e300])
def test_an_endless_time_neither_fails_nor_ends_the_stream(phone, fake, wrong):
    fake.count = 10
    fake.wrong = {"gt": wrong}
    assert len(phone.fetch().readings) == 19
    fake.count, fake.wrong = 20, {}
    assert len(phone.fetch().readings) == 21


def test_a_paused_experiment_continues_as_another_recording(phone, fake):
    """Its time does not count the pause, so the same track would miss what happened meanwhile."""
    batches = []
    for fake.measuring in (False, True, True, False, False, True, True):
        fake.count += 10 * fake.measuring
        batches.append(phone.fetch())
    recordings = [batch.recording for batch in batches]
    assert len(set(recordings[1:5])) == len(set(recordings[5:])) == 1
    assert recordings[4] != recordings[5]
    assert sum(len(batch.readings) for batch in batches) == 80


def test_an_experiment_cleared_while_the_phone_was_away_begins_another_recording(phone, fake):
    fake.count = 100
    before = phone.fetch()
    fake.clear()
    fake.measuring, fake.count = True, 500
    after = phone.fetch()
    assert len(after.readings) == 1000
    assert after.recording != before.recording
