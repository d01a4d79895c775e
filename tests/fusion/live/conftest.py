"""A phone that pushes a recording, and a navigator whose network is cheap."""

import json

import numpy as np
import pytest

from stario.fusion import Navigator
from stario.fusion.live.hub import Hub


class SteadyWalk:
    """Says of every window that the device moved on by its own mean force; cheap, and no zero."""

    def predict(self, windows):
        mean = np.asarray(windows, dtype=float)[:, 3:, :].mean(axis=2) * [0.3, 0.3, 0.0]
        return mean + np.array([0.8, 0.1, 0.0]), np.tile(0.01 * np.eye(3), (len(mean), 1, 1))


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
    """The walk's samples as the bodies of pushes, twenty of 100 Hz in each."""

    def bodies(device="phone", session="one", offset_ns=10**18, seconds=None):
        made = []
        count = len(walk) if seconds is None else round(100 * seconds)
        for begin in range(0, count, 20):
            rows = slice(begin, min(count, begin + 20))
            payload = [
                {"name": name, "time": offset_ns + round(t * 1e9)}
                | {"values": {"x": x, "y": y, "z": z}}
                for name, values in (("gyroscope", walk.gyro), ("totalacceleration", walk.accel))
                for t, (x, y, z) in zip(
                    walk.time[rows].tolist(), values[rows].tolist(), strict=True
                )
            ]
            message = {"messageId": len(made), "sessionId": session, "deviceId": device}
            made.append(json.dumps(message | {"payload": payload}).encode())
        return made

    return bodies
