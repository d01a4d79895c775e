import errno
import json
import subprocess
import sys
import threading

import numpy as np
import pytest
from starlette.testclient import TestClient

from stario.fusion import LiveServer, Navigator, read_fixes
from stario.fusion.live.hub import Hub
from stario.fusion.live.server import live_app
from stario.fusion.live.session import Session
from stario.sequences import read_recording


class SteadyWalk:
    """A cheap network: the displacement depends on the window's mean force and is not zero."""

    def predict(self, windows):
        mean = np.asarray(windows, dtype=float)[:, 3:, :].mean(axis=2) * [0.3, 0.3, 0.0]
        return mean + np.array([0.8, 0.1, 0.0]), np.tile(0.01 * np.eye(3), (len(mean), 1, 1))


def send(client, bodies, query=""):
    return [client.post(f"/data{query}", content=body) for body in bodies]


def lines(walk, count=None):
    rows = zip(walk.time[:count].tolist(), walk.gyro.tolist(), walk.accel.tolist(), strict=False)
    return [json.dumps({"device": "rig", "t": t, "gyro": g, "accel": a}) for t, g, a in rows]


def send_lines(client, posted):
    headers = {"content-type": "Application/X-NDJSON; charset=utf-8"}
    return client.post("/data", content="\n".join(posted), headers=headers)


def command(client, name, device="phone", **content):
    return client.post("/command", json={"device": device, "command": name, **content})


def added(bodies, name, values, every=1):
    """Pushes with another sensor's entry in every so many, of the time since the first [s]."""
    for number, body in enumerate(bodies):
        message = json.loads(body)
        time = message["payload"][0]["time"]
        if number % every == 0:
            entry = {"name": name, "time": time, "values": values(0.2 * number)}
            message["payload"].append(entry)
        yield json.dumps(message).encode()


def ends(session):
    return session.track.drawn.points[-1][1:4]


def rerun(navigator, recording, fixes=()):
    """The filter's track of a recorded file, by the model and settings of a navigator."""
    alone = Navigator(navigator.model, navigator.config, navigator.prior, backend="ekf")
    return alone.run(read_recording(recording), fixes=fixes)


def end_of_rerun(session, navigator):
    """Where the navigator's track of the recording and fixes of a session ends [m]."""
    fixes = session.track.path.with_name(f"{session.track.path.stem}-fixes.csv")
    known = read_fixes(fixes) if fixes.exists() else ()
    return rerun(navigator, session.track.path, known).trajectory.position_W[-1]


def full_disk(*arguments, **more):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.fixture
def new_navigator():
    return lambda: Navigator(SteadyWalk())


@pytest.fixture
def hub(tmp_path, new_navigator):
    hub = Hub(tmp_path / "live", new_navigator)
    yield hub
    hub.close()


@pytest.fixture(scope="session")
def pushes(walk):
    """The walk as bodies of pushes, with twenty samples at 100 Hz in each."""

    def bodies(device="phone", session="one", offset_ns=10**18, seconds=None):
        encoded = []
        count = len(walk) if seconds is None else round(100 * seconds)
        for begin in range(0, count, 20):
            rows = slice(begin, min(count, begin + 20))
            times = [offset_ns + round(t * 1e9) for t in walk.time[rows].tolist()]
            payload = [
                {"name": name, "time": t, "values": dict(zip("xyz", value, strict=True))}
                for name, values in (("gyroscope", walk.gyro), ("totalacceleration", walk.accel))
                for t, value in zip(times, values[rows].tolist(), strict=True)
            ]
            message = {"messageId": len(encoded), "sessionId": session, "deviceId": device}
            encoded.append(json.dumps(message | {"payload": payload}).encode())
        return encoded

    return bodies


@pytest.fixture
def serve(tmp_path, new_navigator):
    running = []

    def start(**options):
        server = LiveServer(new_navigator, tmp_path, port=0, **options)
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


@pytest.fixture
def process(tmp_path):
    """`stario live` as a process of its own, and the address of its pushes."""
    # Without pandas and with it the evaluation, which take seconds: a server starts at once.
    command = "import sys; sys.modules['pandas'] = None; "
    command += "from stario.fusion.commands.cli import main; main()"
    options = ["live", "--port", "0", "--out", str(tmp_path)]
    with subprocess.Popen(
        [sys.executable, "-c", command, *options], stderr=subprocess.PIPE, text=True
    ) as server:
        watchdog = threading.Timer(120.0, server.kill)
        watchdog.start()
        lines = [server.stderr.readline() for _ in range(2)]
        yield server, lines[1].split()[-1]
        watchdog.cancel()
        server.kill()


@pytest.fixture
def client(hub):
    with TestClient(live_app(hub), base_url="http://localhost") as client:
        yield client


@pytest.fixture
def session(tmp_path, new_navigator):
    session = Session("phone", tmp_path, new_navigator)
    yield session
    session.close()
