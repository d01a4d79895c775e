import asyncio
import json
import os
import re
import signal
import socket
import threading
import time
import urllib.request
from contextlib import suppress
from http.client import HTTPException
from urllib.parse import urlsplit

import pytest

from stario.fusion.live import run
from stario.fusion.live.run import LiveServer, is_loopback
from stario.sequences import read_recording

from .conftest import lines, send_lines

HEAD = b"POST /data HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99\r\nX-Filler: abcdefgh\r\n\r\n"


def push(url, body):
    with urllib.request.urlopen(urllib.request.Request(url, body), timeout=10) as answer:
        return json.load(answer)["samples"]


def repeated(url, body):
    """Push as an app does: a push that fails is repeated, but here for no longer than 5 s."""
    stop = time.monotonic() + 5.0
    while True:
        try:
            return push(url, body)
        except (OSError, HTTPException):
            if time.monotonic() > stop:
                raise


async def hold_up(port, already, rest, stop):
    """Hold a connection, sending a byte at a time; connect again as soon as it is closed."""
    while not stop.is_set():
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(already)
            for k in range(1000):
                writer.write(rest[k : k + 1])
                await writer.drain()
                try:
                    async with asyncio.timeout(0.3):
                        if not await reader.read(1000):
                            break
                except TimeoutError:
                    pass
                if stop.is_set():
                    break
            writer.close()
        except OSError:
            await asyncio.sleep(0.1)


async def crowd(port, stop):
    kinds = [(b"", b"")] * 50 + [(b"", HEAD)] * 25 + [(HEAD, b" " * 98)] * 25
    await asyncio.gather(*(hold_up(port, *kind, stop) for kind in kinds))


def test_a_hundred_silent_and_slow_connections_keep_no_push_out(serve, pushes, monkeypatch):
    monkeypatch.setattr(run, "_MAX_CONNECTIONS", 80)  # fewer than there are
    monkeypatch.setattr(run, "MAX_WAITING", 60)
    server, stop = serve(), threading.Event()
    attack = threading.Thread(target=lambda: asyncio.run(crowd(server.port, stop)))
    attack.start()
    try:
        time.sleep(1.0)
        url = f"http://127.0.0.1:{server.port}/data"
        assert sum(repeated(url, body) for body in pushes(seconds=2.0)) == 200
    finally:
        stop.set()
        attack.join()


def test_a_connection_without_a_whole_request_is_closed_in_time(serve, monkeypatch):
    monkeypatch.setattr(run, "REQUEST_SECONDS", 0.2)
    server = serve()
    for sent in (b"", HEAD[:20], HEAD + b"{"):
        with socket.create_connection(("127.0.0.1", server.port), timeout=10.0) as client:
            client.sendall(sent)
            with suppress(ConnectionResetError):
                assert client.recv(100) == b""


def test_a_stranger_keeps_no_connection(serve, monkeypatch):
    monkeypatch.setattr("stario.fusion.live.run.is_loopback", lambda host: False)
    server = serve()
    with socket.create_connection(("127.0.0.1", server.port), timeout=3.0) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert client.makefile("rb").read().startswith(b"HTTP/1.1 401")  # to its end


def test_a_push_waits_no_longer_for_a_missing_one_though_no_other_comes(serve, pushes):
    server = serve()
    url = f"http://127.0.0.1:{server.port}/data"
    bodies = pushes(seconds=4.0)
    taken = sum(push(url, body) for body in [*bodies[:10], *bodies[11:14]])
    stop = time.monotonic() + 10.0
    while server.hub.sessions["phone"].track.samples < taken + 60:
        assert time.monotonic() < stop
        time.sleep(0.05)


SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGKILL")]


@pytest.mark.skipif(os.name == "nt", reason="other signals on this system")
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_loses_nothing_that_was_acknowledged(tmp_path, pushes, process, number):
    server, url = process
    # The last two wait for the one before them, which does not come.
    acknowledged = sum(push(url, body) for k, body in enumerate(pushes(seconds=4.0)) if k != 17)
    server.send_signal(number)
    killed = number == signal.SIGKILL
    assert server.wait() == (-signal.SIGKILL if killed else 0)
    (path,) = tmp_path.glob("*.csv")
    assert len(read_recording(path)) == (acknowledged if killed else 380) >= 340


def test_a_stopping_server_closes_the_connections_of_its_viewers(serve, caplog):
    server = serve()
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/events", timeout=20) as viewer:
        assert viewer.readline().startswith(b"data: ")
        server.stop()
        rest = viewer.read()
    assert rest.endswith(b"\n")
    assert caplog.records == []


def test_only_loopback_needs_no_token(tmp_path, new_navigator):
    assert is_loopback("127.0.0.1")
    assert is_loopback("::1")
    assert not is_loopback("0.0.0.0")
    server = LiveServer(new_navigator, tmp_path, host="0.0.0.0", port=0)
    assert len(server.token) >= 16
    page = re.search(r"http://\S+", server.addresses()[0])[0]
    assert urlsplit(page).query == f"token={server.token}"
    server._socket.close()


def test_a_simulated_phone_walks_to_its_end(serve, walk):
    server = serve(demo=walk.slice(0.0, 1.5))
    stop = time.monotonic() + 20.0
    while not (sessions := server.hub.sessions) or sessions["simulated phone"].running:
        assert time.monotonic() < stop
        time.sleep(0.05)
    track = sessions["simulated phone"].track
    assert track.samples == len(walk.slice(0.0, 1.5)) == len(read_recording(track.path))


def test_posted_lines_are_accepted_all_or_none(client, hub, walk):
    posted = lines(walk, 150)
    broken = send_lines(client, [*posted[:50], '{"t": 1}'])
    assert (broken.status_code, hub.sessions) == (400, {})
    assert broken.json()["error"].startswith("line 51")
    assert hub.refused == 1
    for text in (posted[0], "\n".join(posted[:3])):
        unnamed = client.post("/data", content=text)
        assert "application/x-ndjson" in unnamed.json()["error"]
    assert send_lines(client, posted).json() == {"samples": 150}


def test_a_body_of_too_many_devices_is_refused_before_any_is_taken(client, hub, walk):
    posted = [lines(walk, 1)[0].replace("rig", f"rig {k}") for k in range(17)]
    answer = send_lines(client, posted)
    assert (answer.status_code, "at most 16" in answer.json()["error"]) == (400, True)
    assert hub.sessions == {}
    answer = send_lines(client, posted[:16])
    assert (answer.status_code, len(hub.sessions)) == (200, 16)


def test_answers_are_not_delayed(serve):
    server = serve()
    with socket.create_connection(("127.0.0.1", server.port)) as client:
        client.sendall(b"GET /page/live.css HTTP/1.1\r\nHost: localhost\r\n\r\n")
        client.recv(100)
        [served] = server._server.server_state.connections
        accepted = served.transport.get_extra_info("socket")
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
