"""Rows of zeros for the other sensor, and integer clocks of any epoch: as whatever logger wrote."""

import numpy as np
import pytest
from csv_lines import write_lines
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stario.sequences.readers import read_recording

SECONDS = 5.0
TICKS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9, "100 ns": 10**7}
"""Ticks in a second of clocks since 1970; the last are Windows' since 1601."""
TO_1970 = 11_644_473_600
"""Seconds from 1601 to 1970."""
OURS = "t,gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"


@given(
    rates=st.tuples(st.integers(60, 400), st.integers(60, 400)),
    phase=st.floats(0.0001, 0.002),
    seed=st.integers(0, 99),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
def test_zeros_of_the_sensor_that_was_not_read_are_no_samples(tmp_path, rates, phase, seed):
    rng = np.random.default_rng(seed)
    rows = []
    for sensor, rate in enumerate(rates):
        for t in np.arange(phase * sensor, SECONDS, 1.0 / rate):
            values = np.zeros(6)
            values[3 * sensor : 3 * sensor + 3] = rng.normal([0.0, 0.0, 9.8 * sensor], 0.3)
            rows.append([t, *values])
    rows.sort(key=lambda row: row[0])
    path = tmp_path / "a.csv"
    lines = [",".join(map(repr, map(float, row))) for row in rows]
    write_lines(path, OURS.replace("t,", "t [s],"), *lines)
    read = read_recording(path)
    # Where both are, both are measured: nothing is 0, and gravity is whole.
    assert not (read.gyro == 0.0).all(axis=1).any()
    assert np.median(read.accel[:, 2]) == pytest.approx(9.8, abs=0.2)
    assert read.duration == pytest.approx(SECONDS, abs=0.1)


@given(
    unit=st.sampled_from(list(TICKS)),
    begin=st.integers(946_684_800, 4_090_000_000),  # 2000 to 2099
    rate=st.sampled_from([50, 100, 200, 1000]),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
def test_integer_clocks_of_any_epoch_give_the_rate(tmp_path, unit, begin, rate):
    since = begin + (TO_1970 if unit == "100 ns" else 0)
    ticks = TICKS[unit]
    lines = []
    for k in range(4 * rate):
        stamp = str(since * ticks + k * ticks // rate) if ticks > 1 else f"{since + k / rate:.3f}"
        lines.append(f"{stamp},0.1,{0.01 * (k % 7)},0.3,1.0,2.0,9.{k % 10}")
    path = tmp_path / "a.csv"
    write_lines(path, OURS, *lines)
    read = read_recording(path)
    assert read.duration == pytest.approx(4.0 - 1.0 / rate, abs=2e-3)
    assert len(read) == 4 * rate
