"""A clock that was set back: samples that go on, but in the past.

Single late samples are dropped, and so is a burst that came in the wrong order. Late ones that
advance among themselves for seconds are of another clock: nobody knows how much time has passed
between it and the one before.
"""

from __future__ import annotations

from stario.sequences.errors import InputError

SET_BACK_SECONDS = 5.0
"""Late samples that advance for so long in a row [s] are of a clock that was set back; batches that
come twice or in the wrong order are shorter."""


class ClockSetBackError(InputError):
    """The clock of the samples was set back.

    Attributes:
        by: how far [s].
    """

    def __init__(self, by: float) -> None:
        self.by = by
        super().__init__(
            "time",
            f"a clock set back by {by:.3g} s",
            "one that goes on",
            "what follows is another recording",
        )


class SetBackWatch:
    """Watches the samples that come late."""

    def __init__(self) -> None:
        self._first = self._last = 0.0
        self._running = False

    def on_time(self) -> None:
        """A sample was not late."""
        self._running = False

    def late(self, time: float, newest: float) -> float:
        """A sample at `time` came after one at `newest` [s].

        Returns:
            For how long such samples have come in a row by now [s].

        Raises:
            ClockSetBackError: the late samples are of another clock.
        """
        if not self._running or time < self._last:
            self._first = time
        self._running, self._last = True, time
        if time - self._first >= SET_BACK_SECONDS:
            raise ClockSetBackError(newest - self._first)
        return time - self._first
