"""Large corrections are recorded with time, size and cause, and said."""

import numpy as np
import pytest
from initial_ekf import Driven
from told import health_verdict

from stario.fusion import Navigator, NavigatorConfig
from stario.fusion.filter.corrections import correction
from stario.fusion.values.health import Health
from stario.fusion.values.lie import about_vertical


@pytest.mark.parametrize(
    ("turn", "shift", "recorded"),
    [(0.0, 0.9, False), (0.0, 1.1, True), (0.15, 0.0, False), (0.2, 0.0, True)],
)
def test_a_step_beyond_a_metre_or_ten_degrees_is_a_correction(turn, shift, recorded):
    before = Driven(slots=1).state
    before = before.plus(np.zeros(len(before.P)))
    after = before.transformed(about_vertical(turn), np.array([shift, 0.0, 0.0]))
    found = correction(before, after, "rest")
    assert (found is not None) == recorded
    if found is not None:
        np.testing.assert_allclose(found[1:3], [shift, turn], atol=1e-9)
    assert correction(before, before, "rest") is None


def test_a_good_walk_has_none(make_walk, make_oracle):
    config = NavigatorConfig()
    walk = make_walk(seed=3, seconds=20.0)
    navigator = Navigator(make_oracle(walk, walk.truth, config, noise=0.03, sigma=0.03), config)
    assert navigator.run(walk).health.corrections == []


def test_a_track_with_a_large_correction_is_not_called_good():
    health = Health(updates=100, mean_nis=3.0, corrections=[(93.2, 4.0, 0.5, "magnetic field")])
    first = health_verdict(health)[0]
    assert first.level == "warning"
    assert "4.0 m" in first.text
    assert "magnetic field" in first.text
