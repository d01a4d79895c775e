"""The last second of a stream, so that a late fix can be taken in at its own time.

A fix that comes late changes everything after its time: the state it corrects, how the windows were
turned, which measurements were gated. So the filter goes back to a checkpoint before the fix and
takes the same epochs, measurements and fixes again, with the late one in its place. The result is
the one that the fix would have given in time, for every kind of fix alike; it costs at most one
second of filtering (some milliseconds).
"""

from __future__ import annotations

import bisect
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from stario.fusion.fixes import Fix, by_time
from stario.fusion.imu.intervals import Epoch
from stario.fusion.lie import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

Measurement = tuple[FloatArray, FloatArray]
"""Displacement (3,) [m] and covariance (3, 3) [m^2] in the window's frame N."""


@dataclass(eq=False)
class Step:
    """One step of a recipe and, for some, the state before it.

    Attributes:
        epoch: that was stepped over.
        measurement: of the window that ends there.
        fixes: within the epoch, in order.
        before: the recipe's checkpoint before the step, None where it was not kept.
    """

    epoch: Epoch
    measurement: Measurement | None
    fixes: list[Fix]
    before: dict[str, Any] | None = None


class History:
    """Steps back to one window before now.

    Args:
        every: steps from one checkpoint to the next.
    """

    def __init__(self, every: int) -> None:
        self._every = every
        self.steps: deque[Step] = deque()
        self._since = 0

    def due(self) -> bool:
        """Whether the next step should come with a checkpoint."""
        return not self.steps or self._since >= self._every

    def add(self, step: Step) -> None:
        """Append a step and forget what lies more than a window back."""
        self._since = 1 if step.before is not None else self._since + 1
        self.steps.append(step)
        oldest = step.epoch.stop - WINDOW_SECONDS
        while (second := self._second_checkpoint()) and self.steps[second].epoch.start <= oldest:
            for _ in range(second):
                self.steps.popleft()

    def insert(self, fix: Fix) -> Iterator[Step]:
        """Put a late fix in its place; yields the steps to take again, the first with `before`.

        Yields nothing where the fix is older than what is kept.
        """
        steps: Sequence[Step] = list(self.steps)
        if not steps or fix.time < steps[0].epoch.start:
            return
        stops = [step.epoch.stop for step in steps]
        k = min(bisect.bisect_left(stops, fix.time), len(steps) - 1)
        bisect.insort(steps[k].fixes, fix, key=by_time)
        while steps[k].before is None:
            k -= 1
        yield from steps[k:]

    def dump(self) -> dict[str, Any]:
        """Everything that `load` needs: arrays, numbers, text, lists and dictionaries."""
        steps = [
            {
                "epoch": step.epoch.dump(),
                "measurement": step.measurement and list(step.measurement),
                "fixes": [vars(fix) for fix in step.fixes],
                "before": step.before,
            }
            for step in self.steps
        ]
        return {"steps": steps, "since": self._since}

    def load(self, dump: dict[str, Any]) -> None:
        """Become what was dumped."""
        self._since = dump["since"]
        self.steps = deque(
            Step(
                Epoch.loaded(step["epoch"]),
                step["measurement"] and (step["measurement"][0], step["measurement"][1]),
                [Fix(**fix) for fix in step["fixes"]],
                step["before"],
            )
            for step in dump["steps"]
        )

    def _second_checkpoint(self) -> int:
        """Index of the second step that has a checkpoint, 0 where there is none."""
        for k in range(1, len(self.steps)):
            if self.steps[k].before is not None:
                return k
        return 0
