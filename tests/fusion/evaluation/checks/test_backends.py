"""Back ends compared: time per minute of data, and ratios of errors with their uncertainty."""

from __future__ import annotations

from itertools import count

import numpy as np
import pandas as pd
import pytest

from stario.fusion.evaluation.checks import backends
from stario.fusion.evaluation.checks.backends import ESTIMATORS, score_table, summary
from stario.fusion.evaluation.scores import joined, scored, values


def score(walk: int, ekf: float, graph: float) -> pd.DataFrame:
    errors = dict(zip(ESTIMATORS, (ekf, graph, 2.0 * ekf), strict=True))
    figures = {k: {"ate_m": v, "nees": 2.4, "s_per_min": v} for k, v in errors.items()}
    return scored(f"walk {walk}", figures)


def test_ratios_are_geometric_means_with_their_standard_error() -> None:
    ratios = (0.5, 0.8, 1.0, 1.25, 2.0)
    scores = joined(score(walk, 1.0, ratio) for walk, ratio in enumerate(ratios))
    found = summary(scores)
    means, errors = found["mean_ratio_to_ekf"], found["mean_ratio_error"]
    assert means == pytest.approx({"ekf": 1.0, "graph": 1.0, "fixed_lag": 2.0})
    expected = np.std(np.log(ratios), ddof=1) / np.sqrt(5)
    assert errors == pytest.approx({"ekf": 0.0, "graph": expected, "fixed_lag": 0.0}, abs=1e-10)
    assert f"graph 1.00 +- {expected:.2f}" in score_table(scores)


def test_time_is_per_minute_of_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a clock that advances by a second on every reading."""
    clock = count()
    monkeypatch.setattr(backends, "process_time", lambda: float(next(clock)))
    found = backends.score_walk(0, 10.0)
    [seconds] = values(found, "duration_s", track="ekf")
    for name in ("ekf", "graph"):
        assert values(found, "s_per_min", track=name) == pytest.approx([60.0 / seconds])
    assert values(found, "slowest_ms") == [1e3]
