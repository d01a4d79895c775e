"""Many recordings through one function: in parallel, past those that fail.

joblib does the work: processes of this machine by default, a Dask or Ray cluster within
`joblib.parallel_config("dask")` or "ray".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from stario.sequences.errors import StarioError

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Skipped:
    """What could not be used.

    Attributes:
        item: what it is called: a path.
        reason: the error's line, which names what was wrong where.
    """

    item: str
    reason: str


def each(
    work: Callable[[Item], Result], items: Iterable[Item], jobs: int | None = None
) -> Iterator[Result | Skipped]:
    """What `work` makes of each item, in order, as soon as it is there; with Ray in the end.

    An item for which it raises a `StarioError` comes back as `Skipped`; any other exception is a
    bug and ends the batch.

    Args:
        work: a function that can be pickled, where more than one process works.
        items: anything that can be pickled.
        jobs: processes; -1 for one per core, None for what `joblib.parallel_config` says (1).
    """
    from joblib import Parallel, delayed
    from joblib.parallel import get_active_backend

    one_by_one = get_active_backend()[0].supports_return_generator
    parallel = Parallel(n_jobs=jobs, return_as="generator" if one_by_one else "list")
    yield from parallel(delayed(_attempt)(work, item) for item in items)


def _attempt(work: Callable[[Item], Result], item: Item) -> Result | Skipped:
    try:
        return work(item)
    except StarioError as error:
        return Skipped(str(item), str(error))
