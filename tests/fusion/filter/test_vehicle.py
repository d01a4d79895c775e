from dataclasses import replace

import numpy as np
import pytest
from support import Altered, lying

from stario.fusion import Navigator
from stario.fusion.report.health import health_findings
from stario.sequences import ImuSequence


def shaken(acceleration: float) -> ImuSequence:
    """A shaken phone in a vehicle that starts at 20 s, for 10 s, and brakes at 40 s."""
    phone = lying(60.0, gyro_noise=0.05, accel_noise=0.5)
    time = phone.time
    forward = acceleration * (
        ((time > 20.0) & (time < 30.0)) - 1.0 * ((time > 40.0) & (time < 50.0))
    )
    return replace(phone, accel=phone.accel + np.outer(forward, [1.0, 0.0, 0.0]))


@pytest.mark.parametrize("backend", ["ekf", "graph"])
def test_a_ride_is_told_with_when_it_may_have_begun_and_ended(still_model, backend):
    def surely(number, mean, covariance):
        covariance *= 0.05**2

    rides = {}
    for acceleration in (0.0, 1.5):
        navigator = Navigator(Altered(still_model, surely), backend=backend)
        track = navigator.run(shaken(acceleration))
        health = track.health
        assert not health.zero_velocity
        rides[acceleration] = health.rides
    assert rides[0.0] == []
    ((since, until),) = rides[1.5]
    assert since < 20.0
    assert until > 55.0
    after, before = track.covariance[-1, 6, 6], (track.filtered or track).covariance[150, 6, 6]
    assert np.sqrt(after) == pytest.approx(7.5 * (until - since), rel=0.05)
    assert before < 25.0
    (found,) = (f for f in health_findings(health) if f.code == "rides")
    assert found.text.startswith(f"Between {since:.0f} s and {until:.0f} s the device")
    assert found.level == "warning"
