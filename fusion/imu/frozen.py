"""A sensor that hands out one sample again and again, or nothing but zeros.

No real sensor measures the same six numbers for long: its noise changes the last digits. One that
does has stopped, and what it says is as unknown as what happens in a gap. What has never changed
yet is left to the checks of a stream's first second, and may be simulated without noise.
"""

from __future__ import annotations

import math

_SECONDS = 0.1
"""One sample for so long [s] is none: loggers that repeat slow ones do so for a few hundredths."""

_TURNING, _FORCE = 0.05, 1.5
"""A coarse sensor at rest reads one sample as well: no faster turn [rad/s], and gravity to within
this [m/s^2]."""


class FrozenWatch:
    """Watches the samples of a stream.

    Args:
        gravity: magnitude [m/s^2].
    """

    def __init__(self, gravity: float) -> None:
        self._gravity = gravity
        self._values: tuple[float, ...] = ()
        self._since = math.inf
        self._changed = False

    def look(self, sample: tuple[float, ...]) -> bool:
        """Whether a sample (time, gyro, accel) is only the one before it, held for too long."""
        time, values = sample[0], sample[1:]
        if values != self._values:
            self._changed = bool(self._values)
            self._values, self._since = values, time
            return False
        return self._changed and time - self._since > _SECONDS and not self._looks_at_rest()

    def _looks_at_rest(self) -> bool:
        gyro, accel = self._values[:3], self._values[3:]
        off = abs(math.hypot(*accel) - self._gravity)
        return math.hypot(*gyro) < _TURNING and off < _FORCE
