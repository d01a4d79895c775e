"""Lines over TCP and UDP are recorded like any other samples."""

import json
import socket
import time
import urllib.request

import numpy as np
import pytest

from stario.fusion.live import lines as lines_module
from stario.fusion.live.lines import MAX_LINE
from stario.fusion.live.run import LiveServer, is_loopback
from stario.sequences import InputError, read_recording


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
    return 0 if session is None else session.track.samples


def test_lines_over_tcp_are_recorded_and_invalid_ones_get_an_error(serve, walk):
    server = serve()
    lines = lines_of(walk, 300)
    with socket.create_connection(("127.0.0.1", server.lines_port)) as device:
        content = b"".join([*lines[:100], b'{"t": "x"}\n', b"\n", *lines[100:]])
        for begin in range(0, len(content), 997):  # packets end at arbitrary bytes
            device.sendall(content[begin : begin + 997])
        wait_for(lambda: samples(server, "tcp 127.0.0.1") == 300)
        assert json.loads(device.makefile().readline())["error"].startswith("t: found 'x'")
    recording = read_recording(server.hub.sessions["tcp 127.0.0.1"].track.path)
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


REQUEST = b"POST /%s HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/plain\r\n\r\n"


@pytest.mark.parametrize("path", [b"", b"a" * (MAX_LINE + 9)], ids=["short", "longer than a line"])
def test_a_request_that_a_web_page_sends_by_a_browser_is_refused(serve, walk, path):
    server = serve()
    with socket.create_connection(("127.0.0.1", server.lines_port)) as browser:
        browser.sendall(REQUEST % path + b"".join(lines_of(walk, 100)))
        browser.settimeout(20.0)
        received = b""
        try:
            while data := browser.recv(4096):
                received += data
        except ConnectionResetError:  # it sent more than was read
            pass
    assert received.count(b"error") <= 1
    assert server.hub.refused["tcp"] == 1
    assert server.hub.sessions == {}


def test_idle_connections_without_the_token_are_closed_and_one_too_many_is_told(
    serve, walk, monkeypatch
):
    monkeypatch.setattr(lines_module, "TOKEN_SECONDS", 0.5)
    monkeypatch.setattr(lines_module, "MAX_CONNECTIONS", 2)
    server = serve(token="secret")
    address = ("127.0.0.1", server.lines_port)
    idle = [socket.create_connection(address) for _ in range(2)]
    with socket.create_connection(address) as third:
        assert b"at most 2 at once" in third.makefile("rb").readline()
    for connection in idle:
        assert b"token" in connection.makefile("rb").readline()
        connection.close()
    wait_for(lambda: server._lines._connections == 0)
    with socket.create_connection(address) as device:
        device.sendall(b'{"token": "secret"}\n' + b"".join(lines_of(walk, 100, device="d")))
        wait_for(lambda: samples(server, "d") == 100)


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


def test_lines_cannot_have_the_port_of_the_page(tmp_path, new_navigator):
    server = LiveServer(new_navigator, tmp_path, port=0, lines_port=0)
    server._lines_port = server.port
    started = []
    with pytest.raises(InputError, match="lines-port"):
        server.run(lambda: (started.append(True), server.stop()))
    assert not started


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
