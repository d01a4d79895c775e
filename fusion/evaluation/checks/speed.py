"""Speed of the estimators on this machine: a recording as a whole, and sample by sample."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from time import perf_counter
from timeit import timeit

import numpy as np
import pandas as pd

from stario.fusion.evaluation.compare import demonstration
from stario.fusion.imu.inference import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.values.config import FilterConfig, NavigatorConfig
from stario.fusion.values.state import Track
from stario.sequences.sequence import ImuSequence

_RUNS, _RATES = 3, (2, 10, 20)
"""Number of runs of which the median counts, and update rates of the filter alone [Hz]."""

_WORDS = {
    "run_s_per_min": "s per minute of data: run",
    **{f"filter_{n}_hz_s_per_min": f"s per minute of data: filter at {n} Hz" for n in _RATES},
    "push_us": "us: push without a state (median)",
    "push_with_update_us": "us: push with an update by the network (99th percentile)",
}


def speed_text(found: pd.Series[float]) -> str:
    """Return what `speed` found in words."""
    return "\n".join(f"{found[name]:9.3g} {words}" for name, words in _WORDS.items())


def speed(model: Predictor) -> pd.Series[float]:
    """Time a run of the demonstration, the filter alone at several update rates, and its samples.

    Runs are in s per minute of data, samples in us: without a state (median), and with an update by
    the network (99th percentile).
    """
    sequence = demonstration()
    whole = Navigator(model)
    works: dict[str, Callable[[], Track]] = {"run_s_per_min": lambda: whole.run(sequence)}
    for rate in _RATES:
        config = NavigatorConfig(filter=FilterConfig(update_rate=rate))
        alone = Navigator(model, config, backend="ekf")
        observed = alone.observe(sequence)
        works[f"filter_{rate}_hz_s_per_min"] = partial(alone.track, observed)
    minutes = sequence.duration / 60.0
    rows = [  # in turn, so that all are timed under the same load
        {name: timeit(work, number=1) / minutes for name, work in works.items()}
        for _ in range(_RUNS)
    ]
    plain, with_update = _push_times(Navigator(model), sequence)
    samples = {"push_us": np.median(plain), "push_with_update_us": np.percentile(with_update, 99)}
    return pd.concat([pd.DataFrame(rows).median(), pd.Series(samples)])


def _push_times(navigator: Navigator, sequence: ImuSequence) -> tuple[list[float], list[float]]:
    """Return the times [us] of pushed samples without a state, and with a network's update."""
    plain, with_update, updates = [], [], 0
    rows = zip(sequence.time.tolist(), sequence.gyro.tolist(), sequence.accel.tolist(), strict=True)
    for row in rows:
        began = perf_counter()
        state = navigator.push(*row)
        microseconds = 1e6 * (perf_counter() - began)
        if state is None:
            plain.append(microseconds)
        elif navigator.health.updates > updates:
            updates = navigator.health.updates
            with_update.append(microseconds)
    return plain, with_update
