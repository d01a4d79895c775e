"""Which repeated values are those of a sensor at its limit."""

import numpy as np

from stario.fusion.imu.faults import OutlierDetector


def table(gyro_x: np.ndarray) -> np.ndarray:
    rows = np.zeros((len(gyro_x), 7))
    rows[:, 0] = 0.01 * np.arange(len(gyro_x))
    rows[:, 1] = gyro_x
    return rows


def count_saturated(gyro_x: np.ndarray, size: int = 11) -> int:
    """Number of samples flagged in a stream that is checked interval by interval."""
    detector, rows = OutlierDetector(), table(gyro_x)
    found = [
        detector.detect(rows[k : k + size].copy()).saturated
        for k in range(0, len(rows) - 1, size - 1)
    ]
    return sum(found)


def test_coarse_values_that_repeat_while_rising_are_not_saturated() -> None:
    rising = 0.1 * np.round(np.arange(0.0, 200.0) / 2.0)  # each value twice
    assert count_saturated(rising) == 0


def test_a_clipped_sine_is_saturated_at_its_limit() -> None:
    clipped = np.clip(8.0 * np.sin(np.arange(0.0, 40.0, 0.05)), -5.0, 5.0)
    stuck = int(((clipped[1:] == clipped[:-1]) & (np.abs(clipped[1:]) == 5.0)).sum())
    assert stuck - 2 <= count_saturated(clipped) <= stuck
