"""Lines over TCP and UDP, and samples of a phyphox phone, are recorded like any others."""

import json
import socket
import threading
import time
import urllib.request
from http.server import BaseHTTPRequestHandler, HTTPServer
from urllib.parse import parse_qsl, unquote, urlsplit

import numpy as np
import pytest

from stario.fusion.live.phyphox import Phyphox, buffers_of
from stario.fusion.live.run import LiveServer, is_loopback
from stario.sequences import InputError, read_recording


@pytest.fixture
def serve(tmp_path, new_navigator):
    """Start a server, with a token as if it were not on loopback, or without one."""
    running = []

    def start(token="", phones=()):
        server = LiveServer(new_navigator, tmp_path, port=0, lines_port=0, phones=phones)
        server._lines._token = token
        listening = threading.Event()
        thread = threading.Thread(target=server.run, args=(listening.set,))
        thread.start()
        running.append((server, thread))
        assert listening.wait(20.0)
        return server

    yield start
    for server, thread in running:
        server.stop()
        thread.join(20.0)


def lines_of(walk, count, **extra):
    rows = zip(walk.time[:count].tolist(), walk.gyro.tolist(), walk.accel.tolist(), strict=False)
    return [
        json.dumps({"t": t, "gyro": g, "accel": a, **extra}).encode() + b"\n" for t, g, a in rows
    ]


def wait_for(condition, seconds=20.0):
    stop = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < stop
        time.sleep(0.02)


def samples(server, device):
    session = server.hub.sessions.get(device)
    return 0 if session is None else session.samples


def test_lines_over_tcp_are_recorded_and_invalid_ones_get_an_error(serve, walk):
    server = serve()
    lines = lines_of(walk, 300)
    with socket.create_connection(("127.0.0.1", server.lines_port)) as device:
        content = b"".join([*lines[:100], b'{"t": "x"}\n', b"\n", *lines[100:]])
        for begin in range(0, len(content), 997):  # packets end at arbitrary bytes
            device.sendall(content[begin : begin + 997])
        wait_for(lambda: samples(server, "tcp 127.0.0.1") == 300)
        assert json.loads(device.makefile().readline())["error"].startswith("t: found 'x'")
    recording = read_recording(server.hub.sessions["tcp 127.0.0.1"].path)
    np.testing.assert_array_equal(recording.gyro, walk.gyro[:300])


def test_lines_over_udp_are_recorded_under_the_name_of_the_device(serve, walk):
    server = serve()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        for line in lines_of(walk, 200, device="drone"):
            device.sendto(line, ("127.0.0.1", server.lines_port))
            time.sleep(0.0005)
        device.sendto(b"nonsense", ("127.0.0.1", server.lines_port))
        wait_for(lambda: server.hub.refused["udp"] == 1)
    wait_for(lambda: samples(server, "drone") == 200)


def test_lines_without_the_token_are_refused(serve, walk):
    server = serve(token="secret")
    lines = lines_of(walk, 100, device="d")
    for first in (b"", b'{"token": "other"}\n'):
        with socket.create_connection(("127.0.0.1", server.lines_port)) as device:
            device.sendall(first + lines[0])
            assert b"token" in device.makefile("rb").readline()
    with socket.create_connection(("127.0.0.1", server.lines_port)) as device:
        device.sendall(b'{"token": "secret"}\n' + b"".join(lines))
        wait_for(lambda: samples(server, "d") == 100)


CONFIG = {
    "inputs": [
        {"source": "gyroscope", "outputs": [{"x": "gX", "y": "gY"}, {"z": "gZ"}, {"t": "gt"}]},
        {"source": "accelerometer", "outputs": [{k: f"acc {k}"} for k in "xyzt"]},
        {"source": "light", "outputs": [{"x": "lux"}]},
    ]
}  # fmt: skip


class FakePhone(BaseHTTPRequestHandler):
    """A server of /config and /get like phyphox; each request finds 0.2 s more of the walk."""

    walk, requests = None, 0

    def do_GET(self):
        url = urlsplit(self.path)
        if url.path == "/config":
            self._send(CONFIG)
            return
        FakePhone.requests += 1
        known = slice(0, 20 * FakePhone.requests)
        t = self.walk.time[known]
        columns = {"gt": t, "acc t": t}
        for k, axis in enumerate("xyz"):
            columns[f"g{axis.upper()}"] = self.walk.gyro[known, k]
            columns[f"acc {axis}"] = self.walk.accel[known, k]
        buffers = {}
        for name, asked in parse_qsl(url.query):
            since, _, by = asked.partition("|")
            rows = slice(None) if since == "full" else columns[by or name] > float(since)
            buffers[unquote(name)] = {"buffer": columns[unquote(name)][rows].tolist()}
        self._send({"buffer": buffers, "status": {"session": "abc", "measuring": True}})

    def _send(self, content):
        self.send_response(200)
        self.end_headers()
        self.wfile.write(json.dumps(content).encode())

    def log_message(self, *args):
        pass


def test_a_phyphox_phone_is_polled_until_all_samples_are_recorded(serve, walk):
    FakePhone.walk, FakePhone.requests = walk, 0
    with HTTPServer(("127.0.0.1", 0), FakePhone) as phone:
        threading.Thread(target=phone.serve_forever, daemon=True).start()
        address = f"127.0.0.1:{phone.server_port}"
        server = serve(phones=[address])
        wait_for(lambda: samples(server, f"phyphox {address}") >= 200)
        recording = read_recording(server.hub.sessions[f"phyphox {address}"].path)
        np.testing.assert_array_equal(recording.accel, walk.accel[: len(recording)])
        phone.shutdown()


def test_an_experiment_without_both_sensors_is_refused():
    with pytest.raises(InputError, match="gyroscope and acceleration with g"):
        buffers_of({"inputs": CONFIG["inputs"][1:]})


def test_a_stopping_server_closes_the_connections_of_its_viewers(serve, caplog):
    server = serve()
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/events", timeout=20) as viewer:
        assert viewer.readline().startswith(b"data: ")
        server.stop()
        rest = viewer.read()
    assert rest.endswith(b"\n")
    assert caplog.records == []


def test_a_server_stops_quietly_while_a_device_is_connected(serve, walk, caplog):
    server = serve()
    with socket.create_connection(("127.0.0.1", server.lines_port)) as device:
        device.sendall(b"".join(lines_of(walk, 100, device="d")))
        wait_for(lambda: samples(server, "d") == 100)
        server.stop()
        assert device.recv(10) == b""
    assert caplog.records == []


def test_only_loopback_needs_no_token(tmp_path, new_navigator):
    assert is_loopback("127.0.0.1")
    assert is_loopback("::1")
    assert not is_loopback("0.0.0.0")
    server = LiveServer(new_navigator, tmp_path, host="0.0.0.0", port=0)
    assert len(server.token) >= 16
    assert server.token in "\n".join(server.addresses())
    server._socket.close()


def test_an_invalid_packet_does_not_stop_the_server_from_listening(serve, walk):
    server = serve(token="sesame")
    address = ("127.0.0.1", server.lines_port)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone:
        phone.sendto(b'{"token": "\\ud800"}', address)
        phone.sendto(b'{"token": "sesame"}\n' + lines_of(walk, 1, device="d")[0], address)
        for line in lines_of(walk, 150, device="d")[1:]:
            phone.sendto(b'{"token": "sesame"}\n' + line, address)
            time.sleep(0.0005)
    wait_for(lambda: samples(server, "d") > 50)


def test_a_cleared_experiment_is_followed_from_its_new_start():
    phone = Phyphox("phone:8080")
    phone._buffers = {"gyro": ("t", "x", "y", "z")}

    def answer(times):
        return {name: {"buffer": [float(t) for t in times]} for name in ("t", "x", "y", "z")}

    assert len(phone._readings("gyro", answer([1.0, 2.0, 3.0]))) == 3
    assert len(phone._readings("gyro", answer([3.0, 4.0]))) == 1
    assert len(phone._readings("gyro", answer([0.1, 0.2]))) == 2


@pytest.mark.parametrize("time", [float("inf"), 10**400, 1e300])
def test_an_endless_time_neither_fails_nor_ends_the_stream(time):
    phone = Phyphox("phone:8080")
    phone._buffers = {"gyro": ("t", "x", "y", "z")}

    def answer(times):
        buffers = {name: {"buffer": [0.5] * len(times)} for name in ("x", "y", "z")}
        return buffers | {"t": {"buffer": times}}

    assert len(phone._readings("gyro", answer([1.0, time]))) == 1
    assert len(phone._readings("gyro", answer([2.0, 3.0]))) == 2


def test_a_paused_experiment_continues_as_another_recording(monkeypatch):
    """Its time does not count the pause, so the same track would miss what happened meanwhile."""
    phone, recordings = Phyphox("phone:8080"), []
    for measuring in (False, True, True, False, False, True, True):
        answer = {"buffer": {}, "status": {"session": "abc", "measuring": measuring}}
        monkeypatch.setattr(phone, "_get", lambda path, a=answer: CONFIG if "config" in path else a)
        recordings.append(phone.fetch().recording)
    assert len(set(recordings[1:5])) == len(set(recordings[5:])) == 1
    assert recordings[4] != recordings[5]
