"""Back ends compared: time per minute of data, and ratios of errors with their uncertainty."""

from __future__ import annotations

from itertools import count

import numpy as np
import pytest

from stario.fusion.evaluation.checks import backends
from stario.fusion.evaluation.checks.backends import ESTIMATORS, Score, score_table, summary


def score(ekf: float, graph: float) -> Score:
    values = dict(zip(ESTIMATORS, (ekf, graph, 2.0 * ekf), strict=True))
    return Score("walk", 60.0, values, dict.fromkeys(ESTIMATORS, 2.4), values, 1.0)


def test_ratios_are_geometric_means_with_their_standard_error() -> None:
    scores = [score(1.0, ratio) for ratio in (0.5, 0.8, 1.0, 1.25, 2.0)]
    found = summary(scores)
    ratios, errors = found["mean_ratio_to_ekf"], found["mean_ratio_error"]
    assert ratios == pytest.approx({"ekf": 1.0, "graph": 1.0, "fixed_lag": 2.0})
    logs = np.log([0.5, 0.8, 1.0, 1.25, 2.0])
    expected = np.std(logs, ddof=1) / np.sqrt(5)
    assert errors == pytest.approx({"ekf": 0.0, "graph": expected, "fixed_lag": 0.0}, abs=1e-10)
    assert f"graph 1.00 +- {expected:.2f}" in score_table(scores)


def test_time_is_per_minute_of_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a clock that advances by a second on every reading."""
    clock = count()
    monkeypatch.setattr(backends, "process_time", lambda: float(next(clock)))
    found = backends.score_walk(0, 10.0)
    whole = 60.0 / found.duration_s
    assert found.s_per_min["ekf"] == found.s_per_min["graph"] == pytest.approx(whole)
    assert found.slowest_ms == 1e3
