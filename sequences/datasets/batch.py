"""Apply one function to many recordings in parallel, skipping those that fail.

joblib runs the work: in processes of this machine by default, on a Dask or Ray cluster within
`joblib.parallel_config("dask")` or "ray".
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from stario.sequences.errors import MissingPackageError, StarioError

_log = logging.getLogger(__name__)

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Skipped:
    """An item that could not be used.

    Attributes:
        item: name of the item: its path.
        reason: the one-line error message, which names what was wrong and where.
    """

    item: str
    reason: str


def skipped(item: object, error: StarioError) -> Skipped:
    """Return an item that is skipped because of an error.

    Raises:
        MissingPackageError: that is the error, which no other recording of its kind would escape.
    """
    if isinstance(error, MissingPackageError):
        raise error
    return Skipped(str(item), str(error))


def each(
    work: Callable[[Item], Result], items: Iterable[Item], jobs: int | None = None
) -> Iterator[Result | Skipped]:
    """Yield the result of `work` for each item, in order and as soon as it is ready.

    With Ray all results come at the end. An item for which `work` raises a `StarioError` comes back
    as `Skipped`, as does one of several for which it raises any other exception, whose traceback is
    logged: a fault of ours costs one recording, not all. A missing package ends the batch.

    Args:
        work: function to apply; it must be picklable if there is more than one process.
        items: picklable items.
        jobs: number of processes; -1 for one per core, None for that of `joblib.parallel_config`
            (default 1).
    """
    from joblib import Parallel, delayed
    from joblib.parallel import get_active_backend

    one_by_one = get_active_backend()[0].supports_return_generator
    parallel = Parallel(n_jobs=jobs, return_as="generator" if one_by_one else "list")
    items = list(items)
    alone = len(items) == 1
    yield from parallel(delayed(_attempt)(work, item, alone) for item in items)


def without_skipped(
    outcomes: Iterable[Result | Skipped], skipped: list[Skipped]
) -> Iterator[Result]:
    """Yield the results of `each` in order; append the items that were skipped to `skipped`."""
    for outcome in outcomes:
        if isinstance(outcome, Skipped):
            skipped.append(outcome)
        else:
            yield outcome


def _attempt(work: Callable[[Item], Result], item: Item, alone: bool) -> Result | Skipped:
    try:
        return work(item)
    except StarioError as error:
        return skipped(item, error)
    except Exception as error:
        if alone:
            raise
        _log.exception("%s: not foreseen, please report it:", item)
        return Skipped(str(item), f"{type(error).__name__}: {error}")
