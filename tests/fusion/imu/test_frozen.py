"""A sensor that repeats one sample again and again has stopped."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import CONFIG, stream

from stario.fusion import Navigator
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence

Make = Callable[..., Any]


@pytest.mark.parametrize("held", ["last", "zeros"])
def test_a_sensor_that_stops_makes_a_gap(walk: ImuSequence, make_oracle: Make, held: str) -> None:
    gyro, accel, time = walk.gyro.copy(), walk.accel.copy(), walk.time
    dead = (time > time[0] + 8.0) & (time < time[0] + 11.0)
    last = np.argmax(dead) - 1
    gyro[dead], accel[dead] = (gyro[last], accel[last]) if held == "last" else (0.0, 0.0)
    stopped = replace(walk, gyro=gyro, accel=accel)
    track = Navigator(make_oracle(stopped, walk.truth, CONFIG)).run(stopped)
    assert track.health.samples["frozen"] > 0.9 * dead.sum()
    assert track.health.gap_count == 1
    ((start, length),) = track.health.gaps
    assert start == pytest.approx(time[dead][0], abs=0.15)
    assert length == pytest.approx(3.0, abs=0.2)


def test_a_sensor_at_rest_may_repeat_its_values(still_model: Any) -> None:
    """Simulated without noise, or so coarse that its noise does not show."""
    n = 1000
    still = ImuSequence(
        "still", np.arange(n) / 100.0, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1))
    )
    health = Navigator(still_model).run(still).health
    assert health.samples["frozen"] == 0


@pytest.mark.parametrize("accel", [0.0, 1.0])
def test_an_unchanging_stream_is_refused_for_its_force(still_model: Any, accel: float) -> None:
    n = 300
    silent = ImuSequence(
        "silent", np.arange(n) / 100.0, np.zeros((n, 3)), np.tile([0.0, 0.0, accel], (n, 1))
    )
    with pytest.raises(InputError, match="accel"):
        stream(Navigator(still_model), silent)
